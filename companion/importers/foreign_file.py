"""Boundary of foreign files: plausible records or one LogError, whatever a file holds.

    data = map_file(path)                                # LogError if missing, empty or too large
    for record in usable(path, records, damage): ...     # LogError if nothing could be read

A reader adds each part that it cannot read to a `Damage`; `usable` reports them once, in an event at the end.
Records with a number that is not finite or physically impossible become a `Rejection`, as in flight.
"""

from __future__ import annotations

import heapq
import math
import mmap
import struct
import zipfile
import zlib
from collections import deque
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

from companion.plausibility import implausible_field
from companion.printable import printable
from companion.records import Event, Severity, Stamped
from companion.storage.reader import LogError, open_regular
from companion.units import SECOND_NS

MAX_BYTES = 1 << 36
MAX_TEXT = 1000  # characters of a text of the log
MAX_STEP_US = 60_000_000
"""A longer step of a log's clock is confirmed by the next stamp, or the stamp is damaged."""
MAX_BACK_US = 1_000_000  # a larger decrease of the boot time is a reboot
MAX_BOOT_US = 10**13  # 115 days
MAX_UNSTAMPED = 100_000  # messages in a row without a time
ORDER_NS = 2 * SECOND_NS  # loggers write topics out of order by less

_OF_A_FILE = (ValueError, OSError, EOFError, struct.error, zipfile.BadZipFile, zlib.error)
"""What readers raise for damaged content; the texts need no type."""

T = TypeVar("T")


class Damage:
    """Parts of a file that were not read: number, total size in bytes, place and reason of the first.

    `whole` is the reason if nothing of the file is of use.
    """

    def __init__(self) -> None:
        self.parts = self.size = 0
        self.first = self.whole = ""

    def add(self, place: str, size: int, reason: str) -> None:
        """Add a part of `size` bytes at `place`."""
        self.parts += 1
        self.size += size
        self.first = self.first or f"{place}: {reason}"

    def __str__(self) -> str:
        """Describe all parts in one sentence."""
        if self.parts == 1:
            return f"1 part of {self.size} bytes was not read: {self.first}"
        return f"{self.parts} parts of {self.size} bytes in total were not read, the first at {self.first}"


def map_file(path: Path, limit: int = MAX_BYTES) -> mmap.mmap:
    """Map a file into memory, read-only.

    Raises LogError if it is missing, empty, no regular file, or larger than `limit` bytes.
    """
    try:
        with open_regular(path) as file:
            size = file.seek(0, 2)
            if not size:
                raise LogError(f"{path} is empty: nothing was recorded")
            if size > limit:
                raise LogError(f"{path} has {size} bytes (limit {limit})")
            return mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)
    except LogError:
        raise
    except FileNotFoundError:
        raise LogError(f"{path}: no such log") from None
    except (OSError, ValueError) as error:
        raise LogError(f"{path} cannot be read: {getattr(error, 'strerror', None) or error}") from None


def usable(path: Path, records: Iterable[Stamped], damage: Damage) -> Iterator[Stamped]:
    """Yield the plausible records; an implausible one becomes a Rejection, all damage one event at the end.

    An exception of the reader ends the log at that place. Raises LogError, one sentence, if nothing could be
    read.
    """
    last_ns, found = 0, False
    try:
        for record in records:
            if (fault := implausible_field(record)) is None:
                found, last_ns = True, record.rx_ns
                yield record
            elif fault.name not in ("t_ns", "rx_ns"):
                yield fault.rejection(record)
            else:
                damage.add(type(record).__name__, 0, fault.reason)
    except LogError:
        raise
    except Exception as error:  # the last guard: no content of a file ends the program
        damage.add("the rest of the file", 0, one_line(error))
    if not found:
        why = damage.whole or damage.first or "it contains no supported message"
        raise LogError(f"{path}: nothing could be read: {why}")
    if damage.parts:
        text = printable(f"{path.name} is damaged: {damage}")[:MAX_TEXT]
        yield Event(last_ns, last_ns, Severity.WARNING, text)


