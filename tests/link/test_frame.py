"""Frame reader: known frames whole, byte by byte and with junk around them; noise, loss and random bytes."""

import json
import random
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from companion.link import dialect, frame
from companion.link.frame import BadFrame, Counts, Frame, Reader, Reason, UnknownFrame, encode

VECTORS = json.loads((Path(__file__).parents[1] / "data" / "mavlink_vectors.json").read_text())
GOOD = [v for v in VECTORS if v.get("verified")]
NOT_FRAMES = [v for v in VECTORS if not v.get("verified")]
KINDS = (
    "ATTITUDE",
    "LOCAL_POSITION_NED",
    "GPS_RAW_INT",
    "HEARTBEAT",
    "STATUSTEXT",
    "HIGHRES_IMU",
    "RSBN_MEASUREMENT",
)


def message(rng: random.Random) -> dialect.Message:
    kind = dialect.type_named(rng.choice(KINDS))
    values = {f.name: rng.randrange(120) for f in kind.fields if f.length == 1 and not f.text}
    return dialect.new(kind.name, **values)


def stream(count: int, seed: int) -> list[bytes]:
    rng = random.Random(seed)
    return [encode(message(rng), i & 0xFF, 1, 1) for i in range(count)]


def read(data: bytes, step: int | None = None) -> tuple[Reader, list[frame.Event]]:
    reader = Reader()
    events: list[frame.Event] = []
    for i in range(0, len(data), step or len(data) or 1):
        events += reader.receive(data[i : i + (step or len(data))])
        assert reader.waiting <= frame.MAX_WAITING
    return reader, events + reader.close()


def frames(events: list[frame.Event]) -> list[Frame]:
    return [e for e in events if isinstance(e, Frame)]


@pytest.mark.parametrize("vector", GOOD, ids=lambda v: v["name"])
@pytest.mark.parametrize("step", [None, 1, 3])
@pytest.mark.parametrize("before", [b"", b"\x00\x55junk", b"\xfd", b"\xfe\x09", b"\xfd\x09\x00\x00"])
@pytest.mark.parametrize("after", [b"", b"\x00junk", b"\xfd"])
def test_foreign_frames_are_found_between_other_bytes(
    vector: dict, step: int | None, before: bytes, after: bytes
) -> None:
    raw = bytes.fromhex(vector["hex"])
    _, events = read(before + raw + after, step)
    assert [f.raw for f in frames(events)] == [raw]
    assert sum(e.size for e in events if isinstance(e, BadFrame)) == len(before + after)
    assert (frames(events)[0].signature is not None) == ("signed" in vector["name"])


def test_foreign_frames_decode_to_their_stated_values() -> None:
    by_name = {v["name"]: dialect.decode(frames(read(bytes.fromhex(v["hex"]))[1])[0]) for v in GOOD}
    heartbeat = by_name["v2 HEARTBEAT signed"]
    assert (heartbeat.type, heartbeat.autopilot, heartbeat.base_mode) == (1, 2, 3)
    assert (heartbeat.custom_mode, heartbeat.system_status) == (4, 5)
    flow = by_name["v2 OPTICAL_FLOW signed, trailing zeros kept inside extension"]
    assert (flow.time_usec, flow.sensor_id, flow.flow_x, flow.flow_y, flow.quality) == (1, 2, 3, 4, 7)
    assert (flow.ground_distance, flow.flow_rate_x, flow.flow_rate_y) == (8.0, 0.0, 1.0)
    command = by_name["v2 COMMAND_LONG sent WITHOUT zero-truncation (must be accepted)"]
    assert (command.command, command.param1, command.target_system) == (176, 1.0, 1)
    assert (command.get_seq(), command.get_srcSystem(), command.get_srcComponent()) == (11, 255, 220)
    param = by_name["v1 PARAM_SET with junk after string terminator"]
    assert (param.param_id, param.param_value, param.target_component) == ("RTL_ALT", 4936.0, 13)


