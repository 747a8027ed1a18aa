"""Solution -> messages, as the autopilot at the other end takes them.

Each make reads a standard message in its own way (measured on ArduPlane/ArduCopter 4.7 EKF3 and PX4 EKF2);
those ways are written down here and nowhere else. Nothing implausible leaves: a solution that is not
finite, untrusted, or older than the message can say gives no position message. `NAVIGATION_STATUS` always
goes out, for it says just that.

Times are the companion's monotonic clock in microseconds: ArduPilot learns the offset of any steady clock,
PX4 maps it by the TIMESYNC that the session answers with the same clock.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping
from typing import Any, NamedTuple, TypeAlias

from companion.link import dialect
from companion.nav.geometry import Geodetic, Projection, geodetic_to_local
from companion.records import LocalOrigin, Mode, Solution, Source, Vector3
from companion.wire.decode import Autopilot

Message: TypeAlias = Any

MAX_AGE_S = 0.25
"""ArduPilot cannot be told of an older one, and PX4 takes the time of arrival for that of the position."""

_LOCAL_NED, _BODY_FRD, _LOCAL_FRD = 1, 12, 20  # MAV_FRAME
_ESTIMATOR_UNKNOWN = 0  # PX4 refuses GPS, GPS_INS, LIDAR and AUTOPILOT, and drops the variances of NAIVE
_POSITION_SRC_ESTIMATOR = 6
_YAW_ERROR = 1.5  # rad, the greatest ArduPilot counts with; the attitude sent means nothing
_QUALITY = {Mode.FIXED: 100, Mode.PREDICTING: 50}  # per cent; -1 is "failed" and dropped, 0 "unknown"

_MODES = {Mode.INITIALISING: 0, Mode.FIXED: 1, Mode.PREDICTING: 2, Mode.UNTRUSTED: 3}  # NAVIGATION_MODE
_ESTIMATORS = ("none", "fusion", "minimax", "kalman", "restrictive", "smoother", "polynomial")
_SOURCES = {  # NAVIGATION_SOURCE
    Source.INERTIAL: 1,
    Source.GNSS: 2,
    Source.AZIMUTH: 8,
    Source.RANGE: 16,
    Source.AIR_DATA: 32,
}


class Receiver(NamedTuple):
    """Who is told, and what only the link and the service know.

    `origin` is the autopilot's last local origin, `geoid` the height of mean sea level above the ellipsoid
    here (m) where a receiver tells it, `sensor_id` PX4's EKF2_AGP0_ID. `reset_counter` counts the solution's
    jumps, `rejected` the measurements not used.
    """

    autopilot: Autopilot
    system: int
    component: int = 1
    origin: LocalOrigin | None = None
    geoid: float | None = None
    sensor_id: int = 1
    reset_counter: int = 0
    rejected: int = 0


def encode(solution: Solution, receiver: Receiver, names: Iterable[str]) -> tuple[Message, ...]:
    """The messages called `names` (keys of `ENCODERS`) that may be sent for `solution`."""
    made = (ENCODERS[name](solution, receiver) for name in names if name in ENCODERS)
    return tuple(message for message in made if message is not None)


def accuracy(solution: Solution) -> Vector3:
    """One sigma to state north, east, down, m: the covariance's, or the guaranteed bound where greater."""
    north, east = math.sqrt(solution.covariance[0]), math.sqrt(solution.covariance[3])
    if solution.bound_n is not None:
        north, east = max(north, solution.bound_n[0]), max(east, solution.bound_n[1])
    return north, east, math.sqrt(solution.covariance[5])


def _may_be_sent(solution: Solution) -> bool:
    """Whether an autopilot may steer by this: trusted, finite, on the earth, fresh, its accuracy stated."""
    s = solution
    diagonal = (s.covariance[0], s.covariance[3], s.covariance[5])
    numbers = (s.lat, s.lon, s.alt_msl, *s.covariance, *(s.bound_n or ()))
    return (
        s.mode in _QUALITY
        and all(map(math.isfinite, numbers))
        and min(diagonal) > 0.0
        and abs(s.lat) <= 0.5 * math.pi
        and abs(s.lon) <= math.pi
        and 0.0 <= s.inertial_age_s <= MAX_AGE_S
    )


