"""DataFlash container (ArduPilot `.bin` and `.log`): bytes -> messages with named columns. Pure.

A binary message is two magic bytes, a type and its columns; messages of type 128 (FMT) define the others.
There are no checksums: after damage the reader continues at a message that another one follows soon. It
trusts no length and always advances. pymavlink's DFReader, the reference in the tests, never returns from
some damaged files, gives up on others, and prints to the terminal.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Collection, Iterator
from types import SimpleNamespace
from typing import Any, NamedTuple, TypeAlias

from companion.importers.foreign_file import Damage, one_line

Message: TypeAlias = Any
"""The columns of a message as attributes."""
Buffer: TypeAlias = Any
"""bytes or mmap."""

HEAD = b"\xa3\x95"
_FORMAT, _FORMAT_SIZE = 128, 89
_FORMAT_LAYOUT = struct.Struct("<BB4s16s64s")
_FORMAT_CELLS = 4  # of a FMT line, at least: type, length, name, format
_MAX_LINE = 4096
_GAP = 8  # bytes of damage between two messages that confirm each other

#: struct code and divisor of each format character (ArduPilot's LogStructure.h).
_CODES: dict[str, tuple[str, float | None]] = {
    **{same: (same, None) for same in "bBhHiIfdqQ"},
    "a": ("64s", None),
    "n": ("4s", None),
    "N": ("16s", None),
    "Z": ("64s", None),
    "g": ("e", None),
    "M": ("b", None),
    "c": ("h", 100.0),
    "C": ("H", 100.0),
    "e": ("i", 100.0),
    "E": ("I", 100.0),
    "L": ("i", 1e7),
}
_TEXT = "aNnZ"


class Layout(NamedTuple):
    """Format of one type of message: size in bytes, head included, and what is in its columns."""

    name: str
    size: int
    packed: struct.Struct
    columns: tuple[str, ...]
    decoders: tuple[Callable[[Any], Any] | None, ...]


class FoundMessage(NamedTuple):
    """A message with its type and its place in the file."""

    place: int
    name: str
    message: Message


def is_binary(head: bytes) -> bool | None:
    """Return whether a file with this beginning is a binary log or a text log; None if it is neither."""
    if HEAD + bytes([_FORMAT]) in head[:4096]:
        return True
    return False if b"FMT," in head else None


def messages(
    data: Buffer, names: Collection[str], damage: Damage, *, binary: bool = True
) -> Iterator[FoundMessage]:
    """Yield the messages of the types `names` in the order of the file; unreadable parts go to `damage`."""
    return (_binary_messages if binary else _text_messages)(data, names, damage)


def _binary_messages(data: Buffer, names: Collection[str], damage: Damage) -> Iterator[FoundMessage]:
    layouts: dict[int, Layout] = {_FORMAT: Layout("FMT", _FORMAT_SIZE, _FORMAT_LAYOUT, (), ())}
    at, end = 0, len(data)

    def size_at(place: int) -> int:
        """Return the size of the message that may begin at `place`, 0 if none does."""
        if data[place : place + 2] != HEAD or place + 3 > end:
            return 0
        layout = layouts.get(data[place + 2])
        return layout.size if layout is not None and place + layout.size <= end else 0

    def is_followed(stop: int) -> bool:
        """Return whether a message that stops there is followed by another or the end, `_GAP` bytes apart."""
        following = data.find(HEAD, stop, stop + _GAP + len(HEAD))
        return stop + _GAP >= end or following == stop or (following > stop and size_at(following) > 0)

    def next_message(place: int) -> int:
        """Return where the next message begins that is followed by another or the end; the end if none is."""
        while (place := data.find(HEAD, place)) >= 0:
            size = size_at(place)
            if size and is_followed(place + size):
                return place
            place += 1
        return end

    while at < end:
        size = size_at(at)
        if not size or (at + size < end and data[at + size : at + size + 2] != HEAD):
            following = next_message(at + 1)
            if not size or following < at + size:  # a message that lost bytes holds the next one
                damage.add(f"byte {at}", following - at, "not a message")
                at = following
                continue
        kind = data[at + 2]
        layout = layouts[kind]
        if kind == _FORMAT:
            defined, number, problem = _parse_format(data[at + 3 : at + size])
            if defined is not None:
                layouts[number] = defined
            elif number != _FORMAT:
                damage.add(f"byte {at}", size, problem)
        elif layout.name in names:
            values = layout.packed.unpack_from(data, at + 3)
            yield FoundMessage(at, layout.name, _named(layout, values))
        at += size


def _parse_format(content: bytes) -> tuple[Layout | None, int, str]:
    """Return layout, type and problem of a FMT message."""
    number, size, name, codes, columns = _FORMAT_LAYOUT.unpack(content)
    try:
        if number == _FORMAT:
            return None, number, ""
        layout = _layout(_text(name), _text(codes), _text(columns))
    except (KeyError, struct.error) as error:
        return None, number, f"unknown format {error}"
    if size < 3 + layout.packed.size:
        return None, number, f"{layout.name} needs {3 + layout.packed.size} bytes and states {size}"
    return layout._replace(size=size), number, ""


def _layout(name: str, codes: str, columns: str) -> Layout:
    """Return the layout of a message. Raises KeyError if a format character is unknown."""
    packed = struct.Struct("<" + "".join(_CODES[code][0] for code in codes))
    decoders = tuple(_text if code in _TEXT else _divided(_CODES[code][1]) for code in codes)
    return Layout(name, 0, packed, tuple(columns.split(",")), decoders)


def _named(layout: Layout, values: tuple[Any, ...]) -> Message:
    decoded = (
        value if decode is None else decode(value)
        for value, decode in zip(values, layout.decoders, strict=True)
    )
    return SimpleNamespace(**dict(zip(layout.columns, decoded)))


def _text(value: bytes) -> str:
    return value.partition(b"\0")[0].decode("utf-8", "replace")


def _divided(by: float | None) -> Callable[[Any], Any] | None:
    return None if by is None else lambda value: value / by


def _text_messages(data: Buffer, names: Collection[str], damage: Damage) -> Iterator[FoundMessage]:
    layouts: dict[str, tuple[str, tuple[str, ...]]] = {}
    for place, line in _lines(data, damage):
        name, *cells = (cell.strip() for cell in line.split(","))
        try:
            if name == "FMT":
                if len(cells) < _FORMAT_CELLS:
                    raise ValueError(f"a FMT of {len(cells)} values (at least {_FORMAT_CELLS})")
                layouts[cells[2]] = cells[3], tuple(cells[4:])
            elif name in names and name in layouts:
                codes, columns = layouts[name]
                if name == "MSG":  # its text may contain commas
                    cells[len(columns) - 1 :] = [", ".join(cells[len(columns) - 1 :])]
                if len(cells) != len(codes):
                    raise ValueError(f"{name} of {len(cells)} values (its FMT has {len(codes)})")
                values = [_parse_cell(code, cell) for code, cell in zip(codes, cells, strict=True)]
                yield FoundMessage(place, name, SimpleNamespace(**dict(zip(columns, values))))
            elif name in names or (cells and layouts and name not in layouts):
                damage.add(f"byte {place}", len(line) + 1, "a line of an undefined message")
        except (ValueError, KeyError, IndexError) as error:
            damage.add(f"byte {place}", len(line) + 1, one_line(error))


def _lines(data: Buffer, damage: Damage) -> Iterator[tuple[int, str]]:
    at, end = 0, len(data)
    while at < end:
        newline = data.find(b"\n", at)
        stop = end if newline < 0 else newline
        if stop - at > _MAX_LINE:
            damage.add(f"byte {at}", stop - at, f"a line of {stop - at} bytes (limit {_MAX_LINE})")
        else:
            yield at, data[at:stop].decode("utf-8", "replace")
        at = stop + 1


def _parse_cell(code: str, cell: str) -> Any:
    if code in _TEXT:
        return cell
    if code in "fdgcCeEL":
        return float(cell)
    return int(float(cell)) if "." in cell else int(cell)
