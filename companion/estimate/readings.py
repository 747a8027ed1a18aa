"""Readings of a position in the plane whose errors may be correlated: the estimator (5), iterated.

Lukinova, Podgorna and Rogozhin state (5) for any correlation matrix R of the readings' errors and use a
diagonal one. Here R is full over all readings, of one source or of several:

    X <- X + (H^T R^-1 H)^-1 H^T R^-1 (Z - h(X)),   H = dh/dX at X

`fusion` is the estimator to navigate with: its observations are independent of each other, and it gives
the start of the iteration. `axis_rows` has the same readings in the paper's form, one axis at a time. x
east, y north, in any one unit of length; angles in radians, azimuths clockwise from north.
"""

import math
from collections.abc import Mapping, Sequence
from typing import Literal, NamedTuple

import numpy as np

from companion.estimate.fusion import Azimuth, NoFix, Observation, Position, Range, maximum_likelihood
from companion.estimate.weights import optimal_gain
from companion.units import Floats

Kind = Literal["x", "y", "azimuth", "range"]
KINDS: tuple[Kind, ...] = ("x", "y", "azimuth", "range")
_STEPS = 50
_CONVERGED = 1e-10  # length of the last step, in standard deviations
_NONE = 1e12  # sigmas of a coordinate that a source does not measure


class Reading(NamedTuple):
    """One number read from a source.

    Attributes
    ----------
    source : str
        Name of the source.
    kind : {"x", "y", "azimuth", "range"}
        What it measures.
    value : float
        Value, in the unit of length, or rad.
    sigma : float
        Standard deviation of its error, in the same unit.
    beacon : (float, float)
        Place of the beacon, of azimuths and ranges.
    """

    source: str
    kind: Kind
    value: float
    sigma: float
    beacon: tuple[float, float] = (0.0, 0.0)

    @property
    def name(self) -> str:
        """Return the name of the reading, for example GNSS.x."""
        return f"{self.source}.{self.kind}"


class JointFix(NamedTuple):
    """Position from all readings together.

    Attributes
    ----------
    position : (2,)
        East, north.
    covariance : (2, 2)
        Its covariance if R is right.
    weights : (2, m)
        K of (5) at the position.
    H : (m, 2)
        Partials of the readings at the position.
    iterations : int
        Steps taken.
    """

    position: Floats
    covariance: Floats
    weights: Floats
    H: Floats
    iterations: int


class AxisRows(NamedTuple):
    """Readings of one coordinate: direct ones, and D sin A or D cos A of each beacon.

    Attributes
    ----------
    sources : tuple of str
        Names of their sources.
    z : (k,)
        Readings of the coordinate.
    T : (k, m)
        Partials by all m readings: T R T' is the covariance of z.
    """

    sources: tuple[str, ...]
    z: Floats
    T: Floats


def error_covariance(
    readings: Sequence[Reading], correlations: Mapping[tuple[str, str], float] | None = None
) -> Floats:
    """Build R from sigmas and correlations.

    Parameters
    ----------
    readings : sequence of Reading
        The m readings.
    correlations : mapping, optional
        Correlation coefficient by the names of two readings; 0 where not given.

    Returns
    -------
    (m, m)
        R.

    Raises
    ------
    ValueError
        Names a sigma, a correlation or a reading that is not usable.
    """
    index = {reading.name: i for i, reading in enumerate(readings)}
    if len(index) < len(readings):
        raise ValueError("two readings have the same name: give every source each kind once")
    for reading in readings:
        if not (math.isfinite(reading.value) and math.isfinite(reading.sigma) and reading.sigma > 0.0):
            raise ValueError(
                f"{reading.name} is {reading.value:g} with sigma {reading.sigma:g}: give a finite value and a"
                " positive sigma"
            )
    C = np.eye(len(readings))
    for (a, b), rho in (correlations or {}).items():
        for name in (a, b):
            if name not in index:
                raise ValueError(f"no reading {name!r} to correlate: choose from {', '.join(index)}")
        if a == b or not abs(rho) < 1.0:
            raise ValueError(
                f"correlation of {a} and {b} is {rho:g}: give two readings and a number in (-1, 1)"
            )
        C[index[a], index[b]] = C[index[b], index[a]] = rho
    if (np.linalg.eigvalsh(C) < 1e-12).any():
        raise ValueError("these correlations cannot occur together: their matrix is not positive definite")
    sigma = np.array([reading.sigma for reading in readings])
    R: Floats = C * np.outer(sigma, sigma)
    return R


