"""Maximum-likelihood position from any number of positions, azimuths, ranges and heights with normal errors.

After Lukinova, Podgorna and Rogozhin. Their estimator (5)

    X = (H^T R^-1 H)^-1 H^T R^-1 Z,   covariance (H^T R^-1 H)^-1

is linear and works axis by axis; `weights` keeps it in that form. An azimuth and a range are neither linear
nor independent by axes, so here (5) is iterated on the joint problem: with whitened residuals r and
their Jacobian J at the last position,

    minimise r^T r,   F = J^T J,   step (F + mu I)^-1 J^T r   (Gauss-Newton; `descent`)

and F at the end is the information, F^-1 the Cramer-Rao bound there. DEPARTS FROM (6): the inverse on the
second R is restored. DEPARTS FROM (7): one row per observation, azimuth and range with their own partials.

What degenerates, and what is done
    A direction that nothing measures: `Unobservable`, with the direction and what to add, never a number.
    Two places that explain the same ranges (two beacons: two crossings, mirrored in the line between them):
        a position among the observations, or `start`, chooses; without either `Ambiguous`, with both places.
    Over a beacon: an azimuth whose beacon sees the fix higher than `cone` is left out and listed as `silent`.
        The plane has no elevations: there the caller leaves out azimuths of a beacon too near.
    A start in the wrong valley: a misfit that noise does not explain is tried again from the crossings.
    Rays that do not meet: the cost falls all the way to infinity; `NoFix`.
    A wild measurement is NOT rejected here: the residuals and their shares of the cost tell which one it is.

Frame and observations: see `observations`. It knows no time and no motion.
"""

import contextlib
import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.special import gammaincc

from companion.estimate.initial_position import converted, crossings, mean_position
from companion.estimate.levenberg_marquardt import Minimum, NoFix, descend, inverse
from companion.estimate.observations import (
    Array,
    Azimuth,
    Height,
    Linearised,
    Model,
    Observation,
    Point,
    Position,
    Range,
)

__all__ = [
    "Ambiguous",
    "Azimuth",
    "Fix",
    "Height",
    "NoFix",
    "Observation",
    "Peak",
    "Position",
    "Range",
    "Unobservable",
    "converted",
    "cramer_rao",
    "information",
    "maximum_likelihood",
    "most_likely",
]

CONE_OF_SILENCE = math.radians(60.0)
"""Elevation above which an azimuth is not believed, rad. The signal fades there, and towards the
zenith the linearised azimuth claims an accuracy that it does not have."""

_OBSERVABLE = 1e-12  # least ratio of the information's eigenvalues: standard deviations a million times apart
_TRIALS = 8  # crossings followed down, the cheapest first
_LIKELIHOOD_GAP = 9.0  # difference of costs by which one place is preferred to another: three sigma
_PLAUSIBLE = 5.0  # a cost this many of its own standard deviations above its mean may be a wrong valley


class Unobservable(NoFix):
    """Some direction is measured by nothing. `directions` (k, n) are orthogonal unit vectors."""

    def __init__(self, message: str, directions: Array) -> None:
        super().__init__(message)
        self.directions = directions


class Ambiguous(NoFix):
    """Several places explain the observations. `positions` (k, n) m, the likeliest first."""

    def __init__(self, message: str, positions: Array) -> None:
        super().__init__(message)
        self.positions = positions


class Fix(NamedTuple):
    """The most likely position and how well the observations agree on it.

    `cost` is the sum of squared residuals in standard deviations, chi-square with `degrees_of_freedom` if the
    errors are as stated. Per observation, in the order given: `residuals` are observed minus computed, (k,)
    metres or radians; `chi_squares` their shares of the cost. `silent` are the indices of the azimuths left
    out, in the cone of silence.
    """

    position: Array
    covariance: Array
    cost: float
    iterations: int
    degrees_of_freedom: int
    residuals: tuple[Array, ...]
    chi_squares: tuple[float, ...]
    silent: tuple[int, ...]

    @property
    def p_value(self) -> float:
        """Probability of a cost at least this large if the stated errors are right; 1 without redundancy."""
        if self.degrees_of_freedom == 0:
            return 1.0
        return float(gammaincc(self.degrees_of_freedom / 2.0, self.cost / 2.0))


