"""Scatter of a source's own measurements: found where it is misstated, blind to all that is slow."""

import math
from collections.abc import Callable
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from companion.navigator import scatter
from companion.navigator.scatter import UNKNOWN, UNKNOWN_FOR, Scatter
from companion.units import Floats

STEP_NS = 200_000_000


def observed(values: Floats, sigma: float = 1.0, a: float = 0.0) -> list[Scatter]:
    """Scatter after each of the residuals (n, k), stated with `sigma`."""
    found, s = [], None
    for k, r in enumerate(values):
        s = scatter.observe(s, k * STEP_NS, tuple(r), sigma**2, a)
        found.append(s)
    return found


def noise(n: int = 400, seed: int = 1) -> Floats:
    return np.random.default_rng(seed).standard_normal((n, 2))


def test_honest_noise_is_used_nearly_as_stated() -> None:
    used = np.array([s.used for seed in range(20) for s in observed(noise(seed=seed))[UNKNOWN_FOR:]])
    assert used.mean() < 1.1
    assert np.mean(used > 1.5) < 0.02


@given(st.lists(st.floats(0.05, 60.0), min_size=10, max_size=10))
def test_the_first_measurements_are_taken_as_noisy_however_they_are_spaced(intervals: list[float]) -> None:
    s, t_ns, used = None, 0, []
    for dt in intervals:
        t_ns += round(dt * 1e9)
        s = scatter.observe(s, t_ns, (0.0, 0.0), 1.0, 0.0)
        used.append(s.used)
    assert used == [UNKNOWN] * (UNKNOWN_FOR - 1) + [1.0] * (11 - UNKNOWN_FOR)


@pytest.mark.parametrize("times", [2.0, 3.0, 10.0])
def test_noise_greater_than_stated_is_found_within_four_seconds(times: float) -> None:
    found = observed(times * noise())
    assert np.mean([math.sqrt(s.used) for s in found[20:]]) == pytest.approx(times, rel=0.15)


@pytest.mark.parametrize("quiet", [0.03, 0.3])
def test_noise_of_a_source_that_was_quiet_is_found_nearly_as_soon_as_of_an_honest_one(quiet: float) -> None:
    # clipped to six times a mean of 0.001, as a simulated receiver's, it was not found after 30 fixes
    for seed in range(10):
        before, noisy = noise(200, seed), 3.0 * noise(30, 10 + seed)
        soonest = observed(np.concatenate([before, noisy]))[-1].used
        assert observed(np.concatenate([quiet * before, noisy]))[-1].used > 0.6 * soonest


SLOW: dict[str, Callable[[Floats], Floats]] = {
    "offset of a kilometre": lambda t: np.full_like(t, 1000.0),
    "drawn off at 5 m/s": lambda t: 5.0 * np.maximum(t - 30.0, 0.0),
    "drawn off with 0.1 m/s^2": lambda t: 0.05 * t**2,
    "Schuler oscillation of an INS": lambda t: 5000.0 * np.sin(1.24e-3 * t),
    "jump by 300 m": lambda t: 300.0 * (t > 30.0),
}


@pytest.mark.parametrize("lie", SLOW)
def test_a_lie_does_not_make_its_own_noise(lie: str) -> None:
    t = np.arange(400) * STEP_NS * 1e-9
    honest, false = observed(noise()), observed(noise() + SLOW[lie](t)[:, None])
    apart = [abs(a.factor - b.factor) for a, b in zip(honest, false, strict=True)]
    # a jump is in three differences, each clipped; a rate of 5 m/s begins with 1 m in one of them
    assert max(apart) < (0.6 if "jump" in lie else 0.05)
    assert max(s.used for s in false[UNKNOWN_FOR:]) < 2.25


@given(st.floats(1e-3, 1e3), st.floats(0.0, 1e4))
def test_the_unit_does_not_matter(unit: float, offset: float) -> None:
    one = observed(3.0 * noise(60))[-1].factor
    other = observed(unit * (3.0 * noise(60) + offset), sigma=unit)[-1].factor
    assert other == pytest.approx(one, rel=1e-5)


def test_what_the_nominal_trajectory_lacks_is_not_the_sources() -> None:
    """A velocity that is held for a second while the acceleration is 3 m/s^2, and a fix of 0.5 m."""
    rng = np.random.default_rng(1)
    r = np.cumsum(np.cumsum(rng.choice([-3.0, 3.0], (200, 2)), 0), 0) * 0.5 + 0.5 * rng.standard_normal(
        (200, 2)
    )

    def last(a: float) -> float:
        s = None
        for k, one in enumerate(r):
            s = scatter.observe(s, k * 1_000_000_000, tuple(one), 0.25, a)
        assert s is not None
        return s.used

    assert last(3.0) < 1.3
    assert last(0.0) > 2.0


def test_a_silence_and_an_unequal_distance_begin_anew() -> None:
    s = observed(noise(50))[-1]
    later = scatter.observe(s, s.t_ns + 10 * STEP_NS, (1e3, 1e3), 1.0, 0.0)
    assert later.factor == s.factor
    after = scatter.observe(s, s.t_ns + 100 * STEP_NS, (1e3, 1e3), 1.0, 0.0)
    assert (after.factor, after.before) == (s.factor, None)
    assert scatter.observe(s, s.t_ns, (1e3, 1e3), 1.0, 0.0) is s


def test_a_source_is_noisy_once_until_it_is_quiet_again() -> None:
    noisy = [s.noisy for s in observed(np.concatenate([noise(100), 4.0 * noise(100, 2), noise(300, 3)]))]
    assert [b for a, b in pairwise(noisy) if a != b] == [True, False]


@pytest.mark.parametrize("sigma, share", [(0.3, 1.0), (0.1, 0.3), (0.02, 0.06)])
def test_of_a_velocity_that_scatters_less_than_stated_less_is_used_once_that_is_known(
    sigma: float, share: float
) -> None:
    """Stated 0.5 m/s; as much as one and a half times the scatter is used, never more than is stated."""
    found = observed(sigma * noise(), sigma=0.5)
    assert all(s.quiet == 1.0 for s in found[: scatter.LAST - scatter.FIRST])
    assert np.median([s.quiet for s in found[-100:]]) == pytest.approx(share, rel=0.15)


def test_a_velocity_that_becomes_as_noisy_as_stated_is_used_so_within_ten_fixes() -> None:
    found = observed(np.concatenate([0.1 * noise(200), noise(200, 2)]))
    assert found[199].quiet < 0.2
    assert found[210].quiet > 0.5
