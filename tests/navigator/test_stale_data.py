"""Old numbers are known for what they are: reported, and never used; honest repeats are passed over."""

import math
import random
import tracemalloc

import pytest

from companion.config import Config, InertialConfig
from companion.navigator import Navigator
from companion.navigator.stale_data import (
    AIRSPEED_S,
    ANSWERS,
    ATTITUDE_S,
    HALF_ANSWERS,
    MOST_SOURCES,
    PATIENCE_S,
    SAMPLES,
    StaleDataDetector,
)
from companion.records import (
    AirData,
    Attitude,
    Gnss,
    Imu,
    LocalOrigin,
    LocalPosition,
    Pressure,
    Reboot,
    Rejection,
    RsbnFix,
    Solution,
)

NS = 1_000_000_000
FLYING, PARKED = (40.0, 3.0, 0.0), (0.02, -0.01, 0.0)


def local(t: float, x: float, v_n=FLYING, rx: float | None = None) -> LocalPosition:
    return LocalPosition(round(t * NS), round((t if rx is None else rx) * NS), (x, 0.0, -100.0), v_n)


def gnss(t: float, lat: float, stamp: float | None = None, v_n=FLYING, fix: int = 3) -> Gnss:
    stamp_us = round(1e6 * (t if stamp is None else stamp)) + 10**6
    return Gnss(round(t * NS), round(t * NS), 0, stamp_us, fix, lat, 0.5, 100.0, 1.5, v_n=v_n)


def rsbn(
    t: float, azimuth: float | None, slant_range: float | None, beacon: int = 1, rx: float = 0.15
) -> RsbnFix:
    t_ns = round(t * NS)
    return RsbnFix(t_ns, t_ns + round(rx * NS), beacon, 1.0, 0.5, 50.0, azimuth, slant_range, 2e-3, 100.0)


def verdicts(records) -> list[str]:
    """Of each record: "used", or what was reported of it ("" where nothing was)."""
    detector, found = StaleDataDetector(), []
    for record in records:
        reported = detector.judge(record)
        found.append("used" if reported is None else " ".join(out.reason for out in reported))
    return found


