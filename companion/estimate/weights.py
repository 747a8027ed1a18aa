"""Correction coefficients: the per-axis estimator of several readings, and what wrong weights cost.

Lukinova, Podgorna and Rogozhin fuse INS, GNSS and RSBN one axis at a time by (5), X = K Z, where

    K_opt = (H^T R^-1 H)^-1 H^T R^-1,   P_opt = (H^T R^-1 H)^-1                      (5), (6)

and announce a study of what happens when the coefficients K depart from these. The answer is exact: for every
K that leaves the true value alone, K H = I,

    K R K^T = P_opt + (K - K_opt) R (K - K_opt)^T

so small departures cost little, and for readings of one quantity P = P_opt + sum r_i (w_i - w_i_opt)^2.
Weights that do not add up to one are another matter: they bias the estimate by (K H - I) X; the paper's GNSS
weight one per cent too large, at 100 km, by 0.93 km. `fusion` is the estimator to navigate with; this module
is the paper's, and its study.

DEPARTS FROM (7): three rows, not four, and for the range read as z_P = D with x = D sin A the entry is
1/sin A, not sin A: sin A, cos A are the partials of D and belong to one joint row D = x sin A + y cos A. Even
so the scalar row knows nothing of the azimuth's error and must not be believed near singular azimuths: see
`RsbnRow`.
"""

import math
from typing import Literal, NamedTuple

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]


class AxisFix(NamedTuple):
    """One coordinate from several readings: `value`, claimed `variance`, the readings' `weights` (m,)."""

    value: float
    variance: float
    weights: Array


class RsbnRow(NamedTuple):
    """A range as a reading of one coordinate: z_P = D = `gain` x.

    `claimed` is the variance of z_P that the scalar form knows of, sigma_D^2; `actual` has the azimuth's
    share too, (D sigma_A cot A)^2 for x, which grows without limit towards A = 0 and 180 deg (for y
    tan A, towards 90 and 270 deg).
    """

    gain: float
    claimed: float
    actual: float


def gain(H: npt.ArrayLike, R: npt.ArrayLike) -> Array:
    """The best coefficients K_opt (n, m) of (5) for observation matrix H (m, n), error covariance R (m, m).

    ValueError if R is not positive definite or H does not determine all n unknowns.
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
    K: Array = np.linalg.pinv(W @ H) @ W
    return K


def covariance(K: npt.ArrayLike, R: npt.ArrayLike) -> Array:
    """Covariance K R K^T (n, n) of the estimate K Z for any coefficients K (n, m), best or not."""
    K, R = np.asarray(K, dtype=float), np.asarray(R, dtype=float)
    P: Array = K @ R @ K.T
    return P


def excess(K: npt.ArrayLike, H: npt.ArrayLike, R: npt.ArrayLike) -> Array:
    """What coefficients K (n, m) lose: (K - K_opt) R (K - K_opt)^T (n, n); ValueError unless K H = I."""
    B = bias(K, H)
    if np.abs(B).max() > 1e-9:
        raise ValueError(
            f"K H differs from the identity by {np.abs(B).max():.3g}: the estimate is biased; see bias()"
        )
    return covariance(np.asarray(K, dtype=float) - gain(H, R), R)


def bias(K: npt.ArrayLike, H: npt.ArrayLike) -> Array:
    """Relative bias K H - I (n, n): the mean error of K Z at the true position X is (K H - I) X."""
    K, H = np.asarray(K, dtype=float), np.asarray(H, dtype=float)
    B: Array = K @ H - np.eye(H.shape[1])
    return B


def per_axis(
    readings: npt.ArrayLike, variances: npt.ArrayLike, gains: npt.ArrayLike | None = None
) -> AxisFix:
    """The paper's estimator of one coordinate: `readings` (m,) = `gains` (m,) times it, of `variances` (m,).

    Gains are 1 where not given. The unit of the variances is that of the readings, squared.
    """
    z, r = np.asarray(readings, dtype=float), np.asarray(variances, dtype=float)
    h = np.ones_like(z) if gains is None else np.asarray(gains, dtype=float)
    if not z.shape == r.shape == h.shape == (z.size,) or z.size == 0:
        raise ValueError(
            f"readings {z.shape}, variances {r.shape} and gains {h.shape} must be of one length (m,)"
        )
    if not (np.isfinite(z).all() and np.isfinite(h).all() and h.any()):
        raise ValueError("readings and gains must be finite, and one gain at least not zero")
    if not (np.isfinite(r).all() and (r > 0.0).all()):
        raise ValueError(f"variances must be positive and finite, they are {r.tolist()}")
    P = 1.0 / float(np.sum(h * h / r))
    K = P * h / r
    return AxisFix(float(K @ z), P, K)


def rsbn_row(D: float, A: float, sigma_D: float, sigma_A: float, axis: Literal["x", "y"]) -> RsbnRow:
    """The RSBN row of `per_axis` for range D m and azimuth A rad, x = D sin A or y = D cos A from the beacon.

    ValueError at the azimuth where the row does not exist.
    """
    along, across = (math.sin(A), math.cos(A)) if axis == "x" else (math.cos(A), math.sin(A))
    if abs(along) < 1e-9:
        raise ValueError(
            f"at azimuth {math.degrees(A):.6g} deg the range says nothing of {axis}: leave the row out, or"
            " use the joint estimator fusion.maximum_likelihood"
        )
    return RsbnRow(1.0 / along, sigma_D**2, sigma_D**2 + (D * sigma_A * across / along) ** 2)


def changed(weights: npt.ArrayLike, i: int, eps: float) -> Array:
    """The weights (m,) with the i-th multiplied by 1 + eps and the others rescaled to the same sum."""
    w = np.asarray(weights, dtype=float)
    rest = w.sum() - w[i]
    if rest == 0.0:
        raise ValueError(f"weight {i} is the only one: there is nothing to rescale")
    new: Array = w * (1.0 - eps * w[i] / rest)
    new[i] = w[i] * (1.0 + eps)
    return new


def rms_ratio(weights: npt.ArrayLike, variances: npt.ArrayLike) -> float:
    """Rms error of a weighted mean with these `weights` (m,), of sum 1, over that of the best weights."""
    w, r = np.asarray(weights, dtype=float), np.asarray(variances, dtype=float)
    return math.sqrt(float(r @ (w * w)) / per_axis(np.zeros_like(r), r).variance)


def rms_ratio_assuming(assumed: npt.ArrayLike, variances: npt.ArrayLike) -> float:
    """The same for weights that are best for the `assumed` variances (m,) where `variances` (m,) are true."""
    a = np.asarray(assumed, dtype=float)
    return rms_ratio(per_axis(np.zeros_like(a), a).weights, variances)
