"""Autopilot output: checked positions, for the right make, and never the autopilot's own position."""

import math
import random
from collections import Counter
from collections.abc import Callable
from itertools import pairwise
from typing import Any

import msgspec
import numpy as np
import pytest

from companion.config import Config, ConfigError, InertialConfig, OutputConfig, load, parse
from companion.link import dialect, frame
from companion.link.fields import deg_e7
from companion.nav.geometry import Geodetic, displace, local_to_geodetic, slant_range_azimuth
from companion.navigator import Navigator
from companion.output.autopilot_output import DISPLAY_NAMES, AutopilotOutput
from companion.output.encode import CORRELATION_S, ENCODERS, Receiver
from companion.output.gnss_fusion import ESTIMATOR_SENSOR_ENABLE, GnssFusion
from companion.output.source_table import Situation
from companion.records import (
    AirData,
    Event,
    GlobalPosition,
    Gnss,
    LocalOrigin,
    RsbnFix,
    Solution,
    SystemTime,
    Trust,
    Truth,
)
from companion.runtime.core import CompanionCore
from companion.runtime.links import requested_rates
from tests.recordings import recording
from tests.solutions import solution_at

SECOND, MS = 1_000_000_000, 1_000_000
START = 5000 * SECOND
ORIGIN = Geodetic(math.radians(60.0), math.radians(30.0), 50.0)
BEACON = Geodetic(math.radians(60.05), math.radians(31.07), 80.0)
SPEED, HEIGHT, WIND_EAST = 30.0, 800.0, 4.0
UTC_S = 1_795_248_000
Frame = tuple[str, bytes]
OURS = {"target_system": 1, "target_component": 191}
HAS_FIX, LOST = "EKF source set 1: GNSS has a fix", "EKF source set 2: GNSS is lost, using companion"
AIRSPEED_SENSOR = {f"onboard_control_sensors_{name}": 16 for name in ("present", "enabled", "health")}


def configured(*pairs: str) -> Config:
    return load(pairs=pairs, environment={})


class EventLog:
    def __init__(self) -> None:
        self.events: list[Event] = []

    def record(self, record: Any, channel: str | None = None) -> None:
        if isinstance(record, Event):
            self.events.append(record)

    def frame(self, link: str, outgoing: bool, data: bytes, t_ns: int) -> None: ...


