from collections import Counter, defaultdict
from functools import lru_cache

import numpy as np
import pytest

from companion.link import dialect, frame
from companion.units import SECOND_NS
from sitl.autopilot import NEVER, RECEIVER_COMPONENT, SimulatedAutopilot
from sitl.faults import Fault
from sitl.scenarios import get_scenario
from sitl.world import World

START = 1_000 * SECOND_NS


@lru_cache(maxsize=1)
def short_flight() -> World:
    return World(get_scenario("short"))


def autopilot(**changes):
    scenario = get_scenario("short", **changes)
    shared = short_flight() if not changes else None
    return SimulatedAutopilot(scenario, START, shared)


def send(pilot, name, now=START, **values):
    pilot.receive(frame.encode(dialect.new(name, **values), 0, 1, 191), now)


def request_rate(pilot, name, rate_hz, now=START):
    msgid = dialect.type_named(name).msgid
    interval = 1e6 / rate_hz if rate_hz else -1
    send(pilot, "COMMAND_LONG", now, target_system=1, command=511, param1=msgid, param2=interval)


def receive_all(pilot, until_s=float("inf")):
    """[(arrival time, frame)] up to a flight time."""
    received, reader = [], frame.Reader()
    while (due := pilot.deadline()) != NEVER and due <= START + until_s * 1e9:
        for data in pilot.poll(due):
            received += [(due, found) for found in reader.receive(data) if isinstance(found, frame.Frame)]
    return received


def by_name(received):
    grouped = defaultdict(list)
    for due, found in received:
        grouped[dialect.TYPES[found.msgid].name].append((due, dialect.decode(found)))
    return grouped


def test_default_message_rate_is_one_hertz():
    grouped = by_name(receive_all(autopilot(), 60.0))
    for name in (
        "HEARTBEAT",
        "RAW_IMU",
        "LOCAL_POSITION_NED",
        "GPS_RAW_INT",
        "ATTITUDE",
        "VFR_HUD",
        "SYSTEM_TIME",
        "SYS_STATUS",
    ):
        assert len(grouped[name]) == 60, name
    assert "SIM_STATE" not in grouped
    assert grouped["GPS_GLOBAL_ORIGIN"] and grouped["HOME_POSITION"]
    assert grouped["HEARTBEAT"][0][1].get_type() == "HEARTBEAT"


def test_message_intervals_are_set_and_acknowledged():
    pilot = autopilot()
    for name, rate in (("RAW_IMU", 50), ("LOCAL_POSITION_NED", 10), ("SIM_STATE", 4), ("VFR_HUD", 0)):
        request_rate(pilot, name, rate)
    send(pilot, "COMMAND_LONG", target_system=1, command=511, param1=9999, param2=1e5)
    grouped = by_name(receive_all(pilot, 20.0))
    assert len(grouped["RAW_IMU"]) == pytest.approx(1000, abs=2)
    assert len(grouped["LOCAL_POSITION_NED"]) == pytest.approx(200, abs=2)
    assert len(grouped["SIM_STATE"]) == pytest.approx(80, abs=2)
    assert not grouped["VFR_HUD"]
    assert [ack.result for _, ack in grouped["COMMAND_ACK"]] == [0, 0, 0, 0, 3]
    assert {(ack.target_system, ack.target_component) for _, ack in grouped["COMMAND_ACK"]} == {(1, 191)}


def test_fix_is_repeated_when_the_stream_is_faster_than_the_receiver():
    pilot = autopilot()
    request_rate(pilot, "GPS_RAW_INT", 20)
    stamps = Counter(m.time_usec for _, m in by_name(receive_all(pilot, 30.0))["GPS_RAW_INT"])
    counts = list(stamps.values())[2:-2]
    assert set(counts) == {4}


def test_gnss_loss_is_reported_within_a_second_and_by_the_filter_ten_seconds_later():
    pilot = autopilot()
    request_rate(pilot, "GPS_RAW_INT", 5)
    grouped = by_name(receive_all(pilot, 240.0))
    lost = next(due for due, m in grouped["GPS_RAW_INT"] if m.fix_type == 1)
    assert 0.0 <= (lost - START) * 1e-9 - 180.0 < 1.0
    alone = next(due for due, m in grouped["EKF_STATUS_REPORT"] if m.flags == 303)
    assert 9.0 < (alone - START) * 1e-9 - 180.0 < 12.0


