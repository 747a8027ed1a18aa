"""What each make of autopilot is told, as it reads it; and what it is never told."""

import math
from typing import Any

import msgspec
import pytest

from companion.link import dialect, frame
from companion.nav.geometry import Geodetic, local_to_geodetic
from companion.records import LocalOrigin, Mode, Prediction, Solution, Source
from companion.wire import ENCODERS, Autopilot, Receiver, accuracy, encode

T = 123_456_789_000
LAT, LON = math.radians(55.75), math.radians(37.61)
SOLUTION = Solution(
    t_ns=T,
    rx_ns=T,
    mode=Mode.PREDICTING,
    estimator="minimax",
    lat=LAT,
    lon=LON,
    alt_msl=250.0,
    v_n=(20.0, -3.0, 0.5),
    covariance=(16.0, 2.0, 0.0, 25.0, 0.0, 9.0),
    error_n=(30.0, -40.0),
    velocity_error_n=(0.1, 0.2),
    sources=int(Source.INERTIAL | Source.AZIMUTH),
    horizon_s=60.0,
    bound_n=(12.0, 5.0),
    velocity_bound_n=(0.3, 0.4),
    disagreement=7.5,
    inertial_age_s=0.05,
    ahead=(Prediction(60.0, (30.0, 40.0), (1.0, 1.0), (2.0, 2.0)),),
)


def receiver(autopilot: Autopilot) -> Receiver:
    projection = "tangent" if autopilot == "other" else autopilot
    origin = LocalOrigin(T, T, math.radians(55.7), math.radians(37.7), 150.0, projection)
    return Receiver(autopilot, 1, origin=origin, geoid=14.5, sensor_id=3, reset_counter=258, rejected=70_000)


def told(name: str, autopilot: Autopilot = "ardupilot", **changes: Any) -> Any:
    """The message as it comes out at the other end, single precision and all."""
    (message,) = encode(msgspec.structs.replace(SOLUTION, **changes), receiver(autopilot), [name])
    found = frame.examine(frame.encode(message, 0, 1, 191))
    assert isinstance(found, frame.Frame)
    return dialect.decode(found)


@pytest.mark.parametrize("autopilot", ["ardupilot", "px4", "other"])
def test_odometry_counts_from_the_origin_by_the_autopilot_s_own_earth(autopilot: Autopilot) -> None:
    m = told("ODOMETRY", autopilot)
    who = receiver(autopilot)
    assert who.origin is not None
    origin = Geodetic(who.origin.lat, who.origin.lon, who.origin.alt_msl)
    point = local_to_geodetic(who.origin.projection, origin, [m.x, m.y, m.z])  # type: ignore[arg-type]
    assert point.lat == pytest.approx(LAT, abs=1e-10)
    assert point.lon == pytest.approx(LON, abs=1e-10)
    assert point.alt == pytest.approx(250.0, abs=1e-3)
    assert m.z == pytest.approx(-100.0, abs=10.0)


def test_ardupilot_reads_the_worse_axis_out_of_its_own_formula() -> None:
    m = told("ODOMETRY")
    c = m.pose_covariance
    assert math.cbrt(c[0] ** 2 + c[6] ** 2 + c[11] ** 2) == pytest.approx(12.0)
    assert math.cbrt(c[15] ** 2 + c[18] ** 2 + c[20] ** 2) == pytest.approx(1.5)
    assert all(map(math.isfinite, c))
    assert (m.frame_id, m.child_frame_id, m.q) == (20, 12, [1.0, 0.0, 0.0, 0.0])


def test_px4_reads_true_variances_and_no_attitude() -> None:
    m = told("ODOMETRY", "px4")
    c = m.pose_covariance
    assert (c[0], c[1], c[6], c[11]) == pytest.approx((144.0, 2.0, 25.0, 9.0))
    assert math.isnan(c[15]) and all(map(math.isnan, m.q))
    assert (m.frame_id, m.child_frame_id) == (1, 12)
    assert m.estimator_type in range(4)


