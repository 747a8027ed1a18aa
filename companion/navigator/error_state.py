"""The error of the inertial channel as a Gaussian state: predicted by the INS error equations, corrected by
fixes.

The model is `nav.error_model.aircraft` with Markov gyro drift and accelerometer errors: position errors dx
north and dy east (m), velocity errors (m/s), P minus the rotation of the platform (rad), E minus the gyro
drift (rad/s), A the accelerometer errors (m/s^2), and GN, GE the drift of GNSS (m), radio-navigation drift in
the paper's words. A fix enters by maximum likelihood with this state as one more observation: the position
part of the posterior is the fusion's, and the rest follows it by regression. That is the Kalman update where
the measurement is linear, and the iterated one where it is an azimuth or a range.

Another inertial channel has another model (`winderror` of air-data dead reckoning). What all have in common:
the position error comes first, the drift of GNSS last, and `velocity_rows` tell the velocity error.
"""

from __future__ import annotations

import math
from functools import cache
from typing import NamedTuple, Protocol

import numpy as np

from companion.config import GnssConfig, InertialConfig
from companion.nav.disturbances import Disturbance, accelerometer_slow, compose, gyro_drift
from companion.nav.error_model import INS_STATES, aircraft_matrix
from companion.records import Vector2, Vector3
from companion.units import G0, Floats

N = 14
POSITION = slice(0, 2)
VELOCITY = slice(2, 4)
TILT = slice(4, 7)
INS = slice(0, 7)
GYRO, ACCELEROMETER = (7, 8), (10, 11)  # north and east
TURNING_M_S = 5.0  # slower, the course says nothing of the heading
FRONT_S = 30.0  # how long a jump of the wind takes at most
NEAR_S = 0.5  # the noise that comes in meanwhile is nothing, and an error moves straight on
STEP_S = 2.0  # the transition is a power series: its fifth term is below 1e-12 of the first here


class ErrorState(NamedTuple):
    """Mean x (N,) and covariance P (N, N) of INS minus truth at `t_ns`."""

    t_ns: int
    x: Floats
    P: Floats


VELOCITY_ROWS = np.eye(2, N, 2)
VELOCITY_ROWS.setflags(write=False)


class Belief(NamedTuple):
    """The position error: north, east (m), and its covariance, north, north-east, east (m^2)."""

    error_n: Vector2
    covariance: Vector3


class Seen(NamedTuple):
    """What a fix sees of the state, H x, as `belief`; H P (2, N) ties it to all that is not seen."""

    belief: Belief
    HP: Floats


class System(NamedTuple):
    """x' = A x + w, w white of spectral density Q; both (n, n)."""

    A: Floats
    Q: Floats


class ErrorModel(Protocol):
    """How the errors of one kind of inertial channel move: first sigmas (n,), and what `velocity_noise` (m/s)
    the channel's velocity has besides.
    """

    @property
    def sigma0(self) -> Floats:
        """First sigmas (n,)."""

    @property
    def velocity_noise(self) -> float:
        """White noise of the channel's velocity, m/s, that is no state."""

    def system(self, lat: float, v_n: Vector3, a_n: Vector2) -> System:
        """The error equations while the channel moves at `v_n` with horizontal acceleration `a_n`."""

    def velocity_rows(self, v_n: Vector3) -> Floats:
        """H (2, n): the error of the channel's velocity, north and east, is H x."""


class Grade(NamedTuple):
    """Of an INS: `composed` (N, N) is A with the disturbances of the unit and of GNSS and without the INS's
    own errors; spectral densities (N, N), first sigmas (N,). Errors of sensors that are strapped down are
    `body_fixed`: they turn with the aircraft.
    """

    composed: Floats
    density: Floats
    sigma0: Floats
    velocity_noise: float = 0.0
    body_fixed: bool = False

    def system(self, lat: float, v_n: Vector3, a_n: Vector2) -> System:
        """The INS error equations at this latitude, velocity and acceleration."""
        A = self.composed.copy()
        A[INS, INS] = aircraft_matrix(lat, v_n[0], v_n[1], (*a_n, 0.0))
        # a strapped-down sensor's error turns with the aircraft: b_n' = (course rate) down x b_n
        speed2 = v_n[0] ** 2 + v_n[1] ** 2
        if self.body_fixed and speed2 > TURNING_M_S**2:
            rate = (v_n[0] * a_n[1] - v_n[1] * a_n[0]) / speed2
            for north, east in (GYRO, ACCELEROMETER):
                A[north, east] -= rate
                A[east, north] += rate
        return System(A, self.density)

    def velocity_rows(self, v_n: Vector3) -> Floats:
        """The velocity errors are states."""
        return VELOCITY_ROWS


