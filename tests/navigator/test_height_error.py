"""The height error against GNSS on days that are not standard, and fixes that lie."""

from __future__ import annotations

import math

import numpy as np
import pytest

from companion.nav.geometry import Geodetic
from companion.navigator import height_error
from companion.navigator.height_error import Level
from companion.navigator.inertial_track import Point
from companion.records import Gnss

NS = 1_000_000_000
GATE = 24.0
CORRELATION_S = 60.0


def fix(t: float, alt: float) -> Gnss:
    return Gnss(round(t * NS), round(t * NS), 0, 0, 3, 1.0, 0.5, alt)


def point(t: float, alt: float) -> Point:
    return Point(round(t * NS), Geodetic(1.0, 0.5, alt), (0.0, 0.0, 0.0))


def climbed(
    share: float, hz: float, until: float = math.inf, wrong: dict[int, float] | None = None
) -> list[tuple[float, float]]:
    """Errors of the corrected height and their sigmas, second by second: 300 s level, 2900 m up in 1500 s,
    300 s level. The channel is 20 m too high and `share` of the climb. GNSS errs by a drift of 2 m until it
    ceases at `until`; `wrong` is what it adds at some fixes.
    """
    rng = np.random.default_rng(1)
    level, drift, last, found = Level(), 0.0, -math.inf, []
    for k in range(round(2100 * hz)):
        t = k / hz
        true = 100.0 + 2900.0 * min(max(t - 300.0, 0.0), 1500.0) / 1500.0
        ins = point(t, true + 20.0 + share * (true - 100.0))
        keep = math.exp(-1.0 / hz / CORRELATION_S)
        drift = keep * drift + 2.0 * math.sqrt(1.0 - keep**2) * rng.standard_normal()
        if t < until:
            part = min(t - last, CORRELATION_S) / CORRELATION_S
            reported = true + drift + (wrong or {}).get(k, 0.0)
            level, last = height_error.update(level, fix(t, reported), ins, part, GATE), t
        now = height_error.at(level, ins)
        if k % round(hz) == 0:
            found.append((ins.position.alt - now.error - true, math.sqrt(now.covariance[0])))
    return found


@pytest.mark.parametrize("hz", [1.0, 5.0])
@pytest.mark.parametrize("share", [0.0, 0.08, -0.1])
def test_a_climb_on_a_day_that_is_not_standard(share: float, hz: float) -> None:
    error, sigma = np.array(climbed(share, hz)).T
    assert np.all(np.abs(error[60:]) < 3.0 * sigma[60:])
    assert np.abs(error[60:]).max() < 20.0
    assert np.abs(error[-200:]).max() < 6.0


def test_a_climb_without_gnss_costs_what_is_not_known_of_the_day() -> None:
    """Lost at once it costs 8 % of the climb, one sigma, and says so; lost halfway up, little."""
    error, sigma = np.array(climbed(0.08, 1.0, until=300.0)).T
    assert 100.0 < abs(error[-1]) < 2.0 * sigma[-1]
    error, sigma = np.array(climbed(0.08, 1.0, until=1000.0)).T
    assert abs(error[-1]) < min(3.0 * sigma[-1], 40.0)


def test_one_false_height_is_refused_and_one_that_stays_believed() -> None:
    once = np.array(climbed(0.0, 1.0, wrong={200: 1000.0}))
    none = np.array(climbed(0.0, 1.0))
    assert np.abs(once - none)[:, 0].max() < 0.2
    stays = np.array(climbed(0.0, 1.0, wrong={k: 300.0 for k in range(200, 2100)}))
    assert abs(stays[205, 0]) < 10.0
    assert stays[-1, 0] == pytest.approx(300.0, abs=20.0)