class Peak(NamedTuple):
    """The most likely position (m), the rows of its covariance (m^2) and the cost, as in `Fix`."""

    position: Point
    covariance: tuple[tuple[float, ...], ...]
    cost: float


def maximum_likelihood(
    observations: Sequence[Observation], start: npt.ArrayLike | None = None, cone: float = CONE_OF_SILENCE
) -> Fix:
    """The position (n,) that makes the observations most likely, and its covariance (n, n), m and m^2.

    `start` (n,) m is where to look first: needed only where two places are equally likely and nothing among
    the observations chooses. It is no observation and carries no weight. An azimuth whose beacon sees the fix
    higher than `cone` rad is left out. Raises ValueError naming a bad observation, and NoFix, Unobservable or
    Ambiguous where good observations do not give a position.
    """
    x0 = None if start is None else _start(start)
    model = Model(observations, 2 if x0 is None else len(x0))
    if x0 is None:
        x0 = mean_position(model)
    if x0 is not None and len(x0) != model.n:
        raise ValueError(f"start has {len(x0)} coordinates, the observations {model.n}: give as many")
    model, found = _heard_fix(model, None if x0 is None else model.point(x0), cone)
    covariance = np.array(_invert(model, found.at))
    residuals, shares = model.residuals(found.p)
    return Fix(
        model.place(found.p),
        covariance,
        found.at.cost,
        found.iterations,
        len(found.at.rows) - model.n,
        residuals,
        shares,
        tuple(sorted(model.silent)),
    )


def most_likely(observations: Sequence[Observation], start: Point, cone: float = CONE_OF_SILENCE) -> Peak:
    """The same in space and in plain numbers, for who asks in flight and for no residuals."""
    model, found = _heard_fix(Model(observations, 3), start, cone)
    return Peak(found.p, _invert(model, found.at), found.at.cost)


def information(
    observations: Sequence[Observation], position: npt.ArrayLike, cone: float = CONE_OF_SILENCE
) -> Array:
    """Fisher information F = J^T J (n, n), 1/m^2, of the observations for an aircraft at `position` (n,).

    The measured values do not enter, only where the beacons are and how large the errors. An azimuth in its
    beacon's cone of silence has none.
    """
    J = _heard(observations, position, cone)[1].J
    return J.T @ J


def cramer_rao(
    observations: Sequence[Observation], position: npt.ArrayLike, cone: float = CONE_OF_SILENCE
) -> Array:
    """Cramer-Rao bound F^-1 (n, n), m^2: no unbiased estimator has a smaller covariance at `position` (n,).

    Raises Unobservable where a direction is not measured.
    """
    return np.array(_invert(*_heard(observations, position, cone)))


def _heard(
    observations: Sequence[Observation], position: npt.ArrayLike, cone: float
) -> tuple[Model, Linearised]:
    x = _start(position)
    model = Model(observations, len(x))
    p = model.point(x)
    if model.n == 3:
        model = model.without(model.above(p, cone))
    return model, model.at(p)


def _start(start: npt.ArrayLike) -> Array:
    x = np.array(start, dtype=float)
    if x.shape not in ((2,), (3,)) or not np.isfinite(x).all():
        raise ValueError(f"start is {start!r}: give 2 or 3 finite coordinates")
    return x


def _heard_fix(model: Model, p0: Point | None, cone: float) -> tuple[Model, Minimum]:
    """The fix and the model without the azimuths that cannot be heard there; the plane has no cone."""
    if model.n == 3 and p0 is not None and (silent := model.above(p0, cone)):
        # near its beacon an azimuth pulls the fix into the singular point, so the others are asked first
        quiet = model.without(silent)
        with contextlib.suppress(NoFix):
            found = _descend_from(quiet, p0)
            if silent <= quiet.above(found.p, cone):
                model, p0 = quiet, found.p
    while True:
        found = _descend_from(model, p0)
        # what the cone takes away stays away, so that this ends
        silent = model.above(found.p, cone) - model.silent if model.n == 3 else frozenset[int]()
        if not silent:
            return model, found
        model, p0 = model.without(silent), found.p


