"""The Kalman filter, its consistency tests, and its minimax (coarsened) form.

    x(t+1) = A x(t) + W(t),   z(t) = H x(t) + N(t),   W ~ (0, Q), N ~ (0, R)                (2.1), (2.3)

Equation numbers are Poddubny's paper on restrictive filtering. All functions broadcast over leading axes:
`x` of shape (..., n) with one shared `P` of shape (n, n) is a Monte Carlo of many flights in one call,
because the gain does not depend on the data; with `P` of shape (..., n, n) every flight has its own.

It does not know what the states mean, what time is, nor what to do with a rejected measurement: the `_flaw`
functions say why something is not believable, the caller decides.
"""

from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple, cast

import numpy as np
import numpy.typing as npt
from scipy.stats import chi2

Array = npt.NDArray[np.float64]


class Prediction(NamedTuple):
    """Mean (..., n) and covariance (..., n, n) before the measurement."""

    x: Array
    P: Array


class Estimate(NamedTuple):
    """Mean and covariance after the measurement; the innovation (..., p), its covariance S, nu' S^-1 nu."""

    x: Array
    P: Array
    innovation: Array
    S: Array
    nis: Array


class Gain(NamedTuple):
    """Innovation covariance S = H P H' + R, its inverse, and K = P H' S^-1."""

    S: Array
    S_inverse: Array
    K: Array


def predict(x: Array, P: Array, A: Array, Q: Array) -> Prediction:
    """Carry x (..., n) and P one step forward by the transition A and the noise covariance Q of the step."""
    Pb = A @ P @ A.mT
    Pb += Q
    return Prediction(x @ A.mT, Pb)


def correct(x: Array, P: Array, z: Array, H: Array, R: Array) -> Estimate:
    """Take in z (..., p) = H x + N(0, R).

    DEPARTS FROM (2.5): the paper inverts the predicted covariance, which does not exist after exact alignment
    (P0 = 0). The gain form needs S = H P H' + R invertible only; Joseph's form keeps P symmetric and
    non-negative whatever the rounding of K.
    """
    S, S_inverse, K = gain(P, H, R)
    nu = z - x @ H.mT
    nis = (nu * (S_inverse @ nu[..., None])[..., 0]).sum(-1)
    return Estimate(x + (K @ nu[..., None])[..., 0], joseph(P, K, H, R), nu, S, nis)


def step(x: Array, P: Array, z: Array, A: Array, Q: Array, H: Array, R: Array) -> Estimate:
    """One predict and correct, (2.4)-(2.5): from X(t|t), P(t|t) and z(t+1) to X(t+1|t+1), P(t+1|t+1)."""
    x, P = predict(x, P, A, Q)
    return correct(x, P, z, H, R)


def gain(P: Array, H: Array, R: Array) -> Gain:
    """Of a predicted covariance P (..., n, n), measured through H (p, n) with noise R."""
    HP = H @ P
    S = HP @ H.mT + R
    S_inverse = cast("Array", np.linalg.inv(S))
    return Gain(S, S_inverse, HP.mT @ S_inverse)


def joseph(P: Array, K: Array, H: Array, R: Array) -> Array:
    """M P M' + K R K', M = I - K H, exactly symmetric, and non-negative whatever the rounding of K.

    M is applied, never formed, first from the left and then from the right: every product then has but the
    rank of the measurement. Multiplying all out into four terms of the size of P would be as cheap, but it
    cancels: with R far below H P H' the sign of P is lost.
    """
    MP = K @ (H @ P)
    np.subtract(P, MP, out=MP)  # a stack of flights is large: work in the same memory
    J = (K @ R - MP @ H.mT) @ K.mT
    J += MP
    symmetric: Array = np.add(J, J.mT, out=MP)
    symmetric *= 0.5
    return symmetric