def test_what_changes_is_used() -> None:
    rng = random.Random(1)
    records = [
        each
        for i in range(200)
        for each in (
            local(0.1 * i, 4.0 * i),
            gnss(0.1 * i, 1.0 + 1e-6 * i),
            Attitude(i * NS // 10, i * NS // 10, rng.gauss(0.0, 0.01), 0.0, 1.0),
            AirData(i * NS // 10, i * NS // 10, 40.0 + rng.gauss(0.0, 0.3)),
            rsbn(0.1 * i, rng.random(), 60e3),
        )
    ]
    assert set(verdicts(records)) == {"used"}


def test_a_position_that_stands_still_at_a_speed_is_false_at_once_and_told_once_a_second() -> None:
    found = verdicts([local(0.1 * i, 4.0 * min(i, 10)) for i in range(45)])
    assert found[:11] == ["used"] * 11 and "used" not in found[11:]
    assert sum("frozen" in text for text in found) == 4
    assert set(verdicts([local(0.1 * i, 0.0, PARKED) for i in range(50)])) == {"used"}  # on the ground it may


def test_an_old_time_is_no_news_until_it_lasts() -> None:
    again = [local(1.0, 4.0, rx=1.0 + 0.05 * i) for i in range(100)]
    found = verdicts(again)
    quiet = sum(rx.rx_ns - NS <= PATIENCE_S * NS for rx in again)
    assert set(found[1:quiet]) == {""}
    assert "time stands still" in found[quiet] and "used" not in found[quiet:]


def test_a_fix_repeated_at_the_streams_rate_is_silent_and_one_for_ever_is_told() -> None:
    """A receiver of 1 Hz on a stream of 5 Hz; then it hangs."""
    stream = [gnss(0.2 * i, 1.0 + 1e-6 * (i // 5), stamp=float(i // 5)) for i in range(50)]
    assert set(verdicts(stream)) == {"used"}
    hung = [gnss(0.2 * i, 1.0, stamp=0.0) for i in range(50)]
    found = verdicts(hung)
    assert sum("time stands still" in text for text in found) == 7 and found[:15] == ["used"] * 15
    lost = [gnss(0.2 * i, 1.0, stamp=0.0, fix=1) for i in range(50)]
    assert set(verdicts(lost)) == {"used"}  # without a fix the last numbers may stay


def test_a_parked_receiver_whose_fixes_are_repeated_is_well() -> None:
    """Its numbers stay, as a simulator's do; its time goes on, on a stream of twice its rate."""
    parked = [gnss(0.1 * i, 1.0, stamp=0.2 * (i // 2), v_n=PARKED) for i in range(100)]
    assert set(verdicts(parked)) == {"used"}


def test_a_fix_frozen_under_new_stamps_is_told_at_once() -> None:
    found = verdicts([gnss(0.2 * i, 1.0) for i in range(10)])
    assert found[0] == "used" and "frozen" in found[1] and "used" not in found[1:]
    assert set(verdicts([gnss(0.2 * i, 1.0, v_n=PARKED) for i in range(10)])) == {"used"}


@pytest.mark.parametrize(("azimuth", "slant", "limit"), [(1.0, 60e3, ANSWERS), (None, 60e3, HALF_ANSWERS)])
def test_an_answer_again_and_again_is_a_receiver_that_hangs(azimuth, slant, limit) -> None:
    found = verdicts([rsbn(float(i), azimuth, slant) for i in range(12)])
    assert found[: limit - 1] == ["used"] * (limit - 1)
    assert all("frozen" in text for text in found[limit - 1 :])


@pytest.mark.parametrize(("w_b", "stale"), [((0.0, 0.01, -0.02), True), ((0.0, 0.0, 0.0), False)])
def test_samples_of_an_imu_alike_are_an_imu_that_hangs_unless_it_rests(w_b, stale: bool) -> None:
    """Parked, ArduPilot's simulator sends 66 samples alike, and rates of exactly zero."""
    found = verdicts([Imu(i * NS // 20, i * NS // 20, 0, (0.3, 0.1, -9.8), w_b) for i in range(30)])
    assert found[: SAMPLES - 1] == ["used"] * (SAMPLES - 1)
    assert "frozen" in found[SAMPLES - 1] if stale else found[SAMPLES - 1] == "used"
    assert ("used" in found[SAMPLES - 1 :]) is not stale


def test_an_imu_that_hangs_with_hardly_a_rate_is_found_after_seconds() -> None:
    """Parked, ArduPilot's gyros drift to 4 mrad/s, and samples are alike for up to 4.6 s."""
    w_b = (0.0, 0.004, -0.001)
    found = verdicts([Imu(i * NS // 20, i * NS // 20, 0, (0.3, 0.1, -9.8), w_b) for i in range(200)])
    assert set(found[: 20 * 5]) == {"used"}
    assert "used" not in found[20 * 6 :]


def test_an_answer_heard_on_two_links_is_used_once_in_whatever_order() -> None:
    """Counted twice it would claim to be better by the root of two."""
    one, two = rsbn(1.0, 1.0, 60e3), rsbn(2.0, 1.01, 60.01e3)
    assert verdicts([one, rsbn(1.001, 1.0, 60e3), two, one, two]) == ["used", "", "used", "", ""]
    assert verdicts([one, rsbn(1.0, 1.0, 60e3, beacon=2)]) == ["used", "used"]


def test_a_pressure_that_comes_in_two_messages_is_used_once() -> None:
    """SCALED_PRESSURE of PX4 repeats a value of HIGHRES_IMU (50 Hz) up to 150 ms later, at its own time."""
    rng, records = random.Random(2), []
    for k in range(500):
        t_ns = k * NS // 50
        records.append(Pressure(t_ns, t_ns, rng.gauss(99e3, 1.5)))
        if k % 10 == 0:
            repeat_ns, rx_ns = t_ns - 28 * NS // 1000, t_ns + 148 * NS // 1000
            records.append(Pressure(repeat_ns, rx_ns, records[-1].static, 0.0))
    found = verdicts(sorted(records, key=lambda record: record.rx_ns))
    assert found.count("used") == 500 and found.count("") == 50
    level = [Pressure(k * NS // 10, k * NS // 10, 99e3) for k in range(100)]
    assert set(verdicts(level)) == {"used"}


def test_honest_rounding_costs_few_answers() -> None:
    """A beacon's 0.125 deg and 100 m of noise, rounded to 0.01 deg and 10 m, an hour at one place."""
    rng = random.Random(5)
    answers = [
        rsbn(float(i), math.radians(round(rng.gauss(30.0, 0.125), 2)), 10.0 * round(rng.gauss(6000.0, 10.0)))
        for i in range(3600)
    ]
    assert set(verdicts(answers)) == {"used"}


@pytest.mark.parametrize(
    ("make", "limit_s"),
    [
        (lambda t: Attitude(t, t, 0.1, 0.0, 1.0, (0.0, 0.0, 0.1)), ATTITUDE_S),
        (lambda t: Attitude(t, t, 0.1, 0.0, 1.0, (0.0, 0.0, 1e-12 * t)), ATTITUDE_S),
        (lambda t: AirData(t, t, 38.0, climb=1e-9 * t), AIRSPEED_S),
    ],
)
def test_a_sensor_without_noise_has_stopped(make, limit_s: float) -> None:
    found = verdicts([make(i * NS // 10) for i in range(200)])
    first = next(i for i, text in enumerate(found) if text != "used")
    assert first == pytest.approx(10 * limit_s, abs=1) and "used" not in found[first:]


def test_a_reboot_begins_anew() -> None:
    detector = StaleDataDetector()
    detector.judge(local(1.0, 4.0))
    assert detector.judge(Reboot(2 * NS, 2 * NS, 1)) is None
    assert detector.judge(local(1.1, 4.0)) is None


def test_the_navigator_takes_nothing_of_a_channel_that_froze() -> None:
    """Frozen at 40 m/s and believed, the channel would be off by 400 m after ten seconds."""
    navigator = Navigator(Config(inertial=InertialConfig(independent=True)))
    navigator.handle(LocalOrigin(0, 0, 1.0, 0.5, 0.0, "tangent"))
    reported, after = [], []
    for i in range(1, 200):
        t = 0.1 * i
        out = navigator.handle(local(t, 4.0 * min(i, 100)))
        if i % 5 == 0:
            out += navigator.handle(gnss(t, 1.0 + 4.0 * i / 6.37e6))
        reported += [each for each in out if isinstance(each, Rejection)]
        after += out
    assert {(out.source, out.reason[:12]) for out in reported} == {("inertial channel", "it is frozen")}
    assert max(out.t_ns for out in after if isinstance(out, Solution)) <= 10 * NS + NS // 10


def test_beacons_by_the_thousand_are_forgotten_and_a_frozen_one_is_seen_among_them() -> None:
    detector, found = StaleDataDetector(), []
    tracemalloc.start()
    try:
        for k in range(20 * MOST_SOURCES):
            t = 0.025 * k
            assert detector.judge(rsbn(t, 1.0 + 1e-5 * k, 5e4, beacon=100 + k)) is None
            if k % 40 == 0:
                found.append(detector.judge(rsbn(t, 1.0, 4e4)))
            if k == 2 * MOST_SOURCES:
                before, _ = tracemalloc.get_traced_memory()
        after, _ = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert found[: ANSWERS - 1] == [None] * (ANSWERS - 1) and None not in found[ANSWERS - 1 :]
    assert after - before < 200_000
