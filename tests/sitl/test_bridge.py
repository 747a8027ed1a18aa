"""Bridge to a real autopilot's simulator, tested on a recorded autopilot."""

import itertools
import json
import lzma
import math
import re
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path
from types import SimpleNamespace

import pytest
from click.testing import CliRunner

from companion.analysis import simulated_rsbn
from companion.config import Config, load
from companion.importers import tlog
from companion.link import dialect, frame
from companion.link.dialect import mavlink
from companion.records import Event, RsbnFix, Solution, Truth
from companion.runtime.core import CompanionCore
from companion.storage import flight_log
from sitl import bridge_command, real_time
from sitl.beacon import Beacon
from sitl.bridge import AUTOPILOT, COMPANION, RSBN, Bridge, BridgeMode, GnssSchedule
from sitl.bridge_command import command
from sitl.comparison import outage_table
from sitl.tlog_player import NEVER, TlogPlayer
from tests.network import free_port

SECOND = 1_000_000_000
START = 1000 * SECOND
LOOPBACK = "127.0.0.1"
CUT = Path(__file__).parents[1] / "data" / "plane_wind_change_cut.tlog.xz"
SHARED = Path(__file__).parents[2].parent / "shared" / "data" / "autopilot_sitl"
EAST = Beacon(1, 55.75, 38.57, alt=200.0, drop_out=0.0)  # 60 km from the recorded flights
FED = load(flags={"output.profile": "ardupilot", "rates.imu_hz": 0.0}, environment={})


class RecordingLog:
    def __init__(self) -> None:
        self.records = []

    def record(self, record, channel=None) -> None:
        self.records.append(record)

    def frame(self, link, outgoing, data, t_ns) -> None: ...


@pytest.fixture(scope="module")
def entries(tmp_path_factory):
    path = tmp_path_factory.mktemp("cut") / "cut.tlog"
    path.write_bytes(lzma.decompress(CUT.read_bytes()))
    return list(tlog.read(path))


class BridgeFlight:
    """Player, bridge and companion connected in virtual time."""

    def __init__(self, entries, bridge: Bridge, config: Config = FED, part=(0.0, math.inf)) -> None:
        self.player, self.bridge = TlogPlayer(entries, START, *part), bridge
        self.log = RecordingLog()
        self.onboard = CompanionCore(config, self.log)
        self.reports, self.to_player, self.to_onboard, self.now = [], [], [], START
        while self.player.deadline() < NEVER:
            self.step()
            due = self.player.deadline(), bridge.deadline(), self.onboard.deadline()
            self.now = max(self.now + 1, min(due))

    def step(self) -> None:
        for data in self.player.poll(self.now):
            self.bridge.from_autopilot(data, self.now)
        self.bridge.poll(self.now)
        for data in self.bridge.to_companion():
            self.to_onboard.append(data)
            self.onboard.receive("main", data, self.now)
        if self.now >= self.onboard.deadline():
            self.onboard.poll(self.now)
        for data in self.onboard.to_send("main", self.now):
            self.bridge.from_companion(data, self.now)
        for data in self.bridge.to_autopilot():
            self.to_player.append(data)
            self.player.receive(data)
        self.reports += self.bridge.take_reports()

    def rows(self):
        (loss,) = self.bridge.outages
        rows = outage_table(self.bridge.comparison.errors, loss.lost_ns, loss.regained_ns or self.now)
        return {row.source: row for row in rows}


def frames(chunks) -> list[frame.Frame]:
    reader = frame.Reader()
    return [f for data in chunks for f in reader.receive(data) if isinstance(f, frame.Frame)]


def names(chunks) -> list[str]:
    return [dialect.TYPES[f.msgid].name for f in frames(chunks)]


def decoded(chunks) -> list:
    return [dialect.decode(f) for f in frames(chunks)]


@pytest.fixture(scope="module")
def relayed(entries) -> BridgeFlight:
    return BridgeFlight(entries, Bridge([EAST], unaided=True))