class Flight:
    """Flight with heading north in a west wind; `falsify` changes the messages of the autopilot.

    It sends on all of `links`; one that is taken out is cut.
    """

    def __init__(
        self,
        config: Config,
        autopilot: int = 3,
        falsify: Callable[[str, dict[str, Any]], None] = lambda name, values: None,
        links: tuple[str, ...] = ("main",),
    ) -> None:
        self.log, self.links = EventLog(), links
        self.core, self.falsify, self.autopilot = CompanionCore(config, self.log, links), falsify, autopilot
        self.now, self.ticks = START, 0
        self.gnss = self.rsbn = True
        self.armed = False
        self.source_set, self.answers = 1, True
        self.sent: list[tuple[float, Any]] = []
        self.payloads: list[Frame] = []
        self._sequence, self._reader = 0, frame.Reader()

    def send(self, name: str, /, **values: Any) -> None:
        self.falsify(name, values)
        self._sequence = self._sequence + 1 & 0xFF
        data = frame.encode(dialect.new(name, **values), self._sequence, 1, 1)
        for link in self.links:
            self.core.receive(link, data, self.now)
        self.collect()

    def collect(self) -> None:
        frames = {link: self.core.to_send(link, self.now) for link in self.core.links}
        for data in (each for link in self.links for each in frames[link]):
            for found in self._reader.receive(data):
                assert isinstance(found, frame.Frame)
                message = dialect.decode(found)
                self.sent.append((self.seconds, message))
                self.payloads.append((message.get_type(), found.payload))
                if message.get_type() == "COMMAND_LONG" and message.command == 42007 and self.answers:
                    self.source_set = int(message.param1)
                    self.send("COMMAND_ACK", command=42007, result=0, **OURS)

    @property
    def seconds(self) -> float:
        return (self.now - START) * 1e-9

    def place(self) -> Geodetic:
        x_n = np.array([SPEED * self.seconds, WIND_EAST * self.seconds, -HEIGHT])
        return local_to_geodetic("ardupilot", ORIGIN, x_n)

    def fly(self, seconds: float, gnss: bool | None = None) -> None:
        self.gnss = self.gnss if gnss is None else gnss
        for _ in range(round(10 * seconds)):
            self.now += 100 * MS
            self.ticks += 1
            self._tick(self.ticks)
            self.core.poll(self.now)
            self.collect()

    def _tick(self, tick: int) -> None:
        boot = {"time_boot_ms": (self.now - START) // MS + 30_000}
        place = self.place()
        here = {"lat": deg_e7(place.lat), "lon": deg_e7(place.lon)}
        if tick % 10 == 1:
            self.send("HEARTBEAT", type=1, autopilot=self.autopilot, base_mode=128 if self.armed else 0)
            self.send("SYS_STATUS", **AIRSPEED_SENSOR)
            self.send("SYSTEM_TIME", time_unix_usec=(UTC_S * 10**9 + self.now - START) // 1000, **boot)
        if tick % 50 == 2:
            lat, lon = deg_e7(ORIGIN.lat), deg_e7(ORIGIN.lon)
            self.send("GPS_GLOBAL_ORIGIN", latitude=lat, longitude=lon, altitude=round(ORIGIN.alt * 1e3))
        tremor = 1e-5 * (tick % 7)  # a constant attitude would be rejected as frozen
        self.send("ATTITUDE", roll=tremor, pitch=0.0, yaw=0.0, **boot)
        stamp = boot["time_boot_ms"] * 1000
        if self.autopilot == 3:
            self.send("RAW_IMU", time_usec=stamp, zacc=-1000)
        else:
            self.send("HIGHRES_IMU", time_usec=stamp, zacc=-9.80665, fields_updated=0x3F)
        self.send("SCALED_PRESSURE", press_abs=915.0, temperature=1500, **boot)
        indicated = SPEED * (915.0 / 1013.25) ** 0.404868 + tremor
        self.send("VFR_HUD", airspeed=indicated, groundspeed=SPEED, alt=place.alt, climb=0.0, heading=0)
        x, y = SPEED * self.seconds, WIND_EAST * self.seconds
        self.send("LOCAL_POSITION_NED", x=x, y=y, z=-HEIGHT, vx=SPEED, vy=WIND_EAST, vz=0.0, **boot)
        v = {"vx": round(100 * SPEED), "vy": round(100 * WIND_EAST)}
        self.send("GLOBAL_POSITION_INT", alt=round(place.alt * 1e3), hdg=0, **here, **v, **boot)
        self.send("WIND", direction=270.0, speed=WIND_EAST)
        if tick % 2:
            course = math.degrees(math.atan2(WIND_EAST, SPEED))
            self.send(
                "GPS_RAW_INT",
                time_usec=boot["time_boot_ms"] * 1000,
                fix_type=3 if self.gnss else 1,
                **here,
                alt=round(place.alt * 1e3),
                vel=round(100 * math.hypot(SPEED, WIND_EAST)),
                cog=round(100 * course),
                satellites_visible=14,
            )
        if tick % 10 == 5 and self.rsbn:
            true = slant_range_azimuth(BEACON, place)
            self.send(
                "RSBN_MEASUREMENT",
                time_usec=boot["time_boot_ms"] * 1000,
                beacon_lat=deg_e7(BEACON.lat),
                beacon_lon=deg_e7(BEACON.lon),
                beacon_alt=BEACON.alt,
                azimuth=true.azimuth,
                slant_range=true.slant_range,
                sigma_azimuth=0.002,
                sigma_range=100.0,
                beacon_id=1,
                status=3,
            )

    def sent_messages(self, name: str, after: float = 0.0) -> list[Any]:
        return [m for at, m in self.sent if m.get_type() == name and at >= after]

    def position_payloads(self) -> list[Frame]:
        return [each for each in self.payloads if each[0] in POSITION_MESSAGES]

    @property
    def texts(self) -> list[str]:
        return [event.text for event in self.log.events]


POSITION_MESSAGES = (
    "ODOMETRY",
    "VISION_POSITION_ESTIMATE",
    "GPS_INPUT",
    "GLOBAL_POSITION_SENSOR",
    "COMMAND_INT",
)
METHODS = [
    (3, "ardupilot", "odometry"),
    (3, "ardupilot", "vision"),
    (3, "ardupilot", "gps_input"),
    (3, "ardupilot", "external_position"),
    (12, "px4", "global_position_sensor"),
    (12, "px4", "odometry"),
    (12, "px4", "external_position"),
]


def falsify_position(name: str, values: dict[str, Any]) -> None:
    """Falsify the autopilot's own position, velocity, height and wind."""
    match name:
        case "LOCAL_POSITION_NED":
            x = values["x"] + 33.4  # as the global position: the origin follows from both
            values |= {"x": x, "z": 30.0, "vx": -7.0, "vy": 5.5, "vz": 9.0}
        case "GLOBAL_POSITION_INT":
            # within the drift limit of a position reset
            values |= {"lat": values["lat"] + 3000, "alt": 90_000, "vx": -700, "vy": 550, "relative_alt": 7}
        case "VFR_HUD":
            values |= {"groundspeed": 90.0, "alt": 77.0, "climb": -6.0, "heading": 123}
        case "WIND":
            values |= {"direction": 12.0, "speed": 25.0, "speed_z": 3.0}


@pytest.mark.flight
@pytest.mark.parametrize(
    "source", ["auto", *(pytest.param(s, marks=pytest.mark.long) for s in ("air_data", "imu"))]
)
@pytest.mark.parametrize(("autopilot", "profile", "via"), METHODS)
def test_autopilot_position_never_reaches_the_output(
    autopilot: int, profile: str, via: str, source: str
) -> None:
    """A correct and a falsified autopilot receive the same bytes."""
    config = configured(f"output.profile={profile}", f"output.via={via}", f"inertial.source={source}")
    honest, falsified = Flight(config, autopilot), Flight(config, autopilot, falsify_position)
    for flight in (honest, falsified):
        flight.fly(15.0)
        flight.fly(15.0, gnss=False)
    assert len(honest.position_payloads()) >= (6 if via == "external_position" else 50)
    assert falsified.position_payloads() == honest.position_payloads()


def test_falsified_position_reaches_the_output_of_an_independent_ins() -> None:
    """The test above can fail: with `inertial.independent` the output differs."""
    config = configured("output.profile=ardupilot", "inertial.independent=true")
    honest, falsified = Flight(config), Flight(config, falsify=falsify_position)
    for flight in (honest, falsified):
        flight.fly(8.0)
    assert honest.position_payloads() and falsified.position_payloads() != honest.position_payloads()


@pytest.mark.flight
@pytest.mark.parametrize("via", ["odometry", "vision"])
def test_forged_origin_moves_no_position(via: str) -> None:
    config = configured("output.profile=ardupilot", f"output.via={via}")

    def forge(name: str, values: dict[str, Any]) -> None:
        if name == "GPS_GLOBAL_ORIGIN" and forged.seconds > 10.0:
            values["latitude"] += 300_000  # 3.3 km

    honest, forged = Flight(config), Flight(config)
    forged.falsify = forge
    for flight in (honest, forged):
        flight.fly(40.0)
    assert len(honest.position_payloads()) > 200
    assert forged.position_payloads() == honest.position_payloads()
    assert any(text.startswith("GPS_GLOBAL_ORIGIN 33") and text.endswith("not used") for text in forged.texts)


def test_origin_that_moves_is_followed_with_a_reset() -> None:
    """The autopilot moves its origin by 111 m: its local coordinates and ours change by as much."""
    flight = Flight(configured("output.profile=ardupilot"))

    def move(name: str, values: dict[str, Any]) -> None:
        if flight.seconds > 20.0 and name == "GPS_GLOBAL_ORIGIN":
            values["latitude"] += 10_000
        elif flight.seconds > 20.0 and name == "LOCAL_POSITION_NED":
            values["x"] -= 111.3

    flight.falsify = move
    flight.fly(30.0)
    before = [m for at, m in flight.sent if m.get_type() == "ODOMETRY" and at < 20.0]
    after = flight.sent_messages("ODOMETRY", 25.0)
    assert {m.reset_counter for m in before} == {0} and {m.reset_counter for m in after} == {1}
    assert after[-1].x == pytest.approx(SPEED * flight.seconds - 111.3, abs=5.0)


def displaced(name: str, key: str, off_deg: float) -> Callable[[str, dict[str, Any]], None]:
    """Displace the latitude that one message states."""

    def move(sent: str, values: dict[str, Any]) -> None:
        if sent == name:
            values[key] += round(off_deg * 1e7)

    return move


def odometry(flight: Flight) -> list[tuple[float, float, int]]:
    """Time, error (m) and reset counter of each ODOMETRY."""
    sent = [(at, m) for at, m in flight.sent if m.get_type() == "ODOMETRY"]
    return [(at, math.hypot(m.x - SPEED * at, m.y - WIND_EAST * at), m.reset_counter) for at, m in sent]


@pytest.mark.flight
def test_an_autopilot_with_gnss_receives_nothing_of_a_beacon_22_km_off_and_gnss_once_it_is_used() -> None:
    """88 positions of the wrong place were sent, then none for 47 s, and ArduPlane did not arm."""
    flight = Flight(
        configured("output.profile=ardupilot"), falsify=displaced("RSBN_MEASUREMENT", "beacon_lat", 0.2)
    )
    flight.fly(1.5, gnss=False)
    flight.fly(14.0, gnss=True)
    sent = odometry(flight)
    assert all(at < 2.0 for at, error, _ in sent if error >= 20.0)
    assert 11.0 < next(at for at, error, _ in sent if error < 20.0) < 12.5
    assert flight.source_set == 1 and LOST not in flight.texts
    assert sum("m off the beacon's position: one of them is wrong" in text for text in flight.texts) == 1


def test_a_position_that_was_not_sent_holds_no_later_one_back() -> None:
    """The local origin was not known yet: a jump of 5 km was withheld for 22 s."""
    output, beacon = AutopilotOutput(configured("output.profile=ardupilot")), solution_at(START)
    gnss = solution_at(START + SECOND, lat=beacon.lat + math.radians(0.05))
    unknown, known = (
        Receiver("ardupilot", 1),
        Receiver("ardupilot", 1, origin=LocalOrigin(1, 1, 1.0, 0.5, 0.0)),
    )
    assert not output.messages(beacon, ["ODOMETRY"], unknown)
    assert [m.get_type() for m in output.messages(gnss, ["ODOMETRY"], known)] == ["ODOMETRY"]


def own_position_off(name: str, values: dict[str, Any]) -> None:
    if name == "GLOBAL_POSITION_INT":
        values["lat"] += 10_000  # 111 m


def test_an_ins_of_its_own_that_drifts_is_no_position_of_the_autopilot() -> None:
    config = configured(
        "output.profile=ardupilot", "inertial.source=local_position", "inertial.independent=true"
    )
    flight = Flight(config)
    flight.fly(20.0)
    flight.falsify = own_position_off
    flight.fly(30.0)
    assert flight.sent_messages("ODOMETRY", after=45.0)
    assert not any("own position" in text for text in flight.texts)


def test_an_autopilot_that_does_not_fly_by_the_gnss_in_use_is_reported_once() -> None:
    """Flown: two blended receivers, the second drawn off; the autopilot 110 m off, ours 1 m, no report."""
    flight = Flight(configured("output.profile=ardupilot"))
    flight.fly(20.0)
    flight.falsify = own_position_off
    flight.fly(9.0)
    assert not any("own position" in text for text in flight.texts)
    flight.fly(30.0)
    flight.falsify = lambda name, values: None
    flight.fly(20.0)
    far, near = (text for text in flight.texts if "own position" in text)
    assert far.startswith("autopilot's own position 11") and "it does not fly by the GNSS in use" in far
    assert near.startswith("autopilot's own position ") and near.endswith(" m off ours again")
    assert flight.source_set == 1


LIVED_BY = {"ardupilot": (3, "ODOMETRY"), "px4": (12, "GLOBAL_POSITION_SENSOR")}


@pytest.mark.flight
@pytest.mark.parametrize("profile", LIVED_BY)
@pytest.mark.parametrize("case", ["0.3 s", "4 s", "8 s", "no answer", "three times", "reported"])
def test_a_first_gnss_that_is_false_for_seconds_takes_no_autopilot_off_our_position(
    case: str, profile: str
) -> None:
    """It flies by a beacon. Where the position was withheld, set 1 was requested 2 s later, 22 km off."""
    autopilot, name = LIVED_BY[profile]
    flight = Flight(configured(f"output.profile={profile}"), autopilot)
    flight.armed, flight.answers = True, case != "no answer"
    flight.fly(20.0, gnss=False)
    flight.falsify = displaced("GPS_RAW_INT", "lat", 0.2)
    for _ in range(3 if case == "three times" else 1):
        if case == "reported":
            flight.send("GNSS_INTEGRITY", id=0, jamming_state=3, spoofing_state=3)
        flight.fly({"0.3 s": 0.3, "4 s": 4.0, "8 s": 8.0, "three times": 0.2}.get(case, 7.0), gnss=True)
        flight.fly(5.0, gnss=False)
    flight.fly(5.0)
    sent = [at for at, message in flight.sent if message.get_type() == name and at > 15.0]
    assert max(b - a for a, b in pairwise([15.0, *sent, flight.seconds])) < 1.2
    if profile == "ardupilot":
        assert max(error for at, error, _ in odometry(flight) if at > 15.0) < 300.0
        assert HAS_FIX not in flight.texts
        assert flight.source_set == 2 or case == "no answer"


@pytest.mark.parametrize("profile", LIVED_BY)
def test_a_disarmed_autopilot_gets_no_position_that_its_first_gnss_contradicts(profile: str) -> None:
    """Flown: PX4 on the ground beside a beacon 22 km off held that position for 17 s, armed and took off."""
    autopilot, name = LIVED_BY[profile]
    wrong_beacon = displaced("RSBN_MEASUREMENT", "beacon_lat", 0.2)
    flight = Flight(configured(f"output.profile={profile}"), autopilot, wrong_beacon)
    flight.fly(20.0, gnss=False)
    assert flight.sent_messages(name, after=15.0)
    flight.fly(9.0, gnss=True)
    assert flight.sent_messages(name, after=20.5) == []
    flight.fly(3.0)
    assert flight.sent_messages(name, after=31.0)
    assert f"{DISPLAY_NAMES.get(name, name)} withheld: GNSS contradicts it" in flight.texts


@pytest.mark.flight
def test_an_autopilot_on_our_position_returns_to_a_gnss_that_a_wrong_beacon_contradicted() -> None:
    flight = Flight(
        configured("output.profile=ardupilot"), falsify=displaced("RSBN_MEASUREMENT", "beacon_lat", 0.2)
    )
    flight.fly(20.0, gnss=False)
    assert flight.source_set == 2
    flight.fly(12.0, gnss=True)
    sent = odometry(flight)
    assert flight.source_set == 1
    assert sent[-1][1] < 20.0
    assert {resets for at, error, resets in sent if error < 20.0} == {1}


def test_core_rejects_a_configuration_with_feedback() -> None:
    config = Config(
        output=OutputConfig(profile="ardupilot"), inertial=InertialConfig(source="local_position")
    )
    with pytest.raises(ConfigError, match="its own position back"):
        CompanionCore(config, EventLog())


@pytest.mark.parametrize("msgid", [331, 102, 232, 296, 75])
def test_profile_monitor_rejects_requests_for_position_messages(msgid: int) -> None:
    flight = Flight(configured())
    flight.fly(3.0)
    flight.send("COMMAND_LONG", command=511, param1=msgid, param2=100_000, **OURS)
    values = {"param_id": "ODOMETRY_HZ", "param_value": 5.0, "param_type": 9}
    flight.send("PARAM_SET", **OURS, **values)
    denied = [m.result for m in flight.sent_messages("COMMAND_ACK")]
    flight.fly(5.0)
    assert denied == [3]
    assert [m.error for m in flight.sent_messages("PARAM_ERROR")] == [2]  # out of range
    assert flight.position_payloads() == []
    assert flight.sent_messages("NAVIGATION_STATUS")


def test_ground_station_can_lower_the_output_rate() -> None:
    flight = Flight(configured("output.profile=ardupilot"))
    flight.fly(10.0)
    values = {"param_id": "ODOMETRY_HZ", "param_value": 5.0, "param_type": 9}
    flight.send("PARAM_SET", **OURS, **values)
    start = flight.seconds
    flight.fly(10.0)
    assert len(flight.sent_messages("ODOMETRY", start)) == pytest.approx(50, abs=5)


@pytest.mark.parametrize(("profile", "autopilot"), [("px4", 3), ("ardupilot", 12)])
def test_autopilot_of_another_make_receives_no_position_and_no_command(profile: str, autopilot: int) -> None:
    flight = Flight(configured(f"output.profile={profile}"), autopilot)
    flight.fly(10.0)
    assert flight.position_payloads() == []
    assert not {42007, ESTIMATOR_SENSOR_ENABLE} & {m.command for m in flight.sent_messages("COMMAND_LONG")}
    assert sum(f"the autopilot is not {profile}" in text for text in flight.texts) == 1


def test_ardupilot_source_set_follows_gnss() -> None:
    flight = Flight(configured("output.profile=ardupilot"))
    flight.fly(20.0)
    assert flight.source_set == 1
    rates = Counter(m.get_type() for _, m in flight.sent)
    assert rates["ODOMETRY"] == pytest.approx(200, abs=25)
    flight.gnss = False
    lost = flight.seconds
    flight.fly(20.0)
    assert flight.source_set == 2
    switched = [at for at, m in flight.sent if m.get_type() == "COMMAND_LONG" and m.command == 42007]
    assert len(switched) == 2 and 2.0 <= switched[1] - lost <= 3.0  # 2 s without a fix
    error = [
        math.hypot(m.x - SPEED * at, m.y - WIND_EAST * at)
        for at, m in flight.sent
        if m.get_type() == "ODOMETRY"
    ]
    assert max(error[100:]) < 30.0
    flight.fly(10.0, gnss=True)
    assert flight.source_set == 1
    assert [t for t in flight.texts if "source set" in t] == [HAS_FIX, LOST, HAS_FIX]


def test_source_set_is_known_whichever_link_leads() -> None:
    """Each link had a switch of its own: the first one, back again, took set 2 to lead, where set 1 did."""

    def report(flight: Flight) -> None:  # of the script in deploy/ardupilot
        flight.send("NAMED_VALUE_FLOAT", name="EKFSRC", value=float(flight.source_set))

    flight = Flight(configured("output.profile=ardupilot"), links=("main", "radio"))
    for links, gnss, leading in (
        (("main", "radio"), True, 1),
        (("main", "radio"), False, 2),
        (("radio",), False, 2),
        (("radio",), True, 1),
        (("main", "radio"), False, 2),
        (("main", "radio"), True, 1),
    ):
        flight.links, flight.gnss = links, gnss
        for _ in range(8):
            flight.fly(1.0)
            report(flight)
        assert flight.source_set == leading, (links, gnss)
    assert [t for t in flight.texts if "source set" in t] == [HAS_FIX, *(LOST, HAS_FIX) * 2]


def test_source_switch_can_be_disabled() -> None:
    flight = Flight(configured("output.profile=ardupilot", "output.switch_sources=false"))
    flight.fly(8.0)
    flight.fly(8.0, gnss=False)
    assert not [m for m in flight.sent_messages("COMMAND_LONG") if m.command == 42007]
    assert flight.sent_messages("ODOMETRY")


def test_gnss_that_is_back_leads_again_after_our_positions_were_switched_off() -> None:
    """A ground station sets ODOMETRY_HZ to 0 on set 2: the autopilot stayed there, without a position."""
    flight = Flight(configured("output.profile=ardupilot"))
    flight.fly(10.0)
    flight.fly(10.0, gnss=False)
    assert flight.source_set == 2
    flight.send("PARAM_SET", **OURS, param_id="ODOMETRY_HZ", param_value=0.0, param_type=9)
    flight.fly(3.0)
    flight.fly(10.0, gnss=True)
    assert flight.source_set == 1
    flight.fly(10.0, gnss=False)
    assert flight.source_set == 1


def test_gnss_of_px4_is_on_after_our_positions_were_switched_off(monkeypatch: pytest.MonkeyPatch) -> None:
    """PX4 stores the state when it is disarmed: the next flight began without GNSS."""
    found = Situation(1e3, -1.0, 0.1, gnss_false=0.9999, witness=True, sent_s=1e3, stopped_s=0.0)
    monkeypatch.setattr(GnssFusion, "situation", lambda self, now_ns: found)
    output, receiver = AutopilotOutput(configured("output.profile=px4")), Receiver("px4", 1)
    assert [m.param3 for m in output.poll(receiver, START)] == [0.0]  # and its answer is lost
    output.tune(configured("output.profile=px4", "output.global_position_sensor_hz=0"))
    output.handle_message(dialect.new("HEARTBEAT", base_mode=0), True, 1, START)
    assert [m.param3 for m in output.poll(receiver, START + SECOND)] == [1.0]


@pytest.mark.parametrize("hz", [0.8, 0.2])
def test_source_set_follows_gnss_by_a_slow_output(hz: float) -> None:
    """A second between two positions was a gap: set 2 was never requested, and nothing reported."""
    flight = Flight(parse(f"[output]\nprofile = 'ardupilot'\nodometry_hz = {hz}", "an old log"))
    flight.fly(20.0)
    flight.fly(20.0, gnss=False)
    assert flight.source_set == 2
    flight.fly(10.0, gnss=True)
    assert flight.source_set == 1
    assert [t for t in flight.texts if "source set" in t] == [HAS_FIX, LOST, HAS_FIX]


@pytest.mark.parametrize("via", ["gps_input", "external_position"])
def test_source_set_is_the_pilots_where_none_carries_our_position(via: str) -> None:
    flight = Flight(configured("output.profile=ardupilot", f"output.via={via}"))
    flight.source_set = 3
    flight.fly(10.0)
    assert flight.source_set == 3


@pytest.mark.parametrize("pull", [0.0, 5.0])
def test_answers_that_claim_too_small_a_sigma_do_not_contradict_gnss(pull: float) -> None:
    """The floors of [rsbn] hold for the beacon's own word too; one that contradicts GNSS still counts."""
    output, rng = AutopilotOutput(configured("output.profile=ardupilot")), np.random.default_rng(1)
    origin = LocalOrigin(START, START, ORIGIN.lat, ORIGIN.lon, ORIGIN.alt, "ardupilot")
    receiver, sets = Receiver("ardupilot", 1, origin), list[float]()
    for second in range(180):
        now, is_doubted = START + second * SECOND, second >= 60
        place = displace(*ORIGIN, 0.0, SPEED * second, -HEIGHT)
        seen = displace(*place, pull * max(0, second - 60), 0.0, 0.0)
        output.receive(Gnss(now, now, 0, now // 1000, 3, *seen, v_n=(0.0, SPEED, 0.0)))
        true = slant_range_azimuth(BEACON, place)
        azimuth = true.azimuth + math.radians(0.125) * rng.standard_normal()
        away = true.slant_range + 100.0 * rng.standard_normal()
        output.receive(RsbnFix(now, now, 1, *BEACON, azimuth, away, math.radians(0.01), 10.0))
        for tick in range(10):
            at = {"lat": place.lat, "lon": place.lon, "alt_msl": place.alt, "v_n": (0.0, SPEED, 0.0)}
            false = 0.9995 if is_doubted else 0.0
            solution = solution_at(now + tick * SECOND // 10, gnss_false=false, witness=is_doubted, **at)
            output.messages(solution, ["ODOMETRY"], receiver)
            for command in output.poll(receiver, solution.rx_ns):
                sets.append(command.param1)
                output.handle_acknowledgement(command.command, 0, solution.rx_ns)
    assert sets == ([1.0, 2.0] if pull else [1.0])


def test_beacon_before_the_first_gnss_fix() -> None:
    flight = Flight(configured("output.profile=ardupilot"))
    flight.fly(10.0, gnss=False)
    flight.fly(10.0, gnss=True)
    assert "navigation fixed: azimuth and range fixes" in flight.texts
    assert "navigation fixed: gnss and azimuth and range fixes" in flight.texts
    assert flight.source_set == 1


def test_unanswered_source_switch_is_reported() -> None:
    flight = Flight(configured("output.profile=ardupilot"))
    flight.answers = False
    flight.fly(35.0)
    assert sum("switch it by hand" in text for text in flight.texts) == 1


def test_no_position_reset_while_the_autopilot_has_gps() -> None:
    flight = Flight(configured("output.profile=ardupilot", "output.via=external_position"))
    flight.fly(10.0)
    assert flight.sent_messages("COMMAND_INT") == []
    flight.fly(20.0, gnss=False)
    sent = flight.sent_messages("COMMAND_INT")
    assert 15 <= len(sent) <= 19  # 1 Hz, also after a beacon fix
    assert {m.command for m in sent} == {43003}
    assert sum("external position withheld: the autopilot has GPS" in text for text in flight.texts) == 1


def test_rate_of_position_resets_cannot_be_changed() -> None:
    flight = Flight(configured("output.profile=ardupilot", "output.via=external_position"))
    flight.fly(10.0)
    flight.fly(3.0, gnss=False)
    flight.send("COMMAND_LONG", command=511, param1=75, param2=50_000, **OURS)
    flight.fly(10.0)
    assert [m.result for m in flight.sent_messages("COMMAND_ACK")] == [3]
    at = [at for at, m in flight.sent if m.get_type() == "COMMAND_INT"]
    assert len(at) > 8 and min(np.diff(at)) >= 0.99


def test_gps_input_has_gps_time_and_velocity() -> None:
    flight = Flight(configured("output.profile=ardupilot", "output.via=gps_input"))
    flight.fly(15.0)
    m = flight.sent_messages("GPS_INPUT")[-1]
    assert (m.gps_id, m.fix_type, m.time_week) == (1, 3, 2445)
    assert m.time_week_ms == pytest.approx(547_218_000 + 1000 * flight.seconds, abs=2)
    assert (m.vn, m.ve) == pytest.approx((SPEED, WIND_EAST), abs=0.5)
    assert 0.05 < m.speed_accuracy < 1.0
    behind = displace(*flight.place(), -0.2 * SPEED, -0.2 * WIND_EAST, 0.0)
    assert (m.lat, m.lon) == pytest.approx((deg_e7(behind.lat), deg_e7(behind.lon)), abs=300)


def test_streams_are_requested_at_the_output_rate() -> None:
    fed = ("output.profile=ardupilot", "output.odometry_hz=20")
    assert requested_rates(configured("output.profile=ardupilot"))["ATTITUDE"] == 10.0
    assert requested_rates(configured(*fed))["ATTITUDE"] == 20.0
    assert requested_rates(configured(*fed))["SYS_STATUS"] == 1.0  # states whether airspeed is a sensor's
    for make, imu in (
        ("ardupilot", ["RAW_IMU"]),
        ("px4", ["HIGHRES_IMU"]),
        ("monitor", ["RAW_IMU", "HIGHRES_IMU"]),
    ):
        rates = requested_rates(configured(f"output.profile={make}"))
        assert {name: hz for name, hz in rates.items() if "IMU" in name} == dict.fromkeys(imu, 20.0)
    own = configured("output.profile=ardupilot", "output.odometry_hz=20", "inertial.independent=true")
    assert requested_rates(own)["LOCAL_POSITION_NED"] == 20.0
    assert "SYSTEM_TIME" in requested_rates(configured("output.profile=ardupilot", "output.via=gps_input"))
    assert "GLOBAL_POSITION_INT" in requested_rates(
        configured("output.profile=px4", "output.via=external_position")
    )


def at(seconds: float, **changes: Any) -> Solution:
    return solution_at(START + round(seconds * SECOND), **{"lat": ORIGIN.lat, "lon": ORIGIN.lon} | changes)


def test_odometry_beyond_ardupilots_accuracy_limit_is_sent() -> None:
    """A position worse than 100 m is better than none: sigma grows to 900 m."""
    receiver = Receiver("ardupilot", 1, origin=LocalOrigin(START, START, *ORIGIN, "ardupilot"))
    output = AutopilotOutput(configured("output.profile=ardupilot", "output.switch_sources=false"))
    for k in range(820):
        solution = at(0.1 * k, covariance=((80.0 + k) ** 2, 0.0, 0.0, (80.0 + k) ** 2, 0.0, 25.0))
        assert len(output.messages(solution, ["ODOMETRY"], receiver)) == 1
    assert [event.text for event in output.take_events()] == ["sending ODOMETRY"]


def recorded(name: str) -> list[Any]:
    """Read a recorded ArduPlane flight with a GNSS loss, reduced to 5 Hz.

    The cut has no SYS_STATUS; in the recording it calls the airspeed sensor healthy from 3 s on.
    """
    return [msgspec.structs.replace(r, sensed=True) if isinstance(r, AirData) else r for r in recording(name)]


@pytest.mark.flight
@pytest.mark.parametrize(
    "name", [pytest.param("plane_gps_loss", marks=pytest.mark.long), "plane_wind_change"]
)
def test_gate_passes_recorded_flights(name: str) -> None:
    """Recordings with a simulated beacon 60 km away after the GNSS loss, and none for one minute of it: only
    positions beyond ArduPilot's accuracy limit are withheld.
    """
    records = recorded(name)
    truths = [r for r in records if isinstance(r, Truth) and r.lat]
    loss = max(r.t_ns for r in records if isinstance(r, Gnss) and r.has_3d_fix)
    beacon = displace(truths[-1].lat, truths[-1].lon, 100.0, 45e3, -40e3, 0.0)
    config = configured("output.profile=ardupilot", "output.switch_sources=false")
    rng = np.random.default_rng(3)
    navigator, output = Navigator(config), AutopilotOutput(config)
    receiver = Receiver("ardupilot", 1, origin=LocalOrigin(1, 1, *ORIGIN, "ardupilot"))
    sent, next_ns = Counter[bool](), loss
    for record in records:
        given: list[Any] = []
        if not isinstance(record, Truth):
            given = navigator.handle(record)
        elif record.t_ns >= next_ns and not 120.0 < (record.t_ns - loss) * 1e-9 < 180.0:
            next_ns = record.t_ns + SECOND
            true = slant_range_azimuth(beacon, Geodetic(record.lat, record.lon, record.alt))
            a, d = rng.standard_normal(2)
            azimuth, away = true.azimuth + 0.00218 * a, true.slant_range + 100.0 * d
            at = record.t_ns, record.rx_ns
            given = navigator.handle(RsbnFix(*at, 7, *beacon, azimuth % math.tau, away, 0.00218, 100.0))
        for solution in given:
            if isinstance(solution, Solution):
                sent[bool(output.messages(solution, ["ODOMETRY"], receiver))] += 1
    reasons = {reason for _, reason in output.withheld}
    assert reasons <= {"accuracy worse than ArduPilot's limit of 100 m"}
    assert sent[True] > 1800 and sent[False] < 70


def test_px4_receives_an_accuracy_that_allows_for_the_rate() -> None:
    output, receiver = AutopilotOutput(configured("output.profile=px4")), Receiver("px4", 1)
    solution = at(0.0, covariance=(4e4, 0.0, 0.0, 4e4, 0.0, 25.0))
    (m,) = output.messages(solution, ["GLOBAL_POSITION_SENSOR"], receiver)
    assert m.eph == pytest.approx(200.0 * math.sqrt(2.0 * CORRELATION_S * 2.0))


@pytest.mark.parametrize(
    ("is_off", "doubt", "drawn_m", "is_plain"),
    [
        (True, 0.0, 61, True),
        (True, 0.0, 59, False),
        (False, 0.0, 61, False),
        (False, None, 61, False),
        (False, 0.5, 61, True),
        (False, 0.5, 59, False),
    ],
)
def test_px4_drawn_off_by_a_false_gnss_receives_sigma_as_it_is(
    is_off: bool, doubt: float | None, drawn_m: float, is_plain: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With the greater accuracy EKF2 averages for a minute; with this one it rejects ours and is reset."""
    found = Situation(1e3, -1.0, 0.1, gnss_false=0.9999, witness=is_off, sent_s=1e3, stopped_s=0.0)
    monkeypatch.setattr(GnssFusion, "situation", lambda self, now_ns: found)
    output, receiver = AutopilotOutput(configured("output.profile=px4")), Receiver("px4", 1)
    assert len(output.poll(receiver, START)) == is_off
    output.handle_acknowledgement(ESTIMATOR_SENSOR_ENABLE, 0, START)
    solution = at(1.0, covariance=(400.0, 0.0, 0.0, 400.0, 0.0, 25.0), gnss_false=doubt)
    drawn = displace(solution.lat, solution.lon, solution.alt_msl, 0.0, drawn_m, 0.0)
    output.receive(GlobalPosition(solution.t_ns, solution.t_ns, *drawn, (0.0, 0.0, 0.0), HEIGHT))
    (m,) = output.messages(solution, ["GLOBAL_POSITION_SENSOR"], receiver)
    assert m.eph == pytest.approx(20.0 if is_plain else 20.0 * math.sqrt(4.0 * CORRELATION_S))


def test_gnss_fusion_of_px4_is_switched_off_only_while_armed(monkeypatch: pytest.MonkeyPatch) -> None:
    found = Situation(1e3, -1.0, 0.1, gnss_false=0.9999, witness=True, sent_s=1e3, stopped_s=0.0)
    monkeypatch.setattr(GnssFusion, "situation", lambda self, now_ns: found)
    output, receiver = AutopilotOutput(configured("output.profile=px4")), Receiver("px4", 1)
    for k, (base_mode, enabled) in enumerate(((0, []), (128, [0.0]), (0, [1.0]))):
        output.handle_message(dialect.new("HEARTBEAT", base_mode=base_mode), True, 1, START)
        assert [m.param3 for m in output.poll(receiver, START + k * SECOND)] == enabled
        output.handle_acknowledgement(ESTIMATOR_SENSOR_ENABLE, 0, START + k * SECOND)


def test_gnss_fusion_of_px4_that_is_switched_off_before_the_flight_stays_off() -> None:
    flight = Flight(configured("output.profile=px4"), 12)
    for second in range(20):
        flight.fly(1.0)
        flight.send("ESTIMATOR_SENSOR_FUSION_STATUS", intended=[second < 5, 0, 0, 1, 1, 0, 1, 1, 0])
    commands = {m.command for m in flight.sent_messages("COMMAND_LONG")}
    assert flight.position_payloads() and ESTIMATOR_SENSOR_ENABLE not in commands
    assert flight.texts.count("GNSS fusion off selected by hand: the companion does not switch") == 1


@pytest.mark.parametrize("name", sorted(ENCODERS))
@pytest.mark.parametrize("trust", list(Trust))
def test_untrusted_positions_are_never_sent(name: str, trust: Trust) -> None:
    """The mode is "fixed" throughout, and the autopilot has no GPS."""
    origin = LocalOrigin(1, 1, *ORIGIN, "ardupilot")
    receiver = Receiver("ardupilot", 1, origin=origin, unix_ns=UTC_S * 10**9)
    output = AutopilotOutput(configured("output.profile=ardupilot", "output.switch_sources=false"))
    output.receive(Gnss(START, START, 0, 1, 1, *ORIGIN))
    output.receive(GlobalPosition(START, START, *ORIGIN, (0.0, 0.0, 0.0), HEIGHT))
    sent = output.messages(at(0.5, trust=trust, sigma_velocity=0.5), [name], receiver)
    assert [m.get_type() for m in sent] == ([] if trust is Trust.UNTRUSTED else [name])


def test_withheld_messages_are_counted_by_reason() -> None:
    output = AutopilotOutput(configured("output.profile=px4"))
    for k in range(5):
        assert (
            output.messages(at(0.1 * k, lat=math.nan), ["GLOBAL_POSITION_SENSOR"], Receiver("px4", 1)) == []
        )
    assert output.withheld == {("GLOBAL_POSITION_SENSOR", "position is not finite"): 5}
    assert [e.text for e in output.take_events()] == [
        "GLOBAL_POSITION_SENSOR withheld: position is not finite"
    ]


def test_reset_after_a_reboot_requires_a_new_gps_message() -> None:
    output, receiver = (
        AutopilotOutput(configured("output.profile=ardupilot", "output.via=external_position")),
        Receiver("ardupilot", 1),
    )
    output.receive(Gnss(START, START, 0, 1, 1, *ORIGIN))
    output.receive(SystemTime(START, START, 0, UTC_S * 10**9))
    output.handle_reboot()
    assert output.messages(at(10.0), ["COMMAND_INT"], receiver) == []
    assert "no GPS message" in output.take_events()[-1].text
    assert output.unix_ns == UTC_S * 10**9 - START  # the time of day remains valid


def test_a_link_that_loses_most_frames_is_no_silent_receiver() -> None:
    """GNSS is healthy, and our positions go on by the IMU and the beacon."""
    chance = random.Random(5)

    class LossyFlight(Flight):
        loss = 0.0

        def send(self, name: str, /, **values: Any) -> None:
            self._sequence += 1
            is_gnss = name == "GPS_RAW_INT" and self.loss > 0.0
            if not is_gnss and chance.random() >= self.loss:
                self._sequence -= 1
                super().send(name, **values)

    flight = LossyFlight(configured("output.profile=ardupilot"))
    flight.fly(15.0)
    flight.loss = 0.65
    sent = len(flight.sent_messages("ODOMETRY"))
    flight.fly(6.0)
    assert len(flight.sent_messages("ODOMETRY")) > sent + 15
    assert flight.source_set == 1
    flight.loss = 1e-9  # the others arrive: it is the receiver
    flight.fly(6.0)
    assert flight.source_set == 2
