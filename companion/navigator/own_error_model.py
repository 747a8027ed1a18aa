"""Own channel: error model of airspeed, attitude, IMU and a foreign velocity in one linear state.

The nominal trajectory is integrated from what the autopilot streams, the best source first:

    imu      specific force turned to the level frame by the autopilot's attitude
    air      the velocity through the air: airspeed along the nose
    foreign  the velocity of another estimator (LOCAL_POSITION_NED not fed by us)
    hold     the last velocity
    hover    the last velocity of a multirotor, which returns to zero

Errors are nominal minus truth, north and east. The wind is the wind itself, not an error.

    dp' = dv
    dv' = tilt + R(heading) accelerometer + (versine + heading J) a + white (imu)
    dv  = -wind + (scale + versine + (heading + crab) J) V + turbulence     (air; not integrated, substituted)
    dv  = foreign + white                                                   (foreign; substituted)
    dv' = white                                                             (hold)
    dv' = -dv / HOVER_S + white                                             (hover; the nominal one as well)

V (2,) is the velocity through the air, a (2,) the acceleration, J = [[0, -1], [1, 0]]. In the substituted
cases the velocity error is no memory of its own: it follows from the other states at each moment, so the
sensor is used once. In the IMU case airspeed is a measurement (`airspeed_row`), and a change of wind does
not move the aircraft: it shows in the difference of accelerometers and airspeed.

`heading` is the sine of what is wrong with the heading for minutes, `versine` is 1 less its cosine: the pair
is linear at any angle, where the angle alone ends at about 45 deg. That both are of one angle is a
measurement (`estimate.bank.on_circle`). `versine` is constant, and next to nothing where the heading is
little off. `crab` is what is wrong for seconds (bank-dependent compass error, sideslip); only `crab` is not
shared with the IMU. `tilt` (m/s^2) is gravity seen through the tilt of the attitude. A grade states how many
times coarser attitude and IMU are than the settings; one Phi serves all grades and Q has one layer for each.

Beside the IMU the part of the wind that lasts a second is a state, `gust`: a step of the wind differs from
the gust of half a second ago by more than a gust changes, so it shows at once. White noise would hide it for
ten seconds. By airspeed alone gusts cannot be told from motion: turbulence is white noise there, with its
part that lasts for seconds. A steady airspeed wanders for longer, along the nose: that is the `gust` then,
and the velocity of GNSS shows it.

`doppler` is what is wrong with the velocity of GNSS for minutes. As white noise alone a thousand fixes make a
velocity that is 0.05 m/s off beyond doubt, and then the position of GNSS, which contradicts it, false.

The drag of a multirotor in the plane of its rotors is proportional to its velocity through the air, and its
accelerometers measure it: -f / `drag` is a velocity as airspeed is one, in both directions. `scale` is then
what is wrong with the drag's coefficient, and the error of the accelerometers counts.

An `Interval` sums what Phi needs over many samples (a dozen numbers), so that Phi and Q are made once per
measurement. Not modelled: Schuler loop, vertical channel (heights are pressure altitudes), Coriolis (it is
0.003 m/s^2 at 25 m/s; put it into `a_n` for fast aircraft).
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Literal, NamedTuple

import numpy as np

from companion.records import Vector2
from companion.units import G0, Floats

By = Literal["imu", "air", "foreign", "hold", "hover"]
HELD: tuple[By, By] = ("hold", "hover")  # without a driver
Airspeed = Literal["pitot", "drag", "steady"]
"""What the velocity through the air is taken from; `scale` is what is wrong with it."""

POSITION, VELOCITY, WIND = slice(0, 2), slice(2, 4), slice(4, 6)
SCALE, HEADING, CRAB = 6, 7, 8
TILT, ACCELEROMETER, DRIFT, GUST = slice(9, 11), slice(11, 13), slice(13, 15), slice(15, 17)
DOPPLER, LATENCY, VERSINE = slice(17, 19), 19, 20
FOREIGN = slice(21, 23)  # last: left out where no foreign velocity is used
N = 23

AIRSPEED_NOISE_M_S = 1.0  # of half a second's mean: pitot, angle of attack, sideslip
AIRSPEED_MANOEUVRE_S = 0.2  # and per acceleration; 0.14 to 0.17 in an aerobatic flight (TestLog2)
LEAST_M_S = 0.1  # of an airspeed
LASTING = 2.0  # turbulence by airspeed alone: how many times longer than the gusts it lasts
DRAG_SCALE = 0.25  # of a multirotor's drag; it changes with speed too
STEADY_SCALE = 0.4  # of an airspeed without a sensor, at first: speed over ground in an unknown wind
SCALE_CHANGE, SCALE_CHANGE_S = 0.25, 1800.0  # what either may change, and in what time
#: About it an airspeed without a sensor wanders by so much for so long (UMN: 2.4 m/s within 10 s).
STEADY_M_S, STEADY_S = 3.5, 8.0
HOVER_S = 5.0  # for so long a multirotor keeps a velocity
ALONG = 1.2  # and how much greater it is along the nose than across


class Amplitudes(NamedTuple):
    """Standard deviations and correlation times of the error model; SI and radians."""

    position_m: float = 2000.0
    velocity_m_s: float = 30.0
    wind_m_s: float = 8.0
    wind_change_m_s_sqrt_s: float = 0.05
    scale: float = 0.03
    heading: float = math.radians(1.5)
    slow_s: float = 600.0  # correlation of scale and heading
    crab: float = math.radians(2.0)
    crab_s: float = 20.0
    tilt: float = G0 * math.radians(2.0)  # m/s^2
    tilt_s: float = 30.0
    accelerometer_m_s2: float = 0.1
    accelerometer_s: float = 600.0
    velocity_noise_m_s_sqrt_s: float = 0.15
    hold_m_s_sqrt_s: float = 2.0
    gust_m_s: float = 1.2
    gust_s: float = 1.0
    drift_m: float = 1.5
    drift_s: float = 300.0
    doppler_m_s: float = 0.05
    doppler_s: float = 600.0
    foreign_m_s: float = 0.3
    foreign_change_m_s_sqrt_s: float = 0.5  # 1.2 km in three minutes, as an autopilot without GNSS
    foreign_noise_m_s: float = 0.5
    latency_s: float = 0.15  # sigma about the configured latency
    latency_change_s_sqrt_s: float = 1e-4

    @property
    def turbulence_s(self) -> float:
        """Correlation time of turbulence by airspeed alone."""
        return LASTING * self.gust_s


#: Nodes and weights of Gauss's integral from 0 to 1.
GAUSS = ((0.5 - math.sqrt(0.15), 5.0 / 18.0), (0.5, 8.0 / 18.0), (0.5 + math.sqrt(0.15), 5.0 / 18.0))
#: How many times coarser than the settings attitude, IMU and a held velocity are.
GRADES = (1.0, 4.0, 8.0)
#: The coarsest grade is no finer than that of these: that the settings are wrong is a hypothesis too.
USUAL = Amplitudes()


class Interval(NamedTuple):
    """Sums over the samples since the last measurement.

    `velocity` (m/s) is the nominal one now; `moved` (m) how far the nominal went. c1, s1 are the integrals of
    cosine and sine of the heading, c2, s2 those of c1, s1; n1, e1 of the acceleration, n2, e2 of n1, e1. For
    `air`, n1 and e1 are the way through the air (m) and `V` is the air velocity at the end. `noise` is the
    variance of the velocity by the noise of the samples, (m/s)^2, `shear` that of the wind by height.
    `airspeed` is what the velocity through the air is taken from.
    """

    by: By
    velocity: Vector2
    moved: Vector2 = (0.0, 0.0)
    seconds: float = 0.0
    c1: float = 0.0
    s1: float = 0.0
    c2: float = 0.0
    s2: float = 0.0
    n1: float = 0.0
    e1: float = 0.0
    n2: float = 0.0
    e2: float = 0.0
    V: Vector2 = (0.0, 0.0)
    noise: float = 0.0
    shear: float = 0.0
    airspeed: Airspeed = "pitot"

    @property
    def by_sensed_air(self) -> bool:
        """Whether an airspeed that may be false moves the nominal trajectory."""
        return self.by == "air" and self.airspeed == "pitot"


class Row(NamedTuple):
    """y (m,) = H (m, n) x + noise of covariance R (m, m); the innovation is y - H x."""

    y: Floats
    H: Floats
    R: Floats


# ---------------------------------------------------------------------------------------------------------
# Nominal trajectory
# ---------------------------------------------------------------------------------------------------------


def air_velocity(true_airspeed: float, pitch: float, heading: float) -> Vector2:
    """Velocity through the air along the nose, north and east, m/s.

    Never zero: what a false airspeed of zero is off by has the direction of the nose.
    """
    level = max(true_airspeed, LEAST_M_S) * math.cos(pitch)
    return level * math.cos(heading), level * math.sin(heading)


def begin(by: By, velocity: Vector2) -> Interval:
    """Begin an interval at a nominal velocity (m/s).

    For `air` the nominal velocity is the velocity through the air, for `foreign` the foreign one: pass it.
    """
    return Interval(by, velocity, V=velocity)


def add_imu(i: Interval, dt: float, a_n: Vector2, heading: float, noise: float) -> Interval:
    """Add one IMU step: `a_n` (m/s^2) and `heading` (rad) are means over `dt` (s).

    `noise` (m/s)^2 is what the noise of the samples adds to the variance of the velocity on each axis.
    """
    c, s = math.cos(heading) * dt, math.sin(heading) * dt
    vn, ve = a_n[0] * dt, a_n[1] * dt
    v, m = i.velocity, i.moved
    return Interval(
        "imu",
        (v[0] + vn, v[1] + ve),
        (m[0] + (v[0] + 0.5 * vn) * dt, m[1] + (v[1] + 0.5 * ve) * dt),
        i.seconds + dt,
        i.c1 + c,
        i.s1 + s,
        i.c2 + (i.c1 + 0.5 * c) * dt,
        i.s2 + (i.s1 + 0.5 * s) * dt,
        i.n1 + vn,
        i.e1 + ve,
        i.n2 + (i.n1 + 0.5 * vn) * dt,
        i.e2 + (i.e1 + 0.5 * ve) * dt,
        i.V,
        i.noise + noise,
        i.shear,
        i.airspeed,
    )


def add_velocity(i: Interval, dt: float, velocity: Vector2) -> Interval:
    """Add one sample of the air velocity or of the foreign velocity (m/s), `dt` (s) after the last."""
    n, e = 0.5 * (i.velocity[0] + velocity[0]) * dt, 0.5 * (i.velocity[1] + velocity[1]) * dt
    moved = (i.moved[0] + n, i.moved[1] + e)
    return i._replace(
        velocity=velocity, moved=moved, seconds=i.seconds + dt, n1=i.n1 + n, e1=i.e1 + e, V=velocity
    )


def add_held(i: Interval, dt: float) -> Interval:
    """Go straight on for `dt` (s), a multirotor ever more slowly."""
    kept, way = _first_order(dt, HOVER_S)[:2] if i.by == "hover" else (1.0, dt)
    n, e = i.velocity
    return i._replace(
        velocity=(kept * n, kept * e),
        moved=(i.moved[0] + n * way, i.moved[1] + e * way),
        seconds=i.seconds + dt,
    )


# ---------------------------------------------------------------------------------------------------------
# Propagation
# ---------------------------------------------------------------------------------------------------------


def _correlated(s: Amplitudes) -> Iterator[tuple[int | slice, float, Floats]]:
    """Yield the states that are correlated over a time, that time (s), and their sigmas by grade."""
    for where, tau, sigma, usual in (
        (SCALE, s.slow_s, s.scale, None),
        (HEADING, s.slow_s, s.heading, USUAL.heading),
        (CRAB, s.crab_s, s.crab, USUAL.crab),
        (TILT, s.tilt_s, s.tilt, USUAL.tilt),
        (ACCELEROMETER, s.accelerometer_s, s.accelerometer_m_s2, USUAL.accelerometer_m_s2),
        (DRIFT, s.drift_s, s.drift_m, None),
        (DOPPLER, s.doppler_s, s.doppler_m_s, None),
        (GUST, s.gust_s, s.gust_m_s, None),
    ):
        amplitudes = np.full(len(GRADES), sigma)
        if usual is not None:
            amplitudes *= GRADES
            amplitudes[-1] = max(amplitudes[-1], GRADES[-1] * usual)
        yield where, tau, amplitudes


def prior(settings: Amplitudes) -> Floats:
    """Return the first covariances (grades, n, n); the estimate is zero."""
    s = settings
    sigma = np.empty((len(GRADES), N))
    sigma[:, POSITION], sigma[:, VELOCITY], sigma[:, WIND] = s.position_m, s.velocity_m_s, s.wind_m_s
    sigma[:, FOREIGN], sigma[:, LATENCY] = s.foreign_m_s, s.latency_s
    sigma[:, VERSINE] = 1e-6  # not zero: the smoother inverts the covariance
    for where, _, amplitudes in _correlated(s):
        sigma.T[where] = amplitudes
    return np.asarray(np.square(sigma)[:, :, None] * np.eye(N), dtype=np.float64)


class Propagator:
    """Makes Phi and Q of intervals; holds the constants of one configuration, no state."""

    def __init__(self, settings: Amplitudes) -> None:
        self.settings = s = settings
        rate, density = np.zeros(N), np.zeros((len(GRADES), N))
        for where, tau, amplitudes in _correlated(s):
            rate[where] = 1.0 / tau
            density.T[where] = (2.0 / tau) * amplitudes**2
        density[:, WIND] = s.wind_change_m_s_sqrt_s**2
        density[:, FOREIGN] = s.foreign_change_m_s_sqrt_s**2
        density[:, LATENCY] = s.latency_change_s_sqrt_s**2
        self._rate, self._density = rate, density
        self._coarser2 = np.square(GRADES)
        self._diagonal = np.arange(N)
        self._wind_seen = np.zeros((N, N))
        for k in (0, 1):
            self._wind_seen[2 + k, 2 + k] = 1.0
            self._wind_seen[2 + k, 4 + k] = self._wind_seen[4 + k, 2 + k] = -1.0

    def transition(self, i: Interval) -> tuple[Floats, Floats]:
        """Return Phi (n, n) and Q (grades, n, n) of an interval of about a second."""
        T = i.seconds
        decay = np.exp(-T * self._rate)
        Phi = np.zeros((N, N))
        Phi[self._diagonal, self._diagonal] = decay
        Q = np.zeros((len(GRADES), N, N))
        Q[:, self._diagonal, self._diagonal] = self._density * self._grown(T, decay)
        Q[:, WIND, WIND] += i.shear * np.eye(2)
        if i.airspeed != "pitot":
            Phi[SCALE, SCALE] = math.exp(-T / SCALE_CHANGE_S)
            Q[:, SCALE, SCALE] = 2.0 * SCALE_CHANGE**2 / SCALE_CHANGE_S * T
        if i.airspeed == "steady":
            stays = math.exp(-T / STEADY_S)
            Phi[GUST, GUST] = stays * np.eye(2)
            Q[:, GUST, GUST] = STEADY_M_S**2 * (1.0 - stays * stays) * np.eye(2)
        if i.by == "imu":
            self._inertial(i, T, Phi, Q)
        elif i.by == "air":
            self._air(i, T, Phi, Q)
        elif i.by == "foreign":
            self._foreign(T, Phi, Q)
        elif i.by == "hover":
            self._hovering(T, Phi, Q)
        else:
            _velocity_noise(Phi, Q, T, self.settings.hold_m_s_sqrt_s**2 * self._coarser2)
        return Phi, Q

    def _grown(self, T: float, decay: Floats) -> Floats:
        """Variance that unit density adds to each state in `T` seconds."""
        rate = np.where(self._rate > 0.0, self._rate, 1.0)
        return np.where(self._rate > 0.0, (1.0 - decay * decay) / (2.0 * rate), T)

    def _inertial(self, i: Interval, T: float, Phi: Floats, Q: Floats) -> None:
        half, tilt = 0.5 * T * T, self._density[:, TILT.start]
        noise = self.settings.velocity_noise_m_s_sqrt_s**2 + (i.noise / T if T > 0.0 else 0.0)
        _velocity_noise(Phi, Q, T, noise * self._coarser2)
        Phi[0, 9] = Phi[1, 10] = half
        Phi[2, 9] = Phi[3, 10] = T
        Phi[0:4, 11] = i.c2, i.s2, i.c1, i.s1
        Phi[0:4, 12] = -i.s2, i.c2, -i.s1, i.c1
        Phi[0:4, HEADING] = -i.e2, i.n2, -i.e1, i.n1
        Phi[0:4, VERSINE] = i.n2, i.e2, i.n1, i.e1
        come_up = tilt[:, None, None] * _come_up(T, self.settings.tilt_s)
        for k in (0, 1):  # the tilt that comes up within the interval
            at = np.array((k, 2 + k, 9 + k))
            Q[:, 9 + k, 9 + k] = 0.0
            Q[:, at[:, None], at] += come_up

    def _air(self, i: Interval, T: float, Phi: Floats, Q: Floats) -> None:
        s = self.settings
        n, e = i.V
        Phi[2, 2] = Phi[3, 3] = 0.0
        Phi[0, 4] = Phi[1, 5] = -T
        Phi[2, 4] = Phi[3, 5] = -1.0
        Phi[0:4, SCALE] = Phi[0:4, VERSINE] = i.n1, i.e1, n, e
        Phi[0:4, HEADING] = Phi[0:4, CRAB] = -i.e1, i.n1, -e, n
        lasting = s.turbulence_s
        along = s.gust_m_s if i.airspeed == "pitot" else 0.0
        gust = nose_covariance(i.V, along, s.gust_m_s / ALONG)
        both = gust * (-lasting * math.expm1(-T / lasting))  # integral of the gust times the gust at the end
        crab = self._density[:, CRAB] * T
        # wind and crab that come up within the interval: the velocity follows
        Q += (T * s.wind_change_m_s_sqrt_s**2 + i.shear) * self._wind_seen
        Q[:, 0:2, 0:2] += (2.0 * lasting * T) * gust
        Q[:, 0:2, 2:4] += both
        Q[:, 2:4, 0:2] += both
        Q[:, 2:4, 2:4] += gust + crab[:, None, None] * np.array(((e * e, -n * e), (-n * e, n * n)))
        Q[:, 2, CRAB] = Q[:, CRAB, 2] = -e * crab
        Q[:, 3, CRAB] = Q[:, CRAB, 3] = n * crab
        if i.airspeed == "steady":
            self._wandering(i, T, Phi, Q)

    def _wandering(self, i: Interval, T: float, Phi: Floats, Q: Floats) -> None:
        """What a steady airspeed wanders by, along the nose: as a wind it moves position and velocity."""
        stays, way, *grown = _first_order(T, STEADY_S)
        variance = nose_covariance(i.V, STEADY_M_S, 0.0)
        moved, both, end = (factor * variance for factor in grown)
        Phi[0:2, GUST] = -way * np.eye(2)
        Phi[2:4, GUST] = -stays * np.eye(2)
        Q[:, 0:2, 0:2] += moved
        Q[:, 0:2, 2:4] += both
        Q[:, 2:4, 0:2] += both
        Q[:, 2:4, 2:4] += end
        Q[:, GUST, GUST] = end
        Q[:, GUST, 0:2] = Q[:, 0:2, GUST] = -both
        Q[:, GUST, 2:4] = Q[:, 2:4, GUST] = -end

    def _hovering(self, T: float, Phi: Floats, Q: Floats) -> None:
        stays, way, *grown = _first_order(T, HOVER_S)
        variance = 0.5 * HOVER_S * self.settings.hold_m_s_sqrt_s**2 * self._coarser2
        moved, both, end = (factor * variance for factor in grown)
        for k in (0, 1):
            Phi[k, 2 + k], Phi[2 + k, 2 + k] = way, stays
            Q[:, k, k] = moved
            Q[:, k, 2 + k] = Q[:, 2 + k, k] = both
            Q[:, 2 + k, 2 + k] = end

    def _foreign(self, T: float, Phi: Floats, Q: Floats) -> None:
        at = FOREIGN.start
        noise = self.settings.foreign_noise_m_s**2
        change = self.settings.foreign_change_m_s_sqrt_s**2 * T
        for k in (0, 1):
            Phi[2 + k, 2 + k] = 0.0
            Phi[k, at + k], Phi[2 + k, at + k] = T, 1.0
            Q[:, k, k] += noise * T
            Q[:, 2 + k, 2 + k] += noise + change
            Q[:, 2 + k, at + k] += change
            Q[:, at + k, 2 + k] += change

    def airspeed_row(self, velocity: Vector2, V: Vector2, manoeuvre: float = 0.0) -> Row:
        """Return the row of airspeed and heading as a velocity vector; not in `air` intervals.

        Parameters
        ----------
        velocity
            Nominal velocity over ground (m/s), mean over the samples since the last such row.
        V
            Measured velocity through the air (m/s), `air_velocity`, mean over the same samples.
        manoeuvre
            Mean acceleration above that of level flight (m/s^2): the angle of attack grows with it.
        """
        H = np.zeros((2, N))
        H[0, 2] = H[1, 3] = H[0, 4] = H[1, 5] = 1.0
        H[0, GUST.start] = H[1, GUST.start + 1] = 1.0
        H[:, SCALE] = H[:, VERSINE] = -V[0], -V[1]
        H[:, HEADING] = H[:, CRAB] = V[1], -V[0]
        y = np.array((velocity[0] - V[0], velocity[1] - V[1]))
        return Row(y, H, np.eye(2) * airspeed_variance(manoeuvre))


def _first_order(T: float, tau: float) -> tuple[float, float, float, float, float]:
    """Return of a velocity that is correlated over `tau` what stays of it after `T` seconds and how far 1 m/s
    moves; and what unit variance adds to position, covariance and velocity.
    """
    stays, gone = math.exp(-T / tau), -math.expm1(-T / tau)
    return (
        stays,
        tau * gone,
        tau * (2.0 * T - tau * gone * (2.0 + gone)),
        tau * gone * gone,
        1.0 - stays * stays,
    )


def _come_up(T: float, tau: float) -> Floats:
    """Covariance (3, 3) of position, velocity and acceleration by an acceleration that is correlated over
    `tau` and driven by white noise of unit density for `T` seconds. As a Gram matrix it is never indefinite.
    """
    F = np.empty((3, 3))
    for row, (share, weight) in zip(F, GAUSS, strict=True):
        age = share * T  # from when it came up to the end
        way = -tau * math.expm1(-age / tau)
        row[:] = tau * (age - way), way, math.exp(-age / tau)
        row *= math.sqrt(weight * T)
    covariance: Floats = F.T @ F
    return covariance


def _velocity_noise(Phi: Floats, Q: Floats, T: float, density: Floats) -> None:
    square, cube = density * (0.5 * T * T), density * (T * T * T / 3.0)
    for k in (0, 1):
        Phi[k, 2 + k] = T
        Q[:, k, k] = cube
        Q[:, k, 2 + k] = Q[:, 2 + k, k] = square
        Q[:, 2 + k, 2 + k] = density * T


def nose_covariance(V: Vector2, along: float, across: float) -> Floats:
    """Return the covariance (2, 2), north and east, of sigmas along and across the air velocity `V`."""
    n, e = V
    speed2 = n * n + e * e
    a, b = along * along, across * across
    if speed2 < 1.0:
        return np.diag((max(a, b), max(a, b)))
    nn, ne, ee = n * n / speed2, n * e / speed2, e * e / speed2
    return np.array(((a * nn + b * ee, (a - b) * ne), ((a - b) * ne, a * ee + b * nn)))


# ---------------------------------------------------------------------------------------------------------
# Measurements
# ---------------------------------------------------------------------------------------------------------


def scale_sigma(settings: Amplitudes, airspeed: Airspeed) -> float:
    """Standard deviation of the scale when the velocity through the air is first taken from something."""
    return {"pitot": settings.scale, "drag": DRAG_SCALE, "steady": STEADY_SCALE}[airspeed]


def airspeed_variance(manoeuvre: float) -> float:
    """Variance of an airspeed on each axis, (m/s)^2, by the acceleration above that of level flight."""
    return AIRSPEED_NOISE_M_S**2 + (AIRSPEED_MANOEUVRE_S * manoeuvre) ** 2


def drag_rows(
    x: Floats, velocity: Vector2, V: Vector2, heading: float, drag_per_s: float
) -> tuple[Floats, Floats]:
    """Return z (rows, 2) and H (rows, 2, n) of a multirotor's drag, linearised at each state `x` (rows, n).

    The velocity through the air is that over ground less the wind: a hovering multirotor's is not far above
    the noise of its drag, so that the scale may not be multiplied by the measured one.

    Parameters
    ----------
    velocity
        Nominal velocity over ground (m/s), mean over the samples since the last measurement.
    V
        Specific force across the axis of the rotors over -`drag_per_s`, north and east (m/s), the same mean.
    heading
        Turns the error of the accelerometers (rad).
    """
    air = np.array(velocity) - x[:, VELOCITY] - x[:, WIND] - x[:, GUST]  # (rows, 2)
    scale, ahead = 1.0 + x[:, SCALE], 1.0 - x[:, VERSINE]
    angle = x[:, HEADING] + x[:, CRAB]
    turned = np.stack((-air[:, 1], air[:, 0]), axis=1)
    H = np.zeros((len(x), 2, N))
    for north in (VELOCITY.start, WIND.start, GUST.start):
        H[:, 0, north] = H[:, 1, north + 1] = scale * ahead
        H[:, 1, north] = scale * angle
        H[:, 0, north + 1] = -scale * angle
    predicted = ahead[:, None] * air + angle[:, None] * turned
    H[:, :, SCALE] = -predicted
    H[:, :, HEADING] = H[:, :, CRAB] = -scale[:, None] * turned
    H[:, :, VERSINE] = scale[:, None] * air
    c, s = math.cos(heading) / drag_per_s, math.sin(heading) / drag_per_s
    H[:, :, ACCELEROMETER] = (c, -s), (s, c)
    predicted = scale[:, None] * predicted - x[:, ACCELEROMETER] @ np.array(((c, s), (-s, c)))
    z: Floats = predicted - np.array(V) + np.einsum("rij,rj->ri", H, x[:, :N])
    return z, H
