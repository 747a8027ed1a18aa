"""ULog container (PX4 `.ulg`): bytes -> rows of topics and messages of the logger, in the order of the file.

https://docs.px4.io/main/en/dev_log/ulog_file_format.html. A message has a size, a type and a body; formats
(F) define topics, subscriptions (A) give them numbers, data (D) are their rows. There are no checksums: after
damage the reader continues at the next two messages that follow each other. It trusts no length and always
advances. pyulog, the reference in the tests, keeps the whole log in memory and needs minutes for some damaged
files. Pure.
"""

from __future__ import annotations

import struct
from collections.abc import Collection, Iterator
from typing import Any, NamedTuple, TypeAlias

from companion.importers.foreign_file import Damage, one_line

Row: TypeAlias = dict[str, Any]
Buffer: TypeAlias = Any
"""bytes or mmap."""

MAGIC = b"\x55\x4c\x6f\x67\x01\x12\x35"
_HEADER_SIZE = 16
_HEAD = struct.Struct("<HB")
_DATA_APPENDED = 1  # the only incompatible flag that is known
_SYNC = b"\x2f\x73\x13\x20\x25\x0c\xbb\x12"
#: Smallest body of each type of message.
_SMALLEST = {
    ord(kind): size for kind, size in zip("BFIMPQARDLCSO", (40, 3, 2, 3, 2, 3, 4, 2, 2, 9, 11, 8, 2))
}
_DATA, _SUBSCRIPTION, _FORMAT, _TEXT, _TAGGED, _DROPOUT, _FLAGS, _SYNCHRONISATION = map(ord, "DAFLCOBS")
_CODES = {
    "int8_t": "b",
    "uint8_t": "B",
    "int16_t": "h",
    "uint16_t": "H",
    "int32_t": "i",
    "uint32_t": "I",
    "int64_t": "q",
    "uint64_t": "Q",
    "float": "f",
    "double": "d",
    "bool": "?",
    "char": "c",
}
MAX_FIELDS = 1 << 17
"""Fields of all topics of a file, with those of nested types counted again; the recorded logs have 10,000."""
_MAX_DEPTH, _MAX_LABEL = 8, 64


class TopicRow(NamedTuple):
    """One row of a topic (its first instance)."""

    place: int
    topic: str
    row: Row


class LoggedText(NamedTuple):
    """A text of the logger with its severity (MAV_SEVERITY) and time since boot."""

    place: int
    boot_us: int
    severity: int
    text: str


class Dropout(NamedTuple):
    """Data that the logger lost; its time is that of the data around it."""

    place: int
    duration_ms: int


class _Layout(NamedTuple):
    """A topic's rows: their bytes without padding at the end (which may be missing) and with it."""

    topic: str
    shortest: int
    longest: int
    packed: struct.Struct | None  # None and no fields if the topic is not wanted
    fields: tuple[str, ...]


def messages(
    data: Buffer, topics: Collection[str], damage: Damage
) -> Iterator[TopicRow | LoggedText | Dropout]:
    """Yield rows of `topics`, texts and dropouts; unreadable parts go to `damage`.

    Raises ValueError if the file needs a newer reader.
    """
    layouts = _Layouts(topics)
    subscribed: dict[int, tuple[_Layout, bool]] = {}  # by number; whether it is the first instance
    appended: list[int] = []  # where data was appended to a log that may be torn there, descending
    at, end = _HEADER_SIZE, len(data)

    def size_at(place: int, before: int = 0) -> int:
        """Return the size of the message at `place`, 0 if none begins there.

        The message at `before`, if any, may be the subscription of which it is the first row.
        """
        if place + 3 > end:
            return 0
        size, kind = _HEAD.unpack_from(data, place)
        if size < _SMALLEST.get(kind, 1 << 16) or place + 3 + size > end:
            return 0
        if kind == _DATA:
            number = data[place + 3 : place + 5]
            if before and data[before + 2] == _SUBSCRIPTION and data[before + 4 : before + 6] == number:
                return int(size) + 3
            found = subscribed.get(number[0] | number[1] << 8)
            if found is None or not found[0].shortest + 2 <= size <= found[0].longest + 2:
                return 0
        elif (kind == _SYNCHRONISATION and data[place + 3 : place + 11] != _SYNC) or (
            kind == _FLAGS and place != _HEADER_SIZE  # the first message states what the log needs
        ):
            return 0
        return int(size) + 3

    def next_message(place: int) -> int:
        """Return where the next message begins that is followed by another or the end."""
        while place < end:
            size = size_at(place)
            if size and (place + size == end or size_at(place + size, place)):
                return place
            place += 1
        return end

    while at < end:
        while appended and appended[-1] <= at:
            appended.pop()
        size = size_at(at)
        if appended and (at + size > appended[-1] or not size):
            damage.add(f"byte {at}", appended[-1] - at, "torn before the data appended later")
            at = appended.pop()
            continue
        if not size or (at + size < end and not size_at(at + size, at)):
            following = next_message(at + 1)
            if not size or following < at + size:  # a message that lost bytes holds the next one
                damage.add(f"byte {at}", following - at, "not a message")
                at = following
                continue
        kind, body = data[at + 2], at + 3
        try:
            if kind == _DATA:
                layout, first = subscribed[data[body] | data[body + 1] << 8]
                if first and layout.packed is not None:
                    values = layout.packed.unpack_from(data, body + 2)
                    yield TopicRow(at, layout.topic, dict(zip(layout.fields, values)))
            elif kind == _FORMAT:
                name, _, fields = data[body : at + size].decode("utf-8", "replace").partition(":")
                layouts.formats[name] = fields
            elif kind == _SUBSCRIPTION:
                name = data[body + 3 : at + size].decode("utf-8", "replace")
                number = data[body + 1] | data[body + 2] << 8
                subscribed[number] = layouts.find(name), data[body] == 0
            elif kind in (_TEXT, _TAGGED):
                time_at = body + (1 if kind == _TEXT else 3)
                boot_us = int.from_bytes(data[time_at : time_at + 8], "little")
                text = data[time_at + 8 : at + size].decode("utf-8", "replace")
                yield LoggedText(at, boot_us, min(max(data[body] - ord("0"), 0), 7), text)
            elif kind == _DROPOUT:
                yield Dropout(at, data[body] | data[body + 1] << 8)
            elif kind == _FLAGS:
                appended = _appended_offsets(data[body : body + 40], end)
        except (LookupError, struct.error) as error:
            damage.add(f"byte {at}", size, one_line(error))
        at += size


