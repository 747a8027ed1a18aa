"""Approximation of an unknown function by basis functions, and the choice of their number.

    z_i = x(t_i) + N(0, sigma_i^2),   x(t) = sum_j a_j psi_j(t)                         (6.5.1), (6.5.5)

After Brandin et al., section 6.5. The psi_j are a power, Legendre or trigonometric family made orthonormal
with the weight p(t) = 1 / sigma(t)^2 on the span of the samples (6.5.6); a_r = C_r^-1 Psi_r' P z is least
squares with the first r of them (6.5.8). More terms fit better and have larger variances; the best r
minimises the weighted integral of the squared error (6.5.7). The source breaks off before its estimate,
completed here:

    Jhat(r) = |beta - E_r a_r|^2 - tr C^-1 + 2 tr C_r^-1

beta being a_r for r = r_max, C = Psi' P Psi with C_r its leading block, and E_r padding with zeros. It is
unbiased if x is in the span of r_max functions. DEPARTS FROM the short form that takes C for I/dt, which
leaves out the trace and the coupling of the terms: it chooses order 9 for a cubic, instead of 4.

Jhat does not include what is outside the span of all r_max functions, the residuals do: RSS / (N - r_max)
is about 1 where the span is wide enough; `Order.spans` tests it. The noise is assumed independent.
"""

from __future__ import annotations

from typing import Literal, NamedTuple, get_args

import numpy as np
import numpy.typing as npt

from companion.estimate.kalman import nis_gate
from companion.units import Floats

Family = Literal["power", "legendre", "sine", "fourier"]
FAMILIES: tuple[str, ...] = get_args(Family)

FALSE_ALARM = 1e-3  # probability that `spans` is False although the span is wide enough
GREATEST = 1e100  # absolute value of a number in the samples
_GAUSS = np.polynomial.legendre.leggauss(8)  # nodes for each interval between samples


class Curve(NamedTuple):
    """Fitted function at given times.

    Attributes
    ----------
    x : (N,)
        Values.
    sigma : (N,)
        Standard deviations due to the noise alone.
    """

    x: Floats
    sigma: Floats


class DependentFunctions(ValueError):
    """The samples are too unevenly spread to distinguish the functions."""


class Basis(NamedTuple):
    """Orthonormal functions psi_j (6.5.6): a family on [start, start + span], times `mix`.

    On u = (t - start) / span: power (2u - 1)^m and Legendre P_m(2u - 1), m = 0, 1, ..; sine sin(pi m u) as
    the source prints it, without its m = 0, which is zero (it vanishes at both ends); fourier 1, sin 2 pi u,
    cos 2 pi u, sin 4 pi u, ..

    Attributes
    ----------
    family : str
        One of `FAMILIES`.
    start, span : float
        Interval, s.
    mix : (r, r)
        Upper triangular matrix from the family to the orthonormal functions.
    """

    family: Family
    start: float
    span: float
    mix: Floats

    def __call__(self, t: npt.ArrayLike) -> Floats:
        """Evaluate the functions.

        Parameters
        ----------
        t : (N,)
            Times, s.

        Returns
        -------
        (N, r)
            Psi.
        """
        u = (np.atleast_1d(np.asarray(t, float)) - self.start) / self.span
        return _raw(self.family, u, len(self.mix)) @ self.mix


class Order(NamedTuple):
    """Result of `select_order`.

    Attributes
    ----------
    order : int
        r of the smallest criterion.
    criterion : (r_max,)
        Jhat(r).
    coefficients : (r,)
        a_r in the orthonormal basis.
    covariance : (r, r)
        Their covariance.
    consistency : float
        RSS / (N - r_max).
    degrees_of_freedom : int
        N - r_max.
    basis : Basis
        The orthonormal functions.
    """

    order: int
    criterion: Floats
    coefficients: Floats
    covariance: Floats
    consistency: float
    degrees_of_freedom: int
    basis: Basis

    @property
    def spans(self) -> bool:
        """Return whether r_max functions explain the samples within the noise; otherwise discard it."""
        return self.consistency * self.degrees_of_freedom <= nis_gate(self.degrees_of_freedom, FALSE_ALARM)

    def at(self, t: npt.ArrayLike) -> Curve:
        """Evaluate the function.

        Parameters
        ----------
        t : (N,)
            Times, s, within those of the samples.

        Returns
        -------
        Curve
            Values and standard deviations.
        """
        Psi = self.basis(t)[:, : self.order]
        return Curve(Psi @ self.coefficients, np.sqrt(((Psi @ self.covariance) * Psi).sum(1)))