@pytest.mark.parametrize("vector", NOT_FRAMES, ids=lambda v: v["name"])
def test_invalid_frames_are_not_accepted(vector: dict) -> None:
    raw = bytes.fromhex(vector["hex"])
    for step in (None, 1):
        _, events = read(raw, step)
        assert not frames(events)
        assert sum(e.size for e in events) == len(raw)


def test_encode_and_pymavlink_write_the_same_bytes() -> None:
    rng = random.Random(1)
    sender = dialect.mavlink.MAVLink(None, 5, 191)
    for i in range(200):
        sent = message(rng)
        ours = encode(sent, i & 0xFF, 5, 191)
        sender.seq = i & 0xFF
        assert ours == sent.pack(sender)
        (got,) = Reader().receive(ours)
        assert isinstance(got, Frame)
        assert dialect.decode(got).to_dict() == sent.to_dict()


def test_mavlink_1_with_its_extensions_left_out() -> None:
    sent = dialect.new("GPS_RAW_INT", lat=5, alt_ellipsoid=9)
    sender = dialect.mavlink.MAVLink(None, 5, 1)
    raw = bytearray(sent.pack(sender, force_mavlink1=True))
    (got,) = Reader().receive(bytes(raw))
    assert isinstance(got, Frame)
    assert raw[0] == 0xFE and dialect.decode(got).lat == 5
    short = b"\x1e" + raw[2:6] + raw[6:36]  # as a sender without the extensions would write it
    crc = frame._crc(short + bytes([dialect.TYPES[24].crc_extra]))
    (got,) = Reader().receive(b"\xfe" + short + crc.to_bytes(2, "little"))
    assert isinstance(got, Frame)
    assert dialect.decode(got).lat == 5 and dialect.decode(got).alt_ellipsoid == 0


def test_unknown_incompatibility_flags_reject_the_frame_and_not_the_next() -> None:
    first, second = stream(2, 3)
    changed = first[:2] + b"\x02" + first[3:]
    _, events = read(changed + second)
    assert events == [BadFrame(Reason.FLAGS, len(first)), frames(read(second)[1])[0]]


def unknown(payload: bytes, msgid: int = 190_000, sequence: int = 0) -> bytes:
    head = b"\xfd" + bytes((len(payload), 0, 0, sequence, 1, 1))
    return head + msgid.to_bytes(3, "little") + payload + b"\x12\x34"


@pytest.mark.parametrize("step", [None, 1])
def test_unknown_message_is_skipped_whole_and_reported(step: int | None) -> None:
    first, second = stream(2, 4)
    inside = encode(dialect.new("COMMAND_LONG", command=400), 0, 255, 190)  # must not be decoded
    strange = unknown(inside)
    _, events = read(first + strange + second, step)
    assert [type(e) for e in events] == [Frame, UnknownFrame, Frame]
    assert events[1] == UnknownFrame(190_000, 0, 1, 1, len(strange))


@pytest.mark.parametrize(("sequences", "lost"), [((1, 2, 3), 0), ((0, 1, 4), 2), ((77, 2), 1)])
def test_unknown_messages_are_not_lost_frames(sequences: tuple[int, ...], lost: int) -> None:
    """The sender's frame 0 before, then unknown ones but for the last, which is known."""
    heartbeat = dialect.new("HEARTBEAT")
    strange = (unknown(b"12345", sequence=n) for n in sequences[:-1])
    data = b"".join((encode(heartbeat, 0, 1, 1), *strange, encode(heartbeat, sequences[-1], 1, 1)))
    reader, _ = read(data)
    assert reader.counts == {(1, 1): Counts(received=2, lost=lost)}
    assert reader.lost == lost


def test_unknown_id_in_noise_does_not_hide_the_next_frames() -> None:
    first, second, third = stream(3, 5)
    false_head = b"\xfd\xff\x00\x00\x00\x01\x01" + (190_000).to_bytes(3, "little")
    _, events = read(false_head + first + second + third + bytes(300))
    assert [f.raw for f in frames(events)] == [first, second, third]


