"""A log that is written to once the answer is out: what is told of meanwhile is kept and handed on in order.

    deferred.record(record); deferred.frame(...)     # costs next to nothing
    deferred.settle()                                # the log has it all

Packing and encoding take a tenth of the time between a beacon's answer and the estimate that it causes.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Protocol

from companion.records import Stamped


class Log(Protocol):
    """Where records and raw frames go; `companion.storage.flight_log.Writer` is one."""

    def record(self, record: Stamped, channel: str | None = None) -> None:
        """Write one record, to the channel of its kind if no other is named."""

    def frame(self, link: str, outgoing: bool, data: bytes, t_ns: int) -> None:
        """Write one frame."""


class Deferred:
    """A `Log` before another."""

    def __init__(self, log: Log) -> None:
        self._log = log
        self._kept: list[Callable[[], None]] = []

    def record(self, record: Stamped, channel: str | None = None) -> None:
        """Keep one record."""
        self._kept.append(partial(self._log.record, record, channel))

    def frame(self, link: str, outgoing: bool, data: bytes, t_ns: int) -> None:
        """Keep one frame."""
        self._kept.append(partial(self._log.frame, link, outgoing, data, t_ns))

    def settle(self) -> None:
        """Hand all that is kept to the log."""
        kept, self._kept = self._kept, []
        for write in kept:
            write()
