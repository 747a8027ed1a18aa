"""Encoders: every field of every message as decoded by pymavlink's parser, against values computed by hand
(local projections of both makes, the ellipsoid, GPS time).
"""

import math
from typing import Any

import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pymavlink.dialects.v20 import all as pymavlink

from companion.link import dialect, frame
from companion.link.decode import Autopilot
from companion.link.firmware import Firmware
from companion.output.encode import (
    CORRELATION_S,
    ENCODERS,
    CannotEncode,
    Receiver,
    encode,
    navigation_status,
    stated_as_independent,
)
from companion.output.gate import Position
from companion.records import Bounds, LocalOrigin, Mode, ParallelEstimate, Prediction, Solution, Source
from tests.frames import on_wire

T = 123_456_789_000
NAN = math.nan
POSITION = Position(
    T,
    math.radians(55.75),
    math.radians(37.61),
    250.0,
    (20.0, -3.0, 0.5),
    (16.0, 2.0, 25.0),
    9.0,
    fixed=False,
    sigma_velocity=0.75,
    resets=258,
)
SIGMA = 5.042264  # sqrt of the greater eigenvalue of ((16, 2), (2, 25))
UNIX_NS = 1_795_248_000 * 10**9 - T  # at T it is 2026-11-21 08:00:00 UTC


def receiver(autopilot: Autopilot) -> Receiver:
    projection = "tangent" if autopilot == "other" else autopilot
    origin = LocalOrigin(T, T, math.radians(55.7), math.radians(37.7), 150.0, projection)
    return Receiver(autopilot, 1, origin=origin, sensor_id=3, unix_ns=UNIX_NS, rejected=70_000)


def parsed(message: Any) -> Any:
    """Return the message as received, in single precision."""
    (found,) = pymavlink.MAVLink(None).parse_buffer(frame.encode(message, 0, 1, 191))
    return found


def encoded(name: str, autopilot: Autopilot = "ardupilot", **changes: Any) -> Any:
    return parsed(encode(POSITION._replace(**changes), receiver(autopilot), name))


ARDUPILOT_COVARIANCE = [8.474810, *[0] * 5, 8.474810, *[0] * 4, 8.474810, 0, 0, 0, 0.75, 0, 0, 0.75]
ARDUPILOT_COVARIANCE += [0, 0.75]
TRUE_COVARIANCE = [16, 2, *[0] * 4, 25, *[0] * 4, 9, 0, 0, 0, *[NAN] * 6]

NO_RATES = {name: NAN for name in ("vx", "vy", "vz", "rollspeed", "pitchspeed", "yawspeed")}
AS_ARDUPILOT_COUNTS = {"x": 5565.942251, "y": -5642.184391, "z": -100.0}
AS_PX4_COUNTS = {"x": 5563.401381, "y": -5632.293872, "z": -100.0}
GLOBAL = {"lat": 557_500_000, "lon": 376_100_000, "alt": 250.0}

