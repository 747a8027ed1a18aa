"""What may be said about a position: a position, an azimuth, a slant range, a height, each with its errors.

Four values, and `Model`, which turns a list of them into whitened equations. It knows nothing of how the
equations are solved (`fusion`), of where the errors' sizes come from, nor of the earth: the caller brings
everything into one Cartesian frame first.

Frame: x east, y north[, z up], metres, any origin; this module keeps the papers' order. Azimuths are counted
from north clockwise at the beacon, towards the aircraft. A problem has three dimensions as soon as one
position, beacon or start has three components or a height is given; a position of two components then leaves
the third free.

North at the beacon is not north here: seen in a tangent plane at the aircraft, the true north of a beacon 400
km to the east is turned by 3.6 deg tan(latitude). So `Azimuth.axes` takes this frame's axes to the beacon's
own east, north, up; with the beacon's coordinates brought through ECEF nothing is then approximated. A
slant range needs no such thing: a length is the same in all frames.

Above a beacon there is no azimuth: the antenna has its cone of silence, and the geometry itself breaks down
where the azimuth's share of the error, sigma_A times the horizontal distance, tends to zero and claims an
accuracy that is not there. `Model.above` finds such azimuths and `Model.without` leaves them out.
"""

import copy
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]
Point = tuple[float, float, float]


@dataclass(frozen=True, slots=True, eq=False)
class Position:
    """A measured position, `value` (2,) or (3,) m, with the full `covariance` (2, 2) or (3, 3) m^2."""

    value: npt.ArrayLike
    covariance: npt.ArrayLike


@dataclass(frozen=True, slots=True, eq=False)
class Azimuth:
    """Azimuth of the aircraft from `beacon` (2,) or (3,) m: `value`, `sigma` rad, clockwise from its north.

    `axes` (3, 3) rotates this frame's axes to the beacon's own east, north, up; None where they are the same.
    """

    beacon: npt.ArrayLike
    value: float
    sigma: float
    axes: npt.ArrayLike | None = None


@dataclass(frozen=True, slots=True, eq=False)
class Range:
    """Slant range of the aircraft from `beacon` (2,) or (3,) m: `value` and `sigma` m."""

    beacon: npt.ArrayLike
    value: float
    sigma: float


@dataclass(frozen=True, slots=True, eq=False)
class Height:
    """Height, the z of this frame: `value` and `sigma` m."""

    value: float
    sigma: float


Observation = Position | Azimuth | Range | Height


class _Bearing:
    """An azimuth ready for use: its whitened residual and gradient at a point."""

    __slots__ = ("A", "axes", "beacon", "sigma")

    def __init__(
        self, beacon: Point, A: float, sigma: float, axes: tuple[Point, Point, Point] | None
    ) -> None:
        self.beacon, self.A, self.sigma, self.axes = beacon, A, sigma, axes

    def local(self, p: Point) -> Point:
        """East, north, up of point p as the beacon sees it."""
        x0, y0, z0 = self.beacon
        x, y, z = p[0] - x0, p[1] - y0, p[2] - z0
        if self.axes is None:
            return x, y, z
        e, n, u = self.axes
        return (
            e[0] * x + e[1] * y + e[2] * z,
            n[0] * x + n[1] * y + n[2] * z,
            u[0] * x + u[1] * y + u[2] * z,
        )

    def elevation(self, p: Point) -> float:
        x, y, z = self.local(p)
        return math.atan2(abs(z), math.hypot(x, y))

    def row(self, p: Point) -> tuple[float, float, float, float]:
        x, y, _ = self.local(p)
        residual = math.remainder(self.A - math.atan2(x, y), math.tau) / self.sigma
        d2 = (x * x + y * y) * self.sigma
        if d2 == 0.0:  # exactly above the beacon every azimuth is as good as any other
            return residual, 0.0, 0.0, 0.0
        de, dn = y / d2, -x / d2
        if self.axes is None:
            return residual, de, dn, 0.0
        e, n, _ = self.axes
        return (
            residual,
            de * e[0] + dn * n[0],
            de * e[1] + dn * n[1],
            de * e[2] + dn * n[2],
        )