def _appended_offsets(flags: bytes, end: int) -> list[int]:
    if flags[8] & ~_DATA_APPENDED or any(flags[9:16]):
        raise ValueError("it needs a newer version of ULog (unknown incompatible flags)")
    offsets = struct.unpack_from("<3Q", flags, 16)
    return sorted((offset for offset in offsets if _HEADER_SIZE < offset < end), reverse=True)


class _Layouts:
    """Layouts of the topics, each made once from its format; names of fields are kept for `wanted` ones."""

    def __init__(self, wanted: Collection[str]) -> None:
        self.formats: dict[str, str] = {}
        self._wanted = wanted
        self._found: dict[str, _Layout | LookupError] = {}
        self._left = MAX_FIELDS

    def find(self, name: str) -> _Layout:
        """Return the layout of a topic. Raises LookupError if it is not defined, or too large."""
        if name not in self.formats:
            raise LookupError(f"topic {name} is not defined")
        if name not in self._found:
            try:
                self._found[name] = self._make(name)
            except LookupError as error:
                self._found[name] = error
        found = self._found[name]
        if isinstance(found, LookupError):
            raise LookupError(*found.args)
        return found

    def _make(self, name: str) -> _Layout:
        fields = self._flatten(name, _MAX_DEPTH)
        longest = struct.calcsize("<" + "".join(code for _, code in fields))
        if longest > 0xFFFF:
            raise LookupError(f"topic {name} has {longest} bytes (limit 65535)")
        while fields and fields[-1][0].startswith("_padding"):
            fields.pop()
        packed = struct.Struct("<" + "".join(code for _, code in fields))
        if name not in self._wanted:
            return _Layout(name, packed.size, longest, None, ())
        return _Layout(name, packed.size, longest, packed, tuple(label for label, _ in fields))

    def _flatten(self, name: str, depth: int) -> list[tuple[str, str]]:
        """Return the fields with their struct codes, nested ones as LABEL.NAME, arrays as LABEL[0]."""
        if name not in self.formats or depth == 0:
            raise LookupError(
                f"topic {name} is not defined" if depth else f"topic {name} is nested too deeply"
            )
        self._count(name, self.formats[name].count(";"))
        flat: list[tuple[str, str]] = []
        for field in filter(None, self.formats[name].split(";")):
            kind, _, label = field.partition(" ")
            kind, _, length = kind.partition("[")
            if length and not (length[-1] == "]" and length[:-1].isdecimal() and len(length) < 7):
                raise LookupError(f"topic {name} has the array length {length[:20]!r}")
            if len(label) > _MAX_LABEL:
                raise LookupError(f"topic {name} has a field of {len(label)} letters (limit {_MAX_LABEL})")
            inner = [("", _CODES[kind])] if kind in _CODES else self._flatten(kind, depth - 1)
            count = int(length[:-1]) if length else 1
            self._count(name, count * len(inner))
            labels = [f"{label}[{i}]" for i in range(count)] if length else [label]
            dot = "" if kind in _CODES else "."
            flat += [(f"{one}{dot}{nested}", code) for one in labels for nested, code in inner]
        if not flat:
            raise LookupError(f"topic {name} has no fields")
        return flat

    def _count(self, name: str, fields: int) -> None:
        """Count work before it is done: a small file can define, and nest, fields without number."""
        self._left -= fields
        if self._left < 0:
            raise LookupError(f"topic {name} and those before have more than {MAX_FIELDS} fields")
