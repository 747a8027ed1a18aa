"""Observations of a position: positions, azimuths, slant ranges and heights, each with its errors.

Four values, and `Model`, which turns a list of them into whitened equations. It does not know how the
equations are solved (`fusion`), where the sizes of the errors come from, or the earth: the caller transforms
everything into one Cartesian frame first. The equations are plain numbers: there are two or three unknowns,
and an array of three costs ten times its arithmetic.

Frame: x east, y north[, z up], metres, any origin; this module keeps the papers' order. Azimuths are counted
from north clockwise at the beacon, towards the aircraft. A problem has three dimensions as soon as one
position, beacon or start has three components or a height is given; a position of two components then leaves
the third free.

North at the beacon is not north here: seen in a tangent plane at the aircraft, the true north of a beacon 400
km to the east is turned by 3.6 deg tan(latitude). So `Azimuth.axes` rotates this frame's axes to the beacon's
own east, north, up; with the beacon's coordinates transformed through ECEF nothing is then approximated. A
slant range needs no such rotation: a length is the same in all frames.

Above a beacon there is no azimuth: the antenna has its cone of silence, and the geometry itself breaks down
where the azimuth's share of the error, sigma_A times the horizontal distance, tends to zero and claims an
accuracy that is not there. `Model.azimuths_above` finds such azimuths and `Model.without` leaves them out.
"""

import copy
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from companion.units import Floats

Point = tuple[float, float, float]
Row = tuple[float, float, float, float]
"""One whitened equation at a point: residual, observed minus computed, and the gradient of the computed."""


@dataclass(frozen=True, slots=True, eq=False)
class Position:
    """Measured position.

    Attributes
    ----------
    value : (2,) or (3,)
        East, north[, up], m.
    covariance : (2, 2) or (3, 3)
        Full covariance, m^2.
    """

    value: npt.ArrayLike
    covariance: npt.ArrayLike


@dataclass(frozen=True, slots=True, eq=False)
class Azimuth:
    """Azimuth of the aircraft from a beacon.

    Attributes
    ----------
    beacon : (2,) or (3,)
        Beacon position, m.
    value : float
        Azimuth, rad, clockwise from the beacon's north.
    sigma : float
        Its error, rad.
    axes : (3, 3), optional
        Rotation from this frame's axes to the beacon's own east, north, up; None where they are the same.
    """

    beacon: npt.ArrayLike
    value: float
    sigma: float
    axes: npt.ArrayLike | None = None


@dataclass(frozen=True, slots=True, eq=False)
class Range:
    """Slant range of the aircraft from a beacon.

    Attributes
    ----------
    beacon : (2,) or (3,)
        Beacon position, m.
    value : float
        Range, m.
    sigma : float
        Its error, m.
    """

    beacon: npt.ArrayLike
    value: float
    sigma: float


@dataclass(frozen=True, slots=True, eq=False)
class Height:
    """Height, the z of this frame.

    Attributes
    ----------
    value : float
        Height, m.
    sigma : float
        Its error, m.
    """

    value: float
    sigma: float


Observation = Position | Azimuth | Range | Height


class _AzimuthEquation:
    """Azimuth prepared for evaluation: whitened residual and gradient at a point."""

    __slots__ = ("A", "axes", "beacon", "sigma")

    def __init__(
        self, beacon: Point, A: float, sigma: float, axes: tuple[Point, Point, Point] | None
    ) -> None:
        self.beacon, self.A, self.sigma, self.axes = beacon, A, sigma, axes

    def local(self, p: Point) -> Point:
        """Resolve point p in the beacon's east, north, up."""
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

    def row(self, p: Point) -> Row:
        x, y, _ = self.local(p)
        residual = math.remainder(self.A - math.atan2(x, y), math.tau) / self.sigma
        d2 = (x * x + y * y) * self.sigma
        if d2 == 0.0:  # exactly above the beacon the gradient is undefined: none
            return (residual, 0.0, 0.0, 0.0)
        de, dn = y / d2, -x / d2
        if self.axes is None:
            return (residual, de, dn, 0.0)
        e, n, _ = self.axes
        return (
            residual,
            de * e[0] + dn * n[0],
            de * e[1] + dn * n[1],
            de * e[2] + dn * n[2],
        )


