"""The guaranteed bound in flight: whatever fixes come, jumps, silences, and channels that are no INS."""

from __future__ import annotations

import math

import numpy as np
import pytest

from companion.config import Config, InertialConfig
from companion.nav.geometry import Geodetic
from companion.navigator import minimax_bound
from companion.navigator.channel import Nominal
from companion.navigator.inertial_track import Point
from companion.navigator.minimax_bound import Guarantee
from companion.navigator.own_error_model import begin

CONFIG = Config(inertial=InertialConfig(independent=True))
NS = 1_000_000_000
PLACE = Geodetic(math.radians(60.0), 0.5, 100.0)


def nominal(t_s: float, by: str = "ins") -> Nominal:
    point = Point(round(t_s * NS), PLACE, (30.0, 20.0, 0.0))
    return Nominal(point, (0.0, 0.0), point, None if by == "ins" else begin(by, (30.0, 20.0)))  # type: ignore[arg-type]


def flown(seconds: int, sigmas=(2.0,), noise=1.0, by="ins", fixes_until=10**9, g=None, start=0):
    """Fixes each second of each sigma, and the work that follows each record at 2 Hz; also the widenings."""
    rng, widenings, g = np.random.default_rng(1), set(), g or Guarantee()
    for half in range(2 * start, 2 * seconds):
        now = nominal(0.5 * half, by)
        if half % 2 == 0 and half < 2 * fixes_until:
            for sigma in sigmas:
                value = tuple((noise * sigma * rng.standard_normal(2)).tolist())
                g = minimax_bound.add_fix(g, now.t_ns, value, (sigma, sigma))
        g = minimax_bound.follow(g, now, CONFIG)
        g = minimax_bound.refresh(g, now, CONFIG)
        widenings.add(g.widening)
    return g, widenings


def bounds(g: Guarantee, t_s: float) -> minimax_bound.Guaranteed:
    found = minimax_bound.guaranteed(g, round(t_s * NS))
    assert found is not None
    return found


def test_two_fixes_of_one_instant_too_unlike_for_one_bin_both_count() -> None:
    """A near and a far beacon answer at once: what comes besides takes nothing away."""
    both, near = (bounds(flown(120, s)[0], 120.0).restricted for s in ((20.0, 200.0), (20.0,)))
    assert max(np.abs(both.error_n)) < 2.0 * max(both.bound_n)
    assert max(both.bound_n) < 1.05 * max(near.bound_n)


def test_bound_grows_without_fixes_and_shrinks_within_seconds_of_a_return() -> None:
    g, widenings = flown(150)
    fixed = bounds(g, 150.0)
    assert widenings == {1.0}
    assert fixed.bounds.widening == 1.0 and fixed.bounds.gap < 1e-3
    assert fixed.bounds.tilt_n is not None and fixed.bounds.drift_n is not None
    assert max(fixed.bounds.optimum_n) <= max(fixed.restricted.bound_n) < 12.0
    g, _ = flown(300, fixes_until=0, g=g, start=150)
    alone = bounds(g, 300.0)
    assert max(alone.restricted.bound_n) > 5.0 * max(fixed.restricted.bound_n)
    ahead = minimax_bound.ahead(g, CONFIG)
    assert [p.ahead_s for p in ahead] == [60.0, 300.0, 600.0, 1200.0]
    assert all(p.claimed_n[0] < p.bound_n[0] and p.optimum_n[0] <= p.bound_n[0] for p in ahead)
    assert list(ahead) == sorted(ahead, key=lambda p: p.bound_n)
    g, _ = flown(310, g=g, start=300)
    assert max(bounds(g, 310.0).restricted.bound_n) < 0.5 * max(alone.restricted.bound_n)


def test_a_jump_of_the_channel_is_one_of_its_error() -> None:
    g, _ = flown(120)
    before, after = bounds(g, 120.0), bounds(minimax_bound.shift(g, 30.0, -40.0), 120.0)
    for one, other in ((before.restricted, after.restricted), (before.minimax, after.minimax)):
        moved = (one.error_n[0] + 30.0, one.error_n[1] - 40.0)
        np.testing.assert_allclose(other.error_n, moved, atol=1e-9)
        assert other.bound_n == one.bound_n
    again, _ = flown(123, fixes_until=0, g=minimax_bound.shift(g, 30.0, -40.0), start=120)
    np.testing.assert_allclose(bounds(again, 123.0).restricted.error_n, after.restricted.error_n, atol=3.0)


def test_fixes_that_contradict_the_grade_widen_the_bound() -> None:
    stated, _ = flown(150)
    wild, _ = flown(150, noise=30.0)
    assert bounds(wild, 150.0).bounds.widening > 5.0
    assert max(bounds(wild, 150.0).restricted.bound_n) > 5.0 * max(bounds(stated, 150.0).restricted.bound_n)


@pytest.mark.parametrize(
    ("by", "promised"), [("air", True), ("foreign", True), ("imu", False), ("hold", False)]
)
def test_a_channel_that_is_no_ins_has_its_own_law_or_no_bound(by: str, promised: bool) -> None:
    g, _ = flown(160, by=by, fixes_until=100)
    found = minimax_bound.guaranteed(g, 160 * NS)
    assert (found is not None) is promised
    if found is not None:
        assert found.bounds.tilt_n is None  # Schuler's states are none of its own
        wander = minimax_bound.law(CONFIG, by).walk * 60.0**1.5 * 2.0 / 3.0  # type: ignore[union-attr]
        assert wander < max(found.restricted.bound_n) < 10.0 * wander


def test_another_driver_or_a_long_silence_begins_a_new_window() -> None:
    g, _ = flown(60)
    assert minimax_bound.guaranteed(g, 60 * NS) is not None
    for now in (nominal(60.0, "air"), nominal(200.0), nominal(30.0)):
        fresh = minimax_bound.follow(g, now, CONFIG)
        assert minimax_bound.guaranteed(fresh, now.t_ns) is None
