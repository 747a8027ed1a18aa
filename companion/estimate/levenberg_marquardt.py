"""Gauss-Newton with Levenberg's damping, in two or three unknowns and plain numbers.

With whitened residuals r and their Jacobian J at the last position,

    minimise r^T r,   F = J^T J,   step (F + mu I)^-1 J^T r,   mu rises until the cost falls

It goes down from one point; which one, and what the minimum is worth, is `fusion`'s.
"""

import math
from typing import NamedTuple

from companion.estimate.observations import Linearised, Model, Point

_CLEARLY = 1e-9  # pivots whose product over that of the trace is more hide no small eigenvalue
_DAMPING = 1e-14  # least mu, in traces of F: keeps a step finite along a direction that nothing measures
_STEPS = 100
_CONVERGED = 1e-9  # a step this long, in standard deviations, is not worth taking
_LEVEL = 1e-11  # a rise of the cost by less, relative to 1 + cost, is rounding
_STALLED = 1e-4  # and one this long if rounding no longer lets the cost fall


class NoFix(ValueError):
    """The observations, each fit for use, do not give a position."""


class Minimum(NamedTuple):
    """Where the cost is least, the equations there, and the steps it took."""

    p: Point
    at: Linearised
    iterations: int


def descend(model: Model, p: Point) -> Minimum:
    """The minimum of the cost that is reached from p; NoFix where there is none."""
    at = model.at(p)
    floor, mu = _DAMPING, _DAMPING
    for iteration in range(1, _STEPS + 1):
        step, length = _step(at, mu)
        # while damped, a step is short for another reason
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


def inverse(at: Linearised) -> tuple[tuple[float, ...], ...] | None:
    """The n rows of F^-1, m^2; None where some direction may be measured by nothing."""
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
    """Levenberg's step (F + mu trace(F) I)^-1 J^T r and its length in standard deviations.

    In the plane nothing measures z, and the step has none.
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
    """Of F + `least` I, which no pivot can fall below."""
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