def test_autopilot_error_matches_the_recording(relayed) -> None:
    """Expected values computed from SIM_STATE and GLOBAL_POSITION_INT of the log."""
    row = relayed.rows()[AUTOPILOT]
    assert row.at[30] == pytest.approx(183.0, abs=3.0)
    assert row.at[60] == pytest.approx(384.0, abs=4.0)
    assert row.at[120] is None and row.at[180] is None
    assert row.within is None  # GLOBAL_POSITION_INT states no accuracy


def test_beacon_answers_once_a_second_with_stated_accuracy(relayed) -> None:
    fixes = [r for r in relayed.log.records if isinstance(r, RsbnFix)]
    assert len(fixes) == pytest.approx(84, abs=2)
    assert min(b.t_ns - a.t_ns for a, b in itertools.pairwise(fixes)) > 0.75 * SECOND
    latency = [(r.rx_ns - r.t_ns) * 1e-9 for r in fixes]
    assert max(latency) < 0.25 and min(latency) > 0.1
    row = relayed.rows()[RSBN]
    sigma = math.hypot(100.0, math.radians(0.125) * 60e3)
    assert 0.7 * sigma < row.rms < 1.3 * sigma


@pytest.mark.parametrize(("lat_deg", "scored"), [(0.0003, False), (55.75, True)])
def test_an_autopilot_without_a_position_is_not_scored(lat_deg: float, scored: bool) -> None:
    """ArduPilot states metres from 0 N 0 E before its first position: 6891 km r.m.s. in the table."""
    bridge = Bridge()
    for k in range(1, 20):
        now = START + k * SECOND // 5
        stamp, deg = k * 200, round(1e7 * lat_deg)
        sent = [
            dialect.new("HEARTBEAT", type=1, autopilot=mavlink.MAV_AUTOPILOT_ARDUPILOTMEGA),
            dialect.new("SIM_STATE", lat=55.75, lon=1e-4, lat_int=557_500_000, lon_int=1000),
            dialect.new("GLOBAL_POSITION_INT", time_boot_ms=stamp, lat=deg, lon=1000, alt=100_000),
        ]
        for n, message in enumerate(sent):
            bridge.from_autopilot(frame.encode(message, (3 * k + n) % 256, 1, 1), now)
        bridge.poll(now)
    assert any(error.source == AUTOPILOT for error in bridge.comparison.errors) == scored


def test_a_simulator_that_stood_still_does_not_shift_the_errors() -> None:
    """Its clock is late by 0.8 s from then on; by arrivals alone, companion errors at 20 m/s grow by 16 m."""
    bridge, speed, replies, sequence = Bridge(), 20e7 / 111_320.0, [], itertools.count()
    for k in range(1, 300):
        now = START + k * SECOND // 10
        if 150 <= k < 158:
            continue  # stands still
        boot = k * 100 - (800 if k >= 158 else 0)
        north = round(557_500_000 + speed * boot / 1000)
        sent = [
            dialect.new("HEARTBEAT", type=1, autopilot=mavlink.MAV_AUTOPILOT_ARDUPILOTMEGA),
            dialect.new("GLOBAL_POSITION_INT", time_boot_ms=boot, lat=north, lon=1000, alt=100_000),
            dialect.new("SIM_STATE", lat=55.75, lon=1e-4, lat_int=north, lon_int=1000),
            *(dialect.new("TIMESYNC", tc1=boot * 1_000_000, ts1=ts1) for ts1 in replies),
        ]
        for message in sent:
            bridge.from_autopilot(frame.encode(message, next(sequence) % 256, 1, 1), now)
        estimate = dialect.new(
            "GLOBAL_POSITION_SENSOR", time_usec=now // 1000, lat=north, lon=1000, alt=100.0, eph=5.0
        )
        bridge.from_companion(frame.encode(estimate, k % 256, 1, 191), now)
        bridge.poll(now)
        replies = [m.ts1 for m in decoded(bridge.to_autopilot()) if m.get_type() == "TIMESYNC" and not m.tc1]
    late = [e for e in bridge.comparison.errors if e.source == COMPANION and e.t_ns > START + 20 * SECOND]
    assert len(late) > 50 and max(math.hypot(e.north, e.east) for e in late) < 2.0  # a round trip: 0.1 s


