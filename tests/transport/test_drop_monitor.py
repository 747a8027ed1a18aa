"""Drop monitor: reports the beginning and the end of a period of drops, and nothing in between."""

from companion.transport.address import Address
from companion.transport.drop_monitor import QUIET_S, DropMonitor

SERIAL = Address.parse("serial:/dev/ttyS0:57600")


def test_begin_and_end_of_drops_are_reported_once_each() -> None:
    monitor = DropMonitor(SERIAL)
    reports = [monitor.update(dropped, t) for t, dropped in enumerate([0, 0, 3, 9, 9, 20])]
    assert [text for text in reports if text] == [
        "serial:/dev/ttyS0:57600: the line is too slow, frames that wait longer than 0.5 s are dropped: "
        "lower the rates or raise the baud rate"
    ]
    assert reports[2] and monitor.is_dropping
    assert monitor.update(20, 5 + QUIET_S - 1) is None
    over = "serial:/dev/ttyS0:57600: the line is fast enough again; 20 frames were dropped"
    assert monitor.update(20, 5 + QUIET_S) == over
    assert not monitor.is_dropping and monitor.update(20, 100.0) is None


def test_occasional_drops_are_reported_once() -> None:
    monitor = DropMonitor(SERIAL)
    reports = [monitor.update(1 + t // 7, float(t)) for t in range(3600)]
    assert sum(text is not None for text in reports) == 1


def test_next_period_of_drops_is_counted_from_zero() -> None:
    monitor = DropMonitor(Address.parse("tcpin:5760"))
    monitor.update(5, 0.0)
    assert "; 5 frames" in (monitor.update(5, 20.0) or "")
    assert "baud" not in (monitor.update(7, 30.0) or "baud")
    assert "; 2 frames" in (monitor.update(7, 50.0) or "")
