"""Initial positions: intersections of lines of position, from which the iteration of `fusion` starts.

An azimuth is a ray from its beacon, a range a circle round it, seen from above at a height taken as known.
Two of them intersect in no, one or two points; where they miss each other by the measurements' errors, a
point near both is taken. Errors are not weighed, and no intersection is an estimate: the directions of a
distant beacon are turned to this frame, its tilt is left out.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from companion.estimate.observations import Azimuth, Height, Model, Point, Position, Range
from companion.units import Floats

_ABOVE_BEACONS = 1000.0
"""Height above the highest beacon where nothing is known of the height, m."""


@dataclass(frozen=True, slots=True)
class _Ray:
    beacon: complex
    direction: complex

    def foot(self) -> complex:
        return self.beacon + 1e5 * self.direction


@dataclass(frozen=True, slots=True)
class _Circle:
    beacon: complex
    radius: float

    def foot(self) -> complex:
        return self.beacon + 1j * self.radius


_Line = _Ray | _Circle


def find_crossings(model: Model) -> list[Point]:
    """Find the points where the model's lines of position cross two by two; some point of a single line.

    Parameters
    ----------
    model : Model
        Observations.

    Returns
    -------
    list of Point
        Candidates, m; empty if there is no line of position.
    """
    z = _height(model)
    lines = list(_lines(model, z))
    points = [q for a, b in combinations(lines, 2) for q in _cross(a, b)] or [a.foot() for a in lines[:1]]
    return [(q.real, q.imag, z) for q in points]


def mean_position(model: Model) -> Floats | None:
    """Average the positions and heights alone, by their weights.

    Parameters
    ----------
    model : Model
        Observations.

    Returns
    -------
    (n,) or None
        Mean, m; None if there is no position among the observations.
    """
    if not any(isinstance(z, Position) for z in model.observations):
        return None
    known = model.linear
    F, f = known.J.T @ known.J, known.J.T @ known.r
    if model.n == 3 and F[2, 2] == 0.0:
        F[2, 2], f[2] = 1.0, _height(model)
    return np.asarray(np.linalg.solve(F, f), dtype=np.float64)


def _height(model: Model) -> float:
    if model.n == 2:
        return 0.0
    heights = [float(z.value) for z in model.observations if isinstance(z, Height)]
    heights += [
        float(np.asarray(z.value)[2])
        for z in model.observations
        if isinstance(z, Position) and np.size(z.value) == 3
    ]
    if heights:
        return heights[0]
    return max((s.beacon[2] for s in model.beacon_equations if s is not None), default=0.0) + _ABOVE_BEACONS


def _lines(model: Model, z: float) -> Iterator[_Line]:
    for i, o in enumerate(model.observations):
        equation = model.beacon_equations[i]
        if equation is None or i in model.in_cone:
            continue
        x_b, y_b, z_b = equation.beacon
        if isinstance(o, Azimuth):
            d = np.array([math.sin(o.value), math.cos(o.value), 0.0])
            if o.axes is not None:
                d = np.asarray(o.axes, dtype=float).T @ d
            yield _Ray(complex(x_b, y_b), complex(d[0], d[1]) / math.hypot(d[0], d[1]))
        elif isinstance(o, Range):
            up = z - z_b if model.n == 3 else 0.0
            yield _Circle(complex(x_b, y_b), math.sqrt(max(o.value**2 - up**2, 0.0)))


def _cross(a: _Line, b: _Line) -> list[complex]:
    if isinstance(a, _Ray) and isinstance(b, _Ray):
        return _ray_ray(a, b)
    if isinstance(a, _Circle) and isinstance(b, _Circle):
        return _circle_circle(a, b)
    if isinstance(a, _Ray) and isinstance(b, _Circle):
        return _ray_circle(a, b)
    assert isinstance(a, _Circle) and isinstance(b, _Ray)
    return _ray_circle(b, a)


def _ray_ray(a: _Ray, b: _Ray) -> list[complex]:
    between = b.beacon - a.beacon
    sine = (a.direction.conjugate() * b.direction).imag
    if between == 0.0 or abs(sine) < 1e-9:
        return []
    t = (between.conjugate() * b.direction).imag / sine
    return [a.beacon + t * a.direction]


def _ray_circle(a: _Ray, b: _Circle) -> list[complex]:
    # centre of the circle in the axes of the ray
    centre = a.direction.conjugate() * (b.beacon - a.beacon)
    along, across = centre.real, centre.imag
    half = math.sqrt(max(b.radius**2 - across**2, 0.0))
    return [a.beacon + t * a.direction for t in {along - half, along + half} if t > 0.0]


def _circle_circle(a: _Circle, b: _Circle) -> list[complex]:
    between = b.beacon - a.beacon
    base = abs(between)
    if base == 0.0:
        return []
    along = (base + (a.radius**2 - b.radius**2) / base) / 2.0
    half = math.sqrt(max(a.radius**2 - along**2, 0.0))
    return [a.beacon + complex(along, side) * between / base for side in {half, -half}]