class _RangeEquation:
    """Range prepared for evaluation: whitened residual and gradient at a point."""

    __slots__ = ("D", "beacon", "sigma")

    def __init__(self, beacon: Point, D: float, sigma: float) -> None:
        self.beacon, self.D, self.sigma = beacon, D, sigma

    def row(self, p: Point) -> Row:
        x0, y0, z0 = self.beacon
        x, y, z = p[0] - x0, p[1] - y0, p[2] - z0
        d = math.sqrt(x * x + y * y + z * z)
        if d == 0.0:  # at the beacon the gradient is undefined: north
            return (self.D / self.sigma, 0.0, 1.0 / self.sigma, 0.0)
        s = d * self.sigma
        return ((self.D - d) / self.sigma, x / s, y / s, z / s)


BeaconEquation = _AzimuthEquation | _RangeEquation


class Linearised:
    """Whitened equations at one point.

    Attributes
    ----------
    rows : list
        Residual and gradient of each equation.
    n : int
        Number of unknowns.
    cost : float
        Sum of squared residuals.
    """

    __slots__ = ("cost", "n", "rows")

    def __init__(self, rows: list[Row], n: int) -> None:
        self.rows, self.n = rows, n
        self.cost = sum([row[0] * row[0] for row in rows])

    @property
    def r(self) -> Floats:
        """Return the residuals (m,)."""
        return np.array([row[0] for row in self.rows])

    @property
    def J(self) -> Floats:
        """Return the Jacobian (m, n) of the computed values."""
        return np.array([row[1 : 1 + self.n] for row in self.rows])


class Model:
    """Observations as whitened equations in 2 or 3 unknowns.

    Linear observations (positions, heights) are rows of W x = w, computed once; azimuths and ranges
    (`beacon_equations`) are linearised at each point.

    Parameters
    ----------
    observations : sequence of Observation
        At least one.
    start : int
        Number of coordinates of the start.

    Attributes
    ----------
    n : int
        Number of unknowns.
    beacon_equations : list
        Equation of each azimuth and range, None for other observations.
    in_cone : frozenset of int
        Azimuths left out, in the cone of silence of their beacon.

    Raises
    ------
    ValueError
        Names a bad observation.
    """

    __slots__ = ("_linear", "beacon_equations", "in_cone", "n", "observations")

    def __init__(self, observations: Sequence[Observation], start: int = 2) -> None:
        if not observations:
            raise ValueError("no observations: give at least a Position, or an Azimuth and a Range")
        self.observations = observations
        where = [_where(i, z) for i, z in enumerate(observations)]
        self.n = max(start, max([3 if place is None else len(place) for place in where]))
        self.beacon_equations: list[BeaconEquation | None] = []
        self.in_cone: frozenset[int] = frozenset()
        self._linear: list[Row] = []  # with w in place of the residual
        for i, (z, place) in enumerate(zip(observations, where, strict=True)):
            equation: BeaconEquation | None = None
            if isinstance(z, Height):
                _check(i, z)
                self._linear.append((z.value / z.sigma, 0.0, 0.0, 1.0 / z.sigma))
            elif isinstance(z, Position):
                self._linear += _whitened(i, z, place or ())
            else:
                equation = _beacon_equation(i, z, place or (), self.n)
            self.beacon_equations.append(equation)

    @property
    def linear(self) -> Linearised:
        """Return the positions and heights alone, linearised at the origin."""
        return Linearised(self._linear, self.n)

    def point(self, x: Floats) -> Point:
        """Convert a position to plain numbers.

        Parameters
        ----------
        x : (n,)
            Position, m.

        Returns
        -------
        Point
            Three numbers, z = 0 in the plane.
        """
        p = x.tolist()
        return (p[0], p[1], p[2] if self.n == 3 else 0.0)

    def place(self, p: Point) -> Floats:
        """Convert a point to an array.

        Parameters
        ----------
        p : Point
            Three numbers, m.

        Returns
        -------
        (n,)
            Position, m.
        """
        return np.array(p[: self.n])

    def at(self, p: Point) -> Linearised:
        """Linearise the equations.

        Parameters
        ----------
        p : Point
            Where, m.

        Returns
        -------
        Linearised
            Whitened equations, positions and heights first.
        """
        x, y, z = p
        rows = [(w - a * x - b * y - c * z, a, b, c) for w, a, b, c in self._linear]
        rows += [
            s.row(p) for i, s in enumerate(self.beacon_equations) if s is not None and i not in self.in_cone
        ]
        return Linearised(rows, self.n)

    def azimuths_above(self, p: Point, elevation: float) -> frozenset[int]:
        """Find the azimuths whose beacon sees a point above an elevation.

        Parameters
        ----------
        p : Point
            Position of the aircraft, m.
        elevation : float
            Limit, rad.

        Returns
        -------
        frozenset of int
            Indices of the observations.
        """
        return frozenset(
            i
            for i, s in enumerate(self.beacon_equations)
            if isinstance(s, _AzimuthEquation) and s.elevation(p) > elevation
        )

    def without(self, in_cone: frozenset[int]) -> "Model":
        """Leave out azimuths.

        Parameters
        ----------
        in_cone : frozenset of int
            Indices of the observations.

        Returns
        -------
        Model
            A copy without them.
        """
        other = copy.copy(self)
        other.in_cone = self.in_cone | in_cone
        return other