def test_timesync_returns_time_since_boot():
    pilot = autopilot()
    now = START + 10 * SECOND_NS
    receive_all(pilot, 10.0)
    send(pilot, "TIMESYNC", now, ts1=now)
    (arrival, answer), *_ = by_name(receive_all(pilot, 11.0))["TIMESYNC"]
    assert answer.ts1 == now
    boot_offset = (arrival + now) // 2 - answer.tc1
    assert boot_offset == pytest.approx(START - 37.25 * SECOND_NS, abs=20e6)


def test_stamps_are_boot_time_and_no_frame_arrives_before_its_stamp():
    pilot = autopilot()
    request_rate(pilot, "ATTITUDE", 10)
    for due, m in by_name(receive_all(pilot, 30.0))["ATTITUDE"]:
        delay = (due - START) * 1e-9 - (m.time_boot_ms * 1e-3 - 37.25)
        assert 0.0 < delay < 0.1


def test_rsbn_receiver_is_a_component_that_sends_each_answer_once():
    received = [
        f for _, f in receive_all(autopilot(), 60.0) if dialect.TYPES[f.msgid].name == "RSBN_MEASUREMENT"
    ]
    assert {f.component for f in received} == {RECEIVER_COMPONENT}
    stamps = [dialect.decode(f).time_usec for f in received]
    assert len(set(stamps)) == len(stamps) == pytest.approx(60, abs=4)


def test_frames_are_in_order_without_sequence_gaps():
    received = receive_all(autopilot(), 120.0)
    last = {}
    for _, f in received:
        if f.component in last:
            assert f.sequence == last[f.component] + 1 & 0xFF
        last[f.component] = f.sequence
    assert [due for due, _ in received] == sorted(due for due, _ in received)


def test_single_message_is_sent_on_request():
    pilot = autopilot()
    receive_all(pilot, 2.0)
    send(pilot, "COMMAND_LONG", START + 2 * SECOND_NS, target_system=1, command=512, param1=49)
    grouped = by_name(receive_all(pilot, 2.5))
    assert len(grouped["GPS_GLOBAL_ORIGIN"]) == 1
    assert grouped["COMMAND_ACK"][0][1].result == 0
    assert grouped["GPS_GLOBAL_ORIGIN"][0][1].latitude == 600000000


def test_companion_outputs_are_recorded():
    pilot = autopilot()
    send(pilot, "ODOMETRY", START + 5, frame_id=20, child_frame_id=12, x=1.0)
    send(pilot, "NAVIGATION_STATUS", START + 6)
    send(pilot, "HEARTBEAT", START + 7)
    send(pilot, "COMMAND_LONG", START + 8, command=43003, target_system=1)
    assert [(at, m.get_type()) for at, m in pilot.outputs] == [
        (START + 5, "ODOMETRY"),
        (START + 6, "NAVIGATION_STATUS"),
    ]


