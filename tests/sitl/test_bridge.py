"""The bridge to a real autopilot's simulator: on a recorded one, and on a simulated one that obeys."""

import itertools
import json
import lzma
import math
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path

import pytest
from click.testing import CliRunner

from companion.analysis import simulated_rsbn
from companion.config import Config, load
from companion.importers import tlog
from companion.link import dialect, frame
from companion.records import Event, RsbnFix, Solution, Truth
from companion.runtime.core import Onboard
from companion.storage import flight_log
from sitl import bridge_command
from sitl.beacon import Beacon
from sitl.bridge import AUTOPILOT, COMPANION, RSBN, Bridge, Orders, Way
from sitl.bridge_command import command
from sitl.comparison import table
from sitl.tlog_player import NEVER, Player

SECOND = 1_000_000_000
START = 1000 * SECOND
LOOPBACK = "127.0.0.1"
CUT = Path(__file__).parents[1] / "data" / "plane_wind_change_cut.tlog.xz"
SHARED = Path(__file__).parents[2].parent / "shared" / "data" / "autopilot_sitl"
EAST = Beacon(1, 55.75, 38.57, alt=200.0, drop_out=0.0)  # 60 km from where the recorded flights are
FED = load(flags={"output.profile": "ardupilot", "rates.imu_hz": 0.0}, environment={})


class Silent:
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


class Run:
    """A player, a bridge and a companion joined in virtual time."""

    def __init__(self, entries, bridge: Bridge, config: Config = FED, part=(0.0, math.inf)) -> None:
        self.player, self.bridge = Player(entries, START, *part), bridge
        self.log = Silent()
        self.onboard = Onboard(config, self.log)
        self.told, self.to_player, self.to_onboard, self.now = [], [], [], START
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
        self.told += self.bridge.take_told()

    def rows(self):
        (loss,) = self.bridge.losses
        rows = table(self.bridge.comparison.scored, loss.lost_ns, loss.back_ns or self.now)
        return {row.source: row for row in rows}


def names(chunks) -> list[str]:
    reader = frame.Reader()
    return [
        dialect.TYPES[f.msgid].name
        for data in chunks
        for f in reader.receive(data)
        if isinstance(f, frame.Frame)
    ]


@pytest.fixture(scope="module")
def relayed(entries) -> Run:
    return Run(entries, Bridge([EAST], unaided=True))


def test_the_autopilot_s_own_error_is_that_of_the_recording(relayed) -> None:
    """Against the log read directly: SIM_STATE and GLOBAL_POSITION_INT, whichever came last."""
    row = relayed.rows()[AUTOPILOT]
    assert row.at[30] == pytest.approx(183.0, abs=3.0)
    assert row.at[60] == pytest.approx(384.0, abs=4.0)
    assert row.at[120] is None and row.at[180] is None
    assert row.within is None  # GLOBAL_POSITION_INT states no accuracy


def test_the_beacon_is_heard_once_a_second_and_is_as_good_as_stated(relayed) -> None:
    fixes = [r for r in relayed.log.records if isinstance(r, RsbnFix)]
    assert len(fixes) == pytest.approx(84, abs=2)
    assert min(b.t_ns - a.t_ns for a, b in itertools.pairwise(fixes)) > 0.75 * SECOND
    latency = [(r.rx_ns - r.t_ns) * 1e-9 for r in fixes]
    assert max(latency) < 0.25 and min(latency) > 0.1
    row = relayed.rows()[RSBN]
    sigma = math.hypot(100.0, math.radians(0.125) * 60e3)
    assert 0.7 * sigma < row.rms < 1.3 * sigma


def test_the_companion_is_heard_and_kept_from_the_autopilot(relayed) -> None:
    row = relayed.rows()[COMPANION]
    assert row.samples > 350 and row.within is not None
    assert row.at[60] < 0.5 * relayed.rows()[AUTOPILOT].at[60]
    assert "ODOMETRY" not in names(relayed.to_player)
    assert "NAVIGATION_STATUS" in names(relayed.to_player)  # all else goes on
    assert {"COMMAND_LONG", "HEARTBEAT"} <= set(names(relayed.to_player))


def test_what_the_bridge_scores_is_what_the_companion_s_own_log_says(relayed) -> None:
    solutions = [r for r in relayed.log.records if isinstance(r, Solution)]
    truths = [r for r in relayed.log.records if isinstance(r, Truth)]
    assert len(truths) > 300  # the truth is relayed, so the companion's own log can be scored too
    last = solutions[-1]
    near = min(truths, key=lambda truth: abs(truth.t_ns - last.t_ns))
    scored = [s for s in relayed.bridge.comparison.scored if s.source == COMPANION][-1]
    north, east = (last.lat - near.lat) * 6.36e6, (last.lon - near.lon) * 6.39e6 * math.cos(near.lat)
    assert math.hypot(north - scored.north, east - scored.east) < 8.0  # 0.2 s at 20 m/s, and the lag


