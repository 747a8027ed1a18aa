"""Plain words in docstrings, comments and pages; stated arguments of public mathematics."""

import importlib
import inspect
import pkgutil
import re
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType
from typing import NamedTuple

import pytest

import companion.estimate
import companion.nav

ROOT = Path(__file__).parents[1]
FOLDERS = ("companion", "sitl", "tests", "examples", "deploy", "docs")
PAGES = ("README.md", "ARCHITECTURE.md", "CONTRIBUTING.md", "CHANGELOG.md")
LIMIT = 0.5  # per thousand words; h11 has 1.2, websockets 0.3, pyins 0

#: Words of a dialect that a navigation engineer does not use. "lies" counts as a verb only: a lie is the
#: error of a false source, a term of `estimate.bank`; and a line of sight is geometry.
DIALECT = re.compile(
    r"\b(?:told|tells?|telling|heard|hears?|hearing|says?|said|saying|nobody|lest|anew|heeds?|heeded|lying|liars?"
    r"|taught|teach(?:es)?|learnt|begun|whoever|till|for ever|dear(?:est)?"
    r"|(?:it|that|which|who|what|x|source|gnss|beacon|spoofer|one|position|beyond|point)\s+lies"
    r"|(?<!of )(?<!radio )sights?)\b",
    re.IGNORECASE,
)
WORD = re.compile(r"[A-Za-z']+")
#: A comment of ours has a space after its number sign; `tokenize` finds the same ones, but slowly.
COMMENT = re.compile(r"(?:^|\s)#[:!]? .*")
#: A docstring, of a constant too, starts a line; strings in code are passed over. A parser takes seconds.
TEXT = re.compile(r'^[ \t]*r?"""(.*?)"""|""".*?"""', re.DOTALL | re.MULTILINE)


class Prose(NamedTuple):
    """One line of text that a person reads."""

    path: Path
    line: int
    text: str


def of_python(path: Path) -> Iterator[Prose]:
    """Comments and docstrings of a module."""
    source = path.read_text()
    for number, line in enumerate(source.splitlines(), 1):
        if found := COMMENT.search(line):
            yield Prose(path, number, found[0])
    for found in TEXT.finditer(source):
        first = source.count("\n", 0, found.start()) + 1
        for number, line in enumerate((found[1] or "").splitlines(), first):
            yield Prose(path, number, line)


def of_page(path: Path) -> Iterator[Prose]:
    for number, line in enumerate(path.read_text().splitlines(), 1):
        yield Prose(path, number, line)


def of_code() -> Iterator[Prose]:
    for folder in FOLDERS:
        for path in sorted((ROOT / folder).rglob("*.py")):
            if "generated" not in path.parts and path != Path(__file__):
                yield from of_python(path)


def of_pages() -> Iterator[Prose]:
    found = [path for folder in FOLDERS for path in sorted((ROOT / folder).rglob("*.md"))]
    for path in found:
        if not path.is_relative_to(ROOT / "tests"):
            yield from of_page(path)
    for name in PAGES:
        yield from of_page(ROOT / name)


def share(lines: list[Prose]) -> tuple[float, str]:
    """Dialect words per thousand, and the lines that have them."""
    words = sum(len(WORD.findall(line.text)) for line in lines)
    hits = [(line, len(DIALECT.findall(line.text))) for line in lines]
    shown = "\n".join(
        f"{line.path.relative_to(ROOT)}:{line.line}: {line.text.strip()}" for line, count in hits if count
    )
    return 1000.0 * sum(count for _, count in hits) / words, shown


@pytest.mark.parametrize(
    ("text", "count"),
    [
        ("what it says is told anew", 3),
        ("a beacon that lies is heard again", 2),
        ("the lies move by their rates; a lie per source", 0),
        ("a line of sight, the range of direct radio sight", 0),
        ("the innovation is rejected; bounds hold about the position that is sent", 0),
    ],
)
def test_dialect_is_counted(text: str, count: int) -> None:
    assert len(DIALECT.findall(text)) == count


def test_code_and_docs_are_in_plain_words() -> None:
    found, lines = share([*of_code(), *of_pages()])
    assert found < LIMIT, lines


def test_pages_are_in_plain_words() -> None:
    found, lines = share(list(of_pages()))
    assert found < LIMIT, lines


def public_functions() -> Iterator[tuple[str, object]]:
    """Functions of `estimate` and `nav` whose name is public, in every module of the two packages."""
    for package in (companion.estimate, companion.nav):
        for found in pkgutil.walk_packages(package.__path__, package.__name__ + "."):
            module = importlib.import_module(found.name)
            for name, value in inspect.getmembers(module, inspect.isfunction):
                if value.__module__ == module.__name__ and not name.startswith("_"):
                    yield f"{module.__name__}.{name}", value


def test_public_functions_of_estimate_and_nav_state_parameters_or_returns() -> None:
    functions = dict(public_functions())
    assert len(functions) > 100
    missing = [
        name
        for name, value in functions.items()
        if not re.search(r"^(?:Parameters|Returns)\n-+$", inspect.getdoc(value) or "", re.MULTILINE)
    ]
    assert not missing


@pytest.mark.parametrize("package", [companion.estimate, companion.nav])
def test_every_module_is_listed_in_its_package(package: ModuleType) -> None:
    listed = re.findall(r"^    (\w+)  ", package.__doc__ or "", re.MULTILINE)
    assert sorted(listed) == sorted(found.name for found in pkgutil.iter_modules(package.__path__))
