"""Own position of the autopilot far from ours: when it is reported, and when not."""

from __future__ import annotations

import math

import pytest

from companion.nav.geometry import Geodetic, displace
from companion.output.gate import Position
from companion.output.own_position_monitor import MOST_M, MOST_SIGMAS, OwnPositionMonitor
from companion.records import Severity
from companion.units import SECOND_NS

LAT, LON = math.radians(60.0), math.radians(30.0)
START = 5000 * SECOND_NS


class Compared:
    """A monitor that compares 5 times a second, and its reports."""

    def __init__(self) -> None:
        self.monitor, self.now_ns = OwnPositionMonitor(), START
        self.reports: list[tuple[float, int, str]] = []

    def fly(self, seconds: float, off_m: float | None, sigma: float = 2.0) -> None:
        own = None if off_m is None else displace(LAT, LON, 500.0, 0.0, off_m, 0.0)
        for _ in range(round(5.0 * seconds)):
            self.now_ns += SECOND_NS // 5
            ours = Position(
                self.now_ns, LAT, LON, 500.0, (0.0, 0.0, 0.0), (sigma**2, 0.0, sigma**2), 9.0, True
            )
            where = None if own is None else Geodetic(*own)
            event = self.monitor.update(where, ours, lambda: "why", self.now_ns)
            if event is not None:
                self.reports.append(((self.now_ns - START) * 1e-9, event.severity, event.text))


@pytest.mark.parametrize("sigma", [2.0, 40.0])
def test_the_limit_is_the_greater_of_fifty_metres_and_five_sigma(sigma: float) -> None:
    flight, limit_m = Compared(), max(MOST_M, MOST_SIGMAS * sigma)
    flight.fly(60.0, 0.99 * limit_m, sigma)
    assert not flight.reports
    flight.fly(60.0, 1.01 * limit_m, sigma)
    ((at, severity, text),) = flight.reports
    assert at == pytest.approx(70.0) and severity == Severity.WARNING
    *head, off_m = text.removesuffix(f" m off ours (sigma {sigma:.0f} m): why").split(" ")
    assert head == ["autopilot's", "own", "position"]
    assert float(off_m) == pytest.approx(1.01 * limit_m, abs=1.0)


def test_it_is_near_again_within_half_of_the_limit() -> None:
    flight = Compared()
    for off_m in (110.0, 30.0, 110.0, 20.0):
        flight.fly(20.0, off_m)
    assert [(round(at), severity) for at, severity, _ in flight.reports] == [
        (10, Severity.WARNING),
        (70, Severity.NOTICE),
    ]
    assert flight.reports[1][2] == "autopilot's own position 20 m off ours again"


def test_nothing_is_concluded_across_a_gap_or_from_a_moment() -> None:
    """A filter that is reset to ours is there within seconds."""
    flight = Compared()
    for _ in range(10):
        flight.fly(9.0, 500.0)
        flight.fly(1.0, 5.0)
    for _ in range(10):
        flight.fly(9.0, 500.0)
        flight.fly(4.0, None)
    assert not flight.reports