def test_gnss_is_believed_from_the_start_though_a_beacon_was_first(relayed) -> None:
    """A channel that begins at a beacon's fix is as far off as the fix."""
    rejected = [r for r in relayed.log.records if type(r).__name__ == "Rejection" and r.source == "gnss 0"]
    assert not rejected


def test_a_wind_that_jumps_is_no_fault_of_the_beacon(relayed) -> None:
    said = [r.text for r in relayed.log.records if isinstance(r, Event)]
    assert not [text for text in said if "excluded" in text]


def test_it_tells_what_happens(relayed) -> None:
    said = "\n".join(relayed.told)
    for part in (
        "autopilot 1 is heard (ardupilot)",
        "truth is heard",
        "positions come from the companion",
        "the receiver lost its fix",
        "30 s after the loss, off by: autopilot 183 m, companion",
    ):
        assert part in said


def test_unless_it_is_told_to_withhold_them_positions_go_on(entries) -> None:
    run = Run(entries[: len(entries) // 4], Bridge([EAST]))
    assert "ODOMETRY" in names(run.to_player)


def test_beside_a_link_of_its_own_the_companion_gets_answers_alone_and_untimed(entries) -> None:
    run = Run(entries[: len(entries) // 4], Bridge([EAST], way=Way.BESIDE))
    assert set(names(run.to_onboard)) == {"RSBN_MEASUREMENT"}
    fixes = [r for r in run.log.records if isinstance(r, RsbnFix)]
    assert fixes and all(r.t_ns == r.rx_ns for r in fixes)
    assert "NAVIGATION_STATUS" not in names(run.to_player)


def test_on_one_link_the_answers_go_to_the_router(entries) -> None:
    run = Run(entries[: len(entries) // 4], Bridge([EAST], way=Way.SAME))
    assert "RSBN_MEASUREMENT" in names(run.to_player)
    assert not run.to_onboard


def test_a_recording_has_no_such_parameter_and_that_is_told(entries) -> None:
    run = Run(entries[: len(entries) // 4], Bridge(orders=Orders(gnss_off_s=2.0)))
    assert any("nor one like it: GNSS cannot be switched" in line for line in run.told)


def test_bytes_cut_anywhere_are_relayed_as_whole_frames(entries) -> None:
    stream = b"".join(e.frame.raw for e in entries[:200])
    whole, cut = Bridge(), Bridge()
    whole.from_autopilot(stream, START)
    for at in range(0, len(stream), 7):
        cut.from_autopilot(stream[at : at + 7], START)
    sent = whole.to_companion()
    assert cut.to_companion() == sent and b"".join(sent) == stream


@pytest.mark.shared
@pytest.mark.parametrize(
    ("log", "part", "profile", "expected"),
    [
        ("plane_wind_change", (195.0, 400.0), "ardupilot", {60: 387.0, 120: 794.0, 180: 1206.0}),
        ("plane_gps_loss", (130.0, 285.0), "ardupilot", {30: 2.0, 60: 6.0, 120: 27.0}),
        ("px4_global_position_sensor", (45.0, 130.0), "px4", {30: 12.0, 60: 25.0}),
    ],
)
def test_the_table_of_a_recorded_flight(log: str, part, profile: str, expected) -> None:
    path = SHARED / f"{log}.tlog"
    if not path.exists():
        pytest.skip(f"{path} is not there")
    config = load(flags={"output.profile": profile, "rates.imu_hz": 0.0}, environment={})
    run = Run(list(tlog.read(path)), Bridge([EAST], unaided=True), config, part)
    rows = run.rows()
    for seconds, error in expected.items():
        assert rows[AUTOPILOT].at[seconds] == pytest.approx(error, abs=4.0)
    assert rows[COMPANION].rms < 0.5 * rows[RSBN].rms
    assert not [r for r in run.log.records if isinstance(r, Event) and "excluded" in r.text]
    assert rows[COMPANION].samples > 100


def port_of(kind: int) -> int:
    with socket.socket(socket.AF_INET, kind) as sock:
        sock.bind((LOOPBACK, 0))
        return sock.getsockname()[1]


def test_three_processes_over_tcp_and_udp(entries, tmp_path: Path) -> None:
    """A recorded autopilot over TCP, the bridge, and a companion that logs, for a quarter of a minute."""
    log, errors, logs = tmp_path / "cut.tlog", tmp_path / "errors", tmp_path / "logs"
    log.write_bytes(lzma.decompress(CUT.read_bytes()))
    tcp, udp = port_of(socket.SOCK_STREAM), port_of(socket.SOCK_DGRAM)
    python = [sys.executable, "-m", "companion"]
    play = [*python, "sitl", "play", str(log), "--from", "16", "--connect", f"tcpin:{LOOPBACK}:{tcp}"]
    run = [*python, "run", "--connect", f"udpin:{LOOPBACK}:{udp}", "--logs", str(logs)]
    run += ["--set", "output.profile=ardupilot"]
    bridge = [*python, "sitl", "bridge", "--connect", f"tcp:{LOOPBACK}:{tcp}", "--json", "--seconds", "12"]
    bridge += ["--companion", f"udpout:{LOOPBACK}:{udp}", "--beacon", "55.75,38.57,200", "--log", str(errors)]
    with (
        subprocess.Popen(play, stderr=subprocess.DEVNULL) as autopilot,
        subprocess.Popen(run, stderr=subprocess.DEVNULL) as companion,
    ):
        deadline = time.monotonic() + 20.0
        while not list(logs.glob("*")) and time.monotonic() < deadline:
            time.sleep(0.1)
        done = subprocess.run(bridge, capture_output=True, text=True, timeout=60)
        for process in (companion, autopilot):
            process.send_signal(signal.SIGINT)
            assert process.wait(20) == 0
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout)
    (lost,) = found["tables"]
    assert "GNSS lost at" in lost["title"]
    rows = {row["source"]: row for row in lost["rows"]}
    assert set(rows) == {AUTOPILOT, COMPANION, RSBN}
    assert "the receiver lost its fix" in done.stderr
    lines = Path(found["errors"]).read_text().splitlines()
    assert lines[0].startswith("t_s,source,north_m,east_m,error_m,sigma_m,bound_m,true_lat_deg")
    assert sum(COMPANION in line for line in lines) > 50
    (flown,) = logs.iterdir()
    kinds = {type(entry.value) for entry in flight_log.read(flown)}
    assert {Solution, RsbnFix, Truth} <= kinds


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--beacon", "55.75"], "write it as LAT,LON"),
        (["--beacon", "99,10"], "write it as LAT,LON"),
        (["--connect", "nonsense"], "is no connection string"),
        (["--gnss-on-after", "5"], "give --gnss-off-after"),
        (["--unaided"], "give --companion"),
    ],
)
def test_a_mistake_is_told_in_one_sentence(arguments, words) -> None:
    done = CliRunner().invoke(command, arguments)
    assert done.exit_code == 2 and words in done.output


def test_what_cannot_be_listened_on_or_written_has_its_exit_code(tmp_path: Path) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as taken:
        taken.bind((LOOPBACK, 0))
        done = CliRunner().invoke(command, ["--connect", f"udpin:{LOOPBACK}:{taken.getsockname()[1]}"])
    assert done.exit_code == 69 and "cannot listen on" in done.output
    (tmp_path / "file").touch()
    done = CliRunner().invoke(command, ["--log", str(tmp_path / "file")])
    assert done.exit_code == 73 and "cannot be written" in done.output


def test_a_list_of_beacons_that_is_none_ends_it(tmp_path: Path) -> None:
    path = tmp_path / "beacons.csv"
    path.write_text("a,b\n1,2\n")
    done = CliRunner().invoke(command, ["--beacons", str(path)])
    assert done.exit_code == 1 and "it needs the columns id, lat_deg" in done.output


@pytest.mark.parametrize("height", [0.0, 20.0, 200.0, 900.0])
def test_beacons_of_the_bridge_and_of_a_replay_have_one_horizon(height: float, tmp_path) -> None:
    listed = tmp_path / "beacons.csv"
    listed.write_text(f"id,lat_deg,lon_deg,alt_m\n1,55.75,38.57,{height}\n")
    typed, read = bridge_command._beacons((f"55.75,38.57,{height}",), listed)
    assert typed.ground_alt == read.ground_alt == simulated_rsbn.GROUND


def test_a_bridge_that_hears_no_autopilot_says_so() -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as free:
        free.bind((LOOPBACK, 0))
        link = f"udpin:{LOOPBACK}:{free.getsockname()[1]}"
    done = CliRunner().invoke(command, ["--connect", link, "--seconds", "1"])
    assert done.exit_code == 69
    assert f"companion: no autopilot heard on {link} in 1 s" in done.stderr
    assert not done.stdout
