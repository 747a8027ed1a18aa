"""Telemetry log reader (`.tlog`): entries of 8 bytes of UNIX microseconds, big endian, and a MAVLink frame.

Written by ground stations (MAVProxy, QGroundControl, Mission Planner, DroneKit). Frames damaged on the radio,
frames of unknown messages and a truncated end are counted and skipped. Messages are not interpreted.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

from companion.importers.foreign_file import MAX_BACK_US, MAX_STEP_US, map_file
from companion.link import frame
from companion.link.dialect import TYPES, mavlink
from companion.link.frame import Frame
from companion.link.session import STAMPED_WHEN_SENT
from companion.storage.reader import LogError

_STAMP = 8
_MAGIC = re.compile(b"[\xfd\xfe]")
_LATEST_US = 4_102_444_800_000_000  # 2100; a clock without a battery starts in 1970
_APART_US = 86_400_000_000  # neighbours a day apart: one stamp is damaged, or the clock was set
_BURST_US = 1000  # frames of one boot time keep their order, at most this far apart
_MAX_UNSTAMPED = 500  # frames without a boot time, after which the time of reception counts


class TlogEntry(NamedTuple):
    """A frame with a valid checksum, and its time of reception in nanoseconds of UNIX time."""

    rx_ns: int
    frame: Frame


class Tlog:
    """A tlog, read sequentially; the counts are updated during the iteration.

    `messages` counts valid entries, `corrupt` damaged entries and runs of other bytes, `unknown` frames of
    messages that are not in the dialect, `torn` the bytes of a truncated entry at the end. `corrupt_bytes` is
    the size of the damaged parts, `corrupt_at` the place of the first.
    """

    def __init__(self, data: Any) -> None:
        self.data = data  # bytes or mmap
        self.messages = self.corrupt = self.unknown = self.torn = self.corrupt_bytes = 0
        self.corrupt_at: int | None = None
        self._last_us = 0
        self._stamp_us: int | None = None  # of the last entry, as written
        self._shift_us = 0  # of the writer's clock, where it was set

    def __iter__(self) -> Iterator[TlogEntry]:
        """Yield entries in order; their times never decrease, and go on where the writer's clock was set."""
        data, at = self.data, 0
        while at < len(data):
            found = frame.parse(data, at + _STAMP) if self._has_time_stamp(at) else frame.Reason.JUNK
            if isinstance(found, Frame):
                stamp = self._us(at)
                if self._stamp_us is not None and not _near(stamp, self._stamp_us):
                    self._shift_us = self._last_us - stamp
                self._stamp_us, self._last_us = stamp, max(self._last_us, stamp + self._shift_us)
                self.messages += 1
                yield TlogEntry(self._last_us * 1000, found)
                at += _STAMP + len(found.raw)
            else:
                at = self._skip(at)

    def contains(self, msgid: int) -> bool:
        """Return whether an entry is message `msgid`; a log without any such frame is searched, not read."""
        v1, v2 = re.escape(bytes((msgid & 0xFF,))), re.escape(msgid.to_bytes(3, "little"))
        alike = re.compile(b"\xfd(?=.{6}%b)|\xfe(?=.{4}%b)" % (v2, v1), re.DOTALL).finditer(self.data)
        frames = (frame.parse(self.data, found.start()) for found in alike)
        return any(isinstance(one, Frame) and one.msgid == msgid for one in frames) and any(
            entry.frame.msgid == msgid for entry in Tlog(self.data)
        )

    def _us(self, at: int) -> int:
        return int.from_bytes(self.data[at : at + _STAMP], "big")

    def _has_time_stamp(self, at: int) -> bool:
        """Return whether a plausible time stamp is at `at`: near the last one, or confirmed by the next."""
        stamp = self._us(at)
        if self._stamp_us is None or _near(stamp, self._stamp_us):
            return stamp < _LATEST_US
        first = frame.parse(self.data, at + _STAMP)
        if not isinstance(first, Frame):
            return False
        following = at + _STAMP + len(first.raw)
        confirmed = stamp < _LATEST_US and _near(self._us(following), stamp)
        return confirmed and isinstance(frame.parse(self.data, following + _STAMP), Frame)

    def _skip(self, at: int) -> int:
        """Count the bytes at `at` as corrupt, unknown or torn, and return the offset of the next entry."""
        size = self._stated_length(at)
        end = len(self.data) if size is None else at + size
        # a valid entry before the stated end: the length is not that of an entry
        for magic in _MAGIC.finditer(self.data, at + _STAMP + 1, end):
            begin = magic.start() - _STAMP
            if self._has_time_stamp(begin) and isinstance(frame.parse(self.data, begin + _STAMP), Frame):
                self._count_corrupt(at, begin - at)
                return begin
        if size is not None:
            if _msgid(self.data, at + _STAMP) in TYPES:
                self._count_corrupt(at, size)
            else:
                self.unknown += 1
            return end
        left = len(self.data) - at
        starts = self._has_time_stamp(at) and self.data[at + _STAMP : at + _STAMP + 1] in (
            b"",
            b"\xfd",
            b"\xfe",
        )
        if left < _STAMP or (starts and left < _STAMP + frame.MAX_FRAME_SIZE):
            self.torn = left
        else:
            self._count_corrupt(at, left)
        return len(self.data)

    def _count_corrupt(self, at: int, size: int) -> None:
        self.corrupt += 1
        self.corrupt_bytes += size
        if self.corrupt_at is None:
            self.corrupt_at = at

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


