"""Records: the immutable data types exchanged between packages, in SI units and radians.

A record does not depend on MAVLink, files or estimators. Every record starts with two times:

    t_ns     time of validity, integer nanoseconds on the companion's monotonic clock
    rx_ns    time of arrival, same clock (equal to t_ns for records made by the companion)

A missing value is `None`, never NaN, so that JSON preserves a record bit for bit (`encode`, `DECODERS`) and a
log replays exactly. Vectors are tuples in the frame of their suffix. A covariance is the upper triangle, row
by row. Positions are geodetic: latitude and longitude in radians, altitude in metres above the WGS84
ellipsoid, or above mean sea level with `msl` in the name (the geoid is not known on board).
"""

from __future__ import annotations

import math
from enum import IntEnum, IntFlag, StrEnum
from typing import Any, Literal, TypeAlias, get_args

import msgspec

Vector2: TypeAlias = tuple[float, float]
Vector3: TypeAlias = tuple[float, float, float]
Projection: TypeAlias = Literal["ardupilot", "px4", "tangent"]


class Stamped(msgspec.Struct, frozen=True, gc=False, omit_defaults=True):
    """Base of all records: time of validity and time of arrival."""

    t_ns: int
    rx_ns: int


# ---------------------------------------------------------------------------------------------------------
# Inputs from sensors and the autopilot
# ---------------------------------------------------------------------------------------------------------


class Imu(Stamped, frozen=True, gc=False, tag=True):
    """Specific force and angular rate in the body frame, m/s^2 and rad/s."""

    source: int
    f_b: Vector3
    w_b: Vector3


class Attitude(Stamped, frozen=True, gc=False, tag=True):
    """Roll, pitch, heading (true, rad) and body rates (rad/s) from the autopilot."""

    roll: float
    pitch: float
    heading: float
    w_b: Vector3 | None = None


class Gnss(Stamped, frozen=True, gc=False, tag=True):
    """GNSS fix. `fix` is MAVLink's GPS_FIX_TYPE (3 = 3D). `stamp_us` is the receiver's time as sent (0 if the
    autopilot sends none); it distinguishes a new fix from one repeated at the stream's rate.

    Sigmas are per axis: `sigma_horizontal` of north and of east, m; velocities NED, m/s.
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

    @property
    def has_3d_fix(self) -> bool:
        """Whether the fix is MAVLink's GPS_FIX_TYPE_3D_FIX or better."""
        return self.fix >= 3

    def repeats(self, previous: Gnss) -> bool:
        """Return whether this is `previous` sent again."""
        if self.stamp_us or previous.stamp_us:
            return self.stamp_us == previous.stamp_us
        return (self.lat, self.lon, self.alt_msl, self.v_n) == (
            previous.lat,
            previous.lon,
            previous.alt_msl,
            previous.v_n,
        )


class LocalPosition(Stamped, frozen=True, gc=False, tag=True):
    """Inertial channel: position north, east, down from the local origin (m) and velocity (m/s)."""

    x_n: Vector3
    v_n: Vector3


class LocalOrigin(Stamped, frozen=True, gc=False, tag=True):
    """Origin of the local position; `projection` is the autopilot's local projection."""

    lat: float
    lon: float
    alt_msl: float
    projection: Projection = "tangent"


class HomePosition(Stamped, frozen=True, gc=False, tag=True):
    """The autopilot's home (not the local origin)."""

    lat: float
    lon: float
    alt_msl: float


class GlobalPosition(Stamped, frozen=True, gc=False, tag=True):
    """The autopilot's estimated position and NED velocity."""

    lat: float
    lon: float
    alt_msl: float
    v_n: Vector3
    height_above_home: float
    heading: float | None = None


class AirData(Stamped, frozen=True, gc=False, tag=True):
    """Airspeed (m/s; true if `true`, else indicated or equivalent as sent by the autopilot), climb rate."""

    airspeed: float
    true: bool = False
    groundspeed: float | None = None
    climb: float | None = None
    heading: float | None = None
    alt_msl: float | None = None
    sensed: bool | None = None


