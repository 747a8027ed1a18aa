"""Own channel: the mean of airspeed and heading over half a second."""

from __future__ import annotations

import math

import pytest

from companion.navigator.own_channel import AirspeedSums


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