def grade(settings: InertialConfig, gnss: GnssConfig) -> Grade:
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
    bare = compose(np.zeros((7, 7)), INS_STATES, disturbances)
    density = bare.Q.diagonal().copy()
    density[VELOCITY] = settings.velocity_noise_m_s_sqrt_s**2
    density[TILT] = (math.radians(settings.angle_random_walk_deg_sqrt_h) / 60.0) ** 2
    sigma0 = [settings.position_m] * 2 + [settings.velocity_m_s] * 2 + [tilt, tilt, heading]
    sigma0 += [drift] * 3 + [bias] * 2 + [gnss.sigma_m] * 2
    return Grade(bare.A, np.diag(density), np.array(sigma0), body_fixed=settings.strapped_down)


def overbound(unit: Grade, wind_jump: float) -> Grade:
    """For the integrity monitor of a local position that is the autopilot's own estimate: without GNSS it
    reckons by a wind that it takes for known, and is no witness against GNSS as an INS is.
    """
    density = unit.density.copy()
    density[VELOCITY, VELOCITY] += wind_jump**2 / FRONT_S * np.eye(2)
    return unit._replace(density=density)


def beacon_rows(unit: ErrorModel) -> Floats:
    """What a beacon's fix says of the state: INS minus fix, north and east, is H x; H (2, n)."""
    return _rows(len(unit.sigma0), False)


def gnss_rows(unit: ErrorModel) -> Floats:
    """What a fix of GNSS says of the state, its drift being the last two; H (2, n)."""
    return _rows(len(unit.sigma0), True)


@cache
def _rows(n: int, drifting: bool) -> Floats:
    H = np.eye(2, n) - drifting * np.eye(2, n, n - 2)
    H.setflags(write=False)
    return H


def start(t_ns: int, unit: ErrorModel) -> ErrorState:
    """What is known before the first fix: nothing but the grade of the unit."""
    return ErrorState(t_ns, np.zeros(len(unit.sigma0)), np.diag(unit.sigma0**2))


def predict(
    state: ErrorState, t_ns: int, lat: float, v_n: Vector3, a_n: Vector2, unit: ErrorModel
) -> ErrorState:
    """The state at `t_ns`, the INS flying at `v_n` with horizontal acceleration `a_n` in between."""
    left = (t_ns - state.t_ns) * 1e-9
    if left <= 0.0:
        return state
    Phi, Q = transition(left, unit.system(lat, v_n, a_n))
    P = Phi @ state.P @ Phi.T + Q
    return ErrorState(t_ns, Phi @ state.x, 0.5 * (P + P.T))


def transition(dt: float, system: System) -> tuple[Floats, Floats]:
    """Phi and the covariance Q of what comes in over `dt` seconds; both (n, n)."""
    doublings = max(0, math.ceil(math.log2(dt / STEP_S)))
    step = dt / 2**doublings
    M = system.A * step
    M2 = M @ M
    Phi = np.eye(len(M)) + M + M2 / 2.0 + (M2 @ M) / 6.0 + (M2 @ M2) / 24.0
    # trapezoid of the process noise: second order in the step, which is short against every mode
    Q = 0.5 * step * (system.Q + Phi @ system.Q @ Phi.T)
    for _ in range(doublings):  # a silence of hours costs a dozen steps
        Phi, Q = Phi @ Phi, Phi @ Q @ Phi.T + Q
    return Phi, Q


def seen(state: ErrorState, H: Floats) -> Seen:
    """What a fix of H x (2,) sees."""
    HP = H @ state.P
    north, east = (H @ state.x).tolist()
    (nn, ne), (_, ee) = (HP @ H.T).tolist()
    return Seen(Belief((north, east), (nn, ne, ee)), HP)


def ahead(state: ErrorState, dt: float, v_n: Vector3, unit: ErrorModel) -> tuple[Belief, Belief]:
    """The errors of position and of velocity (m/s) `dt` seconds on, `carried` in plain numbers."""
    H = np.concatenate((beacon_rows(unit), unit.velocity_rows(v_n)))
    n, e, vn, ve = (H @ state.x).tolist()
    (nn, ne, n_vn, n_ve), (_, ee, e_vn, e_ve), (_, _, vnn, vne), (*_, vee) = (H @ state.P @ H.T).tolist()
    place = (
        nn + dt * (2.0 * n_vn + dt * vnn),
        ne + dt * (n_ve + e_vn + dt * vne),
        ee + dt * (2.0 * e_ve + dt * vee),
    )
    return Belief((n + dt * vn, e + dt * ve), place), Belief((vn, ve), (vnn, vne, vee))


