"""Deferred log: buffered records reach the log complete and in order."""

from __future__ import annotations

from companion.records import Event, Stamped
from companion.storage.deferred_log import DeferredLog


class _Log:
    def __init__(self) -> None:
        self.written: list[object] = []

    def record(self, record: Stamped, channel: str | None = None) -> None:
        self.written.append((record, channel))

    def frame(self, link: str, outgoing: bool, data: bytes, t_ns: int) -> None:
        self.written.append((link, outgoing, data, t_ns))


def test_flush_writes_everything_in_order_once() -> None:
    log = _Log()
    deferred = DeferredLog(log)
    events = [Event(k, k, 6, str(k)) for k in range(3)]
    deferred.record(events[0])
    deferred.frame("main", True, b"x", 1)
    deferred.record(events[1], "/link/Event")
    assert log.written == []
    deferred.flush()
    assert log.written == [(events[0], None), ("main", True, b"x", 1), (events[1], "/link/Event")]
    deferred.record(events[2])
    deferred.flush()
    deferred.flush()
    assert log.written[3:] == [(events[2], None)]