def test_loss_is_counted_by_sender_and_a_repeated_frame_is_not_a_loss() -> None:
    sent = [encode(dialect.new("HEARTBEAT"), i & 0xFF, 1, 1) for i in range(600)]
    other = [encode(dialect.new("HEARTBEAT"), i & 0xFF, 1, 191) for i in range(10)]
    del sent[250:260]
    sent.insert(100, sent[99])
    reader, _ = read(b"".join(sent + other))
    assert reader.counts == {(1, 1): frame.Counts(591, 10), (1, 191): frame.Counts(10, 0)}


def test_number_of_sender_counters_is_bounded() -> None:
    reader, _ = read(b"".join(encode(dialect.new("HEARTBEAT"), 0, i >> 8, i & 0xFF) for i in range(5000)))
    assert len(reader.counts) == frame.MAX_SENDERS
    assert (reader.received, reader.lost) == (5000, 0)


def test_dropped_bytes_cost_fewer_frames_than_with_pymavlink() -> None:
    rng = random.Random(2024)
    sent = stream(20_000, 6)
    data = bytes(b for b in b"".join(sent) if rng.random() >= 1e-3)
    whole = set(sent)
    kept = [f for f in frames(read(data, 4096)[1]) if f.raw in whole]
    parser = dialect.mavlink.MAVLink(None)
    parser.robust_parsing = True
    theirs = 0
    for i in range(0, len(data), 4096):
        for m in parser.parse_buffer(data[i : i + 4096]) or []:
            theirs += bytes(m.get_msgbuf()) in whole
    assert len(kept) / len(sent) > 0.94
    assert len(kept) > theirs + 0.02 * len(sent)


def test_a_run_of_junk_is_reported_without_waiting_for_its_end() -> None:
    reader = Reader()
    assert reader.receive(bytes(3000)) == [BadFrame(Reason.JUNK, 1024)] * 2
    assert reader.waiting == 0
    assert reader.close() == [BadFrame(Reason.JUNK, 3000 - 2048)]


def test_frame_after_a_false_header_at_the_end_is_found_on_close() -> None:
    (first,) = stream(1, 7)
    reader = Reader()
    assert reader.receive(b"\xfd\xff\x00" + first) == []
    events = reader.close()
    assert [type(e) for e in events] == [BadFrame, Frame]
    assert events[0] == BadFrame(Reason.TORN, 3)
    assert reader.waiting == 0


pieces = st.one_of(
    st.binary(max_size=40),
    st.sampled_from([*stream(20, 8), unknown(b"payload"), b"\xfd", b"\xfe", b"\xfd\xff", bytes(300)]),
    st.sampled_from([v["hex"] for v in VECTORS]).map(bytes.fromhex),
)


@settings(max_examples=300)
@given(st.lists(pieces, max_size=12).map(b"".join), st.lists(st.integers(1, 400), max_size=12))
def test_events_do_not_depend_on_the_split_of_the_stream(data: bytes, cuts: list[int]) -> None:
    _, whole = read(data)
    reader = Reader()
    events: list[frame.Event] = []
    rest = data
    for cut in cuts:
        events += reader.receive(rest[:cut])
        rest = rest[cut:]
        assert reader.waiting <= frame.MAX_WAITING
    events += reader.receive(rest) + reader.close()
    assert events == whole
    assert sum(len(e.raw) if isinstance(e, Frame) else e.size for e in whole) == len(data)


@settings(max_examples=200)
@given(st.binary(max_size=60), st.integers(0, 5000))
def test_frames_between_noise_without_magic_are_all_found(noise: bytes, seed: int) -> None:
    noise = noise.replace(b"\xfd", b"").replace(b"\xfe", b"")
    sent = stream(4, seed)
    assert [f.raw for f in frames(read(noise.join([b"", *sent, b""]))[1])] == sent
