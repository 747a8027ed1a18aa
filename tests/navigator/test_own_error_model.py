"""The own channel on the ground and in flight."""

from __future__ import annotations

import pytest

from companion.navigator.own_error_model import CLEAR_M, Ground, ground_phase


def phases(*samples: tuple[float, float, float | None]) -> list[bool]:
    """Whether it flies after each (airspeed, ground speed, height), one second apart."""
    g, found = Ground(), []
    for t, (airspeed, speed, height) in enumerate(samples):
        g = ground_phase(g, float(t), airspeed, speed, height)
        found.append(g.flying)
    return found


def test_in_the_ground_roll_airspeed_is_not_used_until_the_wheels_are_off_the_ground() -> None:
    roll = [(0.5, 0.0, 100.0)] * 3 + [(15.0, 14.0, 100.5), (25.0, 24.0, 100.0 + CLEAR_M + 0.1)]
    assert phases(*roll) == [False, False, False, False, True]


def test_without_a_pressure_airspeed_alone_decides() -> None:
    """The flight of UMN has none: its airspeed was never used."""
    assert phases((0.5, 0.0, None), (3.0, 3.0, None), (15.0, 14.0, None)) == [False, False, True]


@pytest.mark.parametrize("seconds", [9, 11])
def test_a_flight_ends_after_ten_slow_seconds(seconds: int) -> None:
    assert phases((20.0, 20.0, None), *[(1.0, 1.0, None)] * (seconds + 1))[-1] == (seconds < 10)