def _descend_from(model: Model, p0: Point | None) -> Minimum:
    """The minimum reached from p0; from the crossings where p0 is missing or ends in a misfit."""
    if p0 is not None:
        try:
            found = descend(model, p0)
        except NoFix:
            return _likeliest(model)
        if _plausible(found.at, model.n):
            return found
        try:
            other = _likeliest(model)
        except NoFix:
            return found
        return other if other.at.cost < found.at.cost - _LIKELIHOOD_GAP else found
    return _likeliest(model)


def _plausible(at: Linearised, n: int) -> bool:
    k = max(len(at.rows) - n, 0)
    return at.cost <= k + _PLAUSIBLE * math.sqrt(2.0 * k) + 1e-6


def _likeliest(model: Model) -> Minimum:
    """The best minimum reachable from the crossings; Ambiguous if another place is nearly as good."""
    points = crossings(model) or [(0.0, 0.0, 0.0)]
    points.sort(key=lambda p: model.at(p).cost)
    minima: list[Minimum] = []
    failure: NoFix | None = None
    for p in points[:_TRIALS]:
        try:
            if all(_apart(p, m) for m in minima):
                minima.append(descend(model, p))
        except NoFix as e:
            failure = e
    if not minima:
        assert failure is not None
        raise failure
    minima.sort(key=lambda m: m.at.cost)
    best = minima[0]
    _invert(model, best.at)  # what is not measured at all is said first
    rivals = [m for m in minima if m.at.cost - best.at.cost < _LIKELIHOOD_GAP and _apart(m.p, best)]
    if rivals:
        places = [model.place(best.p), model.place(rivals[0].p)]
        raise Ambiguous(
            "two places explain the observations: "
            + " and ".join(str(p.round(1).tolist()) for p in places)
            + "; give a start near the right one, or add a Position or another beacon",
            np.array(places),
        )
    return best


def _apart(p: Point, m: Minimum) -> bool:
    """Whether p is another place than the minimum: more than three standard deviations from it."""
    x, y, z = p[0] - m.p[0], p[1] - m.p[1], p[2] - m.p[2]
    return sum([(a * x + b * y + c * z) ** 2 for _, a, b, c in m.at.rows]) > 9.0


def _invert(model: Model, at: Linearised) -> tuple[tuple[float, ...], ...]:
    """Rows of the covariance F^-1; Unobservable where an eigenvalue of F vanishes against the largest."""
    if (found := inverse(at)) is not None:
        return found
    eigenvalues, V = np.linalg.eigh(at.J.T @ at.J)
    blind = eigenvalues <= _OBSERVABLE * eigenvalues[-1]
    if blind.any():
        raise _unobservable(model, V[:, blind])
    return tuple(map(tuple, ((V / eigenvalues) @ V.T).tolist()))


def _unobservable(model: Model, N: Array) -> Unobservable:
    """The exception that names the directions spanned by the columns of N (n, k)."""
    lost = ""
    if model.silent:
        lost = f" (the azimuths {sorted(model.silent)} are silent: their beacons see the fix too high)"
    if model.n == 3:
        # of all bases of the blind directions, the one that has the most vertical member first
        vertical = N @ N[2]
        if np.linalg.norm(vertical) > 0.5:
            N = np.linalg.qr(np.column_stack((vertical, N)))[0][:, : N.shape[1]]
    named = " and ".join(_name(v) for v in N.T)
    advice = (
        "a Position, a Range to a beacon that lies along it, or an Azimuth from a beacon that lies across it"
    )
    if model.n == 3 and abs(N[2, 0]) > 0.5:
        advice = "a Height or a Position of three coordinates" + (f", and {advice}" if N.shape[1] > 1 else "")
    return Unobservable(f"nothing measures the position along {named}{lost}: add {advice}", N.T)


def _name(v: Array) -> str:
    """A direction for people: the vertical, or an azimuth in [0, 180) deg, with its slope if it has one."""
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
