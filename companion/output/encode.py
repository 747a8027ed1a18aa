"""A position, or a solution -> messages, as the autopilot at the other end takes them.

Each make reads a standard message in its own way (measured on ArduPlane/ArduCopter 4.7 EKF3 and PX4 EKF2);
those ways are written down here and nowhere else. What feeds an estimator is made of a `gate.Position` only,
so that nothing implausible can leave; NAVIGATION_STATUS is made of any solution, for it says just that.

Every time sent is that of the companion's monotonic clock: ArduPilot learns the offset of one steady clock a
link, for all messages together, and PX4 maps it by the TIMESYNC that the session answers with the same clock.
A position is sent as of the instant of sending, so none has an age.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple, TypeAlias

from companion.link import dialect
from companion.link.decode import Autopilot
from companion.nav.geometry import Geodetic, Projection, geodetic_to_local
from companion.output.gate import Position
from companion.records import LocalOrigin, Mode, Solution, Source

Message: TypeAlias = Any

GREATEST_ERROR_M = 100.0
"""ArduPilot's filter cuts every position error off here: to say more is not possible, and to say less is
not true."""
GPS_LAG_NS = 200_000_000
"""ArduPilot takes a GPS_INPUT for so much older than its arrival."""
MAV_CMD_EXTERNAL_POSITION_ESTIMATE = 43003

_GLOBAL_INT, _LOCAL_NED, _BODY_FRD, _LOCAL_FRD = 5, 1, 12, 20  # MAV_FRAME
_ESTIMATOR_UNKNOWN = 0  # PX4 refuses GPS, GPS_INS, LIDAR and AUTOPILOT, and drops the variances of NAIVE
_POSITION_SRC_ESTIMATOR = 6
_YAW_ERROR = 1.5  # rad, the greatest ArduPilot counts with; the attitude sent means nothing
_FIXED, _PREDICTED = 100, 50  # quality, per cent; -1 is "failed" and dropped, 0 "unknown"

_SECOND_RECEIVER = 1  # gps_id: the first is the autopilot's own
_FIX_3D = 3
_IGNORE_VERTICAL_VELOCITY = 16  # GPS_INPUT_IGNORE_FLAGS
_SATELLITES, _DOP = 6, 1.0
"""There are none: ArduPilot checks for 6 and 2.5. The least, lest it prefer us to a receiver with a fix."""
_GPS_EPOCH_S, _LEAP_S = 315_964_800, 18  # of UNIX time; GPS time is UTC and 18 s since 2017
_WEEK_MS, _WEEKS = 604_800_000, 1 << 16

_MODES = {Mode.INITIALISING: 0, Mode.FIXED: 1, Mode.PREDICTING: 2, Mode.UNTRUSTED: 3}  # NAVIGATION_MODE
_ESTIMATORS = ("none", "fusion", "minimax", "kalman", "restrictive", "smoother", "polynomial")
_SOURCES = {  # NAVIGATION_SOURCE
    Source.INERTIAL: 1,
    Source.GNSS: 2,
    Source.AZIMUTH: 8,
    Source.RANGE: 16,
    Source.AIR_DATA: 32,
}


class Unsent(Exception):
    """A message that cannot be made honestly, and why."""


class Receiver(NamedTuple):
    """Who is told, and what only the link and the service know.

    `origin` is the autopilot's last local origin, `geoid` the height of mean sea level above the ellipsoid
    here (m) where a receiver tells it, `sensor_id` PX4's EKF2_AGP0_ID, `unix_ns` UTC less our clock (ns)
    where it is known, `rejected` the count of measurements not used.
    """

    autopilot: Autopilot
    system: int
    component: int = 1
    origin: LocalOrigin | None = None
    geoid: float | None = None
    sensor_id: int = 1
    unix_ns: int | None = None
    rejected: int = 0


def encode(position: Position, receiver: Receiver, name: str) -> Message:
    """The message called `name` (a key of `ENCODERS`). `Unsent` where it would not be honest."""
    return ENCODERS[name](position, receiver)


def odometry(position: Position, receiver: Receiver) -> Message:
    """ODOMETRY: the position alone, counted from the autopilot's origin by the autopilot's own projection.

    Velocity and rates are NaN, so that they are not used.
    """
    x, y, z = _local(position, receiver)
    ardupilot = receiver.autopilot == "ardupilot"
    nan = math.nan
    return dialect.new(
        "ODOMETRY",
        time_usec=position.t_ns // 1000,
        frame_id=_LOCAL_FRD if ardupilot else _LOCAL_NED,
        child_frame_id=_BODY_FRD,
        x=x,
        y=y,
        z=z,
        # PX4 leaves out an attitude of NaN. ArduPilot converts it to angles first: "none" is no rotation.
        q=[1.0, 0.0, 0.0, 0.0] if ardupilot else [nan] * 4,
        vx=nan,
        vy=nan,
        vz=nan,
        rollspeed=nan,
        pitchspeed=nan,
        yawspeed=nan,
        pose_covariance=_covariance(position, ardupilot),
        velocity_covariance=[nan] + [0.0] * 20,
        reset_counter=position.resets % 256,
        estimator_type=_ESTIMATOR_UNKNOWN,
        quality=_FIXED if position.fixed else _PREDICTED,
    )


def vision_position_estimate(position: Position, receiver: Receiver) -> Message:
    """VISION_POSITION_ESTIMATE: the same local metres and covariance, north, east, down for both makes."""
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
        covariance=_covariance(position, ardupilot),
        reset_counter=position.resets % 256,
    )


def _local(position: Position, receiver: Receiver) -> tuple[float, float, float]:
    """North, east, down from the autopilot's origin, m."""
    origin = receiver.origin
    if origin is None:
        raise Unsent("the autopilot's local origin is not known")
    if receiver.autopilot == "ardupilot" and position.sigma > GREATEST_ERROR_M:
        raise Unsent(f"its accuracy is worse than the {GREATEST_ERROR_M:g} m that ArduPilot can be told")
    point = Geodetic(position.lat, position.lon, position.alt_msl)
    start = Geodetic(origin.lat, origin.lon, origin.alt_msl)
    return geodetic_to_local(_projection(origin), start, point)


