import math

import pytest

from companion.link import dialect, frame
from companion.nav.geometry import Geodetic, displace, slant_range_azimuth
from companion.records import Truth
from sitl.beacon import Beacon
from sitl.live_beacons import COMPONENT, NEVER, LiveBeacons

SECOND = 1_000_000_000
PERFECT = {"sigma_azimuth_deg": 1e-9, "sigma_range": 1e-6, "sigma_range_share": 0.0, "drop_out": 0.0}
HOME = Geodetic(math.radians(60.0), math.radians(30.0), 1000.0)


def truths(seconds: int, rate: int = 10):
    for i in range(seconds * rate):
        lat, lon, alt = displace(*HOME, 30.0 * i / rate, 0.0, 0.0)
        t_ns = 7 * SECOND + i * SECOND // rate
        yield Truth(t_ns, t_ns, lat, lon, alt, (30.0, 0.0, 0.0))


def test_error_free_beacon_measures_the_position_once_a_second():
    beacon = Beacon(3, 60.1, 30.9, **PERFECT, azimuth_step_deg=0.0, range_step=0.0)
    live = LiveBeacons([beacon])
    made = [(truth, fix) for truth in truths(20) for fix in live.answers_to(truth)]
    assert [fix.t_ns for _, fix in made] == [(7 + i) * SECOND for i in range(20)]
    place = Geodetic(math.radians(60.1), math.radians(30.9), beacon.alt)
    for truth, fix in made:
        expected = slant_range_azimuth(place, Geodetic(truth.lat, truth.lon, truth.alt))
        assert fix.slant_range == pytest.approx(expected.slant_range, abs=0.01)
        assert fix.azimuth == pytest.approx(expected.azimuth, abs=1e-8)


def delivered(live, boot_ns=SECOND):
    found = []
    for truth in truths(5):
        live.answers_to(truth)
        for data in live.take_due(truth.t_ns, boot_ns, 9):
            (f,) = frame.Reader().receive(data)
            found.append((truth.t_ns, f, dialect.decode(f)))
    return found


def test_answer_is_delayed_and_stamped_in_autopilot_time():
    found = delivered(LiveBeacons([Beacon(1, 60.1, 30.9, drop_out=0.0)]))
    assert len(found) == 5
    for now_ns, f, message in found:
        assert (f.system, f.component) == (9, COMPONENT)
        age = (now_ns - SECOND) * 1e-9 - message.time_usec * 1e-6
        assert 0.15 <= age < 0.26


def test_untimed_answer_is_sent_at_once():
    found = delivered(LiveBeacons([Beacon(1, 60.1, 30.9, drop_out=0.0)], untimed=True))
    assert [now_ns % SECOND for now_ns, _, _ in found] == [0] * 5
    assert all(message.time_usec == 0 for _, _, message in found)


def test_nothing_is_sent_before_the_autopilot_clock_is_known():
    assert delivered(LiveBeacons([Beacon(1, 60.1, 30.9)]), boot_ns=None) == []


def test_the_nearest_eight_beacons_answer():
    beacons = [Beacon(i, 60.0 + 0.05 * i, 30.0, drop_out=0.0, silence_deg=90.0) for i in range(1, 30)]
    live = LiveBeacons(beacons[::-1])
    assert {fix.beacon for truth in truths(3) for fix in live.answers_to(truth)} == set(range(1, 9))


def test_noise_depends_on_the_seed():
    def ranges(seed):
        live = LiveBeacons([Beacon(1, 60.1, 30.9)], seed)
        return [fix.slant_range for truth in truths(5) for fix in live.answers_to(truth)]

    assert ranges(1) == ranges(1) != ranges(2)


def test_no_deadline_without_pending_answers():
    assert LiveBeacons([]).deadline() == NEVER