def absorb_position(state: ErrorState, before: Seen, found: Belief) -> ErrorState:
    """The state once fusion has turned what is seen of it from `before` into `found`.

    K = P H' S^-1, S = H P H', carries the change to every state: x + K (change of H x), P - K (S - C) K'
    with the covariance C found. With nothing learnt it changes nothing. ZeroDivisionError if S is singular.
    """
    (was_n, was_e), (nn, ne, ee) = before.belief
    (now_n, now_e), (c_nn, c_ne, c_ee) = found
    part = 1.0 / (nn * ee - ne * ne)
    i, j, k = ee * part, -ne * part, nn * part  # S^-1
    n, e = now_n - was_n, now_e - was_e
    a, b, d = nn - c_nn, ne - c_ne, ee - c_ee
    p, q, r, s = i * a + j * b, i * b + j * d, j * a + k * b, j * b + k * d  # S^-1 (S - C)
    cross = p * j + q * k
    lost = np.array(((p * i + q * j, cross), (cross, r * j + s * k)))  # S^-1 (S - C) S^-1
    x = state.x + np.array((i * n + j * e, j * n + k * e)) @ before.HP
    P = state.P - before.HP.T @ (lost @ before.HP)
    return ErrorState(state.t_ns, x, 0.5 * (P + P.T))


def absorb_velocity(
    state: ErrorState, H: Floats, velocity_error: Floats, sigma: float
) -> tuple[ErrorState, float]:
    """The state corrected by a measured INS velocity error H x (2,) m/s, Joseph's form; and the NIS of the
    innovation.
    """
    HP = H @ state.P
    S = HP @ H.T + sigma**2 * np.eye(2)
    nu = velocity_error - H @ state.x
    K = _over(HP, S)
    J = np.eye(len(state.x)) - K @ H
    P = J @ state.P @ J.T + sigma**2 * K @ K.T
    return ErrorState(state.t_ns, state.x + K @ nu, 0.5 * (P + P.T)), float(nu @ _over(nu, S))


def _over(X: Floats, S: Floats) -> Floats:
    """X' S^-1, X (2,) or (2, n), S (2, 2) symmetric; ZeroDivisionError where it is singular."""
    (a, b), (_, d) = S.tolist()
    part = 1.0 / (a * d - b * b)
    return X.T @ np.array(((d * part, -b * part), (-b * part, a * part)))


def is_sound(state: ErrorState | None) -> bool:
    """Whether the numbers are numbers and no variance is negative."""
    if state is None:
        return True
    squares = float(state.x @ state.x) + float(np.vdot(state.P, state.P))  # one that is no number spoils it
    return math.isfinite(squares) and min(state.P.diagonal().tolist()) >= 0.0


def shift(state: ErrorState, north: float, east: float, v_n: Vector2 | None = None) -> ErrorState:
    """The state after the channel itself jumped by (north, east) m: the error jumped with it, nothing else
    did. With `v_n` (m/s) its velocity jumped too, which is a state of its own then.
    """
    x = state.x.copy()
    x[POSITION] += north, east
    if v_n is not None:
        x[VELOCITY] += v_n
    return state._replace(x=x)


def blur(state: ErrorState, sigma: float, sigma_v: float = 0.0) -> ErrorState:
    """The state after the channel moved by nobody knows how much, `sigma` (m) north and as much east; and
    turned faster or slower by `sigma_v` (m/s) where its velocity error is a state.
    """
    P = state.P.copy()
    P[POSITION, POSITION] += sigma**2 * np.eye(2)
    P[VELOCITY, VELOCITY] += sigma_v**2 * np.eye(2)
    return state._replace(P=P)


def carried(H: Floats, dt: float, v_n: Vector3, unit: ErrorModel) -> Floats:
    """H of what is seen `dt` seconds after the state: the position error has moved on by its velocity."""
    return H + dt * unit.velocity_rows(v_n) if dt else H


def widen(state: ErrorState, factor: float) -> ErrorState:
    """The state with its covariance multiplied: what it claimed was proved wrong."""
    return state._replace(P=state.P * factor)