def odometry(solution: Solution, receiver: Receiver) -> Message | None:
    """ODOMETRY: the position alone, counted from the autopilot's origin by the autopilot's own projection.

    None without an origin, or where the solution must not be steered by. Velocity and rates are NaN, so that
    they are not used.
    """
    if receiver.origin is None or not _may_be_sent(solution):
        return None
    origin = receiver.origin
    point = Geodetic(solution.lat, solution.lon, solution.alt_msl)
    x_n = geodetic_to_local(
        _projection(origin), Geodetic(origin.lat, origin.lon, origin.alt_msl), point
    ).tolist()
    ardupilot = receiver.autopilot == "ardupilot"
    nan = math.nan
    return dialect.new(
        "ODOMETRY",
        time_usec=solution.t_ns // 1000,
        frame_id=_LOCAL_FRD if ardupilot else _LOCAL_NED,
        child_frame_id=_BODY_FRD,
        x=x_n[0],
        y=x_n[1],
        z=x_n[2],
        # PX4 leaves out an attitude of NaN. ArduPilot converts it to angles first: "none" is no rotation.
        q=[1.0, 0.0, 0.0, 0.0] if ardupilot else [nan] * 4,
        vx=nan,
        vy=nan,
        vz=nan,
        rollspeed=nan,
        pitchspeed=nan,
        yawspeed=nan,
        pose_covariance=_ardupilot_covariance(solution) if ardupilot else _pose_covariance(solution),
        velocity_covariance=[nan] + [0.0] * 20,
        reset_counter=receiver.reset_counter % 256,
        estimator_type=_ESTIMATOR_UNKNOWN,
        quality=_QUALITY[solution.mode],
    )


def _projection(origin: LocalOrigin) -> Projection:
    for known in ("ardupilot", "px4", "tangent"):
        if origin.projection == known:
            return known
    raise ValueError(f"unknown local projection {origin.projection!r}: choose ardupilot, px4 or tangent")


def _pose_covariance(solution: Solution) -> list[float]:
    """Upper triangle of 6 x 6, row by row: true variances of the position, none of the attitude."""
    north, east, down = accuracy(solution)
    _, c_ne, c_nd, _, c_ed, _ = solution.covariance
    nan = math.nan
    position = [north**2, c_ne, c_nd, 0, 0, 0, east**2, c_ed, 0, 0, 0, down**2, 0, 0, 0]
    return [*map(float, position), nan, nan, nan, nan, nan, nan]


def _ardupilot_covariance(solution: Solution) -> list[float]:
    """ArduPilot reads one number for all axes, A = cbrt(c0^2 + c6^2 + c11^2), and cuts it off at 100 m.

    To say A metres, the worse of both horizontal axes, c0 = c6 = c11 = sqrt(A^3 / 3); so too for the angles.
    """
    north, east, _ = accuracy(solution)
    covariance = [0.0] * 21
    covariance[0] = covariance[6] = covariance[11] = math.sqrt(max(north, east) ** 3 / 3.0)
    covariance[15] = covariance[18] = covariance[20] = math.sqrt(_YAW_ERROR**3 / 3.0)
    return covariance


def global_position_sensor(solution: Solution, receiver: Receiver) -> Message | None:
    """GLOBAL_POSITION_SENSOR, `eph` and `epv` honest; None where the solution must not be steered by."""
    if not _may_be_sent(solution):
        return None
    north, east, down = accuracy(solution)
    return dialect.new(
        "GLOBAL_POSITION_SENSOR",
        target_system=receiver.system,
        target_component=receiver.component,
        id=receiver.sensor_id,
        time_usec=solution.t_ns // 1000,
        source=_POSITION_SRC_ESTIMATOR,
        lat=_deg_e7(solution.lat),
        lon=_deg_e7(solution.lon),
        alt_ellipsoid=math.nan if receiver.geoid is None else solution.alt_msl + receiver.geoid,
        alt=solution.alt_msl,
        eph=max(north, east),
        epv=down,
    )


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
    )


def _deg_e7(angle: float) -> int:
    return round(math.degrees(angle) * 1e7)


ENCODERS: Mapping[str, Callable[[Solution, Receiver], Message | None]] = {
    "ODOMETRY": odometry,
    "GLOBAL_POSITION_SENSOR": global_position_sensor,
    "NAVIGATION_STATUS": navigation_status,
}
"""Every message that a solution can be told by."""