class _Slant:
    """A range ready for use: its whitened residual and gradient at a point."""

    __slots__ = ("D", "beacon", "sigma")

    def __init__(self, beacon: Point, D: float, sigma: float) -> None:
        self.beacon, self.D, self.sigma = beacon, D, sigma

    def row(self, p: Point) -> tuple[float, float, float, float]:
        x0, y0, z0 = self.beacon
        x, y, z = p[0] - x0, p[1] - y0, p[2] - z0
        d = math.sqrt(x * x + y * y + z * z)
        if d == 0.0:  # at the beacon any way out is as good as any other: north
            return self.D / self.sigma, 0.0, 1.0 / self.sigma, 0.0
        s = d * self.sigma
        return (self.D - d) / self.sigma, x / s, y / s, z / s


Sight = _Bearing | _Slant


class Linearised:
    """The whitened equations at one point: residuals r, Jacobian J of the computed values, cost r.r."""

    __slots__ = ("J", "cost", "r")

    def __init__(self, r: Array, J: Array) -> None:
        self.r, self.J = r, J
        self.cost = float(r @ r)


class Model:
    """Observations as whitened equations in `n` (2 or 3) unknowns; ValueError names a bad observation.

    Linear observations (positions, heights) become rows W x = w once; azimuths and ranges (`sights`) are
    linearised anew at each point.
    """

    __slots__ = ("W", "_whiteners", "n", "observations", "sights", "silent", "sizes", "w")

    def __init__(self, observations: Sequence[Observation], start: Array | None = None) -> None:
        if not observations:
            raise ValueError("no observations: give at least a Position, or an Azimuth and a Range")
        self.observations = observations
        self.n = _dimension(observations, start)
        self.sights: list[Sight | None] = []
        self.sizes: list[int] = []
        self.silent: frozenset[int] = frozenset()
        self._whiteners: list[Array | None] = []
        rows: list[Array] = []
        values: list[Array] = []
        for i, z in enumerate(observations):
            sight: Sight | None = None
            whitener: Array | None = None
            size = 1
            if isinstance(z, Position):
                value, whitener = _whitened(i, z)
                size = len(value)
                rows.append(_widened(whitener, self.n))
                values.append(whitener @ value)
            elif isinstance(z, Height):
                _check(i, z)
                whitener = np.array([[1.0 / z.sigma]])
                rows.append(np.array([[0.0, 0.0, 1.0 / z.sigma]]))
                values.append(np.array([z.value / z.sigma]))
            else:
                sight = _sight(i, z, self.n)
            self.sights.append(sight)
            self.sizes.append(size)
            self._whiteners.append(whitener)
        self.W = np.concatenate(rows) if rows else np.zeros((0, self.n))
        self.w = np.concatenate(values) if values else np.zeros(0)

    def point(self, x: Array) -> Point:
        """Position x (n,) as three numbers, z = 0 in the plane."""
        p = x.tolist()
        return (p[0], p[1], p[2] if self.n == 3 else 0.0)

    def at(self, x: Array) -> Linearised:
        """Whitened residuals (observed minus computed) and Jacobian at position x (n,)."""
        p = self.point(x)
        sight_rows = [s.row(p) for i, s in enumerate(self.sights) if s is not None and i not in self.silent]
        r = self.w - self.W @ x
        if not sight_rows:
            return Linearised(r, self.W)
        S = np.array(sight_rows)
        return Linearised(np.concatenate((r, S[:, 0])), np.concatenate((self.W, S[:, 1 : 1 + self.n])))

    def above(self, x: Array, elevation: float) -> frozenset[int]:
        """Indices of the azimuths whose beacon sees position x (n,) higher than `elevation` rad."""
        p = self.point(x)
        return frozenset(
            i for i, s in enumerate(self.sights) if isinstance(s, _Bearing) and s.elevation(p) > elevation
        )

    def without(self, silent: frozenset[int]) -> "Model":
        """The same model with those azimuths left out."""
        other = copy.copy(self)
        other.silent = self.silent | silent
        return other

    def residuals(self, x: Array) -> tuple[tuple[Array, ...], tuple[float, ...]]:
        """Per observation at x (n,): observed minus computed in its own unit, and its share of the cost.

        A silent azimuth has an empty residual and no share.
        """
        p = self.point(x)
        residuals: list[Array] = []
        shares: list[float] = []
        for i, z in enumerate(self.observations):
            sight, whitener = self.sights[i], self._whiteners[i]
            if i in self.silent:
                e = r = np.zeros(0)
            elif sight is not None:
                r = np.array(sight.row(p)[:1])
                e = r * sight.sigma
            else:
                assert whitener is not None
                if isinstance(z, Position):
                    e = np.asarray(z.value, dtype=float) - x[: self.sizes[i]]
                else:
                    e = np.asarray(z.value, dtype=float) - x[2:]
                r = whitener @ e
            residuals.append(e)
            shares.append(float(r @ r))
        return tuple(residuals), tuple(shares)


