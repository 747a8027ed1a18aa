"""`companion smooth`: all formats have the same track; the two-point form agrees and notices an error."""

import csv
import json
import lzma
import math
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
from click.testing import CliRunner

from companion.analysis import smoothing
from companion.analysis.flights import open_flights
from companion.analysis.replay_inputs import open_inputs
from companion.analysis.smooth_command import ELLIPSE_95, command
from companion.config import Config
from companion.link import dialect, frame
from companion.records import Smoothed
from companion.storage import flight_log
from companion.storage.reader import LogError

LOG = Path(__file__).parents[1] / "data/plane_wind_change_cut.tlog.xz"


@pytest.fixture(scope="module")
def log(tmp_path_factory):
    path = tmp_path_factory.mktemp("smooth") / "plane.tlog"
    path.write_bytes(lzma.decompress(LOG.read_bytes()))
    return path


@pytest.fixture(scope="module")
def written(log):
    """Paths by suffix, and the output of the command."""
    paths = {suffix: log.with_name(f"track{suffix}") for suffix in (".mcap", ".csv", ".kml", ".geojson")}
    arguments = [str(log), "--check", *(word for path in paths.values() for word in ("-o", str(path)))]
    result = CliRunner().invoke(command, arguments)
    assert result.exit_code == 0, result.output
    return paths, result.output


def test_table_and_log_have_the_same_track(written):
    paths, _ = written
    records = [e.value for e in flight_log.read(paths[".mcap"]) if isinstance(e.value, Smoothed)]
    rows = list(csv.DictReader(paths[".csv"].read_text().splitlines()))
    assert len(rows) == len(records) > 100
    for row, record in zip(rows, records, strict=True):
        assert float(row["lat_deg"]) == pytest.approx(math.degrees(record.lat), abs=1e-9)
        assert float(row["sigma_east_m"]) == pytest.approx(math.sqrt(record.covariance[2]), rel=1e-5)
        for axis in ("north", "east"):  # later fixes can only help
            assert float(row[f"sigma_{axis}_m"]) <= 1.00001 * float(row[f"filter_sigma_{axis}_m"])


def test_times_count_from_the_first_record_of_the_log(log, written):
    """As those of reports, of outages and of correctors."""
    paths, _ = written
    first = next(iter(open_inputs(log).records))
    rows = csv.DictReader(paths[".csv"].read_text().splitlines())
    records = [e.value for e in flight_log.read(paths[".mcap"]) if isinstance(e.value, Smoothed)]
    for row, record in zip(rows, records, strict=True):
        assert float(row["t_s"]) == pytest.approx((record.t_ns - first.rx_ns) * 1e-9, abs=6e-4)
    assert records[0].t_ns > first.rx_ns


def test_maps_have_track_and_ellipses(written):
    paths, _ = written
    track, *ellipses = json.loads(paths[".geojson"].read_text())["features"]
    records = [e.value for e in flight_log.read(paths[".mcap"]) if isinstance(e.value, Smoothed)]
    assert track["properties"]["name"] == "smoothed track"
    seconds = {record.t_ns // 1_000_000_000 for record in records}
    assert len(track["properties"]["covariances"]) == len(seconds)
    lon, lat = np.radians(ellipses[0]["geometry"]["coordinates"][0]).T
    north, east = (lat - lat.mean()) * 6.37e6, (lon - lon.mean()) * 6.38e6 * math.cos(lat[0])
    nn, _, ee = records[0].covariance
    assert np.ptp(north) / 2 == pytest.approx(ELLIPSE_95 * math.sqrt(nn), rel=0.02)
    assert np.ptp(east) / 2 == pytest.approx(ELLIPSE_95 * math.sqrt(ee), rel=0.02)
    assert len(ElementTree.parse(paths[".kml"]).getroot()[0]) == 2 + len(ellipses)


def test_report_on_the_track_names_the_log_that_it_was_made_from(written):
    paths, _ = written
    with pytest.raises(LogError, match=r"no estimate: give .* from, plane\.tlog"):
        open_flights(paths[".mcap"], Config())


def test_two_point_form_agrees(written):
    _, output = written
    (line,) = (line for line in output.splitlines() if line.startswith("two-point"))
    assert float(line.split(": ")[1].split()[0]) < 1e-9


def test_two_point_form_notices_an_error_of_the_smoother(log, tmp_path, monkeypatch):
    correct = smoothing.rts_backward

    def wrong(x, P, predicted, Phi, Q):
        return correct(x, P, predicted, [0.9 * each for each in Phi], Q)

    monkeypatch.setattr(smoothing, "rts_backward", wrong)
    result = CliRunner().invoke(command, [str(log), "--check", "-o", str(tmp_path / "t.csv")])
    assert result.exit_code == 1


@pytest.mark.parametrize(
    ("arguments", "message"),
    [(("-o", "track.gpx"), "ends with one of"), (("--with", "nonsense=1"), "no section has this key")],
)
def test_bad_options(log, arguments, message):
    result = CliRunner().invoke(command, [str(log), *arguments])
    assert result.exit_code != 0
    assert message in result.output + str(result.exception)


def test_a_log_without_an_estimate_is_named(tmp_path):
    path = tmp_path / "parked.tlog"
    beat = frame.encode(dialect.new("HEARTBEAT", type=1, autopilot=3), 0, 1, 1)
    stamps = range(1_700_000_000_000_000, 1_700_000_005_000_000, 1_000_000)
    path.write_bytes(b"".join(us.to_bytes(8, "big") + beat for us in stamps))
    result = CliRunner().invoke(command, [str(path), "-o", str(tmp_path / "t.csv")])
    assert isinstance(result.exception, LogError)
    assert str(result.exception).startswith(f"{path}: nothing to smooth: ")


def test_same_output_twice_is_rejected(log, tmp_path):
    first, second = tmp_path / "t.csv", tmp_path / "." / "t.csv"
    result = CliRunner().invoke(command, [str(log), "-o", str(first), "-o", str(second)])
    assert isinstance(result.exception, LogError) and "would be written twice" in str(result.exception)
    assert not first.exists()


def test_no_log_is_overwritten_by_a_table(log, tmp_path):
    link = tmp_path / "t.csv"
    other = tmp_path / "other.tlog"
    other.write_bytes(log.read_bytes())
    link.symlink_to(other)
    result = CliRunner().invoke(command, [str(log), "-o", str(link)])
    assert isinstance(result.exception, LogError) and "is a log and is not overwritten" in str(
        result.exception
    )
    assert other.read_bytes() == log.read_bytes()
