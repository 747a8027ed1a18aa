"""Message encoders: positions and solutions as MAVLink messages, as each make of autopilot reads them.

Each make interprets a standard message in its own way (measured on ArduPlane/ArduCopter 4.7 EKF3 and PX4
EKF2); these differences are handled here only. A message for an estimator is made from a `gate.Position`, so
no unchecked value can be sent. NAVIGATION_STATUS is made from any solution and reports its state.

Every timestamp is on the companion's monotonic clock: ArduPilot estimates the offset of one clock per link
for all messages, and PX4 maps it by the TIMESYNC messages, which the session answers from the same clock. A
position is valid at the time of sending, so none has an age.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Callable, Mapping
from typing import NamedTuple

from companion.link import dialect
from companion.link.decode import Autopilot
from companion.link.dialect import Message, mavlink, rsbn
from companion.link.fields import deg_e7
from companion.link.firmware import Firmware
from companion.nav.geometry import Geodetic, geodetic_to_local
from companion.output.gate import Position
from companion.records import PARALLEL, LocalOrigin, Mode, Solution, Source, Trust

ARDUPILOT_MAX_SIGMA_M = 100.0
"""ArduPilot's filter limits every position sigma to this value, so a greater one cannot be stated."""
ROOT_OF_SUM = (4, 7)
"""First ArduPilot that reads sqrt(c0 + c6 + c11) as the position error; before, cbrt(c0^2 + c6^2 + c11^2)."""
CORRELATION_S = 20.0
"""Time for which our position error keeps its sign (ArduPlane on one beacon 60 km away: 15 to 40 s)."""
GPS_LAG_NS = 200_000_000
"""Age that ArduPilot assumes for a GPS_INPUT on arrival."""

# PX4 rejects GPS, GPS_INS, LIDAR and AUTOPILOT, and ignores the variances of NAIVE
_ESTIMATOR_UNKNOWN = mavlink.MAV_ESTIMATOR_TYPE_UNKNOWN
_YAW_ERROR = 1.5  # rad, the greatest that ArduPilot uses; the attitude sent is meaningless
_FIXED, _PREDICTED = 100, 50  # quality, per cent; -1 is "failed" and dropped, 0 "unknown"

_SECOND_RECEIVER = 1  # gps_id: the first is the autopilot's own
_SATELLITES, _DOP = 6, 1.0
"""Placeholders: the minimum of ArduPilot's check (6, 2.5), so that a receiver with a fix is preferred."""
_GPS_EPOCH_S, _LEAP_S = 315_964_800, 18  # UNIX time; GPS time is 18 s ahead of UTC since 2017
_WEEK_MS, _WEEKS = 604_800_000, 1 << 16

_MODES = {mode: getattr(rsbn, f"NAVIGATION_MODE_{mode.name}") for mode in Mode}
_ESTIMATORS = {
    "minimax": rsbn.NAVIGATION_ESTIMATOR_MINIMAX,
    "kalman": rsbn.NAVIGATION_ESTIMATOR_KALMAN,
    "restrictive": rsbn.NAVIGATION_ESTIMATOR_RESTRICTIVE,
    "restricted": rsbn.NAVIGATION_ESTIMATOR_RESTRICTED,
}
_SOURCES = {
    Source.INERTIAL: rsbn.NAVIGATION_SOURCE_INS,
    Source.GNSS: rsbn.NAVIGATION_SOURCE_GNSS,
    Source.AZIMUTH: rsbn.NAVIGATION_SOURCE_RSBN_AZIMUTH,
    Source.RANGE: rsbn.NAVIGATION_SOURCE_RSBN_RANGE,
    Source.AIR_DATA: rsbn.NAVIGATION_SOURCE_AIR_DATA,
}


class CannotEncode(Exception):
    """The receiver cannot be given this position correctly; the text states why."""


class Receiver(NamedTuple):
    """The autopilot that receives a message, and the values that only its link knows.

    `origin` is the autopilot's local origin, `origin_resets` how often it moved, `sensor_id` PX4's
    EKF2_AGP0_ID, `unix_ns` UTC minus our clock (ns) if known, `firmware` the version if stated, `rejected`
    the number of rejected measurements.
    """

    autopilot: Autopilot
    system: int
    origin: LocalOrigin | None = None
    origin_resets: int = 0
    sensor_id: int = 1
    unix_ns: int | None = None
    firmware: Firmware | None = None
    rejected: int = 0


