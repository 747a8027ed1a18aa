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

It does not know time: one call is one record, memory grows as (m T)^2.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from companion.estimate import bounded_lsq, kalman
from companion.units import Floats


class Sample(NamedTuple):
    """One step of the record.

    Attributes
    ----------
    z : (p,)
        Measurement at the end of the step.
    A : (n, n)
        Transition.
    B : (n, m)
        Influence of the bounded inputs.
    Q : (n, n)
        Process noise covariance.
    H : (p, n)
        Measurement matrix.
    R : (p, p)
        Measurement noise covariance.
    C : (m,)
        Bounds of the inputs in this step.
    """

    z: Floats
    A: Floats
    B: Floats
    Q: Floats
    H: Floats
    R: Floats
    C: Floats


class Condensed(NamedTuple):
    """Record of T samples with only the inputs unknown: minimise 1/2 |r - D v|^2, v = u / C.

    Attributes
    ----------
    D : (T p, T m)
        Whitened influence of the scaled inputs on the innovations.
    r : (T p,)
        Whitened innovations of the filter with U = 0.
    x, P : (n,), (n, n)
        That filter at the end of the record.
    G : (n, T m)
        Influence of v on the last state: X(T|T) = x + G v.
    """

    D: Floats
    r: Floats
    x: Floats
    P: Floats
    G: Floats


class FullHorizonEstimate(NamedTuple):
    """Exact restrictive estimate over a record of T samples.

    Attributes
    ----------
    x : (T+1, n)
        States given the whole record; the last one is the filter's.
    P : (n, n)
        Covariance of the last state, conditional on the active set.
    u : (T, m)
        Inputs; u[t] leads from x[t] to x[t+1].
    status : (T, m)
        -1 or +1 on a bound, 0 inside.
    l : (T+2, n)
        Adjoint, l[0] = A' l[1].
    """

    x: Floats
    P: Floats
    u: Floats
    status: bounded_lsq.Status
    l: Floats


def solve_full_horizon(
    x0: Floats, P0: Floats, Z: Floats, A: Floats, B: Floats, Q: Floats, H: Floats, R: Floats, C: Floats
) -> FullHorizonEstimate:
    """Estimate all states of a record by box-constrained maximum likelihood, for constant matrices.

    Parameters
    ----------
    x0, P0 : (n,), (n, n)
        Prior of the initial state; P0 may be singular.
    Z : (T, p)
        Measurements; Z[t] measures x[t+1].
    A, B, Q, H, R
        Constant model matrices, as in `Sample`.
    C : (m,)
        Bounds of the inputs in one step.

    Returns
    -------
    FullHorizonEstimate
        States, covariance of the last state, inputs, their status and the adjoint.

    References
    ----------
    Poddubny, section 2.
    """
    samples = [Sample(z, A, B, Q, H, R, C) for z in Z]
    record = condense(x0, P0, samples)
    best = bounded_lsq.least_squares(record.D, record.r)
    u = best.v.reshape(len(samples), -1) * C
    x, l = reconstruct_trajectory(x0, P0, samples, u)
    P = record.P + record.G @ best.free_inverse @ record.G.T
    return FullHorizonEstimate(x, P, u, best.status.reshape(u.shape), l)


def condense(x: Floats, P: Floats, samples: Sequence[Sample]) -> Condensed:
    """Eliminate the states: run the Kalman filter with U = 0 and keep the influence of each input.

    Parameters
    ----------
    x, P : (n,), (n, n)
        Prior of the initial state.
    samples : sequence of Sample
        The record.

    Returns
    -------
    Condensed
        Whitened least-squares problem in the inputs alone.
    """
    m = samples[0].B.shape[1]
    G = np.zeros((len(x), m * len(samples)))
    rows, r = [], []
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
    return Condensed(np.concatenate(rows), np.concatenate(r), x, P, G)


def reconstruct_trajectory(
    x0: Floats, P0: Floats, samples: Sequence[Sample], u: Floats
) -> tuple[Floats, Floats]:
    """Compute states and adjoint for given inputs: filter forward, Bryson-Frazier backward.

    Parameters
    ----------
    x0, P0 : (n,), (n, n)
        Prior of the initial state.
    samples : sequence of Sample
        The record, T samples.
    u : (T, m)
        Inputs.

    Returns
    -------
    tuple
        States (T+1, n) and adjoint (T+2, n).
    """
    x, P = x0, P0
    forward = []
    for (z, A, B, Q, H, R, _), u_t in zip(samples, u, strict=True):
        x, P = kalman.predict(x, P, A, Q)
        x = x + B @ u_t
        _, S_inverse, K = kalman.gain(P, H, R)
        nu = z - H @ x
        forward.append((x, P, K, H.T @ (S_inverse @ nu)))
        x, P = x + K @ nu, kalman.joseph(P, K, H, R)
    T = len(samples)
    l = np.zeros((T + 2, len(x0)))
    states = np.empty((T + 1, len(x0)))
    propagated = l[T + 1]  # A' l(t+1)
    for t in range(T, 0, -1):
        x, P, K, pull = forward[t - 1]
        l[t] = pull + propagated - samples[t - 1].H.T @ (K.T @ propagated)
        states[t] = x + P @ l[t]
        propagated = samples[t - 1].A.T @ l[t]
    l[0] = propagated
    states[0] = x0 + P0 @ propagated
    return states, l
