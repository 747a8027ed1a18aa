"""Own channel: dead reckoning by whatever the autopilot's sensors allow, best first.

    imu      specific force turned by the autopilot's attitude, from 3.5 Hz up
    air      airspeed along the nose, where the aircraft flies; without a sensor, a steady one
    foreign  velocity of the autopilot's estimator, alone and only where it is asked for
    hold     the last velocity; hover: a multirotor's, which returns to zero

Airspeed or a multirotor's drag beside the IMU are measurements (see `own_error_model`). No position of the
autopilot's is used. Its velocity comes from the same sensors and GNSS: beside them it was no second witness,
and once GNSS was lost its error, the wind's, was taken for motion.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from msgspec import Struct, structs

from companion.config import Config
from companion.nav.geometry import separation
from companion.navigator import air_data_channel, own_error_model, strapdown_channel
from companion.navigator.air_data_channel import Reckoner
from companion.navigator.channel import DOPPLER_S, Nominal, Transition, moved
from companion.navigator.ground import Ground
from companion.navigator.inertial_track import Point
from companion.navigator.own_error_model import By, Propagator
from companion.navigator.standing import Standing
from companion.navigator.strapdown_channel import Strap
from companion.records import AirData, AirspeedSensor, Gnss, RsbnFix, Vector2, Vector3
from companion.units import G0, SECOND_NS, Floats

#: A driver that is silent for longer hands over to the next.
SILENT_NS: dict[By, int] = {"imu": 600_000_000, "air": 1_500_000_000, "foreign": 2_500_000_000}
ORDER: tuple[By, ...] = ("imu", "air", "foreign")  # or the velocity is held
FRESH_NS = 1_000_000_000  # an attitude older than this turns no airspeed into a velocity
HOLD_M_S_SQRT_S = 4.0  # a turn of 30 degrees of bank changes the velocity by 5.7 m/s in a second
SENSOR_NS = 10_000_000_000  # the word of the autopilot that its airspeed sensor is healthy lasts so long
STEADY_AFTER_NS = 20 * SECOND_NS  # in flight, until the airspeed is steady
LASTING = 0.5  # share of the velocity error of GNSS that lasts for minutes
ONE_WAY = 0.95  # a mean of half a second is so short, by the lengths of its samples, in a turn at 130 deg/s
WEIGHTS = (1.0, 0.5, 0.25)  # of `own_error_model.GRADES`


class AirspeedSums(NamedTuple):
    """Sums over the samples since `start_ns`: nominal velocity, velocity through the air, size of the latter
    (m/s), squares of its steps (m^2/s^2); `last` is its last sample, for the next step.
    """

    start_ns: int
    last: Vector2 | None = None
    samples: int = 0
    velocity: Vector2 = (0.0, 0.0)
    air: Vector2 = (0.0, 0.0)
    speed: float = 0.0
    steps: float = 0.0

    def with_one(self, velocity: Vector2, V: Vector2) -> AirspeedSums:
        """With one more sample (m/s)."""
        return AirspeedSums(
            self.start_ns,
            V,
            self.samples + 1,
            (self.velocity[0] + velocity[0], self.velocity[1] + velocity[1]),
            (self.air[0] + V[0], self.air[1] + V[1]),
            self.speed + math.hypot(*V),
            self.steps + (0.0 if self.last is None else math.dist(self.last, V) ** 2),
        )

    @property
    def is_one_way(self) -> bool:
        """Whether the samples are of one heading or a turn: a mean over a step of it is of neither."""
        return math.hypot(*self.air) >= ONE_WAY * self.speed

    @property
    def scatter(self) -> float:
        """Variance of the mean velocity through the air on each axis, (m/s)^2, if samples are white noise."""
        return self.steps / (4.0 * self.samples**2)


class Wind(NamedTuple):
    """The wind as it was estimated beside a pitot at `t_ns`: north and east (m/s), variance on each axis."""

    t_ns: int
    north: float
    east: float
    variance: float


class Sensors(Struct, frozen=True):
    """Last readings: IMU and attitude, air data, and when each driver was last of use."""

    strap: Strap = Strap()
    air: Reckoner = Reckoner()
    ground: Ground = Ground()
    sensor_ns: int | None = None  # when the autopilot last called its airspeed sensor healthy
    unused_ns: int | None = None  # when it last stated that it does not use it
    pitot_ns: int = -SENSOR_NS  # when the airspeed of a sensor was last used
    winds: tuple[Wind, ...] = ()  # of the last half minute beside a pitot that was used
    steady: AirData | None = None  # the last airspeed that moved the position
    imu_ns: int = -SENSOR_NS
    air_ns: int = -SENSOR_NS
    foreign_ns: int = -SENSOR_NS
    accelerations: tuple[Vector3, ...] = ()  # of the last three samples without a gap
    mean_acceleration: Vector3 = (0.0, 0.0, 0.0)  # of the last seconds, north, east and down
    mean_force: Vector3 = (0.0, 0.0, 0.0)  # specific force in the body, of the same
    sums: AirspeedSums | None = None  # since airspeed was last a measurement
    measured_ns: int = -SENSOR_NS
    multirotor: bool = False
    fixed_wing: bool = False
    hovering: bool = False
    landed: bool = False  # by the autopilot's statement
    standing: Standing = Standing()
    aloft_ns: int | None = None  # since when it flies, a VTOL as an aeroplane, by the autopilot
    steady_m_s: float | None = None  # airspeed of a fixed wing without a sensor; its scale is estimated

    @property
    def held(self) -> By:
        """How the velocity is held without a driver."""
        return "hover" if self.multirotor or self.hovering else "hold"

    def last_ns(self, by: By) -> int:
        """When a driver last gave a sample."""
        return {"imu": self.imu_ns, "air": self.air_ns, "foreign": self.foreign_ns}[by]

    def is_silent(self, by: By, t_ns: int) -> bool:
        """Whether a driver has given no sample for too long; to hold the velocity needs none."""
        return by in ORDER and t_ns - self.last_ns(by) > SILENT_NS[by]

    def leads(self, by: By, t_ns: int) -> bool:
        """Whether no better driver than `by` gives samples now."""
        better = ORDER[: ORDER.index(by)] if by in ORDER else ORDER
        return all(self.is_silent(b, t_ns) for b in better)

    def heading(self) -> float | None:
        """Heading of the last attitude, rad."""
        return None if self.air.attitude is None else self.air.attitude.heading


class OwnChannel:
    """Error model of the own channel with the constants of one configuration."""

    grades = WEIGHTS
    drift, doppler = own_error_model.DRIFT, own_error_model.DOPPLER
    arm = None  # airspeed and attitude are not known to a metre
    velocity_noise = 0.0
    wind = (4, 5)

    def __init__(self, config: Config) -> None:
        air, strapdown, gnss = config.air_data, config.strapdown, config.gnss
        self.settings = own_error_model.Amplitudes(
            wind_m_s=air.wind_m_s,
            wind_change_m_s_sqrt_s=air.wind_change_m_s_sqrt_s,
            scale=0.01 * air.airspeed_percent,
            heading=math.radians(air.heading_deg),
            slow_s=60.0 * air.correlation_min,
            crab=math.radians(air.crab_deg),
            crab_s=air.crab_s,
            gust_m_s=air.gust_m_s,
            gust_s=air.gust_s,
            accelerometer_m_s2=strapdown.accelerometer_m_s2,
            tilt=G0 * math.radians(strapdown.tilt_deg),
            tilt_s=strapdown.tilt_s,
            velocity_noise_m_s_sqrt_s=strapdown.velocity_noise_m_s_sqrt_s,
            drift_m=gnss.sigma_m,
            drift_s=gnss.correlation_s,
            doppler_m_s=LASTING * gnss.sigma_velocity_m_s,
            doppler_s=DOPPLER_S,
            hold_m_s_sqrt_s=HOLD_M_S_SQRT_S,
        )
        self.propagator = Propagator(self.settings)
        self.n = own_error_model.N if config.uses_local_velocity else own_error_model.FOREIGN.start
        self.latency = own_error_model.LATENCY

    def prior(self) -> Floats:
        """First covariances (grades, n, n)."""
        return own_error_model.prior(self.settings)[:, : self.n, : self.n]

    def transition(self, nominal: Nominal) -> Transition:
        """Phi and Q of the interval."""
        assert nominal.interval is not None
        Phi, Q = self.propagator.transition(nominal.interval)
        return Transition(Phi[: self.n, : self.n], Q[:, : self.n, : self.n])


def with_airspeed_sensor(s: Sensors, record: AirspeedSensor) -> Sensors:
    """Remember whether a healthy airspeed sensor is there, and whether the autopilot uses it."""
    unused_ns = s.unused_ns
    if record.used is not None:
        unused_ns = None if record.used else record.t_ns
    return structs.replace(s, sensor_ns=record.t_ns if record.healthy else None, unused_ns=unused_ns)


def airspeed_is_sensed(s: Sensors, record: AirData) -> bool:
    """Whether the airspeed is of a sensor that the autopilot uses too, as far as it states that.

    Without one VFR_HUD carries the estimator's own number.
    """
    if is_switched_off(s, record.t_ns):
        return False
    return _has_airspeed_sensor(s, record.t_ns) if record.sensed is None else record.sensed


def is_switched_off(s: Sensors, t_ns: int) -> bool:
    """Whether the autopilot states that it does not use the airspeed sensor that it has."""
    return s.unused_ns is not None and t_ns - s.unused_ns <= SENSOR_NS


def _has_airspeed_sensor(s: Sensors, t_ns: int) -> bool:
    return s.sensor_ns is not None and t_ns - s.sensor_ns <= SENSOR_NS


def drag_is_sensed(s: Sensors, t_ns: int) -> bool:
    """Whether the accelerometers show the velocity through the air: of a multirotor, in flight.

    One with an airspeed sensor has that instead, unless the autopilot does not use it.
    """
    air = s.air.air
    senses = air is not None and air.sensed is True and t_ns - air.t_ns <= SENSOR_NS
    return s.multirotor and (not (senses or _has_airspeed_sensor(s, t_ns)) or is_switched_off(s, t_ns))


def is_steady(s: Sensors, t_ns: int) -> bool:
    """Whether the airspeed is taken for steady: of a fixed wing, no sensor's having been used lately."""
    aloft = s.aloft_ns is not None and t_ns - s.aloft_ns >= STEADY_AFTER_NS
    return aloft and s.fixed_wing and t_ns - s.pitot_ns > SENSOR_NS