def minimax_noise(B: Array, C: Array, Q: Array) -> Array:
    """Q + B diag(C_i^2) B', the noise of the minimax filter for X(t+1) = A X + B U + W, |U_i| <= C_i.

    Of all laws of a white U within its bounds, +-C_i with equal chances has the greatest variance: section 2.
    """
    return Q + (B * np.square(C)) @ B.T


# Consistency: is the spread what P and S promise?


@lru_cache(maxsize=64)
def gate(dof: int, false_alarm: float = 1e-3) -> float:
    """Limit that the NIS of an honest measurement of `dof` components exceeds with chance `false_alarm`."""
    return float(chi2.isf(false_alarm, dof))


@lru_cache(maxsize=64)
def band(dof: int, samples: int, false_alarm: float = 1e-3) -> tuple[float, float]:
    """Two-sided limits of the mean of `samples` independent NIS or NEES values, each of `dof` components."""
    low, high = chi2.interval(1.0 - false_alarm, dof * samples)
    return float(low) / samples, float(high) / samples


def nees(error: Array, P: Array) -> Array:
    """error' P^+ error (...,), whose mean is the rank of P (..., n, n) where the filter is consistent.

    The inverse is taken on the correlation matrix, so that kilometres and microradians weigh alike;
    directions in which P promises exactness (P0 = 0) are left out.
    """
    sigma = np.sqrt(np.einsum("...ii->...i", P))
    scale = np.where(sigma > 0.0, sigma, 1.0)
    rho = P / (scale[..., :, None] * scale[..., None, :])
    e = error / scale
    inverse: Array = np.linalg.pinv(rho, rcond=1e-12, hermitian=True)
    weight: Array = (e * (inverse @ e[..., None])[..., 0]).sum(-1)
    return weight


# What can be wrong with the numbers


@dataclass(frozen=True, slots=True)
class Start:
    """A validated beginning of a filter: time, mean (n,), covariance (n, n). ValueError names the flaw."""

    t_ns: int
    x: Array
    P: Array

    def __post_init__(self) -> None:
        if not np.isfinite(self.x).all():
            raise ValueError("the initial state x is not finite: give every state a finite starting value")
        if reason := covariance_flaw("P0", self.P, len(self.x)):
            raise ValueError(reason)


def covariance_flaw(name: str, P: Array, n: int, *, definite: bool = False) -> str | None:
    """Why P cannot be the covariance of n numbers, or None. `definite` also forbids a zero eigenvalue."""
    if P.shape != (n, n):
        return f"covariance {name} has shape {P.shape}, it must be ({n}, {n})"
    if not np.isfinite(P).all():
        return f"covariance {name} is not finite: check the variances it is made of"
    variance = np.diag(P)
    if (variance < 0.0).any() or (definite and (variance == 0.0).any()):
        wanted = "positive" if definite else "not negative"
        return f"covariance {name} has variance {variance.min():.3g} on its diagonal, it must be {wanted}"
    scale = np.sqrt(np.where(variance > 0.0, variance, 1.0))
    rho = P / np.outer(scale, scale)
    if np.abs(rho - rho.T).max(initial=0.0) > 1e-9:
        return f"covariance {name} is not symmetric: build it as (P + P') / 2"
    least = np.linalg.eigvalsh(rho)[0] if n else 1.0
    if least < -1e-9 or (definite and least < 1e-14):
        kind = "definite" if definite else "semidefinite"
        return f"covariance {name} is not positive {kind} (least correlation eigenvalue {least:.3g})"
    return None


def measurement_flaw(t_ns: int, z: Array, R: Array, last_t_ns: int) -> str | None:
    """Why the measurement z (p,) with covariance R (p, p) cannot be used after time `last_t_ns`, or None."""
    if t_ns < last_t_ns:
        late = (last_t_ns - t_ns) / 1e9
        return f"time runs backwards by {late:.3f} s: go back to an older state and forward again"
    if not np.isfinite(z).all():
        return "the measurement is not finite: check its source"
    return covariance_flaw("R", R, len(z), definite=True)
