"""Sensor models of a simulated flight: INS, GNSS, air data and IMU, as arrays.

The INS is not integrated from the IMU: its error follows the Schuler error equations along the flight, driven
by gyro and accelerometer errors of its grade, and is added to the truth. Errors are INS minus truth. The
vertical channel is aided by the barometer and has a bounded random error.

Records, messages, beacons (`sitl.beacon`) and faults are not handled here. Every function takes the random
generator of its noise.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from companion.config import InertialConfig
from companion.nav.earth import OMEGA
from companion.units import Floats
from sitl.flight import Trajectory, radii, rotation

Generator = np.random.Generator

G = 9.81
R = 6371000.0
DEG_H = math.radians(1.0) / 3600.0
"""1 deg/h in rad/s."""
UG = 1e-6 * G
"""1 micro-g in m/s^2."""
_STEP_S = 0.5  # the INS error is integrated at 2 Hz: turns last at least 20 s
RHO_0, P_0, T_0 = 1.225, 101325.0, 288.15
"""International standard atmosphere at sea level: kg/m^3, Pa, K."""


@dataclass(frozen=True, slots=True)
class InertialGrade:
    """Inertial grade, one sigma each.

    Biases are the residuals after alignment and calibration in flight: half of the variance is constant, half
    is a Gauss-Markov process with the correlation time.
    """

    name: str
    gyro_bias_deg_h: float
    angle_random_walk_deg_sqrt_h: float
    accelerometer_bias_ug: float
    velocity_random_walk_ug_sqrt_hz: float
    correlation_s: float
    velocity_m_s: float
    tilt_arcsec: float
    heading_deg: float


# values within the classes of Groves (2013), table 4.1 and section 4.4 (aviation, intermediate, tactical)
GRADES = {
    # ring laser gyro INS, 1 nautical mile per hour (0.01 deg/h, 50 micro-g)
    "navigation": InertialGrade("navigation", 0.01, 0.002, 50.0, 20.0, 3600.0, 0.1, 10.0, 0.05),
    # fibre-optic gyro unit, 1 deg/h, calibrated in flight to 0.1 deg/h
    "tactical": InertialGrade("tactical", 0.1, 0.07, 200.0, 100.0, 1800.0, 0.2, 40.0, 0.2),
    # good MEMS unit (bias instability 0.5 deg/h and 0.05 mg), calibrated in flight, with temperature drift
    "mems": InertialGrade("mems", 1.0, 0.15, 500.0, 120.0, 600.0, 0.4, 120.0, 1.0),
}
#: The same grades as `inertial` of a configuration states them: the tilt after levelling holds the
#: accelerometers' errors too, and what turns with the aircraft is not simulated.
STATED_GRADES: dict[str, InertialConfig] = {
    "navigation": InertialConfig(),
    "tactical": InertialConfig(
        gyro_drift_deg_h=0.1,
        gyro_correlation_h=0.5,
        angle_random_walk_deg_sqrt_h=0.07,
        accelerometer_bias_ug=200.0,
        accelerometer_correlation_h=0.5,
        tilt_arcsec=60.0,
        heading_arcmin=12.0,
    ),
    "mems": InertialConfig(
        gyro_drift_deg_h=1.0,
        gyro_correlation_h=0.17,
        angle_random_walk_deg_sqrt_h=0.15,
        accelerometer_bias_ug=500.0,
        accelerometer_correlation_h=0.17,
        velocity_noise_m_s_sqrt_s=0.0012,
        tilt_arcsec=160.0,
        heading_arcmin=60.0,
    ),
}


class InertialError(NamedTuple):
    """INS minus truth: position and velocity NED (n, 3) in m and m/s, misalignment `psi` (n, 3) in rad.

    `psi` is P of the error equations: minus the rotation of the platform, so the heading error is +psi_z.
    """

    t: Floats
    x_n: Floats
    v_n: Floats
    psi: Floats


class GnssFixes(NamedTuple):
    """GNSS fixes with errors; `usable` is False without a fix. Geodetic, ellipsoidal height."""

    t: Floats
    lat: Floats
    lon: Floats
    alt: Floats
    v_n: Floats
    usable: npt.NDArray[np.bool_]


@dataclass(frozen=True, slots=True)
class GnssModel:
    """GNSS receiver: correlated (first-order Gauss-Markov) and white error, one sigma per axis, m and m/s."""

    correlated_m: float = 1.5
    correlation_s: float = 60.0
    white_m: float = 0.8
    vertical_ratio: float = 1.6
    velocity_m_s: float = 0.08

    @property
    def sigma_horizontal(self) -> float:
        """Stated one sigma per horizontal axis, m."""
        return math.hypot(self.correlated_m, self.white_m)


@dataclass(frozen=True, slots=True)
class AirDataModel:
    """Pitot-static system: scale-factor and white error of airspeed, turbulence along the flight path."""

    scale: float = 0.01
    noise_m_s: float = 0.15
    turbulence_m_s: float = 0.8
    turbulence_length_m: float = 300.0
    pressure_noise_pa: float = 4.0
    pressure_wander_pa: float = 30.0


class AirReadings(NamedTuple):
    """Measured true and equivalent airspeed (m/s), static and impact pressure (Pa), temperature (K)."""

    t: Floats
    true_airspeed: Floats
    equivalent_airspeed: Floats
    static: Floats
    impact: Floats
    temperature: Floats


def gauss_markov(n: int, dt: float, correlation_s: float, rng: Generator, columns: int = 1) -> Floats:
    """Sample a stationary first-order Gauss-Markov process of unit variance, (n, columns)."""
    phi = math.exp(-dt / correlation_s)
    white = rng.standard_normal((n, columns))
    white[1:] *= math.sqrt(1.0 - phi * phi)
    return recur(phi, white)


def recur(phi: float, drive: Floats) -> Floats:
    """Return y[k] = phi y[k-1] + drive[k], (n, columns); `scipy.signal` would take 0.4 s to import."""
    out = np.empty_like(drive)
    for k, column in enumerate(drive.T.tolist()):
        y, sums = 0.0, []
        for w in column:
            y = phi * y + w
            sums.append(y)
        out[:, k] = sums
    return out


def error_rates(flight: Trajectory) -> Floats:
    """Return A(t) (n, 7, 7) of dx, dy [m], dVN, dVE [m/s], PX, PY, PZ [rad] along the flight.

    Poddubny's INS error model, complete to first order for aircraft, with the specific force of manoeuvres;
    x north, y east, dx = R dphi, dy = R cos(phi) dlam. `companion.nav.error_model` has the same equations for
    one instant; the tests compare the two.
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


