"""Every value that flows: immutable records in SI units and radians.

A record knows nothing of MAVLink, files or estimators. Two times stand at its head:

    t_ns     when the value was true, integer nanoseconds on the companion's monotonic clock
    rx_ns    when it reached the companion, same clock (equal to t_ns for what the companion makes itself)

Absent is `None`, never NaN, so that a record survives JSON bit for bit (`encode`, `decode`) and a log
replays exactly. Vectors are tuples in the frame their name ends with. A covariance is the upper triangle,
row by row. Positions are geodetic: latitude and longitude in radians, altitude in metres above the WGS84
ellipsoid, or above mean sea level where the name says `msl` (the geoid is not known on board).
"""

from __future__ import annotations

from enum import IntEnum, IntFlag, StrEnum
from typing import Any, TypeAlias, get_args

import msgspec

Vector2: TypeAlias = tuple[float, float]
Vector3: TypeAlias = tuple[float, float, float]


class Stamped(msgspec.Struct, frozen=True, gc=False, omit_defaults=True):
    """What every record begins with: the time of validity and the time of arrival."""

    t_ns: int
    rx_ns: int


# ---------------------------------------------------------------------------------------------------------
# What sensors and the autopilot say
# ---------------------------------------------------------------------------------------------------------


class Imu(Stamped, frozen=True, gc=False, tag=True):
    """Specific force and angular rate in the body frame, m/s^2 and rad/s."""

    source: int
    f_b: Vector3
    w_b: Vector3


class Attitude(Stamped, frozen=True, gc=False, tag=True):
    """Roll, pitch, heading (true, rad) and body rates (rad/s) as the autopilot has them."""

    roll: float
    pitch: float
    heading: float
    w_b: Vector3 | None = None


class Gnss(Stamped, frozen=True, gc=False, tag=True):
    """One GNSS fix. `fix` is MAVLink's GPS_FIX_TYPE (3 = 3D), `stamp_us` the receiver's own time as sent
    (0 where the autopilot sends none), which tells a new fix from one repeated at the stream's rate.

    Sigmas are per axis: `sigma_horizontal` of north and of east, both metres; velocities NED in m/s.
    """

    receiver: int
    stamp_us: int
    fix: int
    lat: float
    lon: float
    alt_msl: float
    sigma_horizontal: float | None = None
    sigma_vertical: float | None = None
    v_n: Vector3 | None = None
    sigma_velocity: float | None = None
    satellites: int | None = None
    hdop: float | None = None
    alt: float | None = None

    def repeats(self, previous: Gnss) -> bool:
        """Whether this is `previous` sent once more."""
        if self.stamp_us or previous.stamp_us:
            return self.stamp_us == previous.stamp_us
        return (self.lat, self.lon, self.alt_msl, self.v_n) == (
            previous.lat,
            previous.lon,
            previous.alt_msl,
            previous.v_n,
        )


class LocalPosition(Stamped, frozen=True, gc=False, tag=True):
    """The inertial channel: position north, east, down from the local origin (m) and velocity (m/s)."""

    x_n: Vector3
    v_n: Vector3


class LocalOrigin(Stamped, frozen=True, gc=False, tag=True):
    """Where the local position is counted from; `projection` is the autopilot's own flat-earth formula."""

    lat: float
    lon: float
    alt_msl: float
    projection: str = "tangent"


class HomePosition(Stamped, frozen=True, gc=False, tag=True):
    """The autopilot's home (not the local origin)."""

    lat: float
    lon: float
    alt_msl: float


class GlobalPosition(Stamped, frozen=True, gc=False, tag=True):
    """The autopilot's own filtered position and NED velocity."""

    lat: float
    lon: float
    alt_msl: float
    v_n: Vector3
    height_above_home: float
    heading: float | None = None


class AirData(Stamped, frozen=True, gc=False, tag=True):
    """Airspeed (m/s, true where `true`, else indicated or equivalent as the autopilot sends it) and climb."""

    airspeed: float
    true: bool = False
    groundspeed: float | None = None
    climb: float | None = None
    heading: float | None = None
    alt_msl: float | None = None


class Wind(Stamped, frozen=True, gc=False, tag=True):
    """The autopilot's own wind estimate: velocity of the air over ground, NED, m/s."""

    v_n: Vector3
    sigma: float | None = None


class Pressure(Stamped, frozen=True, gc=False, tag=True):
    """Static and differential pressure (Pa) and temperature (K)."""

    static: float
    differential: float | None = None
    temperature: float | None = None


class FilterStatus(Stamped, frozen=True, gc=False, tag=True):
    """The autopilot's estimator flags; its `accuracy` in metres only where it is honest (PX4)."""

    flags: int
    gnss_glitch: bool
    position_ratio: float
    horizontal_accuracy: float | None = None


class SystemTime(Stamped, frozen=True, gc=False, tag=True):
    """UNIX time of the autopilot at its boot time, both in nanoseconds; `unix_ns` None before GNSS time."""

    boot_ns: int
    unix_ns: int | None = None


class RsbnFix(Stamped, frozen=True, gc=False, tag=True):
    """One answer of a beacon: azimuth at the beacon (rad, true north, clockwise) and slant range (m).

    Either may be absent. `lat`, `lon`, `alt` are the beacon's, `alt` above the ellipsoid.
    """

    beacon: int
    lat: float
    lon: float
    alt: float
    azimuth: float | None
    slant_range: float | None
    sigma_azimuth: float
    sigma_range: float


class Reboot(Stamped, frozen=True, gc=False, tag=True):
    """The autopilot began anew: its origin, its clock and its inertial channel are others from here on."""

    system: int


class Tuning(Stamped, frozen=True, gc=False, tag=True):
    """A ground station set parameters: the whole configuration from here on, as TOML."""

    toml: str