def orthonormal_basis(t: Floats, sigma: Floats, family: Family, r: int) -> Basis:
    """Orthonormalise the first r functions of a family with the weight 1/sigma(t)^2 from t[0] to t[-1].

    Between samples sigma is linear. The integral is Gauss' in each interval, the rest a QR decomposition, and
    R's diagonal is made positive: each function keeps the sign of its family's.

    Parameters
    ----------
    t : (N,)
        Times of the samples, s, not decreasing.
    sigma : (N,)
        Their errors.
    family : {"power", "legendre", "sine", "fourier"}
        Family of functions.
    r : int
        Number of functions.

    Returns
    -------
    Basis
        Orthonormal functions.

    Raises
    ------
    ValueError
        If the functions are nearly dependent.

    References
    ----------
    Brandin et al. (6.5.6).
    """
    half = 0.5 * np.diff(t)[:, None]
    nodes = (0.5 * (t[1:] + t[:-1])[:, None] + half * _GAUSS[0]).ravel()
    root = np.sqrt((half * _GAUSS[1]).ravel()) / np.interp(nodes, t, sigma)
    start, span = float(t[0]), float(t[-1] - t[0])
    R = np.linalg.qr(root[:, None] * _raw(family, (nodes - start) / span, r), mode="r")
    if np.linalg.cond(R) > 1e12:
        raise DependentFunctions(f"{r} functions of the {family} basis are nearly dependent: take fewer")
    return Basis(family, start, span, np.linalg.inv(R * np.sign(np.diag(R))[:, None]))


def select_order(
    t: npt.ArrayLike, z: npt.ArrayLike, sigma: npt.ArrayLike, basis: Family, r_max: int
) -> Order:
    """Choose the number of functions that estimates x(t) best, and estimate it.

    Parameters
    ----------
    t : (N,)
        Times, s, not decreasing.
    z : (N,)
        Samples.
    sigma : (N,) or float
        Their errors, in the unit of z.
    basis : {"power", "legendre", "sine", "fourier"}
        Family of functions.
    r_max : int
        Largest number of functions.

    Returns
    -------
    Order
        Order, estimate and criteria.

    Raises
    ------
    ValueError
        If the samples are not usable, or too few or too unevenly spread to distinguish r_max functions.

    References
    ----------
    Brandin et al. (6.5.5)-(6.5.8).
    """
    t, z, sigma = _samples(t, z, sigma, basis, r_max)
    functions = orthonormal_basis(t, sigma, basis, r_max)
    Q, R = np.linalg.qr(functions(t) / sigma[:, None])  # C_r = R_r' R_r, never formed
    if np.linalg.cond(R) > 1e8:
        raise DependentFunctions(
            f"the samples do not distinguish {r_max} functions of the {basis} basis: take fewer"
        )
    y = z / sigma
    b = Q.T @ y
    inverse = np.linalg.inv(R)  # inverse of a leading block is the leading block
    fits = np.triu(np.cumsum(inverse * b, axis=1))  # column r - 1 is a_r, padded with zeros
    beta = fits[:, -1]
    traces = np.cumsum((inverse**2).sum(0))  # tr C_r^-1, r = 1..r_max
    criterion = ((beta[:, None] - fits) ** 2).sum(0) - traces[-1] + 2.0 * traces
    residual = y - Q @ b
    rss, N, r = float(residual @ residual), len(z), int(criterion.argmin()) + 1
    V = inverse[:r, :r] @ inverse[:r, :r].T
    return Order(r, criterion, fits[:r, r - 1], V, rss / (N - r_max), N - r_max, functions)


class Track(NamedTuple):
    """Smoothed track.

    Attributes
    ----------
    x : (N,)
        Values at the times of the samples.
    sigma : (N,)
        Upper bounds of their standard deviations.
    windows : int
        Number of windows side by side.
    consistency : float
        RSS / (N - r_max) over them, about 1 if they were short enough.
    """

    x: Floats
    sigma: Floats
    windows: int
    consistency: float


def smooth_track(
    t: npt.ArrayLike, z: npt.ArrayLike, sigma: npt.ArrayLike, basis: Family = "legendre", r_max: int = 8
) -> Track:
    """Smooth a track of unknown shape.

    Its span is cut into 1, 2, 4, .. windows until r_max functions explain each to within the noise, or one
    would hold fewer than 2 r_max samples, or, beside a gap, too unevenly spread ones. Windows overlap by half
    and are blended by cos^2, so that the track has no joints; their sigmas are blended in the same way, an
    upper bound.

    Parameters
    ----------
    t : (N,)
        Times, s, not decreasing.
    z : (N,)
        Samples.
    sigma : (N,) or float
        Their errors, in the unit of z.
    basis : {"power", "legendre", "sine", "fourier"}
        Family of functions.
    r_max : int
        Largest number of functions in a window.

    Returns
    -------
    Track
        Track with errors.

    Raises
    ------
    ValueError
        If the samples are not usable.
    """
    samples = _samples(t, z, sigma, basis, r_max)
    found, explained = _windowed(samples, basis, r_max, 1)
    count = 2
    while not explained and all(
        inside.stop - inside.start >= 2 * r_max for inside in _windows(samples.t, count)
    ):
        try:
            found, explained = _windowed(samples, basis, r_max, count)
        except DependentFunctions:
            break
        count *= 2
    return found


