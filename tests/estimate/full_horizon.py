"""Full-horizon restrictive estimate: the exact solution by which the recursive filters are judged.

Minimise the weighted squares of X(0), W, N under X(t+1) = A X(t) + B U(t) + W(t), Z = H X + N, |U_i| <= C_i.
The conditions of the optimum are the two-point problem of Poddubny, section 2:

    X(t+1) = A X(t) + B U(t) + Q l(t+1),   X(0) = x0 + P0 l(0),                          (state)
    l(t) = A' l(t+1) + H' R^-1 (Z(t) - H X(t)),   l(T+1) = 0,   l(0) = A' l(1)            (adjoint)
    U_i(t) = C_i sign (B' l(t+1))_i, and where that is zero |U_i| <= C_i                  (bounds)

It is not solved in that form. The Kalman filter with U = 0 gives innovations nu_t, and these depend linearly
on the inputs: nu_t - D_t u, with D_t = H (A G_{t-1} + [0 .. B .. 0]), G_t = (I - K H)(A G_{t-1} + [0 .. B ..
0]). What remains is min 1/2 sum |nu_t - D_t u|^2_{S_t^-1} in the box, with m T unknowns and well conditioned
(1e2-1e4 for hours of flight). Given U, one backward pass (Bryson, Frazier) gives the states and the adjoint.
It inverts no covariance: P0 = 0 and singular Q are allowed.
"""

from typing import NamedTuple

import numpy as np
from scipy.optimize import lsq_linear

from companion.estimate import bounded_lsq, kalman
from companion.estimate.bounded_lsq import BoxMinimum
from companion.units import Floats


class FullHorizonEstimate(NamedTuple):
    """The estimate over a record of T samples.

    `x` (T+1, n) states given the whole record, the last one is the filter's; `P` (n, n) of the last state,
    conditional on the active set; `u` (T, m) inputs, u[t] leads from x[t] to x[t+1]; `status` (T, m) -1 or +1
    on a bound, 0 inside; `l` (T+2, n) adjoint, l[0] = A' l[1].
    """

    x: Floats
    P: Floats
    u: Floats
    status: bounded_lsq.Status
    l: Floats


def solve(
    x0: Floats, P0: Floats, Z: Floats, A: Floats, B: Floats, Q: Floats, H: Floats, R: Floats, C: Floats
) -> FullHorizonEstimate:
    """Estimate all states of a record; Z[t] measures x[t+1], and P0 may be singular."""
    T, (n, m) = len(Z), B.shape
    x, P, G = x0, P0, np.zeros((n, m * T))
    rows, residuals = [], []
    for t, z in enumerate(Z):
        x, P = kalman.predict(x, P, A, Q)
        G = A @ G
        G[:, m * t : m * (t + 1)] = B * C
        S, _, K = kalman.gain(P, H, R)
        D, nu = H @ G, z - H @ x
        white = np.linalg.solve(np.linalg.cholesky(S), np.column_stack([nu, D]))
        residuals.append(white[:, 0])
        rows.append(white[:, 1:])
        x, P, G = x + K @ nu, kalman.joseph(P, K, H, R), G - K @ D
    best = least_squares(np.concatenate(rows), np.concatenate(residuals))
    u = best.v.reshape(T, m) * C
    states, l = _trajectory(x0, P0, Z, u, (A, B, Q, H, R))
    return FullHorizonEstimate(states, P + G @ best.free_inverse @ G.T, u, best.status.reshape(T, m), l)


def _trajectory(
    x0: Floats, P0: Floats, Z: Floats, u: Floats, model: tuple[Floats, Floats, Floats, Floats, Floats]
) -> tuple[Floats, Floats]:
    """States (T+1, n) and adjoint (T+2, n) for given inputs: filter forward, Bryson-Frazier backward."""
    A, B, Q, H, R = model
    x, P = x0, P0
    forward = []
    for z, u_t in zip(Z, u, strict=True):
        x, P = kalman.predict(x, P, A, Q)
        x = x + B @ u_t
        _, S_inverse, K = kalman.gain(P, H, R)
        nu = z - H @ x
        forward.append((x, P, K, H.T @ (S_inverse @ nu)))
        x, P = x + K @ nu, kalman.joseph(P, K, H, R)
    T = len(Z)
    l, states = np.zeros((T + 2, len(x0))), np.empty((T + 1, len(x0)))
    for t in range(T, 0, -1):
        x, P, K, pull = forward[t - 1]
        propagated = A.T @ l[t + 1]
        l[t] = pull + propagated - H.T @ (K.T @ propagated)
        states[t] = x + P @ l[t]
    l[0] = A.T @ l[1]
    states[0] = x0 + P0 @ l[0]
    return states, l


def least_squares(D: Floats, r: Floats) -> BoxMinimum:
    """Minimise 1/2 |r - D v|^2 over |v_i| <= 1 by BVLS, for any number of unknowns.

    The method of Stark and Parker ends on an active set, so that it is as exact as the linear algebra. 600
    samples of two inputs take about two seconds; an interior-point solver takes 0.2 s and stops 1e-8 short.
    """
    m = D.shape[1]
    M = D.T @ D
    weight = bounded_lsq.prior_information(M)
    if weight.any():
        D, r, M = np.vstack([D, weight]), np.concatenate([r, np.zeros(m)]), M + weight
    found = lsq_linear(D, r, (-np.ones(m), np.ones(m)), method="bvls", tol=1e-15, max_iter=10 * m + 100)
    assert found.status > 0, found.message
    status = found.active_mask.astype(np.int8)
    free = status == 0
    inverse = np.zeros((m, m))
    inverse[np.ix_(free, free)] = np.linalg.inv(M[np.ix_(free, free)])
    return BoxMinimum(np.where(free, found.x, status), status, inverse)
