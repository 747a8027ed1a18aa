"""A function of which nothing is known, from noisy samples: a sum of basis functions, and how many of them.

    z_i = x(t_i) + N(0, sigma_i^2),   x(t) = sum_j a_j psi_j(t)                         (6.5.1), (6.5.5)

After Brandin et al., section 6.5. The psi_j are a power, Legendre or trigonometric family made orthonormal
with the weight p(t) = 1 / sigma(t)^2 on the span of the samples (6.5.6); a_r = C_r^-1 Psi_r' P z is least
squares with the first r of them (6.5.8). More terms fit better and are known worse; the best r minimises the
weighted integral of the squared error (6.5.7). The source breaks off before its estimate, completed here:

    Jhat(r) = |beta - E_r a_r|^2 - tr C^-1 + 2 tr C_r^-1

beta being a_r for r = r_max, C = Psi' P Psi with C_r its leading block, and E_r padding with zeros. It is
unbiased if x lies in the span of r_max functions. DEPARTS FROM the short form that takes C for I/dt, which
leaves out the trace and the coupling of the terms: it chooses order 9 for a cubic, instead of 4.

What lies outside the span of all r_max functions Jhat cannot see, the residuals can: RSS / (N - r_max) is
about 1 where the span is wide enough, and `spans` says whether it is. The noise is taken for independent.
"""

from __future__ import annotations

from typing import Literal, NamedTuple, get_args

import numpy as np
import numpy.typing as npt
from scipy.special import chdtri

Array = npt.NDArray[np.float64]
Family = Literal["power", "legendre", "sine", "fourier"]
FAMILIES: tuple[str, ...] = get_args(Family)

FALSE_ALARM = 1e-3  # chance that `spans` is False though the span is wide enough
_GAUSS = np.polynomial.legendre.leggauss(8)  # per interval between samples


class Curve(NamedTuple):
    """Values of the fitted function and their standard deviations, the noise's part of the error alone."""

    x: Array
    sigma: Array


class Basis(NamedTuple):
    """Functions psi_j (6.5.6): a family on [start, start + span], times `mix` (r, r), upper triangular.

    On u = (t - start) / span: power (2u - 1)^m and Legendre P_m(2u - 1), m = 0, 1, ..; sine sin(pi m u) as
    the source prints it, less its m = 0, which is zero (it vanishes at both ends); fourier 1, sin 2 pi u,
    cos 2 pi u, sin 4 pi u, ..
    """

    family: Family
    start: float
    span: float
    mix: Array

    def __call__(self, t: npt.ArrayLike) -> Array:
        """Psi (N, r) at the times t (N,)."""
        u = (np.atleast_1d(np.asarray(t, float)) - self.start) / self.span
        return _raw(self.family, u, len(self.mix)) @ self.mix


class Order(NamedTuple):
    """What `select_order` found.

    `order` r of the least `criterion` (r_max,); `coefficients` a_r (r,) in the orthonormal basis and their
    `covariance` (r, r); `cp` (r_max,) Mallows' criterion, the discrete twin; `consistency` RSS/(N - r_max).
    """

    order: int
    criterion: Array
    coefficients: Array
    covariance: Array
    cp: Array
    consistency: float
    freedom: int
    basis: Basis

    @property
    def spans(self) -> bool:
        """Whether r_max functions explain the samples to within their noise; if not, nothing here holds."""
        return self.consistency * self.freedom <= float(chdtri(self.freedom, FALSE_ALARM))

    def at(self, t: npt.ArrayLike) -> Curve:
        """The function at the times t (N,), which should be among those of the samples."""
        Psi = self.basis(t)[:, : self.order]
        return Curve(Psi @ self.coefficients, np.sqrt(((Psi @ self.covariance) * Psi).sum(1)))


def orthonormal(t: Array, sigma: Array, family: Family, r: int) -> Basis:
    """The first r functions of the family, orthonormal with the weight 1/sigma(t)^2 from t[0] to t[-1].

    Between samples sigma runs straight. The integral is Gauss' in each interval, the rest a QR
    decomposition, and R's diagonal is made positive: each function begins as its family's does.
    """
    half = 0.5 * np.diff(t)[:, None]
    nodes = (0.5 * (t[1:] + t[:-1])[:, None] + half * _GAUSS[0]).ravel()
    root = np.sqrt((half * _GAUSS[1]).ravel()) / np.interp(nodes, t, sigma)
    start, span = float(t[0]), float(t[-1] - t[0])
    R = np.linalg.qr(root[:, None] * _raw(family, (nodes - start) / span, r), mode="r")
    if np.linalg.cond(R) > 1e12:
        raise ValueError(f"{r} functions of the {family} basis are as good as dependent: take fewer")
    return Basis(family, start, span, np.linalg.inv(R * np.sign(np.diag(R))[:, None]))


