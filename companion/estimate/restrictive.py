"""The restrictive filter R1: some inputs are not random, only bounded.

    X(t+1) = A X(t) + B U(t) + W(t),   |U_i| <= C_i,   Z = H X + N                             (2.7)-(2.9)

Maximum likelihood of X(0), W, N under the bounds gives a two-point problem with saturations; invariant
imbedding with a linear approximation step by step turns it into a Kalman filter whose covariance is rebuilt
by the data at every step (Poddubny, section 2). One step: find the best input within the bounds

    U* = argmin 1/2 |nu - D u|^2_{S^-1},   |u_i| <= C_i,   D = H B,

then the inputs on a bound are known numbers, and those inside (f) unknown ones:

    X+ = A X + B U* + K (nu - D U*),   P+ = P1 + (B_f - K D_f) (D_f' S^-1 D_f)^-1 (B_f - K D_f)'.

The box is solved exactly: clipping the free solution component by component is wrong as soon as D' S^-1 D is
not diagonal. For C -> 0 and C -> inf the filter is exact; between them P is conditional on the active sets
and overconfident: never a guarantee. `moving_horizon` has windows longer than one step, `full_horizon` the
exact solution by which both are judged.

It does not know what U is. The bounds are those of one step: a finer step with the same C is another problem.
"""

from typing import NamedTuple

import numpy as np

from companion.estimate import bounded_lsq, kalman
from companion.estimate.full_horizon import exact
from companion.estimate.kalman import Array

__all__ = ["Restricted", "exact", "step"]


class Restricted(NamedTuple):
    """Mean (..., n), covariance, bounded inputs (..., m) and where they lie: -1 and +1 on a bound, 0 inside.

    The innovation (..., p) is nu - D U*, what no input can explain, with the S and NIS of the known-input
    filter.
    """

    x: Array
    P: Array
    u: Array
    status: bounded_lsq.Status
    innovation: Array
    S: Array
    nis: Array


def step(
    x: Array,
    P: Array,
    z: Array,
    A: Array,
    B: Array,
    Q: Array,
    H: Array,
    R: Array,
    C: Array,
    kappa: float = np.inf,
) -> Restricted:
    """One step from X(t|t), P(t|t) and z(t+1) (..., p); B is (n, m), C (m,) the bounds; leading axes are
    flights.

    `kappa` = inf knows nothing of U but its bounds, a finite one adds the prior N(0, kappa C^2). An input
    that this one measurement does not show takes the prior with kappa = 1, the minimax filter's
    (`box.information`).
    """
    Ax, Pb = kalman.predict(x, P, A, Q)
    S, S_inverse, K = kalman.gain(Pb, H, R)
    nu = z - Ax @ H.mT
    BC = B * C
    DC = H @ BC  # inputs in units of their bounds
    SD = S_inverse @ DC
    M = DC.T @ SD
    best = bounded_lsq.minimum(M + bounded_lsq.information(M, kappa), (SD.mT @ nu[..., None])[..., 0])
    left = nu - best.v @ DC.T
    W = BC - K @ DC
    rebuilt = kalman.joseph(Pb, K, H, R)
    rebuilt += W @ best.free_inverse @ W.mT
    return Restricted(
        x=Ax + best.v @ BC.T + (K @ left[..., None])[..., 0],
        P=rebuilt,
        u=best.v * C,
        status=best.status,
        innovation=left,
        S=S,
        nis=(left * (S_inverse @ left[..., None])[..., 0]).sum(-1),
    )
