"""Source distribution and wheel, built without network: complete, and a flight from nothing but the wheel."""

import json
import os
import shutil
import subprocess
import sys
import tarfile
from pathlib import Path

import pytest

pytestmark = pytest.mark.flight
ROOT = Path(__file__).parents[1]
#: Not of the source: hidden files and what tools, builds and flights leave in a checkout (.gitignore).
LEFT = shutil.ignore_patterns(".?*", "__pycache__", "*.egg-info", "build", "dist", "study", "*.mcap")


def run(*command: str | Path, cwd: Path, path: Path | None = None) -> str:
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    if path is not None:
        environment["PYTHONPATH"] = str(path)
    done = subprocess.run(command, cwd=cwd, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def built(kind: str, source: Path, into: Path) -> Path:
    """Build `kind`, sdist or wheel, of `source`; return its file."""
    into.mkdir()
    code = f"from setuptools import build_meta; build_meta.build_{kind}({str(into)!r})"
    run(sys.executable, "-c", code, cwd=source)
    (found,) = into.iterdir()
    return found


def files(folder: Path, *packages: str) -> set[str]:
    found = (path for package in packages or ("",) for path in (folder / package).rglob("*"))
    return {str(path.relative_to(folder)) for path in found if path.is_file() and path.suffix != ".pyc"}


@pytest.fixture(scope="module")
def tree(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A copy of the source: building leaves files in it."""
    return shutil.copytree(ROOT, tmp_path_factory.mktemp("tree") / "tree", ignore=LEFT)


@pytest.fixture(scope="module")
def unpacked(tree: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The source distribution of `tree`, unpacked."""
    folder = tmp_path_factory.mktemp("sdist")
    with tarfile.open(built("sdist", tree, folder / "built")) as archive:
        archive.extraction_filter = getattr(tarfile, "data_filter", None)  # not in Python 3.11.2
        archive.extractall(folder)
    (found,) = folder.glob("navigation_companion-*")
    return found


@pytest.fixture(scope="module")
def target(unpacked: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder into which the wheel of `unpacked` is installed."""
    folder = tmp_path_factory.mktemp("wheel")
    wheel = built("wheel", unpacked, folder / "built")
    options = ("--no-deps", "--no-index", "--no-compile", "--quiet", "--target")
    run(sys.executable, "-m", "pip", "install", *options, folder / "target", wheel, cwd=folder)
    return folder / "target"


def test_source_distribution_is_the_whole_source(tree: Path, unpacked: Path) -> None:
    assert files(tree) ^ files(unpacked) == {"PKG-INFO", "setup.cfg"}
    for folder in ("tests", "docs", "examples", "deploy"):
        assert files(unpacked, folder), folder
    assert {"LICENSE", "companion/link/rsbn.xml"} <= files(unpacked)


def test_wheel_holds_the_packages_with_their_data(unpacked: Path, target: Path) -> None:
    packages = ("companion", "sitl")
    assert files(target, *packages) == files(unpacked, *packages)
    assert list(target.glob("navigation_companion-*.dist-info/licenses/LICENSE"))


def test_wheel_flies(target: Path, tmp_path: Path) -> None:
    imported = run(
        sys.executable, "-c", "import companion; print(companion.__file__)", cwd=tmp_path, path=target
    )
    assert Path(imported.strip()).is_relative_to(target)
    companion = target / "bin" / "companion"
    assert "loopback" in run(companion, "--help", cwd=tmp_path, path=target)
    flown = run(companion, "loopback", "--scenario=short", "--logs=logs", "--json", cwd=tmp_path, path=target)
    assert json.loads(flown)
    assert list((tmp_path / "logs").iterdir())
