"""Minimax prediction on the Schuler channel: the closed form, and the continuous problem in general.

Position gamma is measured on all of [0, T] with errors of r.m.s. at most sigma and any correlation; the
state is wanted at T + alpha. Matasov, Martirosyan: the optimal estimate uses four instants, 0, chi, T - chi,
T, and

    H~ Phi_s = a_s (2.5),  (2.6),   d_s = sigma sum |Phi_sj|

With h = T / 2, t1 = h - chi, c = h + alpha the four bounds are sigma / D times

    gamma  c cos t1 - sin c      phi  |sin c|      mu  cos t1 - cos c      vartheta  cos t1,     D = h cos t1
    - sin h

written below with u(x) = x - sin x and half angles, since as printed they cancel in a short window. Where
they hold: all four have one dual polynomial, A x - B sin x in x = tau - h, which levels at +-1 with
alternating signs on the four instants and nowhere exceeds 1 while h + t1 < 2 pi; so the closed form holds
for a target exactly when its four weights alternate in sign too. The paper's T <= pi/2, alpha <= pi - T
is sufficient for gamma, mu and vartheta, but not for phi, whose optimum has three instants near h + alpha =
0 and pi: there `continuous_tau` takes over.

The bound is on the r.m.s. error, and attained by rho = +-sigma sign Phi. It bounds |error| itself only where
|rho| <= sigma for certain: of a fully correlated Gaussian error 31.7 % of realisations exceed it.

Units: `closed_form` takes seconds and metres. The functions named `_tau` take dimensionless time, radians of
Schuler phase (one second is 1.2387e-3), and dimensionless errors; `schuler.Scale` converts.
"""

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from companion.estimate.minimax_lp import Design
from companion.estimate.schuler import MEAN_EARTH, STATE, Scale, schuler_row, transition
from companion.estimate.schuler import sine_excess_scalar as u
from companion.units import Floats

REMEZ_TOLERANCE = 1e-11  # how far the dual polynomial may exceed sigma between grid points, relative
REMEZ_ROUNDS = 30  # three to five are usual, fifteen where two instants merge


class ClosedForm(NamedTuple):
    """Minimax estimates of gamma, phi, mu, vartheta, in this order, at the end of the window plus `ahead`.

    Estimate k is weights[k] . z(instants[k]). `closed_form` gives SI (s, m, rad, m/s, rad/s),
    `closed_form_tau` dimensionless numbers.

    Attributes
    ----------
    times : (4,)
        Instants 0, chi, T - chi, T of the paper's form.
    weights : (4, 4)
        One row per target, one column per instant.
    bounds : (4,)
        Worst r.m.s. errors, sigma sum |weights|.
    instants : (4, 4)
        Instants of each target: `times`, except for the targets in `fallback`.
    fallback : tuple of str
        Targets for which the paper's form is not optimal; the general solver found at most four instants.
    """

    times: Floats
    weights: Floats
    bounds: Floats
    instants: Floats
    fallback: tuple[str, ...]


class Continuous(NamedTuple):
    """Minimax estimate weights . z(times) of one target from gamma measured on all of [0, T]; dimensionless.

    Attributes
    ----------
    times : (k,)
        Instants, k <= 4.
    weights : (k,)
        Weights of the measurements there.
    bound : float
        Worst r.m.s. error.
    dual : (4,)
        Dual vector on the state at T + alpha, feasible.
    gap : float
        Relative duality gap.
    """

    times: Floats
    weights: Floats
    bound: float
    dual: Floats
    gap: float


def closed_form(window_s: float, ahead_s: float, sigma_m: float, scale: Scale = MEAN_EARTH) -> ClosedForm:
    """Compute the minimax estimates of the INS errors ahead of a window of positions, in SI units.

    `closed_form(900, 600, 30).bounds[0]` is 1217 m: 15 minutes of 30 m positions, ten minutes ahead.

    Parameters
    ----------
    window_s : float
        Length of the window on which the position error is measured, s.
    ahead_s : float
        Time ahead of the end of the window, s; negative inside the window.
    sigma_m : float
        R.m.s. error of the measured positions, m, of any correlation.
    scale : Scale
        Earth radius and Schuler rate.

    Returns
    -------
    ClosedForm
        Instants in s; rows of weights and bounds for position (m), tilt (rad), velocity (m/s), drift (rad/s).

    Raises
    ------
    ValueError
        If the window or sigma is not positive, or a number is not finite.

    References
    ----------
    Matasov, Martirosyan (2.5), (2.6).
    """
    _check(window_s=window_s, sigma_m=sigma_m)
    _check(positive=False, ahead_s=ahead_s)
    found = closed_form_tau(window_s * scale.rate, ahead_s * scale.rate, sigma_m / scale.radius)
    units = np.array(scale.units)
    return ClosedForm(
        found.times / scale.rate,
        found.weights * (units / scale.radius)[:, None],
        found.bounds * units,
        found.instants / scale.rate,
        found.fallback,
    )