def _dimension(observations: Sequence[Observation], start: Array | None) -> int:
    n = 2 if start is None else len(start)
    for i, z in enumerate(observations):
        if isinstance(z, Height):
            n = 3
        elif isinstance(z, Position):
            n = max(n, np.size(z.value))
        elif isinstance(z, (Azimuth, Range)):
            n = max(n, np.size(z.beacon))
        else:
            raise ValueError(
                f"observation {i} is a {type(z).__name__}: give Position, Azimuth, Range or Height"
            )
    return n


def _name(i: int, z: Observation) -> str:
    return f"observation {i} ({type(z).__name__})"


def _check(i: int, z: Azimuth | Range | Height) -> None:
    if not math.isfinite(z.value):
        raise ValueError(f"{_name(i, z)}: value is {z.value}, not a finite number; leave it out")
    if not (math.isfinite(z.sigma) and z.sigma > 0.0):
        raise ValueError(f"{_name(i, z)}: sigma is {z.sigma}; it must be positive and finite")


def _whitened(i: int, z: Position) -> tuple[Array, Array]:
    """Value and whitener W, W^T W = covariance^-1."""
    value = np.asarray(z.value, dtype=float)
    C = np.asarray(z.covariance, dtype=float)
    if value.shape not in ((2,), (3,)) or C.shape != 2 * value.shape:
        raise ValueError(
            f"{_name(i, z)}: value has shape {value.shape} and covariance {C.shape};"
            " they must be (2,) and (2, 2), or (3,) and (3, 3)"
        )
    if not math.isfinite(value.sum()):
        raise ValueError(f"{_name(i, z)}: value {value} is not finite; leave it out")
    if not math.isfinite(C.sum()) or np.abs(C - C.T).max() > 1e-9 * abs(C).max():
        raise ValueError(f"{_name(i, z)}: covariance must be finite and symmetric, it is {C.tolist()}")
    try:
        return value, np.linalg.inv(np.linalg.cholesky(C))
    except np.linalg.LinAlgError:
        raise ValueError(
            f"{_name(i, z)}: covariance is not positive definite (eigenvalues"
            f" {np.linalg.eigvalsh(C).tolist()}); give every axis a positive variance"
        ) from None


def _widened(W: Array, n: int) -> Array:
    if W.shape[1] == n:
        return W
    return np.hstack((W, np.zeros((len(W), n - W.shape[1]))))


def _sight(i: int, z: Azimuth | Range, n: int) -> Sight:
    _check(i, z)
    b = np.asarray(z.beacon, dtype=float)
    if b.shape != (n,):
        raise ValueError(
            f"{_name(i, z)}: beacon has shape {b.shape} in a problem of {n} dimensions; give {n} coordinates"
        )
    beacon = (float(b[0]), float(b[1]), float(b[2]) if n == 3 else 0.0)
    if not math.isfinite(sum(beacon)):
        raise ValueError(f"{_name(i, z)}: beacon {beacon} is not finite")
    if isinstance(z, Range):
        if z.value < 0.0:
            raise ValueError(f"{_name(i, z)}: value is {z.value} m; a range is not negative")
        return _Slant(beacon, float(z.value), float(z.sigma))
    axes = None
    if z.axes is not None:
        C = np.asarray(z.axes, dtype=float)
        # not (... <= ...) so that a NaN is refused too
        if n != 3 or C.shape != (3, 3) or not np.abs(C @ C.T - np.eye(3)).max() <= 1e-6:
            raise ValueError(
                f"{_name(i, z)}: axes must be a (3, 3) rotation, and the problem of three dimensions"
            )
        e, nn, u = C.tolist()
        axes = (tuple(e), tuple(nn), tuple(u))
    return _Bearing(beacon, float(z.value), float(z.sigma), axes)
