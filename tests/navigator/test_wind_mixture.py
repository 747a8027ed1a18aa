"""The sum of wind histories: honest whatever the wind does, and better where it keeps."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import pytest

from companion.config import AirDataConfig, GnssConfig
from companion.nav.geometry import Geodetic
from companion.navigator import error_state, wind_error_model, wind_mixture
from companion.navigator.error_state import ErrorState
from companion.navigator.inertial_track import Point
from companion.navigator.wind_mixture import Jumps
from companion.units import Floats

NS = 1_000_000_000
UNIT = wind_error_model.grade(AirDataConfig(), GnssConfig())
H = error_state.beacon_rows(UNIT)
R = np.diag([130.0**2, 100.0**2])  # of one answer of a beacon 60 km away, m^2
V = 25.0, 0.0, 0.0
FIXED, GAP = 200, 60  # s


def ins(t_ns: int) -> Point:
    return Point(t_ns, Geodetic(1.0, 0.5, 100.0), V)


def absorbing(z: Floats) -> Callable[[ErrorState], tuple[ErrorState, float]]:
    """What a fix that is linear does: Kalman's update and its log-likelihood."""

    def absorb(state: ErrorState) -> tuple[ErrorState, float]:
        S = H @ state.P @ H.T + R
        nu = z - H @ state.x
        K = np.linalg.solve(S, H @ state.P).T
        likelihood = -0.5 * (nu @ np.linalg.solve(S, nu) + math.log(np.linalg.det(S)))
        return ErrorState(state.t_ns, state.x + K @ nu, state.P - K @ S @ K.T), float(likelihood)

    return absorb


class Run(NamedTuple):
    """The error of position at the end of the gap (2,) m, what is claimed of it (2, 2), and the same (error
    only) of the Gaussian random walk alone."""

    error: Floats
    P: Floats
    walking: Floats


def flown(wind: Floats, seed: int) -> Run:
    """Fixes for FIXED seconds, none for GAP; `wind` (n, 2) from second to second."""
    rng = np.random.default_rng(seed)
    k, psi = UNIT.sigma0[wind_error_model.SCALE], UNIT.sigma0[wind_error_model.HEADING]
    along = np.array([k * V[0], psi * V[0]]) * rng.standard_normal(2)
    steps = -wind[1:] + along + math.sqrt(UNIT.density[0]) * rng.standard_normal((len(wind) - 1, 2))
    true = np.vstack([np.zeros(2), np.cumsum(steps, axis=0)])
    first = error_state.start(0, UNIT)
    first.P[:2, :2] = np.eye(2)
    first.P[wind_error_model.WIND, wind_error_model.WIND] = np.eye(2)  # learnt before
    first.x[wind_error_model.WIND] = -wind[0]
    jumps, alone = wind_mixture.begin(first), first
    for second in range(1, FIXED + 1):
        absorb = absorbing(true[second] + np.sqrt(np.diag(R)) * rng.standard_normal(2))
        jumps = wind_mixture.learn(wind_mixture.at(jumps, ins(second * NS), (0.0, 0.0), UNIT), absorb)
        alone, _ = absorb(error_state.predict(alone, second * NS, 1.0, V, (0.0, 0.0), UNIT))
    t_ns = (FIXED + GAP) * NS
    end = error_state.predict(wind_mixture.moments(jumps), t_ns, 1.0, V, (0.0, 0.0), UNIT)
    walked = error_state.predict(alone, t_ns, 1.0, V, (0.0, 0.0), UNIT)
    last = true[FIXED + GAP]
    return Run(end.x[:2] - last, end.P[:2, :2], walked.x[:2] - last)


def steady(rng: np.random.Generator) -> Floats:
    return np.broadcast_to([5.0, -3.0], (FIXED + GAP + 1, 2))


def walking(rng: np.random.Generator) -> Floats:
    """As the configuration says on average, but evenly."""
    change = math.sqrt(UNIT.density[2]) * rng.standard_normal((FIXED + GAP, 2))
    return np.cumsum(np.vstack([[5.0, -3.0], change]), axis=0)


