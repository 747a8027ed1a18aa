"""Companion core: accepted senders, log, output timing and robustness, from bytes to bytes."""

import math
from collections import Counter

import numpy as np
import pytest

from companion.config import Config, InertialConfig, OutputConfig, load
from companion.link import dialect, frame
from companion.link.dialect import mavlink
from companion.link.fields import deg_e7
from companion.link.parameter_server import parameter_table
from companion.nav.geometry import Geodetic, local_to_geodetic, slant_range_azimuth
from companion.navigator import Navigator
from companion.records import (
    Attitude,
    Event,
    Gnss,
    LinkState,
    LocalPosition,
    Reboot,
    Rejection,
    Reset,
    Resumed,
    RsbnFix,
    Severity,
    Solution,
    Stamped,
    Truth,
)
from companion.runtime import core
from companion.runtime.core import CompanionCore
from companion.runtime.input_monitor import STREAMS
from companion.runtime.links import requested_rates

CONFIG = Config(
    inertial=InertialConfig(independent=True),
    output=OutputConfig(profile="custom", odometry_hz=5.0, global_position_sensor_hz=2.0),
)
SECOND, MS = 1_000_000_000, 1_000_000
START = 5000 * SECOND
BOOT = START - 30 * SECOND
ORIGIN = Geodetic(math.radians(60.0), math.radians(30.0), 50.0)
BEACON = Geodetic(math.radians(60.05), math.radians(31.07), 80.0)
V_NORTH, HEIGHT = 40.0, 800.0
OURS = {"target_system": 1, "target_component": 191}


class Log:
    def __init__(self) -> None:
        self.records: list[tuple[str | None, Stamped]] = []
        self.frames: Counter[bool] = Counter()

    def record(self, record: Stamped, channel: str | None = None) -> None:
        self.records.append((channel, record))

    def frame(self, link: str, outgoing: bool, data: bytes, t_ns: int) -> None:
        self.frames[outgoing] += 1

    def of(self, *kinds: type[Stamped]) -> list:
        return [record for _, record in self.records if isinstance(record, kinds)]


class Flight:
    """An autopilot flying north with a companion, on a simulated clock."""

    def __init__(self, *links: str, config: Config = CONFIG) -> None:
        self.log = Log()
        self.core = CompanionCore(config, self.log, links or ("main",))
        self.now, self.boot, self.sends_origin, self.system = START, BOOT, True, 1
        self.sent: list[tuple[int, dialect.Message]] = []
        self._sequence = 0
        self._reader = frame.Reader()

    def frame(self, name: str, system: int | None = None, component: int = 1, **values: object) -> bytes:
        self._sequence = self._sequence + 1 & 0xFF
        message = dialect.new(name, **values)
        return frame.encode(message, self._sequence, self.system if system is None else system, component)

    def send(self, name: str, system: int | None = None, component: int = 1, **values: object) -> None:
        self.receive(self.frame(name, system, component, **values))

    def receive(self, data: bytes) -> None:
        self.core.receive("main", data, self.now)
        self.collect()

    def collect(self) -> None:
        for data in self.core.to_send("main", self.now):
            for found in self._reader.receive(data):
                self.sent.append((self.now, dialect.decode(found)))

    def place(self) -> Geodetic:
        t = (self.now - START) * 1e-9
        return local_to_geodetic("ardupilot", ORIGIN, np.array([V_NORTH * t, 0.0, -HEIGHT]))

    def fly(self, seconds: float) -> None:
        for _ in range(round(10 * seconds)):
            self.now += 100 * MS
            stamp = (self.now - self.boot) // MS
            tick = (self.now - START) // (100 * MS)
            if tick % 10 == 1:
                self.send("HEARTBEAT", type=1, autopilot=3)
            if tick % 50 == 2 and self.sends_origin:
                self.send_origin()
            x = V_NORTH * (self.now - START) * 1e-9
            self.send("LOCAL_POSITION_NED", time_boot_ms=stamp, x=x, z=-HEIGHT, vx=V_NORTH)
            if tick % 2:
                lat, lon, alt = self.place()
                self.send(
                    "GPS_RAW_INT",
                    time_usec=stamp * 1000,
                    fix_type=3,
                    lat=deg_e7(lat),
                    lon=deg_e7(lon),
                    alt=round(alt * 1e3),
                    vel=round(V_NORTH * 100),
                    satellites_visible=14,
                )
            self.core.poll(self.now)
            self.collect()

    def send_origin(self) -> None:
        lat, lon = deg_e7(ORIGIN.lat), deg_e7(ORIGIN.lon)
        self.send("GPS_GLOBAL_ORIGIN", latitude=lat, longitude=lon, altitude=round(ORIGIN.alt * 1e3))

    def rsbn(self, component: int = 1, **changes: object) -> None:
        self.receive(self.rsbn_frame(component, **changes))

    def rsbn_frame(self, component: int = 1, **changes: object) -> bytes:
        true = slant_range_azimuth(BEACON, self.place())
        values = {
            "time_usec": (self.now - self.boot) // 1000,
            "beacon_lat": deg_e7(BEACON.lat),
            "beacon_lon": deg_e7(BEACON.lon),
            "beacon_alt": BEACON.alt,
            "azimuth": true.azimuth,
            "slant_range": true.slant_range,
            "sigma_azimuth": 0.002,
            "sigma_range": 100.0,
            "beacon_id": 1,
            "status": 3,
        }
        return self.frame("RSBN_MEASUREMENT", component=component, **(values | changes))

    def times_sent(self, name: str) -> list[int]:
        return [at for at, message in self.sent if message.get_type() == name]


