"""Restrictive filter R1: some inputs are not random but bounded.

    X(t+1) = A X(t) + B U(t) + W(t),   |U_i| <= C_i,   Z = H X + N                             (2.7)-(2.9)

Maximum likelihood of X(0), W, N under the bounds gives a two-point problem with saturations. Invariant
imbedding with a linear approximation at every step turns it into a Kalman filter whose covariance depends on
the data (Poddubny, section 2). One step finds the best input within the bounds

    U* = argmin 1/2 |nu - D u|^2_{S^-1},   |u_i| <= C_i,   D = H B,

and then treats the inputs on a bound as known numbers, those inside (f) as unknown:

    X+ = A X + B U* + K (nu - D U*),   P+ = P1 + (B_f - K D_f) (D_f' S^-1 D_f)^-1 (B_f - K D_f)'.

The box problem is solved exactly: clipping the free solution component by component is wrong as soon as D'
S^-1 D is not diagonal. For C -> 0 and C -> inf the filter is exact. Between them P is conditional on the
active sets and overconfident: it is not a guarantee. The tests compare it with the exact solution.

It does not know what U is. The bounds are those of one step: a finer step with the same C is another problem.
"""

from typing import NamedTuple

import numpy as np

from companion.estimate import bounded_lsq, kalman
from companion.units import Floats


class RestrictiveEstimate(NamedTuple):
    """State after one step.

    Attributes
    ----------
    x : (..., n)
        Mean.
    P : (..., n, n)
        Covariance, conditional on the active set.
    u : (..., m)
        Inputs of the step, in their own unit.
    status : (..., m)
        -1 or +1 on a bound, 0 inside.
    """

    x: Floats
    P: Floats
    u: Floats
    status: bounded_lsq.Status


def step(
    x: Floats,
    P: Floats,
    z: Floats,
    A: Floats,
    B: Floats,
    Q: Floats,
    H: Floats,
    R: Floats,
    C: Floats,
    kappa: float = np.inf,
) -> RestrictiveEstimate:
    """Predict over one step with bounded inputs and update by its measurement.

    An input that this measurement does not determine takes the prior kappa = 1, the minimax filter's (see
    `bounded_lsq.prior_information`).

    Parameters
    ----------
    x, P : (..., n), (..., n, n)
        X(t|t) and P(t|t); leading axes are flights.
    z : (..., p)
        Measurement z(t+1).
    A : (n, n)
        Transition.
    B : (n, m)
        Influence of the inputs.
    Q : (n, n)
        Process noise covariance.
    H : (p, n)
        Measurement matrix.
    R : (p, p)
        Measurement noise covariance.
    C : (m,)
        Bounds of the inputs in one step.
    kappa : float
        Prior variance of an input over its squared bound; inf for bounds only.

    Returns
    -------
    RestrictiveEstimate
        X(t+1|t+1), P(t+1|t+1), and the inputs found.

    References
    ----------
    Poddubny (2.7)-(2.9) and section 2.
    """
    Ax, Pb = kalman.predict(x, P, A, Q)
    _, S_inverse, K = kalman.gain(Pb, H, R)
    nu = z - Ax @ H.mT
    BC = B * C
    DC = H @ BC  # inputs in units of their bounds
    SD = S_inverse @ DC
    M = DC.T @ SD
    best = bounded_lsq.minimize_quadratic(
        M + bounded_lsq.prior_information(M, kappa), (SD.mT @ nu[..., None])[..., 0]
    )
    left = nu - best.v @ DC.T  # the part that no input can explain
    W = BC - K @ DC
    rebuilt = kalman.joseph(Pb, K, H, R)
    rebuilt += W @ best.free_inverse @ W.mT
    return RestrictiveEstimate(
        x=Ax + best.v @ BC.T + (K @ left[..., None])[..., 0],
        P=rebuilt,
        u=best.v * C,
        status=best.status,
    )