def encode(position: Position, receiver: Receiver, name: str, rate_hz: float = 0.0) -> Message:
    """Encode the message `name` (a key of `ENCODERS`), sent `rate_hz` times a second (0: once).

    Raises `CannotEncode` if it would be incorrect.
    """
    if receiver.autopilot != "ardupilot":
        position = stated_as_independent(position, rate_hz)
    return ENCODERS[name](position, receiver)


def stated_as_independent(position: Position, rate_hz: float) -> Position:
    """Enlarge the covariance for a filter that takes the errors of successive messages as independent.

    Such a filter gains the information rate_hz / s^2 per second from a stated sigma s. An error with sigma
    and correlation time tau brings 1 / (2 tau sigma^2), the inverse of its spectral density at low
    frequencies. So s^2 = 2 tau rate_hz sigma^2 gives the filter what there is.

    ArduPilot receives sigma as it is. Its filter holds on to a wind that has changed, and follows a position
    of 100 m too slowly: 49 and 31 m r.m.s. in the first minute instead of 31 and 24 m, the same after it.
    """
    factor = max(1.0, 2.0 * CORRELATION_S * rate_hz)
    nn, ne, ee = position.covariance
    return position._replace(covariance=(factor * nn, factor * ne, factor * ee))


def odometry(position: Position, receiver: Receiver) -> Message:
    """Encode ODOMETRY: position only, from the autopilot's local origin in the autopilot's own projection.

    Velocity and rates are NaN: not given.
    """
    x, y, z = _local(position, receiver)
    ardupilot = receiver.autopilot == "ardupilot"
    nan = math.nan
    return dialect.new(
        "ODOMETRY",
        time_usec=position.t_ns // 1000,
        frame_id=mavlink.MAV_FRAME_LOCAL_FRD if ardupilot else mavlink.MAV_FRAME_LOCAL_NED,
        child_frame_id=mavlink.MAV_FRAME_BODY_FRD,
        x=x,
        y=y,
        z=z,
        # PX4 ignores an attitude of NaN; ArduPilot converts it to angles, so it receives no rotation
        q=[1.0, 0.0, 0.0, 0.0] if ardupilot else [nan] * 4,
        vx=nan,
        vy=nan,
        vz=nan,
        rollspeed=nan,
        pitchspeed=nan,
        yawspeed=nan,
        pose_covariance=_covariance(position, receiver),
        velocity_covariance=[nan] + [0.0] * 20,
        reset_counter=(position.resets + receiver.origin_resets) % 256,
        estimator_type=_ESTIMATOR_UNKNOWN,
        quality=_FIXED if position.fixed else _PREDICTED,
    )


def vision_position_estimate(position: Position, receiver: Receiver) -> Message:
    """Encode VISION_POSITION_ESTIMATE: position and covariance as in ODOMETRY; NED for both makes."""
    x, y, z = _local(position, receiver)
    ardupilot = receiver.autopilot == "ardupilot"
    angle = 0.0 if ardupilot else math.nan
    return dialect.new(
        "VISION_POSITION_ESTIMATE",
        usec=position.t_ns // 1000,
        x=x,
        y=y,
        z=z,
        roll=angle,
        pitch=angle,
        yaw=angle,
        covariance=_covariance(position, receiver),
        reset_counter=(position.resets + receiver.origin_resets) % 256,
    )


def _local(position: Position, receiver: Receiver) -> tuple[float, float, float]:
    """Return north, east, down from the autopilot's local origin, m."""
    origin = receiver.origin
    if origin is None:
        raise CannotEncode("the autopilot's local origin is not confirmed by its positions")
    start = Geodetic(origin.lat, origin.lon, origin.alt_msl)
    return geodetic_to_local(origin.projection, start, position.place)


def _covariance(position: Position, receiver: Receiver) -> list[float]:
    """Return the upper triangle of the 6 x 6 covariance, row by row.

    ArduPilot reads one accuracy for all axes, A = sqrt(c0 + c6 + c11), so A is encoded as c0 = c6 = c11 =
    A^2 / 3, and the angles likewise. Versions before `ROOT_OF_SUM` read cbrt(c0^2 + c6^2 + c11^2). A version
    that is not known receives the former: the latter is then more than A from 3 m up, never less. Others
    receive the position variances, and NaN for the attitude.
    """
    covariance = [0.0] * 21
    if receiver.autopilot != "ardupilot":
        covariance[0], covariance[1], covariance[6] = position.covariance
        covariance[11] = position.variance_down
        covariance[15:] = [math.nan] * 6
        return covariance
    is_old = receiver.firmware is not None and receiver.firmware[:2] < ROOT_OF_SUM
    accuracy = min(position.sigma, ARDUPILOT_MAX_SIGMA_M)
    covariance[0] = covariance[6] = covariance[11] = _element(accuracy, is_old)
    covariance[15] = covariance[18] = covariance[20] = _element(_YAW_ERROR, is_old)
    return covariance


