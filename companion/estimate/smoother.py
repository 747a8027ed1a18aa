"""The whole flight at once: the most likely trajectory given all measurements, before and after (MAP).

    x_{i+1} = Phi_i x_i + Gamma_i theta_i,   theta_i ~ N(0, D_i),   x_0 ~ N(m, B)           i = 0..N-1
    z_{i+1} = H_{i+1} x_{i+1} + N(0, R_{i+1})                                               (6.4.5)-(6.4.7)

After Brandin et al., section 6.4, which ends in the two-point boundary problem

    x_0     = m + B Phi_0' s_0
    x_{i+1} = Phi_i x_i + Gamma_i D_i Gamma_i' s_i                                          (6.4.12)
    s_i     = Phi_{i+1}' s_{i+1} + H_{i+1}' R_{i+1}^-1 (z_{i+1} - H_{i+1} x_{i+1}),   s_N = 0

and theta_i = D_i Gamma_i' s_i (6.4.11). Three ways lead to it, and agree:

    rts           a Kalman filter forward, then back
    two_point     the sparse linear system itself (`boundary`)
    gauss_newton  the same for z = h(x) + N(0, R): linearised, solved, repeated, with a line search

DEPARTS FROM section 6.4: "shooting" s forward by Phi^-T is not offered. It multiplies rounding by the
growth of the unstable adjoint: 1e8 after 120 steps of the smallest example.

The lists Phi, Gamma, D, H, R, z have N entries each; the i-th H, R, z are those of x_{i+1}. Dimensions may
differ from epoch to epoch, an H of no rows (or z None) is an epoch without measurement. D and B may be
singular, R not. Memory and time grow as N. It does not know what the states mean, nor which z to believe.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from companion.estimate import kalman, two_point_bvp
from companion.estimate.linear_system import Gaps, Lists, Stage, stages_of

Array = npt.NDArray[np.float64]
Measured = Callable[[int, Array], tuple[npt.ArrayLike, npt.ArrayLike]]

_ARMIJO = 1e-4  # of the decrease that the linearised problem promises, at least this part must come
_SHORTEST = 2.0**-30


class Smoothed(NamedTuple):
    """The most likely trajectory.

    x (N+1, n) and P (N+1, n, n) given all measurements; s (N, n) the multipliers of (6.4.12). `theta` and
    `theta_P`, N arrays (q_i,) and (q_i, q_i): the disturbances, and how well they are known.
    """

    x: Array
    P: Array
    s: Array
    theta: tuple[Array, ...]
    theta_P: tuple[Array, ...]


class Iterated(NamedTuple):
    """What `gauss_newton` ended with: the trajectory, the criterion (6.4.8) twice over, the steps taken."""

    smoothed: Smoothed
    cost: float
    iterations: int

    @property
    def x(self) -> Array:
        """As in `Smoothed`."""
        return self.smoothed.x

    @property
    def P(self) -> Array:
        """As in `Smoothed`, of the problem linearised at the end."""
        return self.smoothed.P


class Filtered(NamedTuple):
    """x (N+1, n), P (N+1, n, n) given the measurements up to each epoch; the first is the prior."""

    x: Array
    P: Array


def rts(
    Phi: Lists, Gamma: Lists, D: Lists, H: Gaps, R: Gaps, z: Gaps, m: npt.ArrayLike, B: npt.ArrayLike
) -> Smoothed:
    """The smoothed trajectory by a filter forward and a pass backward over its innovations nu.

    Backward in the multipliers s (Bryson and Frazier, 1963) and the information M of what comes after, so
    that no predicted covariance is inverted, which may be singular here; with Y = M_{i+1} + H' R^-1 H,

        s_i = H' S^-1 nu + (I - K H)' Phi_{i+1}' s_{i+1},    M_i = Phi_i' (I + Y Q_i)^-1 Y Phi_i
        x_{i|N} = x_{i|i} + P_{i|i} Phi_i' s_i,              P_{i|N} = (I + P_{i|i} M_i)^-1 P_{i|i}

    which is Rauch, Tung and Striebel's where s_i = P_{i+1|i}^-1 (x_{i+1|N} - x_{i+1|i}) exists. No covariance
    is a difference of greater ones. This and `two_point` still lose digits alike to a prior
    wider by many powers of ten than what is learnt.
    """
    stages, m, B = stages_of(Phi, Gamma, D, H, R, z, m, B)
    N, n = len(stages), len(m)
    x, P = _forward(stages, m, B)
    scale = _scale(stages, B)
    s = np.zeros((N, n))
    theta, theta_P = [m] * N, [B] * N
    back, M = np.zeros(n), np.zeros((n, n))  # Phi' s of the stage after, and what is known of x from after it
    for i in range(N - 1, -1, -1):
        stage = stages[i]
        predicted = kalman.predict(x[i], P[i], stage.Phi, stage.Q)
        s[i] = back
        x[i + 1] += P[i + 1] @ back
        P[i + 1] = _tempered(P[i + 1], M, scale)
        if len(stage.z):
            G = kalman.gain(predicted.P, stage.H, stage.R)
            nu = stage.z - stage.H @ predicted.x
            s[i] = back + stage.H.T @ (G.S_inverse @ nu - G.K.T @ back)
            M = M + stage.H.T @ np.linalg.solve(stage.R, stage.H)
        L = _tempered(M, predicted.P, 1.0 / scale)
        theta[i], theta_P[i] = _disturbance(stage, s[i], L)
        back, M = stage.Phi.T @ s[i], stage.Phi.T @ _tempered(M, stage.Q, 1.0 / scale) @ stage.Phi
    x[0] += P[0] @ back
    P[0] = _tempered(P[0], M, scale)
    return Smoothed(x, P, s, tuple(theta), tuple(theta_P))


def filtered(
    Phi: Lists, Gamma: Lists, D: Lists, H: Gaps, R: Gaps, z: Gaps, m: npt.ArrayLike, B: npt.ArrayLike
) -> Filtered:
    """The forward pass of `rts` alone: what could be known at each epoch in flight."""
    stages, m, B = stages_of(Phi, Gamma, D, H, R, z, m, B)
    return _forward(stages, m, B)


def two_point(
    Phi: Lists, Gamma: Lists, D: Lists, H: Gaps, R: Gaps, z: Gaps, m: npt.ArrayLike, B: npt.ArrayLike
) -> Smoothed:
    """The smoothed trajectory as the solution of (6.4.12), a symmetric block-tridiagonal system.

    Nothing is filtered. The unknowns of block i are s_{i-1} and x_i; its inverse holds the covariances of x_i
    and, with the minus sign, of s_{i-1}.
    """
    stages, m, B = stages_of(Phi, Gamma, D, H, R, z, m, B)
    return _two_point(stages, m, B)[0]


def gauss_newton(
    Phi: Lists,
    Gamma: Lists,
    D: Lists,
    h: Measured,
    R: Gaps,
    z: Gaps,
    m: npt.ArrayLike,
    B: npt.ArrayLike,
    tolerance: float = 1e-9,
    steps: int = 50,
) -> Iterated:
    """The smoothed trajectory for nonlinear measurements z_i = h(i, x_i) + N(0, R_i).

    `h(i, x)` returns the value (p,) and its Jacobian H (p, n) for list entry i at x (n,), an angle within
    half a turn of z_i. Each step solves the problem linearised along the last trajectory and goes towards its
    solution as far as the criterion (6.4.8) falls. It ends once a full step is shorter than `tolerance`
    standard deviations everywhere. ValueError where it does not end, or where h does not fit z.
    """
    n = np.size(m)
    none = [None if each is None else np.zeros((np.size(each), n)) for each in z]
    stages, m, B = stages_of(Phi, Gamma, D, none, R, z, m, B)
    at = _Iterate(_carried(stages, m), np.zeros((len(stages) + 1, n)))
    for iteration in range(1, steps + 1):
        linear, cost = _linearised(stages, h, at, B)
        smoothed, s = _two_point(linear, m, B)
        step = _Iterate(smoothed.x - at.x, s - at.s)
        variance = np.einsum("ijj->ij", smoothed.P)
        still = (step.x**2 <= tolerance**2 * variance + 1e-30 * smoothed.x**2).all()
        if still:
            return Iterated(smoothed, cost, iteration)
        promised = cost - _quadratic(stages, B, s) - _misfit(linear, smoothed.x)
        at = _searched(stages, h, at, step, cost, promised, B)
    raise ValueError(f"no minimum of the criterion within {steps} steps: give a nearer m or a greater R")


class _Iterate(NamedTuple):
    """A trajectory x (N+1, n) that obeys the dynamics, with the multipliers that make it: s_{-1}..s_{N-1}."""

    x: Array
    s: Array


def _searched(
    stages: list[Stage], h: Measured, at: _Iterate, step: _Iterate, cost: float, promised: float, B: Array
) -> _Iterate:
    """Backtracking: half the step until the criterion falls as Armijo asks. The linearised one is a parabola
    with its least value a whole step away, so that its slope here is -2 promised.
    """
    length = 1.0
    while length > _SHORTEST:
        trial = _Iterate(at.x + length * step.x, at.s + length * step.s)
        if _linearised(stages, h, trial, B)[1] <= cost - 2.0 * _ARMIJO * length * promised + 1e-13 * cost:
            return trial
        length *= 0.5
    raise ValueError("no step lowers the criterion: the Jacobian that h returns is not that of its value")


def _linearised(stages: list[Stage], h: Measured, at: _Iterate, B: Array) -> tuple[list[Stage], float]:
    """The problem linear around a trajectory, z - h(x) + H x for z, and the criterion there."""
    linear, cost = [], _quadratic(stages, B, at.s)
    for i, stage in enumerate(stages):
        if not len(stage.z):
            linear.append(stage)
            continue
        value, jacobian = h(i, at.x[i + 1])
        value, H = np.atleast_1d(np.asarray(value, float)), np.atleast_2d(np.asarray(jacobian, float))
        if value.shape != stage.z.shape or H.shape != stage.H.shape:
            shapes = f"{value.shape} and {H.shape} for z {stage.z.shape} and {H.shape[-1]} states"
            raise ValueError(f"h({i}, x) returns value and Jacobian of shapes {shapes}: make them fit")
        r = stage.z - value
        cost += float(r @ np.linalg.solve(stage.R, r))
        linear.append(stage._replace(H=H, z=r + H @ at.x[i + 1]))
    return linear, cost


def _misfit(linear: list[Stage], x: Array) -> float:
    """The sum of squared residuals of the linear measurements, in standard deviations."""
    total = 0.0
    for i, stage in enumerate(linear):
        r = stage.z - stage.H @ x[i + 1]
        total += float(r @ np.linalg.solve(stage.R, r))
    return total


def _quadratic(stages: list[Stage], B: Array, s: Array) -> float:
    """The prior and the disturbances in (6.4.8) by their multipliers, which needs no inverse of B or D."""
    return float(s[0] @ B @ s[0]) + sum(float(a @ b.Q @ a) for a, b in zip(s[1:], stages, strict=True))


def _carried(stages: list[Stage], m: Array) -> Array:
    x = [m]
    for stage in stages:
        x.append(stage.Phi @ x[-1])
    return np.array(x)


def _forward(stages: list[Stage], m: Array, B: Array) -> Filtered:
    N, n = len(stages), len(m)
    x, P = np.zeros((N + 1, n)), np.zeros((N + 1, n, n))
    x[0], P[0] = m, B
    for i, stage in enumerate(stages):
        x[i + 1], P[i + 1] = kalman.predict(x[i], P[i], stage.Phi, stage.Q)
        if len(stage.z):
            x[i + 1], P[i + 1] = kalman.correct(x[i + 1], P[i + 1], stage.z, stage.H, stage.R)[:2]
    return Filtered(x, P)


def _two_point(stages: list[Stage], m: Array, B: Array) -> tuple[Smoothed, Array]:
    """The trajectory, and s (N+1, n) with the multiplier of the prior, s_{-1} = Phi_0' s_0, before it."""
    N, n = len(stages), len(m)
    scale = _scale(stages, B)
    outer = np.outer(scale, scale)
    one = np.eye(n)
    diagonal, lower = np.zeros((N + 1, 2 * n, 2 * n)), np.zeros((N, n, n))
    right = np.zeros((N + 1, 2 * n))
    diagonal[:, :n, n:] = diagonal[:, n:, :n] = one
    diagonal[0, :n, :n], right[0, :n] = -B / outer, m / scale
    for i, stage in enumerate(stages):
        diagonal[i + 1, :n, :n] = -stage.Q / outer
        lower[i] = -stage.Phi * scale / scale[:, None]
        if len(stage.z):
            HP = np.linalg.solve(stage.R, stage.H * scale).T
            diagonal[i + 1, n:, n:] = HP @ stage.H * scale
            right[i + 1, n:] = HP @ stage.z
    y, inverse = two_point_bvp.solve(diagonal, lower, right)
    s, x = y[:, :n] / scale, y[:, n:] * scale
    P, L = inverse[:, n:, n:] * outer, -inverse[1:, :n, :n] / outer
    disturbances = [_disturbance(stage, a, b) for stage, a, b in zip(stages, s[1:], L, strict=True)]
    theta, theta_P = zip(*disturbances, strict=True)
    return Smoothed(x, P, s[1:], theta, theta_P), s


def _scale(stages: list[Stage], B: Array) -> Array:
    """Of each state (n,), so that metres and microradians weigh alike in the linear algebra."""
    variance = np.diag(B) + sum(np.diag(stage.Q) for stage in stages)
    return np.sqrt(np.where(variance > 0.0, variance, 1.0))


def _disturbance(stage: Stage, s: Array, L: Array) -> tuple[Array, Array]:
    """theta = D Gamma' s (6.4.11), and its covariance, from s and the covariance L of s."""
    DG = stage.D @ stage.Gamma.T
    return DG @ s, stage.D - DG @ L @ DG.T


def _tempered(A: Array, B: Array, scale: Array) -> Array:
    """(I + A B)^-1 A for symmetric A, B >= 0, exactly symmetric; A's variables are of the size of `scale`."""
    outer = np.outer(scale, scale)
    a = A / outer
    X = np.linalg.solve(np.eye(len(A)) + a @ (B * outer), a) * outer
    symmetric: Array = 0.5 * (X + X.T)
    return symmetric
