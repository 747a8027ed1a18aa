"""Deferred log: buffers records and frames while a solution is computed, writes them afterwards in order.

    deferred.record(record); deferred.frame(...)    # append to a list
    deferred.flush()                                # encode and write everything

Encoding for the log would take a tenth of the latency from a beacon measurement to the corrected estimate.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Protocol

from companion.records import Stamped


class Log(Protocol):
    """Sink of records and raw frames, such as `companion.storage.flight_log.Writer`."""

    def record(self, record: Stamped, channel: str | None = None) -> None:
        """Write one record, to the topic of its type unless `channel` is given."""

    def frame(self, link: str, outgoing: bool, data: bytes, t_ns: int) -> None:
        """Write one frame."""


class NoLog:
    """A `Log` that writes nothing."""

    def record(self, record: Stamped, channel: str | None = None) -> None:
        """Ignore one record."""

    def frame(self, link: str, outgoing: bool, data: bytes, t_ns: int) -> None:
        """Ignore one frame."""


class DeferredLog:
    """A `Log` that buffers in front of another one."""

    def __init__(self, log: Log) -> None:
        self._log = log
        self._pending: list[Callable[[], None]] = []

    def record(self, record: Stamped, channel: str | None = None) -> None:
        """Buffer one record."""
        self._pending.append(partial(self._log.record, record, channel))

    def frame(self, link: str, outgoing: bool, data: bytes, t_ns: int) -> None:
        """Buffer one frame."""
        self._pending.append(partial(self._log.frame, link, outgoing, data, t_ns))

    def flush(self) -> None:
        """Write everything buffered to the log."""
        pending, self._pending = self._pending, []
        for write in pending:
            write()
