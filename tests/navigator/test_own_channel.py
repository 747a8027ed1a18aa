"""Own channel: the mean of airspeed and heading, and the autopilot's velocity while it is not fed."""

from __future__ import annotations

import math
from typing import Any

import pytest

from companion.config import Config, load, to_toml
from companion.nav.geometry import Geodetic, separation
from companion.navigator import Navigator
from companion.navigator.own_channel import AirspeedSums
from companion.records import (
    Attitude,
    Gnss,
    Input,
    LocalPosition,
    Rejection,
    RsbnFix,
    Solution,
    Truth,
    Tuning,
)
from tests.recordings import recording

FED, UNFED = (
    load(flags={"output.profile": "ardupilot", "output.odometry_hz": rate}, environment={})
    for rate in (10.0, 0.0)
)


def sums_of(*headings_deg: float) -> AirspeedSums:
    sums = AirspeedSums(0)
    for heading in map(math.radians, headings_deg):
        sums = sums.with_one((0.0, 0.0), (22.0 * math.cos(heading), 22.0 * math.sin(heading)))
    return sums


def test_samples_of_a_turn_are_of_one_heading() -> None:
    assert sums_of(*(0.5 / 9 * k * 90.0 for k in range(10))).is_one_way  # 90 deg/s for half a second


@pytest.mark.parametrize("degrees", [45.0, 90.0, 180.0])
@pytest.mark.parametrize("before", [3, 5, 7])
def test_samples_before_and_behind_a_step_are_not(degrees: float, before: int) -> None:
    assert not sums_of(*before * [0.0], *(10 - before) * [degrees]).is_one_way


def flown(
    *switched: tuple[float, Config], lost_s: float = math.inf, kinds: Any = Input, copies: int = 1
) -> list[Solution]:
    """Solutions of a flight; each switch is the time (s) from which another configuration is in force."""
    navigator, found, waiting = Navigator(switched[0][1]), list[Solution](), list(switched)
    records = [r for r in recording("plane_take_off") if not isinstance(r, Truth) and isinstance(r, kinds)]
    for record in records:
        seconds = (record.rx_ns - records[0].rx_ns) * 1e-9
        if waiting and seconds >= waiting[0][0]:
            navigator.handle(Tuning(record.t_ns, record.rx_ns, to_toml(waiting.pop(0)[1])))
        if seconds < lost_s or not isinstance(record, Gnss | RsbnFix):
            outputs = [out for _ in range(copies) for out in navigator.handle(record)]
            assert not [out for out in outputs if isinstance(out, Rejection) and "computed" in out.reason]
            found += [out for out in outputs if isinstance(out, Solution)]
    return found


def apart_m(one: Solution, other: Solution) -> float:
    return math.hypot(*separation(Geodetic(one.lat, one.lon, 0.0), Geodetic(other.lat, other.lon, 0.0))[:2])


def test_a_feed_that_is_switched_off_and_on_keeps_the_estimate() -> None:
    """The velocity of the autopilot is used in between, its errors have states of their own."""
    plain = {out.t_ns: out for out in flown((0.0, FED))}
    switched = flown((0.0, FED), (40.0, UNFED), (60.0, FED))
    assert switched[-1].t_ns == max(plain)
    both = [(out, plain[out.t_ns]) for out in switched if out.t_ns in plain]
    assert max(apart_m(out, other) / math.sqrt(other.covariance[0]) for out, other in both) < 1.0


def test_a_feed_that_is_switched_on_without_fixes_keeps_the_position() -> None:
    fed, plain = flown((0.0, UNFED), (60.0, FED), lost_s=55.0), flown((0.0, UNFED), lost_s=55.0)
    assert abs(fed[-1].t_ns - plain[-1].t_ns) < 1e9
    assert apart_m(fed[-1], plain[-1]) < 3.0 * math.sqrt(fed[-1].covariance[0])


def test_beyond_the_velocity_of_the_autopilot_the_last_one_is_held_with_its_error() -> None:
    """Nothing else moved the position; then it is fed, and attitudes alone arrive."""
    kinds = (Gnss, LocalPosition, Attitude)
    fed = flown((0.0, UNFED), (60.0, FED), lost_s=55.0, kinds=kinds)
    before = [out for out in fed if out.sigma_velocity < 2.0]
    assert fed[-1].t_ns - before[-1].t_ns > 5e9
    assert fed[-1].sigma_velocity > 4.0


def test_records_that_a_router_sends_twice_count_once() -> None:
    """The scatter of its samples is the noise of the IMU, and their rate shows whether it is fast enough."""
    once, twice = (flown((0.0, FED), lost_s=40.0, copies=copies) for copies in (1, 2))
    assert once == twice