class Truth(Stamped, frozen=True, gc=False, tag=True):
    """What only a simulator knows. It is logged and scored and never reaches the navigator."""

    lat: float
    lon: float
    alt: float
    v_n: Vector3
    attitude: Vector3 | None = None


# ---------------------------------------------------------------------------------------------------------
# What the companion says
# ---------------------------------------------------------------------------------------------------------


class Mode(StrEnum):
    """What the position rests on."""

    INITIALISING = "initialising"  # no inertial channel or no fix yet
    FIXED = "fixed"  # trusted fixes now
    PREDICTING = "predicting"  # no fixes: the inertial error is predicted
    UNTRUSTED = "untrusted"  # the prediction is infeasible, or its bound passed the stated limit


class Trust(IntEnum):
    """How far the position can be trusted, from best to worst."""

    NORMAL = 0  # fixes that check each other, the protection level within its limit
    DEGRADED = 1  # fixes, but a source is excluded or under suspicion, or too little checks them
    PREDICTING = 2  # no fixes: the inertial error is predicted within a guaranteed bound
    UNTRUSTED = 3  # no bound, or one beyond its limit


class Source(IntFlag):
    """What a solution rests on, as bits."""

    INERTIAL = 1
    GNSS = 2
    AZIMUTH = 4
    RANGE = 8
    AIR_DATA = 16


class Prediction(msgspec.Struct, frozen=True, gc=False):
    """The inertial error `ahead_s` from now, north and east (m): the guaranteed r.m.s. bound, and beside it
    what least squares claims under white noise and what it would suffer under the worst correlation."""

    ahead_s: float
    bound_n: Vector2
    claimed_n: Vector2
    worst_n: Vector2


class Solution(Stamped, frozen=True, gc=False, tag=True):
    """The corrected estimate.

    `covariance` is of north, east, down position (m^2), upper triangle. `bound_n` is the guaranteed r.m.s.
    bound north and east (m), None where it cannot be given. `error_n` is the estimated error of the inertial
    channel (m), `velocity_error_n` that of its velocity (m/s); `sigma_velocity` is what is left of it on the
    worse horizontal axis (m/s), gusts included. `horizon_s` counts from the last accepted fix.
    `disagreement` is the greatest distance between the estimators that run (m). `protection` is the
    horizontal protection level (m): with the configured risk the error is beyond it, whichever one source
    lies; `trust` says what else must be known of it.
    """

    mode: Mode
    estimator: str
    lat: float
    lon: float
    alt_msl: float
    v_n: Vector3
    covariance: tuple[float, float, float, float, float, float]
    error_n: Vector2
    velocity_error_n: Vector2
    sources: int
    horizon_s: float
    bound_n: Vector2 | None = None
    velocity_bound_n: Vector2 | None = None
    disagreement: float | None = None
    inertial_age_s: float = 0.0
    ahead: tuple[Prediction, ...] = ()
    sigma_velocity: float | None = None
    protection: float | None = None
    trust: Trust | None = None


class Fix(Stamped, frozen=True, gc=False, tag=True):
    """A maximum-likelihood radio fix, the INS left out: the correction vector INS minus fix, NED (m).

    `covariance` is that of north, east (upper triangle); `cost` the chi-square of its residuals with
    `freedom` degrees of freedom; `normalised` the squared innovation of azimuth and range, or of the GNSS
    position, against the running estimate by its covariance: chi-square with 2 degrees of freedom.
    """

    lat: float
    lon: float
    alt_msl: float
    correction_n: Vector2
    covariance: Vector3
    sources: int
    cost: float
    freedom: int
    iterations: int
    normalised: float | None = None


class Rejection(Stamped, frozen=True, gc=False, tag=True):
    """A measurement not used: which, why, and the numbers behind it (value against limit)."""

    source: str
    reason: str
    value: float | None = None
    limit: float | None = None


class Reset(Stamped, frozen=True, gc=False, tag=True):
    """The navigator began anew, wholly or in part, and why."""

    what: str
    reason: str


class Event(Stamped, frozen=True, gc=False, tag=True):
    """A change of state worth a line: severity is MAVLink's (0 emergency ... 6 info, 7 debug)."""

    severity: int
    text: str


class LinkState(Stamped, frozen=True, gc=False, tag=True):
    """A link's health: counts since start, and the clock mapping to the autopilot."""

    link: str
    connected: bool
    received: int
    lost: int
    bad: int
    dropped: int
    offset_ns: int | None = None
    round_trip_ns: int | None = None


Input: TypeAlias = (
    Imu
    | Attitude
    | Gnss
    | LocalPosition
    | LocalOrigin
    | HomePosition
    | GlobalPosition
    | AirData
    | Wind
    | Pressure
    | FilterStatus
    | SystemTime
    | RsbnFix
    | Reboot
    | Tuning
)
Output: TypeAlias = Solution | Fix | Rejection | Reset | Event
Record: TypeAlias = Input | Output | LinkState | Truth

INPUTS: tuple[type[Stamped], ...] = get_args(Input)
OUTPUTS: tuple[type[Stamped], ...] = get_args(Output)
BY_NAME: dict[str, type[Stamped]] = {kind.__name__: kind for kind in get_args(Record)}

_encoder = msgspec.json.Encoder()
_decoders: dict[str, msgspec.json.Decoder[Any]] = {
    name: msgspec.json.Decoder(kind) for name, kind in BY_NAME.items()
}


def encode(record: Stamped) -> bytes:
    """One record as JSON; doubles keep every bit."""
    return _encoder.encode(record)


def decode(name: str, data: bytes) -> Any:
    """The record of kind `name` from its JSON; mirror of `encode`."""
    return _decoders[name].decode(data)
