"""Smoothing: the most likely trajectory (MAP) given all measurements, before and after.

    x_{i+1} = Phi_i x_i + Gamma_i theta_i,   theta_i ~ N(0, D_i),   x_0 ~ N(m, B)           i = 0..N-1
    z_{i+1} = H_{i+1} x_{i+1} + N(0, R_{i+1})                                               (6.4.5)-(6.4.7)

After Brandin et al., section 6.4, which ends in the two-point boundary problem

    x_0     = m + B Phi_0' s_0
    x_{i+1} = Phi_i x_i + Gamma_i D_i Gamma_i' s_i                                          (6.4.12)
    s_i     = Phi_{i+1}' s_{i+1} + H_{i+1}' R_{i+1}^-1 (z_{i+1} - H_{i+1} x_{i+1}),   s_N = 0

where theta_i = D_i Gamma_i' s_i (6.4.11). Two algorithms solve it, and agree:

    rts        a Kalman filter forward, then a pass backward
    two_point  the sparse linear system itself (`two_point_bvp`)

`rts_backward` is the backward pass alone, over the stored states of any forward filter, for filters whose
updates are nonlinear or gated.

DEPARTS FROM section 6.4: "shooting" s forward by Phi^-T is not offered. It multiplies rounding by the
growth of the unstable adjoint: 1e8 after 120 steps of the smallest example.

Memory and time grow as N. It does not know what the states mean and rejects no z.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from companion.estimate import kalman, two_point_bvp
from companion.estimate.kalman import Gaussian
from companion.estimate.linear_system import LinearSystem
from companion.units import Floats


class Smoothed(NamedTuple):
    """Most likely trajectory.

    Attributes
    ----------
    x : (N+1, n)
        Means given all measurements.
    P : (N+1, n, n)
        Their covariances.
    s : (N, n)
        Multipliers of (6.4.12).
    """

    x: Floats
    P: Floats
    s: Floats


def rts(system: LinearSystem) -> Smoothed:
    """Smooth a linear Gaussian system by a filter forward and a pass backward over its innovations nu.

    Backward in the multipliers s (Bryson and Frazier, 1963) and the information M of the later measurements,
    so that no predicted covariance is inverted, which may be singular here; with Y = M_{i+1} + H' R^-1 H,

        s_i = H' S^-1 nu + (I - K H)' Phi_{i+1}' s_{i+1},    M_i = Phi_i' (I + Y Q_i)^-1 Y Phi_i
        x_{i|N} = x_{i|i} + P_{i|i} Phi_i' s_i,              P_{i|N} = (I + P_{i|i} M_i)^-1 P_{i|i}

    which equals `rts_backward` where s_i = P_{i+1|i}^-1 (x_{i+1|N} - x_{i+1|i}) exists. No covariance is a
    difference of larger ones. This and `two_point` both lose digits to a prior wider by many powers of ten
    than the posterior.

    Parameters
    ----------
    system : LinearSystem
        The system and its measurements.

    Returns
    -------
    Smoothed
        Most likely trajectory.

    References
    ----------
    Brandin et al. (6.4.5)-(6.4.12); Bryson, Frazier (1963).
    """
    n = len(system.m)
    x, P = forward_filter(system)
    scale = _state_scale(system)
    s = np.zeros((len(system.stages), n))
    back, M = np.zeros(n), np.zeros((n, n))  # Phi' s and the information of the later stages
    for i, stage in reversed(list(enumerate(system.stages))):
        s[i] = back
        x[i + 1] += P[i + 1] @ back
        P[i + 1] = _reduce(P[i + 1], M, scale)
        if len(stage.z):
            predicted = kalman.predict(x[i], P[i], stage.Phi, stage.Q)
            G = kalman.gain(predicted.P, stage.H, stage.R)
            nu = stage.z - stage.H @ predicted.x
            s[i] = back + stage.H.T @ (G.S_inverse @ nu - G.K.T @ back)
            M = M + stage.H.T @ np.linalg.solve(stage.R, stage.H)
        back, M = stage.Phi.T @ s[i], stage.Phi.T @ _reduce(M, stage.Q, 1.0 / scale) @ stage.Phi
    x[0] += P[0] @ back
    P[0] = _reduce(P[0], M, scale)
    return Smoothed(x, P, s)


def rts_backward(
    x: Floats, P: Floats, predicted: Sequence[Floats], Phi: Sequence[Floats], Q: Sequence[Floats]
) -> Gaussian:
    """Smooth the stored states of a forward filter by the recursion of Rauch, Tung and Striebel.

    Needs nothing of the measurements: the filter's updates may be nonlinear or gated. With
    C = P_k Phi' P_{k+1|k}^-1,

        x_{k|N} = x_k + C (x_{k+1|N} - x_{k+1|k})
        P_{k|N} = (I - C Phi) P_k (I - C Phi)' + C (P_{k+1|N} + Q) C'

    Parameters
    ----------
    x, P : (N+1, n), (N+1, n, n)
        Filter's states after the measurement of each epoch.
    predicted : sequence of N arrays (n,)
        Mean at epoch k+1 before its measurement.
    Phi, Q : sequences of N arrays (n, n)
        Transition and noise covariance from epoch k to k+1; Phi P Phi' + Q must be invertible.

    Returns
    -------
    Gaussian
        Smoothed states; the last is the filter's.

    References
    ----------
    Rauch, Tung, Striebel (1965).
    """
    x, P = x.copy(), P.copy()
    identity = np.eye(x.shape[1])
    for k in range(len(x) - 2, -1, -1):
        ahead = Phi[k] @ P[k] @ Phi[k].T + Q[k]
        scale = np.sqrt(np.diag(ahead))  # invert the correlations: states may be metres and microradians
        C = np.linalg.solve(ahead / np.outer(scale, scale), (Phi[k] @ P[k]) / scale[:, None]).T / scale
        x[k] += C @ (x[k + 1] - predicted[k])
        J = identity - C @ Phi[k]
        P_k = J @ P[k] @ J.T + C @ (P[k + 1] + Q[k]) @ C.T
        P[k] = 0.5 * (P_k + P_k.T)
    return Gaussian(x, P)


def forward_filter(system: LinearSystem) -> Gaussian:
    """Run the Kalman filter of `rts` alone: the estimate available at each epoch in flight.

    Parameters
    ----------
    system : LinearSystem
        The system and its measurements.

    Returns
    -------
    Gaussian
        States given the measurements up to each epoch; the first is the prior.
    """
    N, n = len(system.stages), len(system.m)
    x, P = np.zeros((N + 1, n)), np.zeros((N + 1, n, n))
    x[0], P[0] = system.m, system.B
    for i, stage in enumerate(system.stages):
        x[i + 1], P[i + 1] = kalman.predict(x[i], P[i], stage.Phi, stage.Q)
        if len(stage.z):
            x[i + 1], P[i + 1] = kalman.update(x[i + 1], P[i + 1], stage.z, stage.H, stage.R)
    return Gaussian(x, P)


def two_point(system: LinearSystem) -> Smoothed:
    """Smooth a linear Gaussian system by solving (6.4.12), a symmetric block-tridiagonal system.

    Nothing is filtered. The unknowns of block i are s_{i-1} and x_i; its inverse holds the covariances of x_i
    and, with the minus sign, of s_{i-1}.

    Parameters
    ----------
    system : LinearSystem
        The system and its measurements.

    Returns
    -------
    Smoothed
        Most likely trajectory.

    References
    ----------
    Brandin et al. (6.4.12).
    """
    (stages, m, B), N, n = system, len(system.stages), len(system.m)
    scale = _state_scale(system)
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
    s, x = y[1:, :n] / scale, y[:, n:] * scale
    return Smoothed(x, inverse[:, n:, n:] * outer, s)


def _state_scale(system: LinearSystem) -> Floats:
    """Choose a scale for each state (n,), so that metres and microradians weigh alike."""
    variance = np.diag(system.B) + sum(np.diag(stage.Q) for stage in system.stages)
    return np.sqrt(np.where(variance > 0.0, variance, 1.0))


def _reduce(A: Floats, B: Floats, scale: Floats) -> Floats:
    """Compute (I + A B)^-1 A for symmetric A, B >= 0, exactly symmetric; `scale` is that of A's variables."""
    outer = np.outer(scale, scale)
    a = A / outer
    X = np.linalg.solve(np.eye(len(A)) + a @ (B * outer), a) * outer
    symmetric: Floats = 0.5 * (X + X.T)
    return symmetric