class Wind(Stamped, frozen=True, gc=False, tag=True):
    """The autopilot's wind estimate: velocity of the air over ground, NED, m/s."""

    v_n: Vector3
    sigma: float | None = None


class Pressure(Stamped, frozen=True, gc=False, tag=True):
    """Static and differential pressure (Pa) and temperature (K)."""

    static: float
    differential: float | None = None
    temperature: float | None = None


class AirspeedSensor(Stamped, frozen=True, gc=False, tag=True):
    """Whether the autopilot has an airspeed sensor that is present, enabled and healthy.

    `used`: by SYS_STATUS, whether it uses the sensor that is present; None: not stated.
    """

    healthy: bool
    used: bool | None = None


class Vehicle(Stamped, frozen=True, gc=False, tag=True):
    """The kind of vehicle and whether it is in the air; None: not stated.

    `multirotor`: rotors alone hold it up; `fixed_wing`: it has a wing; `hovering`: a VTOL that is not in the
    flight of an aeroplane.
    """

    multirotor: bool | None = None
    flying: bool | None = None
    fixed_wing: bool | None = None
    hovering: bool | None = None


class GnssIntegrity(Stamped, frozen=True, gc=False, tag=True):
    """Jamming and spoofing as the receiver reports them (GNSS_INTEGRITY)."""

    receiver: int
    jamming: int
    spoofing: int

    @property
    def threatened(self) -> bool:
        """Whether jamming or spoofing is indicated, mitigated or not."""
        return self.jamming >= 2 or self.spoofing >= 2


class FilterStatus(Stamped, frozen=True, gc=False, tag=True):
    """The autopilot's estimator flags; `horizontal_accuracy` (m) only if it is meaningful (PX4)."""

    flags: int
    gnss_glitch: bool
    position_ratio: float
    horizontal_accuracy: float | None = None


class SystemTime(Stamped, frozen=True, gc=False, tag=True):
    """UNIX time of the autopilot at its boot time, both in ns; `unix_ns` is None before GNSS time."""

    boot_ns: int
    unix_ns: int | None = None


class RsbnFix(Stamped, frozen=True, gc=False, tag=True):
    """Reply of a beacon: azimuth at the beacon (rad, clockwise from true north) and slant range (m).

    Either may be None. `lat`, `lon`, `alt` are the beacon's position, `alt` above the ellipsoid.
    """

    beacon: int
    lat: float
    lon: float
    alt: float
    azimuth: float | None
    slant_range: float | None
    sigma_azimuth: float
    sigma_range: float


class RangeDifference(Stamped, frozen=True, gc=False, tag=True):
    """Line of position of a hyperbolic system: distance to station a minus distance to station b, m.

    `chain` identifies the pair; altitudes of the stations are above the ellipsoid.
    """

    chain: int
    lat_a: float
    lon_a: float
    alt_a: float
    lat_b: float
    lon_b: float
    alt_b: float
    difference: float
    sigma: float


class StarFix(Stamped, frozen=True, gc=False, tag=True):
    """Altitude and azimuth of a star against the axes of the INS, rad, refraction removed.

    `lat`, `lon`: where the star is in the zenith at that time (declination, and hour angle from Greenwich
    taken east). `azimuth`, from the INS's north clockwise, may be None.
    """

    star: int
    lat: float
    lon: float
    altitude: float
    azimuth: float | None
    sigma_altitude: float
    sigma_azimuth: float


class SecondIns(Stamped, frozen=True, gc=False, tag=True):
    """Position of a second INS, rad; its errors are its own."""

    ins: int
    lat: float
    lon: float


class Reboot(Stamped, frozen=True, gc=False, tag=True):
    """The autopilot rebooted: its origin, clock and inertial channel change."""

    system: int


