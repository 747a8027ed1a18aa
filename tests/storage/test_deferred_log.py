"""What is kept for later reaches the log whole and in order, and nothing is held twice."""

from __future__ import annotations

from companion.records import Event, Stamped
from companion.storage.deferred_log import Deferred


class _Log:
    def __init__(self) -> None:
        self.written: list[object] = []

    def record(self, record: Stamped, channel: str | None = None) -> None:
        self.written.append((record, channel))

    def frame(self, link: str, outgoing: bool, data: bytes, t_ns: int) -> None:
        self.written.append((link, outgoing, data, t_ns))


def test_the_log_has_all_in_order_once_settled() -> None:
    log = _Log()
    deferred = Deferred(log)
    events = [Event(k, k, 6, str(k)) for k in range(3)]
    deferred.record(events[0])
    deferred.frame("main", True, b"x", 1)
    deferred.record(events[1], "/link/Event")
    assert log.written == []
    deferred.settle()
    assert log.written == [(events[0], None), ("main", True, b"x", 1), (events[1], "/link/Event")]
    deferred.record(events[2])
    deferred.settle()
    deferred.settle()
    assert log.written[3:] == [(events[2], None)]