def test_truth_is_logged_but_not_passed_to_the_navigator(monkeypatch: pytest.MonkeyPatch) -> None:
    handled: list[type] = []
    handle = Navigator.handle

    def spy(self: Navigator, record: Stamped) -> list:
        handled.append(type(record))
        return handle(self, record)

    monkeypatch.setattr(Navigator, "handle", spy)
    flight = Flight()
    flight.fly(2.0)
    lat, lon, alt = flight.place()
    flight.send("SIM_STATE", lat_int=deg_e7(lat), lon_int=deg_e7(lon), alt=alt, q1=1.0)
    hil = {"lat": deg_e7(lat), "lon": deg_e7(lon), "alt": round(alt * 1e3)}
    flight.send("HIL_STATE_QUATERNION", **hil, attitude_quaternion=[1.0, 0.0, 0.0, 0.0])
    assert len(flight.log.of(Truth)) == 2
    assert Truth not in handled
    assert LocalPosition in handled and Gnss in handled


def test_an_attitude_sent_twice_is_decoded_once() -> None:
    """PX4 sends ATTITUDE and ATTITUDE_QUATERNION; the second is used where the first is missing."""
    flight = Flight()
    flight.fly(1.0)

    def attitudes(*names: str) -> int:
        before = len(flight.log.of(Attitude))
        for _ in range(10):
            flight.now += 20 * MS
            stamp = {"time_boot_ms": (flight.now - flight.boot) // MS}
            for name in names:
                flight.send(name, **stamp, **({"q1": 1.0} if "QUATERNION" in name else {}))
        return len(flight.log.of(Attitude)) - before

    assert attitudes("ATTITUDE_QUATERNION") == 10
    assert attitudes("ATTITUDE", "ATTITUDE_QUATERNION") == 10
    flight.fly(2.0)
    assert attitudes("ATTITUDE_QUATERNION") == 10


def test_solutions_are_sent_at_their_rates_and_immediately_after_a_beacon_fix() -> None:
    flight = Flight()
    flight.fly(13.0)
    begin = flight.now - 10 * SECOND
    for name, rate in (("ODOMETRY", 5), ("GLOBAL_POSITION_SENSOR", 2), ("NAVIGATION_STATUS", 1)):
        times = [at for at in flight.times_sent(name) if at > begin]
        assert len(times) == pytest.approx(10 * rate, abs=1), name
    before = len(flight.sent)
    flight.now += 10 * MS
    flight.rsbn(component=42)  # a receiver with its own component id
    assert {m.get_type() for _, m in flight.sent[before:]} >= {"ODOMETRY", "GLOBAL_POSITION_SENSOR"}
    assert len(flight.log.of(RsbnFix)) == 1


def test_origin_is_requested_until_received() -> None:
    flight = Flight()
    flight.sends_origin = False
    flight.fly(10.0)

    def requests() -> int:
        return sum(
            m.get_type() == "COMMAND_LONG" and m.command == 512 and m.param1 == 49 for _, m in flight.sent
        )

    assert 3 <= requests() <= 4
    assert not flight.log.of(Solution)
    flight.send_origin()
    count = requests()
    flight.fly(7.0)
    assert requests() == count
    assert flight.log.of(Solution)


def test_second_autopilot_is_reported_once_and_ignored() -> None:
    alone, disturbed = Flight(), Flight()
    alone.fly(6.0)
    for _ in range(6):
        disturbed.fly(1.0)
        disturbed.send("HEARTBEAT", system=9, type=1, autopilot=3)
        disturbed.send("LOCAL_POSITION_NED", system=9, time_boot_ms=1, x=9e4, y=9e4)
    reports = [e.text for e in disturbed.log.of(Event) if "second autopilot" in e.text]
    assert len(reports) == 1 and "9" in reports[0]
    assert disturbed.log.of(Solution) == alone.log.of(Solution)


def decoded(frames: list[bytes]) -> list[dialect.Message]:
    found = [found for data in frames for found in frame.Reader().receive(data)]
    return [dialect.decode(each) for each in found if isinstance(each, frame.Frame)]


def event_texts(flight: Flight) -> list[str]:
    return [event.text for event in flight.log.of(Event)]


class TwoLinks(Flight):
    """The same autopilot on a second, delayed link; the first can be cut.

    TIMESYNC is answered on the links `answering`.
    """

    def __init__(self, late: int, *answering: str) -> None:
        super().__init__("main", "radio")
        self.late, self.cut, self.answering = late, False, set(answering)
        self.steered: Counter[str] = Counter()
        self.texts: Counter[tuple[str, str]] = Counter()  # by link and text
        self._way: list[tuple[int, bytes]] = []

    def receive(self, data: bytes) -> None:
        if not self.cut:
            super().receive(data)
        self._way.append((self.now + self.late, data))
        while self._way and self._way[0][0] <= self.now:
            self.core.receive("radio", self._way.pop(0)[1], self.now)
        for name in ("main", "radio"):
            self.answer(name)

    def answer(self, name: str) -> None:
        for message in decoded(self.core.to_send(name, self.now)):
            self.steered[name] += message.get_type() == "ODOMETRY"
            if message.get_type() == "STATUSTEXT":
                self.texts[name, message.text] += 1
            if message.get_type() == "TIMESYNC" and not message.tc1 and name in self.answering:
                reply = self.frame("TIMESYNC", tc1=self.now - self.boot, ts1=message.ts1)
                self.core.receive(name, reply, self.now)

    def collect(self) -> None:
        pass


@pytest.mark.parametrize("late", [0, 400 * MS, 2 * SECOND])
def test_one_of_two_links_leads(late: int) -> None:
    alone, both = Flight(), TwoLinks(late)
    alone.fly(20.0)
    both.fly(20.0)
    assert both.log.of(Solution) == alone.log.of(Solution)
    assert both.steered["radio"] == 0 and both.steered["main"] == len(alone.times_sent("ODOMETRY"))
    assert "radio: autopilot 1 connected (ardupilot); main leads" in event_texts(both)


def test_second_link_leads_while_the_first_is_silent() -> None:
    flight = TwoLinks(20 * MS)
    flight.fly(15.0)
    flight.cut = True
    flight.fly(20.0)
    assert any(
        t.startswith("main: autopilot 1 silent") and t.endswith("radio leads") for t in event_texts(flight)
    )
    during = [s for s in flight.log.of(Solution) if s.rx_ns > flight.now - 14 * SECOND]
    assert len(during) >= 65 and flight.steered["radio"] >= 65
    assert max(math.hypot(*s.error_n) for s in during) < 3.0
    flight.cut = False
    before = flight.steered.copy()
    flight.fly(10.0)
    assert flight.steered["main"] - before["main"] >= 45
    assert not flight.log.of(Reset)


def test_second_link_leads_before_the_loss_of_the_first_is_noticed() -> None:
    flight = TwoLinks(20 * MS)
    flight.fly(15.0)
    flight.cut = True
    flight.fly(4.0)
    assert flight.steered["radio"] >= 9
    texts = event_texts(flight)
    assert not any("silent" in text or "no solution" in text for text in texts)
    times = [s.rx_ns for s in flight.log.of(Solution)]
    assert max(np.diff(times)) <= 2 * SECOND


def test_a_link_on_which_the_autopilot_does_not_answer_does_not_lead() -> None:
    flight = TwoLinks(20 * MS, "main", "radio")
    flight.fly(20.0)
    assert flight.steered["radio"] == 0
    flight.answering.remove("main")
    flight.fly(12.0)
    before = flight.steered.copy()
    flight.fly(10.0)
    assert flight.steered["main"] == before["main"]
    assert event_texts(flight)[-1] == "radio leads: the autopilot does not answer on main"
    assert flight.steered["radio"] - before["radio"] >= 45
    flight.answering.add("main")
    flight.fly(3.0)
    before = flight.steered.copy()
    flight.fly(10.0)
    assert flight.steered["radio"] == before["radio"] and not flight.log.of(Reset)


@pytest.mark.parametrize("names", [("radio",), ("main", "radio")])
def test_a_beacon_is_used_on_any_link_and_once(names: tuple[str, ...]) -> None:
    alone, both = Flight(), TwoLinks(0)
    for _ in range(20):
        alone.fly(1.0)
        alone.rsbn(component=77)
        both.fly(1.0)
        data = both.rsbn_frame(component=77)
        for name in names:
            both.core.receive(name, data, both.now)
    assert len(both.log.of(RsbnFix)) == 20 and not both.log.of(Rejection)
    assert not any("not used" in text for text in event_texts(both))
    assert both.log.of(Solution) == alone.log.of(Solution)


def test_a_text_goes_out_once_on_the_way_to_each_station() -> None:
    flight = TwoLinks(0)
    flight.fly(30.0)
    station = Station(flight, "radio")
    for name in ("main", "radio"):  # one that the autopilot forwards
        Station(flight, name).send("HEARTBEAT", type=6, autopilot=8)
    flight.texts.clear()
    flight.core.report(Severity.INFO, "a", flight.now)
    flight.fly(1.0)
    assert flight.texts == {("main", "a"): 1}
    data = frame.encode(dialect.new("HEARTBEAT", type=6, autopilot=8), 1, 254, 190)
    flight.core.receive("radio", data, flight.now)  # one that only the second link has
    flight.core.report(Severity.INFO, "b", flight.now)
    flight.fly(1.0)
    assert flight.texts["main", "b"] == flight.texts["radio", "b"] == 1
    assert station.send("PING", time_usec=7)


def test_parameters_are_checked_once_for_two_links() -> None:
    flight = TwoLinks(0)
    flight.fly(60.0)
    assert sum("run companion doctor" in text for text in event_texts(flight)) == 1


@pytest.mark.parametrize("late", [0, 2 * SECOND])
def test_reboot_seen_on_two_links_is_one(late: int) -> None:
    flight = TwoLinks(late)
    for reboots in (1, 2):
        flight.fly(8.0)
        flight.boot = flight.now - SECOND
        flight.fly(8.0)
        assert len(flight.log.of(Reboot)) == len(flight.log.of(Reset)) == reboots
        assert sum("rebooted" in text for text in event_texts(flight)) == reboots
    flight.cut, flight.boot = True, flight.now - SECOND  # seen on the second link only
    flight.fly(20.0)
    assert len(flight.log.of(Reboot)) == 3


def test_another_aircraft_on_a_second_link_is_reported_and_ignored() -> None:
    alone, disturbed = Flight(), Flight("main", "radio")
    alone.fly(6.0)
    for _ in range(6):
        disturbed.fly(1.0)
        for name, values in (
            ("HEARTBEAT", {"type": 1, "autopilot": 3}),
            ("LOCAL_POSITION_NED", {"time_boot_ms": 1000, "x": 9e4, "y": 9e4}),
        ):
            disturbed.core.receive("radio", disturbed.frame(name, system=9, **values), disturbed.now)
    assert "radio: second autopilot 9 ignored; connected to 1" in event_texts(disturbed)
    assert disturbed.log.of(Solution) == alone.log.of(Solution)
    names = [m.get_type() for m in decoded(disturbed.core.to_send("radio", disturbed.now))]
    assert set(names) == {"HEARTBEAT"}


def test_a_station_gets_copies_of_the_feed_on_its_own_link_and_does_not_change_it() -> None:
    flight, results = Flight("main", "station"), []

    def ask(link: str, interval_us: float) -> None:
        fields = {"command": 511, "param1": dialect.type_named("ODOMETRY").msgid, "param2": interval_us}
        command = flight.frame("COMMAND_LONG", system=255, component=190, **OURS, **fields)
        flight.core.receive(link, command, flight.now)
        sent = decoded(flight.core.to_send(link, flight.now))
        results.extend(m.result for m in sent if m.get_type() == "COMMAND_ACK")

    def flown(seconds: float) -> tuple[int, int]:
        before, copies = len(flight.times_sent("ODOMETRY")), 0
        for _ in range(round(seconds)):
            flight.fly(1.0)
            sent = decoded(flight.core.to_send("station", flight.now))
            copies += sum(m.get_type() == "ODOMETRY" for m in sent)
        return len(flight.times_sent("ODOMETRY")) - before, copies

    flown(5.0)
    fed, _ = flown(10.0)
    assert fed == pytest.approx(50, abs=1)
    for interval_us, copies in ((60e6, 1), (500e3, 20), (20e3, fed), (-1.0, 0), (500e3, 20), (0.0, 0)):
        ask("station", interval_us)
        found = flown(10.0)
        assert found == (pytest.approx(fed, abs=1), pytest.approx(copies, abs=1)), interval_us
    assert results == [mavlink.MAV_RESULT_ACCEPTED] * 6
    ask("main", 60e6)
    assert results[-1] == mavlink.MAV_RESULT_DENIED
    assert flown(10.0) == (pytest.approx(fed, abs=1), 0)


def test_before_the_first_solution_the_trust_is_untrusted_and_all_else_unknown() -> None:
    flight = Flight()
    flight.send("HEARTBEAT", type=1, autopilot=3)
    flight.now += SECOND
    flight.core.poll(flight.now)
    flight.collect()
    named = {m.name: m.value for _, m in flight.sent if m.get_type() == "NAMED_VALUE_FLOAT"}
    assert named.pop("nav_trust") == 4.0
    assert len(named) == 4 and all(math.isnan(value) for value in named.values())


def test_a_parameter_that_changes_is_reported_with_its_sender() -> None:
    flight = Flight()
    flight.fly(3.0)
    for value in (3.0, 3.0, 2.5):
        fields = {"param_id": "GNSS_SIGMA_M", "param_value": value, "param_type": 9}
        flight.send("PARAM_SET", system=254, component=190, **OURS, **fields)
    assert [text for text in event_texts(flight) if "GNSS_SIGMA_M" in text] == [
        "GNSS_SIGMA_M set from 2 to 3 by 254",
        "GNSS_SIGMA_M set from 3 to 2.5 by 254",
    ]


def test_faster_output_requests_a_faster_inertial_channel() -> None:
    flight = Flight()
    flight.fly(3.0)
    before = len(flight.sent)
    fields = {"param_id": b"ODOMETRY_HZ", "param_value": 20.0, "param_type": 9}
    flight.send("PARAM_SET", system=255, component=190, **OURS, **fields)
    flight.fly(1.0)
    requests = [m for _, m in flight.sent[before:] if m.get_type() == "COMMAND_LONG" and m.command == 511]
    local = dialect.type_named("LOCAL_POSITION_NED").msgid
    assert [(m.param1, m.param2) for m in requests] == [(local, 50_000.0)]


def test_garbage_and_unknown_messages_are_counted_and_navigation_continues() -> None:
    flight = Flight()
    flight.fly(3.0)
    flight.receive(bytes(range(256)) * 4)
    flight.receive(b"\xfd\x02\x00\x00\x00\x01\x01\xff\xff\x7fab\x12\x34")
    solutions = len(flight.log.of(Solution))
    flight.fly(3.0)
    assert flight.log.of(LinkState)[-1].bad >= 2
    assert len(flight.log.of(Solution)) >= solutions + 14


def test_an_answer_without_sigmas_has_those_configured() -> None:
    """Also once a ground station has set them."""
    flight = Flight(
        config=load(environment={}, pairs=("rsbn.sigma_azimuth_deg=0.05", "rsbn.sigma_range_m=30"))
    )

    def sigmas() -> tuple[float, float]:
        flight.fly(1.0)
        flight.rsbn(sigma_azimuth=math.nan, sigma_range=math.nan)
        (*_, fix) = flight.log.of(RsbnFix)
        return math.degrees(fix.sigma_azimuth), fix.sigma_range

    assert sigmas() == pytest.approx((0.05, 30.0))
    values = {"RSBN_AZIMUTH_DEG": 0.5, "RSBN_RANGE_M": 300.0}
    for name, value in values.items():
        flight.send(
            "PARAM_SET", system=255, component=190, **OURS, param_id=name, param_value=value, param_type=9
        )
    assert sigmas() == pytest.approx((0.5, 300.0))


@pytest.mark.parametrize("name", ["LOCAL_POSITION_NED", "RSBN_MEASUREMENT", "GPS_RAW_INT"])
def test_non_finite_fields_cause_one_rejection(name: str) -> None:
    flight = Flight()
    flight.fly(3.0)
    rejected = len(flight.log.of(Rejection))
    if name == "RSBN_MEASUREMENT":
        flight.rsbn(azimuth=math.nan, slant_range=math.nan)
    elif name == "GPS_RAW_INT":
        flight.send(name, time_usec=1, fix_type=3, lat=2_000_000_000, lon=0)
    else:
        flight.send(name, time_boot_ms=(flight.now - flight.boot) // MS, x=math.nan, z=-HEIGHT)
    found = flight.log.of(Rejection)[rejected:]
    assert [r.source for r in found] == [name]
    solutions = len(flight.log.of(Solution))
    flight.fly(2.0)
    assert len(flight.log.of(Solution)) >= solutions + 9


def test_navigation_restarts_after_a_reboot() -> None:
    flight = Flight()
    flight.fly(6.0)
    flight.boot = flight.now - SECOND
    flight.fly(6.0)
    assert len(flight.log.of(Reboot)) == 1
    assert [r.what for r in flight.log.of(Reset)] == ["navigator"]
    assert sum("rebooted" in e.text for e in flight.log.of(Event)) == 1
    assert flight.log.of(Solution)[-1].rx_ns > flight.now - SECOND
    assert any(at > flight.now - SECOND for at in flight.times_sent("ODOMETRY"))


def test_after_a_reboot_without_a_fix_the_fix_is_what_is_missing(monkeypatch: pytest.MonkeyPatch) -> None:
    """The channel arrives all the time."""
    flight = Flight()
    send = flight.send
    flight.fly(6.0)
    flight.boot = flight.now - SECOND
    monkeypatch.setattr(flight, "send", lambda name, **values: name == "GPS_RAW_INT" or send(name, **values))
    flight.fly(6.0)
    assert "no solution for 2 s: no fix to begin again from" in event_texts(flight)


def killed_and_begun_again(
    seconds: float, autopilot_boots: bool = False, system: int = 1
) -> tuple[Flight, Flight]:
    """A flight, and the one of a second core that was given what the first one kept."""
    first, second = Flight(), Flight()
    first.fly(40)
    second.core = CompanionCore(CONFIG, second.log, ("main",), flown=first.core.flown(first.now))
    second.now, second.system = first.now + round(seconds * SECOND), system
    second.boot = second.now - 20 * SECOND if autopilot_boots else first.boot
    second.fly(1)
    return first, second


def test_a_companion_that_was_killed_goes_on_with_the_flight() -> None:
    first, second = killed_and_begun_again(6.0)
    (kept,) = second.log.of(Resumed)
    assert "navigation goes on after a restart, 6.1 s later" in event_texts(second)
    before, after = first.log.of(Solution)[-1], second.log.of(Solution)[0]
    assert after.gnss_false == pytest.approx(before.gnss_false, rel=1e-3)
    assert after.t_ns - kept.t_ns < SECOND


def test_what_was_kept_is_not_of_use_to_an_autopilot_that_booted_since() -> None:
    _, second = killed_and_begun_again(6.0, autopilot_boots=True)
    assert not second.log.of(Resumed)
    assert not [text for text in event_texts(second) if "restart" in text]


def test_what_was_kept_is_not_of_use_beside_another_autopilot_that_booted_together() -> None:
    """As those of a swarm do; the one that was flown may still come."""
    _, second = killed_and_begun_again(6.0, system=2)
    assert second.core.links["main"].session.autopilot == 2
    assert not second.log.of(Resumed)


def test_before_a_solution_nothing_is_kept() -> None:
    flight = Flight()
    assert flight.core.flown(flight.now) is None


def test_version_of_another_autopilot_is_requested_again() -> None:
    """ArduPilot's version decides how it reads the accuracy of ODOMETRY."""
    flight = Flight()
    flight.fly(3.0)
    flight.send("AUTOPILOT_VERSION", flight_sw_version=4 << 24 | 6 << 16)
    for k in range(1000):  # a hundred seconds of another aircraft only
        flight.now += 100 * MS
        if k % 10 == 0:
            flight.send("HEARTBEAT", system=2, type=1, autopilot=3)
        flight.send("ATTITUDE", system=2, time_boot_ms=(flight.now - flight.boot) // MS, yaw=1.0)
        flight.core.poll(flight.now)
        flight.collect()
    asked = [m for _, m in flight.sent if m.get_type() == "COMMAND_LONG" and m.param1 == 148]
    assert flight.core.links["main"].session.autopilot == 2
    assert {m.target_system for m in asked} == {1, 2}


def test_lost_and_regained_autopilot_is_reported() -> None:
    flight = Flight()
    flight.fly(2.0)
    for _ in range(8):
        flight.now += SECOND
        flight.core.poll(flight.now)
    flight.fly(2.0)
    texts = [e.text for e in flight.core.take_events()]
    assert sum("silent" in t for t in texts) == 1
    assert sum("connected" in t for t in texts) == 2


def test_every_frame_is_logged_in_both_directions() -> None:
    flight = Flight()
    flight.fly(3.0)
    assert flight.log.frames[True] == len(flight.sent)
    assert flight.log.frames[False] == flight.core.links["main"].received


def test_a_message_that_nothing_uses_is_logged_but_not_decoded(monkeypatch) -> None:
    flight = Flight()
    flight.fly(1.0)
    decoded, decode = list[int](), dialect.decode
    monkeypatch.setattr(dialect, "decode", lambda found: decoded.append(found.msgid) or decode(found))
    frames = flight.log.frames[False]
    flight.core.receive("main", flight.frame("SERVO_OUTPUT_RAW", servo1_raw=1500), flight.now)
    assert (flight.log.frames[False], decoded) == (frames + 1, [])
    attitude = flight.frame("ATTITUDE", time_boot_ms=(flight.now - flight.boot) // MS, yaw=1.0)
    flight.core.receive("main", attitude, flight.now)
    assert decoded == [dialect.id_of(dialect.new("ATTITUDE"))]


def test_a_foreign_flood_is_logged_within_its_budget_and_reported() -> None:
    """5,000 frames a second of strangers for ten seconds; the autopilot's are all logged."""
    flight = Flight()
    flight.fly(5.0)
    before = flight.log.frames[False]
    frames = [flight.frame("STATUSTEXT", 66, 1, severity=6, text="flood") for _ in range(500)]
    for _ in range(100):
        flight.fly(0.1)
        flight.receive(b"".join(frames))
    quiet = Flight()
    quiet.fly(15.0)
    size = len(frames[0])
    foreign = flight.log.frames[False] - quiet.log.frames[False]
    assert before > 0 and 0 < foreign * size <= core.UNUSED_LOG_BURST + 11 * core.UNUSED_LOG_HZ
    assert any("frames of other senders not logged" in text for text in event_texts(flight))


def test_one_sender_cannot_have_more_than_its_share_of_beacon_answers() -> None:
    flight = Flight()
    flight.fly(5.0)
    answers = len(flight.log.of(RsbnFix))
    for k in range(2000):
        flight.now += MS
        flight.receive(flight.frame("RSBN_MEASUREMENT", 66, 1 + k % 200, status=1, time_usec=k))
    assert len(flight.log.of(RsbnFix, Rejection)) - answers <= 4 * (20 + 10 * 2) + 4
    assert any("beacon answers of 66/" in text for text in event_texts(flight))


def test_deadline_is_in_the_future_after_poll() -> None:
    flight = Flight()
    flight.fly(1.0)
    for _ in range(20):
        deadline = flight.core.deadline()
        assert deadline > flight.now
        flight.now = deadline
        flight.core.poll(flight.now)
        flight.collect()


class Station:
    """A ground station on a link of its own."""

    def __init__(self, flight: Flight, link: str) -> None:
        self._flight, self._link, self._sequence = flight, link, 0

    def send(self, name: str, **values: object) -> list[dialect.Message]:
        """Send a message; return what the companion answers on this link."""
        self._sequence += 1
        data = frame.encode(dialect.new(name, **values), self._sequence, 255, 190)
        self._flight.core.receive(self._link, data, self._flight.now)
        return self.take()

    def take(self) -> list[dialect.Message]:
        return decoded(self._flight.core.to_send(self._link, self._flight.now))


def test_station_on_a_link_without_an_autopilot_is_served() -> None:
    flight = Flight("main", "station")
    station = Station(flight, "station")
    station.send("HEARTBEAT", type=6, autopilot=8)
    received = station.send("PARAM_REQUEST_LIST", **OURS)
    for _ in range(30):
        flight.fly(0.5)
        received += station.take()
    names = Counter(message.get_type() for message in received)
    assert names["PARAM_VALUE"] == len(parameter_table())
    assert names["HEARTBEAT"] >= 14 and names["STATUSTEXT"] >= 1
    assert names["NAVIGATION_STATUS"] >= 10 and names["NAMED_VALUE_FLOAT"] >= 50
    assert not names["ODOMETRY"]  # positions go to the autopilot only
    assert {message.get_srcSystem() for message in received} == {1}


def test_link_without_a_station_gets_heartbeats_only() -> None:
    flight = Flight("main", "beacon")
    flight.fly(3.0)
    assert {m.get_type() for m in decoded(flight.core.to_send("beacon", flight.now))} == {"HEARTBEAT"}


def test_named_values_are_those_of_navigation_status() -> None:
    flight = Flight()
    flight.fly(20.0)
    (status,) = [m for _, m in flight.sent if m.get_type() == "NAVIGATION_STATUS"][-1:]
    values = {m.name: m.value for _, m in flight.sent if m.get_type() == "NAMED_VALUE_FLOAT"}
    assert set(values) == {"nav_source", "nav_sigma", "nav_bound", "nav_hpl", "nav_trust"}
    assert (values["nav_source"], values["nav_trust"]) == (status.sources, status.trust)
    assert values["nav_sigma"] == pytest.approx(status.sigma_horizontal, rel=0.05)
    assert len(flight.times_sent("NAMED_VALUE_FLOAT")) == pytest.approx(5 * 19, abs=5)


def test_named_values_of_a_stopped_navigation_are_unknown_and_untrusted() -> None:
    flight = Flight()
    flight.fly(10.0)
    for _ in range(40):
        flight.now += 100 * MS
        flight.send("HEARTBEAT", type=1, autopilot=3)
        flight.core.poll(flight.now)
        flight.collect()
    last = {m.name: m.value for _, m in flight.sent if m.get_type() == "NAMED_VALUE_FLOAT"}
    assert last.pop("nav_trust") == 4.0
    assert all(math.isnan(value) for value in last.values())


def test_ping_and_mission_list_are_answered() -> None:
    flight = Flight("main", "station")
    station = Station(flight, "station")
    (ping,) = [m for m in station.send("PING", time_usec=123, seq=9) if m.get_type() == "PING"]
    assert (ping.time_usec, ping.seq, ping.target_system, ping.target_component) == (123, 9, 255, 190)
    assert not [m for m in station.send("PING", seq=9, **OURS)]
    (count,) = station.send("MISSION_REQUEST_LIST", mission_type=1, **OURS)
    assert (count.get_type(), count.count, count.mission_type) == ("MISSION_COUNT", 0, 1)
    assert station.send("MISSION_REQUEST_LIST", target_system=1, target_component=1) == []


def test_texts_that_nobody_receives_delay_none_for_the_pilot() -> None:
    """The service reports its addresses and its log before the autopilot is there."""
    flight = Flight()
    for k in range(6):
        flight.core.report(Severity.WARNING, f"of the service, {k}", flight.now)
    flight.send("HEARTBEAT", autopilot=3, type=1, mavlink_version=3)
    flight.core.report(Severity.INFO, "of the flight", flight.now)
    flight.collect()
    texts = [m.text for _, m in flight.sent if m.get_type() == "STATUSTEXT"]
    assert texts == ["autopilot 1 connected (ardupilot)", "of the flight"]
    assert len([e for e in flight.log.of(Event) if "of the service" in e.text]) == 6


def test_status_text_names_no_link() -> None:
    flight = Flight("udpin:127.0.0.1:14550")
    flight.core.receive("udpin:127.0.0.1:14550", flight.frame("HEARTBEAT", type=1, autopilot=3), flight.now)
    texts = [
        m.text
        for m in decoded(flight.core.to_send("udpin:127.0.0.1:14550", flight.now))
        if m.get_type() == "STATUSTEXT"
    ]
    assert texts == ["autopilot 1 connected (ardupilot)"]
    assert flight.log.of(Event)[0].text == "udpin:127.0.0.1:14550: autopilot 1 connected (ardupilot)"


def test_silence_is_reported_once_with_what_to_check() -> None:
    flight = Flight("serial:/dev/ttyS0:57600", "station")
    Station(flight, "station").send("PARAM_REQUEST_LIST", **OURS)
    for _ in range(200):
        flight.now += 100 * MS
        flight.core.receive("serial:/dev/ttyS0:57600", b"\x00\xff" * 8, flight.now)
        flight.core.poll(flight.now)
    (text,) = event_texts(flight)
    assert "no autopilot in 5 s" in text and "same baud rate" in text
    assert flight.core.status().text() == "waiting for an autopilot"


def test_silence_is_counted_from_the_time_at_which_the_link_is_open() -> None:
    flight = Flight("serial:/dev/ttyS0:57600")
    (link,) = flight.core.links.values()
    link.is_open = False
    for number in range(200):
        link.is_open = number >= 100
        flight.now += 100 * MS
        flight.core.poll(flight.now)
        assert event_texts(flight) == [] or number >= 150
    (text,) = event_texts(flight)
    assert "no autopilot in 5 s: no data received; check the wiring" in text


def test_silence_is_reported_again_when_something_else_arrives() -> None:
    flight = Flight(config=load(pairs=("link.system_id=5",), environment={}))
    for number in range(400):
        flight.now += 100 * MS
        if number >= 100:
            flight.receive(b"\x00\xff" * 8)
        if number >= 200:
            flight.send("HEARTBEAT", system=7, type=1, autopilot=3)
        flight.core.poll(flight.now)
    nothing, no_mavlink, other_vehicle = (text for text in event_texts(flight) if "no autopilot" in text)
    assert "no autopilot in 5 s: no data received" in nothing
    assert "no autopilot in 15 s: bytes but no MAVLink received" in no_mavlink
    assert "no autopilot in 25 s: received only 7/1" in other_vehicle


def test_silence_of_a_link_that_opens_later_is_reported() -> None:
    flight = Flight("udpin:127.0.0.1:14550", "serial:/dev/ttyS0:57600")
    serial = flight.core.links["serial:/dev/ttyS0:57600"]
    for number in range(200):
        serial.is_open = number >= 100
        flight.now += 100 * MS
        flight.core.poll(flight.now)
    network, line = event_texts(flight)
    assert network.startswith("udpin:127.0.0.1:14550: no autopilot in 5 s")
    assert line.startswith("serial:/dev/ttyS0:57600: no autopilot in 5 s")


@pytest.mark.parametrize(
    ("system_id", "kind", "advice"),
    [
        (0, {"type": 26, "autopilot": 8}, ""),
        (5, {"type": 1, "autopilot": 3}, "; link.system_id = 5 must be its system id, or 0 for any"),
    ],
)
def test_system_id_is_reported_where_it_excludes_an_autopilot(
    system_id: int, kind: dict[str, int], advice: str
) -> None:
    flight = Flight(config=load(pairs=(f"link.system_id={system_id}",), environment={}))
    for _ in range(60):
        flight.now += 100 * MS
        flight.send("HEARTBEAT", system=7, **kind)
        flight.core.poll(flight.now)
    expected = f"main: no autopilot in 5 s: received only 7/1; check the autopilot's connection{advice}"
    assert expected in event_texts(flight)


def test_input_that_stops_is_reported_once_and_again_when_it_is_back(monkeypatch: pytest.MonkeyPatch) -> None:
    flight = Flight()
    flight.fly(20.0)
    assert flight.core.status().missing == ()
    send = flight.send
    monkeypatch.setattr(flight, "send", lambda name, **values: name == "GPS_RAW_INT" or send(name, **values))
    flight.fly(30.0)
    assert flight.core.status().missing == ("GNSS",)
    monkeypatch.undo()
    flight.fly(20.0)
    texts = [text for text in event_texts(flight) if "GPS_RAW_INT" in text]
    assert texts == [
        "GNSS (GPS_RAW_INT) has stopped; check its sensor and the line",
        "GNSS (GPS_RAW_INT) arrives again at 5.0 Hz",
    ]


@pytest.mark.parametrize("after_s", [20.5, 21.5, 22.5, 23.5, 24.5])
def test_an_outage_of_five_seconds_is_no_slow_input(after_s: float, monkeypatch: pytest.MonkeyPatch) -> None:
    """Across two windows it left the rate of the second standing for 10 s: `is slow`, long after it."""
    flight = Flight()
    flight.fly(after_s)
    monkeypatch.setattr(flight, "send", lambda name, **values: None)
    flight.fly(4.8)
    monkeypatch.undo()
    flight.fly(30.0)
    assert not [text for text in event_texts(flight) if "GPS_RAW_INT" in text]
    assert flight.core.status().slow == ()


def test_slow_input_of_the_output_is_named_and_no_key_that_does_not_exist() -> None:
    flight = Flight(config=load(pairs=("output.profile=ardupilot",), environment={}))
    for _ in range(30):
        stamp = (flight.now - flight.boot) // MS
        flight.send("GLOBAL_POSITION_INT", time_boot_ms=stamp, lat=600_000_000, lon=300_000_000)
        flight.fly(1.0)
    assert [text for text in event_texts(flight) if "GLOBAL_POSITION_INT" in text] == [
        "EKF position (GLOBAL_POSITION_INT) is slow: 1.0 of 2 Hz; use a faster line"
    ]


def test_every_requested_stream_has_its_words() -> None:
    for via in ("odometry", "gps_input", "external_position"):
        config = load(pairs=("output.profile=ardupilot", f"output.via={via}"), environment={})
        assert requested_rates(config).keys() <= STREAMS.keys()


def test_input_that_never_arrives_is_reported_if_it_is_used() -> None:
    flight = Flight(config=Config())
    flight.fly(30.0)
    never = [text for text in event_texts(flight) if "never arrived" in text]
    assert any(text.startswith("attitude (ATTITUDE)") for text in never)
    assert not any("EKF_STATUS_REPORT" in text for text in never)
    assert "attitude" in flight.core.status().text()