def air_velocity(s: Sensors, record: AirData, alt: float) -> Vector2 | None:
    """Velocity through the air, north and east (m/s); None without a fresh attitude."""
    attitude = s.air.attitude
    if attitude is None or abs(record.t_ns - attitude.t_ns) > FRESH_NS:
        return None
    speed = air_data_channel.true_airspeed(record, s.air.static, alt)
    return own_error_model.air_velocity(speed, attitude.pitch, attitude.heading)


def begin(s: Sensors, fix: Gnss | RsbnFix) -> Nominal | None:
    """Begin the nominal trajectory at the first position, with the velocity of GNSS or none."""
    place = air_data_channel.first_place(fix, s.air.static)
    if place is None:
        return None
    v = (fix.v_n if isinstance(fix, Gnss) else None) or (0.0, 0.0, 0.0)
    point = Point(fix.t_ns, place, (v[0], v[1], 0.0))
    return Nominal(point, (0.0, 0.0), point, own_error_model.begin(s.held, (v[0], v[1])))


def restart(nominal: Nominal, by: By, velocity: Vector2) -> Nominal:
    """Begin the next interval at the nominal point, driven `by` a sensor, at a nominal `velocity` (m/s).

    The wind's shear of an interval that the bank was propagated over is over with it.
    """
    point = nominal.point._replace(v_n=(*velocity, nominal.point.v_n[2]))
    interval = own_error_model.begin(by, velocity)
    if nominal.interval is not None:
        shear = nominal.interval.shear if nominal.pending_s <= 0.0 else 0.0
        interval = interval._replace(shear=shear, airspeed=nominal.interval.airspeed)
    return Nominal(point, nominal.a_n, point, interval)


