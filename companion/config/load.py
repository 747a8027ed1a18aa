"""Configuration loader: file, environment variables and command line, each overriding the one before.

The file is TOML, one table per section; the environment variable of a key is `COMPANION_SECTION__KEY`. A
mistake raises `ConfigError`: one sentence with the place, the key and the nearest valid one. The service then
does not start (exit code 78, EX_CONFIG).
"""

from __future__ import annotations

import difflib
import os
import re
import stat
import tomllib
from collections.abc import Iterable, Mapping
from pathlib import Path
from types import UnionType
from typing import Annotated, Any, Literal, Union, get_args, get_origin, get_type_hints

import msgspec

from companion.config.presets import PRESETS
from companion.config.schema import SECTIONS, Config
from companion.config.validate import find_conflicts, find_mistakes

#: Bytes of a file and dots in a line of it: a dotted key takes memory by the square of its parts (60 kB of
#: them, 3.5 GB).
MAX_SIZE, MAX_DOTS = 1 << 16, 1000
MAX_QUOTED = 100  # characters of a line that is quoted in an error
PREFIX = "COMPANION_"  # every environment variable with this prefix must name a key


class ConfigError(ValueError):
    """Invalid configuration; the text states where the mistake is and what to write instead."""


def load(
    path: Path | None = None,
    flags: Mapping[str, Any] | None = None,
    environment: Mapping[str, str] | None = None,
    pairs: Iterable[str] = (),
    tuned: Path | None = None,
    preset: str | None = None,
) -> Config:
    """Load the configuration; each source overrides the ones before.

    Parameters
    ----------
    path
        TOML file.
    tuned
        TOML file of the values that ground stations set; overrides `path` only.
    environment
        Variables `COMPANION_SECTION__KEY`, those of the process by default.
    flags
        Values by "section.key"; None is unset.
    pairs
        Texts "section.key=value" as typed.
    preset
        Name in `PRESETS`; every other source overrides it.

    Raises
    ------
    ConfigError
        If a file cannot be read, a key is unknown or a value is invalid.
    """
    tree: dict[str, dict[str, Any]] = {}
    origin: dict[tuple[str, str], str] = {}
    for name, value in _preset(preset).items():
        section, _, key = name.partition(".")
        tree.setdefault(section, {})[key] = value
        origin[section, key] = f"preset {preset}"
    for source in (path, tuned):
        if source is not None:
            for section, table in _read(source).items():
                tree.setdefault(section, {}).update(table)
                origin |= {(section, key): str(source) for key in table}
    for name, text in (os.environ if environment is None else environment).items():
        if name.startswith(PREFIX):
            section, between, key = name.removeprefix(PREFIX).lower().partition("__")
            if not between:
                raise ConfigError(f"environment variable {name}: no such key{_nearest_variable(name)}")
            _check_keys({section: {key: text}}, f"environment variable {name}")
            tree.setdefault(section, {})[key] = _parse_value(text)
            origin[section, key] = f"environment variable {name}"
    for name, value in (flags or {}).items():
        if value is not None:
            section, key = name.split(".")
            tree.setdefault(section, {})[key] = value
            origin[section, key] = "command line"
    for pair in pairs:
        name, _, text = pair.partition("=")
        section, _, key = name.strip().partition(".")
        if not key or not text:
            raise ConfigError(f"--set {pair}: write it as SECTION.KEY=VALUE, for example gnss.sigma_m=3.0")
        _check_keys({section: {key: text}}, f"--set {pair}")
        if (first := origin.get((section, key), "")).startswith("--set "):
            raise ConfigError(f"--set {pair}: {section}.{key} is given twice, also as {first}: leave one out")
        tree.setdefault(section, {})[key] = _parse_value(text.strip())
        origin[section, key] = f"--set {pair}"
    _check_preset(preset, tree, origin, path)
    config = _convert(tree, origin)
    _refuse(find_mistakes(config), origin)
    return config


def parse(text: str, where: str) -> Config:
    """Parse the configuration in `text`, e.g. of a log; `where` names its source in a `ConfigError`."""
    tree = _tree(text, where)
    _check_keys(tree, where)
    return _convert(tree, {(section, key): where for section, table in tree.items() for key in table})


def to_toml(config: Config) -> str:
    """Format the whole configuration as TOML that `load` reads back."""
    lines = []
    for section in config.__struct_fields__:
        table = getattr(config, section)
        lines.append(f"[{section}]")
        # JSON strings, numbers, booleans and lists are valid TOML
        lines += [
            f"{key} = {msgspec.json.encode(getattr(table, key)).decode()}" for key in table.__struct_fields__
        ]
        lines.append("")
    return "\n".join(lines)