def _windows(t: Floats, count: int) -> list[slice]:
    """List the samples of `count` windows side by side and of those that straddle two of them, in order."""
    edges = np.linspace(t[0], t[-1], 2 * count + 1)
    first = np.searchsorted(t, edges[:-2], side="left")
    last = np.searchsorted(t, edges[2:], side="right")
    return [slice(a, b) for a, b in zip(first, last, strict=True)]


def _windowed(samples: _Samples, basis: Family, r_max: int, count: int) -> tuple[Track, bool]:
    t, z, sigma = samples
    x, deviation = np.zeros_like(z), np.zeros_like(z)
    half = (t[-1] - t[0]) / (2 * count)
    rss, degrees_of_freedom = 0.0, 0
    windows = _windows(t, count)
    for j, inside in enumerate(windows):
        u = (t[inside] - t[0]) / half - j  # 0 .. 2, the middle at 1
        weight = np.cos(0.5 * np.pi * (u - 1.0)) ** 2
        if j == 0:
            weight[u < 1.0] = 1.0
        if j == len(windows) - 1:
            weight[u >= 1.0] = 1.0
        order = select_order(t[inside], z[inside], sigma[inside], basis, r_max)
        curve = order.at(t[inside])
        x[inside] += weight * curve.x
        deviation[inside] += weight * curve.sigma
        if j % 2 == 0:  # windows side by side share no samples
            rss += order.consistency * order.degrees_of_freedom
            degrees_of_freedom += order.degrees_of_freedom
    explained = rss <= nis_gate(degrees_of_freedom, FALSE_ALARM)
    return Track(x, deviation, count, rss / degrees_of_freedom), explained


class _Samples(NamedTuple):
    t: Floats
    z: Floats
    sigma: Floats


def _samples(t: npt.ArrayLike, z: npt.ArrayLike, sigma: npt.ArrayLike, basis: str, r_max: int) -> _Samples:
    t, z = np.asarray(t, float), np.asarray(z, float)
    if basis not in FAMILIES:
        raise ValueError(f"unknown basis {basis!r}: choose one of {', '.join(FAMILIES)}")
    if t.ndim != 1 or z.shape != t.shape or np.shape(sigma) not in ((), t.shape):
        shapes = f"t {t.shape}, z {z.shape}, sigma {np.shape(sigma)}"
        raise ValueError(f"{shapes} do not fit: give N times, N values, and one sigma or N")
    sigma = np.broadcast_to(np.asarray(sigma, float), t.shape)
    if not 1 <= r_max < len(t):
        raise ValueError(f"r_max is {r_max} for {len(t)} samples: take at least 1 and fewer than the samples")
    if not (np.isfinite(t).all() and np.isfinite(z).all() and np.isfinite(sigma).all()):
        raise ValueError("a sample is not finite: leave it out")
    if (sigma <= 0.0).any():
        raise ValueError(f"sigma is {sigma.min():g} somewhere: it must be positive")
    if (np.diff(t) < 0.0).any():
        raise ValueError("the times are not increasing: sort the samples by time")
    if t[0] == t[-1]:
        raise DependentFunctions(f"all samples are of one time, {t[0]:g} s: give samples of several times")
    _reject_overflow(t, z, sigma)
    return _Samples(t, z, sigma)


def _reject_overflow(t: Floats, z: Floats, sigma: Floats) -> None:
    """Raise ValueError for numbers whose squares, weighted, are too great for a double."""
    with np.errstate(over="ignore"):
        weighted = {"1 / sigma": 1.0 / sigma, "z / sigma": z / sigma}
    for name, values in {"t": t, "z": z, "sigma": sigma, **weighted}.items():
        worst = values[np.argmax(np.abs(values))]
        if abs(worst) > GREATEST:
            advice = "leave this sample out, or use another unit"
            raise ValueError(f"{name} is {worst:g} somewhere: at most {GREATEST:g} can be used: {advice}")


def _raw(family: Family, u: Floats, r: int) -> Floats:
    """Evaluate the first r functions of the family (N, r) on u = 0 .. 1."""
    if family == "power":
        return np.vander(2.0 * u - 1.0, r, increasing=True)
    if family == "legendre":
        values: Floats = np.polynomial.legendre.legvander(2.0 * u - 1.0, r - 1).astype(float)
        return values
    if family == "sine":
        return np.sin(np.pi * np.outer(u, np.arange(1, r + 1)))
    waves = 2.0 * np.pi * np.outer(u, np.arange(1, r // 2 + 1))
    both = np.stack((np.sin(waves), np.cos(waves)), axis=-1).reshape(len(u), -1)
    return np.column_stack((np.ones_like(u), both))[:, :r]
