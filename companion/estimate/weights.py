"""Correction coefficients: the best ones for readings with known errors, and departures from them.

Lukinova, Podgorna and Rogozhin fuse INS, GNSS and RSBN one axis at a time by (5), X = K Z, where

    K_opt = (H^T R^-1 H)^-1 H^T R^-1,   P_opt = (H^T R^-1 H)^-1                      (5), (6)

and announce a study of coefficients K that depart from these. The result is exact: for every unbiased K, that
is K H = I,

    K R K^T = P_opt + (K - K_opt) R (K - K_opt)^T

so small departures cost little, and for readings of one quantity P = P_opt + sum r_i (w_i - w_i_opt)^2.
Weights that do not add up to one bias the estimate by (K H - I) X: the paper's GNSS weight one per cent too
large, at 100 km, by 0.93 km. `fusion` is the estimator to navigate with; `readings` has the rows of the
paper's; `companion study weights` is its study.

DEPARTS FROM (7): three rows, not four, and for the range read as z_P = D with x = D sin A the entry is
1/sin A, not sin A: sin A, cos A are the partials of D and belong to one joint row D = x sin A + y cos A. Even
so the scalar row does not include the azimuth's error: (D sigma_A cot A)^2 in the variance of z_P, without
limit towards A = 0 and 180 deg (for y, with tan A, towards 90 and 270 deg).
"""

import numpy as np
import numpy.typing as npt

from companion.units import Floats


def optimal_gain(H: npt.ArrayLike, R: npt.ArrayLike) -> Floats:
    """Compute the best coefficients K_opt of (5).

    Parameters
    ----------
    H : (m, n)
        Observation matrix.
    R : (m, m)
        Covariance of the readings' errors.

    Returns
    -------
    (n, m)
        K_opt.

    Raises
    ------
    ValueError
        If R is not positive definite or H does not determine all n unknowns.

    References
    ----------
    Lukinova, Podgorna, Rogozhin (5), (6).
    """
    H, R = np.asarray(H, dtype=float), np.asarray(R, dtype=float)
    if H.ndim != 2 or R.shape != (len(H), len(H)):
        raise ValueError(f"H has shape {H.shape} and R {R.shape}; they must be (m, n) and (m, m)")
    if not (np.isfinite(H).all() and np.isfinite(R).all()):
        raise ValueError("H and R must be finite")
    try:
        W = np.linalg.inv(np.linalg.cholesky(R))
    except np.linalg.LinAlgError:
        raise ValueError("R is not positive definite; give every reading a positive variance") from None
    if np.linalg.matrix_rank(W @ H) < H.shape[1]:
        raise ValueError(f"H of shape {H.shape} does not determine its {H.shape[1]} unknowns; add a reading")
    K: Floats = np.linalg.pinv(W @ H) @ W
    return K


def estimate_covariance(K: npt.ArrayLike, R: npt.ArrayLike) -> Floats:
    """Compute the covariance of the estimate K Z for any coefficients, best or not.

    Parameters
    ----------
    K : (n, m)
        Coefficients.
    R : (m, m)
        Covariance of the readings' errors.

    Returns
    -------
    (n, n)
        K R K^T.
    """
    K, R = np.asarray(K, dtype=float), np.asarray(R, dtype=float)
    P: Floats = K @ R @ K.T
    return P


def perturb_weight(weights: npt.ArrayLike, i: int, eps: float) -> Floats:
    """Multiply one weight by 1 + eps and rescale the others to keep the sum.

    Parameters
    ----------
    weights : (m,)
        Weights.
    i : int
        Index of the weight to change.
    eps : float
        Relative change.

    Returns
    -------
    (m,)
        New weights.

    Raises
    ------
    ValueError
        If it is the only nonzero weight.
    """
    w = np.asarray(weights, dtype=float)
    rest = w.sum() - w[i]
    if rest == 0.0:
        raise ValueError(f"weight {i} is the only one: there is nothing to rescale")
    new: Floats = w * (1.0 - eps * w[i] / rest)
    new[i] = w[i] * (1.0 + eps)
    return new
