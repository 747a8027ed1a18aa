"""Replayed outputs compared with the flight's: exactly on the same platform, within a tolerance elsewhere."""

from __future__ import annotations

import math

from msgspec import structs

from companion.analysis.comparison import POSITION_M, OutputComparison
from companion.estimate.predictor import RESTRICTED_TOLERANCE
from companion.records import Event, Prediction, Rejection, Solution
from tests.solutions import solution_at

SOLUTION = solution_at(1, rx_ns=2, v_n=(20.0, -3.0, 0.1), error_n=(1.0, 2.0))
METRE = 1.0 / 6.4e6


def compare(exact: bool, now: object, then: object = SOLUTION) -> OutputComparison:
    comparison = OutputComparison(exact)
    comparison.add([then], [now])  # type: ignore[list-item]
    return comparison


def test_the_last_bit_counts_on_the_same_platform_only() -> None:
    nearly = structs.replace(SOLUTION, lat=math.nextafter(1.0, 2.0), error_n=(math.nextafter(1.0, 2.0), 2.0))
    assert compare(True, nearly).different == 1
    assert compare(False, nearly).different == 0
    assert compare(True, SOLUTION).different == 0


def test_the_distance_is_in_metres_and_limited() -> None:
    away = structs.replace(SOLUTION, lat=1.0 + 5.0 * METRE)
    found = compare(False, away)
    assert found.different == 1
    assert abs(found.apart_m - 5.0) < 0.05
    assert compare(False, structs.replace(SOLUTION, lat=1.0 + 0.5 * POSITION_M * METRE)).different == 0


def test_other_kinds_missing_outputs_and_numbers_differ_elsewhere_too() -> None:
    assert compare(False, Event(1, 2, 6, "x")).different == 1
    assert compare(False, structs.replace(SOLUTION, v_n=(20.1, -3.0, 0.1))).different == 1
    missing = OutputComparison(False)
    missing.add([SOLUTION], [])
    assert (missing.compared, missing.different) == (1, 1)


def test_what_is_in_a_bound_agrees_as_the_bound_does() -> None:
    def with_claim(m: float) -> Solution:
        return structs.replace(SOLUTION, ahead=(Prediction(60.0, (100.0, 100.0), (m, m), (1.0, 1.0)),))

    off = 1.0 + 0.5 * RESTRICTED_TOLERANCE
    assert compare(False, with_claim(50.0 * off), with_claim(50.0)).different == 0
    assert compare(False, with_claim(50.0 * off**4), with_claim(50.0)).different == 1


def test_a_text_may_round_its_number_differently_but_say_nothing_else() -> None:
    then = Rejection(1, 2, "Gnss", "too far: 163 m")
    assert compare(False, Rejection(1, 2, "Gnss", "too far: 164 m"), then).different == 0
    assert compare(False, Rejection(1, 2, "Gnss", "too late: 163 m"), then).different == 1


def test_the_first_difference_is_shortened() -> None:
    found = compare(True, structs.replace(SOLUTION, lat=1.1))
    assert found.first is not None
    assert len(found.first) < 320


def test_the_first_difference_is_shown_with_both_values() -> None:
    """Of a Solution 300 characters are not even all of the one in flight."""
    found = compare(True, structs.replace(SOLUTION, protection=41.5, horizon_s=2.0))
    apart = "horizon_s in flight 0.0, now 2.0; protection in flight None, now 41.5"
    assert found.first == f"Solution, t_ns 1: {apart}"
    text = "inertial channel: own, by what arrives of imu, air data; no guaranteed bound by "
    found = compare(True, Event(1, 2, 6, f"{text}IMU"), Event(1, 2, 6, f"{text}imu"))
    assert found.first is not None and f"{text}imu" in found.first and f"{text}IMU" in found.first
    missing = OutputComparison(True)
    missing.add([SOLUTION], [])
    assert missing.first is not None and missing.first.endswith(", now None") and len(missing.first) < 320
