"""The committed dialect matches the XML; decode, payload and pymavlink agree on every message."""

import ast
import random
from pathlib import Path
from typing import NamedTuple

import pytest

from companion.link import dialect
from companion.link.frame import Frame
from companion.records import Gnss, Severity


def frame_of(msgid: int, payload: bytes) -> Frame:
    return Frame(msgid, payload, 7, 3, 9, None, b"")


def test_committed_module_matches_the_xml(tmp_path: Path) -> None:
    dialect.regenerate(tmp_path / "rsbn_dialect.py")
    made = (tmp_path / "rsbn_dialect.py").read_text()
    assert ast.dump(ast.parse(made)) == ast.dump(ast.parse(Path(dialect.rsbn.__file__).read_text()))


def test_own_messages_use_the_private_range_and_do_not_collide() -> None:
    lacking = {397: 182, 514: 197}  # CRC_EXTRA as generated from common.xml and development.xml
    assert set(dialect.rsbn.mavlink_map) == {*range(180000, 180005), *lacking}
    assert {msgid: dialect.TYPES[msgid].crc_extra for msgid in lacking} == lacking
    assert not set(dialect.rsbn.mavlink_map) & set(dialect.mavlink.mavlink_map)


@pytest.mark.parametrize("msgid", sorted(dialect.TYPES))
def test_decode_agrees_with_the_generated_constructor_on_random_payloads(msgid: int) -> None:
    kind = dialect.TYPES[msgid]
    rng = random.Random(msgid)
    payload = rng.randbytes(kind.layout.size)
    message = dialect.decode(frame_of(msgid, payload))
    arguments = {}
    values = kind.layout.unpack(payload)
    for name, first, length, text in kind.fields:
        value = values[first] if length == 1 else list(values[first : first + length])
        arguments[name] = value.rstrip(b"\0") if text else value
    built = kind.cls(**arguments)
    assert repr(message.to_dict()) == repr(built.to_dict())  # by repr: NaN is equal to itself there
    assert set(vars(message)) == set(vars(built))
    assert (message.get_type(), message.get_msgId(), dialect.id_of(message)) == (kind.name, msgid, msgid)
    assert (message.get_srcSystem(), message.get_srcComponent(), message.get_seq()) == (3, 9, 7)
    sane = dialect.new(kind.name, **{f.name: 1 for f in kind.fields if f.length == 1 and not f.text})
    sender = dialect.mavlink.MAVLink(None)
    if kind.name == "TEST_TYPES":
        return  # its one-character field has a default that pymavlink itself cannot pack
    sane.pack(sender)
    assert bytes(sane.get_payload()) == (dialect.payload(sane).rstrip(b"\0") or b"\0")


def test_trimmed_payload_is_padded_and_a_longer_one_is_cut() -> None:
    message = dialect.decode(frame_of(32, b""))
    assert (message.time_boot_ms, message.x) == (0, 0.0)
    whole = dialect.payload(dialect.new("LOCAL_POSITION_NED", x=4.0))
    assert dialect.decode(frame_of(32, whole + b"from the future")).x == 4.0


def test_rsbn_measurement_keeps_its_precision() -> None:
    sent = dialect.rsbn.MAVLink_rsbn_measurement_message(
        1_700_000_000_000_000, 557_512_345, 376_123_456, 187.5, 6.1, 250_000.0, 0.004, 200.0, 12, 3
    )
    got = dialect.decode(frame_of(180000, dialect.payload(sent)))
    assert (got.time_usec, got.beacon_lat, got.beacon_id, got.status) == (
        1_700_000_000_000_000,
        557_512_345,
        12,
        3,
    )
    assert got.azimuth == pytest.approx(6.1, abs=2.5e-7)  # 6 cm at 250 km


def test_invalid_names_and_values_are_reported() -> None:
    with pytest.raises(ValueError, match="'GPS_RAW_IN'; did you mean GPS_RAW_INT"):
        dialect.new("GPS_RAW_IN")
    with pytest.raises(ValueError, match="HEARTBEAT has no field 'kind'"):
        dialect.new("HEARTBEAT", kind=1)
    with pytest.raises(ValueError, match="HEARTBEAT cannot be packed"):
        dialect.payload(dialect.new("HEARTBEAT", type=300))


def test_any_object_with_the_fields_of_a_frame_can_be_decoded() -> None:
    class Replayed(NamedTuple):
        msgid: int
        payload: bytes
        sequence: int
        system: int
        component: int

    assert dialect.decode(Replayed(253, b"\x06hello", 0, 1, 1)).text == "hello"


def test_records_agree_with_the_enums_of_the_dialect() -> None:
    for severity in Severity:
        assert severity == getattr(dialect.mavlink, f"MAV_SEVERITY_{severity.name}")
    for fix, entry in dialect.mavlink.enums["GPS_FIX_TYPE"].items():
        is_3d = fix >= dialect.mavlink.GPS_FIX_TYPE_3D_FIX
        assert Gnss(0, 0, 0, 0, fix, 0.0, 0.0, 0.0).has_3d_fix == is_3d, entry.name
