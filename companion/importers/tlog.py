"""Telemetry log reader (`.tlog`): entries of 8 bytes of UNIX microseconds, big endian, and a MAVLink frame.

Written by ground stations (MAVProxy, QGroundControl, Mission Planner, DroneKit). Frames damaged on the radio,
frames of unknown messages and a truncated end are counted and skipped. Messages are not interpreted.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

from companion.link import frame
from companion.link.dialect import TYPES
from companion.link.frame import Frame

_STAMP = 8
_MAGIC = re.compile(b"[\xfd\xfe]")
_EARLIEST_US, _LATEST_US = 946_684_800_000_000, 4_102_444_800_000_000  # 2000, 2100
_APART_US = 86_400_000_000  # neighbours a day apart: one stamp is damaged


class TlogEntry(NamedTuple):
    """A frame with a valid checksum, and its time of reception in nanoseconds of UNIX time."""

    rx_ns: int
    frame: Frame


class Tlog:
    """A tlog, read sequentially; the counts are updated during the iteration.

    `messages` counts valid entries, `corrupt` damaged entries and runs of other bytes, `unknown` frames of
    messages that are not in the dialect, `torn` the bytes of a truncated entry at the end.
    """

    def __init__(self, data: bytes) -> None:
        self.data = data
        self.messages = self.corrupt = self.unknown = self.torn = 0
        self._last_us = 0

    def __iter__(self) -> Iterator[TlogEntry]:
        """Yield entries in order; their times never decrease, even if the writer's clock did."""
        data, at = self.data, 0
        while at < len(data):
            found = frame.parse(data, at + _STAMP) if self._has_time_stamp(at) else frame.Reason.JUNK
            if isinstance(found, Frame):
                self._last_us = max(self._last_us, self._us(at))
                self.messages += 1
                yield TlogEntry(self._last_us * 1000, found)
                at += _STAMP + len(found.raw)
            else:
                at = self._skip(at)

    def _us(self, at: int) -> int:
        return int.from_bytes(self.data[at : at + _STAMP], "big")

    def _has_time_stamp(self, at: int) -> bool:
        """Return whether a plausible time stamp is at `at`."""
        stamp = self._us(at)
        if self._last_us:
            return abs(stamp - self._last_us) < _APART_US
        return _EARLIEST_US < stamp < _LATEST_US

    def _skip(self, at: int) -> int:
        """Count the bytes at `at` as corrupt, unknown or torn, and return the offset of the next entry."""
        if (size := self._stated_length(at)) is not None:
            if _msgid(self.data, at + _STAMP) in TYPES:
                self.corrupt += 1
            else:
                self.unknown += 1
            return at + size
        for magic in _MAGIC.finditer(self.data, at + _STAMP + 1):
            begin = magic.start() - _STAMP
            if self._has_time_stamp(begin) and isinstance(frame.parse(self.data, begin + _STAMP), Frame):
                self.corrupt += 1
                return begin
        left = len(self.data) - at
        starts = self._has_time_stamp(at) and self.data[at + _STAMP : at + _STAMP + 1] in (
            b"",
            b"\xfd",
            b"\xfe",
        )
        if left < _STAMP or (starts and left < _STAMP + frame.MAX_FRAME_SIZE):
            self.torn = left
        else:
            self.corrupt += 1
        return len(self.data)

    def _stated_length(self, at: int) -> int | None:
        """Return the length of the entry at `at` by its header, if the next entry or the end follows it."""
        head = at + _STAMP
        size = _frame_size(self.data, head)
        if size is None or not self._has_time_stamp(at):
            return None
        following = head + size
        if following == len(self.data):
            return _STAMP + size
        follows = self.data[following + _STAMP : following + _STAMP + 1] in (b"\xfd", b"\xfe")
        return _STAMP + size if follows and self._has_time_stamp(following) else None


def read(path: Path) -> Tlog:
    """Open a tlog. Raises ValueError if the file is empty or not a tlog, OSError as `open` does."""
    data = path.read_bytes()
    if not data:
        raise ValueError(f"{path} is empty: nothing was recorded")
    if next(iter(Tlog(data)), None) is None:
        raise ValueError(f"{path} is not a tlog: it contains no MAVLink frame after a time stamp")
    return Tlog(data)


def _frame_size(data: bytes, head: int) -> int | None:
    """Return the length of the frame at `head` by its header, None if no frame starts there."""
    if len(data) < head + 8:
        return None
    if data[head] == frame.MAGIC_V1:
        return data[head + 1] + 8
    if data[head] == frame.MAGIC_V2 and data[head + 2] <= frame.SIGNED:
        return data[head + 1] + 12 + frame.SIGNATURE_SIZE * data[head + 2]
    return None


def _msgid(data: bytes, head: int) -> int:
    if data[head] == frame.MAGIC_V1:
        return data[head + 5]
    return int.from_bytes(data[head + 7 : head + 10], "little")
