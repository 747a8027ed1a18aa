"""A log explains itself to other programs: units, references, one schema each, dialect, events."""

import json
import tempfile
from collections import Counter
from pathlib import Path

import pytest
from mcap.reader import make_reader
from pymavlink.generator import mavparse

from companion import records as r
from companion.link.generated import rsbn_dialect
from companion.storage import location_fix, retention, schemas
from companion.storage.recovery import recover

S = 1_000_000_000
UNITS = ("m", "rad", "ns", "us", "s", "m/s", "Pa", "K", "count", "m^2", "m/s^2", "rad/s")


@pytest.fixture(scope="module")
def log(tmp_path_factory):
    """A log of the service with records, frames and events on several channels."""
    folder = tmp_path_factory.mktemp("log")
    with retention.create_log(folder, metadata={}, start_unix_ns=10**18, start_ns=0) as log:
        for k, severity in enumerate(r.Severity):
            log.record(r.Event(k, k, severity, f"text {k}"), "/link/Event" if k % 2 else None)
            log.frame("udp", bool(k % 2), b"\xfd", k)
        log.record(r.Gnss(9, 9, 0, 1, 3, 0.5, 0.6, 120.0, 1.0, 2.0, alt=140.0))
        log.record(r.Truth(9, 9, 0.5, 0.6, 120.0, (0.0, 0.0, 0.0)))
        log.record(r.Imu(9, 9, 0, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)))
        log.record(r.Imu(9, 9, 0, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)), "/replay/Imu")
    return log.path


@pytest.mark.parametrize("kind", r.BY_NAME.values(), ids=lambda kind: kind.__name__)
def test_every_field_has_a_description_and_every_number_a_unit(kind):
    schema = json.loads(schemas.record_schema(kind))
    assert schema["type"] == "object" and "$ref" not in schema
    for part in (schema, *schema.get("$defs", {}).values()):
        for name, field in part.get("properties", {}).items():
            if name == "type":
                continue
            assert field["description"]
            physical = name.startswith(("lat", "lon", "alt", "sigma", "azimuth", "heading"))
            if physical or name.endswith(("_n", "_b", "_s", "_ns", "_us")):
                assert field["description"].replace(",", " ").replace(":", " ").split()[0] in UNITS, name


def test_names_of_units_agree_with_the_names_of_fields():
    for name, text in schemas.FIELDS.items():
        if name.endswith("_ns"):
            assert text.startswith("ns")
        if name.endswith("_s"):
            assert text.startswith("s")
    assert "mean sea level" in schemas.FIELDS["alt_msl"] and "ellipsoid" in schemas.FIELDS["alt"]


def test_no_field_of_the_table_is_unknown():
    names = {
        field for kind in (*r.BY_NAME.values(), r.Prediction, r.Bounds) for field in kind.__struct_fields__
    }
    assert {name.rsplit(".", 1)[-1] for name in schemas.FIELDS} == names


def test_each_schema_is_written_once_and_every_channel_has_one(log):
    with log.open("rb") as stream:
        summary = make_reader(stream).get_summary()
    assert all(channel.schema_id for channel in summary.channels.values())
    assert set(Counter(schema.name for schema in summary.schemas.values()).values()) == {1}
    frames = [c for c in summary.channels.values() if c.message_encoding == "mavlink"]
    assert {summary.schemas[c.schema_id].name for c in frames} == {"mavlink"} and len(frames) == 2


def test_dialect_is_attached_and_is_the_one_in_use(log):
    with log.open("rb") as stream:
        (found,) = make_reader(stream).iter_attachments()
    assert found.name == "rsbn.xml"
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / found.name
        path.write_bytes(found.data)
        parsed = mavparse.MAVXML(str(path), mavparse.PROTOCOL_2_0)
    assert {m.id for m in parsed.message} == {
        value
        for name, value in vars(rsbn_dialect).items()
        if name.startswith("MAVLINK_MSG_ID_") and value >= 180000
    }


def test_events_are_foxglove_logs(log):
    with log.open("rb") as stream:
        found = [json.loads(m.data) for _, c, m in make_reader(stream).iter_messages() if c.topic == "/log"]
    assert [one["message"] for one in found] == [f"text {k}" for k in range(8)]
    assert [one["level"] for one in found] == [5, 5, 5, 4, 3, 2, 2, 1]
    assert all(one["timestamp"]["sec"] == 10**9 for one in found)
    assert set(found[0]) == set(schemas.LOG["properties"])


def test_map_positions_are_degrees_above_mean_sea_level(log):
    with log.open("rb") as stream:
        found = {
            c.topic: json.loads(m.data)
            for s, c, m in make_reader(stream).iter_messages()
            if s is not None and s.name == location_fix.SCHEMA_NAME
        }
    assert found["/map/gnss"]["latitude"] == pytest.approx(28.64788975654116)
    assert {one["altitude"] for one in found.values()} == {120.0}


def test_a_recovered_log_keeps_its_attachment(log, tmp_path):
    torn = tmp_path / "x.mcap.active"
    torn.write_bytes(log.read_bytes()[:-200])
    with recover(torn).path.open("rb") as stream:
        (found,) = make_reader(stream).iter_attachments()
    assert found.name == "rsbn.xml"


def test_foxglove_layout_names_topics_and_fields_of_a_log():
    layout = Path(__file__).parents[2] / "deploy" / "foxglove" / "layout.json"
    panels = json.loads(layout.read_text())["configById"]
    paths = [path["value"] for panel in panels.values() for path in panel.get("paths", ())]
    assert len(paths) == 5
    for path in paths:
        topic, field = path.split("[")[0].rsplit(".", 1)
        assert topic == "/out/Solution" and field in r.Solution.__struct_fields__
    assert panels["RosOut!events"]["topicToRender"] == schemas.LOG_TOPIC
    assert set(panels["map!companion"]["topicColors"]) == {
        f"/map/{n}" for n in ("solution", "inertial", "gnss", "truth")
    }