def _where(i: int, z: Observation) -> tuple[float, ...] | None:
    """Return the coordinates of the position or of the beacon; None for a height."""
    if isinstance(z, Height):
        return None
    if isinstance(z, Position):
        return _vector(z.value)
    if isinstance(z, Azimuth | Range):
        return _vector(z.beacon)
    raise ValueError(f"observation {i} is a {type(z).__name__}: give Position, Azimuth, Range or Height")


def _vector(x: npt.ArrayLike) -> tuple[float, ...]:
    """Convert to plain numbers; empty if it is not a vector."""
    if isinstance(x, tuple):
        return x
    array = np.asarray(x, dtype=float)
    return tuple(array.tolist()) if array.ndim == 1 else ()


def _matrix(x: npt.ArrayLike) -> tuple[tuple[float, ...], ...]:
    """Convert to rows of plain numbers; empty if it is not a matrix."""
    if isinstance(x, tuple):
        return x
    array = np.asarray(x, dtype=float)
    return tuple(map(tuple, array.tolist())) if array.ndim == 2 else ()


def _name(i: int, z: Observation) -> str:
    return f"observation {i} ({type(z).__name__})"


def _check(i: int, z: Azimuth | Range | Height) -> None:
    if not math.isfinite(z.value):
        raise ValueError(f"{_name(i, z)}: value is {z.value}, not a finite number; leave it out")
    if not (math.isfinite(z.sigma) and z.sigma > 0.0):
        raise ValueError(f"{_name(i, z)}: sigma is {z.sigma}; it must be positive and finite")


def _whitened(i: int, z: Position, x: tuple[float, ...]) -> list[Row]:
    """Compute the rows of W x = W value, W^T W = covariance^-1."""
    n, C = len(x), _matrix(z.covariance)
    if n not in (2, 3) or [len(row) for row in C] != [n] * n:
        raise ValueError(
            f"{_name(i, z)}: value has shape {np.shape(z.value)} and covariance {np.shape(z.covariance)};"
            " they must be (2,) and (2, 2), or (3,) and (3, 3)"
        )
    if not all(map(math.isfinite, x)):
        raise ValueError(f"{_name(i, z)}: value {list(x)} is not finite; leave it out")
    scale = max([abs(c) for row in C for c in row])
    off = max([abs(C[j][k] - C[k][j]) for k in range(n) for j in range(k)])
    if not (math.isfinite(scale) and off <= 1e-9 * scale):
        raise ValueError(f"{_name(i, z)}: covariance must be finite and symmetric, it is {C}")
    W = _whitener(C)
    if W is None:
        raise ValueError(
            f"{_name(i, z)}: covariance is not positive definite (eigenvalues"
            f" {np.linalg.eigvalsh(C).tolist()}); give every axis a positive variance"
        )
    if n == 2:
        return [(a * x[0] + b * x[1], a, b, 0.0) for a, b in W]
    return [(a * x[0] + b * x[1] + c * x[2], a, b, c) for a, b, c in W]