def test_unaided_scores_companion_positions_without_relaying_them(relayed) -> None:
    row = relayed.rows()[COMPANION]
    assert row.samples > 350 and row.within is not None
    assert row.at[60] < 0.5 * relayed.rows()[AUTOPILOT].at[60]
    assert "ODOMETRY" not in names(relayed.to_player)
    assert "NAVIGATION_STATUS" in names(relayed.to_player)  # other messages are relayed
    assert {"COMMAND_LONG", "HEARTBEAT"} <= set(names(relayed.to_player))


def test_bridge_errors_agree_with_the_companion_log(relayed) -> None:
    solutions = [r for r in relayed.log.records if isinstance(r, Solution)]
    truths = [r for r in relayed.log.records if isinstance(r, Truth)]
    assert len(truths) > 300  # the truth is relayed: the companion's log can be scored
    last = solutions[-1]
    near = min(truths, key=lambda truth: abs(truth.t_ns - last.t_ns))
    scored = [s for s in relayed.bridge.comparison.errors if s.source == COMPANION][-1]
    north, east = (last.lat - near.lat) * 6.36e6, (last.lon - near.lon) * 6.39e6 * math.cos(near.lat)
    assert math.hypot(north - scored.north, east - scored.east) < 8.0  # 0.2 s at 20 m/s, and the latency


def test_gnss_is_accepted_although_a_beacon_fix_came_first(relayed) -> None:
    """A channel initialised at a beacon fix has the error of that fix."""
    rejected = [r for r in relayed.log.records if type(r).__name__ == "Rejection" and r.source == "gnss 0"]
    assert not rejected


def test_wind_jump_does_not_exclude_the_beacon(relayed) -> None:
    events = [r.text for r in relayed.log.records if isinstance(r, Event)]
    assert not [text for text in events if "excluded" in text]


def test_events_are_reported(relayed) -> None:
    text = "\n".join(relayed.reports)
    for part in (
        "connected to autopilot 1 (ardupilot)",
        "receiving the simulator's truth",
        "receiving positions from the companion",
        "the receiver lost its fix",
        "30 s after the loss, errors: autopilot 183 m, companion",
    ):
        assert part in text


def test_beacon_out_of_reach_is_reported(entries, relayed) -> None:
    exchanged = Beacon(1, EAST.lon_deg, EAST.lat_deg, alt=200.0)
    flight = BridgeFlight(entries[:300], Bridge([exchanged]))
    (text,) = [text for text in flight.reports if "beacon" in text]
    assert text.startswith("no beacon answers here: the nearest, 1 at 38.57, 55.75 deg and 200 m, is 2")
    assert not [text for text in relayed.reports if "beacon" in text]


