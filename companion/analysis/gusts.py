"""Gusts of a recorded flight, from airspeed and GNSS velocity: their amplitude and correlation time.

Along the nose, the velocity through the air less that over ground is minus the wind, the error of the
airspeed's scale, and gusts. In every four minutes wind and scale are fitted and taken out; the autocovariance
of the rest is that of the gusts, except at lag zero, where the noise of GNSS joins it.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from companion.units import Floats

WINDOW_S, LEAST_S, LONGEST_S = 240.0, 480.0, 30.0
ACROSS_S = 1.0  # samples further apart are not neighbours


class Gusts(NamedTuple):
    """One sigma (m/s) along the nose, and correlation time (s)."""

    sigma: float
    correlation_s: float


class GustSamples:
    """Samples of one flight: time, difference of the velocities along the nose, heading."""

    def __init__(self) -> None:
        self._rows: list[tuple[float, float, float]] = []

    def add(self, t_s: float, air: tuple[float, float], ground: tuple[float, float]) -> None:
        """Add a velocity through the air and one over ground, both north and east, m/s.

        A velocity of 0 has no direction: it is left out.
        """
        speed = math.hypot(*air)
        if not speed > 0.0:
            return
        c, s = air[0] / speed, air[1] / speed
        self._rows.append((t_s, speed - c * ground[0] - s * ground[1], math.atan2(s, c)))

    def estimate(self) -> Gusts | None:
        """Return the gusts; None from less than `LEAST_S` of regular samples."""
        if len(self._rows) < 2:
            return None
        rows = np.array(self._rows)
        step = float(np.median(np.diff(rows[:, 0])))
        if not 0.0 < step <= ACROSS_S:
            return None
        per_window, lags = round(WINDOW_S / step), round(LONGEST_S / step)
        # a pause ends a window; in each the samples are as good as equidistant
        breaks = np.flatnonzero(np.diff(rows[:, 0]) > ACROSS_S) + 1
        windows = [
            part[k : k + per_window]
            for part in np.split(rows, breaks)
            for k in range(0, len(part) - per_window + 1, per_window)
        ]
        if len(windows) * WINDOW_S < LEAST_S:
            return None
        covariance = np.mean([_autocovariance(window, lags) for window in windows], axis=0)
        return _exponential(covariance, step)


def _autocovariance(window: Floats, lags: int) -> Floats:
    """Autocovariance (lags + 1,) of what wind and scale leave of a window."""
    _, difference, heading = window.T
    known = np.stack([np.cos(heading), np.sin(heading), np.ones(len(heading))], axis=1)
    rest = difference - known @ np.linalg.lstsq(known, difference, rcond=0.05)[0]
    n = len(rest)
    return np.array([rest[: n - k] @ rest[k:] for k in range(lags + 1)]) / n


def _exponential(covariance: Floats, step: float) -> Gusts | None:
    """Fit sigma^2 exp(-lag / tau) to the first lag after zero and to where a third of it is left."""
    first = float(covariance[1])
    below = np.flatnonzero(covariance[1:] < first / math.e)
    if not first > 0.0 or not len(below):
        return None
    k = int(below[0])  # at least one: the first lag is not below itself
    a, b = float(covariance[k]), float(covariance[k + 1])
    tau = max((k - 1 + (a - first / math.e) / (a - b)) * step, step)
    at_zero = min(first * math.exp(step / tau), float(covariance[0]))
    return Gusts(math.sqrt(at_zero), tau)
