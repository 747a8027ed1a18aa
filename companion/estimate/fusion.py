"""Maximum-likelihood position from any number of positions, azimuths, ranges and heights with normal errors.

After Lukinova, Podgorna and Rogozhin. Their estimator (5)

    X = (H^T R^-1 H)^-1 H^T R^-1 Z,   covariance (H^T R^-1 H)^-1

is linear and works axis by axis; `weights` keeps it in that form. An azimuth and a range are neither linear
nor independent by axes, so here (5) is iterated on the joint problem: with whitened residuals r and
their Jacobian J at the last position,

    minimise r^T r,   F = J^T J,   step (F + mu I)^-1 J^T r   (`levenberg_marquardt`)

and F at the end is the information, F^-1 the Cramer-Rao bound there. DEPARTS FROM (6): the inverse on the
second R is restored. DEPARTS FROM (7): one row per observation, azimuth and range with their own partials.

Degenerate cases
    A direction that no observation measures: `Unobservable`, with the direction and what to add.
    Two places that explain the same ranges (two beacons: two crossings, mirrored in the line between them):
        a position among the observations, or `start`, chooses; without either `Ambiguous`, with both places.
    Over a beacon: an azimuth whose beacon sees the fix higher than CONE_OF_SILENCE is left out and listed in
        `in_cone_of_silence`. The plane has no elevations: there the caller leaves out azimuths of a beacon
        too near.
    A start near a wrong local minimum: a misfit that noise does not explain is retried from the crossings.
    Rays that do not meet: the cost falls all the way to infinity; `NoFix`.
    A wild measurement is NOT rejected here: the residuals and their shares of the cost identify it.

Frame and observations: see `observations`. It knows no time and no motion.
"""

import contextlib
import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from companion.estimate.initial_position import find_crossings, mean_position
from companion.estimate.levenberg_marquardt import Minimum, NoFix, invert_information, minimize_cost
from companion.estimate.observations import (
    Azimuth,
    Height,
    Linearised,
    Model,
    Observation,
    Point,
    Position,
    Range,
)
from companion.units import Floats

__all__ = [
    "Ambiguous",
    "Azimuth",
    "Fix",
    "Height",
    "NoFix",
    "Observation",
    "Position",
    "Range",
    "Unobservable",
    "maximum_likelihood",
]

CONE_OF_SILENCE = math.radians(60.0)
"""Elevation above which an azimuth is left out, rad. The signal fades there, and towards the
zenith the linearised azimuth claims an accuracy that it does not have."""

_OBSERVABLE = 1e-12  # least ratio of the information's eigenvalues: standard deviations a million times apart
_TRIALS = 8  # crossings tried, in the order of their cost
_LIKELIHOOD_GAP = 9.0  # least difference of costs to prefer one place to another: three sigma
_PLAUSIBLE = 5.0  # a cost more of its standard deviations above its mean may be a wrong minimum


class Unobservable(NoFix):
    """Some direction is not measured.

    Attributes
    ----------
    directions : (k, n)
        Orthogonal unit vectors of the unobservable directions.
    """

    def __init__(self, message: str, directions: Floats) -> None:
        super().__init__(message)
        self.directions = directions


class Ambiguous(NoFix):
    """Several places explain the observations.

    Attributes
    ----------
    positions : (k, n)
        The places, m, the most likely first.
    """

    def __init__(self, message: str, positions: Floats) -> None:
        super().__init__(message)
        self.positions = positions


class Fix(NamedTuple):
    """Maximum-likelihood position.

    Attributes
    ----------
    position : (n,)
        East, north[, up], m.
    covariance : (n, n)
        Its covariance, m^2.
    cost : float
        Sum of squared residuals in standard deviations; chi-square if the errors are as stated.
    iterations : int
        Steps of the last descent.
    degrees_of_freedom : int
        Of the cost.
    in_cone_of_silence : tuple of int
        Indices of the azimuths left out.
    """

    position: Floats
    covariance: Floats
    cost: float
    iterations: int
    degrees_of_freedom: int
    in_cone_of_silence: tuple[int, ...]


def maximum_likelihood(observations: Sequence[Observation], start: npt.ArrayLike | None = None) -> Fix:
    """Compute the most likely position and its covariance.

    Parameters
    ----------
    observations : sequence of Observation
        In one Cartesian frame, see `observations`.
    start : (n,), optional
        First point of the search, m. Needed only where two places are equally likely and no observation
        chooses; it is not an observation and has no weight.

    Returns
    -------
    Fix
        Position and covariance.

    Raises
    ------
    ValueError
        Names a bad observation.
    NoFix, Unobservable, Ambiguous
        If good observations do not give a position.

    References
    ----------
    Lukinova, Podgorna, Rogozhin (5)-(7).
    """
    x0 = None if start is None else _check_start(start)
    model = Model(observations, 2 if x0 is None else len(x0))
    if x0 is None:
        x0 = mean_position(model)
    if x0 is not None and len(x0) != model.n:
        raise ValueError(f"start has {len(x0)} coordinates, the observations {model.n}: give as many")
    model, found = _fix_outside_cone(model, None if x0 is None else model.point(x0))
    covariance = np.array(_invert(model, found.at))
    return Fix(
        model.place(found.p),
        covariance,
        found.at.cost,
        found.iterations,
        len(found.at.rows) - model.n,
        tuple(sorted(model.in_cone)),
    )


def _check_start(start: npt.ArrayLike) -> Floats:
    x = np.array(start, dtype=float)
    if x.shape not in ((2,), (3,)) or not np.isfinite(x).all():
        raise ValueError(f"start is {start!r}: give 2 or 3 finite coordinates")
    return x