def _near(stamp_us: int, other_us: int) -> bool:
    return abs(stamp_us - other_us) < _APART_US


class BootTimeBase:
    """Time base of one recording: the autopilot's boot time, continued over its reboots.

    A link that stalls delivers its backlog at once: the times of reception then differ from those of the
    flight. The time of reception counts before the first message that states a boot time, while a boot time
    is doubtful (a reboot), and after `_MAX_UNSTAMPED` frames without one.
    """

    def __init__(self) -> None:
        self.now_us = 0
        self.confirmed = False  # the boot time before the last one was not damaged
        self._rx_us = 0  # reception of the last frame
        self._shift_us: int | None = None
        self._boot_us = self._stamped_rx_us = 0  # of the last frame with a boot time
        self._doubtful_us: int | None = None
        self._unstamped = 0

    def update(self, rx_us: int, boot_us: int | None) -> int | None:
        """Return the time (ns) of a frame received at `rx_us`; `boot_us` if the autopilot states it.

        None if that boot time is ahead by more than `MAX_STEP_US`: the next one decides whether it is
        damaged, and `confirmed` states it. (Of one that is behind, a reboot, the session waits for a second.)
        """
        elapsed_us, self._rx_us = min(max(rx_us - self._rx_us, 0), MAX_STEP_US), rx_us
        if boot_us is not None and self._update_boot(rx_us, boot_us, elapsed_us):
            return self.now_us * 1000
        if self._shift_us is None:
            self.now_us = max(self.now_us, rx_us)
        else:
            self._unstamped += 1
            counts = self._doubtful_us is not None or self._unstamped > _MAX_UNSTAMPED
            self.now_us += elapsed_us if counts else min(max(elapsed_us, 1), _BURST_US)
        ahead = boot_us is not None and boot_us > self._boot_us
        return None if ahead else self.now_us * 1000

    def _update_boot(self, rx_us: int, boot_us: int, elapsed_us: int) -> bool:
        self.confirmed = False
        if self._shift_us is None:
            self.now_us = max(self.now_us, rx_us)
            self._shift_us = self.now_us - boot_us
        elif not _continues(boot_us, self._boot_us):
            if self._doubtful_us is None or not _continues(boot_us, self._doubtful_us):
                if self._doubtful_us is None:
                    self.now_us += max(rx_us - self._stamped_rx_us - elapsed_us, 0)
                self._doubtful_us = boot_us  # one damaged stamp: the next one decides
                return False
            self.confirmed = True
            if boot_us < self._boot_us:  # rebooted
                self._shift_us = self.now_us + elapsed_us - boot_us
        if self._unstamped > _MAX_UNSTAMPED:
            self._shift_us = max(self._shift_us, self.now_us - boot_us)
        self.now_us = max(self.now_us + min(max(elapsed_us, 1), _BURST_US), self._shift_us + boot_us)
        self._boot_us, self._stamped_rx_us, self._unstamped, self._doubtful_us = boot_us, rx_us, 0, None
        return True


def _continues(us: int, last_us: int) -> bool:
    return -MAX_BACK_US <= us - last_us <= MAX_STEP_US


def boot_time_us(found: Frame) -> int | None:
    """Return the time since boot at which a frame was sent, None if it does not state it."""
    if found.msgid not in STAMPED_WHEN_SENT:
        return None
    at = 8 if found.msgid == mavlink.MAVLINK_MSG_ID_SYSTEM_TIME else 0  # after time_unix_usec
    boot_ms = int.from_bytes(found.payload[at : at + 4], "little")
    return boot_ms * 1000 if boot_ms else None


def read(path: Path) -> Tlog:
    """Open a tlog. Raises LogError if it is empty, cannot be read or is not a tlog."""
    log = Tlog(map_file(path))
    if next(iter(log), None) is None:
        raise LogError(f"{path} is not a tlog: it contains no MAVLink frame after a time stamp")
    return Tlog(log.data)


def _frame_size(data: Any, head: int) -> int | None:
    """Return the length of the frame at `head` by its header, None if no frame starts there."""
    if len(data) < head + 8:
        return None
    if data[head] == frame.MAGIC_V1:
        return int(data[head + 1]) + 8
    if data[head] == frame.MAGIC_V2 and data[head + 2] <= frame.SIGNED:
        return int(data[head + 1]) + 12 + frame.SIGNATURE_SIZE * int(data[head + 2])
    return None


def _msgid(data: Any, head: int) -> int:
    if data[head] == frame.MAGIC_V1:
        return int(data[head + 5])
    return int.from_bytes(data[head + 7 : head + 10], "little")
