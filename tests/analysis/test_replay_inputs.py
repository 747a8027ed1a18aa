"""Replay with changed keys, simulated beacons and outages; converted logs replay like the originals."""

import json
import pathlib
from typing import Any

import pytest
from click.testing import CliRunner, Result

from companion import records as r
from companion.analysis import replay_inputs
from companion.command_line import cli
from companion.config import Config, ConfigError
from companion.link import dialect, frame
from companion.storage import flight_log
from companion.storage.reader import LogError
from companion.storage.run_metadata import logged_configuration

TESTS = pathlib.Path(__file__).parents[1]
SHARED = TESTS.parent.parent / "shared" / "data"
FLIGHT = TESTS / "data" / "umn_fixed_wing_cut"
NO_CHANNEL = "no estimate: The log has nothing for an inertial channel."


def run(*arguments: object, fails: type[Exception] | None = None) -> Result:
    result = CliRunner().invoke(cli, [str(argument) for argument in arguments])
    if fails is None:
        assert result.exit_code == 0, result.output
    else:
        assert isinstance(result.exception, fails), result.output
    return result


def report(*arguments: object) -> dict[str, Any]:
    found: dict[str, Any] = json.loads(run("replay", "--json", *arguments).stdout)
    return found


def values(path: pathlib.Path, kind: type[r.Stamped]) -> list[Any]:
    return [entry.value for entry in flight_log.read(path) if type(entry.value) is kind]


def test_configuration_selects_the_vehicle_of_a_log_with_two(tmp_path: pathlib.Path) -> None:
    log, start_us = tmp_path / "two.tlog", 1_700_000_000_000_000
    beat = dialect.new("HEARTBEAT", type=1, autopilot=3)
    rolled = {1: 0.25, 2: 0.5}
    frames = [frame.encode(beat, 0, system, 1) for system in rolled] + [
        frame.encode(dialect.new("ATTITUDE", time_boot_ms=1000 + 100 * k, roll=roll), k, system, 1)
        for k in range(10)
        for system, roll in rolled.items()
    ]
    log.write_bytes(
        b"".join((start_us + 50_000 * k).to_bytes(8, "big") + raw for k, raw in enumerate(frames))
    )
    for system, roll in {0: 0.25, **rolled}.items():
        config = replay_inputs.apply_changes(Config(), f"link.system_id={system}")
        found = list(replay_inputs.open_inputs(log, config).records)
        assert [one.roll for one in found if isinstance(one, r.Attitude)] == [roll] * 10
    output = tmp_path / "out.mcap"
    run("replay", log, "-o", output, "--with", "link.system_id=2")
    assert {one.roll for one in values(output, r.Attitude)} == {0.5}
    config_file, converted = tmp_path / "second.toml", tmp_path / "second.mcap"
    config_file.write_text("[link]\nsystem_id = 2\n")
    run("log", "convert", log, "-o", converted, "--config", config_file)
    assert {one.roll for one in values(converted, r.Attitude)} == {0.5}


