"""The minimax Kalman filter and R1, the restrictive one, beside the bank: a wind bounded in its change.

    X(t+1) = A X(t) + B U(t) + W(t),   |U_i| <= C = q sqrt(3 dt)

U is the change of the wind over one interval; q is `air_data.wind_change_m_s_sqrt_s`. A change even within
its bounds has the variance of a random walk, so the filters differ from one in what they make of the bounds
and in nothing else. X is

    by air data   dx, dy, dVN, dVE: position error and minus the wind
    with an INS   all states of the channel: INS, gyro drift, accelerometer errors, the correctors' (wind)

The interval is fixed, because R1 is not indifferent to it: in one second a beacon's fix shows nothing of U.
So the measurements of ten seconds are averaged, each kind for itself, and taken at their middle. Fixes are
those without the INS, of sources that the bank believes: the filters judge no source. Where nothing is
measured R1's prediction is the minimax filter's.

By air data, on the recorded flights, R1 is as good as one such random walk, and a minute without fixes ends
half as far off again as by a wind that jumps. In a turn it is worse: it has no states for the errors of
airspeed and heading. R1's covariance is conditional on which bounds are active, and overconfident: never a
guarantee.

Source: V. Poddubny, a stochastic-restrictive model of navigation systems, section 2.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from companion.config import AirDataConfig, Config
from companion.estimate import kalman, restrictive
from companion.navigator.channel import Channel, Nominal
from companion.navigator.corrected_ins import CorrectedIns
from companion.navigator.inertial_track import Point
from companion.units import Floats

INTERVAL_NS = 10_000_000_000
EVEN = 1.0 / 3.0  # variance of a change even within its bounds, in units of the bound's square
RESTRICTIVE = "restrictive"
WIND = ("wN", "wE")


class Law(NamedTuple):
    """A, B, C and Q of an interval."""

    A: Floats
    B: Floats
    C: Floats
    Q: Floats


class Mean(NamedTuple):
    """Sums over the measurements of one kind in one interval.

    How many, how many of independent errors, their times from its start (s), values, rows on the state, and
    covariances.
    """

    fixes: int
    independent: int
    time: float
    z: Floats
    H: Floats
    R: Floats


class Filter(NamedTuple):
    """Mean x (n,) and covariance P (n, n) of one filter at the start of the interval."""

    name: str
    x: Floats
    P: Floats


class Parallel(NamedTuple):
    """Filters at the point where the interval starts, and what was measured since: points, sums by kind."""

    start: Point
    filters: tuple[Filter, ...]
    points: tuple[Point, ...] = ()
    means: tuple[tuple[str, Mean], ...] = ()


def names(config: Config) -> tuple[str, ...]:
    """Return the filters that run: `estimator.parallel`, and the restrictive one where it is the output."""
    named = config.estimator.parallel
    leads = config.leading_estimator == RESTRICTIVE and RESTRICTIVE not in named
    return (*named, RESTRICTIVE) if leads else named


def begin(config: Config, channel: Channel, point: Point, x: Floats, P: Floats) -> Parallel:
    """Begin with the error of position and velocity x (4,), P (4, 4); an INS as it is stated."""
    if isinstance(channel, CorrectedIns):
        x, P = np.zeros(channel.n), channel.prior()[0]
    return Parallel(point, tuple(Filter(name, x.copy(), P.copy()) for name in names(config)))


def add(
    p: Parallel,
    point: Point,
    kind: str,
    z: Floats,
    H: Floats,
    R: Floats,
    *,
    white: bool,
    config: Config,
    channel: Channel,
) -> Parallel:
    """Add z = H x + noise of covariance R, measured at `point`; H on the first states.

    `white`: its error has nothing to do with the one before. GNSS drifts: many fixes are worth one.
    """
    if p.points and point.t_ns - p.start.t_ns >= INTERVAL_NS:
        p = _closed(p, config.air_data, channel)
    dt = (point.t_ns - p.start.t_ns) * 1e-9
    if dt <= 0.0:
        return p
    rows = np.zeros((len(z), len(p.filters[0].x)))
    rows[:, : H.shape[1]] = H
    means = dict(p.means)
    if kind in means:
        m = means[kind]
        means[kind] = Mean(m.fixes + 1, m.independent + white, m.time + dt, m.z + z, m.H + rows, m.R + R)
    else:
        means[kind] = Mean(1, 1, dt, z, rows, R)
    return p._replace(points=(*p.points, point), means=tuple(means.items()))


def at(p: Parallel, point: Point, config: Config, channel: Channel) -> list[Filter]:
    """Predict all filters to `point`; measurements of an interval not yet over wait for its end.

    A solution may be a moment older than the fix it began with: then it is what it was then.
    """
    if point.t_ns <= p.start.t_ns:
        return list(p.filters)
    A, B, C, Q = _law(p.start, point, config.air_data, channel)
    noise = kalman.minimax_noise(B, C, Q)
    return [Filter(f.name, *kalman.predict(f.x, f.P, A, noise)) for f in p.filters]


def shift(p: Parallel, north: float, east: float) -> Parallel:
    """After the channel jumped by (north, east) m, so did every error ever measured against it."""
    moved = np.zeros(len(p.filters[0].x))
    moved[:2] = north, east
    filters = tuple(f._replace(x=f.x + moved) for f in p.filters)
    means = tuple((kind, m._replace(z=m.z + m.H @ moved)) for kind, m in p.means)
    return p._replace(filters=filters, means=means)


def _closed(p: Parallel, air: AirDataConfig, channel: Channel) -> Parallel:
    """The interval's measurements as one of each kind, at their middle."""
    count = sum(m.fixes for _, m in p.means)
    middle_s = sum(m.time for _, m in p.means) / count
    middle_ns = p.start.t_ns + round(1e9 * middle_s)
    point = min(p.points, key=lambda q: abs(q.t_ns - middle_ns))._replace(t_ns=middle_ns)
    law = _law(p.start, point, air, channel)
    z, H, R = _stacked([m for _, m in p.means], middle_s)
    return Parallel(point, tuple(_stepped(f, law, z, H, R) for f in p.filters))