def jumping(rng: np.random.Generator) -> Floats:
    """A front 80 s before the gap."""
    direction = rng.uniform(0.0, math.tau)
    wind = np.array(steady(rng))
    wind[FIXED - 80 :] += 7.0 * np.array([math.cos(direction), math.sin(direction)])
    return wind


@pytest.mark.parametrize(("history", "worth"), [(steady, 0.75), (jumping, 1.2), (walking, 1.1)])
def test_honest_in_any_wind_and_better_where_it_keeps(
    history: Callable[[np.random.Generator], Floats], worth: float
) -> None:
    """Over seeds: r.m.s. against that of the random walk alone, and squared errors against their claim."""
    runs = [flown(history(np.random.default_rng(100 + seed)), seed) for seed in range(24)]
    rms = math.sqrt(np.mean([run.error @ run.error for run in runs]))
    of_walk = math.sqrt(np.mean([run.walking @ run.walking for run in runs]))
    misfit = np.mean([run.error @ np.linalg.solve(run.P, run.error) for run in runs]) / 2.0
    assert rms < worth * of_walk
    assert misfit < 1.0
    assert max(run.error @ np.linalg.solve(run.P, run.error) for run in runs) < 18.4  # 1e-4 of chi-square


def some(weights: tuple[float, ...]) -> Jumps:
    rng = np.random.default_rng(7)
    n = wind_error_model.N
    hypotheses = []
    for weight in weights:
        root = rng.standard_normal((n, n))
        hypotheses.append(
            wind_mixture.Hypothesis(weight, ErrorState(0, rng.standard_normal(n), root @ root.T))
        )
    return Jumps(0, tuple(hypotheses))


def test_merging_keeps_the_moments() -> None:
    jumps = some((0.4, 0.2, 0.15, 0.1, 0.1, 0.05))
    few = wind_mixture._few(list(jumps.hypotheses))
    assert len(few) == wind_mixture.KEPT - 1
    whole, merged = wind_mixture.moments(jumps), wind_mixture.moments(Jumps(0, tuple(few)))
    np.testing.assert_allclose(merged.x, whole.x, rtol=1e-12)
    np.testing.assert_allclose(merged.P, whole.P, rtol=1e-12)


def test_where_nothing_is_measured_the_wind_changes_as_configured() -> None:
    """The variance of the sum grows by the mean spectral density, jump by jump."""
    first = error_state.start(0, UNIT)
    jumps = wind_mixture.begin(first)
    for second in range(10, 70, 10):
        jumps = wind_mixture.at(jumps, ins(second * NS), (0.0, 0.0), UNIT)
    grown = wind_mixture.moments(jumps).P.diagonal() - first.P.diagonal()
    np.testing.assert_allclose(
        grown[wind_error_model.WIND], 60.0 * UNIT.density[wind_error_model.WIND], rtol=0.1
    )
    assert sum(h.weight for h in jumps.hypotheses) == pytest.approx(1.0)


def test_a_measurement_weighs_by_bayes_and_drops_the_impossible() -> None:
    jumps = some((0.5, 0.3, 0.2))
    told = {0.5: -1.0, 0.3: 0.0, 0.2: -50.0}
    by_state = {id(h.state): told[h.weight] for h in jumps.hypotheses}
    learnt = wind_mixture.learn(jumps, lambda state: (state, by_state[id(state)]))
    a, b = 0.5 * math.exp(-1.0), 0.3
    weights = [h.weight for h in learnt.hypotheses]
    assert weights == pytest.approx([b / (a + b), a / (a + b)])


def test_what_happens_to_the_channel_happens_under_every_hypothesis() -> None:
    jumps = some((0.6, 0.4))
    moved = wind_mixture.each(jumps, lambda state: error_state.shift(state, 3.0, -4.0))
    assert moved is not None
    whole = error_state.shift(wind_mixture.moments(jumps), 3.0, -4.0)
    np.testing.assert_allclose(wind_mixture.moments(moved).x, whole.x)
    np.testing.assert_allclose(wind_mixture.moments(moved).P, whole.P, atol=1e-9)
    assert wind_mixture.each(None, lambda state: state) is None
