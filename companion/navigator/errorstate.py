"""The error of the inertial channel as a Gaussian state: predicted by the INS error equations, corrected by
fixes.

The model is `nav.error_model.aircraft` with Markov gyro drift and accelerometer errors: position errors dx
north and dy east (m), velocity errors (m/s), P minus the rotation of the platform (rad), E minus the gyro
drift (rad/s), A the accelerometer errors (m/s^2), and GN, GE the drift of GNSS (m), radio-navigation drift in
the paper's words. A fix enters by maximum likelihood with this state as one more observation: the position
part of the posterior is the fusion's, and the rest follows it by regression. That is the Kalman update where
the measurement is linear, and the iterated one where it is an azimuth or a range.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from companion.config import GnssSection, Inertial
from companion.nav.disturbances import Disturbance, accelerometer_slow, gyro_drift
from companion.nav.error_model import aircraft
from companion.records import Vector2, Vector3

Floats = npt.NDArray[np.float64]

N = 14
POSITION = slice(0, 2)
VELOCITY = slice(2, 4)
TILT = slice(4, 7)
#: What a radio fix, a beacon's or GNSS's, says of the state: INS minus fix, north and east (2, N).
BEACON_ROWS = np.eye(2, N)
GNSS_ROWS = BEACON_ROWS - np.eye(2, N, 12)
G0 = 9.80665  # [m/s^2] of a bias quoted in micro-g
STEP_S = 2.0  # the transition is a power series: its fifth term is below 1e-12 of the first here


class ErrorState(NamedTuple):
    """Mean x (N,) and covariance P (N, N) of INS minus truth at `t_ns`."""

    t_ns: int
    x: Floats
    P: Floats


class Grade(NamedTuple):
    """Disturbances of the unit and of GNSS, white spectral densities (N,), first sigmas (N,)."""

    disturbances: tuple[Disturbance, ...]
    density: Floats
    sigma0: Floats


def grade(settings: Inertial, gnss: GnssSection) -> Grade:
    """What the configuration says of the unit and of GNSS, in SI."""
    drift = math.radians(settings.gyro_drift_deg_h) / 3600.0
    bias = settings.accelerometer_bias_ug * 1e-6 * G0
    tilt = math.radians(settings.tilt_arcsec / 3600.0)
    heading = math.radians(settings.heading_arcmin / 60.0)
    disturbances = (
        gyro_drift(1.0 / (3600.0 * settings.gyro_correlation_h), drift),
        accelerometer_slow(1.0 / (3600.0 * settings.accelerometer_correlation_h), bias),
        Disturbance(("GN", "GE"), 1.0 / gnss.correlation_s, gnss.sigma_m),
    )
    density = np.zeros(N)
    density[VELOCITY] = settings.velocity_noise_m_s_sqrt_s**2
    density[TILT] = (math.radians(settings.angle_random_walk_deg_sqrt_h) / 60.0) ** 2
    sigma0 = [settings.position_m] * 2 + [settings.velocity_m_s] * 2 + [tilt, tilt, heading]
    sigma0 += [drift] * 3 + [bias] * 2 + [gnss.sigma_m] * 2
    return Grade(disturbances, density, np.array(sigma0))


def start(t_ns: int, unit: Grade) -> ErrorState:
    """What is known before the first fix: nothing but the grade of the unit."""
    return ErrorState(t_ns, np.zeros(N), np.diag(unit.sigma0**2))


def predict(state: ErrorState, t_ns: int, lat: float, v_n: Vector3, a_n: Vector2, unit: Grade) -> ErrorState:
    """The state at `t_ns`, the INS flying at `v_n` with horizontal acceleration `a_n` in between."""
    left = (t_ns - state.t_ns) * 1e-9
    if left <= 0.0:
        return state
    x, P = state.x, state.P
    model = aircraft(lat, v_n[0], v_n[1], (*a_n, 0.0), added=unit.disturbances)
    density = model.Q + np.diag(unit.density)
    steps = math.ceil(left / STEP_S)
    dt = left / steps
    M = model.A * dt
    M2 = M @ M
    Phi = np.eye(N) + M + M2 / 2.0 + (M2 @ M) / 6.0 + (M2 @ M2) / 24.0
    # trapezoid of the process noise: second order in dt, which is short against every mode
    Q = 0.5 * dt * (density + Phi @ density @ Phi.T)
    for _ in range(steps):
        x = Phi @ x
        P = Phi @ P @ Phi.T + Q
    return ErrorState(t_ns, x, 0.5 * (P + P.T))


def absorb_position(state: ErrorState, H: Floats, mean: Floats, covariance: Floats) -> ErrorState:
    """The state once fusion has turned H x (2,) into `mean` (2,) with `covariance` (2, 2), m north, east.

    K = P H' (H P H')^-1 carries the change to every state; with nothing learnt it changes nothing.
    """
    HP = H @ state.P
    S = HP @ H.T
    K = np.linalg.solve(S, HP).T
    x = state.x + K @ (mean - H @ state.x)
    P = state.P - K @ (S - covariance) @ K.T
    return ErrorState(state.t_ns, x, 0.5 * (P + P.T))


def absorb_velocity(state: ErrorState, velocity_error: Floats, sigma: float) -> tuple[ErrorState, float]:
    """The state corrected by a measured INS velocity error (2,) m/s, Joseph's form; and the NIS of the
    innovation.
    """
    S = state.P[VELOCITY, VELOCITY] + sigma**2 * np.eye(2)
    nu = velocity_error - state.x[VELOCITY]
    K = np.linalg.solve(S, state.P[VELOCITY, :]).T
    J = np.eye(N)
    J[:, VELOCITY] -= K
    P = J @ state.P @ J.T + sigma**2 * K @ K.T
    return ErrorState(state.t_ns, state.x + K @ nu, 0.5 * (P + P.T)), float(nu @ np.linalg.solve(S, nu))


def shift(state: ErrorState, north: float, east: float) -> ErrorState:
    """The state after the channel itself jumped by (north, east) m: the error jumped with it, nothing else
    did.
    """
    x = state.x.copy()
    x[POSITION] += north, east
    return state._replace(x=x)


def widen(state: ErrorState, factor: float) -> ErrorState:
    """The state with its covariance multiplied: what it claimed was proved wrong."""
    return state._replace(P=state.P * factor)
