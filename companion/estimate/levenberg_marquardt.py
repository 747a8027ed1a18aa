"""Levenberg-Marquardt minimisation in two or three unknowns, in plain numbers.

With whitened residuals r and their Jacobian J at the last position,

    minimise r^T r,   F = J^T J,   step (F + mu I)^-1 J^T r,   mu rises until the cost falls

It descends from one point; `fusion` chooses that point and assesses the minimum.
"""

import math
from typing import NamedTuple

from companion.estimate.observations import Linearised, Model, Point

_CLEARLY = 1e-9  # least product of pivots over trace^3 that excludes a small eigenvalue
_DAMPING = 1e-14  # least mu, in traces of F: keeps a step finite along an unobservable direction
_STEPS = 100
_CONVERGED = 1e-9  # length of the last step, in standard deviations
_LEVEL = 1e-11  # rise of the cost, relative to 1 + cost, that is rounding
_STALLED = 1e-4  # length of the last step where the cost no longer falls, by rounding


class NoFix(ValueError):
    """The observations, each usable, do not determine a position."""


class Minimum(NamedTuple):
    """Minimum of the cost.

    Attributes
    ----------
    p : Point
        Position, m.
    at : Linearised
        Equations there.
    iterations : int
        Steps taken.
    """

    p: Point
    at: Linearised
    iterations: int


def minimize_cost(model: Model, p: Point) -> Minimum:
    """Minimise the cost from a starting point.

    Parameters
    ----------
    model : Model
        Equations.
    p : Point
        Start, m.

    Returns
    -------
    Minimum
        Minimum reached.

    Raises
    ------
    NoFix
        If there is none within the limit of steps.
    """
    at = model.at(p)
    floor, mu = _DAMPING, _DAMPING
    for iteration in range(1, _STEPS + 1):
        step, length = _step(at, mu)
        # a damped step is short without convergence
        if length < _CONVERGED and mu == floor:
            return Minimum(p, at, iteration)
        q = (p[0] + step[0], p[1] + step[1], p[2] + step[2])
        trial = model.at(q)
        if trial.cost <= at.cost + _LEVEL * (1.0 + at.cost):
            p, at, mu = q, trial, max(mu / 100.0, floor)
        elif length < _STALLED:
            return Minimum(p, at, iteration)
        else:
            mu = max(10.0 * mu, 1e-4)
    raise NoFix(
        f"no minimum of the cost within {_STEPS} steps (reached {model.place(p).round(1).tolist()}):"
        " azimuths that do not meet, or a start too far away; add an observation or give a nearer start"
    )


def invert_information(at: Linearised) -> tuple[tuple[float, ...], ...] | None:
    """Invert the information F = J^T J.

    Parameters
    ----------
    at : Linearised
        Equations at a point.

    Returns
    -------
    tuple or None
        n rows of F^-1, m^2; None where some direction may be unobservable.
    """
    F = _information(at)
    if at.n == 2:
        F = F._replace(zz=max(F.xx, F.yy))
    trace = F.xx + F.yy + F.zz
    if trace == 0.0:
        return None
    f = _factors(F, _DAMPING**2 * trace)
    if not f.dx * f.dy * f.dz > _CLEARLY * trace**3:
        return None
    if at.n == 2:
        return _solve(f, 1.0, 0.0, 0.0)[:2], _solve(f, 0.0, 1.0, 0.0)[:2]
    return _solve(f, 1.0, 0.0, 0.0), _solve(f, 0.0, 1.0, 0.0), _solve(f, 0.0, 0.0, 1.0)


def _step(at: Linearised, mu: float) -> tuple[Point, float]:
    """Compute Levenberg's step (F + mu trace(F) I)^-1 J^T r and its length in standard deviations.

    In the plane z is not measured, and the step has none.
    """
    F = _information(at)
    least = mu * (F.xx + F.yy + F.zz)
    if least == 0.0:
        return (0.0, 0.0, 0.0), 0.0
    u = v = w = 0.0
    for r, a, b, c in at.rows:
        u, v, w = u + a * r, v + b * r, w + c * r
    x, y, z = _solve(_factors(F, least), u, v, w)
    return (x, y, z), math.sqrt(max(x * u + y * v + z * w, 0.0))


class _Information(NamedTuple):
    """F = J^T J."""

    xx: float
    xy: float
    xz: float
    yy: float
    yz: float
    zz: float


class _Factors(NamedTuple):
    """F = L D L^T, the diagonal of L being ones."""

    dx: float
    dy: float
    dz: float
    yx: float
    zx: float
    zy: float


def _information(at: Linearised) -> _Information:
    xx = xy = xz = yy = yz = zz = 0.0
    for _, a, b, c in at.rows:
        xx, xy, xz = xx + a * a, xy + a * b, xz + a * c
        yy, yz, zz = yy + b * b, yz + b * c, zz + c * c
    return _Information(xx, xy, xz, yy, yz, zz)


def _factors(F: _Information, least: float) -> _Factors:
    """Factor F + `least` I; no pivot falls below `least`."""
    dx = F.xx + least
    yx, zx = F.xy / dx, F.xz / dx
    dy = max(F.yy + least - yx * F.xy, least)
    below = F.yz - yx * F.xz
    zy = below / dy
    dz = max(F.zz + least - zx * F.xz - zy * below, least)
    return _Factors(dx, dy, dz, yx, zx, zy)


def _solve(f: _Factors, u: float, v: float, w: float) -> Point:
    v -= f.yx * u
    w -= f.zx * u + f.zy * v
    z = w / f.dz
    y = v / f.dy - f.zy * z
    return u / f.dx - f.yx * y - f.zx * z, y, z