def predict_readings(readings: Sequence[Reading], position: Floats) -> tuple[Floats, Floats]:
    """Compute h(X) and H = dh/dX.

    Parameters
    ----------
    readings : sequence of Reading
        The m readings; their values do not enter.
    position : (2,)
        East, north.

    Returns
    -------
    tuple
        h (m,), an azimuth in (-pi, pi], and H (m, 2).

    Raises
    ------
    NoFix
        At the place of a beacon.
    """
    h, H = np.zeros(len(readings)), np.zeros((len(readings), 2))
    for i, reading in enumerate(readings):
        if reading.kind in ("x", "y"):
            axis = "xy".index(reading.kind)
            h[i], H[i, axis] = position[axis], 1.0
            continue
        x, y = float(position[0]) - reading.beacon[0], float(position[1]) - reading.beacon[1]
        d = math.hypot(x, y)
        if d == 0.0:
            raise NoFix(
                f"{reading.name}: the position is that of its beacon; azimuth and range have no partials"
            )
        if reading.kind == "range":
            h[i], H[i] = d, (x / d, y / d)
        else:
            h[i], H[i] = math.atan2(x, y), (y / d**2, -x / d**2)
    return h, H


def estimate_joint(readings: Sequence[Reading], R: Floats) -> JointFix:
    """Compute the most likely position from correlated readings.

    Parameters
    ----------
    readings : sequence of Reading
        The m readings.
    R : (m, m)
        Covariance of their errors, in their order.

    Returns
    -------
    JointFix
        Position, covariance and weights.

    Raises
    ------
    ValueError
        If R is not positive definite.
    NoFix
        If the readings do not determine a position.

    References
    ----------
    Lukinova, Podgorna, Rogozhin (5).
    """
    X = maximum_likelihood(_observations(readings)).position
    z = np.array([reading.value for reading in readings])
    angles = np.array([reading.kind == "azimuth" for reading in readings])
    for iteration in range(1, _STEPS + 1):
        h, H = predict_readings(readings, X)
        K = optimal_gain(H, R)
        nu = z - h
        nu[angles] = np.remainder(nu[angles] + math.pi, math.tau) - math.pi
        step, P = K @ nu, K @ R @ K.T
        X = X + step
        if float(step @ np.linalg.solve(P, step)) < _CONVERGED**2:
            return JointFix(X, P, K, H, iteration)
    raise NoFix(f"no position within {_STEPS} steps: check the readings, their sigmas and correlations")


def axis_rows(readings: Sequence[Reading], axis: Literal["x", "y"]) -> AxisRows:
    """Collect the readings of one coordinate, the paper's form.

    Parameters
    ----------
    readings : sequence of Reading
        The m readings.
    axis : {"x", "y"}
        Coordinate.

    Returns
    -------
    AxisRows
        k readings of it; a beacon needs azimuth and range.

    References
    ----------
    Lukinova, Podgorna, Rogozhin (7), corrected: see `weights`.
    """
    names, values, rows = [], [], []
    ranges = {r.source: (i, r) for i, r in enumerate(readings) if r.kind == "range"}
    for i, reading in enumerate(readings):
        row = np.zeros(len(readings))
        if reading.kind == axis:
            row[i], value = 1.0, reading.value
        elif reading.kind == "azimuth" and reading.source in ranges:
            j, D = ranges[reading.source]
            s, c = math.sin(reading.value), math.cos(reading.value)
            along, turned = (s, c) if axis == "x" else (c, -s)
            row[j], row[i] = along, D.value * turned
            value = D.beacon["xy".index(axis)] + D.value * along
        else:
            continue
        names.append(reading.source)
        values.append(value)
        rows.append(row)
    return AxisRows(tuple(names), np.array(values), np.reshape(rows, (len(rows), len(readings))))


def _observations(readings: Sequence[Reading]) -> list[Observation]:
    """Return the readings as independent observations."""
    found: list[Observation] = []
    for reading in readings:
        if reading.kind == "azimuth":
            found.append(Azimuth(reading.beacon, reading.value, reading.sigma))
        elif reading.kind == "range":
            found.append(Range(reading.beacon, reading.value, reading.sigma))
    lengths = [reading for reading in readings if reading.kind in ("x", "y")]
    for reading in lengths:
        variance = [(_NONE * reading.sigma) ** 2] * 2
        value = [0.0, 0.0]
        axis = "xy".index(reading.kind)
        variance[axis], value[axis] = reading.sigma**2, reading.value
        found.append(Position(value, np.diag(variance)))
    return found
