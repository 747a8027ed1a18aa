"""The face of every inertial channel: a nominal trajectory and a linear model of its errors.

A channel integrates a nominal trajectory from what the autopilot sends. Its error, nominal minus truth, is
what the bank of hypotheses estimates. Position errors north and east (m) are states 0 and 1, velocity
errors (m/s) states 2 and 3; drift, latency and lever arm of GNSS are states too. A transition covers the
time since the bank was last propagated and serves all rows; the process noise has one layer for each grade.
"""

from __future__ import annotations

import math
from typing import NamedTuple, Protocol

import numpy as np
from msgspec import Struct

from companion.nav.geometry import Geodetic, displace
from companion.navigator.inertial_track import Point
from companion.navigator.own_error_model import Interval
from companion.records import Vector2
from companion.units import Floats

DOPPLER_S = 600.0  # s; correlation of the lasting part of the velocity error of GNSS
STEP_S = 2.0  # the transition is a power series: its fifth term is below 1e-12 of the first here


class Transition(NamedTuple):
    """x <- Phi x, P <- Phi P Phi' + Q[grade]; Phi (n, n), Q (grades, n, n)."""

    Phi: Floats
    Q: Floats


class Nominal(Struct, frozen=True):
    """Nominal trajectory at `point`, with horizontal acceleration `a_n` (m/s^2).

    `since` is where the bank stands; `interval` sums what the error model of the own channel needs of the
    time in between.
    """

    point: Point
    a_n: Vector2
    since: Point
    interval: Interval | None = None

    @property
    def t_ns(self) -> int:
        """Time of the nominal point."""
        return self.point.t_ns

    @property
    def driver(self) -> str:
        """What moves it: a driver of the own channel, or "ins"."""
        return "ins" if self.interval is None else self.interval.by

    @property
    def pending_s(self) -> float:
        """Seconds since the bank was propagated."""
        return (self.point.t_ns - self.since.t_ns) * 1e-9


class Channel(Protocol):
    """Error model of one kind of channel."""

    @property
    def n(self) -> int:
        """Number of states, those of GNSS included."""

    @property
    def drift(self) -> slice:
        """The two states of GNSS drift."""

    @property
    def doppler(self) -> slice:
        """The two states of the lasting error of the GNSS velocity."""

    @property
    def latency(self) -> int:
        """The state of GNSS latency."""

    @property
    def arm(self) -> int | None:
        """The state of the antenna's lever arm along the fuselage; None where it is far below the noise."""

    @property
    def grades(self) -> tuple[float, ...]:
        """Prior weights of the grades, finest first."""

    @property
    def velocity_noise(self) -> float:
        """White noise of the nominal velocity that is no state, m/s."""

    @property
    def wind(self) -> tuple[int, ...]:
        """States that jump with the wind; empty where the wind is no state."""

    def prior(self) -> Floats:
        """First covariances (grades, n, n); the means are zero."""

    def transition(self, nominal: Nominal) -> Transition:
        """Phi and Q from `nominal.since` to `nominal.point`."""


def moved(point: Point, v_n: tuple[float, float], t_ns: int) -> Point:
    """Carry a point on to `t_ns` with the mean of its own velocity and `v_n`, which it then has."""
    dt = (t_ns - point.t_ns) * 1e-9
    north, east = 0.5 * (point.v_n[0] + v_n[0]) * dt, 0.5 * (point.v_n[1] + v_n[1]) * dt
    place = displace(*point.position, north, east, 0.0)
    return Point(t_ns, Geodetic(place.lat, place.lon, point.position.alt), (*v_n, point.v_n[2]))


def discretise(A: Floats, Q: Floats, dt: float) -> Transition:
    """Discretise x' = A x + w over `dt` seconds: Phi (n, n), and Q (grades, n, n) from densities alike."""
    doublings = max(0, math.ceil(math.log2(dt / STEP_S))) if dt > 0.0 else 0
    step = dt / 2**doublings
    M = A * step
    M2 = M @ M
    Phi = np.eye(len(M)) + M + M2 / 2.0 + (M2 @ M) / 6.0 + (M2 @ M2) / 24.0
    # trapezoid of the process noise: second order in the step, which is short against every mode
    Q = 0.5 * step * (Q + Phi @ Q @ Phi.T)
    for _ in range(doublings):  # a silence of hours costs a dozen steps
        Phi, Q = Phi @ Phi, Phi @ Q @ Phi.T + Q
    return Transition(Phi, Q)