def propagate(flight: Trajectory, initial: Floats, drive: Floats) -> Floats:
    """Integrate x' = A(t) x + drive(t) from `initial` (7,) over the flight's equal steps; states (n, 7).

    Second order (midpoint): I + M + M^2/2 + M^3/6 with M the mean of A over a step.
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


def simulate_inertial_error(flight: Trajectory, grade: InertialGrade, rng: Generator) -> InertialError:
    """Simulate the error of a strapdown INS of this grade along the flight, at 2 Hz."""
    coarse = flight.at(np.arange(flight.t[0], flight.t[-1] + 2.0 * _STEP_S, _STEP_S))
    n = len(coarse.t)
    C_nb = rotation(coarse.attitude)

    def bias(sigma: float) -> Floats:
        wander = gauss_markov(n, _STEP_S, grade.correlation_s, rng, 3)
        constant = rng.standard_normal(3)
        body = sigma * math.sqrt(0.5) * (wander + constant)
        out: Floats = np.einsum("nij,nj->ni", C_nb, body)
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
    # levelling leaves the tilt that cancels the accelerometer bias, plus the stated tilt error
    level = np.array([-accelerometer_n[0, 1], accelerometer_n[0, 0]]) / G
    initial[4:6] = level + math.radians(grade.tilt_arcsec / 3600.0) * rng.standard_normal(2)
    initial[6] = math.radians(grade.heading_deg) * rng.standard_normal()
    states = propagate(coarse, initial, drive)

    down = 3.0 * gauss_markov(n, _STEP_S, 300.0, rng)
    down = recur(0.95, 0.05 * (down - down[0]))[:, 0]  # smoothed: its derivative is the velocity error
    x_n = np.stack([states[:, 0], states[:, 1], down], axis=1)
    v_n = np.stack([states[:, 2], states[:, 3], np.gradient(down, _STEP_S)], axis=1)
    return InertialError(coarse.t, x_n, v_n, states[:, 4:7])


def interpolate_error(error: InertialError, t: Floats) -> InertialError:
    """Interpolate the error linearly at times `t`."""

    def columns(a: Floats) -> Floats:
        return np.stack([np.interp(t, error.t, a[:, i]) for i in range(3)], axis=1)

    return InertialError(t, columns(error.x_n), columns(error.v_n), columns(error.psi))


def displace_positions(flight: Trajectory, x_n: Floats) -> tuple[Floats, Floats, Floats]:
    """Return latitude, longitude, height of the true positions displaced by `x_n` (n, 3) m NED."""
    R_N, R_E = radii(flight.lat)
    lat = flight.lat + x_n[:, 0] / (R_N + flight.alt)
    lon = flight.lon + x_n[:, 1] / ((R_E + flight.alt) * np.cos(flight.lat))
    return lat, lon, flight.alt - x_n[:, 2]


def simulate_gnss(
    flight: Trajectory, model: GnssModel, outages: tuple[tuple[float, float], ...], rng: Generator
) -> GnssFixes:
    """Simulate fixes at the times of `flight`; unusable inside the outages (start, end in s)."""
    n = len(flight.t)
    dt = float(flight.t[1] - flight.t[0])
    error_n = model.correlated_m * gauss_markov(n, dt, model.correlation_s, rng, 3)
    error_n += model.white_m * rng.standard_normal((n, 3))
    error_n[:, 2] *= model.vertical_ratio
    lat, lon, alt = displace_positions(flight, error_n)
    usable = np.ones(n, dtype=np.bool_)
    for start, end in outages:
        usable &= (flight.t < start) | (flight.t >= end)
    v_n = flight.v_n + model.velocity_m_s * rng.standard_normal((n, 3))
    return GnssFixes(flight.t, lat, lon, alt, v_n, usable)


def simulate_air_data(flight: Trajectory, model: AirDataModel, rng: Generator) -> AirReadings:
    """Simulate airspeed with Dryden's longitudinal turbulence, and pressures of the standard atmosphere.

    Turbulence after MIL-F-8785C: first order, correlation time L/V.
    """
    n = len(flight.t)
    dt = float(flight.t[1] - flight.t[0])
    speed = float(np.mean(flight.airspeed)) or 1.0
    gust = model.turbulence_m_s * gauss_markov(n, dt, model.turbulence_length_m / speed, rng)[:, 0]
    aloft = np.clip(flight.airspeed / 15.0, 0.0, 1.0)
    true_airspeed = (flight.airspeed + gust * aloft) * (1.0 + model.scale * rng.standard_normal())
    true_airspeed = np.maximum(true_airspeed + model.noise_m_s * rng.standard_normal(n), 0.0)
    temperature = np.maximum(T_0 - 0.0065 * flight.alt, 216.65)  # which it is from 11 km up
    static = P_0 * (temperature / T_0) ** 5.25588 * np.exp(np.minimum(11_000.0 - flight.alt, 0.0) / 6341.62)
    equivalent = true_airspeed * np.sqrt(static * T_0 / (P_0 * temperature))
    noise = model.pressure_noise_pa * rng.standard_normal(n)
    noise += model.pressure_wander_pa * gauss_markov(n, dt, 1800.0, rng)[:, 0]
    impact = 0.5 * RHO_0 * equivalent**2
    return AirReadings(flight.t, true_airspeed, equivalent, static + noise, impact, temperature)


def simulate_imu(flight: Trajectory, grade: InertialGrade, rng: Generator) -> tuple[Floats, Floats]:
    """Simulate specific force and angular rate (n, 3) with the grade's constant biases and white noise."""
    dt = float(flight.t[1] - flight.t[0])
    arw = math.radians(grade.angle_random_walk_deg_sqrt_h) / 60.0 / math.sqrt(dt)
    vrw = grade.velocity_random_walk_ug_sqrt_hz * UG / math.sqrt(dt)
    shape = flight.f_b.shape
    f_b = flight.f_b + grade.accelerometer_bias_ug * UG * rng.standard_normal(3)
    w_b = flight.w_b + grade.gyro_bias_deg_h * DEG_H * rng.standard_normal(3)
    return f_b + vrw * rng.standard_normal(shape), w_b + arw * rng.standard_normal(shape)
