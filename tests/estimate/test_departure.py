"""The moment when an INS error leaves its model: false alarms, detection, and the interval round it."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from companion.estimate.departure import departure

T = np.arange(0.0, 3600.0, 6.0)
RATE = 1.2387e-3  # Schuler's
MODEL = np.column_stack((np.ones_like(T), T, np.cos(RATE * T), np.sin(RATE * T)))
SIGMA = 5.0
BREAK = 2004.0


def flown(seed: int, after: Any = 0.0) -> Any:
    """An INS error on the Schuler channel seen by fixes of 5 m; `after` is added from BREAK on."""
    rng = np.random.default_rng(seed)
    z = MODEL @ (300.0 * rng.standard_normal(4) * [1.0, 1e-3, 1.0, 1.0]) + SIGMA * rng.standard_normal(len(T))
    return z + np.where(T >= BREAK, after, 0.0)


@pytest.mark.parametrize("model", [MODEL, None])
def test_false_alarms_are_rarer_than_allowed(model: Any) -> None:
    allowed, runs = 0.1, 100
    alarms = 0
    for seed in range(runs):
        z = flown(seed) if model is not None else SIGMA * np.random.default_rng(seed).standard_normal(len(T))
        alarms += departure(T, z, SIGMA, model, false_alarm=allowed, looks=40) is not None
    assert alarms <= allowed * runs + 3.0 * math.sqrt(allowed * runs)


@pytest.mark.parametrize(
    ("after", "within"), [(40.0, 20.0), (0.3 * (T - BREAK), 250.0), (1e-3 * (T - BREAK) ** 2, 500.0)]
)
def test_the_moment_is_found(after: Any, within: float) -> None:
    runs, held = 40, 0
    for seed in range(runs):
        found = departure(T, flown(seed, after), SIGMA, MODEL)
        assert found is not None
        assert found.noticed >= BREAK
        assert abs(found.t - BREAK) < within
        assert found.earliest <= found.t <= found.latest
        assert found.gain > found.limit
        held += found.earliest <= BREAK <= found.latest
    assert held >= 0.9 * runs


def test_it_is_noticed_sooner_where_it_is_worse() -> None:
    delays = []
    for rate in (0.05, 0.2, 1.0):
        found = departure(T, flown(3, rate * (T - BREAK)), SIGMA, MODEL)
        assert found is not None
        delays.append(found.noticed - BREAK)
    assert delays[0] > delays[1] > delays[2]


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 10**6), st.integers(0, 3), st.integers(10, 60))
def test_the_gain_is_that_of_two_regressions(seed: int, q: int, N: int) -> None:
    """The one departure that is reported gains what least squares with and without it says."""
    rng = np.random.default_rng(seed)
    t = np.sort(rng.uniform(0.0, 9.0, N))
    sigma, model = rng.uniform(0.5, 2.0, N), rng.standard_normal((N, q))
    z = rng.standard_normal(N) + np.where(t > t[N // 2], 60.0, 0.0)
    found = departure(t, z, sigma, model if q else None, terms=2, looks=1)
    assert found is not None
    gains = []
    for moment in t:
        after = np.column_stack((model, t >= moment, np.where(t >= moment, t, 0.0)))
        rss = [0.0, 0.0]
        for k, columns in enumerate((model, after)):
            a = np.linalg.lstsq(columns / sigma[:, None], z / sigma, rcond=None)[0]
            rss[k] = float((((z - columns @ a) / sigma) ** 2).sum())
        gains.append(rss[0] - rss[1])
    assert found.gain == pytest.approx(max(gains), rel=1e-6)
    assert found.t == t[int(np.argmax(gains))]


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"z": [1.0]}, "do not fit"),
        ({"model": np.ones((3, 1))}, "does not fit 600 samples"),
        ({"sigma": -1.0}, "must be positive"),
        ({"z": np.full(len(T), math.nan)}, "not finite"),
        ({"t": T[::-1]}, "the times do not rise"),
        ({"false_alarm": 0.0}, "give a chance"),
        ({"t": T[:3], "z": T[:3]}, "3 samples are too few"),
    ],
)
def test_bad_input_is_one_sentence(change: dict[str, Any], said: str) -> None:
    with pytest.raises(ValueError, match=said):
        departure(**({"t": T, "z": T, "sigma": SIGMA} | change))
