"""The position of an autopilot is set only while it has no GPS, and no further than it may have drifted."""

import math

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from companion.nav.geometry import displace
from companion.output.gate import FREE_M, Position
from companion.output.position_reset import SECOND, Resetting
from companion.records import FilterStatus, GlobalPosition, Gnss

LAT, LON = 1.0, 0.5
START = 10**12


def position(seconds: float, north: float = 0.0, sigma: float = 20.0) -> Position:
    """Ours, `north` of where the autopilot stands."""
    lat, lon, alt = displace(LAT, LON, 500.0, north, 0.0, 0.0)
    t_ns = START + round(seconds * SECOND)
    return Position(t_ns, lat, lon, alt, (0.0, 0.0, 0.0), (sigma**2, 0.0, sigma**2), 9.0, True)


def gnss(seconds: float, fix: int, receiver: int = 0) -> Gnss:
    at = START + round(seconds * SECOND)
    return Gnss(at, at, receiver, 0, fix, LAT, LON, 500.0)


def own(seconds: float, v_north: float = 0.0) -> GlobalPosition:
    at = START + round(seconds * SECOND)
    return GlobalPosition(at, at, LAT, LON, 500.0, (v_north, 0.0, 0.0), 100.0)


def flown(lost_s: float = 0.0, until_s: float = 60.0) -> Resetting:
    """An autopilot whose GPS was lost at `lost_s`, heard until `until_s`."""
    resetting = Resetting()
    for tenth in range(-100, round(10 * until_s) + 1):
        t = 0.1 * tenth
        resetting.heard(gnss(t, 3 if t < lost_s else 1))
        resetting.heard(own(t))
    return resetting


def test_only_while_the_autopilot_has_no_gps() -> None:
    assert flown(lost_s=100.0).forbids(position(60.0)) == "the autopilot has GPS"
    assert flown(lost_s=59.0).forbids(position(60.0)) == "the autopilot has GPS"
    assert flown(lost_s=57.0).forbids(position(60.0)) is None


def test_a_receiver_that_fell_silent_is_one_that_is_lost() -> None:
    resetting = flown(lost_s=100.0)
    resetting.heard(own(63.0))
    assert resetting.forbids(position(63.0)) is None


def test_a_fix_that_the_autopilot_rejects_is_none() -> None:
    resetting = flown(lost_s=0.0)
    resetting.heard(FilterStatus(START, START, 32768, True, 2.0))
    resetting.heard(gnss(60.0, 3))
    assert resetting.forbids(position(60.0)) is None
    resetting.heard(FilterStatus(START, START, 831, False, 0.1))
    resetting.heard(gnss(60.0, 3))
    assert resetting.forbids(position(60.0)) == "the autopilot has GPS"


def test_what_we_feed_as_the_second_receiver_is_not_its_gps() -> None:
    resetting = flown(lost_s=0.0)
    resetting.heard(gnss(60.0, 3, receiver=1))
    assert resetting.forbids(position(60.0)) is None


def test_unheard_is_not_known() -> None:
    resetting = Resetting()
    resetting.heard(own(0.0))
    assert "never heard" in str(resetting.forbids(position(60.0)))
    resetting.heard(gnss(0.0, 1))
    assert "own position is not heard" in str(resetting.forbids(position(60.0)))


@pytest.mark.parametrize("seconds", [5.0, 60.0, 180.0])
def test_no_further_than_a_wrong_wind_explains(seconds: float) -> None:
    resetting = flown(until_s=seconds)
    room = 3.0 * 20.0 + 20.0 * (seconds + 0.1) + FREE_M
    assert resetting.forbids(position(seconds, north=0.99 * room)) is None
    assert "further" in str(resetting.forbids(position(seconds, north=1.01 * room)))


def test_the_drift_that_was_measured_is_let_back_and_500_km_never() -> None:
    """1266 m in three minutes after the wind changed by 7 m/s; ArduPilot accepted 500 km."""
    resetting = flown(until_s=180.0)
    assert resetting.forbids(position(180.0, north=1266.0)) is None
    assert "further" in str(resetting.forbids(position(180.0, north=500_000.0)))


def test_after_one_was_taken_the_next_must_be_near() -> None:
    resetting = flown(until_s=180.0)
    event = resetting.acknowledged(0, START + 180 * SECOND)
    assert event is not None and event.text == "external position accepted"
    for tenth in range(1, 31):
        resetting.heard(own(180.0 + 0.1 * tenth))
    assert resetting.forbids(position(183.0, north=100.0)) is None
    assert "further" in str(resetting.forbids(position(183.0, north=150.0)))


def test_at_one_a_second_it_goes_on_after_it_was_taken() -> None:
    """Its own position is sure again by ours, but not by GPS."""
    resetting = flown(until_s=180.0)
    resetting.acknowledged(0, START + 180 * SECOND)
    resetting.heard(own(181.0))
    assert resetting.forbids(position(181.0)) is None


def test_an_answer_is_told_when_it_changes() -> None:
    resetting = flown()
    answers = [4, 4, 4, 0, 0, 2, 2, 3, 8]
    told = [e.text for answer in answers if (e := resetting.acknowledged(answer, START)) is not None]
    assert told == [
        "external position failed",
        "external position accepted",
        "external position denied",
        "external position unsupported",
        "external position MAV_RESULT 8",
    ]


def test_its_own_position_is_carried_to_the_time_of_ours() -> None:
    resetting = flown(until_s=3.0)
    resetting.heard(own(3.0, v_north=100.0))
    assert resetting.forbids(position(4.9, north=190.0, sigma=1.0)) is None


@settings(deadline=None, max_examples=200)
@given(
    lost=st.floats(-9.0, 9.0),
    now=st.floats(0.0, 10.0),
    north=st.floats(-1e6, 1e6),
    sigma=st.floats(0.1, 100.0),
)
def test_whatever_goes_out_is_near_and_without_gps(
    lost: float, now: float, north: float, sigma: float
) -> None:
    resetting = flown(lost_s=lost, until_s=math.floor(10.0 * now) / 10.0)
    if resetting.forbids(position(now, north, sigma)) is None:
        assert now - lost >= 1.9
        assert abs(north) <= 1.01 * (3.0 * sigma + 20.0 * (now - lost + 0.1) + FREE_M)
