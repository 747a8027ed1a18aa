"""Wind mostly stays as it is, and now and then it jumps: the error of dead reckoning as a sum of Gaussians.

A random walk must choose between following a front and averaging beacons for minutes; wind does either at its
time. So a few error states go side by side, each of its own history: in one the wind never jumped, in others
it did at some moment. Every ten seconds one more is born of the likeliest, in which it has jumped just now;
fixes weigh them (Bayes), and the unlikely are dropped or merged. The rate of jumps is such that on average
the wind changes as `winderror` says, and where nothing is measured it is that.

Source: Alspach, Sorenson, Nonlinear Bayesian estimation using Gaussian sum approximations, IEEE Trans. AC-17
(1972), 439-448. The moments of the sum are the error state that everybody else sees.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from companion.navigator import error_state
from companion.navigator.error_state import ErrorState
from companion.navigator.inertial_track import Point
from companion.navigator.wind_error_model import WIND, WindError
from companion.records import Vector2

BORN_NS = 10_000_000_000  # how often the wind is supposed to have jumped
CALM = 1.0 / 16.0  # of the wind's mean spectral density between jumps
KEPT = 6  # hypotheses
LEAST = 1e-4  # weight below which one is dropped


class Hypothesis(NamedTuple):
    """One history of the wind: how likely, and the error state under it."""

    weight: float
    state: ErrorState


class Jumps(NamedTuple):
    """The hypotheses, the likeliest first, weights of sum 1; and when one was last born."""

    born_ns: int
    hypotheses: tuple[Hypothesis, ...]


def begin(state: ErrorState) -> Jumps:
    """One hypothesis: this state."""
    return Jumps(state.t_ns, (Hypothesis(1.0, state),))


def at(jumps: Jumps, ins: Point, a_n: Vector2, unit: WindError) -> Jumps:
    """The hypotheses at the time of `ins`, the channel flying at its velocity, with acceleration `a_n`."""

    def carried(state: ErrorState, density: float) -> ErrorState:
        spectral = unit.density.copy()
        spectral[WIND] = density
        moving = unit._replace(density=spectral)
        return error_state.predict(state, ins.t_ns, ins.position.lat, ins.v_n, a_n, moving)

    mean, t_ns = float(unit.density[WIND].mean()), ins.t_ns
    old = [Hypothesis(h.weight, carried(h.state, CALM * mean)) for h in jumps.hypotheses]
    parent = jumps.hypotheses[0].state
    if t_ns - jumps.born_ns < BORN_NS or t_ns <= parent.t_ns:
        return Jumps(jumps.born_ns, tuple(old))
    jump = unit.jump**2
    rate = (1.0 - CALM) * mean / jump  # of jumps, 1/s: together with the calm they have the mean density
    born = 1.0 - math.exp(-rate * (t_ns - jumps.born_ns) * 1e-9)
    child = carried(parent, jump / ((t_ns - parent.t_ns) * 1e-9))
    old = [h._replace(weight=h.weight * (1.0 - born)) for h in old]
    return Jumps(t_ns, (*_few(old), Hypothesis(born, child)))


def learn(jumps: Jumps, absorb: Callable[[ErrorState], tuple[ErrorState, float]]) -> Jumps:
    """Each hypothesis with one more measurement, which tells the state after it and its log-likelihood."""
    found = [(math.log(h.weight), *absorb(h.state)) for h in jumps.hypotheses]
    best = max(prior + likelihood for prior, _, likelihood in found)
    weights = [math.exp(prior + likelihood - best) for prior, _, likelihood in found]
    whole = sum(weights)
    new = [Hypothesis(w / whole, state) for w, (_, state, _) in zip(weights, found, strict=True)]
    kept = [h for h in new if h.weight >= LEAST]
    whole = sum(h.weight for h in kept)
    kept = [h._replace(weight=h.weight / whole) for h in kept]
    return jumps._replace(hypotheses=tuple(sorted(kept, key=lambda h: -h.weight)))


def each(jumps: Jumps | None, change: Callable[[ErrorState], ErrorState]) -> Jumps | None:
    """What happens to the channel happens under every hypothesis."""
    if jumps is None:
        return None
    changed = tuple(Hypothesis(h.weight, change(h.state)) for h in jumps.hypotheses)
    return jumps._replace(hypotheses=changed)


def moments(jumps: Jumps) -> ErrorState:
    """Mean and covariance of the sum."""
    return _merged(jumps.hypotheses).state


def _few(hypotheses: list[Hypothesis]) -> list[Hypothesis]:
    """The least likely merged into the likeliest until one more has room."""
    while len(hypotheses) >= KEPT:
        hypotheses = [_merged((hypotheses[0], hypotheses[-1])), *hypotheses[1:-1]]
    return hypotheses


def _merged(hypotheses: tuple[Hypothesis, ...]) -> Hypothesis:
    whole = sum(h.weight for h in hypotheses)
    first = hypotheses[0].state
    x, P = np.zeros_like(first.x), np.zeros_like(first.P)
    for h in hypotheses:
        x += h.weight / whole * h.state.x
    for h in hypotheses:
        d = h.state.x - x
        P += h.weight / whole * (h.state.P + np.outer(d, d))
    return Hypothesis(whole, ErrorState(first.t_ns, x, P))
