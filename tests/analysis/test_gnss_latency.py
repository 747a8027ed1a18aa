"""GNSS that is late behind the local position is found out, whatever the two do besides; so is a glitch."""

import math
import pathlib

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from companion import records as r
from companion.analysis import gnss_latency
from companion.importers import sources
from companion.nav.geometry import Geodetic, from_enu

TESTS = pathlib.Path(__file__).parents[1]
SHARED = TESTS.parent.parent / "shared" / "data"
Floats = npt.NDArray[np.float64]


def path(t: Floats) -> tuple[Floats, Floats]:
    """A circuit of 25 m/s: north, east and their rates, (n, 2)."""
    turn, R = 0.05 * t, 500.0
    x = np.stack([R * np.sin(turn), R * (1.0 - np.cos(turn))], axis=1)
    return x, 25.0 * np.stack([np.cos(turn), np.sin(turn)], axis=1)


def track(tau: float, sigma: float = 0.3, seed: int = 0, offset: float = 0.0) -> gnss_latency.Track:
    rng = np.random.default_rng(seed)
    t, t_local = np.arange(5.0, 595.0, 0.2), np.arange(0.0, 600.0, 0.1)
    x, v = path(t - tau)
    x_local, v_local = path(t_local)
    noise = sigma * rng.standard_normal(x.shape)
    return gnss_latency.Track(0, t, x + noise + [offset, 0.0], v, t_local, x_local, v_local)


@settings(deadline=None, max_examples=15)
@given(tau=st.floats(-1.0, 1.0), offset=st.floats(-50.0, 50.0), seed=st.integers(0, 99))
def test_a_delay_is_found_behind_noise_and_offset(tau: float, offset: float, seed: int) -> None:
    found = gnss_latency.estimate(track(tau, seed=seed, offset=offset))
    if found is None:  # only where an offset hides what the delay does
        assert abs(offset) > 5.0
    else:
        assert found.seconds == pytest.approx(tau, abs=0.03)
        assert found.sigma < 0.03


def test_without_noise_the_delay_is_exact() -> None:
    found = gnss_latency.estimate(track(0.2, sigma=0.0))
    assert found is not None
    assert found.seconds == pytest.approx(0.2, abs=2e-3)
    assert found.before == pytest.approx(0.2 * 25.0, abs=0.1) and found.after < 0.06


def test_resets_of_the_local_position_do_not_move_it() -> None:
    """Its filter jumps by 40 m three times, as PX4's does."""
    flown = track(0.2)
    for begin in (100.0, 290.0, 420.0):
        flown.x_local[flown.t_local > begin] += [40.0, -25.0]
    found = gnss_latency.estimate(flown)
    assert found is not None and found.seconds == pytest.approx(0.2, abs=0.02)


def test_what_stands_still_has_no_delay_to_show() -> None:
    flown = track(0.2)
    still = flown._replace(x=0.0 * flown.x, x_local=0.0 * flown.x_local, v_local=0.0 * flown.v_local)
    assert gnss_latency.estimate(still) is None


def glitching(velocity: float) -> gnss_latency.Track:
    """GNSS 15 m off for 1.4 s, and saying `velocity` more while it goes there."""
    flown = track(0.1, sigma=0.2)
    off = (flown.t >= 60.0) & (flown.t < 61.5)
    flown.x[off] += [15.0, 0.0]
    flown.v[off] += [velocity, 0.0]
    return flown


def test_a_glitch_is_found_where_it_was() -> None:
    for flown in (glitching(0.0), glitching(-25.0)):
        (glitch,) = gnss_latency.glitches(flown, 0.1)
        assert (glitch.start, glitch.end) == (pytest.approx(60.0, abs=0.01), pytest.approx(61.4, abs=0.01))
        assert glitch.distance == pytest.approx(15.0, abs=1.0)
    assert glitch.speed == pytest.approx(50.0, abs=1.0)
    assert gnss_latency.glitches(track(0.1)) == []


def test_a_local_position_that_leaves_is_no_glitch_of_gnss() -> None:
    flown = track(0.0, sigma=0.2)
    flown.x_local[(flown.t_local > 50.0) & (flown.t_local < 54.0)] += [60.0, 0.0]
    assert gnss_latency.glitches(flown) == []


def test_boots_are_told_apart() -> None:
    """After a reboot another origin holds; each boot has its own track, from its own origin."""
    told: list[r.Stamped] = []
    for boot, alt in ((0, 100.0), (200, 100.0)):
        origin = Geodetic(0.7 + 1e-4 * boot, 0.5, alt)
        zero = boot * 1_000_000_000
        if boot:
            told.append(r.Reboot(zero, zero, 1))
        told.append(r.LocalOrigin(zero, zero, *origin, "tangent"))
        for k in range(600):
            t = zero + 200_000_000 * k
            (x,), (v,) = path(np.array([0.2 * k]))
            told.append(r.LocalPosition(t, t, (*x.tolist(), 0.0), (*v.tolist(), 0.0)))
            ((north, east),), _ = path(np.array([0.2 * k - 0.3]))
            at = from_enu(np.array([east, north, 0.0]), origin)
            told.append(r.Gnss(t, t, 0, t // 1000 + 1, 3, *at))
    found = [gnss_latency.estimate(each) for each in gnss_latency.watch(told)]
    assert len(found) == 2
    for each in found:
        assert each is not None and each.seconds == pytest.approx(0.3, abs=0.02)
    lines = list(gnss_latency.sentences(map(gnss_latency.look, gnss_latency.watch(told))))
    assert len(lines) == 2 and lines[0].startswith("GNSS is 0.30 s")


def test_a_real_fixed_wing_hears_gnss_a_fifth_of_a_second_late() -> None:
    (flown,) = gnss_latency.watch(sources.open_source(TESTS / "data" / "umn_fixed_wing_cut"))
    found = gnss_latency.estimate(flown)
    assert found is not None
    assert found.seconds == pytest.approx(0.2, abs=0.03)
    assert found.before > 3.0 and found.after < 0.5


@pytest.mark.shared
def test_the_whole_real_flight_says_the_same() -> None:
    folder = SHARED / "umn_fixed_wing"
    if not folder.exists():
        pytest.skip("the recordings do not stand beside the repository")
    (flown,) = gnss_latency.watch(sources.open_source(folder))
    found = gnss_latency.estimate(flown)
    assert found is not None and found.pairs > 2400  # 4.9 Hz: each row of the topic is a fix
    assert found.seconds == pytest.approx(0.2, abs=0.01)
    assert found.before == pytest.approx(3.5, abs=0.1) and found.after == pytest.approx(0.72, abs=0.05)
    assert math.isfinite(found.sigma) and gnss_latency.glitches(flown, found.seconds) == []