def closed_form_tau(T: float, alpha: float, sigma: float = 1.0) -> ClosedForm:
    """Compute the minimax estimates at T + alpha from gamma on [0, T], dimensionless.

    Parameters
    ----------
    T : float
        Window, radians of Schuler phase (seconds times `Scale.rate`).
    alpha : float
        Time ahead of the end of the window, radians of Schuler phase; negative inside the window.
    sigma : float
        R.m.s. error of gamma, dimensionless (metres over `Scale.radius`).

    Returns
    -------
    ClosedForm
        Dimensionless times, weights and bounds.

    Raises
    ------
    ValueError
        If T or sigma is not positive, or a number is not finite.

    References
    ----------
    Matasov, Martirosyan (2.5), (2.6).
    """
    _check(T=T, sigma=sigma)
    _check(positive=False, alpha=alpha)
    h, c = 0.5 * T, 0.5 * T + alpha
    t1 = _inner_instant(h)
    times = np.array([0.0, h - t1, h + t1, T])
    weights = _weights(h, t1, c)
    versine = 2.0 * math.sin(0.5 * t1) ** 2
    D = u(h) - h * versine
    bounds = np.array([u(c) - c * versine, math.sin(c), _cos_difference(t1, c), math.cos(t1)])
    bounds = sigma / D * np.abs(bounds)
    alternating = weights * (1.0, -1.0, 1.0, -1.0)
    least = np.maximum(alternating.min(axis=1), -alternating.max(axis=1))
    holds = (least >= -1e-14 * np.abs(weights).sum(axis=1)) & (h + t1 < 2.0 * math.pi)
    instants = np.tile(times, (4, 1))
    for k in np.flatnonzero(~holds):
        optimum = continuous_tau(T, alpha, np.eye(4)[k], sigma)
        used = len(optimum.times)
        instants[k], weights[k] = optimum.times[-1], 0.0  # fewer than four: the rest have zero weight
        instants[k, :used], weights[k, :used], bounds[k] = optimum.times, optimum.weights, optimum.bound
    return ClosedForm(times, weights, bounds, instants, tuple(STATE[k] for k in np.flatnonzero(~holds)))


def continuous_tau(T: float, alpha: float, target: npt.ArrayLike, sigma: float = 1.0) -> Continuous:
    """Compute the minimax estimate of any target from gamma on [0, T], dimensionless.

    The exchange over a grid, then over the extrema of its dual polynomial, until none exceeds sigma (Remez).

    Parameters
    ----------
    T, alpha : float
        Window and time ahead of its end, radians of Schuler phase.
    target : (4,)
        Coefficients of gamma, phi, mu, vartheta at T + alpha.
    sigma : float
        R.m.s. error of gamma, dimensionless.

    Returns
    -------
    Continuous
        Instants, weights, bound and its certificate.

    Raises
    ------
    ValueError
        If T or sigma is not positive, a number is not finite, or the target is not (4,).

    References
    ----------
    Matasov, Martirosyan (1.9), (1.10).
    """
    _check(T=T, sigma=sigma)
    _check(positive=False, alpha=alpha)
    a = np.asarray(target, dtype=np.float64)
    if a.shape != (4,):
        raise ValueError(f"target has shape {a.shape}; give (4,): gamma, phi, mu, vartheta")
    h = 0.5 * T
    a_mid = a @ transition(h + alpha)  # the same target as a function of the state at the middle, x = 0
    if not a_mid.any():
        return Continuous(np.empty(0), np.empty(0), 0.0, np.zeros(4), 0.0)
    x = h * np.sin(np.linspace(-0.5 * np.pi, 0.5 * np.pi, 16 * (4 + math.ceil(T))))
    if -T <= alpha <= 0.0:
        x = np.union1d(x, h + alpha)  # inside the window a fix at that instant may be the optimum
    for _ in range(REMEZ_ROUNDS):
        best = Design.of(schuler_row("gamma", -x), sigma).minimax(a_mid)
        used = np.flatnonzero(np.abs(best.weights) > 1e-12 * np.abs(best.weights).sum())
        times, weights = x[used] + h, best.weights[used]
        peaks = _extrema(x, best.dual)
        excess = max(1.0, float(np.abs(schuler_row("gamma", -peaks) @ best.dual).max()) / sigma)
        if excess <= 1.0 + REMEZ_TOLERANCE:
            break
        x = np.union1d(x[np.abs(x[:, None] - peaks).min(axis=1) > 1e-6 * h], peaks)
    dual = transition(h + alpha) @ best.dual / excess
    return Continuous(times, weights, best.bound, dual, (best.bound - float(a @ dual)) / best.bound)


