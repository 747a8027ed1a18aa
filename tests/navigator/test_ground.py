"""Phases of a flight: parked, ground roll, in the air."""

from __future__ import annotations

import math

import pytest

from companion.config import load
from companion.navigator import Navigator
from companion.navigator.ground import (
    CLEAR_M,
    SAME_WIND,
    SHEAR_M_S,
    SHEAR_TOP_M,
    Ground,
    ground_phase,
    lifted,
    wind_shear,
)
from companion.records import AirData, Attitude, Gnss, Pressure, Vehicle
from companion.units import SECOND_NS


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


def test_below_the_parked_height_it_flies_too() -> None:
    """Launched from a hill its airspeed was never used."""
    assert phases((0.5, 0.0, 100.0), (25.0, 24.0, 100.0 - CLEAR_M - 0.1))[-1]


def opened(g: Ground, heights: list[float]) -> float:
    """Variance of the wind's change over a flight by airspeed through these pressure altitudes."""
    total = 0.0
    for k, height in enumerate(heights):
        after = ground_phase(g, 0.1 * k, 25.0, 25.0, height)
        total, g = total + wind_shear(g, after), after
    return total


@pytest.mark.parametrize("step", [1.0, 300.0])
def test_the_wind_is_as_open_after_many_small_steps_of_height_as_after_one(step: float) -> None:
    climb = [100.0 + step * k for k in range(1, round(300.0 / step) + 1)]
    up = SHEAR_M_S**2 * math.log(SHEAR_TOP_M / CLEAR_M)
    assert opened(Ground(False, None, 100.0), climb) == pytest.approx(up, rel=1e-12)
    high = Ground(True, None, 100.0, SHEAR_TOP_M)
    down = SHEAR_M_S**2 * math.log(SHEAR_TOP_M / CLEAR_M / SAME_WIND)
    assert opened(high, [*reversed(climb), 100.0]) == pytest.approx(down, rel=1e-12)


def test_a_little_up_and_down_leaves_the_wind_as_it_is() -> None:
    level = Ground(True, None, 100.0, 80.0)
    assert opened(level, [180.0 - 80.0 * (1.0 - 1.0 / SAME_WIND), 180.0] * 50) == pytest.approx(
        0.0, abs=1e-12
    )
    assert opened(level, [140.0]) > 0.0
    assert wind_shear(level, lifted(level, 140.0)) == 0.0  # a multirotor works near the ground


def test_parked_after_a_landing_the_wind_is_as_it_was() -> None:
    level = Ground(
        True,
        None,
        100.0,
        80.0,
    )
    parked = ground_phase(level._replace(flying=False), 0.0, 0.0, 0.0, 100.0)
    assert not parked.flying
    assert wind_shear(level, parked) == 0.0


def test_without_a_pressure_it_flies_once_it_moves() -> None:
    """The flight of UMN has none: its airspeed was never used."""
    assert phases((0.5, 0.0, None), (3.0, 3.0, None), (15.0, 14.0, None)) == [False, False, True]


def test_a_pitot_behind_a_running_propeller_is_no_flight() -> None:
    """The wind was estimated as 20 m/s; the airspeed was false after lift-off, and later GNSS."""
    assert phases((21.0, 0.1, None), (21.0, 1.0, None), (18.0, 9.0, None)) == [False, False, True]


@pytest.mark.parametrize("seconds", [9, 11])
def test_a_flight_ends_after_ten_slow_seconds(seconds: int) -> None:
    assert phases((20.0, 20.0, None), *[(1.0, 1.0, None)] * (seconds + 1))[-1] == (seconds < 10)


@pytest.mark.parametrize("states", [True, False])
def test_a_vtol_that_hovers_is_not_parked(states: bool) -> None:
    """In a cruise at the height of the hover its airspeed was not used."""
    navigator = Navigator(load(flags={"output.profile": "ardupilot"}, environment={}))
    for k in range(600):
        t_ns, cruises = (k + 1) * SECOND_NS // 10, k >= 450
        static = 101_325.0 - (600.0 if k >= 150 else 0.0) - 1e-3 * k  # 50 m up
        speed = 20.0 if cruises else 0.0
        navigator.handle(Attitude(t_ns, t_ns, 0.0, 0.0, 1e-6 * k))
        if k % 5:
            continue
        if states:
            vehicle = Vehicle(t_ns, t_ns, fixed_wing=True, flying=k >= 150, hovering=not cruises)
            navigator.handle(vehicle)
        north = 0.1 * speed * max(k - 450, 0) / 6.4e6
        fix = Gnss(t_ns, t_ns, 0, t_ns // 1000, 3, 0.9 + north, 0.6, 100.0, 1.5, 3.0, v_n=(speed, 0.0, 0.0))
        for record in (Pressure(t_ns, t_ns, static), fix):
            navigator.handle(record)
        navigator.handle(AirData(t_ns, t_ns, speed + 1e-3 * math.sin(k), sensed=True))
    assert navigator.state.sensors.ground.flying == states