def select_order(
    t: npt.ArrayLike, z: npt.ArrayLike, sigma: npt.ArrayLike, basis: Family, r_max: int
) -> Order:
    """The number of functions that estimates x(t) best, and the estimate.

    t (N,) s rising, z (N,), sigma (N,) or one for all, in the unit of z. ValueError where the samples are not
    fit for use, or too few or too unevenly spread to tell r_max functions apart.
    """
    t, z, sigma = _samples(t, z, sigma, basis, r_max)
    functions = orthonormal(t, sigma, basis, r_max)
    Q, R = np.linalg.qr(functions(t) / sigma[:, None])  # C_r = R_r' R_r, never formed
    if np.linalg.cond(R) > 1e8:
        raise ValueError(f"the samples do not tell {r_max} functions of the {basis} basis apart: take fewer")
    y = z / sigma
    b = Q.T @ y
    inverse = np.linalg.inv(R)  # that of a leading block is the leading block of this
    fits = np.triu(np.cumsum(inverse * b, axis=1))  # column r - 1 is a_r, padded with zeros
    beta = fits[:, -1]
    traces = np.cumsum((inverse**2).sum(0))  # tr C_r^-1, r = 1..r_max
    criterion = ((beta[:, None] - fits) ** 2).sum(0) - traces[-1] + 2.0 * traces
    residual = y - Q @ b
    rss, N, r = float(residual @ residual), len(z), int(criterion.argmin()) + 1
    beyond = np.append(np.cumsum(b[:0:-1] ** 2)[::-1], 0.0)  # what the later functions explain
    cp = rss + beyond - N + 2.0 * np.arange(1, r_max + 1)
    V = inverse[:r, :r] @ inverse[:r, :r].T
    return Order(r, criterion, fits[:r, r - 1], V, cp, rss / (N - r_max), N - r_max, functions)


class Track(NamedTuple):
    """A smoothed track: x and sigma (N, k) at the times of the samples, the windows it took, and
    RSS/(N - r_max) over them, which is about 1 if they were short enough.
    """

    x: Array
    sigma: Array
    windows: int
    consistency: float


def smooth_track(
    t: npt.ArrayLike, z: npt.ArrayLike, sigma: npt.ArrayLike, basis: Family = "legendre", r_max: int = 8
) -> Track:
    """A track of which nothing is known: z (N, k), each component estimated on its own; sigma (N,) or one.

    Its span is cut into 1, 2, 4, .. windows until r_max functions explain each to within the noise, or one
    would hold fewer than 2 r_max samples. Windows overlap by half and are blended by cos^2, so that the track
    has no joints; its sigma is theirs blended alike, an upper bound.
    """
    t, z = np.asarray(t, float), np.asarray(z, float)
    if z.ndim != 2 or len(z) != t.size:
        raise ValueError(f"the track z {z.shape} does not fit its times {t.shape}: give one row for each")
    columns = [_samples(t, column, sigma, basis, r_max) for column in z.T]
    t, sigma = columns[0].t, columns[0].sigma
    count = 1
    while True:
        found, explained = _windowed(t, z, sigma, basis, r_max, count)
        count *= 2
        if explained or min(len(t[inside]) for inside in _windows(t, count)) < 2 * r_max:
            return found


def _windows(t: Array, count: int) -> list[slice]:
    """The samples of `count` windows side by side and of those that straddle two of them, in their order."""
    edges = np.linspace(t[0], t[-1], 2 * count + 1)
    first = np.searchsorted(t, edges[:-2], side="left")
    last = np.searchsorted(t, edges[2:], side="right")
    return [slice(a, b) for a, b in zip(first, last, strict=True)]


def _windowed(t: Array, z: Array, sigma: Array, basis: Family, r_max: int, count: int) -> tuple[Track, bool]:
    x, deviation = np.zeros_like(z), np.zeros_like(z)
    half = (t[-1] - t[0]) / (2 * count)
    rss, freedom = 0.0, 0
    windows = _windows(t, count)
    for j, inside in enumerate(windows):
        u = (t[inside] - t[0]) / half - j  # 0 .. 2, the middle at 1
        weight = np.cos(0.5 * np.pi * (u - 1.0)) ** 2
        if j == 0:
            weight[u < 1.0] = 1.0
        if j == len(windows) - 1:
            weight[u >= 1.0] = 1.0
        for k in range(z.shape[1]):
            order = select_order(t[inside], z[inside, k], sigma[inside], basis, r_max)
            curve = order.at(t[inside])
            x[inside, k] += weight * curve.x
            deviation[inside, k] += weight * curve.sigma
            if j % 2 == 0:  # those side by side share no samples
                rss, freedom = rss + order.consistency * order.freedom, freedom + order.freedom
    return Track(x, deviation, count, rss / freedom), rss <= float(chdtri(freedom, FALSE_ALARM))


class _Samples(NamedTuple):
    t: Array
    z: Array
    sigma: Array


def _samples(t: npt.ArrayLike, z: npt.ArrayLike, sigma: npt.ArrayLike, basis: str, r_max: int) -> _Samples:
    t, z = np.asarray(t, float), np.asarray(z, float)
    if basis not in FAMILIES:
        raise ValueError(f"there is no basis {basis!r}: choose one of {', '.join(FAMILIES)}")
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
    if (np.diff(t) < 0.0).any() or t[-1] <= t[0]:
        raise ValueError("the times do not rise: sort the samples by time")
    return _Samples(t, z, sigma)


def _raw(family: Family, u: Array, r: int) -> Array:
    """The first r functions of the family (N, r) on u = 0 .. 1."""
    if family == "power":
        return np.vander(2.0 * u - 1.0, r, increasing=True)
    if family == "legendre":
        values: Array = np.polynomial.legendre.legvander(2.0 * u - 1.0, r - 1).astype(float)
        return values
    if family == "sine":
        return np.sin(np.pi * np.outer(u, np.arange(1, r + 1)))
    waves = 2.0 * np.pi * np.outer(u, np.arange(1, r // 2 + 1))
    both = np.stack((np.sin(waves), np.cos(waves)), axis=-1).reshape(len(u), -1)
    return np.column_stack((np.ones_like(u), both))[:, :r]
