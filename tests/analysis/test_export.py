"""Maps for other programs: coordinates, times and heights survive; text of a log cannot break a file."""

import json
import math
from xml.etree import ElementTree

import numpy as np
import pytest
from click.testing import CliRunner

from companion.analysis import export
from companion.analysis.export import Place, Track
from companion.analysis.log_command import group
from companion.config import Config
from companion.nav.geometry import displace
from companion.records import Gnss, Mode, Reboot, RsbnFix
from companion.storage import flight_log
from companion.storage.reader import LogError
from companion.storage.run_metadata import run_metadata
from tests.solutions import solution_at

S = 1_000_000_000
SPACES = {"k": "http://www.opengis.net/kml/2.2", "gx": "http://www.google.com/kml/ext/2.2"}
NASTY = 'a </name><script>alert("x")</script> & \x00\x1b\ud800 b'


def track(lat_deg, lon_deg, seconds=None, name="t"):
    n = len(lat_deg)
    t = np.arange(n) if seconds is None else np.array(seconds)
    unix = 1_700_000_000 * S + np.round(t * S).astype(np.int64)
    return Track(name, unix, np.radians(lat_deg), np.radians(lon_deg), np.full(n, 120.5), "#d1242f")


def kml_lines(text):
    """Points (lon, lat, alt) and times of each gx:Track."""
    root = ElementTree.fromstring(text)
    return [
        (
            [tuple(map(float, c.text.split())) for c in line.findall("gx:coord", SPACES)],
            [w.text for w in line.findall("k:when", SPACES)],
        )
        for line in root.iter(f"{{{SPACES['gx']}}}Track")
    ]


def test_coordinates_and_times_are_those_of_the_track():
    lat, lon = [55.123456789, 55.2, 55.3], [37.5, 37.6, 37.7]
    one = track(lat, lon, [0.0, 0.25, 1.5])
    (feature,) = json.loads(export.to_geojson("m", [one]))["features"]
    ((points, times),) = kml_lines(export.to_kml("m", [one]))
    assert np.allclose(feature["geometry"]["coordinates"][0], list(zip(lon, lat)), atol=1e-8)
    assert np.allclose(points, [(x, y, 120.5) for x, y in zip(lon, lat)], atol=1e-8)
    assert times == feature["properties"]["coordTimes"][0]
    assert times == ["2023-11-14T22:13:20.000Z", "2023-11-14T22:13:20.250Z", "2023-11-14T22:13:21.500Z"]
    assert feature["properties"]["alt_m"] == [[120.5] * 3]


@pytest.mark.parametrize(
    ("lat", "lon", "seconds", "sizes"),
    [
        ([0.0] * 4, [179.8, 179.9, -179.9, -179.8], None, [2, 2]),  # RFC 7946, 3.1.9
        ([0.0] * 4, [1.0, 1.1, 1.2, 1.3], [0, 1, 60, 61], [2, 2]),
        ([0.0, 0.0, math.nan, 0.0, 0.0], [1.0] * 5, None, [2, 2]),
        ([89.9, 90.0, 89.9], [0.0, 0.0, 0.0], None, [3]),
    ],
)
def test_a_line_is_cut_at_the_antimeridian_and_at_gaps(lat, lon, seconds, sizes):
    one = track(lat, lon, seconds)
    (feature,) = json.loads(export.to_geojson("m", [one]))["features"]
    assert [len(line) for line in feature["geometry"]["coordinates"]] == sizes
    assert [len(points) for points, _ in kml_lines(export.to_kml("m", [one]))] == sizes


def test_text_of_a_log_cannot_break_a_file():
    one, place = track([1.0, 2.0], [1.0, 2.0], name=NASTY), Place(NASTY, 0.5, 0.5, "#1a7f37", {"a": NASTY})
    root = ElementTree.fromstring(export.to_kml(NASTY, [one], [place]).encode())
    names = [element.text for element in root.iter(f"{{{SPACES['k']}}}name")]
    assert len(names) == 3 and all("<script>" in name and "\x00" not in name for name in names)