def _whitener(C: tuple[tuple[float, ...], ...]) -> list[tuple[float, ...]] | None:
    """Compute W with W C W^T = I by orthonormalising the unit vectors under C; None if C is not definite."""
    xx, xy, yy = C[0][0], C[0][1], C[1][1]
    if not xx > 0.0:
        return None
    u = 1.0 / math.sqrt(xx)
    yx = xy / xx
    rest = yy - yx * xy
    if not rest > 0.0:
        return None
    v = 1.0 / math.sqrt(rest)
    if len(C) == 2:
        return [(u, 0.0), (-v * yx, v)]
    (_, _, xz), (_, _, yz), (_, _, zz) = C
    zy = (yz - yx * xz) / rest
    zx = xz / xx - yx * zy
    rest = zz - zx * xz - zy * yz
    if not rest > 0.0:
        return None
    w = 1.0 / math.sqrt(rest)
    return [(u, 0.0, 0.0), (-v * yx, v, 0.0), (-w * zx, -w * zy, w)]


def _beacon_equation(i: int, z: Azimuth | Range, beacon: tuple[float, ...], n: int) -> BeaconEquation:
    _check(i, z)
    if len(beacon) != n or n > 3:
        raise ValueError(
            f"{_name(i, z)}: beacon has shape {np.shape(z.beacon)} in a problem of {n} dimensions;"
            f" give {min(n, 3)} coordinates"
        )
    place = (beacon[0], beacon[1], beacon[2] if n == 3 else 0.0)
    if not math.isfinite(sum(place)):
        raise ValueError(f"{_name(i, z)}: beacon {beacon} is not finite")
    if isinstance(z, Range):
        if z.value < 0.0:
            raise ValueError(f"{_name(i, z)}: value is {z.value} m; a range is not negative")
        return _RangeEquation(place, z.value, z.sigma)
    if z.axes is None:
        return _AzimuthEquation(place, z.value, z.sigma, None)
    C = _matrix(z.axes)
    if n != 3 or [len(row) for row in C] != [3] * 3 or not _orthonormal(*C):
        raise ValueError(
            f"{_name(i, z)}: axes must be a (3, 3) rotation, and the problem of three dimensions"
        )
    (xe, ye, ze), (xn, yn, zn), (xu, yu, zu) = C
    return _AzimuthEquation(place, z.value, z.sigma, ((xe, ye, ze), (xn, yn, zn), (xu, yu, zu)))


def _orthonormal(e: tuple[float, ...], n: tuple[float, ...], u: tuple[float, ...]) -> bool:
    """Return whether the rows are unit vectors at right angles; False for NaN."""
    return (
        abs(e[0] * e[0] + e[1] * e[1] + e[2] * e[2] - 1.0) <= 1e-6
        and abs(n[0] * n[0] + n[1] * n[1] + n[2] * n[2] - 1.0) <= 1e-6
        and abs(u[0] * u[0] + u[1] * u[1] + u[2] * u[2] - 1.0) <= 1e-6
        and abs(e[0] * n[0] + e[1] * n[1] + e[2] * n[2]) <= 1e-6
        and abs(e[0] * u[0] + e[1] * u[1] + e[2] * u[2]) <= 1e-6
        and abs(n[0] * u[0] + n[1] * u[1] + n[2] * u[2]) <= 1e-6
    )