def _preset(name: str | None) -> Mapping[str, Any]:
    if name is None:
        return {}
    if name not in PRESETS:
        raise ConfigError(f"--preset {name}: not one of {', '.join(PRESETS)}{_did_you_mean(name, PRESETS)}")
    return PRESETS[name].values


def _check_preset(
    preset: str | None,
    tree: Mapping[str, Mapping[str, Any]],
    origin: Mapping[tuple[str, str], str],
    path: Path | None,
) -> None:
    """Refuse a file that takes away what the preset is for: its first key. One with every key does.

    Of an autopilot without an INS of its own none may be stated, wherever that is.
    """
    values = _preset(preset)
    if (
        values
        and "inertial.independent" not in values
        and tree.get("inertial", {}).get("independent") is True
    ):
        raise ConfigError(
            f"--preset {preset} is for an autopilot without an INS of its own, and "
            f"{origin['inertial', 'independent']} sets inertial.independent = true: leave out one of them"
        )
    other = []
    for name, value in values.items():
        section, _, key = name.partition(".")
        if origin[section, key] == str(path) and tree[section][key] != value:
            other.append(name)
    if next(iter(values), None) in other:
        raise ConfigError(
            f"--preset {preset} has no effect: {path} overrides its {', '.join(other)}; "
            "remove that from the file, or leave the preset out"
        )


def _read(path: Path) -> dict[str, dict[str, Any]]:
    try:
        if not stat.S_ISREG(path.stat().st_mode) and not path.is_dir():
            raise ConfigError(f"{path} is not a regular file; give the TOML file")  # a pipe may never end
        with path.open(encoding="utf-8-sig") as file:  # some editors begin a file with a byte order mark
            text = file.read(MAX_SIZE + 1)
        size = max(path.stat().st_size, len(text))
    except FileNotFoundError:
        raise ConfigError(f"{path}: no such file; start from `companion check-config --defaults`") from None
    except UnicodeDecodeError:
        raise ConfigError(f"{path}: not a text file in UTF-8; a configuration is TOML") from None
    except IsADirectoryError:
        raise ConfigError(f"{path} is a folder; give the TOML file") from None
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read ({error.strerror or error})") from None
    _check_size(size, str(path))
    tree = _tree(text, str(path))
    _check_keys(tree, str(path))
    return tree


def _tree(text: str, where: str) -> dict[str, dict[str, Any]]:
    _check_size(len(text), where)
    for number, line in enumerate(text.split("\n"), 1):
        if (dots := line.count(".")) > MAX_DOTS:
            raise ConfigError(f"{where}: line {number} has {dots} dots, at most {MAX_DOTS} are allowed")
    try:
        tree = tomllib.loads(text)
    except (ValueError, RecursionError) as error:  # an integer of thousands of digits is no TOMLDecodeError
        raise ConfigError(f"{where}: not valid TOML: {error}{_line_of(error, text)}") from None
    for section, table in tree.items():
        if isinstance(table, dict):
            continue
        if section in SECTIONS:
            raise ConfigError(f"{where}: `{section}` is a section: write [{section}] and its keys below it")
        raise ConfigError(f"{where}: the key `{section}` is in no section{_sections_of(section)}")
    return tree


def _line_of(error: Exception, text: str) -> str:
    """Return the line that an error of tomllib names, and what is mostly wrong with it."""
    found = re.search(r"\(at line (\d+),", str(error))
    line = text.split("\n")[int(found[1]) - 1].strip() if found else ""
    quoted = f": `{line}`" if 0 < len(line) <= MAX_QUOTED else ""
    if re.match(r"Cannot (overwrite|declare|mutate)", str(error)):
        return f"{quoted}; a key or section is given twice: keep one"
    advice = "; write text in quotes, numbers with a decimal point, and a switch as true or false"
    return f"{quoted}{advice}" if quoted else ""


def _check_size(size: int, where: str) -> None:
    if size > MAX_SIZE:
        raise ConfigError(f"{where}: {size} bytes, but a configuration has at most {MAX_SIZE}")


def _check_keys(tree: Mapping[str, Mapping[str, Any]], where: str) -> None:
    for section, table in tree.items():
        if section not in SECTIONS:
            raise ConfigError(f"{where}: there is no section [{section}]{_nearest(section, SECTIONS)}")
        keys = SECTIONS[section].__struct_fields__
        for key in table:
            if key not in keys:
                raise ConfigError(f"{where}: section [{section}] has no key `{key}`{_nearest(key, keys)}")