def carry_on(nominal: Nominal, s: Sensors, t_ns: int) -> Nominal:
    """Carry the nominal trajectory on to `t_ns` by the last sample of its driver."""
    assert nominal.interval is not None
    if nominal.interval.by == "imu":
        return by_imu(nominal, nominal.a_n, s, t_ns)
    return by_velocity(nominal, nominal.interval.velocity, t_ns)


class Reckoned(NamedTuple):
    """Reckoning by airspeed alone: the nominal place at its last sample with the velocity through the air,
    and how far from there it is, north and east (m): by wind 72 km in two hours, too far for one plane.
    """

    track: Nominal
    apart: Vector2


def reckoned(before: Reckoned | None, nominal: Point, velocity: Vector2, t_ns: int) -> Reckoned:
    """Go on to `t_ns` by the velocity through the air (m/s) alone, or begin at the nominal place."""
    nominal = moved(nominal, nominal.v_n[:2], t_ns)
    apart = (0.0, 0.0) if before is None else apart_from(before, nominal, velocity)
    point = nominal._replace(v_n=(*velocity, 0.0))
    return Reckoned(Nominal(point, (0.0, 0.0), point, own_error_model.begin("air", velocity)), apart)


def apart_from(by_air: Reckoned, nominal: Point, velocity: Vector2) -> Vector2:
    """How far reckoning by airspeed, now at `velocity` (m/s), is from a nominal point, north and east (m)."""
    last = by_air.track.point
    half_s = 0.5e-9 * (nominal.t_ns - last.t_ns)
    north, east, _ = separation(nominal.position, last.position)
    return (
        by_air.apart[0] + half_s * (last.v_n[0] + velocity[0]) - north,
        by_air.apart[1] + half_s * (last.v_n[1] + velocity[1]) - east,
    )