def _stacked(means: Sequence[Mean], middle_s: float) -> tuple[Floats, Floats, Floats]:
    """Means as one measurement of the state at the middle; the position error moves with that of velocity."""
    z = np.concatenate([m.z / m.fixes for m in means])
    H = np.vstack([m.H / m.fixes for m in means])
    R = np.zeros((len(z), len(z)))
    k = 0
    for m in means:
        here = slice(k, k + len(m.z))
        H[here, 2:4] += (m.time / m.fixes - middle_s) * H[here, :2]
        R[here, here] = m.R / (m.fixes * m.independent)
        k += len(m.z)
    return z, H, R


def _stepped(f: Filter, law: Law, z: Floats, H: Floats, R: Floats) -> Filter:
    A, B, C, Q = law
    if f.name == RESTRICTIVE:
        found = restrictive.step(f.x, f.P, z, A, B, Q, H, R, C, EVEN)
        return Filter(f.name, found.x, found.P)
    x, P = kalman.predict(f.x, f.P, A, kalman.minimax_noise(B, C, Q))
    updated = kalman.update(x, P, z, H, R)
    return Filter(f.name, updated.x, updated.P)


def _law(start: Point, end: Point, air: AirDataConfig, channel: Channel) -> Law:
    """The error model from one point to another, the wind changing evenly."""
    dt = (end.t_ns - start.t_ns) * 1e-9
    C = np.full(2, air.wind_change_m_s_sqrt_s * np.sqrt(dt / EVEN))
    if isinstance(channel, CorrectedIns):
        A, noise = channel.transition(Nominal(end, (0.0, 0.0), start))
        wind = [channel.names.index(name) for name in WIND]
        Q = noise[0].copy()
        Q[wind, wind] = 0.0
        return Law(A, np.eye(len(A))[:, wind], C, Q)
    A = np.eye(4)
    A[:2, 2:] = dt * np.eye(2)
    B = np.vstack([0.5 * dt * np.eye(2), np.eye(2)])
    gusts = 2.0 * air.gust_m_s**2 * air.gust_s * dt
    return Law(A, B, C, np.diag([gusts, gusts, 0.0, 0.0]))
