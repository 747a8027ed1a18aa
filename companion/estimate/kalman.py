"""Kalman filter: predict, update, consistency tests, and the minimax (coarsened) noise.

    x(t+1) = A x(t) + W(t),   z(t) = H x(t) + N(t),   W ~ (0, Q), N ~ (0, R)                (2.1), (2.3)

Equation numbers are those of Poddubny's paper on restrictive filtering. All functions broadcast over leading
axes: `x` of shape (..., n) with one shared `P` of shape (n, n) is a Monte Carlo of many flights in one call,
because the gain does not depend on the data; with `P` of shape (..., n, n) every flight has its own.

This is the one implementation of the measurement update in `companion.estimate`: `restrictive`,
`smoother` and `schemes` call it. It does not know what the states mean, and it rejects nothing: the
`find_*_flaw` functions describe what is wrong with a number, the caller decides.
"""

from functools import lru_cache
from typing import NamedTuple, cast

import numpy as np

from companion.units import Floats


class Gaussian(NamedTuple):
    """State at one time, or at several.

    Attributes
    ----------
    x : (..., n)
        Mean.
    P : (..., n, n)
        Covariance.
    """

    x: Floats
    P: Floats


class Gain(NamedTuple):
    """Kalman gain with the innovation covariance it is made of.

    Attributes
    ----------
    S : (..., p, p)
        Innovation covariance H P H' + R.
    S_inverse : (..., p, p)
        Its inverse.
    K : (..., n, p)
        Gain P H' S^-1.
    """

    S: Floats
    S_inverse: Floats
    K: Floats


def predict(x: Floats, P: Floats, A: Floats, Q: Floats) -> Gaussian:
    """Propagate mean and covariance over one step.

    Parameters
    ----------
    x : (..., n)
        Mean.
    P : (n, n) or (..., n, n)
        Covariance.
    A : (n, n)
        Transition of the step.
    Q : (n, n)
        Covariance of the noise added in the step.

    Returns
    -------
    Gaussian
        A x and A P A' + Q.

    References
    ----------
    Poddubny (2.4).
    """
    Pb = A @ P @ A.mT
    Pb += Q
    return Gaussian(x @ A.mT, Pb)


def update(x: Floats, P: Floats, z: Floats, H: Floats, R: Floats) -> Gaussian:
    """Update mean and covariance by the measurement z = H x + N(0, R).

    DEPARTS FROM (2.5): the paper inverts the predicted covariance, which does not exist after exact alignment
    (P0 = 0). The gain form needs only an invertible S = H P H' + R; Joseph's form keeps P symmetric and
    non-negative whatever the rounding of K.

    Parameters
    ----------
    x : (..., n)
        Predicted mean.
    P : (n, n) or (..., n, n)
        Predicted covariance.
    z : (..., p)
        Measurement.
    H : (p, n)
        Measurement matrix.
    R : (p, p)
        Measurement noise covariance, positive definite.

    Returns
    -------
    Gaussian
        Updated state.

    References
    ----------
    Poddubny (2.5).
    """
    K = gain(P, H, R).K
    nu = z - x @ H.mT
    return Gaussian(x + (K @ nu[..., None])[..., 0], joseph(P, K, H, R))


def step(x: Floats, P: Floats, z: Floats, A: Floats, Q: Floats, H: Floats, R: Floats) -> Gaussian:
    """Predict over one step and update by its measurement.

    Parameters
    ----------
    x, P : (..., n), (..., n, n)
        X(t|t) and P(t|t).
    z : (..., p)
        Measurement z(t+1).
    A, Q, H, R
        As in `predict` and `update`.

    Returns
    -------
    Gaussian
        X(t+1|t+1), P(t+1|t+1).

    References
    ----------
    Poddubny (2.4), (2.5).
    """
    x, P = predict(x, P, A, Q)
    return update(x, P, z, H, R)


def gain(P: Floats, H: Floats, R: Floats) -> Gain:
    """Compute the Kalman gain of a predicted covariance.

    Parameters
    ----------
    P : (..., n, n)
        Predicted covariance.
    H : (p, n)
        Measurement matrix.
    R : (p, p)
        Measurement noise covariance.

    Returns
    -------
    Gain
        S, its inverse, and K.

    Raises
    ------
    numpy.linalg.LinAlgError
        If S is singular.
    """
    HP = H @ P
    S = HP @ H.mT + R
    S_inverse = cast("Floats", np.linalg.inv(S))
    return Gain(S, S_inverse, HP.mT @ S_inverse)


def joseph(P: Floats, K: Floats, H: Floats, R: Floats) -> Floats:
    """Update a covariance for any gain: M P M' + K R K', M = I - K H.

    M is applied, never formed, first from the left and then from the right: every product then has only the
    rank of the measurement. Multiplying out into four terms of the size of P would be as cheap, but it
    cancels: with R far below H P H' the sign of P is lost.

    Parameters
    ----------
    P : (..., n, n)
        Predicted covariance.
    K : (..., n, p)
        Gain, optimal or not.
    H : (p, n)
        Measurement matrix.
    R : (p, p)
        Measurement noise covariance.

    Returns
    -------
    (..., n, n)
        Updated covariance, exactly symmetric, and non-negative whatever the rounding of K.
    """
    MP = K @ (H @ P)
    np.subtract(P, MP, out=MP)  # in place: a stack of flights is large
    J = (K @ R - MP @ H.mT) @ K.mT
    J += MP
    symmetric: Floats = np.add(J, J.mT, out=MP)
    symmetric *= 0.5
    return symmetric


def minimax_noise(B: Floats, C: Floats, Q: Floats) -> Floats:
    """Compute the noise of the minimax filter for X(t+1) = A X + B U + W with bounded inputs |U_i| <= C_i.

    Of all distributions of a white U within its bounds, +-C_i with equal chances has the largest variance.

    Parameters
    ----------
    B : (n, m)
        Influence of the inputs.
    C : (m,)
        Bounds, in the unit of the inputs.
    Q : (n, n)
        Covariance of W.

    Returns
    -------
    (n, n)
        Q + B diag(C_i^2) B'.

    References
    ----------
    Poddubny, section 2.
    """
    return Q + (B * np.square(C)) @ B.T


# Consistency: does the spread match P and S?


@lru_cache(maxsize=64)
def nis_gate(dof: int, false_alarm: float = 1e-3) -> float:
    """Compute the chi-square gate for the NIS.

    Parameters
    ----------
    dof : int
        Number of components of the measurement.
    false_alarm : float
        Probability that a measurement with the stated errors exceeds the gate.

    Returns
    -------
    float
        Upper chi-square quantile, dimensionless.
    """
    from scipy.special import chdtri

    return float(chdtri(dof, false_alarm))


def nees(error: Floats, P: Floats) -> Floats:
    """Compute the normalised estimation error squared; its mean is the rank of P if the filter is consistent.

    The inverse is taken on the correlation matrix, so that kilometres and microradians weigh alike.
    Directions of zero variance (P0 = 0) are left out.

    Parameters
    ----------
    error : (..., n)
        Estimate minus truth.
    P : (..., n, n)
        Covariance.

    Returns
    -------
    (...,)
        error' P^+ error.
    """
    sigma = np.sqrt(np.einsum("...ii->...i", P))
    scale = np.where(sigma > 0.0, sigma, 1.0)
    rho = P / (scale[..., :, None] * scale[..., None, :])
    e = error / scale
    inverse: Floats = np.linalg.pinv(rho, rcond=1e-12, hermitian=True)
    weight: Floats = (e * (inverse @ e[..., None])[..., 0]).sum(-1)
    return weight
