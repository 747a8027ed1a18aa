"""Logs of other recorders are replayed to the end and written as our own logs."""

import errno
import json
import os
import re
import shutil
from collections import Counter
from functools import partial
from pathlib import Path

import click
import pytest
from click.testing import CliRunner

from companion.analysis import replay, replay_inputs, report, smooth_command
from companion.analysis.convert import convert_log
from companion.analysis.replay_inputs import apply_changes
from companion.command_line import cli
from companion.config import Config
from companion.records import Event, Reboot, Reset, Solution, Stamped
from companion.storage import flight_log
from companion.storage.deferred_log import NoLog
from companion.storage.mcap_file import DiskFile
from companion.storage.reader import LogError
from companion.storage.run_metadata import logged_configuration

DATA = Path(__file__).parents[1] / "data"
SHARED = Path(__file__).parents[2].parent / "shared" / "data"
CUT = DATA / "dronekit_copter_cut.tlog"


REAL = (
    "dronekit_copter/flight.tlog",
    "autopilot_sitl/plane_gps_loss.tlog",
    "autopilot_sitl/px4_global_position_sensor.tlog",
    pytest.param("autopilot_sitl/plane_gps_input_aid.tlog", marks=pytest.mark.long),
    pytest.param("autopilot_sitl/plane_wind_change.tlog", marks=pytest.mark.long),
)


def replayed(log: Path, output: Path, *options: str) -> dict:
    done = CliRunner().invoke(replay.command, [str(log), "-o", str(output), "--json", *options])
    assert done.exit_code == 0, done.output
    return json.loads(done.stdout)


def test_damaged_log_with_reboot_is_read_to_the_end(tmp_path: Path) -> None:
    found = replayed(CUT, tmp_path / "out.mcap")
    assert [found[k] for k in ("messages", "corrupt", "unknown", "torn", "reboots")] == [841, 24, 0, 13, 1]
    kinds = Counter(type(entry.value) for entry in flight_log.read(tmp_path / "out.mcap"))
    assert kinds[Reboot] == 1
    assert sum(kinds.values()) > 265  # all inputs and outputs
    resets = [e for e in flight_log.read(tmp_path / "out.mcap") if isinstance(e.value, Reset)]
    assert [(e.topic, e.value.what) for e in resets][:2] == [
        ("/link/Reset", "flight"),
        ("/out/Reset", "sensors"),  # the own channel outlives a reboot of the autopilot
    ]


def test_output_of_a_replay_replays_bit_for_bit(tmp_path: Path) -> None:
    replayed(CUT, tmp_path / "out.mcap")
    config = logged_configuration(tmp_path / "out.mcap")
    found = replay.replay_own(tmp_path / "out.mcap", config, NoLog())
    assert found.different == 0 and found.compared


def test_outputs_beyond_the_end_of_a_cut_log_are_no_difference(tmp_path: Path) -> None:
    whole, cut = tmp_path / "whole.mcap", tmp_path / "cut.mcap"
    replayed(CUT, whole)
    entries = [entry for entry in flight_log.read(whole) if isinstance(entry.value, Stamped)]
    last = max(k for k, entry in enumerate(entries) if isinstance(entry.value, Solution))
    about = flight_log.metadata(whole)
    with flight_log.Writer(cut, metadata=about, start_unix_ns=10**18, start_ns=0, block=True) as log:
        for entry in entries[:last]:
            log.record(entry.value, entry.topic)
    found = replay.replay_own(cut, logged_configuration(whole), NoLog())
    assert found.compared and found.first_difference is None


def test_configuration_is_stored_in_the_log(tmp_path: Path) -> None:
    config_file = tmp_path / "mine.toml"
    config_file.write_text("[gnss]\nsigma_m = 7.5\n")
    log = tmp_path / "out.mcap"
    done = CliRunner().invoke(replay.command, [str(CUT), "-o", str(log), "--config", str(config_file)])
    assert done.exit_code == 0, done.output
    assert logged_configuration(log).gnss.sigma_m == 7.5
    assert logged_configuration(log) != Config()