class TimeStep(Stamped, frozen=True, gc=False, tag=True):
    """The autopilot's times map `step_s` later than before, at once, though its clock was not set.

    Its clock stood still or was slow (a simulator on a busy computer), or the mapping was wrong until now.
    Which of them is not known, nor how far the aircraft has flown meanwhile.
    """

    system: int
    step_s: float


class Tuning(Stamped, frozen=True, gc=False, tag=True):
    """A ground station set parameters: the whole new configuration, as TOML."""

    toml: str


class Resumed(Stamped, frozen=True, gc=False, tag=True):
    """A run of the service ended in flight: its configuration, as TOML, and its navigator's state."""

    toml: str
    state: bytes


class Truth(Stamped, frozen=True, gc=False, tag=True):
    """True state from a simulator; logged and used for scoring, never passed to the navigator."""

    lat: float
    lon: float
    alt: float
    v_n: Vector3
    attitude: Vector3 | None = None


# ---------------------------------------------------------------------------------------------------------
# Outputs of the companion
# ---------------------------------------------------------------------------------------------------------


class Mode(StrEnum):
    """Basis of the position."""

    INITIALISING = "initialising"  # no inertial channel or no fix yet
    FIXED = "fixed"  # trusted fixes available
    PREDICTING = "predicting"  # no fixes: the inertial error is predicted
    UNTRUSTED = "untrusted"  # the prediction is infeasible, or its bound passed the stated limit


class Trust(IntEnum):
    """Trust in the position, from best to worst."""

    NORMAL = 0  # fixes that confirm each other, protection level within its limit
    DEGRADED = 1  # fixes, but a source is excluded or suspected, or nothing confirms them
    PREDICTING = 2  # no fixes: the inertial error is predicted within a guaranteed bound
    UNTRUSTED = 3  # no bound, or a bound above its limit


class Source(IntFlag):
    """Sources of a solution, as bits."""

    INERTIAL = 1
    GNSS = 2
    AZIMUTH = 4
    RANGE = 8
    AIR_DATA = 16


class Prediction(msgspec.Struct, frozen=True, gc=False):
    """Inertial error predicted `ahead_s` from now, straight on, north and east (m): the guaranteed r.m.s.
    bound, the expected r.m.s. error, and the least bound that any estimate could have."""

    ahead_s: float
    bound_n: Vector2
    claimed_n: Vector2
    optimum_n: Vector2 = (math.nan, math.nan)


class Bounds(msgspec.Struct, frozen=True, gc=False):
    """Guaranteed r.m.s. bounds beside that of the position that is sent, north and east.

    `optimum_n` is the least bound of the position that any estimate could have (m), proved to within the
    relative `gap`; `tilt_n` (rad) and `drift_n` (rad/s) are of an INS. All are `widening` times wider than
    stated, more than 1 where the fixes contradict the stated errors.
    """

    optimum_n: Vector2
    gap: float
    widening: float
    tilt_n: Vector2 | None = None
    drift_n: Vector2 | None = None


#: Filters that may run beside the leading estimator, in the order of NAVIGATION_STATUS.
PARALLEL = ("minimax_filter", "restrictive")


class ParallelEstimate(msgspec.Struct, frozen=True, gc=False):
    """Error of the inertial channel by a filter that runs beside the leading estimator, north and east (m),
    and the covariance that it claims: nn, ne, ee (m^2)."""

    estimator: str
    error_n: Vector2
    covariance: Vector3