def _fix_outside_cone(model: Model, p0: Point | None) -> tuple[Model, Minimum]:
    """Compute the fix and the model without the azimuths in the cone of silence; a plane has no cone."""
    if model.n == 3 and p0 is not None and (in_cone := model.azimuths_above(p0, CONE_OF_SILENCE)):
        # near its beacon an azimuth pulls the fix into the singular point: try without it first
        reduced = model.without(in_cone)
        with contextlib.suppress(NoFix):
            found = _descend_from(reduced, p0)
            if in_cone <= reduced.azimuths_above(found.p, CONE_OF_SILENCE):
                model, p0 = reduced, found.p
    while True:
        found = _descend_from(model, p0)
        if model.n == 2 or not (in_cone := model.azimuths_above(found.p, CONE_OF_SILENCE) - model.in_cone):
            return model, found
        # an azimuth once left out stays out: the loop ends
        model, p0 = model.without(in_cone), found.p


def _descend_from(model: Model, p0: Point | None) -> Minimum:
    """Find the minimum from p0; from the crossings where p0 is missing or ends in a misfit."""
    if p0 is not None:
        try:
            found = minimize_cost(model, p0)
        except NoFix:
            return _best_from_crossings(model)
        if _is_plausible(found.at, model.n):
            return found
        try:
            other = _best_from_crossings(model)
        except NoFix:
            return found
        return other if other.at.cost < found.at.cost - _LIKELIHOOD_GAP else found
    return _best_from_crossings(model)


def _is_plausible(at: Linearised, n: int) -> bool:
    k = max(len(at.rows) - n, 0)
    return at.cost <= k + _PLAUSIBLE * math.sqrt(2.0 * k) + 1e-6


def _best_from_crossings(model: Model) -> Minimum:
    """Find the best minimum reachable from the crossings; Ambiguous if another place is nearly as good."""
    points = find_crossings(model) or [(0.0, 0.0, 0.0)]
    points.sort(key=lambda p: model.at(p).cost)
    minima: list[Minimum] = []
    failure: NoFix | None = None
    for p in points[:_TRIALS]:
        try:
            if all(_differs(p, m) for m in minima):
                minima.append(minimize_cost(model, p))
        except NoFix as e:
            failure = e
    if not minima:
        assert failure is not None
        raise failure
    minima.sort(key=lambda m: m.at.cost)
    best = minima[0]
    _invert(model, best.at)  # report an unobservable direction first
    rivals = [m for m in minima if m.at.cost - best.at.cost < _LIKELIHOOD_GAP and _differs(m.p, best)]
    if rivals:
        places = [model.place(best.p), model.place(rivals[0].p)]
        raise Ambiguous(
            "two places explain the observations: "
            + " and ".join(str(p.round(1).tolist()) for p in places)
            + "; give a start near the right one, or add a Position or another beacon",
            np.array(places),
        )
    return best


def _differs(p: Point, m: Minimum) -> bool:
    """Return whether p is more than three standard deviations from the minimum."""
    x, y, z = p[0] - m.p[0], p[1] - m.p[1], p[2] - m.p[2]
    return sum([(a * x + b * y + c * z) ** 2 for _, a, b, c in m.at.rows]) > 9.0


def _invert(model: Model, at: Linearised) -> tuple[tuple[float, ...], ...]:
    """Compute the rows of F^-1; Unobservable where an eigenvalue of F vanishes against the largest."""
    if (found := invert_information(at)) is not None:
        return found
    eigenvalues, V = np.linalg.eigh(at.J.T @ at.J)
    unobservable = eigenvalues <= _OBSERVABLE * eigenvalues[-1]
    if unobservable.any():
        raise _unobservable(model, V[:, unobservable])
    return tuple(map(tuple, ((V / eigenvalues) @ V.T).tolist()))


def _unobservable(model: Model, N: Floats) -> Unobservable:
    """Build the exception that names the directions spanned by the columns of N (n, k)."""
    left_out = ""
    if model.in_cone:
        left_out = f" (the azimuths {sorted(model.in_cone)} are left out: cone of silence of their beacons)"
    if model.n == 3:
        # choose the basis of the unobservable directions with the most vertical vector first
        vertical = N @ N[2]
        if np.linalg.norm(vertical) > 0.5:
            N = np.linalg.qr(np.column_stack((vertical, N)))[0][:, : N.shape[1]]
    named = " and ".join(_direction_name(v) for v in N.T)
    advice = (
        "a Position, a Range to a beacon that lies along it, or an Azimuth from a beacon that lies across it"
    )
    if model.n == 3 and abs(N[2, 0]) > 0.5:
        advice = "a Height or a Position of three coordinates" + (f", and {advice}" if N.shape[1] > 1 else "")
    return Unobservable(f"nothing measures the position along {named}{left_out}: add {advice}", N.T)


def _direction_name(v: Floats) -> str:
    """Describe a direction: the vertical, or an azimuth in [0, 180) deg, with its slope if it has one."""
    horizontal = math.hypot(v[0], v[1])
    up = float(v[2]) if len(v) == 3 else 0.0
    if horizontal < 0.02 * abs(up):
        return "the vertical"
    azimuth_deg = math.degrees(math.atan2(v[0], v[1])) % 360.0
    if azimuth_deg >= 179.995:
        azimuth_deg, up = azimuth_deg - 180.0, -up
    slope_deg = math.degrees(math.atan2(up, horizontal))
    level = abs(slope_deg) < 0.05
    # + 0.0 turns a rounded -0.0 into 0.0
    return f"azimuth {round(azimuth_deg, 2) + 0.0:.2f} deg" + (
        "" if level else f" at a slope of {slope_deg:.1f} deg"
    )