CASES: list[tuple[str, Autopilot, dict[str, Any]]] = [
    (
        "ODOMETRY",
        "ardupilot",
        {
            "time_usec": 123_456_789,
            "frame_id": 20,
            "child_frame_id": 12,
            **AS_ARDUPILOT_COUNTS,
            "q": [1, 0, 0, 0],
            **NO_RATES,
            "pose_covariance": ARDUPILOT_COVARIANCE,
            "velocity_covariance": [NAN, *[0] * 20],
            "reset_counter": 2,
            "estimator_type": 0,
            "quality": 50,
        },
    ),
    (
        "ODOMETRY",
        "px4",
        {
            "time_usec": 123_456_789,
            "frame_id": 1,
            "child_frame_id": 12,
            **AS_PX4_COUNTS,
            "q": [NAN] * 4,
            **NO_RATES,
            "pose_covariance": TRUE_COVARIANCE,
            "velocity_covariance": [NAN, *[0] * 20],
            "reset_counter": 2,
            "estimator_type": 0,
            "quality": 50,
        },
    ),
    (
        "VISION_POSITION_ESTIMATE",
        "ardupilot",
        {
            "usec": 123_456_789,
            **AS_ARDUPILOT_COUNTS,
            **dict.fromkeys(("roll", "pitch", "yaw"), 0.0),
            "covariance": ARDUPILOT_COVARIANCE,
            "reset_counter": 2,
        },
    ),
    (
        "VISION_POSITION_ESTIMATE",
        "px4",
        {
            "usec": 123_456_789,
            **AS_PX4_COUNTS,
            **dict.fromkeys(("roll", "pitch", "yaw"), NAN),
            "covariance": TRUE_COVARIANCE,
            "reset_counter": 2,
        },
    ),
    (
        "GPS_INPUT",
        "ardupilot",
        {
            "time_usec": 123_456_789,
            "gps_id": 1,
            "ignore_flags": 16,  # the vertical velocity alone
            "time_week": 2445,
            "time_week_ms": 547_218_000,
            "fix_type": 3,
            # 0.2 s before: 4.0 m south and 0.6 m east
            "lat": 557_499_641,
            "lon": 376_100_096,
            "alt": 250.1,
            "hdop": 1.0,
            "vdop": 1.0,
            "vn": 20.0,
            "ve": -3.0,
            "vd": 0.0,
            "speed_accuracy": 0.75,
            "horiz_accuracy": SIGMA,
            "vert_accuracy": 3.0,
            "satellites_visible": 6,
            "yaw": 0,
        },
    ),
    (
        "GLOBAL_POSITION_SENSOR",
        "px4",
        {
            "target_system": 1,
            "target_component": 1,
            "id": 3,
            "time_usec": 123_456_789,
            "processing_time": 0,
            "source": 6,
            "flags": 0,
            **GLOBAL,
            "alt_ellipsoid": NAN,
            "eph": SIGMA,
            "epv": 3.0,
        },
    ),
    *(
        (
            "COMMAND_INT",
            autopilot,
            {
                "target_system": 1,
                "target_component": 1,
                "frame": 5,
                "command": 43003,
                "current": 0,
                "autocontinue": 0,
                "param1": 123.456787109375,  # single precision, and not above 123.456789
                "param2": 0.0,
                "param3": SIGMA,
                "param4": 0.0,
                "x": 557_500_000,
                "y": 376_100_000,
                "z": NAN,
            },
        )
        for autopilot in ("ardupilot", "px4")
    ),
]


@pytest.mark.parametrize(("name", "autopilot", "fields"), CASES, ids=lambda value: str(value)[:24])
def test_every_field_of_every_message(name: str, autopilot: Autopilot, fields: dict[str, Any]) -> None:
    m = encoded(name, autopilot)
    assert m.get_msgId() == dialect.type_named(name).msgid
    assert set(fields) == set(m.fieldnames)
    for field, expected in fields.items():
        assert getattr(m, field) == pytest.approx(expected, rel=2e-6, abs=1e-6, nan_ok=True), field


def accuracy_read(message: Any, is_old: bool) -> float:
    """Return the position error that ArduPilot reads: since 4.7 (PR 32084), and before."""
    c = message.pose_covariance if message.get_type() == "ODOMETRY" else message.covariance
    assert all(map(math.isfinite, c))
    return math.cbrt(c[0] ** 2 + c[6] ** 2 + c[11] ** 2) if is_old else math.sqrt(c[0] + c[6] + c[11])


@pytest.mark.parametrize("sigma", [0.5, 20.0, 99.9])
@pytest.mark.parametrize("name", ["ODOMETRY", "VISION_POSITION_ESTIMATE"])
@pytest.mark.parametrize(
    ("version", "is_old"), [((4, 7), False), ((4, 8), False), ((4, 6), True), ((3, 9), True)]
)
def test_every_version_of_ardupilot_reads_the_accuracy(
    name: str, sigma: float, version: tuple[int, int], is_old: bool
) -> None:
    to = receiver("ardupilot")._replace(firmware=Firmware(*version, 0, 0))
    position = POSITION._replace(covariance=(sigma**2, 0.0, 0.25 * sigma**2))
    assert accuracy_read(parsed(encode(position, to, name)), is_old) == pytest.approx(sigma)