def test_another_configuration_is_not_compared_with_the_flight(tmp_path: Path) -> None:
    flight, file, output = (tmp_path / name for name in ("flight.mcap", "other.toml", "other.mcap"))
    replayed(CUT, flight)
    file.write_text("[gnss]\nsigma_m = 7.5\n")
    found = replayed(flight, output, "--config", str(file))
    assert (found["compared"], found["different"]) == (None, 0)
    assert logged_configuration(output).gnss.sigma_m == 7.5


def test_outputs_that_differ_from_the_flight_are_reported(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    flight = tmp_path / "flight.mcap"
    replayed(CUT, flight)
    other = apply_changes(Config(), "every_s=2")
    monkeypatch.setattr(replay_inputs, "logged_configuration", lambda path: other)
    done = CliRunner().invoke(replay.command, [str(flight)])
    assert done.exit_code == 1
    assert "DIFFERENT" in done.stdout and "first difference: in flight" in done.stdout


def test_counts_are_printed(tmp_path: Path) -> None:
    done = CliRunner().invoke(replay.command, [str(CUT), "-o", str(tmp_path / "out.mcap")])
    assert "841 messages, 24 corrupt" in done.stdout and "1 reboots" in done.stdout
    assert str(tmp_path / "out.mcap") in done.stdout


@pytest.mark.flight
@pytest.mark.shared
@pytest.mark.parametrize("name", REAL)
def test_recordings_give_solutions(name: str, tmp_path: Path) -> None:
    log = SHARED / name
    if not log.exists():
        pytest.skip("the recordings are not available")
    part = tmp_path / log.name  # the first third; tests/importers/test_sources.py reads all of it
    part.write_bytes(log.read_bytes()[: log.stat().st_size // 3])
    found = replayed(part, tmp_path / "out.mcap")
    assert found["outputs"]["Solution"] > 200  # at most 5 Hz
    info = flight_log.info(tmp_path / "out.mcap")
    assert info.closed and info.counts["/out/Solution"] == found["outputs"]["Solution"]


def test_empty_and_torn_logs_are_reported(tmp_path: Path) -> None:
    empty = tmp_path / "empty.mcap"
    with flight_log.Writer(empty, metadata={}, start_unix_ns=10**18, start_ns=0, block=True) as log:
        log.record(Event(1, 1, 6, "hello"))
    done = CliRunner().invoke(replay.command, [str(empty)])
    assert isinstance(done.exception, LogError) and "nothing to replay" in str(done.exception)
    replayed(CUT, tmp_path / "out.mcap")
    whole = (tmp_path / "out.mcap").read_bytes()
    (tmp_path / "torn.mcap").write_bytes(whole[:-100])
    done = CliRunner().invoke(replay.command, [str(tmp_path / "torn.mcap")])
    assert "the log was not closed" in done.output
    assert "not closed" not in CliRunner().invoke(replay.command, [str(tmp_path / "out.mcap")]).output


def test_what_an_estimate_needs_is_named_where_there_is_no_solution(tmp_path: Path) -> None:
    (tmp_path / "topics").mkdir()
    table = "timestamp,true_airspeed_m_s\n1000000,15.0\n2000000,15.5"
    (tmp_path / "topics" / "airspeed.csv").write_text(table)
    arguments = [str(tmp_path / "topics"), "-o", str(tmp_path / "out.mcap")]
    done = CliRunner().invoke(replay.command, arguments)
    assert done.exit_code == 0
    assert "or the log lacks attitude with airspeed or an IMU" in done.output


@pytest.mark.parametrize("how", ["itself", "symbolic link", "hard link"])
def test_input_log_is_not_overwritten(how: str, tmp_path: Path) -> None:
    log, output = tmp_path / "flight.tlog", tmp_path / "other.mcap"
    shutil.copy(CUT, log)
    if how == "itself":
        output = log
    elif how == "symbolic link":
        output.symlink_to(log)
    else:
        output.hardlink_to(log)
    done = CliRunner().invoke(replay.command, [str(log), "-o", str(output)])
    assert isinstance(done.exception, LogError)
    named = "" if how == "itself" else f" (as {log})"
    assert str(done.exception) == f"{output} is an input{named} and is not overwritten: give another name"
    assert log.read_bytes() == CUT.read_bytes()


@pytest.mark.parametrize("command", [replay.command, report.command])
@pytest.mark.parametrize("output", ["", "/"])
def test_output_without_a_name_is_rejected(command: click.Command, output: str) -> None:
    done = CliRunner().invoke(command, [str(CUT), "-o", output])
    assert isinstance(done.exception, LogError)
    assert str(done.exception) == f"'{output or '.'}' as output is a folder: give the name of a file"


def test_own_log_is_not_overwritten_by_its_replay(tmp_path: Path) -> None:
    log = tmp_path / "out.mcap"
    replayed(CUT, log)
    before = log.read_bytes()
    for changes in ([], ["--with", "gnss.sigma_m=3"]):
        done = CliRunner().invoke(replay.command, [str(log), "-o", str(log), *changes])
        assert isinstance(done.exception, LogError) and "not overwritten" in str(done.exception)
    assert log.read_bytes() == before


def test_log_of_another_flight_is_not_overwritten(tmp_path: Path) -> None:
    flight, text = tmp_path / "flight.mcap", tmp_path / "text.mcap"
    with flight_log.Writer(flight, metadata={}, start_unix_ns=10**18, start_ns=0, block=True) as log:
        log.record(Event(1, 1, 6, "hello"))
    text.write_text("not a log")
    before = flight.read_bytes()
    for command, output in (
        (replay.command, flight),
        (smooth_command.command, flight),
        (replay.command, text),
    ):
        done = CliRunner().invoke(command, [str(CUT), "-o", str(output)])
        assert isinstance(done.exception, LogError)
        assert str(done.exception) == (
            f"{output} already exists and was not made by replay or smooth: give another name, or delete it"
        )
    assert (flight.read_bytes(), text.read_text()) == (before, "not a log")


def test_replay_may_be_repeated(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    for _ in range(2):
        assert CliRunner().invoke(replay.command, [str(CUT)]).exit_code == 0
    replayed(CUT, tmp_path / "dronekit_copter_cut.replay.mcap")


def test_name_of_a_log_may_be_of_any_bytes(tmp_path: Path) -> None:
    log = tmp_path / os.fsdecode(b"flight \xff\n.tlog")
    shutil.copy(CUT, log)
    replayed(log, tmp_path / "out.mcap")
    assert flight_log.metadata(tmp_path / "out.mcap")["derived"]["from"] == r"flight \udcff\n.tlog"
    convert_log(log, tmp_path / "in.mcap", Config())
    assert flight_log.metadata(tmp_path / "in.mcap")["converted"]["from"] == r"flight \udcff\n.tlog"


def interrupted(log: Path, metadata: dict[str, dict[str, str]]) -> Path:
    """Leave what a killed writer of `log` leaves."""
    sink = flight_log.Writer(log, metadata=metadata, start_unix_ns=10**18, start_ns=0, block=True)
    sink.record(Event(1, 1, 6, "hello"))
    sink.close(finish=False)
    return log.with_name(log.name + ".active")


def test_leftover_of_a_replay_is_replaced(tmp_path: Path) -> None:
    output = tmp_path / "out.mcap"
    active = interrupted(output, {"derived": {"by": "replay"}})
    assert active.exists() and not output.exists()
    replayed(CUT, output)
    assert list(tmp_path.iterdir()) == [output]
    active.touch()  # on a full disk
    replayed(CUT, output)
    assert list(tmp_path.iterdir()) == [output]


def test_leftover_of_a_flight_is_kept(tmp_path: Path) -> None:
    output = tmp_path / "out.mcap"
    active = interrupted(output, {})
    before = active.read_bytes()
    done = CliRunner().invoke(replay.command, [str(CUT), "-o", str(output)])
    assert isinstance(done.exception, LogError)
    assert str(done.exception) == (
        f"{active} already exists and may be of a flight: give another name, or delete it"
    )
    assert active.read_bytes() == before


def test_leftover_that_is_the_input_is_kept(tmp_path: Path) -> None:
    output = tmp_path / "out.mcap"
    active = interrupted(output, {"derived": {"by": "replay"}})
    done = CliRunner().invoke(replay.command, [str(active), "-o", str(output)])
    assert isinstance(done.exception, LogError) and "is an input" in str(done.exception)
    assert active.exists()


def test_log_that_is_still_written_is_not_replaced(tmp_path: Path) -> None:
    output = tmp_path / "out.mcap"
    with flight_log.Writer(output, metadata={"derived": {}}, start_unix_ns=10**18, start_ns=0):
        done = CliRunner().invoke(replay.command, [str(CUT), "-o", str(output)])
    assert isinstance(done.exception, LogError) and "is still being written" in str(done.exception)


def test_replay_that_fails_keeps_the_older_one(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    output = tmp_path / "out.mcap"
    replayed(CUT, output)
    before = output.read_bytes()

    def interrupt(*arguments: object) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(replay.gnss_latency, "glitch_events", interrupt)
        stopped = CliRunner().invoke(replay.command, [str(CUT), "-o", str(output)])
    assert stopped.exit_code == 1
    assert f"companion: {output}.active is incomplete: run the command again\n" in stopped.stderr
    assert output.read_bytes() == before
    write = DiskFile.write

    def full(self: DiskFile, at: int, data: bytes) -> None:
        if at > 10_000:
            raise OSError(errno.ENOSPC, "No space left on device")
        write(self, at, data)

    monkeypatch.setattr(DiskFile, "write", full)
    done = CliRunner().invoke(replay.command, [str(CUT), "-o", str(output)])
    assert isinstance(done.exception, LogError)
    assert str(done.exception) == (
        f"cannot write the log {output}: No space left on device; {output}.active is incomplete:"
        " run the command again"
    )
    assert output.read_bytes() == before


@pytest.mark.parametrize(
    "command",
    [("replay", "LOG"), ("replay", "LOG", "--with", "gnss.sigma_m=3"), ("log", "convert", str(CUT))],
    ids=["as flown", "changed", "converted"],
)
def test_messages_lost_on_a_disk_that_recovers_are_stated(
    command: tuple[str, ...], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    log, output = tmp_path / "log.mcap", tmp_path / "out.mcap"
    replayed(CUT, log)
    arguments = [str(log) if word == "LOG" else word for word in command]
    write, fails = DiskFile.write, True

    def full(self: DiskFile, at: int, data: bytes) -> None:
        if fails and at > 10_000:
            raise OSError(errno.ENOSPC, "No space left on device")
        write(self, at, data)

    def recover(writer: flight_log.Writer, finish: bool = True) -> bool:
        nonlocal fails
        fails = False
        return close(writer, finish=finish)

    close = flight_log.Writer.close
    monkeypatch.setattr(DiskFile, "write", full)
    monkeypatch.setattr(flight_log.Writer, "close", recover)
    short = partial(flight_log.Writer, depth=30_000, chunk_bytes=2000)
    monkeypatch.setattr(replay.flight_log, "Writer", short)
    done = CliRunner().invoke(cli, [*arguments, "-o", str(output)])
    lost = re.search(rf"(\d+) messages were lost while {output} could not be written", done.stderr)
    assert lost and int(lost[1]) > 0, done.output