def _element(accuracy: float, is_old: bool) -> float:
    """Return the diagonal element that ArduPilot reads as `accuracy` (m or rad)."""
    return math.sqrt(accuracy**3 / 3.0) if is_old else accuracy**2 / 3.0


def gps_input(position: Position, receiver: Receiver) -> Message:
    """Encode GPS_INPUT as ArduPilot's second receiver, valid `GPS_LAG_NS` before it arrives.

    The velocity is always included. With the ignore flags ArduPilot keeps the velocity of the last message
    without them, and without any velocity it assumes zero (51 m r.m.s. position error instead of 4.4 m). The
    velocity is independent of the autopilot's, because no channel that uses its position may feed it.
    """
    if receiver.unix_ns is None:
        raise CannotEncode("the time of day is unknown")
    if position.sigma > ARDUPILOT_MAX_SIGMA_M:
        raise CannotEncode(f"accuracy worse than ArduPilot's limit of {ARDUPILOT_MAX_SIGMA_M:g} m")
    if position.sigma_velocity is None:
        raise CannotEncode("velocity accuracy is unknown")
    then = position.at(position.t_ns - GPS_LAG_NS)
    gps_ms = (position.t_ns + receiver.unix_ns) // 1_000_000 + (_LEAP_S - _GPS_EPOCH_S) * 1000
    if not _WEEK_MS <= gps_ms < _WEEKS * _WEEK_MS:
        raise CannotEncode("the time of day is unknown")
    north, east, _ = position.v_n
    return dialect.new(
        "GPS_INPUT",
        time_usec=position.t_ns // 1000,
        gps_id=_SECOND_RECEIVER,
        ignore_flags=mavlink.GPS_INPUT_IGNORE_FLAG_VEL_VERT,
        time_week_ms=gps_ms % _WEEK_MS,
        time_week=gps_ms // _WEEK_MS,
        fix_type=mavlink.GPS_FIX_TYPE_3D_FIX,
        lat=deg_e7(then.lat),
        lon=deg_e7(then.lon),
        alt=then.alt_msl,
        hdop=_DOP,
        vdop=_DOP,
        vn=north,
        ve=east,
        vd=0.0,
        speed_accuracy=position.sigma_velocity,
        horiz_accuracy=position.sigma,
        vert_accuracy=math.sqrt(position.variance_down),
        satellites_visible=_SATELLITES,
        yaw=0,
    )


def global_position_sensor(position: Position, receiver: Receiver) -> Message:
    """Encode GLOBAL_POSITION_SENSOR; `eph` and `epv` are the standard deviations."""
    return dialect.new(
        "GLOBAL_POSITION_SENSOR",
        target_system=receiver.system,
        target_component=mavlink.MAV_COMP_ID_AUTOPILOT1,
        id=receiver.sensor_id,
        time_usec=position.t_ns // 1000,
        source=mavlink.GLOBAL_POSITION_SRC_ESTIMATOR,
        lat=deg_e7(position.lat),
        lon=deg_e7(position.lon),
        alt_ellipsoid=math.nan,  # the geoid is not known
        alt=position.alt_msl,
        eph=position.sigma,
        epv=math.sqrt(position.variance_down),
    )


def external_position_estimate(position: Position, receiver: Receiver) -> Message:
    """Encode MAV_CMD_EXTERNAL_POSITION_ESTIMATE, which is accepted in COMMAND_INT only.

    Both makes accept frame 5 (PX4 no other) and a height of NaN (ArduPilot no other). A `param1` of NaN
    crashes ArduPilot. It is rounded down to single precision, because a timestamp in the future would shift
    the clock offset that all messages of the link share.
    """
    if position.sigma > ARDUPILOT_MAX_SIGMA_M:
        raise CannotEncode(f"accuracy worse than {ARDUPILOT_MAX_SIGMA_M:g} m, the limit of a position reset")
    return dialect.new(
        "COMMAND_INT",
        target_system=receiver.system,
        target_component=mavlink.MAV_COMP_ID_AUTOPILOT1,
        frame=mavlink.MAV_FRAME_GLOBAL_INT,
        command=mavlink.MAV_CMD_EXTERNAL_POSITION_ESTIMATE,
        param1=_single_below(position.t_ns * 1e-9),
        param2=0.0,
        param3=position.sigma,
        param4=0.0,
        x=deg_e7(position.lat),
        y=deg_e7(position.lon),
        z=math.nan,
    )


