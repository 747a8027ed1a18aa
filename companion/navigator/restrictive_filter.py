"""The restrictive estimate of dead reckoning's error: the wind not random, only bounded in its change.

    X = (dx, dy, dVN, dVE),   X(t+1) = A X(t) + B U(t) + W(t),   |U_i| <= C = q sqrt(3 dt)

U is the change of the wind over one interval and W the gusts; q is `air_data.wind_change_m_s_sqrt_s`. A
change even within its bounds has the variance of a random walk, so the two differ in what
they make of the bounds and in nothing else. The interval is fixed, because the filter is not indifferent to
it: in one second a beacon's fix shows nothing of U. So fixes are averaged over ten seconds; where nothing is
measured the prediction is the minimax filter's.

On the recorded flights it is as good as one such random walk, and a minute without fixes ends half as far
off again as by a wind that jumps. In a turn it is worse: it has no states for the errors of
airspeed and heading, which the error state learns there.

The covariance is conditional on which bounds are active, and overconfident: never a guarantee.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from companion.config import AirDataConfig
from companion.estimate import kalman, restrictive
from companion.units import Floats

INTERVAL_NS = 10_000_000_000
EVEN = 1.0 / 3.0  # variance of a change even within its bounds, in units of the bound's square
POSITION = np.eye(2, 4)


class Bin(NamedTuple):
    """Sums over the fixes of one interval: how many, how many of independent errors, their times from its
    start (s), values and covariances.
    """

    fixes: int = 0
    independent: int = 0
    time: float = 0.0
    value: Floats = np.zeros(2)
    covariance: Floats = np.zeros((2, 2))


class Restrictive(NamedTuple):
    """Mean x (4,) and covariance P (4, 4) at `t_ns`, and the fixes since."""

    t_ns: int
    x: Floats
    P: Floats
    since: Bin = Bin()


def begin(t_ns: int, x: Floats, P: Floats) -> Restrictive:
    """Begin with the error of position and velocity x (4,), P (4, 4); the latter is minus the wind."""
    return Restrictive(t_ns, x.copy(), P.copy())


def update(
    r: Restrictive, t_ns: int, value: Floats, covariance: Floats, white: bool, settings: AirDataConfig
) -> Restrictive:
    """With one more fix: channel minus fix (2,), m north and east, and its covariance.

    `white`: its error has nothing to do with the one before. GNSS drifts: many fixes are worth one.
    """
    if r.since.fixes and t_ns - r.t_ns >= INTERVAL_NS:
        r = _closed(r, settings)
    since, dt = r.since, (t_ns - r.t_ns) * 1e-9
    if dt <= 0.0:
        return r
    fixes, independent = since.fixes + 1, since.independent + (white or not since.fixes)
    since = Bin(fixes, independent, since.time + dt, since.value + value, since.covariance + covariance)
    return r._replace(since=since)


def at(r: Restrictive, t_ns: int, settings: AirDataConfig) -> kalman.Prediction:
    """The error (4,) and its covariance at `t_ns`; fixes of an interval not yet over wait for its end.

    A solution may be a moment older than the fix it began with: then it is what it was then.
    """
    A, B, C, Q = _interval(max(t_ns - r.t_ns, 0) * 1e-9, settings)
    return kalman.predict(r.x, r.P, A, kalman.minimax_noise(B, C, Q))


def shift(r: Restrictive, north: float, east: float) -> Restrictive:
    """After the channel jumped by (north, east) m, so did every error ever measured against it."""
    since = r.since._replace(value=r.since.value + r.since.fixes * np.array([north, east]))
    return r._replace(x=r.x + np.array([north, east, 0.0, 0.0]), since=since)


def _closed(r: Restrictive, settings: AirDataConfig) -> Restrictive:
    """The interval's fixes as one, at their middle."""
    n = r.since.fixes
    dt = r.since.time / n
    A, B, C, Q = _interval(dt, settings)
    R = r.since.covariance / (n * r.since.independent)
    now = restrictive.step(r.x, r.P, r.since.value / n, A, B, Q, POSITION, R, C, EVEN)
    return Restrictive(r.t_ns + round(1e9 * dt), now.x, now.P)


def _interval(dt: float, settings: AirDataConfig) -> tuple[Floats, Floats, Floats, Floats]:
    """A, B, C and Q of an interval of dt seconds, the wind changing evenly."""
    A = np.eye(4)
    A[:2, 2:] = dt * np.eye(2)
    B = np.vstack([0.5 * dt * np.eye(2), np.eye(2)])
    gusts = 2.0 * settings.gust_m_s**2 * settings.gust_s * dt
    Q = np.diag([gusts, gusts, 0.0, 0.0])
    C = np.full(2, settings.wind_change_m_s_sqrt_s * np.sqrt(dt / EVEN))
    return A, B, C, Q