class Solution(Stamped, frozen=True, gc=False, tag=True):
    """Corrected estimate.

    `covariance` is of north, east, down position (m^2), upper triangle. `bound_n` is the guaranteed r.m.s.
    bound north and east (m), None if there is none. `error_n` is the estimated error of the inertial channel
    (m), `velocity_error_n` of its velocity (m/s); `sigma_velocity` is the remaining velocity sigma on the
    worse horizontal axis (m/s), gusts included. `horizon_s` is the time since the last accepted fix.
    `disagreement` is the greatest distance between the running estimators (m). `protection` is the horizontal
    protection level (m): the error exceeds it with the configured risk, even if any one source is faulty.
    `false_sources`: once a second, the probability that each source is false, by name. `contradicted`: by a
    first GNSS, where it began at one beacon. `restarts`: how often the position was given up.
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
    gnss_false: float | None = None
    witness: bool = False
    false_sources: tuple[tuple[str, float], ...] = ()
    bounds: Bounds | None = None
    contradicted: bool = False
    restarts: int = 0
    parallel: tuple[ParallelEstimate, ...] = ()

    @property
    def status_word(self) -> str:
        """The state in one word for users: normal, degraded, predicting, recovering or untrusted.

        It is the trust, or "recovering" while fixes are back and the trust is still that of the outage. The
        mode if the trust is unknown.
        """
        if self.trust is None:
            return str(self.mode)
        if self.mode is Mode.FIXED and self.trust is Trust.PREDICTING:
            return "recovering"
        return self.trust.name.lower()


class Fix(Stamped, frozen=True, gc=False, tag=True):
    """Maximum-likelihood radio fix without the INS: correction vector, INS minus fix, north and east (m).

    `covariance` is of north, east (upper triangle); `cost` the chi-square of its residuals with
    `degrees_of_freedom`.
    """

    lat: float
    lon: float
    alt_msl: float
    correction_n: Vector2
    covariance: Vector3
    sources: int
    cost: float
    degrees_of_freedom: int
    iterations: int


class Smoothed(Stamped, frozen=True, gc=False, tag=True):
    """Position from all fixes of a flight, later ones included (`companion smooth`).

    `covariance` is of north, east (upper triangle, m^2); `error_n` the error of the inertial channel that was
    taken off (m).
    """

    lat: float
    lon: float
    alt_msl: float
    covariance: Vector3
    error_n: Vector2


class Rejection(Stamped, frozen=True, gc=False, tag=True):
    """Measurement that was not used: source, reason, and the value with its limit."""

    source: str
    reason: str
    value: float | None = None
    limit: float | None = None


class Reset(Stamped, frozen=True, gc=False, tag=True):
    """Full or partial reset of the navigator, and its reason."""

    what: str
    reason: str


class Severity(IntEnum):
    """Severity of an event: MAVLink's MAV_SEVERITY, which are the levels of syslog."""

    EMERGENCY = 0
    ALERT = 1
    CRITICAL = 2
    ERROR = 3
    WARNING = 4
    NOTICE = 5
    INFO = 6
    DEBUG = 7


class Event(Stamped, frozen=True, gc=False, tag=True):
    """Change of state reported to the user; `severity` is a `Severity`."""

    severity: int
    text: str


class LinkState(Stamped, frozen=True, gc=False, tag=True):
    """State of a link: counts since the start, and the clock offset to the autopilot."""

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
    | AirspeedSensor
    | Vehicle
    | GnssIntegrity
    | Wind
    | Pressure
    | FilterStatus
    | SystemTime
    | RsbnFix
    | RangeDifference
    | StarFix
    | SecondIns
    | Reboot
    | TimeStep
    | Tuning
    | Resumed
)
Output: TypeAlias = Solution | Fix | Rejection | Reset | Event
Record: TypeAlias = Input | Output | LinkState | Truth | Smoothed

INPUTS: tuple[type[Stamped], ...] = get_args(Input)
OUTPUTS: tuple[type[Stamped], ...] = get_args(Output)
BY_NAME: dict[str, type[Stamped]] = {kind.__name__: kind for kind in get_args(Record)}

_encoder = msgspec.json.Encoder()
#: Decoders of the JSON of `encode`, by the name of the record's type.
DECODERS: dict[str, msgspec.json.Decoder[Any]] = {
    name: msgspec.json.Decoder(kind) for name, kind in BY_NAME.items()
}


def encode(record: Stamped) -> bytes:
    """Encode a record as JSON; doubles are preserved bit for bit."""
    return _encoder.encode(record)
