"""GNSS against a beacon: the shape of their difference, and the wind, identify the faulty source."""

from __future__ import annotations

import numpy as np
import pytest

from companion.estimate import gnss_beacon_conflict
from companion.estimate.gnss_beacon_conflict import Evidence, Sight, Wind, apart, keep, weigh
from companion.estimate.integrity import threshold

SIGMA_M = 100.0
BIAS = {"range": 50.0, "azimuth": 50.0}  # the azimuth in metres across
WIND = Wind(4.0, 0.0025)
START_S, SECOND = 200, 1_000_000_000


def sights(
    until_s: int, seed: int, *, step: float = 0.0, pull: float = 0.0, blow: float = 0.0
) -> list[Sight]:
    """A beacon in the north, once a second; from START_S on its range is long by `step` m, GNSS is pulled off
    at `pull` m/s northwards, and the wind is another by `blow` m/s.
    """
    rng, out = np.random.default_rng(seed), []
    for t in range(until_s):
        on = float(t >= START_S)
        pulled, moving = on * pull * (t - START_S), on * (pull + blow)
        drift = 0.3 * rng.standard_normal(2) - (moving, 0.0)
        both = (("range", (1.0, 0.0), step * on + pulled), ("azimuth", (0.0, 1.0), 0.0))
        for source, (north, east), off in both:
            residual = (off + 20.0) / SIGMA_M + rng.standard_normal()
            H = (north / SIGMA_M, east / SIGMA_M)
            out.append(Sight(t * SECOND, source, residual, H, 1.0 / SIGMA_M, (drift[0], drift[1])))
    return out


def weighed(until_s: int, seed: int, **lie: float) -> Evidence:
    return weigh(tuple(sights(until_s, seed, **lie)), BIAS, WIND)


@pytest.mark.parametrize("pull, after_s", [(0.5, 240), (2.0, 90), (5.0, 50)])
def test_pull_of_gnss_is_distinguished_from_a_step_of_the_beacon(pull: float, after_s: int) -> None:
    for seed in range(8):
        found = weighed(START_S + after_s, seed, pull=pull)
        assert found.liar(False, 0.0) in ("", None)
        assert found.liar(False, gnss_beacon_conflict.PATIENCE_S) == ""


@pytest.mark.parametrize("step, after_s", [(500.0, 5), (300.0, 14), (200.0, 40)])
def test_step_of_the_beacon_is_distinguished_from_a_pull_despite_a_wind_jump(
    step: float, after_s: int
) -> None:
    for seed in range(8):
        for blow in (0.0, 6.0):
            found = weighed(START_S + after_s, seed, step=step, blow=blow)
            assert found.source == "range"
            assert found.liar(False, 0.0) in ("range", None)
            assert found.moved == pytest.approx(step, rel=0.3)
    assert weighed(START_S + 3 * after_s, 1, step=step).liar(False, 0.0) == "range"


def test_no_source_is_blamed_without_a_fault_in_any_wind() -> None:
    for seed in range(12):
        for blow in (0.0, 8.0):
            assert weighed(START_S + 30 + 20 * seed, seed, blow=blow).liar(False, 1e9) is None


def test_small_step_does_not_exclude_a_beacon_and_doubt_is_limited() -> None:
    """The error by a stepped beacon is limited, that by a spoofer is not."""
    assert Evidence(20.0, 40.0, "range", 80.0).liar(False, 0.0) == ""
    assert Evidence(20.0, 40.0, "range", 80.0).liar(True, 0.0) == "range"
    doubt = Evidence(30.0, 35.0, "range", 200.0)
    assert doubt.liar(False, 0.0) is None
    assert doubt.liar(False, gnss_beacon_conflict.PATIENCE_S) == ""
    assert Evidence(35.0, 30.0, "range", 200.0).liar(True, 0.0) == "range"


def test_gap_and_short_record_are_handled() -> None:
    whole = sights(START_S + 50, 3, pull=5.0)
    gap = tuple(s for s in whole if not 60 <= s.t_ns // SECOND < START_S - 10)
    assert weigh(gap, BIAS, WIND).liar(False, 0.0) == ""
    assert weigh(tuple(whole[:4]), BIAS, WIND).liar(False, 0.0) is None


def test_old_sights_are_dropped() -> None:
    kept: tuple[Sight, ...] = ()
    for s in sights(700, 1):
        kept = keep(kept, s)
    assert (kept[-1].t_ns - kept[0].t_ns) == gnss_beacon_conflict.WINDOW_NS


def test_difference_of_an_excluded_gnss_is_measured() -> None:
    x, P, names = np.array([20.0, 20.0]), np.diag([8.0**2, 8.0**2]), tuple(BIAS)
    limit = threshold(1e-3)
    honest = [apart(tuple(sights(60, seed)), x, P, names) for seed in range(200)]
    assert np.mean(honest) == pytest.approx(2.0, rel=0.25)  # chi-square of two
    assert sum(value > limit for value in honest) <= 2
    for seed in range(8):
        held = tuple(s._replace(residual=s.residual + 150.0 * s.H[0]) for s in sights(60, seed))
        assert apart(held, x, P, names) > limit
