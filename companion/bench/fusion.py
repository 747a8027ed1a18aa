"""Benchmark of maximum-likelihood fixes: that of the navigator, and fixes with three beacons."""

import math
from collections.abc import Callable, Iterator

import numpy as np

from companion.estimate.fusion import Azimuth, Observation, Position, Range, maximum_likelihood


def cases() -> Iterator[tuple[str, Callable[[], object]]]:
    """Yield (name, callable): one call computes one fix."""
    aircraft = np.array([150.0, -90.0, 40.0])
    ins = Position(np.zeros(3), np.diag([4e6, 4e6, 2500.0]))
    gnss = Position(aircraft + np.array([12.0, -9.0, 6.0]), np.diag([100.0, 100.0, 225.0]))
    beacons = ([80e3, 60e3, -900.0], [-120e3, 30e3, -1200.0], [10e3, -150e3, -1500.0])
    pairs: list[Observation] = [z for b in beacons for z in _measurements(np.array(b), aircraft)]
    yield (
        "ml fix: INS, GNSS, azimuth and range of one beacon",
        lambda: maximum_likelihood([ins, gnss, *pairs[:2]]),
    )
    yield "ml fix: INS, azimuth and range of three beacons", lambda: maximum_likelihood([ins, *pairs])
    plane: list[Observation] = [z for b in beacons for z in _measurements(np.array(b[:2]), aircraft[:2])]
    yield "ml fix: three beacons alone, in the plane, no start", lambda: maximum_likelihood(plane)


def _measurements(beacon: np.ndarray, aircraft: np.ndarray) -> tuple[Azimuth, Range]:
    """Return measurements of the beacon with small errors."""
    d = aircraft - beacon
    A, D = math.atan2(d[0], d[1]), float(np.linalg.norm(d))
    axes = np.eye(3) if len(d) == 3 else None
    return Azimuth(beacon, A + 0.002, math.radians(0.25), axes), Range(beacon, D - 120.0, 200.0)
