"""Correction coefficients: the per-axis estimator of several readings, and the cost of wrong weights.

Lukinova, Podgorna and Rogozhin fuse INS, GNSS and RSBN one axis at a time by (5), X = K Z, where

    K_opt = (H^T R^-1 H)^-1 H^T R^-1,   P_opt = (H^T R^-1 H)^-1                      (5), (6)

and announce a study of coefficients K that depart from these. The result is exact: for every unbiased K, that
is K H = I,

    K R K^T = P_opt + (K - K_opt) R (K - K_opt)^T

so small departures cost little, and for readings of one quantity P = P_opt + sum r_i (w_i - w_i_opt)^2.
Weights that do not add up to one bias the estimate by (K H - I) X: the paper's GNSS weight one per cent too
large, at 100 km, by 0.93 km. `fusion` is the estimator to navigate with; this module is the paper's, and its
study.

DEPARTS FROM (7): three rows, not four, and for the range read as z_P = D with x = D sin A the entry is
1/sin A, not sin A: sin A, cos A are the partials of D and belong to one joint row D = x sin A + y cos A. Even
so the scalar row does not include the azimuth's error and must not be used near singular azimuths: see
`RsbnRow`.
"""

import math
from typing import Literal, NamedTuple

import numpy as np
import numpy.typing as npt

from companion.units import Floats


class AxisFix(NamedTuple):
    """One coordinate from several readings.

    Attributes
    ----------
    value : float
        Estimate, in the unit of the readings.
    variance : float
        Its variance if the stated ones are right.
    weights : (m,)
        Weights of the readings.
    """

    value: float
    variance: float
    weights: Floats


class RsbnRow(NamedTuple):
    """A range as a reading of one coordinate: z_P = D = `gain` x.

    Attributes
    ----------
    gain : float
        1 / sin A for x, 1 / cos A for y.
    claimed : float
        Variance of z_P in the scalar form, sigma_D^2, m^2.
    actual : float
        The same with the azimuth's share, (D sigma_A cot A)^2 for x, m^2; it grows without limit towards
        A = 0 and 180 deg (for y, with tan A, towards 90 and 270 deg).
    """

    gain: float
    claimed: float
    actual: float


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


def excess_covariance(K: npt.ArrayLike, H: npt.ArrayLike, R: npt.ArrayLike) -> Floats:
    """Compute the covariance added by coefficients that are not the best.

    Parameters
    ----------
    K : (n, m)
        Unbiased coefficients, K H = I.
    H : (m, n)
        Observation matrix.
    R : (m, m)
        Covariance of the readings' errors.

    Returns
    -------
    (n, n)
        (K - K_opt) R (K - K_opt)^T.

    Raises
    ------
    ValueError
        If K H is not the identity.
    """
    B = relative_bias(K, H)
    if np.abs(B).max() > 1e-9:
        raise ValueError(
            f"K H differs from the identity by {np.abs(B).max():.3g}: the estimate is biased, see"
            " relative_bias()"
        )
    return estimate_covariance(np.asarray(K, dtype=float) - optimal_gain(H, R), R)


def relative_bias(K: npt.ArrayLike, H: npt.ArrayLike) -> Floats:
    """Compute the relative bias of the estimate K Z: its mean error at the true X is (K H - I) X.

    Parameters
    ----------
    K : (n, m)
        Coefficients.
    H : (m, n)
        Observation matrix.

    Returns
    -------
    (n, n)
        K H - I.
    """
    K, H = np.asarray(K, dtype=float), np.asarray(H, dtype=float)
    B: Floats = K @ H - np.eye(H.shape[1])
    return B


def estimate_axis(
    readings: npt.ArrayLike, variances: npt.ArrayLike, gains: npt.ArrayLike | None = None
) -> AxisFix:
    """Estimate one coordinate from several readings by the paper's scalar form.

    Parameters
    ----------
    readings : (m,)
        Readings, each `gains` times the coordinate.
    variances : (m,)
        Their variances, in the unit of the readings squared.
    gains : (m,), optional
        1 where not given.

    Returns
    -------
    AxisFix
        Estimate, variance and weights.

    Raises
    ------
    ValueError
        If the lengths differ or a number is not usable.

    References
    ----------
    Lukinova, Podgorna, Rogozhin (5).
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
    """Build the RSBN row of `estimate_axis`, x = D sin A or y = D cos A from the beacon.

    Parameters
    ----------
    D : float
        Range, m.
    A : float
        Azimuth, rad.
    sigma_D : float
        Range error, m.
    sigma_A : float
        Azimuth error, rad.
    axis : {"x", "y"}
        Coordinate: east or north.

    Returns
    -------
    RsbnRow
        Gain, claimed and actual variance.

    Raises
    ------
    ValueError
        At an azimuth where the row does not exist.

    References
    ----------
    Lukinova, Podgorna, Rogozhin (7).
    """
    along, across = (math.sin(A), math.cos(A)) if axis == "x" else (math.cos(A), math.sin(A))
    if abs(along) < 1e-9:
        raise ValueError(
            f"at azimuth {math.degrees(A):.6g} deg the range does not measure {axis}: leave the row out, or"
            " use the joint estimator fusion.maximum_likelihood"
        )
    return RsbnRow(1.0 / along, sigma_D**2, sigma_D**2 + (D * sigma_A * across / along) ** 2)


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


def rms_ratio(weights: npt.ArrayLike, variances: npt.ArrayLike) -> float:
    """Compare the rms error of a weighted mean with that of the best weights.

    Parameters
    ----------
    weights : (m,)
        Weights of sum 1.
    variances : (m,)
        True variances of the readings.

    Returns
    -------
    float
        Ratio, 1 or more.
    """
    w, r = np.asarray(weights, dtype=float), np.asarray(variances, dtype=float)
    return math.sqrt(float(r @ (w * w)) / estimate_axis(np.zeros_like(r), r).variance)


def rms_ratio_assuming(assumed: npt.ArrayLike, variances: npt.ArrayLike) -> float:
    """Compare the rms error of weights computed from assumed variances with that of the best weights.

    Parameters
    ----------
    assumed : (m,)
        Assumed variances.
    variances : (m,)
        True variances.

    Returns
    -------
    float
        Ratio, 1 or more.
    """
    a = np.asarray(assumed, dtype=float)
    return rms_ratio(estimate_axis(np.zeros_like(a), a).weights, variances)