def _extrema(x: Floats, dual: Floats) -> Floats:
    """Find the local extrema of the dual polynomial from the grid x (n,), by Newton on its slope."""
    value = np.abs(schuler_row("gamma", -x) @ dual)
    inner = np.flatnonzero((value[1:-1] >= value[:-2]) & (value[1:-1] >= value[2:])) + 1
    peak = x[inner]
    for _ in range(4):  # d gamma / d tau = mu, d mu / d tau = -phi
        slope = schuler_row("mu", -peak) @ dual
        curvature = -(dual[1] * np.cos(peak) + (dual[2] - dual[3]) * np.sin(peak))
        with np.errstate(divide="ignore", invalid="ignore"):
            step = np.nan_to_num(slope / curvature, nan=0.0, posinf=0.0, neginf=0.0)
        peak = np.clip(peak - step, x[inner - 1], x[inner + 1])
    return np.concatenate([x[[0, -1]], peak])


def _inner_instant(h: float) -> float:
    """Solve sin(chi - h) + (T - chi) cos(chi - h) - sin h = 0 for t1 = h - chi.

    As u(h) + u(t1) = 2 (h + t1) sin^2(t1 / 2), whose difference falls and is concave on (0, pi/2): Newton
    from the right descends monotonically until rounding stops it.
    """
    t1 = min(h, 0.5 * math.pi)
    u_h = u(h)
    while True:
        surplus = u_h + u(t1) - 2.0 * (h + t1) * math.sin(0.5 * t1) ** 2
        lower = t1 + surplus / ((h + t1) * math.sin(t1))
        if not lower < t1 * (1.0 - 2e-16):
            return lower
        t1 = lower


def _weights(h: float, t1: float, c: float) -> Floats:
    """Compute N^-1 of (2.5) (4 targets, 4 instants), as even and odd pairs about the middle of the window."""
    u_h, u_1, u_c = u(h), u(t1), u(c)
    versine = 2.0 * math.sin(0.5 * c) ** 2
    sin, cos = math.sin(c), math.cos(c)
    De, Do = 2.0 * _cos_difference(h, t1), 2.0 * (t1 * u_h - h * u_1)
    even_h = np.array([_cos_difference(c, t1), cos, -sin, 0.0]) / De
    even_1 = np.array([_cos_difference(h, c), -cos, sin, 0.0]) / De
    odd_h = np.array([t1 * u_c - c * u_1, -sin * t1, t1 * versine - u_1, math.sin(t1)]) / Do
    odd_1 = np.array([c * u_h - h * u_c, sin * h, u_h - h * versine, -math.sin(h)]) / Do
    return np.stack([even_h - odd_h, even_1 - odd_1, even_1 + odd_1, even_h + odd_h], axis=1)


def _cos_difference(x: float, y: float) -> float:
    """Compute cos x - cos y without cancellation."""
    return -2.0 * math.sin(0.5 * (x + y)) * math.sin(0.5 * (x - y))


def _check(positive: bool = True, **numbers: float) -> None:
    for name, value in numbers.items():
        if not math.isfinite(value) or (positive and value <= 0.0):
            raise ValueError(f"{name} is {value}; give a {'positive' if positive else 'finite'} number")