def _projection(origin: LocalOrigin) -> Projection:
    for known in ("ardupilot", "px4", "tangent"):
        if origin.projection == known:
            return known
    raise ValueError(f"unknown local projection {origin.projection!r}: choose ardupilot, px4 or tangent")


def _covariance(position: Position, ardupilot: bool) -> list[float]:
    """Upper triangle of 6 x 6, row by row.

    For ArduPilot the horizontal accuracy: it reads one number for all axes, A = cbrt(c0^2 + c6^2 + c11^2), so
    A metres are said by c0 = c6 = c11 = sqrt(A^3 / 3), and so for the angles. For others the true variances
    of the position, and none of the attitude.
    """
    covariance = [0.0] * 21
    if ardupilot:
        covariance[0] = covariance[6] = covariance[11] = math.sqrt(position.sigma**3 / 3.0)
        covariance[15] = covariance[18] = covariance[20] = math.sqrt(_YAW_ERROR**3 / 3.0)
        return covariance
    covariance[0], covariance[1], covariance[6] = position.covariance
    covariance[11] = position.variance_down
    covariance[15:] = [math.nan] * 6
    return covariance


def gps_input(position: Position, receiver: Receiver) -> Message:
    """GPS_INPUT as ArduPilot's second receiver, as of `GPS_LAG_NS` before it arrives.

    With our velocity, always: a message with the ignore flags leaves ArduPilot the velocity of the last one
    without them, and one that never has any is taken for standing still (51 m r.m.s. where a true velocity
    gave 4.4 m). It is ours to give: no channel that takes part of the autopilot's may feed it.
    """
    if receiver.unix_ns is None:
        raise Unsent("the time of day is not known")
    if position.sigma > GREATEST_ERROR_M:
        raise Unsent(f"its accuracy is worse than the {GREATEST_ERROR_M:g} m that ArduPilot can be told")
    if position.sigma_velocity is None:
        raise Unsent("the accuracy of its velocity is not known")
    then = position.at(position.t_ns - GPS_LAG_NS)
    gps_ms = (position.t_ns + receiver.unix_ns) // 1_000_000 + (_LEAP_S - _GPS_EPOCH_S) * 1000
    if not _WEEK_MS <= gps_ms < _WEEKS * _WEEK_MS:
        raise Unsent("the time of day is not known")
    north, east, _ = position.v_n
    return dialect.new(
        "GPS_INPUT",
        time_usec=position.t_ns // 1000,
        gps_id=_SECOND_RECEIVER,
        ignore_flags=_IGNORE_VERTICAL_VELOCITY,
        time_week_ms=gps_ms % _WEEK_MS,
        time_week=gps_ms // _WEEK_MS,
        fix_type=_FIX_3D,
        lat=_deg_e7(then.lat),
        lon=_deg_e7(then.lon),
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
    """GLOBAL_POSITION_SENSOR, `eph` and `epv` honest."""
    return dialect.new(
        "GLOBAL_POSITION_SENSOR",
        target_system=receiver.system,
        target_component=receiver.component,
        id=receiver.sensor_id,
        time_usec=position.t_ns // 1000,
        source=_POSITION_SRC_ESTIMATOR,
        lat=_deg_e7(position.lat),
        lon=_deg_e7(position.lon),
        alt_ellipsoid=math.nan if receiver.geoid is None else position.alt_msl + receiver.geoid,
        alt=position.alt_msl,
        eph=position.sigma,
        epv=math.sqrt(position.variance_down),
    )


def external_position_estimate(position: Position, receiver: Receiver) -> Message:
    """MAV_CMD_EXTERNAL_POSITION_ESTIMATE, in COMMAND_INT, which alone takes it.

    Both makes take frame 5 (PX4 no other), and a height of NaN (ArduPilot no other). A `param1` of NaN kills
    ArduPilot; it is rounded down to the single precision of the wire, because a stamp that is late would
    move the clock that all messages of the link share.
    """
    if position.sigma > GREATEST_ERROR_M:
        raise Unsent(f"its accuracy is worse than {GREATEST_ERROR_M:g} m, and it would be taken for true")
    return dialect.new(
        "COMMAND_INT",
        target_system=receiver.system,
        target_component=receiver.component,
        frame=_GLOBAL_INT,
        command=MAV_CMD_EXTERNAL_POSITION_ESTIMATE,
        param1=_single_below(position.t_ns * 1e-9),
        param2=0.0,
        param3=position.sigma,
        param4=0.0,
        x=_deg_e7(position.lat),
        y=_deg_e7(position.lon),
        z=math.nan,
    )


def _single_below(value: float) -> float:
    """The greatest number of single precision that is not above a positive `value`."""
    packed = struct.pack("<f", value)
    single: float = struct.unpack("<f", packed)[0]
    if single > value:
        (bits,) = struct.unpack("<I", packed)
        (single,) = struct.unpack("<f", struct.pack("<I", bits - 1))
    return single


def navigation_status(solution: Solution, receiver: Receiver) -> Message:
    """NAVIGATION_STATUS, for every solution; unknown is NaN."""
    s = solution
    ahead = s.ahead[:4]
    unused = 4 - len(ahead)
    variance = s.covariance[0] + s.covariance[3]
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
        estimator=_ESTIMATORS.index(s.estimator) if s.estimator in _ESTIMATORS else 0,
        protection=math.nan if s.protection is None else s.protection,
        trust=0 if s.trust is None else s.trust + 1,  # NAVIGATION_TRUST: 0 is "not told"
    )


def _deg_e7(angle: float) -> int:
    return round(math.degrees(angle) * 1e7)


ENCODERS: Mapping[str, Callable[[Position, Receiver], Message]] = {
    "ODOMETRY": odometry,
    "VISION_POSITION_ESTIMATE": vision_position_estimate,
    "GPS_INPUT": gps_input,
    "GLOBAL_POSITION_SENSOR": global_position_sensor,
    "COMMAND_INT": external_position_estimate,
}
"""Every message that a position can be told by; of COMMAND_INT, MAV_CMD_EXTERNAL_POSITION_ESTIMATE."""