def test_a_flight_is_cut_into_legs_with_and_without_fixes(tmp_path):
    log, out = tmp_path / "flight.mcap", tmp_path / "flight.geojson"
    meta, start = run_metadata(Config()), 1_700_000_000 * S
    with flight_log.Writer(log, metadata=meta, start_unix_ns=start, start_ns=0, block=True) as writer:
        for k in range(600):
            t, lost = k * S // 5, 200 <= k < 400
            lat, lon, _ = displace(0.97, 0.65, 0.0, 0.0, 4.0 * k, 0.0)
            if not lost:
                writer.record(Gnss(t, t, 0, k + 1, 3, lat, lon, 100.0, 2.0))
            if k % 50 == 0:
                writer.record(RsbnFix(t, t, 7, 0.971, 0.651, 30.0, 1.0, 2000.0, 0.002, 100.0))
            writer.record(
                solution_at(
                    t,
                    mode=Mode.PREDICTING if lost else Mode.FIXED,
                    lat=lat,
                    lon=lon,
                    alt_msl=100.0,
                    sources=1 if lost else 3,
                )
            )
    kml = out.with_suffix(".kml")
    both = ["export", str(log), "-o", str(out), "-o", str(kml)]
    found = CliRunner().invoke(group, both, catch_exceptions=False)
    assert found.exit_code == 0
    assert found.output.splitlines() == [f"{path}: 4 tracks, 1 beacons" for path in (out, kml)]
    assert kml.read_text().startswith("<?xml")
    twice = CliRunner().invoke(group, [*both, "-o", str(out)])
    assert "would be written twice" in str(twice.exception)
    features = {f["properties"]["name"]: f for f in json.loads(out.read_text())["features"]}
    assert set(features) == {"estimate, GNSS", "estimate, no fixes", "GNSS", "beacon 7"}
    lost = features["estimate, no fixes"]
    assert (lost["properties"]["from_s"], lost["properties"]["to_s"]) == (40.0, 80.0)
    assert [len(line) for line in lost["geometry"]["coordinates"]] == [41]
    assert [len(line) for line in features["GNSS"]["geometry"]["coordinates"]] == [40, 41]
    few = ["export", str(log), "-o", str(out), "--every", "15"]
    assert CliRunner().invoke(group, few, catch_exceptions=False).exit_code == 0
    lines = {
        f["properties"]["name"]: f["geometry"]["coordinates"] for f in json.loads(out.read_text())["features"]
    }
    assert [len(line) for line in lines["estimate, no fixes"]] == [5]  # 40, 45, 60, 75 s and the last
    assert [len(line) for line in lines["GNSS"]] == [3, 4]  # 0, 15, 30 s; 80, 90, 105 s and the last
    none = CliRunner().invoke(group, ["export", str(log), "-o", str(out), "--every", "1e300"])
    assert none.exit_code == 2 and "1e+300 is not in the range" in none.stderr
    lon, lat = features["beacon 7"]["geometry"]["coordinates"]
    assert (math.radians(lat), math.radians(lon)) == pytest.approx((0.971, 0.651), abs=1e-9)


def test_beacons_of_all_flights_of_a_log_are_exported(tmp_path):
    """Those of the flights before the last reboot were left out."""
    log, out = tmp_path / "flights.mcap", tmp_path / "flights.geojson"
    with flight_log.Writer(
        log, metadata=run_metadata(Config()), start_unix_ns=1_700_000_000 * S, start_ns=0, block=True
    ) as writer:
        for k in range(60):
            t = k * S
            if k == 30:
                writer.record(Reboot(t, t, 1))
            writer.record(Gnss(t, t, 0, k + 1, 3, 0.97, 0.65 + 1e-6 * k, 100.0, 2.0))
            for beacon in (9, 7 if k < 30 else 8):
                writer.record(RsbnFix(t, t, beacon, 0.971, 0.651, 30.0, 1.0, 2000.0, 0.002, 100.0))
    found = CliRunner().invoke(group, ["export", str(log), "-o", str(out)], catch_exceptions=False)
    assert found.exit_code == 0 and "3 beacons" in found.output
    names = [f["properties"]["name"] for f in json.loads(out.read_text())["features"]]
    assert sorted(names) == ["beacon 7", "beacon 8", "beacon 9", "flight 1: GNSS", "flight 2: GNSS"]


def test_unknown_suffix_is_reported_in_one_sentence(tmp_path):
    with pytest.raises(LogError, match=r"\.geojson, \.json, \.kml"):
        export.write_map(tmp_path / "x.gpx", "m", [])


def test_a_log_without_a_position_has_no_map(tmp_path):
    """It was an empty file, and the exit code 0."""
    log, out = tmp_path / "f.mcap", tmp_path / "f.kml"
    with flight_log.Writer(log, metadata=run_metadata(Config()), start_unix_ns=10**18, start_ns=0) as sink:
        sink.record(Reboot(10**9, 10**9, 10**9))
    found = CliRunner().invoke(group, ["export", str(log), "-o", str(out)])
    assert isinstance(found.exception, LogError) and "has no position" in str(found.exception)
    assert not out.exists()


def test_missing_folder_is_named(tmp_path):
    with pytest.raises(LogError, match=r"x\.kml cannot be written: no folder .*none$"):
        export.write_map(tmp_path / "none" / "x.kml", "m", [])
