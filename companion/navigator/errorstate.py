"""The error of the inertial channel as a Gaussian state: predicted by the INS error equations, corrected by
fixes.

The model is `nav.error_model.aircraft` with Markov gyro drift and accelerometer errors: position errors dx
north and dy east (m), velocity errors (m/s), P minus the rotation of the platform (rad), E minus the gyro
drift (rad/s), A the accelerometer errors (m/s^2). A fix enters by maximum likelihood with this state as one
more observation: the position part of the posterior is the fusion's, and the rest follows it by regression.
That is the Kalman update where the measurement is linear, and the iterated one where it is an azimuth or a
range.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from companion.config import Inertial
from companion.nav.disturbances import Disturbance, accelerometer_slow, gyro_drift
from companion.nav.error_model import aircraft
from companion.records import Vector2, Vector3

Floats = npt.NDArray[np.float64]

N = 12
POSITION = slice(0, 2)
VELOCITY = slice(2, 4)
G0 = 9.80665  # [m/s^2] of a bias quoted in micro-g
STEP_S = 2.0  # the transition is a power series: its fifth term is below 1e-12 of the first here


class ErrorState(NamedTuple):
    """Mean x (12,) and covariance P (12, 12) of INS minus truth at `t_ns`."""

    t_ns: int
    x: Floats
    P: Floats


class Grade(NamedTuple):
    """The disturbances of the unit and the spectral density of its velocity noise (m/s)^2/s."""

    disturbances: tuple[Disturbance, ...]
    velocity_density: float
    sigma0: Floats


def grade(settings: Inertial) -> Grade:
    """What the configuration says of the unit, in SI."""
    drift = math.radians(settings.gyro_drift_deg_h) / 3600.0
    bias = settings.accelerometer_bias_ug * 1e-6 * G0
    tilt = math.radians(settings.tilt_arcsec / 3600.0)
    heading = math.radians(settings.heading_arcmin / 60.0)
    disturbances = (
        gyro_drift(1.0 / (3600.0 * settings.gyro_correlation_h), drift),
        accelerometer_slow(1.0 / (3600.0 * settings.accelerometer_correlation_h), bias),
    )
    sigma0 = (
        [settings.position_m] * 2
        + [settings.velocity_m_s] * 2
        + [tilt, tilt, heading]
        + [drift] * 3
        + [bias] * 2
    )
    return Grade(disturbances, settings.velocity_noise_m_s_sqrt_s**2, np.array(sigma0))


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
    model.Q[VELOCITY, VELOCITY] += unit.velocity_density * np.eye(2)
    steps = math.ceil(left / STEP_S)
    dt = left / steps
    M = model.A * dt
    M2 = M @ M
    Phi = np.eye(N) + M + M2 / 2.0 + (M2 @ M) / 6.0 + (M2 @ M2) / 24.0
    # trapezoid of the process noise: second order in dt, which is short against every mode
    Q = 0.5 * dt * (model.Q + Phi @ model.Q @ Phi.T)
    for _ in range(steps):
        x = Phi @ x
        P = Phi @ P @ Phi.T + Q
    return ErrorState(t_ns, x, 0.5 * (P + P.T))


def absorb_position(state: ErrorState, mean: Floats, covariance: Floats) -> ErrorState:
    """The state once fusion has turned its position part into `mean` (2,) and `covariance` (2, 2), m north,
    east.

    K = P_.p P_pp^-1 carries the change of position to every other state; with nothing learnt it changes
    nothing.
    """
    P_pp = state.P[POSITION, POSITION]
    K = np.linalg.solve(P_pp, state.P[POSITION, :]).T
    x = state.x + K @ (mean - state.x[POSITION])
    P = state.P - K @ (P_pp - covariance) @ K.T
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
