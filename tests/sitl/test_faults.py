import math
from itertools import pairwise

import numpy as np
import pytest

from companion.link import dialect, frame
from companion.nav.geometry import Geodetic, separation
from companion.records import AirData, Attitude, Gnss, LocalPosition, RsbnFix
from sitl.faults import (
    AUTOPILOT_FAULTS,
    CONSUMER_FAULTS,
    LINK_FAULTS,
    NAMES,
    RECORD_FAULTS,
    Fault,
    TimedBytes,
    apply_link_faults,
    apply_record_faults,
)

S = 1_000_000_000
RNG = np.random.default_rng


def stream_of(kind, count=60):
    def one(k):
        t = k * S
        if kind is Gnss:
            fix = {"lat": 1.0, "lon": 0.5, "alt_msl": 100.0 + k, "v_n": (0.0, 30.0, 0.0), "satellites": 12}
            return Gnss(t, t, 0, t // 1000, 3, **fix)
        if kind is RsbnFix:
            return RsbnFix(t, t, k % 2, 1.0, 0.5, 60.0 + 1e-3 * k, 3.0, 50e3, 0.002, 107.5)
        if kind is LocalPosition:
            return LocalPosition(t, t, (10.0 * k, 0.0, -100.0), (10.0, 0.0, 0.0))
        if kind is Attitude:
            return Attitude(t, t, 0.0, 0.0, 6.25)
        return AirData(t, t, 38.0 + 0.1 * k)

    return [one(k) for k in range(count)]


def apply_fault(name, size=None, **order):
    kind = RECORD_FAULTS[name].kind
    before = stream_of(kind)
    after = apply_record_faults(kind, before, (Fault(name, 20.0, 40.0, size, **order),), RNG(1))
    return before, after


def east_of(fix, origin):
    return (fix.lon - origin.lon) * 6.39e6 * math.cos(origin.lat)


@pytest.mark.parametrize("name", RECORD_FAULTS)
def test_fault_changes_only_its_window_reproducibly(name):
    before, after = apply_fault(name)
    outside = [r for r in before if not 20 * S <= r.t_ns < 40 * S]
    assert [r for r in after if not 20 * S <= r.t_ns < 40 * S] == outside
    assert [r for r in after if 20 * S <= r.t_ns < 40 * S] != before[20:40]
    assert repr(apply_fault(name)[1]) == repr(after)


def test_gnss_jump_and_spoof():
    before, after = apply_fault("gnss-jump", 500.0)
    assert math.hypot((after[30].lat - 1.0) * 6.37e6, east_of(after[30], before[30])) == pytest.approx(
        500, rel=5e-3
    )
    before, after = apply_fault("gnss-spoof", 2.0)
    assert [east_of(after[k], before[k]) for k in (20, 25, 39)] == pytest.approx([0.0, 10.0, 38.0], rel=5e-3)
    assert after[30].v_n == (0.0, 32.0, 0.0)


def test_gnss_velocity_is_off_by_a_share():
    before, after = apply_fault("gnss-velocity", -0.003)
    assert after[30].v_n == pytest.approx([0.997 * v for v in before[30].v_n[:2]] + [before[30].v_n[2]])
    assert (after[30].lat, after[30].lon) == (before[30].lat, before[30].lon)


def test_gnss_lever_arm_of_a_fix_that_comes_twice():
    """The antenna's velocity was 0/0 there."""
    before = [fix for fix in stream_of(Gnss) for _ in range(2)]
    after = apply_record_faults(Gnss, before, (Fault("gnss-lever-arm", 20.0, 40.0, 5.0),), RNG(1))
    assert np.array([r.v_n for r in after]) == pytest.approx(np.array([b.v_n for b in before]), abs=1e-9)
    assert [east_of(r, b) for r, b in zip(after[40:80], before[40:80])] == pytest.approx([5.0] * 40, rel=5e-3)


def test_gnss_jam_and_frozen_fix():
    _, after = apply_fault("gnss-jam")
    assert {r.fix for r in after[20:40]} == {1}
    _, after = apply_fault("gnss-frozen")
    assert all(r.repeats(after[19]) for r in after[20:40])
    assert not after[40].repeats(after[19])
    _, after = apply_fault("gnss-stale")
    assert {r.alt_msl for r in after[20:40]} == {after[19].alt_msl}
    assert not any(b.repeats(a) for a, b in pairwise(after))  # the stamps advance


def test_beacon_bias_north_and_position_faults():
    _, after = apply_fault("beacon-bias", 700.0, beacon=1)
    assert {(r.beacon, r.slant_range) for r in after[20:40]} == {(0, 50e3), (1, 50.7e3)}
    _, after = apply_fault("beacon-north", 0.05)
    assert after[25].azimuth == pytest.approx(3.05)
    _, after = apply_fault("beacon-position", 3000.0)
    assert (after[25].lat - 1.0) * 6.385e6 == pytest.approx(3000.0, rel=5e-3)


def test_each_beacon_is_stated_at_a_wrong_place_of_its_own():
    """The same from answer to answer; each scale of distance as often as another."""
    away = []
    for seed in range(200):
        order = Fault("beacon-anywhere", 20.0, 40.0)
        after = apply_record_faults(RsbnFix, stream_of(RsbnFix), (order,), RNG(seed))[20:40]
        places = {(r.beacon, round(r.lat, 7), round(r.lon, 7)) for r in after}
        assert len(places) == 2
        for _, *there in places:
            north, east, _ = separation(Geodetic(1.0, 0.5, 0.0), Geodetic(*there, 0.0))
            away.append(math.hypot(north, east))
    assert min(away) >= 1000.0 and max(away) <= 161e3
    assert np.quantile(away, [0.25, 0.5, 0.75]) == pytest.approx(
        1000.0 * 160.0 ** np.array([0.25, 0.5, 0.75]), rel=0.3
    )


def test_multipath_lengthens_some_ranges():
    _, after = apply_fault("beacon-multipath", 1500.0)
    ranges = np.array([r.slant_range for r in after[20:40]])
    assert ranges.min() == 50e3 < ranges.max()
    assert 1 <= np.count_nonzero(ranges > 50e3) <= 15


def test_drop_out_and_delay():
    _, after = apply_fault("beacon-drop-out", 1.0)
    assert len(after) == 40
    for name in ("gnss-late", "beacon-late"):
        _, after = apply_fault(name, 5.0)
        assert {r.rx_ns - r.t_ns for r in after if 20 * S <= r.t_ns < 40 * S} == {5 * S}
        assert [r.rx_ns for r in after] == sorted(r.rx_ns for r in after)


def test_ins_reset_and_nan():
    before, after = apply_fault("ins-reset", 200.0)
    assert math.dist(before[30].x_n, after[30].x_n) == pytest.approx(200.0)
    _, after = apply_fault("ins-nan")
    assert all(map(math.isnan, after[30].x_n + after[30].v_n))


def test_accelerating_spoofer_and_false_fix_after_an_outage():
    before, after = apply_fault("gnss-accelerate", 0.1)
    assert east_of(after[30], before[30]) == pytest.approx(0.5 * 0.1 * 10.0**2, rel=1e-3)
    assert after[30].v_n[1] == pytest.approx(before[30].v_n[1] + 1.0)
    before = stream_of(Gnss, 200)
    after = apply_record_faults(Gnss, before, (Fault("gnss-return", 20.0, size=450.0),), RNG(1))
    assert not any(fix.has_3d_fix for fix in after[20:80])
    assert all(fix.has_3d_fix for fix in after[80:])
    assert east_of(after[80], before[80]) == pytest.approx(450.0 * math.sqrt(0.5), rel=1e-3)


def test_latency_moves_stamp_and_arrival():
    before, after = apply_fault("gnss-latency", 0.3)
    assert {a.t_ns - b.t_ns for a, b in zip(after[20:39], before[20:39])} == {3 * S // 10}
    assert all(a.rx_ns == a.t_ns and a.lat == b.lat for a, b in zip(after, before, strict=True))
    assert {a.stamp_us - a.t_ns // 1000 for a in after} == {0}
    _, after = apply_fault("gnss-latency", 1.5)
    assert [fix.rx_ns for fix in after] == sorted(fix.rx_ns for fix in after)


def test_pitot_and_heading():
    before, after = apply_fault("pitot-stuck", 8.0)
    assert {air.airspeed for air in after[20:40]} == {8.0}
    before, after = apply_fault("pitot-scale", 1.5)
    assert after[30].airspeed == pytest.approx(1.5 * before[30].airspeed)
    before, after = apply_fault("heading-off", 0.1)
    assert after[30].heading == pytest.approx(before[30].heading + 0.1 - math.tau)


def test_ins_drift_has_a_consistent_velocity():
    before, after = apply_fault("ins-drift", 2.0)
    assert before[30].x_n[0] - after[30].x_n[0] == pytest.approx(20.0)
    assert before[30].v_n[0] - after[30].v_n[0] == pytest.approx(2.0)


def test_airspeed_icing_freezing_and_wind_shear():
    before, after = apply_fault("airspeed-icing", 0.6)
    assert after[30].airspeed == pytest.approx(before[30].airspeed * 0.9)
    _, after = apply_fault("airspeed-frozen")
    assert {r.airspeed for r in after[20:40]} == {after[19].airspeed}
    assert after[30].t_ns == 30 * S
    before, after = apply_fault("wind-shear", 8.0)
    assert after[30].airspeed == before[30].airspeed + 8.0


def frames(count=400):
    messages = (dialect.new("ATTITUDE", time_boot_ms=k, roll=0.1, yaw=1.0) for k in range(1, count + 1))
    return [TimedBytes(k * 20_000_000, frame.encode(m, k & 0xFF, 1, 1)) for k, m in enumerate(messages)]


def apply_link_fault(name, size=None):
    out = []
    rng = RNG(5)
    for chunk in frames():
        out += apply_link_faults([chunk], chunk.due_ns, (Fault(name, 0.0, 1e9, size),), rng)
    return sorted(out, key=lambda chunk: chunk.due_ns)


def parse_frames(chunks):
    reader = frame.Reader()
    events = [event for chunk in chunks for event in reader.receive(chunk.data)] + reader.close()
    return [event for event in events if isinstance(event, frame.Frame)], events


@pytest.mark.parametrize("name", LINK_FAULTS)
def test_link_faults_change_only_their_window_reproducibly(name):
    quiet = (Fault(name, 5.0, 6.0),)
    assert apply_link_faults(frames(2), 4 * S, quiet, RNG(1)) == frames(2)
    assert apply_link_fault(name) == apply_link_fault(name)


def test_link_loss_duplicates_delay_and_reordering():
    assert apply_link_fault("link-loss") == []
    assert len(apply_link_fault("link-loss", 0.25)) == pytest.approx(300, abs=30)
    assert len(apply_link_fault("duplicates", 0.1)) == pytest.approx(440, abs=25)
    assert [c.due_ns for c in apply_link_fault("link-late", 5.0)] == [c.due_ns + 5 * S for c in frames()]
    shuffled = [chunk.data for chunk in apply_link_fault("reordering", 0.2)]
    assert shuffled != [c.data for c in frames()]
    assert sorted(shuffled) == sorted(c.data for c in frames())


def test_bit_error_rate():
    before = np.frombuffer(b"".join(c.data for c in frames()), np.uint8)
    after = np.frombuffer(b"".join(c.data for c in apply_link_fault("bit-errors", 1e-3)), np.uint8)
    wrong = np.unpackbits(before ^ after)
    assert np.mean(wrong) == pytest.approx(1e-3, rel=0.3)


def test_garbage_and_truncation():
    found, events = parse_frames(apply_link_fault("garbage", 20.0))
    assert len(found) >= 395 and len(events) > len(found)
    found, _ = parse_frames(apply_link_fault("cut", 0.1))
    assert len(found) == pytest.approx(360, abs=25)


def test_second_autopilot_repeats_frames_with_correct_checksums():
    found, events = parse_frames(apply_link_fault("second-autopilot"))
    assert len(found) == len(events) == 800
    assert {f.system for f in found} == {1, 2}


def test_fault_names_are_unique_and_invalid_faults_are_rejected():
    assert len(set(NAMES)) == len(RECORD_FAULTS) + len(LINK_FAULTS) + len(AUTOPILOT_FAULTS) + len(
        CONSUMER_FAULTS
    )
    with pytest.raises(ValueError, match="unknown fault 'gnss-leap'"):
        Fault("gnss-leap", 0.0)
    with pytest.raises(ValueError, match="end after its start"):
        Fault("gnss-jump", 10.0, 5.0)
