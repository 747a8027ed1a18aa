"""GNSS delay relative to the local position, and GNSS glitches, are detected."""

import math
import pathlib

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from companion import records as r
from companion.importers import gnss_latency, sources
from companion.nav.geometry import Geodetic, from_enu
from companion.units import Floats

TESTS = pathlib.Path(__file__).parents[1]
SHARED = TESTS.parent.parent / "shared" / "data"


def circle(t: Floats) -> tuple[Floats, Floats]:
    """Return a circle flown at 25 m/s: north, east and their rates, (n, 2)."""
    turn, R = 0.05 * t, 500.0
    x = np.stack([R * np.sin(turn), R * (1.0 - np.cos(turn))], axis=1)
    return x, 25.0 * np.stack([np.cos(turn), np.sin(turn)], axis=1)


def make_track(
    tau: float, sigma: float = 0.3, seed: int = 0, offset: float = 0.0
) -> gnss_latency.GnssLocalTrack:
    rng = np.random.default_rng(seed)
    t, t_local = np.arange(5.0, 595.0, 0.2), np.arange(0.0, 600.0, 0.1)
    x, v = circle(t - tau)
    x_local, v_local = circle(t_local)
    noise = sigma * rng.standard_normal(x.shape)
    return gnss_latency.GnssLocalTrack(0, t, x + noise + [offset, 0.0], v, t_local, x_local, v_local)


@settings(max_examples=15)
@given(tau=st.floats(-1.0, 1.0), offset=st.floats(-50.0, 50.0), seed=st.integers(0, 99))
def test_delay_is_estimated_despite_noise_and_offset(tau: float, offset: float, seed: int) -> None:
    found = gnss_latency.estimate_latency(make_track(tau, seed=seed, offset=offset))
    if found is None:  # only if a large offset masks the delay
        assert abs(offset) > 5.0
    else:
        assert found.seconds == pytest.approx(tau, abs=0.03)
        assert found.sigma < 0.03


def test_delay_is_exact_without_noise() -> None:
    found = gnss_latency.estimate_latency(make_track(0.2, sigma=0.0))
    assert found is not None
    assert found.seconds == pytest.approx(0.2, abs=2e-3)
    assert found.before == pytest.approx(0.2 * 25.0, abs=0.1) and found.after < 0.06


def test_delay_is_unaffected_by_local_position_resets() -> None:
    """The local position jumps three times, as after PX4 filter resets."""
    track = make_track(0.2)
    for begin in (100.0, 290.0, 420.0):
        track.x_local[track.t_local > begin] += [40.0, -25.0]
    found = gnss_latency.estimate_latency(track)
    assert found is not None and found.seconds == pytest.approx(0.2, abs=0.02)


def test_no_delay_is_estimated_at_rest() -> None:
    track = make_track(0.2)
    still = track._replace(x=0.0 * track.x, x_local=0.0 * track.x_local, v_local=0.0 * track.v_local)
    assert gnss_latency.estimate_latency(still) is None


def track_with_glitch(velocity: float) -> gnss_latency.GnssLocalTrack:
    """Return a track with GNSS 15 m off for 1.4 s and `velocity` added to its reported velocity."""
    track = make_track(0.1, sigma=0.2)
    off = (track.t >= 60.0) & (track.t < 61.5)
    track.x[off] += [15.0, 0.0]
    track.v[off] += [velocity, 0.0]
    return track


def test_glitch_is_found_at_its_time() -> None:
    for track in (track_with_glitch(0.0), track_with_glitch(-25.0)):
        (glitch,) = gnss_latency.find_glitches(track, 0.1)
        assert (glitch.start, glitch.end) == (pytest.approx(60.0, abs=0.01), pytest.approx(61.4, abs=0.01))
        assert glitch.distance == pytest.approx(15.0, abs=1.0)
    assert glitch.speed == pytest.approx(50.0, abs=1.0)
    assert gnss_latency.find_glitches(make_track(0.1)) == []


def test_local_position_jump_is_not_a_gnss_glitch() -> None:
    track = make_track(0.0, sigma=0.2)
    track.x_local[(track.t_local > 50.0) & (track.t_local < 54.0)] += [60.0, 0.0]
    assert gnss_latency.find_glitches(track) == []


def test_each_boot_has_its_own_track() -> None:
    """The origin changes at a reboot: each boot has its own track with its own origin."""
    records: list[r.Stamped] = []
    for boot, alt in ((0, 100.0), (200, 100.0)):
        origin = Geodetic(0.7 + 1e-4 * boot, 0.5, alt)
        zero = boot * 1_000_000_000
        if boot:
            records.append(r.Reboot(zero, zero, 1))
        records.append(r.LocalOrigin(zero, zero, *origin, "tangent"))
        for k in range(600):
            t = zero + 200_000_000 * k
            (x,), (v,) = circle(np.array([0.2 * k]))
            records.append(r.LocalPosition(t, t, (*x.tolist(), 0.0), (*v.tolist(), 0.0)))
            ((north, east),), _ = circle(np.array([0.2 * k - 0.3]))
            at = from_enu(np.array([east, north, 0.0]), origin)
            records.append(r.Gnss(t, t, 0, t // 1000 + 1, 3, *at))
    found = [gnss_latency.estimate_latency(each) for each in gnss_latency.collect_tracks(records)]
    assert len(found) == 2
    for each in found:
        assert each is not None and each.seconds == pytest.approx(0.3, abs=0.02)
    lines = list(
        gnss_latency.describe_analyses(map(gnss_latency.analyze_track, gnss_latency.collect_tracks(records)))
    )
    assert len(lines) == 2 and lines[0].startswith("GNSS is 0.30 s")


def test_recorded_fixed_wing_has_a_gnss_delay_of_0_2_s() -> None:
    (track,) = gnss_latency.collect_tracks(sources.open_source(TESTS / "data" / "umn_fixed_wing_cut"))
    found = gnss_latency.estimate_latency(track)
    assert found is not None
    assert found.seconds == pytest.approx(0.2, abs=0.03)
    assert found.before > 3.0 and found.after < 0.5


@pytest.mark.shared
def test_complete_recording_has_the_same_delay() -> None:
    folder = SHARED / "umn_fixed_wing"
    if not folder.exists():
        pytest.skip("the recordings are not available")
    (track,) = gnss_latency.collect_tracks(sources.open_source(folder))
    found = gnss_latency.estimate_latency(track)
    assert found is not None and found.pairs > 2400  # 4.9 Hz: each row of the topic is a fix
    assert found.seconds == pytest.approx(0.2, abs=0.01)
    assert found.before == pytest.approx(3.5, abs=0.1) and found.after == pytest.approx(0.72, abs=0.05)
    assert math.isfinite(found.sigma) and gnss_latency.find_glitches(track, found.seconds) == []
