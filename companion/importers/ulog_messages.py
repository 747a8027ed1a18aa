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
_MAX_FIELDS, _MAX_DEPTH = 4096, 8


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


class _Subscription(NamedTuple):
    topic: str
    wanted: bool
    packed: struct.Struct  # without padding at the end, which may be missing
    longest: int
    fields: tuple[str, ...]


def messages(
    data: Buffer, topics: Collection[str], damage: Damage
) -> Iterator[TopicRow | LoggedText | Dropout]:
    """Yield rows of `topics`, texts and dropouts; unreadable parts go to `damage`.

    Raises ValueError if the file needs a newer reader.
    """
    formats: dict[str, str] = {}
    subscribed: dict[int, _Subscription] = {}
    appended: list[int] = []  # where data was appended to a log that may be torn there, descending
    at, end = _HEADER_SIZE, len(data)

    def size_at(place: int) -> int:
        """Return the size of the message at `place`, 0 if none begins there."""
        if place + 3 > end:
            return 0
        size, kind = _HEAD.unpack_from(data, place)
        if size < _SMALLEST.get(kind, 1 << 16) or place + 3 + size > end:
            return 0
        if kind == _DATA:
            found = subscribed.get(data[place + 3] | data[place + 4] << 8)
            if found is None or not found.packed.size + 2 <= size <= found.longest + 2:
                return 0
        elif kind == _SYNCHRONISATION and data[place + 3 : place + 11] != _SYNC:
            return 0
        return int(size) + 3

    def next_message(place: int) -> int:
        """Return where the next message begins that is followed by another or the end."""
        while place < end:
            size = size_at(place)
            if size and (place + size == end or size_at(place + size)):
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
        if not size or (at + size < end and not size_at(at + size)):
            following = next_message(at + 1)
            if not size or following < at + size:  # a message that lost bytes holds the next one
                damage.add(f"byte {at}", following - at, "not a message")
                at = following
                continue
        kind, body = data[at + 2], at + 3
        try:
            if kind == _DATA:
                found = subscribed[data[body] | data[body + 1] << 8]
                if found.wanted:
                    values = found.packed.unpack_from(data, body + 2)
                    yield TopicRow(at, found.topic, dict(zip(found.fields, values)))
            elif kind == _FORMAT:
                name, _, fields = data[body : at + size].decode("utf-8", "replace").partition(":")
                formats[name] = fields
            elif kind == _SUBSCRIPTION:
                name = data[body + 3 : at + size].decode("utf-8", "replace")
                number = data[body + 1] | data[body + 2] << 8
                subscribed[number] = _subscribe(name, formats, name in topics and data[body] == 0)
            elif kind in (_TEXT, _TAGGED):
                time_at = body + (1 if kind == _TEXT else 3)
                boot_us = int.from_bytes(data[time_at : time_at + 8], "little")
                text = data[time_at + 8 : at + size].decode("utf-8", "replace")
                yield LoggedText(at, boot_us, min(max(data[body] - ord("0"), 0), 7), text)
            elif kind == _DROPOUT:
                yield Dropout(at, data[body] | data[body + 1] << 8)
            elif kind == _FLAGS:
                appended = _appended_offsets(data[body : body + 40], end)
        except (KeyError, LookupError, struct.error) as error:
            damage.add(f"byte {at}", size, one_line(error))
        at += size


def _appended_offsets(flags: bytes, end: int) -> list[int]:
    if flags[8] & ~_DATA_APPENDED or any(flags[9:16]):
        raise ValueError("it needs a newer version of ULog (unknown incompatible flags)")
    offsets = struct.unpack_from("<3Q", flags, 16)
    return sorted((offset for offset in offsets if _HEADER_SIZE < offset < end), reverse=True)


def _subscribe(name: str, formats: dict[str, str], wanted: bool) -> _Subscription:
    """Return the layout of a topic. Raises LookupError if it is not defined, or larger than a message."""
    fields = list(_flatten(name, formats, "", _MAX_DEPTH))
    longest = struct.calcsize("<" + "".join(code for _, code in fields))
    if longest > 0xFFFF:
        raise LookupError(f"topic {name} has {longest} bytes (limit 65535)")
    while fields and fields[-1][0].startswith("_padding"):
        fields.pop()
    packed = struct.Struct("<" + "".join(code for _, code in fields))
    return _Subscription(name, wanted, packed, longest, tuple(name for name, _ in fields))


def _flatten(name: str, formats: dict[str, str], prefix: str, depth: int) -> Iterator[tuple[str, str]]:
    """Yield the fields of a topic with their struct codes, nested ones as PREFIX.NAME, arrays as NAME[0]."""
    if name not in formats or depth == 0:
        raise LookupError(f"topic {name} is not defined" if depth else f"topic {name} is nested too deeply")
    count = 0
    for field in formats[name].split(";"):
        if not field:
            continue
        kind, _, label = field.partition(" ")
        kind, _, length = kind.partition("[")
        if length and not (length[-1] == "]" and length[:-1].isdecimal() and len(length) < 7):
            raise LookupError(f"topic {name} has the array length {length[:20]!r}")
        labels = [f"{label}[{i}]" for i in range(int(length[:-1]))] if length else [label]
        for one in labels:
            inner = [(prefix + one, _CODES[kind])] if kind in _CODES else None
            for flat in inner or _flatten(kind, formats, f"{prefix}{one}.", depth - 1):
                yield flat
                count += 1
                if count > _MAX_FIELDS:
                    raise LookupError(f"topic {name} has more than {_MAX_FIELDS} fields")