def one_line(error: Exception) -> str:
    """Describe an exception on one line: what a file lacks, or the text; the type of an unexpected one."""
    text = " ".join(str(error).split())[:200]
    if isinstance(error, AttributeError) and error.name:
        return f"no column {error.name}"
    if isinstance(error, KeyError):
        return f"{text} is missing"
    if text and isinstance(error, _OF_A_FILE):
        return text
    return f"{type(error).__name__}: {text}" if text else type(error).__name__


def finite(value: float | None) -> float | None:
    """Return the value, None if it is no finite number."""
    return value if value is not None and math.isfinite(value) else None


class Step(NamedTuple):
    """An item of a log with its boot time (us) and the time to add because of reboots before it."""

    boot_us: int
    shift_us: int
    reboot: bool
    item: Any


def steady_steps(stamped: Iterable[tuple[int | None, int, Any]], damage: Damage) -> Iterator[Step]:
    """Yield the items of a log in order, on a time that continues over reboots.

    `stamped` has boot time (us; None if an item has none), place in the file, item. A stamp that leaves the
    last one by more than `MAX_STEP_US`, or decreases, has to be confirmed by the next; else it is damage. A
    confirmed decrease is a reboot: the time goes on, as the duration of the reboot is not known. An item
    without a stamp has the time of the item before it, or of the first one that has a stamp. After
    `MAX_UNSTAMPED` in a row the log ends: its time is not known.
    """
    waiting = deque[tuple[int, Any]]()  # number and item of those without a stamp

    def with_stamps() -> Iterator[tuple[int, int, tuple[int, Any]]]:
        for number, (us, place, item) in enumerate(stamped):
            if us is not None:
                yield us, place, (number, item)
            elif len(waiting) < MAX_UNSTAMPED:
                waiting.append((number, item))
            else:
                damage.add(f"byte {place}", 0, f"{MAX_UNSTAMPED} messages before have no time since boot")
                return

    last: Step | None = None
    for step in _steady_stamps(with_stamps(), damage):
        number, item = step.item
        while waiting and waiting[0][0] < number:
            yield (last or step)._replace(reboot=False, item=waiting.popleft()[1])
        last = step._replace(item=item)
        yield last
    if last is not None:
        yield from (last._replace(reboot=False, item=item) for _, item in waiting)
    elif waiting:
        damage.whole = f"none of its {len(waiting)} messages has a time since boot"


def _steady_stamps(stamped: Iterable[tuple[int, int, Any]], damage: Damage) -> Iterator[Step]:
    """Yield the items of `steady_steps` that have a stamp."""
    last: int | None = None
    doubtful: tuple[int, int, Any] | None = None
    shift = 0
    for us, place, item in stamped:
        if not 0 <= us <= MAX_BOOT_US:
            damage.add(f"byte {place}", 0, f"boot time of {us} us")
            continue
        if last is None or not -MAX_BACK_US <= us - last <= MAX_STEP_US:
            if doubtful is None or not -MAX_BACK_US <= us - doubtful[0] <= MAX_STEP_US:
                if doubtful is not None:
                    damage.add(f"byte {doubtful[1]}", 0, f"boot time of {doubtful[0]} us does not continue")
                doubtful = us, place, item
                continue
            reboot = last is not None and doubtful[0] < last
            shift += (last or 0) - doubtful[0] if reboot else 0
            yield Step(doubtful[0], shift, reboot, doubtful[2])
            last, doubtful = doubtful[0], None
        elif doubtful is not None:
            damage.add(f"byte {doubtful[1]}", 0, f"boot time of {doubtful[0]} us does not continue")
            doubtful = None
        last = max(us, last)
        yield Step(us, shift, False, item)
    if doubtful is not None:
        if last is None:
            yield Step(doubtful[0], shift, False, doubtful[2])
        else:
            damage.add(f"byte {doubtful[1]}", 0, f"boot time of {doubtful[0]} us does not continue")


def in_order(records: Iterable[Stamped]) -> Iterator[Stamped]:
    """Yield records by time of arrival; the log has them in order but for `ORDER_NS`."""
    waiting: list[tuple[int, int, Stamped]] = []
    newest = 0
    for number, record in enumerate(records):
        newest = max(newest, record.rx_ns)
        heapq.heappush(waiting, (record.rx_ns, number, record))
        while waiting[0][0] < newest - ORDER_NS:
            yield heapq.heappop(waiting)[2]
    while waiting:
        yield heapq.heappop(waiting)[2]
