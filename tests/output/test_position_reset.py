"""Position reset: only while the autopilot has no GPS, and only within its possible drift."""

import math

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from companion.nav.geometry import displace
from companion.output.gate import JUMP_MARGIN_M, Position
from companion.output.position_reset import PositionReset
from companion.records import FilterStatus, GlobalPosition, Gnss
from companion.units import SECOND_NS

LAT, LON = 1.0, 0.5
START = 10**12


def position(seconds: float, north: float = 0.0, sigma: float = 20.0) -> Position:
    """Return our position, `north` metres from the autopilot's."""
    lat, lon, alt = displace(LAT, LON, 500.0, north, 0.0, 0.0)
    t_ns = START + round(seconds * SECOND_NS)
    return Position(t_ns, lat, lon, alt, (0.0, 0.0, 0.0), (sigma**2, 0.0, sigma**2), 9.0, True)


def gnss(seconds: float, fix: int, receiver: int = 0) -> Gnss:
    at = START + round(seconds * SECOND_NS)
    return Gnss(at, at, receiver, 0, fix, LAT, LON, 500.0)


def own(seconds: float, v_north: float = 0.0) -> GlobalPosition:
    at = START + round(seconds * SECOND_NS)
    return GlobalPosition(at, at, LAT, LON, 500.0, (v_north, 0.0, 0.0), 100.0)


def flown(lost_s: float = 0.0, until_s: float = 60.0) -> PositionReset:
    """Return the state after an autopilot lost GPS at `lost_s` and sent messages until `until_s`."""
    reset = PositionReset()
    for tenth in range(-100, round(10 * until_s) + 1):
        t = 0.1 * tenth
        reset.receive(gnss(t, 3 if t < lost_s else 1))
        reset.receive(own(t))
    return reset


def test_reset_only_without_gps() -> None:
    assert flown(lost_s=100.0).withholding_reason(position(60.0)) == "the autopilot has GPS"
    assert flown(lost_s=59.0).withholding_reason(position(60.0)) == "the autopilot has GPS"
    assert flown(lost_s=57.0).withholding_reason(position(60.0)) is None


def test_silent_receiver_counts_as_lost_gps() -> None:
    reset = flown(lost_s=100.0)
    reset.receive(own(63.0))
    assert reset.withholding_reason(position(63.0)) is None


def test_rejected_gps_fix_counts_as_no_gps() -> None:
    reset = flown(lost_s=0.0)
    reset.receive(FilterStatus(START, START, 32768, True, 2.0))
    reset.receive(gnss(60.0, 3))
    assert reset.withholding_reason(position(60.0)) is None
    reset.receive(FilterStatus(START, START, 831, False, 0.1))
    reset.receive(gnss(60.0, 3))
    assert reset.withholding_reason(position(60.0)) == "the autopilot has GPS"


def test_reset_requires_gps_status_and_position() -> None:
    reset = PositionReset()
    reset.receive(own(0.0))
    assert "no GPS message" in str(reset.withholding_reason(position(60.0)))
    reset.receive(gnss(0.0, 1))
    assert "no recent position" in str(reset.withholding_reason(position(60.0)))


@pytest.mark.parametrize("seconds", [5.0, 60.0, 180.0])
def test_reset_distance_is_limited_by_the_wind_error(seconds: float) -> None:
    reset = flown(until_s=seconds)
    room = 3.0 * 20.0 + 20.0 * (seconds + 0.1) + JUMP_MARGIN_M
    assert reset.withholding_reason(position(seconds, north=0.99 * room)) is None
    assert "further" in str(reset.withholding_reason(position(seconds, north=1.01 * room)))


def test_measured_drift_is_allowed_and_500_km_is_not() -> None:
    """Measured: 1266 m in three minutes after the wind changed by 7 m/s. ArduPilot accepted 500 km."""
    reset = flown(until_s=180.0)
    assert reset.withholding_reason(position(180.0, north=1266.0)) is None
    assert "further" in str(reset.withholding_reason(position(180.0, north=500_000.0)))


def test_drift_limit_restarts_after_an_accepted_reset() -> None:
    reset = flown(until_s=180.0)
    event = reset.handle_acknowledgement(0, START + 180 * SECOND_NS)
    assert event is not None and event.text == "external position accepted"
    for tenth in range(1, 31):
        reset.receive(own(180.0 + 0.1 * tenth))
    assert reset.withholding_reason(position(183.0, north=100.0)) is None
    assert "further" in str(reset.withholding_reason(position(183.0, north=150.0)))


def test_resets_continue_after_an_accepted_one() -> None:
    """An accepted reset corrects the autopilot's position, but is no GPS fix."""
    reset = flown(until_s=180.0)
    reset.handle_acknowledgement(0, START + 180 * SECOND_NS)
    reset.receive(own(181.0))
    assert reset.withholding_reason(position(181.0)) is None


def test_result_is_reported_when_it_changes() -> None:
    reset = flown()
    answers = [4, 4, 4, 0, 0, 2, 2, 3, 99]
    texts = [e.text for answer in answers if (e := reset.handle_acknowledgement(answer, START)) is not None]
    assert texts == [
        "external position failed",
        "external position accepted",
        "external position denied",
        "external position unsupported",
        "external position MAV_RESULT 99",
    ]


def test_autopilot_position_is_propagated_to_our_time() -> None:
    reset = flown(until_s=3.0)
    reset.receive(own(3.0, v_north=100.0))
    assert reset.withholding_reason(position(4.9, north=190.0, sigma=1.0)) is None


@settings(max_examples=200)
@given(
    lost=st.floats(-9.0, 9.0),
    now=st.floats(0.0, 10.0),
    north=st.floats(-1e6, 1e6),
    sigma=st.floats(0.1, 100.0),
)
def test_every_allowed_reset_is_near_and_without_gps(
    lost: float, now: float, north: float, sigma: float
) -> None:
    reset = flown(lost_s=lost, until_s=math.floor(10.0 * now) / 10.0)
    if reset.withholding_reason(position(now, north, sigma)) is None:
        assert now - lost >= 1.9
        assert abs(north) <= 1.01 * (3.0 * sigma + 20.0 * (now - lost + 0.1) + JUMP_MARGIN_M)