def test_output_has_the_name_of_its_log(tmp_path: pathlib.Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = tmp_path / "flight.2024-05-01"
    (folder / "topics").mkdir(parents=True)
    monkeypatch.chdir(folder / "topics")
    for log, name in {
        "a.b.tlog": "a.b",
        "../a.mcap": "a",
        "a.mcap.active": "a",
        "A.b.MCAP": "A.b",
        "A.MCAP.active": "A",
        ".": "topics",
        "..": "flight.2024-05-01",
        str(folder): "flight.2024-05-01",
    }.items():
        found = replay_inputs.default_output(pathlib.Path(log), "replay")
        assert found == pathlib.Path(f"{name}.replay.mcap")


def test_log_with_an_ending_in_capitals_is_written_and_read(tmp_path: pathlib.Path) -> None:
    converted, replayed = tmp_path / "FLIGHT.MCAP", tmp_path / "AGAIN.MCAP"
    run("log", "convert", FLIGHT, "-o", converted)
    run("replay", converted, "-o", replayed)
    assert values(replayed, r.Gnss) == values(converted, r.Gnss) != []


@pytest.fixture
def beacons(tmp_path: pathlib.Path) -> pathlib.Path:
    path = tmp_path / "beacons.csv"
    path.write_text("id,lat_deg,lon_deg,alt_m\n11,45.3,-93.1,290\n12,45.2,-93.4,280\n99,10,10,0\n")
    return path


@pytest.mark.flight
def test_converted_log_replays_as_the_original(tmp_path: pathlib.Path) -> None:
    converted = tmp_path / "flight.mcap"
    assert "879 records" in run("log", "convert", FLIGHT, "-o", converted).output
    once, twice = tmp_path / "once.mcap", tmp_path / "twice.mcap"
    by_local = ("--with", "inertial.source=local_position")
    first, second = report(FLIGHT, *by_local, "-o", once), report(converted, *by_local, "-o", twice)
    assert first["inputs"] == second["inputs"] > 800
    assert first["outputs"] == second["outputs"] and first["outputs"]["Solution"] > 200
    assert values(once, r.Solution) == values(twice, r.Solution)
    again = report(twice)  # the output is an own log and replays bit for bit
    assert again["compared"] > 0 and again["different"] == 0


def test_a_log_without_an_inertial_channel_is_explained(tmp_path: pathlib.Path) -> None:
    note = report(FLIGHT, "-o", tmp_path / "x.mcap")["notes"][0]
    assert note.startswith(
        "no estimate: The log has nothing for an inertial channel. Give --with inertial.source="
    )


def test_gnss_delay_is_reported(tmp_path: pathlib.Path) -> None:
    result = run("replay", FLIGHT, "-o", tmp_path / "x.mcap").output
    assert "GNSS is 0.18 s (sigma 0.01) behind the local position: median distance 3.15 m, 0.31 m" in result


@pytest.mark.flight
def test_navigator_predicts_in_an_outage_and_uses_simulated_beacons(
    tmp_path: pathlib.Path, beacons: pathlib.Path
) -> None:
    without_gnss, aided = tmp_path / "without_gnss.mcap", tmp_path / "aided.mcap"
    by_local = ("--with", "inertial.source=local_position", "--outage", "GNSS:30-60")
    result = report(FLIGHT, "-o", without_gnss, *by_local)
    start = min(values(without_gnss, r.LocalPosition), key=lambda x: x.rx_ns).rx_ns
    assert max(fix.rx_ns for fix in values(without_gnss, r.Gnss)) < start + 31 * 10**9
    assert {s.mode for s in values(without_gnss, r.Solution)[-20:]} <= {r.Mode.PREDICTING, r.Mode.UNTRUSTED}
    assert any("autopilot's own GNSS" in note for note in result["notes"])
    result = report(FLIGHT, "-o", aided, *by_local, "--rsbn", beacons)
    assert any(
        "of 2 beacons (11, 12) simulated along the log's own smoothed track" in n for n in result["notes"]
    )
    late = [s for s in values(aided, r.Solution) if s.t_ns > start + 50 * 10**9]
    assert any(s.sources & r.Source.RANGE for s in late)


@pytest.mark.parametrize(
    ("keys", "outage"),
    [("source=air_data", "GNSS:30-60"), ("independent=true", "GNSS:30-60"), ("source=auto", "GNSS:900-960")],
)
def test_no_note_if_the_autopilot_position_is_unused_or_independent(
    tmp_path: pathlib.Path, keys: str, outage: str
) -> None:
    result = report(FLIGHT, "-o", tmp_path / "x.mcap", "--outage", outage, "--with", keys)
    assert not any("autopilot's own GNSS" in note for note in result["notes"])


def test_outage_after_the_end_is_reported(tmp_path: pathlib.Path) -> None:
    late = ("--outage", "GNSS:9000-9900", "--outage", "GNSS:30-60")
    result = report(FLIGHT, "-o", tmp_path / "x.mcap", *late)
    (note,) = [note for note in result["notes"] if "has no effect" in note]
    assert note.startswith("--outage GNSS:9000-9900 has no effect: the log ends at ")


def dataflash_with_text_first(tmp_path: pathlib.Path) -> pathlib.Path:
    """A text log of ArduPilot: a message at 1 s, a fix each second from 31 to 41 s, nothing else."""
    lines = [
        "FMT, 128, 89, FMT, BBnNZ, Type,Length,Name,Format,Columns",
        "FMT, 130, 50, GPS, QBIHBcLLeee, TimeUS,Status,GMS,GWk,NSats,HDop,Lat,Lng,Alt,Spd,GCrs",
        "FMT, 131, 75, MSG, QZ, TimeUS,Message",
        "MSG, 1000000, Barometer calibrated",
    ]
    lines += [f"GPS, {s}000000, 3, {s}000, 2300, 9, 1.0, 45.0, 7.0, 300.0, 0.0, 0.0" for s in range(31, 42)]
    path = tmp_path / "text_first.log"
    path.write_text("\n".join([*lines, ""]))
    return path


def test_outage_counts_from_the_first_record_as_the_report_does(tmp_path: pathlib.Path) -> None:
    """The first record is a text, no input: an outage that removed fixes was reported as without effect."""
    log, output = dataflash_with_text_first(tmp_path), tmp_path / "x.mcap"
    outages = ("--outage", "GNSS:35-38", "--outage", "GNSS:41-50")
    result = report(log, "-o", output, *outages)
    first = next(iter(flight_log.read(output))).value
    assert type(first) is r.Event
    seconds = [round((fix.rx_ns - first.rx_ns) * 1e-9) for fix in values(output, r.Gnss)]
    assert seconds == [30, 31, 32, 33, 34, 38, 39, 40]
    assert result["notes"] == ["--outage GNSS:41-50 has no effect: the log ends at 40 s", NO_CHANNEL]
    (flight,) = result["flights"]
    assert (flight["start_s"], flight["end_s"]) == (pytest.approx(30.0), pytest.approx(40.0))


def test_beacon_out_of_reach_is_described_in_a_note(tmp_path: pathlib.Path) -> None:
    (exchanged := tmp_path / "exchanged.csv").write_text("id,lat_deg,lon_deg,alt_m\n5,7.0,45.0,300\n")
    result = report(dataflash_with_text_first(tmp_path), "-o", tmp_path / "x.mcap", "--rsbn", exchanged)
    (note, without_channel) = result["notes"]
    assert without_channel == NO_CHANNEL
    assert note.startswith(f"no beacon of {exchanged} is received along the log's own smoothed track")
    assert ": the nearest, 5 at 7, 45 deg and 300 m, is 5" in note


@pytest.mark.flight
def test_simulated_measurements_depend_on_the_seed(tmp_path: pathlib.Path, beacons: pathlib.Path) -> None:
    one, same, other = (tmp_path / name for name in ("one.mcap", "same.mcap", "other.mcap"))
    report(FLIGHT, "-o", one, "--rsbn", beacons)
    report(FLIGHT, "-o", same, "--rsbn", beacons, "--seed", 0)
    report(FLIGHT, "-o", other, "--rsbn", beacons, "--seed", 1)
    assert values(one, r.RsbnFix) == values(same, r.RsbnFix) != values(other, r.RsbnFix)
    assert values(one, r.Solution) == values(same, r.Solution)


@pytest.mark.flight
def test_own_log_is_replayed_with_changed_keys(tmp_path: pathlib.Path) -> None:
    flown, other = tmp_path / "flown.mcap", tmp_path / "other.mcap"
    report(FLIGHT, "-o", flown, "--with", "sigma_m=3.5")
    assert logged_configuration(flown).gnss.sigma_m == 3.5
    result = report(flown, "--with", "estimator=kalman", "-o", other)
    assert result["compared"] is None
    config = logged_configuration(other)
    assert (config.estimator.output, config.gnss.sigma_m) == ("kalman", 3.5)
    assert values(other, r.Gnss) == values(flown, r.Gnss)


def test_keys_with_and_without_section() -> None:
    config = replay_inputs.apply_changes(
        Config(), "estimator=kalman,gnss.sigma_m=3,ahead_min=[1.0,2.0],window_min=10"
    )
    assert config.estimator.output == "kalman" and config.gnss.sigma_m == 3.0
    assert config.predictor.ahead_min == (1.0, 2.0) and config.predictor.window_min == 10.0
    for text, words in (
        ("estimator=foo", "--with estimator.output=foo"),
        ("timeout_s=3", "sections gnss, rsbn all have this key"),
        ("beta=3", "no section has this key"),
        ("gnss.sigma=3", "did you mean `sigma_m`"),
        ("estimator", "write it as SECTION.KEY=VALUE"),
        ("sigma_m=3,gnss.sigma_m=4", "--with gnss.sigma_m=4: gnss.sigma_m is given twice"),
        ("independent=true,scheme=feedback", "set inertial.source = 'air_data' or 'imu'"),
    ):
        with pytest.raises(ConfigError, match=words) as caught:
            replay_inputs.apply_changes(Config(), text)
        assert "--set" not in str(caught.value)


@pytest.mark.parametrize("name", ["a.tlog", "a.bin", "a.log", "a.ulg", "a.ulog", "a.mat", "a.zip", "a.mcap"])
@pytest.mark.parametrize("content", [None, b"", b"something else " * 400])
def test_unreadable_log_is_reported_in_one_sentence(
    tmp_path: pathlib.Path, name: str, content: bytes | None
) -> None:
    path = tmp_path / name
    if content is not None:
        path.write_bytes(content)
    result = str(run("replay", path, "-o", tmp_path / "x.mcap", fails=LogError).exception)
    assert name in result and "\n" not in result
    if path.suffix != ".mcap":
        result = str(run("log", "convert", path, "-o", tmp_path / "y.mcap", fails=LogError).exception)
        assert name in result and "\n" not in result
    assert not list(tmp_path.glob("[xy].mcap*"))  # no partial files remain


def test_convert_does_not_overwrite(tmp_path: pathlib.Path) -> None:
    there = tmp_path / "there.mcap"
    there.write_bytes(b"existing")
    result = run("log", "convert", FLIGHT, "-o", there, fails=LogError)
    assert "already exists" in str(result.exception)
    assert there.read_bytes() == b"existing"


@pytest.mark.parametrize("command", [("replay",), ("log", "convert")])
def test_log_is_written_under_a_name_that_is_read_again(
    command: tuple[str, ...], tmp_path: pathlib.Path
) -> None:
    result = run(*command, FLIGHT, "-o", tmp_path / "x.txt", fails=LogError)
    assert "give a name that ends with it" in str(result.exception)
    assert not list(tmp_path.iterdir())


@pytest.mark.flight
@pytest.mark.shared
def test_recorded_quadrotor_glitch_is_an_event(tmp_path: pathlib.Path) -> None:
    path = SHARED / "inertialnav" / "f450_glitch_log.zip"
    if not path.exists():
        pytest.skip("the recordings are not available")
    written = tmp_path / "f450.mcap"
    result = report(path, "-o", written)
    assert result["outputs"]["Solution"] > 500
    (glitch,) = [event for event in values(written, r.Event) if "GNSS glitch" in event.text]
    assert 126.2 < glitch.t_ns * 1e-9 < 127.7


def test_conversion_of_an_own_log_is_rejected(tmp_path: pathlib.Path) -> None:
    log, again, foreign = tmp_path / "x.mcap", tmp_path / "y.mcap", tmp_path / "z.mcap"
    run("log", "convert", FLIGHT, "-o", log)
    foreign.write_bytes(b"what is this" * 20)
    for source, message in ((log, f"{log} is already an MCAP log"), (foreign, "is not an MCAP log")):
        assert message in str(run("log", "convert", source, "-o", again, fails=LogError).exception)
    assert not again.exists()


@pytest.mark.parametrize(("command", "first"), [(("replay",), ".mcap, .tlog"), (("log", "convert"), ".tlog")])
def test_only_what_the_command_reads_is_offered(
    command: tuple[str, ...], first: str, tmp_path: pathlib.Path
) -> None:
    (tmp_path / "x.pdf").touch()
    result = run(*command, tmp_path / "x.pdf", "-o", tmp_path / "x.mcap", fails=LogError)
    assert f"unknown file type; give {first}, " in str(result.exception)


def test_correctors_join_at_seconds_of_the_log(tmp_path):
    table = tmp_path / "stars.csv"
    header = "t_s,star,lat_deg,lon_deg,altitude_deg,azimuth_deg,sigma_altitude_arcsec,sigma_azimuth_arcsec"
    table.write_text(f"{header}\n2.5,1,20,30,45,,20,\n0.5,2,10,70,40,,20,\n")
    log = [r.Pressure(k * 1_000_000_000, k * 1_000_000_000, 1e5) for k in range(7, 11)]
    inputs = replay_inputs.LogInputs(log, dict)
    merged = list(replay_inputs.with_correctors(inputs, [table]).records)
    assert [record.rx_ns / 1e9 for record in merged] == [7.0, 7.5, 8.0, 9.0, 9.5, 10.0]
    assert [type(record) for record in merged].count(r.StarFix) == 2
    assert list(replay_inputs.with_correctors(inputs, []).records) == log


def test_correctors_that_the_configuration_does_not_use_are_reported(tmp_path):
    log, output, table = dataflash_with_text_first(tmp_path), tmp_path / "x.mcap", tmp_path / "second.csv"
    table.write_text("t_s,ins,lat_deg,lon_deg\n32,0,45,7\n")
    use = "inertial.independent=true,inertial.correctors=second_ins"
    unused = [f"records of second_ins have no effect: give --with {use}", NO_CHANNEL]
    assert report(log, "-o", output, "--correctors", table)["notes"] == unused
    other = use.replace("second_ins", "stars")
    assert report(log, "-o", output, "--correctors", table, "--with", other)["notes"] == unused
    assert report(log, "-o", output, "--correctors", table, "--with", use)["notes"] == [NO_CHANNEL]


def test_corrector_rows_outside_the_log_are_reported_and_not_used(tmp_path):
    """A table of another flight went unseen: its rows moved the start and the end of the replay."""
    log, output, table = dataflash_with_text_first(tmp_path), tmp_path / "x.mcap", tmp_path / "second.csv"
    use = "inertial.independent=true,inertial.correctors=second_ins"
    rows = "".join(f"{t_s},0,45,7\n" for t_s in (9001, -40, 0, 32.5, 40, 40.2))
    table.write_text(f"t_s,ins,lat_deg,lon_deg\n{rows}")
    result = report(log, "-o", output, "--correctors", table, "--with", use)
    assert result["notes"] == [
        f"{table}: 3 of 6 rows are not used: t_s from -40.0 to 9001.0, and the log has 0 to 40.0 s; check "
        "that the table is of this flight",
        NO_CHANNEL,
    ]
    first = next(iter(flight_log.read(output))).value.rx_ns
    assert [(row.rx_ns - first) * 1e-9 for row in values(output, r.SecondIns)] == [0.0, 32.5, 40.0]
    assert result["flights"][0]["end_s"] == pytest.approx(40.0)


def test_table_that_is_none_of_the_correctors_is_reported(tmp_path):
    table = tmp_path / "stars.csv"
    table.write_text("time,star\n1,2\n")
    with pytest.raises(LogError, match="the header is 'time,star'"):
        replay_inputs.with_correctors(replay_inputs.LogInputs([r.Pressure(0, 0, 1e5)], dict), [table])
