"""Gusts found in a flight are those that were there, whatever wind, scale and turns lie over them."""

from __future__ import annotations

import math

import numpy as np
import pytest

from companion.analysis.gusts import GustSamples


def flight(
    sigma: float, correlation_s: float, hz: float = 5.0, seconds: float = 1800.0, pause_s: float = 0.0
) -> GustSamples:
    """A flight with turns, a wandering wind of 6 m/s, an airspeed 3 % high, and GNSS noise of 0.1 m/s."""
    rng = np.random.default_rng(3)
    n, keep = round(seconds * hz), math.exp(-1.0 / (hz * correlation_s))
    wind = np.array([4.0, -5.0]) + np.cumsum(0.05 / math.sqrt(hz) * rng.standard_normal((n, 2)), axis=0)
    found, gust, heading = GustSamples(), 0.0, 0.5
    for k in range(n):
        t = k / hz
        gust = keep * gust + sigma * math.sqrt(1.0 - keep * keep) * float(rng.standard_normal())
        heading += math.radians(3.0) / hz * (t % 200.0 < 30.0)
        nose = np.array([math.cos(heading), math.sin(heading)])
        air, noise = (38.0 * 1.03 + gust) * nose, 0.1 * rng.standard_normal(2)
        ground = 38.0 * nose + wind[k] + noise
        late = t + pause_s * (t > 0.5 * seconds)
        found.add(late, (float(air[0]), float(air[1])), (float(ground[0]), float(ground[1])))
    return found


@pytest.mark.parametrize(
    ("sigma", "correlation_s", "hz"), [(1.2, 0.7, 5.0), (1.0, 2.0, 5.0), (1.2, 8.0, 2.0)]
)
def test_gusts_are_found(sigma: float, correlation_s: float, hz: float) -> None:
    found = flight(sigma, correlation_s, hz).estimate()
    assert found is not None
    assert found.sigma == pytest.approx(sigma, rel=0.2)
    assert found.correlation_s == pytest.approx(correlation_s, rel=0.35)


def test_short_or_sparse_flights_show_none() -> None:
    assert GustSamples().estimate() is None
    assert flight(1.0, 2.0, seconds=300.0).estimate() is None
    assert flight(1.0, 2.0, hz=0.5).estimate() is None


def test_pause_does_not_join_what_is_apart() -> None:
    whole, apart = flight(1.2, 2.0).estimate(), flight(1.2, 2.0, pause_s=500.0).estimate()
    assert whole is not None
    assert apart is not None
    assert apart.correlation_s == pytest.approx(whole.correlation_s, rel=0.15)


def test_airspeed_of_zero_is_left_out() -> None:
    """A parked aircraft: an airspeed of exactly 0 ended the report of its recording."""
    found, same = flight(1.2, 0.7), flight(1.2, 0.7)
    found.add(2000.0, (0.0, 0.0), (0.1, 0.0))
    assert found.estimate() == same.estimate() is not None