def _did_you_mean(name: str, known: Iterable[str], cutoff: float = 0.5) -> str:
    spelt = {word.lower(): word for word in known}
    close = difflib.get_close_matches(name.lower(), list(spelt), 1, cutoff)
    return f"; did you mean `{spelt[close[0]]}`?" if close else ""


def _nearest(name: str, known: Iterable[str]) -> str:
    return _did_you_mean(name, known) or f"; it has {', '.join(known)}"


def _sections_of(key: str) -> str:
    """Return the advice for a key without its section: every section that has it, or the nearest key."""
    tables = {section: kind.__struct_fields__ for section, kind in SECTIONS.items()}
    close = difflib.get_close_matches(key, sorted({name for names in tables.values() for name in names}), 1)
    found = [f"`{section}.{name}`" for name in close for section in tables if name in tables[section]]
    return f"; did you mean {' or '.join(found)}?" if found else f"; the sections are {', '.join(tables)}"


def _nearest_variable(name: str) -> str:
    known = [f"{PREFIX}{s}__{key}".upper() for s, kind in SECTIONS.items() for key in kind.__struct_fields__]
    return _did_you_mean(name, known, 0.6) or f"; write it as {PREFIX}SECTION__KEY"


def _parse_value(text: str) -> Any:
    """Parse a value as TOML; a text that is not TOML is a string."""
    try:
        return tomllib.loads(f"value = {text}")["value"]
    except (ValueError, RecursionError):
        return text


def _as_list(value: Any, kind: Any) -> Any:
    """Wrap a single value in a list where the key takes a list."""
    return [value] if get_origin(kind) is tuple and not isinstance(value, list | tuple) else value


def choices(kind: Any) -> tuple[str, ...]:
    """Return the texts that a key accepts; empty if it accepts other values too."""
    if get_origin(kind) is Literal:
        return get_args(kind)
    if get_origin(kind) in (Union, UnionType, tuple):
        return tuple(word for one in get_args(kind) for word in choices(one))
    return ()


def _or_number(kind: Any) -> str:
    """Return what a key accepts besides texts."""
    limits = [get_args(one)[1] for one in get_args(kind) if get_origin(one) is Annotated]
    return "".join(f", nor a number {_interval(limit)}" for limit in limits)


def _interval(limit: msgspec.Meta) -> str:
    """Return the limits of a number in words; some have no upper one."""
    return f"of at least {limit.ge:g}" if limit.le is None else f"from {limit.ge:g} to {limit.le:g}"


def _wanted(kind: Any, value: Any) -> str:
    """Return what to give for a number, text, or true or false; empty for another kind of key."""
    if kind is bool:
        return "give true or false"
    if kind in (str, tuple[str, ...]):
        return "give text in quotes"
    if get_origin(kind) is not Annotated or get_args(kind)[0] not in (int, float):
        return ""
    base, limit = get_args(kind)
    number = "a whole number" if base is int else "a number"
    without = ""
    if isinstance(value, str):
        without = ", with a decimal point" if "," in value else ", without quotes"
    if base is int and isinstance(value, float) and value.is_integer():
        without = ", without point or exponent"
    return f"give {number} {_interval(limit)}{without}"


def _convert(tree: Mapping[str, Mapping[str, Any]], origin: Mapping[tuple[str, str], str]) -> Config:
    sections: dict[str, Any] = {}
    for section, table in tree.items():
        kind = SECTIONS[section]
        hints = get_type_hints(kind, include_extras=True)
        table = {key: _as_list(value, hints[key]) for key, value in table.items()}
        for key, value in table.items():
            try:
                msgspec.convert({key: value}, kind)
            except msgspec.ValidationError as error:
                reason = str(error).split(" - at ")[0].replace("`", "")
                where = origin[section, key]
                if words := choices(hints[key]):
                    raise ConfigError(
                        f"{where}: {section}.{key}: {value!r} is not one of {', '.join(words)}"
                        f"{_or_number(hints[key])}{_did_you_mean(str(value), words)}"
                    ) from None
                wanted = _wanted(hints[key], value) or f"{reason[0].lower()}{reason[1:]}"
                raise ConfigError(f"{where}: {section}.{key} = {value!r} is invalid: {wanted}") from None
        sections[section] = msgspec.convert(table, kind)
    config = Config(**sections)
    _refuse(find_conflicts(config), origin)
    return config


def _refuse(found: Iterable[tuple[str, str, str]], origin: Mapping[tuple[str, str], str]) -> None:
    for section, key, sentence in found:
        raise ConfigError(f"{origin.get((section, key), 'configuration')}: {sentence}")