@pytest.mark.parametrize("autopilot", ["ardupilot", "px4"])
def test_odometry_is_of_the_position_alone(autopilot: Autopilot) -> None:
    m = told("ODOMETRY", autopilot)
    rates = (m.vx, m.vy, m.vz, m.rollspeed, m.pitchspeed, m.yawspeed, m.velocity_covariance[0])
    assert all(map(math.isnan, rates))
    assert (m.time_usec, m.reset_counter) == (T // 1000, 2)
    assert 0 < m.quality <= 100


def test_the_accuracy_stated_is_the_guaranteed_one_where_that_is_greater() -> None:
    assert accuracy(SOLUTION) == (12.0, 5.0, 3.0)
    assert accuracy(msgspec.structs.replace(SOLUTION, bound_n=None)) == (4.0, 5.0, 3.0)


def test_global_position_sensor() -> None:
    m = told("GLOBAL_POSITION_SENSOR", "px4")
    assert (m.lat, m.lon) == (557_500_000, 376_100_000)
    assert (m.alt, m.alt_ellipsoid, m.eph, m.epv) == (250.0, 264.5, 12.0, 3.0)
    # `.id` is the payload's here: the message's own stands in its header.
    assert (m.target_system, m.id, dialect.id_of(m)) == (1, 3, 296)


NEVER: list[dict[str, Any]] = [
    {"mode": Mode.INITIALISING},
    {"mode": Mode.UNTRUSTED},
    {"lat": math.nan},
    {"lat": 2.0},
    {"lon": 7.0},
    {"alt_msl": math.inf},
    {"covariance": (math.nan, 0.0, 0.0, 1.0, 0.0, 1.0)},
    {"covariance": (1.0, 0.0, 0.0, -1.0, 0.0, 1.0)},
    {"covariance": (0.0,) * 6},
    {"bound_n": (math.inf, 1.0)},
    {"inertial_age_s": 0.3},
    {"inertial_age_s": math.nan},
]


@pytest.mark.parametrize("changes", NEVER, ids=str)
@pytest.mark.parametrize("autopilot", ["ardupilot", "px4", "other"])
def test_nothing_implausible_is_sent_but_its_status_is(autopilot: Autopilot, changes: dict[str, Any]) -> None:
    solution = msgspec.structs.replace(SOLUTION, **changes)
    sent = encode(solution, receiver(autopilot), ENCODERS)
    assert [dialect.id_of(message) for message in sent] == [180001]
    assert isinstance(frame.encode(sent[0], 0, 1, 191), bytes)


def test_no_origin_no_odometry() -> None:
    assert encode(SOLUTION, Receiver("ardupilot", 1), ["ODOMETRY"]) == ()


def test_status_says_what_no_other_message_does() -> None:
    m = told("NAVIGATION_STATUS")
    assert (m.mode, m.estimator, m.sources, m.rejected, m.age) == (2, 2, 1 | 8, 65535, 50)
    assert (m.bound_north, m.bound_east, m.bound_horizontal) == (12.0, 5.0, 13.0)
    assert (m.bound_velocity, m.disagreement, m.horizon) == pytest.approx((0.5, 7.5, 60.0))
    assert m.sigma_horizontal == pytest.approx(math.sqrt(41.0))
    assert (m.ahead, m.bound_ahead[0]) == ([60.0, 0.0, 0.0, 0.0], 50.0)
    assert all(map(math.isnan, m.bound_ahead[1:]))


def test_status_leaves_open_what_is_not_known() -> None:
    m = told("NAVIGATION_STATUS", bound_n=None, velocity_bound_n=None, disagreement=None, ahead=())
    unknown = (m.bound_north, m.bound_east, m.bound_horizontal, m.bound_velocity, m.disagreement)
    assert all(map(math.isnan, unknown))


@pytest.mark.parametrize("mode", list(Mode))
def test_every_mode_has_its_number(mode: Mode) -> None:
    assert told("NAVIGATION_STATUS", mode=mode).mode == list(Mode).index(mode)