@pytest.mark.parametrize("sigma", [3.0, 20.0, 99.9])
def test_unknown_version_is_never_given_too_good_an_accuracy(sigma: float) -> None:
    m = encoded("ODOMETRY", covariance=(sigma**2, 0.0, sigma**2))
    assert accuracy_read(m, is_old=False) == pytest.approx(sigma)
    assert accuracy_read(m, is_old=True) >= sigma


@pytest.mark.parametrize("name", ["ODOMETRY", "VISION_POSITION_ESTIMATE"])
def test_accuracy_beyond_ardupilots_limit_is_stated_as_the_limit(name: str) -> None:
    """ArduPilot limits it itself; a position worse than 100 m is better than none."""
    m = encoded(name, covariance=(300.0**2, 0.0, 300.0**2))
    assert accuracy_read(m, is_old=False) == pytest.approx(100.0)


@pytest.mark.parametrize("name", ["GPS_INPUT", "COMMAND_INT"])
def test_receiver_and_reset_beyond_ardupilots_limit_are_not_encoded(name: str) -> None:
    encoded(name, covariance=(99.0**2, 0.0, 99.0**2))
    with pytest.raises(CannotEncode, match="worse than"):
        encoded(name, covariance=(80.0**2, 70.0**2, 80.0**2))  # 80 m each way, 106 m along the diagonal


@pytest.mark.parametrize("rate_hz", [2.0, 10.0])
def test_filter_that_takes_errors_as_independent_is_as_sure_as_our_error_allows(rate_hz: float) -> None:
    """Mean of a correlated error over a long time against what the filter believes of it.

    An exponentially correlated error (sigma, tau) is averaged over a time T >> tau. A filter that takes f
    messages a second with stated sigma s as independent believes s / sqrt(f T).
    """
    sigma, seconds = 3.0, 4000.0
    stated = stated_as_independent(POSITION._replace(covariance=(sigma**2, 0.0, sigma**2)), rate_hz).sigma
    believed = stated / math.sqrt(rate_hz * seconds)
    rng = np.random.default_rng(1)
    n, keep = round(seconds * rate_hz), math.exp(-1.0 / (rate_hz * CORRELATION_S))
    drive = sigma * math.sqrt(1.0 - keep**2) * rng.standard_normal((n, 300))
    error = sigma * rng.standard_normal(300)
    total = np.zeros(300)
    for step in drive:
        error = keep * error + step
        total += error
    assert np.sqrt(np.mean((total / n) ** 2)) == pytest.approx(believed, rel=0.1)


def test_independent_messages_keep_their_accuracy() -> None:
    assert stated_as_independent(POSITION, 0.0) == POSITION  # a single one


def test_px4_receives_the_true_accuracy() -> None:
    assert encoded("GLOBAL_POSITION_SENSOR", "px4", covariance=(4e4, 0.0, 1e4)).eph == 200.0
    assert encoded("ODOMETRY", "px4", covariance=(4e4, 0.0, 1e4)).pose_covariance[0] == 4e4


@pytest.mark.parametrize("name", ["ODOMETRY", "VISION_POSITION_ESTIMATE"])
def test_local_position_requires_an_origin(name: str) -> None:
    with pytest.raises(CannotEncode, match="origin"):
        encode(POSITION, Receiver("ardupilot", 1), name)


@pytest.mark.parametrize("unix_ns", [None, 0, -(10**18), 2**67])
def test_gps_input_requires_the_time_of_day(unix_ns: int | None) -> None:
    with pytest.raises(CannotEncode, match="time of day"):
        encode(POSITION, receiver("ardupilot")._replace(unix_ns=unix_ns), "GPS_INPUT")


def test_gps_input_requires_a_velocity() -> None:
    with pytest.raises(CannotEncode, match="velocity"):
        encoded("GPS_INPUT", sigma_velocity=None)


@given(ns=st.integers(1, 10**16))
@settings(max_examples=300)
def test_command_timestamp_is_never_ahead_of_the_clock(ns: int) -> None:
    """A timestamp ahead of the clock would shift ArduPilot's clock offset of the whole link."""
    m, odometry = encoded("COMMAND_INT", t_ns=ns), encoded("ODOMETRY", t_ns=ns)
    assert 0.0 <= ns * 1e-9 - m.param1 <= ns * 1e-9 * 2.0**-22
    assert odometry.time_usec == ns // 1000