def test_bytes_depend_on_seed_not_on_polling():
    def flown(step_ns):
        pilot, out, now = autopilot(seed=3), [], START
        while now <= START + 30 * SECOND_NS:
            out += pilot.poll(now)
            now += step_ns
        return b"".join(out)

    assert flown(SECOND_NS // 100) == flown(SECOND_NS)


def test_reboot_silences_streams_and_resets_boot_time_and_rates():
    pilot = autopilot(faults=(Fault("reboot", 60.0, size=8.0),))
    request_rate(pilot, "LOCAL_POSITION_NED", 10)
    received = by_name(receive_all(pilot, 90.0))["LOCAL_POSITION_NED"]
    arrivals = np.array([due - START for due, _ in received]) * 1e-9
    gap = np.argmax(np.diff(arrivals))
    assert np.diff(arrivals)[gap] == pytest.approx(8.0, abs=1.1)
    assert received[gap + 1][1].time_boot_ms < 10_000 < received[gap][1].time_boot_ms
    assert np.median(np.diff(arrivals[gap + 1 :])) == pytest.approx(1.0, abs=0.05)


def test_clock_jumps_by_an_hour_and_back():
    pilot = autopilot(faults=(Fault("clock-jump", 60.0, 90.0),))
    received = by_name(receive_all(pilot, 120.0))["ATTITUDE"]
    offsets = {round((due - START) * 1e-9 - m.time_boot_ms * 1e-3) for due, m in received}
    assert offsets == {-37, -3637}


def test_lost_link_loses_both_directions():
    pilot = autopilot(faults=(Fault("link-loss", 30.0, 40.0),))
    request_rate(pilot, "ATTITUDE", 10, START + 35 * SECOND_NS)
    assert pilot.rates_hz()["ATTITUDE"] == 1.0
    arrivals = np.array([due - START for due, _ in receive_all(pilot, 60.0)]) * 1e-9
    assert not np.any((arrivals > 30.1) & (arrivals < 40.0))


def test_late_link_keeps_order_and_reordering_link_does_not():
    def stamps(name):
        pilot = autopilot(faults=(Fault(name, 30.0, 40.0),))
        request_rate(pilot, "ATTITUDE", 10)
        received = by_name(receive_all(pilot, 60.0))["ATTITUDE"]
        late = max((due - START) * 1e-9 - (m.time_boot_ms * 1e-3 - 37.25) for due, m in received)
        return [m.time_boot_ms for _, m in received], late

    in_order, late = stamps("link-late")
    assert in_order == sorted(in_order)
    assert 5.0 < late < 5.1
    shuffled, late = stamps("reordering")
    assert shuffled != sorted(shuffled)
    assert late < 0.3


def test_px4_sends_its_own_messages():
    pilot = autopilot(autopilot="px4")
    request_rate(pilot, "HIL_STATE_QUATERNION", 5)
    grouped = by_name(receive_all(pilot, 10.0))
    assert grouped["HIGHRES_IMU"] and grouped["ESTIMATOR_STATUS"] and grouped["HIL_STATE_QUATERNION"]
    assert {m.time_usec for _, m in grouped["GPS_RAW_INT"]} == {0}
    assert "RAW_IMU" not in grouped


def test_a_whole_flight_is_emitted_at_the_requested_rates():
    pilot = SimulatedAutopilot(get_scenario("short"), START)  # 300 s
    for name, rate in (("RAW_IMU", 50), ("LOCAL_POSITION_NED", 10), ("GPS_RAW_INT", 5), ("ATTITUDE", 10)):
        request_rate(pilot, name, rate)
    count = 0
    while (due := pilot.deadline()) != NEVER:
        count += len(pilot.poll(due))
    assert count > 300 * (50 + 10 + 5 + 10)


def test_commands_are_ignored_during_boot():
    pilot = autopilot(faults=(Fault("reboot", 60.0, size=8.0),))
    receive_all(pilot, 61.0)
    request_rate(pilot, "ATTITUDE", 10, START + 65 * SECOND_NS)
    assert pilot.rates_hz()["ATTITUDE"] == 1.0
    assert min(due for due, _ in receive_all(pilot, 70.0)) >= START + 68 * SECOND_NS


@pytest.mark.parametrize("make", ["ardupilot", "px4"])
def test_origin_change_moves_local_but_not_global_position(make):
    pilot = autopilot(autopilot=make, faults=(Fault("origin-change", 60.0, 90.0, 1000.0),))
    received = by_name(receive_all(pilot, 120.0))
    north_east = [(m.x, m.y) for _, m in received["LOCAL_POSITION_NED"]]
    steps = np.diff(north_east, axis=0) - [(m.vx, m.vy) for _, m in received["LOCAL_POSITION_NED"]][1:]
    leaps = {k: step for k, step in enumerate(steps) if np.hypot(*step) > 500.0}
    assert list(leaps.values()) == [
        pytest.approx(sign * np.sqrt(0.5) * np.array([1000.0, 1000.0]), abs=15.0) for sign in (-1, 1)
    ]
    places = {(m.latitude, m.longitude) for _, m in received["GPS_GLOBAL_ORIGIN"]}
    assert len(places) == 2
    smooth = np.diff([(m.lat, m.lon) for _, m in received["GLOBAL_POSITION_INT"]], axis=0) * 1e-7 * 111e3
    assert np.abs(smooth).max() < 100.0