def is_old(by_air: Reckoned, t_ns: int) -> bool:
    """Whether reckoning by airspeed has had no sample for too long."""
    return t_ns - by_air.track.t_ns > SILENT_NS["air"]


def by_imu(nominal: Nominal, a_n: Vector2, s: Sensors, t_ns: int) -> Nominal:
    """Go on to `t_ns` by the mean acceleration `a_n` (m/s^2)."""
    assert nominal.interval is not None
    dt = (t_ns - nominal.t_ns) * 1e-9
    noise = strapdown_channel.velocity_variance(s.accelerations, s.mean_acceleration, dt)
    interval = own_error_model.add_imu(nominal.interval, dt, a_n, s.heading() or 0.0, noise)
    return structs.replace(nominal, point=moved(nominal.point, interval.velocity, t_ns), interval=interval)


def by_velocity(nominal: Nominal, velocity: Vector2, t_ns: int) -> Nominal:
    """Go on to `t_ns` by an air or foreign velocity (m/s), or straight on."""
    i = nominal.interval
    assert i is not None
    dt = (t_ns - nominal.t_ns) * 1e-9
    is_held = i.by in own_error_model.HELD
    add = own_error_model.add_held(i, dt) if is_held else own_error_model.add_velocity(i, dt, velocity)
    return structs.replace(nominal, point=moved(nominal.point, add.velocity, t_ns), interval=add)