def test_quality_is_lower_during_prediction() -> None:
    assert (encoded("ODOMETRY", fixed=True).quality, encoded("ODOMETRY").quality) == (100, 50)


def test_every_output_method_has_an_encoder() -> None:
    from companion.config.profiles import MESSAGES

    assert set(ENCODERS) == set(MESSAGES.values())


SOLUTION = Solution(
    t_ns=T,
    rx_ns=T,
    mode=Mode.PREDICTING,
    estimator="minimax",
    lat=POSITION.lat,
    lon=POSITION.lon,
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


def status(**changes: Any) -> Any:
    message = navigation_status(msgspec.structs.replace(SOLUTION, **changes), receiver("ardupilot"))
    return dialect.decode(on_wire(message, 1, 191))


def test_status_fields() -> None:
    m = status()
    assert (m.mode, m.estimator, m.sources, m.rejected, m.age) == (2, 2, 1 | 8, 65535, 50)
    assert (m.bound_north, m.bound_east, m.bound_horizontal) == (12.0, 5.0, 13.0)
    assert (m.bound_velocity, m.disagreement, m.horizon) == pytest.approx((0.5, 7.5, 60.0))
    assert m.sigma_horizontal == pytest.approx(math.sqrt(41.0))
    assert (m.ahead, m.bound_ahead[0]) == ([60.0, 0.0, 0.0, 0.0], 50.0)
    assert all(map(math.isnan, m.bound_ahead[1:]))


def test_unknown_status_fields_are_nan() -> None:
    m = status(bound_n=None, velocity_bound_n=None, disagreement=None, ahead=())
    unknown = (m.bound_north, m.bound_east, m.bound_horizontal, m.bound_velocity, m.disagreement)
    assert all(map(math.isnan, unknown))


def test_bounds_of_tilt_and_drift() -> None:
    assert status().tilt_bound == status().drift_bound == [0.0, 0.0]
    m = status(bounds=Bounds((3.0, 4.0), 0.0, 1.0, (3e-4, 4e-4), (7e-7, 8e-7)))
    assert m.tilt_bound == pytest.approx([3e-4, 4e-4])
    assert m.drift_bound == pytest.approx([7e-7, 8e-7])


def test_filters_beside_the_leader_have_their_places() -> None:
    m = status()
    assert m.parallel_distance == m.parallel_sigma == [0.0, 0.0]
    m = status(
        error_n=(10.0, 20.0), parallel=(ParallelEstimate("restrictive", (13.0, 24.0), (36.0, 5.0, 64.0)),)
    )
    assert m.parallel_distance == pytest.approx([0.0, 5.0])
    assert m.parallel_sigma == pytest.approx([0.0, 10.0])


@pytest.mark.parametrize("name", ["kalman", "minimax", "restricted", "restrictive"])
def test_every_estimator_has_its_number(name: str) -> None:
    number = status(estimator=name).estimator
    assert dialect.rsbn.enums["NAVIGATION_ESTIMATOR"][number].name == f"NAVIGATION_ESTIMATOR_{name.upper()}"


def test_the_enumerations_have_nothing_that_is_never_sent() -> None:
    enums = dialect.rsbn.enums
    sent = {
        status(estimator=name).estimator
        for name in ("none", "kalman", "minimax", "restricted", "restrictive")
    }
    assert sent == set(enums["NAVIGATION_ESTIMATOR"]) - {max(enums["NAVIGATION_ESTIMATOR"])}  # ..._ENUM_END
    modes = {status(mode=mode).mode for mode in Mode}
    assert modes == set(enums["NAVIGATION_MODE"]) - {max(enums["NAVIGATION_MODE"])}


@pytest.mark.parametrize("mode", list(Mode))
def test_every_mode_has_its_number(mode: Mode) -> None:
    assert status(mode=mode).mode == list(Mode).index(mode)


@pytest.mark.parametrize(
    "changes",
    [{"lat": NAN}, {"covariance": (NAN,) * 6}, {"bound_n": (math.inf, 1.0)}, {"inertial_age_s": NAN}],
    ids=str,
)
def test_status_is_encoded_for_any_solution(changes: dict[str, Any]) -> None:
    assert status(**changes).mode == 2