def _single_below(value: float) -> float:
    """Return the greatest single-precision number that is not above a positive `value`."""
    packed = struct.pack("<f", value)
    single: float = struct.unpack("<f", packed)[0]
    if single > value:
        (bits,) = struct.unpack("<I", packed)
        (single,) = struct.unpack("<f", struct.pack("<I", bits - 1))
    return single


def navigation_status(solution: Solution, receiver: Receiver) -> Message:
    """Encode NAVIGATION_STATUS, for any solution; unknown values are NaN."""
    s = solution
    ahead = s.ahead[:4]
    unused = 4 - len(ahead)
    variance, bounds = s.covariance[0] + s.covariance[3], s.bounds
    running = {p.estimator: p for p in s.parallel}
    beside = [running.get(name) for name in PARALLEL]
    return dialect.new(
        "NAVIGATION_STATUS",
        time_usec=s.t_ns // 1000,
        bound_north=math.nan if s.bound_n is None else s.bound_n[0],
        bound_east=math.nan if s.bound_n is None else s.bound_n[1],
        bound_horizontal=math.nan if s.bound_n is None else math.hypot(*s.bound_n),
        bound_velocity=math.nan if s.velocity_bound_n is None else math.hypot(*s.velocity_bound_n),
        sigma_horizontal=math.sqrt(variance) if variance >= 0.0 else math.nan,
        horizon=s.horizon_s,
        disagreement=math.nan if s.disagreement is None else s.disagreement,
        ahead=[p.ahead_s for p in ahead] + [0.0] * unused,
        bound_ahead=[math.hypot(*p.bound_n) for p in ahead] + [math.nan] * unused,
        sources=sum(bit for source, bit in _SOURCES.items() if s.sources & source),
        rejected=min(receiver.rejected, 0xFFFF),
        age=min(round(max(s.inertial_age_s, 0.0) * 1e3), 0xFFFF)
        if math.isfinite(s.inertial_age_s)
        else 0xFFFF,
        mode=_MODES[s.mode],
        estimator=_ESTIMATORS.get(s.estimator, rsbn.NAVIGATION_ESTIMATOR_NONE),
        protection=math.nan if s.protection is None else s.protection,
        trust=0 if s.trust is None else s.trust + 1,  # NAVIGATION_TRUST: 0 is "unknown"
        tilt_bound=list(bounds.tilt_n) if bounds and bounds.tilt_n else [0.0, 0.0],
        drift_bound=list(bounds.drift_n) if bounds and bounds.drift_n else [0.0, 0.0],
        parallel_distance=[math.dist(p.error_n, s.error_n) if p else 0.0 for p in beside],
        parallel_sigma=[math.sqrt(max(0.0, p.covariance[0] + p.covariance[2])) if p else 0.0 for p in beside],
    )


def named_values(status: Message | None, now_ns: int) -> list[Message]:
    """Encode the main values of NAVIGATION_STATUS as NAMED_VALUE_FLOAT.

    Every ground station plots these, and ArduPilot forwards and logs them, where an unknown id is dropped.
    Without a recent solution (None) the trust is "untrusted" and all else NaN, so that no plot keeps an old
    value.
    """
    values = dict.fromkeys(("nav_source", "nav_sigma", "nav_bound", "nav_hpl"), math.nan)
    values["nav_trust"] = float(Trust.UNTRUSTED + 1)
    if status is not None:
        values = {
            "nav_source": float(status.sources),
            "nav_sigma": status.sigma_horizontal,
            "nav_bound": status.bound_horizontal,
            "nav_hpl": status.protection,
            "nav_trust": float(status.trust),
        }
    boot_ms = now_ns // 1_000_000 & 0xFFFFFFFF
    return [
        dialect.new("NAMED_VALUE_FLOAT", time_boot_ms=boot_ms, name=name, value=value)
        for name, value in values.items()
    ]


ENCODERS: Mapping[str, Callable[[Position, Receiver], Message]] = {
    "ODOMETRY": odometry,
    "VISION_POSITION_ESTIMATE": vision_position_estimate,
    "GPS_INPUT": gps_input,
    "GLOBAL_POSITION_SENSOR": global_position_sensor,
    "COMMAND_INT": external_position_estimate,
}
"""Encoders of the position messages; COMMAND_INT carries MAV_CMD_EXTERNAL_POSITION_ESTIMATE."""
