"""A telemetry log (`.tlog`) entry by entry: 8 bytes of UNIX microseconds, big endian, before each frame.

What ground stations write (MAVProxy, QGroundControl, Mission Planner, DroneKit). Such a file may hold frames
damaged on the radio, frames of unknown messages, and a torn end; none of them stops the reading, each is
counted. It knows frames, and nothing of what a message means or whose it is.
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
_APART_US = 86_400_000_000  # no two neighbours are a day apart unless one stamp is damaged


class Entry(NamedTuple):
    """A frame with a right checksum, and when the writer received it, nanoseconds of UNIX time."""

    rx_ns: int
    frame: Frame


class Tlog:
    """A tlog read once, front to back; the counts grow as it is iterated.

    `messages` are the entries given, `corrupt` the chunks that are no frame (a damaged entry, or a run of
    bytes between entries), `unknown` the frames of messages that no dialect here knows, `torn` the bytes of
    an unfinished entry at the end.
    """

    def __init__(self, data: bytes) -> None:
        self.data = data
        self.messages = self.corrupt = self.unknown = self.torn = 0
        self._last_us = 0

    def __iter__(self) -> Iterator[Entry]:
        """Entries in order; their times never go back (the writer's clock may)."""
        data, at = self.data, 0
        while at < len(data):
            found = frame.examine(data, at + _STAMP) if self._stamped(at) else frame.Reason.JUNK
            if isinstance(found, Frame):
                self._last_us = max(self._last_us, self._us(at))
                self.messages += 1
                yield Entry(self._last_us * 1000, found)
                at += _STAMP + len(found.raw)
            else:
                at = self._skip(at)

    def _us(self, at: int) -> int:
        return int.from_bytes(self.data[at : at + _STAMP], "big")

    def _stamped(self, at: int) -> bool:
        """Whether a believable time stands at `at`."""
        stamp = self._us(at)
        if self._last_us:
            return abs(stamp - self._last_us) < _APART_US
        return _EARLIEST_US < stamp < _LATEST_US

    def _skip(self, at: int) -> int:
        """Count what stands at `at` and return where the next entry begins."""
        if (size := self._claimed(at)) is not None:
            if _msgid(self.data, at + _STAMP) in TYPES:
                self.corrupt += 1
            else:
                self.unknown += 1
            return at + size
        for magic in _MAGIC.finditer(self.data, at + _STAMP + 1):
            begin = magic.start() - _STAMP
            if self._stamped(begin) and isinstance(frame.examine(self.data, begin + _STAMP), Frame):
                self.corrupt += 1
                return begin
        left = len(self.data) - at
        begun = self._stamped(at) and self.data[at + _STAMP : at + _STAMP + 1] in (b"", b"\xfd", b"\xfe")
        if left < _STAMP or (begun and left < _STAMP + frame.LONGEST):
            self.torn = left
        else:
            self.corrupt += 1
        return len(self.data)

    def _claimed(self, at: int) -> int | None:
        """The length of the entry at `at` as its own header claims, if the next entry stands right after it
        or the file ends there; else None."""
        head = at + _STAMP
        size = _frame_size(self.data, head)
        if size is None or not self._stamped(at):
            return None
        following = head + size
        if following == len(self.data):
            return _STAMP + size
        begins = self.data[following + _STAMP : following + _STAMP + 1] in (b"\xfd", b"\xfe")
        return _STAMP + size if begins and self._stamped(following) else None


def read(path: Path) -> Tlog:
    """Open a tlog. ValueError if the file is empty or its beginning is no tlog's; OSError as by `open`."""
    data = path.read_bytes()
    if not data:
        raise ValueError(f"{path} is empty: nothing was recorded")
    if next(iter(Tlog(data)), None) is None:
        raise ValueError(f"{path} is no tlog: it holds no MAVLink frame behind a time stamp")
    return Tlog(data)


def _frame_size(data: bytes, head: int) -> int | None:
    """The whole length of the frame that claims to begin at `head`."""
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
