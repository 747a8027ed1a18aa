"""What the sensors of a simulated flight say: INS, GNSS, air data and IMU, as arrays, by seed.

The INS is not integrated from the IMU: its error obeys the Schuler error equations along the flight, driven
by gyro and accelerometer errors of its grade, and is added to the truth. Errors are INS minus true. The
vertical channel is held by the barometer and only wanders.

It knows nothing of records, messages, beacons (`sitl.beacon`) or faults. Every function takes the
generator that makes its noise.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.signal import lfilter

from companion.nav.earth import OMEGA
from sitl.flight import Array, Flight, radii, rotation

Generator = np.random.Generator

G = 9.81
R = 6371000.0
DEG_H = math.radians(1.0) / 3600.0
"""1 deg/h in rad/s."""
UG = 1e-6 * G
"""1 micro-g in m/s^2."""
_STEP_S = 0.5  # the INS error is integrated at 2 Hz: a turn lasts 20 s and more
RHO_0, P_0, T_0 = 1.225, 101325.0, 288.15
"""International standard atmosphere at sea level: kg/m^3, Pa, K."""


@dataclass(frozen=True, slots=True)
class Grade:
    """An inertial grade, one sigma each. Biases are what is left after alignment and calibration in flight;
    half of their variance is constant, half wanders with the correlation time."""

    name: str
    gyro_bias_deg_h: float
    angle_random_walk_deg_sqrt_h: float
    accelerometer_bias_ug: float
    velocity_random_walk_ug_sqrt_hz: float
    correlation_s: float
    velocity_m_s: float
    tilt_arcsec: float
    heading_deg: float


# Figures within the classes of Groves (2013), tables 4.1 and section 4.4 (aviation, intermediate, tactical).
GRADES = {
    # A ring laser gyro INS of 1 nautical mile an hour (0.01 deg/h, 50 micro-g).
    "navigation": Grade("navigation", 0.01, 0.002, 50.0, 20.0, 3600.0, 0.1, 10.0, 0.05),
    # A fibre-optic gyro unit of 1 deg/h, calibrated in flight to a tenth of that.
    "tactical": Grade("tactical", 0.1, 0.07, 200.0, 100.0, 1800.0, 0.2, 40.0, 0.2),
    # A good MEMS unit (bias instability 0.5 deg/h and 0.05 mg), calibrated in flight, temperature wandering.
    "mems": Grade("mems", 1.0, 0.15, 500.0, 120.0, 600.0, 0.4, 120.0, 1.0),
}


class InertialError(NamedTuple):
    """INS minus true: position and velocity NED (n, 3) in m and m/s, misalignment `psi` (n, 3) in rad
    (the P of the error equations: minus the rotation of the platform, so the heading error is +psi_z)."""

    t: Array
    x_n: Array
    v_n: Array
    psi: Array


class GnssFixes(NamedTuple):
    """Fixes: errors are inside; `usable` False where the receiver has none. Geodetic, ellipsoidal height."""

    t: Array
    lat: Array
    lon: Array
    alt: Array
    v_n: Array
    usable: npt.NDArray[np.bool_]


@dataclass(frozen=True, slots=True)
class GnssModel:
    """A receiver: correlated (first-order Gauss-Markov) and white error, one sigma per axis, m and m/s."""

    correlated_m: float = 1.5
    correlation_s: float = 60.0
    white_m: float = 0.8
    vertical_ratio: float = 1.6
    velocity_m_s: float = 0.08

    @property
    def sigma_horizontal(self) -> float:
        """One sigma of north and of east, as the receiver states it, m."""
        return math.hypot(self.correlated_m, self.white_m)


@dataclass(frozen=True, slots=True)
class AirDataModel:
    """A pitot-static system: scale-factor and white error of airspeed, turbulence along the flight path."""

    scale: float = 0.01
    noise_m_s: float = 0.15
    turbulence_m_s: float = 0.8
    turbulence_length_m: float = 300.0
    pressure_noise_pa: float = 4.0
    pressure_wander_pa: float = 30.0


class AirReadings(NamedTuple):
    """True and equivalent airspeed as measured (m/s), static and impact pressure (Pa), temperature (K)."""

    t: Array
    true_airspeed: Array
    equivalent_airspeed: Array
    static: Array
    impact: Array
    temperature: Array


def gauss_markov(n: int, dt: float, correlation_s: float, rng: Generator, columns: int = 1) -> Array:
    """A stationary first-order Gauss-Markov process of unit variance, (n, columns)."""
    phi = math.exp(-dt / correlation_s)
    white = rng.standard_normal((n, columns))
    white[1:] *= math.sqrt(1.0 - phi * phi)
    out: Array = lfilter([1.0], [1.0, -phi], white, axis=0)
    return out


def error_rates(flight: Flight) -> Array:
    """A(t) (n, 7, 7) of dx, dy [m], dVN, dVE [m/s], PX, PY, PZ [rad] along the flight, continuous.

    The equations of Poddubny's INS error model, complete to first order for aircraft, with the manoeuvres'
    own specific force; x north, y east, dx = R dphi, dy = R cos(phi) dlam. `companion.nav.error_model`
    has them one moment at a time; the two are tested against each other.
    """
    VN, VE, _ = flight.v_n.T
    s, c = np.sin(flight.lat), np.cos(flight.lat)
    t = s / c
    fN, fE, fD = np.einsum("nij,nj->ni", rotation(flight.attitude), flight.f_b).T
    wX, wY, wZ = OMEGA * c + VE / R, -VN / R, -(OMEGA * s + VE * t / R)
    a = np.zeros((len(flight.t), 7, 7))
    a[:, 0, 2] = 1.0
    a[:, 1, 3], a[:, 1, 0], a[:, 1, 1] = 1.0, VE * t / R, -VN * t / R
    convergence = 2.0 * OMEGA * c + VE / (R * c * c)
    a[:, 2, 0] = -convergence * VE / R
    a[:, 2, 3] = -2.0 * (OMEGA * s + VE * t / R)
    a[:, 2, 5], a[:, 2, 6] = fD, -fE
    a[:, 3, 0] = convergence * VN / R
    a[:, 3, 2], a[:, 3, 3] = 2.0 * OMEGA * s + VE * t / R, VN * t / R
    a[:, 3, 4], a[:, 3, 6] = -fD, fN
    a[:, 4, 0], a[:, 4, 3], a[:, 4, 5], a[:, 4, 6] = OMEGA * s / R, -1.0 / R, wZ, -wY
    a[:, 5, 2], a[:, 5, 4], a[:, 5, 6] = 1.0 / R, -wZ, wX
    a[:, 6, 0], a[:, 6, 3] = (OMEGA * c + VE / (R * c * c)) / R, t / R
    a[:, 6, 4], a[:, 6, 5] = wY, -wX
    return a


def propagate(flight: Flight, initial: Array, drive: Array) -> Array:
    """The states (n, 7) of x' = A(t) x + drive(t) from `initial` (7,) on, at the flight's equal steps.

    Second order by the midpoint: I + M + M^2/2 + M^3/6 with M the mean of A over a step.
    """
    dt = float(flight.t[1] - flight.t[0])
    a = error_rates(flight)
    m = 0.5 * dt * (a[1:] + a[:-1])
    m2 = m @ m
    transition = np.eye(7) + m + 0.5 * m2 + m2 @ m / 6.0
    half = np.eye(7) + 0.5 * m + m2 / 6.0
    pushed = (half @ (0.5 * dt * (drive[1:] + drive[:-1]))[:, :, None])[:, :, 0]
    states = np.empty((len(flight.t), 7))
    states[0] = x = initial
    for k in range(len(transition)):
        x = transition[k] @ x + pushed[k]
        states[k + 1] = x
    return states


def inertial_error(flight: Flight, grade: Grade, rng: Generator) -> InertialError:
    """The error of an INS of this grade, strapped to the body, along the flight (at 2 Hz)."""
    coarse = flight.at(np.arange(flight.t[0], flight.t[-1] + 2.0 * _STEP_S, _STEP_S))
    n = len(coarse.t)
    C_nb = rotation(coarse.attitude)

    def bias(sigma: float) -> Array:
        wander = gauss_markov(n, _STEP_S, grade.correlation_s, rng, 3)
        constant = rng.standard_normal(3)
        body = sigma * math.sqrt(0.5) * (wander + constant)
        out: Array = np.einsum("nij,nj->ni", C_nb, body)
        return out

    gyro_n = bias(grade.gyro_bias_deg_h * DEG_H)
    accelerometer_n = bias(grade.accelerometer_bias_ug * UG)
    white = 1.0 / math.sqrt(_STEP_S)
    arw = math.radians(grade.angle_random_walk_deg_sqrt_h) / 60.0
    gyro_n += arw * white * rng.standard_normal((n, 3))
    accelerometer_n += grade.velocity_random_walk_ug_sqrt_hz * UG * white * rng.standard_normal((n, 3))
    drive = np.zeros((n, 7))
    drive[:, 2:4] = accelerometer_n[:, :2]
    drive[:, 4:7] = gyro_n

    initial = np.zeros(7)
    initial[2:4] = grade.velocity_m_s * rng.standard_normal(2)
    # A levelled platform has the tilt that hides its accelerometer's bias, and a little more.
    level = np.array([-accelerometer_n[0, 1], accelerometer_n[0, 0]]) / G
    initial[4:6] = level + math.radians(grade.tilt_arcsec / 3600.0) * rng.standard_normal(2)
    initial[6] = math.radians(grade.heading_deg) * rng.standard_normal()
    states = propagate(coarse, initial, drive)

    down = 3.0 * gauss_markov(n, _STEP_S, 300.0, rng)[:, 0]
    down = lfilter([0.05], [1.0, -0.95], down - down[0])  # smooth: its slope is the velocity error
    x_n = np.stack([states[:, 0], states[:, 1], down], axis=1)
    v_n = np.stack([states[:, 2], states[:, 3], np.gradient(down, _STEP_S)], axis=1)
    return InertialError(coarse.t, x_n, v_n, states[:, 4:7])


def error_at(error: InertialError, t: Array) -> InertialError:
    """The error at times `t`, linear between its samples."""

    def columns(a: Array) -> Array:
        return np.stack([np.interp(t, error.t, a[:, i]) for i in range(3)], axis=1)

    return InertialError(t, columns(error.x_n), columns(error.v_n), columns(error.psi))


def displaced(flight: Flight, x_n: Array) -> tuple[Array, Array, Array]:
    """Latitude, longitude, height of positions `x_n` (n, 3) NED metres away from the true ones."""
    R_N, R_E = radii(flight.lat)
    lat = flight.lat + x_n[:, 0] / (R_N + flight.alt)
    lon = flight.lon + x_n[:, 1] / ((R_E + flight.alt) * np.cos(flight.lat))
    return lat, lon, flight.alt - x_n[:, 2]


def gnss(
    flight: Flight, model: GnssModel, outages: tuple[tuple[float, float], ...], rng: Generator
) -> GnssFixes:
    """Fixes at the times of `flight`, none inside the outages (start, end in s)."""
    n = len(flight.t)
    dt = float(flight.t[1] - flight.t[0])
    error_n = model.correlated_m * gauss_markov(n, dt, model.correlation_s, rng, 3)
    error_n += model.white_m * rng.standard_normal((n, 3))
    error_n[:, 2] *= model.vertical_ratio
    lat, lon, alt = displaced(flight, error_n)
    usable = np.ones(n, dtype=np.bool_)
    for start, end in outages:
        usable &= (flight.t < start) | (flight.t >= end)
    v_n = flight.v_n + model.velocity_m_s * rng.standard_normal((n, 3))
    return GnssFixes(flight.t, lat, lon, alt, v_n, usable)


def air_data(flight: Flight, model: AirDataModel, rng: Generator) -> AirReadings:
    """Airspeed with Dryden's longitudinal turbulence (MIL-F-8785C: first order, time V/L) and pressures
    of the standard atmosphere."""
    n = len(flight.t)
    dt = float(flight.t[1] - flight.t[0])
    speed = float(np.mean(flight.airspeed)) or 1.0
    gust = model.turbulence_m_s * gauss_markov(n, dt, model.turbulence_length_m / speed, rng)[:, 0]
    aloft = np.clip(flight.airspeed / 15.0, 0.0, 1.0)
    true_airspeed = (flight.airspeed + gust * aloft) * (1.0 + model.scale * rng.standard_normal())
    true_airspeed = np.maximum(true_airspeed + model.noise_m_s * rng.standard_normal(n), 0.0)
    temperature = T_0 - 0.0065 * flight.alt
    static = P_0 * (temperature / T_0) ** 5.25588
    equivalent = true_airspeed * np.sqrt(static * T_0 / (P_0 * temperature))
    noise = model.pressure_noise_pa * rng.standard_normal(n)
    noise += model.pressure_wander_pa * gauss_markov(n, dt, 1800.0, rng)[:, 0]
    impact = 0.5 * RHO_0 * equivalent**2
    return AirReadings(flight.t, true_airspeed, equivalent, static + noise, impact, temperature)


def imu(flight: Flight, grade: Grade, rng: Generator) -> tuple[Array, Array]:
    """Specific force and angular rate (n, 3) with the grade's constant biases and white noise."""
    dt = float(flight.t[1] - flight.t[0])
    arw = math.radians(grade.angle_random_walk_deg_sqrt_h) / 60.0 / math.sqrt(dt)
    vrw = grade.velocity_random_walk_ug_sqrt_hz * UG / math.sqrt(dt)
    shape = flight.f_b.shape
    f_b = flight.f_b + grade.accelerometer_bias_ug * UG * rng.standard_normal(3)
    w_b = flight.w_b + grade.gyro_bias_deg_h * DEG_H * rng.standard_normal(3)
    return f_b + vrw * rng.standard_normal(shape), w_b + arw * rng.standard_normal(shape)
