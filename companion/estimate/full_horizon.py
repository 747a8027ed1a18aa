"""The exact restrictive estimate over a whole record, by which the recursive filters are judged.

Minimise the weighted squares of X(0), W, N under X(t+1) = A X(t) + B U(t) + W(t), Z = H X + N, |U_i| <= C_i.
The conditions of the optimum are the two-point problem of Poddubny, section 2:

    X(t+1) = A X(t) + B U(t) + Q l(t+1),   X(0) = x0 + P0 l(0),                          (state)
    l(t) = A' l(t+1) + H' R^-1 (Z(t) - H X(t)),   l(T+1) = 0,   l(0) = A' l(1)            (adjoint)
    U_i(t) = C_i sign (B' l(t+1))_i, and where that is zero |U_i| <= C_i                  (bounds)

It is not solved as such. The Kalman filter with U = 0 gives innovations nu_t, and these depend on the inputs
linearly: nu_t - D_t u, with D_t = H (A G_{t-1} + [0 .. B .. 0]), G_t = (I - K H)(A G_{t-1} + [0 .. B .. 0]).
What remains is min 1/2 sum |nu_t - D_t u|^2_{S_t^-1} within the box, of m T unknowns and well conditioned
(1e2-1e4 for hours of flight). Given U, the states and the adjoint follow from one backward pass (Bryson,
Frazier), which inverts no covariance: P0 = 0 and singular Q are welcome.

It does not know about time: one call is one record, memory grows as (m T)^2.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from companion.estimate import bounded_lsq, kalman
from companion.estimate.kalman import Array


class Sample(NamedTuple):
    """One step: the measurement z (p,) at its end and the model that leads to it; C (m,) bounds the input."""

    z: Array
    A: Array
    B: Array
    Q: Array
    H: Array
    R: Array
    C: Array


class Condensed(NamedTuple):
    """Record of T samples with only the inputs unknown: 1/2 |r - D v|^2, v = u / C, m T of them.

    x, P, G: the filter with U = 0 at the end, X(T|T) = x + G v; S the innovation covariance of the last
    sample.
    """

    D: Array
    r: Array
    x: Array
    P: Array
    G: Array
    S: Array


class Exact(NamedTuple):
    """x (T+1, n) the states given the whole record, the last of them the filter's; P (n, n) of that last one.

    u (T, m) leads from x[t] to x[t+1], status its place -1, 0, +1; l (T+2, n) the adjoint, l[0] = A' l[1].
    """

    x: Array
    P: Array
    u: Array
    status: bounded_lsq.Status
    l: Array


def exact(
    x0: Array, P0: Array, Z: Array, A: Array, B: Array, Q: Array, H: Array, R: Array, C: Array
) -> Exact:
    """Box-constrained maximum likelihood from Z (T, p), Z[t] measuring x[t+1], for constant matrices."""
    samples = [Sample(z, A, B, Q, H, R, C) for z in Z]
    record = condense(x0, P0, samples)
    best = bounded_lsq.least_squares(record.D, record.r)
    u = best.v.reshape(len(samples), -1) * C
    x, l = trajectory(x0, P0, samples, u)
    P = record.P + record.G @ best.free_inverse @ record.G.T
    return Exact(x, P, u, best.status.reshape(u.shape), l)


def condense(x: Array, P: Array, samples: Sequence[Sample]) -> Condensed:
    """Run the Kalman filter with U = 0 and keep what its whitened innovations owe to each input."""
    m = samples[0].B.shape[1]
    G = np.zeros((len(x), m * len(samples)))
    rows, r, S = [], [], P[:0, :0]
    for t, (z, A, B, Q, H, R, C) in enumerate(samples):
        x, P = kalman.predict(x, P, A, Q)
        G = A @ G
        G[:, m * t : m * (t + 1)] = B * C
        S, _, K = kalman.gain(P, H, R)
        D, nu = H @ G, z - H @ x
        white = np.linalg.solve(np.linalg.cholesky(S), np.column_stack([nu, D]))
        r.append(white[:, 0])
        rows.append(white[:, 1:])
        x, P, G = x + K @ nu, kalman.joseph(P, K, H, R), G - K @ D
    return Condensed(np.concatenate(rows), np.concatenate(r), x, P, G, S)


def trajectory(x0: Array, P0: Array, samples: Sequence[Sample], u: Array) -> tuple[Array, Array]:
    """States (T+1, n) and adjoint (T+2, n) given u (T, m): forward filter, backward Bryson-Frazier."""
    x, P = x0, P0
    passed = []
    for (z, A, B, Q, H, R, _), u_t in zip(samples, u, strict=True):
        x, P = kalman.predict(x, P, A, Q)
        x = x + B @ u_t
        _, S_inverse, K = kalman.gain(P, H, R)
        nu = z - H @ x
        passed.append((x, P, K, H.T @ (S_inverse @ nu)))
        x, P = x + K @ nu, kalman.joseph(P, K, H, R)
    T = len(samples)
    l = np.zeros((T + 2, len(x0)))
    states = np.empty((T + 1, len(x0)))
    carried = l[T + 1]  # A' l(t+1)
    for t in range(T, 0, -1):
        x, P, K, pull = passed[t - 1]
        l[t] = pull + carried - samples[t - 1].H.T @ (K.T @ carried)
        states[t] = x + P @ l[t]
        carried = samples[t - 1].A.T @ l[t]
    l[0] = carried
    states[0] = x0 + P0 @ carried
    return states, l