def test_positions_are_relayed_by_default(entries) -> None:
    flight = BridgeFlight(entries[: len(entries) // 4], Bridge([EAST]))
    assert "ODOMETRY" in names(flight.to_player)


def test_only_the_truth_that_the_autopilot_has_is_requested(relayed) -> None:
    """ArduPilot reports each request for a message that it does not have on every ground station."""
    assert "SIM_STATE" in requested(relayed)
    assert "HIL_STATE_QUATERNION" not in requested(relayed)


def requested(flight: BridgeFlight) -> set[str]:
    return {
        dialect.TYPES[round(message.param1)].name
        for message in decoded(flight.to_player)
        if message.get_type() == "COMMAND_LONG" and message.command == mavlink.MAV_CMD_SET_MESSAGE_INTERVAL
    }


def test_beside_a_companion_it_requests_what_it_needs_itself(entries) -> None:
    """Without GPS_RAW_INT it reported GNSS as available throughout an outage."""
    flight = BridgeFlight(entries[: len(entries) // 4], Bridge([EAST], mode=BridgeMode.BESIDE))
    assert {"GPS_RAW_INT", "GLOBAL_POSITION_INT", "SIM_STATE"} <= requested(flight)


def test_beside_mode_sends_only_untimed_answers(entries) -> None:
    flight = BridgeFlight(entries[: len(entries) // 4], Bridge([EAST], mode=BridgeMode.BESIDE))
    assert set(names(flight.to_onboard)) == {"RSBN_MEASUREMENT"}
    fixes = [r for r in flight.log.records if isinstance(r, RsbnFix)]
    assert fixes and all(r.t_ns == r.rx_ns for r in fixes)
    assert "NAVIGATION_STATUS" not in names(flight.to_player)


def test_same_mode_sends_answers_to_the_router(entries) -> None:
    flight = BridgeFlight(entries[: len(entries) // 4], Bridge([EAST], mode=BridgeMode.SAME))
    assert "RSBN_MEASUREMENT" in names(flight.to_player)
    assert not flight.to_onboard


def test_missing_gnss_parameter_of_a_recording_is_reported(entries) -> None:
    flight = BridgeFlight(entries[: len(entries) // 4], Bridge(schedule=GnssSchedule(gnss_off_s=2.0)))
    assert any("or similar parameter: GNSS cannot be switched" in line for line in flight.reports)


def test_split_bytes_are_relayed_as_whole_frames(entries) -> None:
    stream = b"".join(e.frame.raw for e in entries[:200])
    whole, cut = Bridge(), Bridge()
    whole.from_autopilot(stream, START)
    for at in range(0, len(stream), 7):
        cut.from_autopilot(stream[at : at + 7], START)
    sent = whole.to_companion()
    assert cut.to_companion() == sent and b"".join(sent) == stream


@pytest.mark.flight
@pytest.mark.shared
@pytest.mark.parametrize(
    ("log", "part", "profile", "expected"),
    [
        pytest.param(
            "plane_wind_change",
            (195.0, 400.0),
            "ardupilot",
            {60: 387.0, 120: 794.0, 180: 1206.0},
            marks=pytest.mark.long,
        ),
        ("plane_gps_loss", (130.0, 285.0), "ardupilot", {30: 2.0, 60: 6.0, 120: 27.0}),
        ("px4_global_position_sensor", (45.0, 130.0), "px4", {30: 12.0, 60: 25.0}),
    ],
)
def test_table_of_a_recorded_flight(log: str, part, profile: str, expected) -> None:
    path = SHARED / f"{log}.tlog"
    if not path.exists():
        pytest.skip(f"{path} is not there")
    config = load(flags={"output.profile": profile, "rates.imu_hz": 0.0}, environment={})
    flight = BridgeFlight(list(tlog.read(path)), Bridge([EAST], unaided=True), config, part)
    rows = flight.rows()
    for seconds, error in expected.items():
        assert rows[AUTOPILOT].at[seconds] == pytest.approx(error, abs=4.0)
    assert rows[COMPANION].rms < 0.5 * rows[RSBN].rms
    assert not [r for r in flight.log.records if isinstance(r, Event) and "excluded" in r.text]
    assert rows[COMPANION].samples > 100


LOST = "the receiver lost its fix"


def are_scored(errors: Path, reported: Path) -> bool:
    """Whether the errors of all three are known after the loss, twenty of the companion."""
    loss = next((line for line in reported.read_text().splitlines() if LOST in line), None)
    if loss is None:
        return False
    (path,) = errors.iterdir()
    rows = [line.split(",")[:2] for line in path.read_text().splitlines()[1:-1]]
    later = [row[1] for row in rows if float(row[0]) > float(loss.split()[0]) + 5.0]
    return later.count(COMPANION) > 20 and {AUTOPILOT, RSBN} <= set(later)


def test_three_processes_over_tcp_and_udp(entries, tmp_path: Path) -> None:
    """Recorded autopilot over TCP, bridge, and companion with log, until there are errors after the loss."""
    log, errors, logs = tmp_path / "cut.tlog", tmp_path / "errors", tmp_path / "logs"
    log.write_bytes(lzma.decompress(CUT.read_bytes()))
    tcp, udp = free_port(), free_port()
    python = [sys.executable, "-m", "companion"]
    play = [*python, "sitl", "play", str(log), "--from", "16", "--connect", f"tcpin:{LOOPBACK}:{tcp}"]
    flight = [*python, "run", "--connect", f"udpin:{LOOPBACK}:{udp}", "--logs", str(logs)]
    flight += ["--set", "output.profile=ardupilot"]
    bridge = [*python, "sitl", "bridge", "--connect", f"tcp:{LOOPBACK}:{tcp}", "--json", "--seconds", "60"]
    bridge += ["--companion", f"udpout:{LOOPBACK}:{udp}", "--beacon", "55.75,38.57,200", "--log", str(errors)]
    with (
        subprocess.Popen(play, stderr=subprocess.DEVNULL) as autopilot,
        subprocess.Popen(flight, stderr=subprocess.DEVNULL) as companion,
    ):
        deadline = time.monotonic() + 60.0
        while not list(logs.glob("*")) and time.monotonic() < deadline:
            time.sleep(0.1)
        with (
            (tmp_path / "shown").open("w") as shown,
            (tmp_path / "reported").open("w") as reported,
            subprocess.Popen(bridge, stdout=shown, stderr=reported) as relaying,
        ):
            while relaying.poll() is None and not are_scored(errors, tmp_path / "reported"):
                time.sleep(0.1)
            relaying.send_signal(signal.SIGINT)
            assert relaying.wait(60) == 0, (tmp_path / "reported").read_text()
        for process in (companion, autopilot):
            process.send_signal(signal.SIGINT)
            assert process.wait(60) == 0
    found = json.loads((tmp_path / "shown").read_text())
    (lost,) = found["tables"]
    assert "GNSS lost at" in lost["title"]
    rows = {row["source"]: row for row in lost["rows"]}
    assert set(rows) == {AUTOPILOT, COMPANION, RSBN}
    assert LOST in (tmp_path / "reported").read_text()
    lines = Path(found["errors"]).read_text().splitlines()
    assert lines[0].startswith("t_s,source,north_m,east_m,error_m,sigma_m,bound_m,true_lat_deg")
    assert sum(COMPANION in line for line in lines) > 20
    (flown,) = logs.iterdir()
    kinds = {type(entry.value) for entry in flight_log.read(flown)}
    assert {Solution, RsbnFix, Truth} <= kinds


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--beacon", "55.75"], "write it as LAT,LON"),
        (["--beacon", "99,10"], "latitude 99: give -90 to 90 deg"),
        (["--beacon", "10,-190"], "longitude -190: give -180 to 180 deg"),
        (["--beacon", "10,10,1e300"], "height 1e+300: give -100000 to 100000 m"),
        (["--connect", "nonsense"], "is not a connection string"),
        (["--gnss-on-after", "5"], "give --gnss-off-after"),
        (["--gnss-off-after", "60", "--seconds", "60"], "--gnss-off-after 60 has no effect: the run ends"),
        (
            ["--gnss-off-after", "5", "--gnss-on-after", "90", "--seconds", "60"],
            "--gnss-on-after 90 has no effect: the run ends after --seconds 60: give a smaller number",
        ),
        (["--unaided"], "give --companion"),
    ],
)
def test_invalid_options_are_reported(arguments, words) -> None:
    done = CliRunner().invoke(command, arguments)
    assert done.exit_code == 2 and words in done.output.replace("\n", " ")


def test_exit_codes_of_busy_address_and_unwritable_folder(tmp_path: Path) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as taken:
        taken.bind((LOOPBACK, 0))
        done = CliRunner().invoke(command, ["--connect", f"udpin:{LOOPBACK}:{taken.getsockname()[1]}"])
    assert done.exit_code == 69 and "cannot listen on" in done.output
    (tmp_path / "file").touch()
    done = CliRunner().invoke(command, ["--log", str(tmp_path / "file")])
    assert done.exit_code == 73 and "cannot be written: it is a file; give a folder" in done.output


def test_invalid_beacon_file_is_reported(tmp_path: Path) -> None:
    path = tmp_path / "beacons.csv"
    path.write_text("a,b\n1,2\n")
    done = CliRunner().invoke(command, ["--beacons", str(path)])
    assert done.exit_code == 1 and "it needs the columns id, lat_deg" in done.output


@pytest.mark.parametrize("height", [0.0, 20.0, 200.0, 900.0])
def test_bridge_and_replay_use_the_same_radio_horizon(height: float, tmp_path) -> None:
    listed = tmp_path / "beacons.csv"
    listed.write_text(f"id,lat_deg,lon_deg,alt_m\n1,55.75,38.57,{height}\n")
    typed, read = bridge_command._parse_beacons((f"55.75,38.57,{height}",), listed)
    assert typed.ground_alt == read.ground_alt == simulated_rsbn.GROUND


def test_seconds_count_from_the_first_message_of_the_autopilot(monkeypatch: pytest.MonkeyPatch) -> None:
    """Regression: the run and its lines counted from the start of the bridge, GNSS off from the message."""
    now = START
    clock = SimpleNamespace(monotonic_ns=lambda: now)
    monkeypatch.setattr(bridge_command, "time", clock)
    monkeypatch.setattr(real_time, "time", clock)
    shown: list[tuple[float, str]] = []
    bridge = Bridge(schedule=GnssSchedule(9.0))
    address = bridge_command.parse_address("tcp:127.0.0.1:5760")
    run = bridge_command.BridgeRunner(
        bridge, (address,), lambda t, text: shown.append((t, text)), print, 10.0
    )
    steps = run._steps()
    next(steps)
    now += 8 * SECOND
    heartbeat = dialect.new("HEARTBEAT", type=mavlink.MAV_TYPE_FIXED_WING, autopilot=3)
    run._receive(0, frame.encode(heartbeat, 0, 1, 1))
    next(steps)
    now += 9 * SECOND
    assert next(steps) <= 1.0
    assert shown[0] == (0.0, "connected to autopilot 1 (ardupilot)")
    assert (9.0, "switching GNSS off") in shown
    now += SECOND
    assert next(steps, None) is None


def test_each_beacon_has_a_number_of_its_own_that_fits_the_message(tmp_path: Path) -> None:
    """Regression: ids of OurAirports are beyond 65535, where the bridge ended; typed ones began at 1 too."""
    path = tmp_path / "navaids.csv"
    rows = "90000,VOR-DME,55.8,38.5,100", "1,VOR-DME,55.9,38.4,100"
    path.write_text("\n".join(("id,type,latitude_deg,longitude_deg,elevation_ft", *rows)))
    beacons = bridge_command._parse_beacons(("55.75,38.57",), path)
    assert [(b.number, b.lat_deg) for b in beacons] == [
        (2, 55.75),
        (3, pytest.approx(55.8)),
        (1, pytest.approx(55.9)),
    ]


def test_missing_autopilot_is_reported() -> None:
    link = f"udpin:{LOOPBACK}:{free_port()}"
    done = CliRunner().invoke(command, ["--connect", link, "--seconds", "1"])
    assert done.exit_code == 69
    assert re.search(rf"companion: no autopilot on {link} in \d+ s", done.stderr)
    assert not done.stdout
