"""Signing: agreement with other implementations; forged, replayed and future frames; restarts."""

import hashlib
import json
import pathlib

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pymavlink.dialects.v20 import common

from companion.link import dialect, frame, signing
from companion.link.session import FrameRejected, MessageReceived, Session
from companion.link.signing import AHEAD, BEHIND, LEAD, MAX_TIMESTAMP, SignatureFault, Signing
from companion.runtime.state_file import replace_text
from tests.frames import on_wire, parsed

VECTORS = json.loads((pathlib.Path(__file__).parents[1] / "data" / "mavlink_vectors.json").read_text())
SIGNED = [vector for vector in VECTORS if "key_hex" in vector]
KEY, OTHER_KEY = bytes(range(32)), bytes(32)
SECOND = 1_000_000_000  # ns
TICKS = 100_000  # of a stamp in a second
NOON_NS = 1_800_000_000 * SECOND  # UNIX
NOON = (NOON_NS - signing.EPOCH_NS) // 10_000


def signed(
    stamp: int, key: bytes = KEY, link: int = 0, system: int = 255, component: int = 190
) -> frame.Frame:
    """Return a frame with any timestamp, signed without `Signing`."""

    def sign(data: bytes) -> bytes:
        head = bytes([link]) + stamp.to_bytes(6, "little")
        return head + hashlib.sha256(key + data + head).digest()[:6]

    return parsed(
        frame.encode(dialect.new("HEARTBEAT", type=6, mavlink_version=3), 0, system, component, sign)
    )


def at_noon(**options: object) -> Signing:
    """Return a signer whose trusted clock reads NOON at time 0."""
    here = Signing(KEY, **options)  # type: ignore[arg-type]
    here.set_time(NOON_NS, 0)
    return here


@pytest.mark.parametrize("vector", SIGNED, ids=lambda vector: vector["name"])
def test_foreign_signed_frames_are_genuine_with_their_key_only(
    vector: dict[str, str],
) -> None:
    found = parsed(bytes.fromhex(vector["hex"]))
    reason = Signing(bytes.fromhex(vector["key_hex"])).verify(found, 0)
    # one vector has the last timestamp of the 48 bits, after which no other could follow
    assert reason is (SignatureFault.FUTURE if found.raw[-12:-6] == b"\xff" * 6 else None)
    assert Signing(KEY).verify(found, 0) is SignatureFault.FORGED


def test_three_vectors_are_signed() -> None:
    assert len(SIGNED) == 3


@pytest.mark.parametrize("vector", SIGNED[:1], ids=lambda vector: vector["name"])
def test_signature_equals_that_of_another_implementation(vector: dict[str, str]) -> None:
    raw = bytes.fromhex(vector["hex"])
    found = parsed(raw)
    stamp = int.from_bytes(raw[-12:-6], "little")
    signer = Signing(bytes.fromhex(vector["key_hex"]), timestamp=stamp - 1)
    message = dialect.decode(found)
    again = frame.encode(
        message, found.sequence, found.system, found.component, lambda data: signer.sign(data, raw[-13], 0)
    )
    assert again == raw


def other_implementation(key: bytes | None) -> common.MAVLink:
    """pymavlink's reader and writer, with its own check of signatures."""
    other = common.MAVLink(None, srcSystem=255, srcComponent=190)
    if key is not None:
        other.signing.secret_key = key
        other.signing.sign_outgoing = True
        other.signing.timestamp = NOON
        other.signing.link_id = 3
    return other


@pytest.mark.parametrize("key", [None, KEY])
def test_session_and_another_implementation_read_each_other(key: bytes | None) -> None:
    other = other_implementation(key)
    session = Session(component=191, signing=at_noon() if key else None, link_id=7)
    session.poll(0)
    session.send(dialect.new("STATUSTEXT", severity=6, text="ready"))
    for value in range(300):
        session.send(dialect.new("PING", seq=value))
    sent = [other.decode(bytearray(data)) for data in session.to_send()]
    assert [m.get_type() for m in sent[:3]] == ["HEARTBEAT", "STATUSTEXT", "PING"]
    assert [m.seq for m in sent[2:]] == list(range(300))
    assert all(m.get_signed() == (key is not None) for m in sent)

    data = b"".join(other.param_request_list_encode(1, 191).pack(other) for _ in range(300))
    received = session.receive(data, SECOND)
    assert all(isinstance(event, MessageReceived) for event in received) and len(received) == 300


def test_another_implementation_rejects_our_frames_with_another_key() -> None:
    other = other_implementation(OTHER_KEY)
    session = Session(signing=at_noon())
    session.poll(0)
    with pytest.raises(common.MAVError, match="signature"):
        other.decode(bytearray(session.to_send()[0]))


def test_sessions_with_one_key_accept_each_other_and_reject_a_third() -> None:
    here = Session(component=191, signing=at_noon())
    there = Session(autopilot_system=255, component=190, signing=at_noon())
    stranger = Session(autopilot_system=255, component=190, signing=Signing(OTHER_KEY))
    for second in range(100):
        now = second * SECOND
        for session in (here, there, stranger):
            session.poll(now)
        mine, theirs, strange = (b"".join(s.to_send()) for s in (here, there, stranger))
        assert all(isinstance(e, MessageReceived) for e in there.receive(mine, now))
        assert all(isinstance(e, MessageReceived) for e in here.receive(theirs, now))
        assert all(isinstance(e, FrameRejected) for e in here.receive(strange, now))
    assert here.rejected == {SignatureFault.FORGED: 100} and not there.rejected


def test_forged_future_frame_does_not_lock_out_the_genuine_sender() -> None:
    session = Session(signing=at_noon())
    events = []
    for second in range(60):
        now = second * SECOND
        stamp = NOON + second * TICKS
        events += session.receive(signed(MAX_TIMESTAMP - 1, key=OTHER_KEY).raw, now)
        events += session.receive(signed(stamp).raw, now)
        events += session.receive(signed(stamp).raw, now)  # replayed
    received = [e for e in events if isinstance(e, MessageReceived)]
    assert len(received) == 60
    assert session.rejected == {SignatureFault.FORGED: 60, SignatureFault.REPLAYED: 60}
    assert {(e.system, e.component) for e in events if isinstance(e, FrameRejected)} == {(255, 190)}


def test_rejected_frames_count_neither_as_received_nor_as_lost() -> None:
    session, signer, forger = Session(signing=at_noon()), at_noon(), Signing(OTHER_KEY)
    for sequence in range(100):
        for who, number in ((signer, sequence), (forger, sequence + 50 & 0xFF)):
            sign = lambda data, who=who: who.sign(data, 0, 0)  # noqa: E731
            data = frame.encode(dialect.new("HEARTBEAT", type=6), number, 255, 190, sign)
            session.receive(data + data, 0)
    assert session.reader.counts == {(255, 190): frame.Counts(100, 0)}
    assert session.rejected == {SignatureFault.FORGED: 200, SignatureFault.REPLAYED: 100}


@settings(max_examples=200)
@given(at=st.integers(1, 100), flip=st.integers(1, 255))
def test_changed_byte_of_a_genuine_frame_is_detected(at: int, flip: int) -> None:
    raw = bytearray(signed(NOON).raw)
    at %= len(raw)
    raw[at] ^= flip
    end = len(raw) - frame.SIGNATURE_SIZE
    kind = dialect.TYPES[0]
    raw[end - 2 : end] = frame.crc16.mcrf4xx(bytes(raw[1 : end - 2]) + bytes([kind.crc_extra])).to_bytes(
        2, "little"
    )
    session = Session(signing=at_noon())
    events = session.receive(bytes(raw), 0)
    assert bytes(raw) == signed(NOON).raw or not any(isinstance(e, MessageReceived) for e in events)


def test_timestamps_are_tracked_by_link_system_and_component() -> None:
    here = at_noon()
    streams = [(0, 255, 190), (1, 255, 190), (0, 254, 190), (0, 255, 191)]
    for link, system, component in streams:
        for reason in (None, SignatureFault.REPLAYED):
            assert here.verify(signed(NOON, KEY, link, system, component), 0) is reason


@pytest.mark.parametrize(
    ("off", "reason"),
    [
        (-BEHIND - 1, SignatureFault.OLD),
        (-BEHIND, None),
        (AHEAD, None),
        (AHEAD + 1, SignatureFault.FUTURE),
        (365 * 86_400 * TICKS, SignatureFault.FUTURE),
    ],
)
def test_timestamp_of_a_new_stream_must_be_near_our_time(off: int, reason: SignatureFault | None) -> None:
    here = at_noon()
    assert here.verify(signed(NOON + off), 0) is reason
    assert here.verify(signed(NOON + 1, system=254), 0) is None  # other senders are not affected
    assert here.time(0) == NOON


def test_timestamp_of_a_known_stream_may_be_late_if_it_increases() -> None:
    here = at_noon()
    assert here.verify(signed(NOON), 0) is None
    assert here.verify(signed(NOON + 1), 3600 * SECOND) is None


def test_without_a_clock_our_time_is_the_newest_genuine_timestamp() -> None:
    here = Signing(KEY)
    assert here.verify(signed(NOON, key=OTHER_KEY), 0) is SignatureFault.FORGED
    assert here.time(0) == 0
    assert here.verify(signed(NOON), 0) is None
    assert int.from_bytes(here.sign(b"", 0, 0)[1:7], "little") == NOON + 1


def test_sent_timestamps_increase_and_follow_the_clock() -> None:
    here = at_noon()
    instants = [0, 0, 0, SECOND, SECOND, 10 * SECOND]
    stamps = [int.from_bytes(here.sign(b"", 0, now)[1:7], "little") for now in instants]
    assert stamps == sorted(set(stamps))
    assert stamps[-1] == NOON + 10 * TICKS
    here.set_time(NOON_NS - 3600 * SECOND, 10 * SECOND)  # the clock is set back
    assert int.from_bytes(here.sign(b"", 0, 10 * SECOND)[1:7], "little") == stamps[-1] + 1


def test_unsigned_frames_are_rejected_unless_configured() -> None:
    heartbeat = on_wire(dialect.new("HEARTBEAT"), 1, 1)
    radio = on_wire(dialect.new("RADIO_STATUS"), 51, 68)
    assert at_noon().verify(heartbeat, 0) is SignatureFault.UNSIGNED
    assert at_noon().verify(radio, 0) is None
    assert at_noon(always_accepted=()).verify(radio, 0) is SignatureFault.UNSIGNED
    lenient = at_noon(refuse_unsigned=False)
    assert lenient.verify(heartbeat, 0) is None
    assert (
        lenient.verify(signed(NOON, key=OTHER_KEY), 0) is SignatureFault.FORGED
    )  # a wrong signature is never accepted


@settings(max_examples=60)
@given(
    steps=st.lists(st.tuples(st.floats(0.0, 90.0), st.floats(-40.0, 50.0)), max_size=12),
    pause=st.floats(0.0, 200.0),
)
def test_nothing_accepted_before_a_restart_is_accepted_after_it(
    steps: list[tuple[float, float]], pause: float
) -> None:
    here, now, disk, accepted = at_noon(), 0, 0, []
    for wait, off in steps:
        now += int(wait * SECOND)
        received = signed(NOON + now // 10_000 + int(off * TICKS))
        if here.verify(received, now) is None:
            accepted.append(received)
        here.sign(b"", 0, now)
        if here.needs_saving:
            here.note_saved(disk := here.timestamp_to_save())
        assert (
            disk > max([here.time(0), *(int.from_bytes(a.raw[-12:-6], "little") for a in accepted)]) + BEHIND
        )
    after = Signing(KEY, timestamp=disk)
    after.set_time(NOON_NS + now, int(pause * SECOND))
    for received in accepted:
        assert after.verify(received, int(pause * SECOND)) is SignatureFault.OLD


def test_timestamps_after_a_restart_are_a_minute_ahead() -> None:
    here = at_noon()
    last = int.from_bytes(here.sign(b"", 0, 0)[1:7], "little")
    after = Signing(KEY, timestamp=here.timestamp_to_save())
    assert int.from_bytes(after.sign(b"", 0, 0)[1:7], "little") > last + 60 * TICKS
    assert LEAD == 60 * TICKS


def test_restarted_peer_is_accepted_at_once() -> None:
    here, there = at_noon(), at_noon()
    there.sign(b"", 0, 0)
    there = Signing(KEY, timestamp=there.timestamp_to_save())
    there.set_time(NOON_NS, SECOND)

    def sent(signer: Signing, system: int) -> frame.Frame:
        sign = lambda data: signer.sign(data, 0, SECOND)  # noqa: E731
        return parsed(frame.encode(dialect.new("HEARTBEAT"), 0, system, 1, sign))

    assert here.verify(sent(there, 2), SECOND) is None
    assert there.verify(sent(here, 1), SECOND) is None


def test_timestamp_file_is_read_back_and_an_invalid_one_is_reported(tmp_path: pathlib.Path) -> None:
    path = tmp_path / "stamp"
    assert signing.load_timestamp(path) == 0
    replace_text(path, f"{NOON}\n")
    replace_text(path, f"{NOON + 1}\n")
    assert signing.load_timestamp(path) == NOON + 1
    assert [p.name for p in tmp_path.iterdir()] == ["stamp"]
    for torn in ("", "-5", "12x"):
        path.write_text(torn)
        with pytest.raises(ValueError, match="holds no signing timestamp"):
            signing.load_timestamp(path)


def test_key_file_is_raw_or_hexadecimal_and_must_be_private(tmp_path: pathlib.Path) -> None:
    path = tmp_path / "key"
    with pytest.raises(ValueError, match="cannot be read"):
        signing.read_key(path)
    for text in (KEY, KEY.hex().encode(), KEY.hex().upper().encode() + b"\n"):
        path.write_bytes(text)
        path.chmod(0o600)
        assert signing.read_key(path) == KEY
    for mode in (0o640, 0o604, 0o644):
        path.chmod(mode)
        with pytest.raises(ValueError, match="chmod 600"):
            signing.read_key(path)
    path.chmod(0o600)
    for text in (b"", KEY[:31], KEY.hex()[:-1].encode(), b"z" * 64, b"\xff" * 64):
        path.write_bytes(text)
        with pytest.raises(ValueError, match="not a signing key"):
            signing.read_key(path)


def test_invalid_keys_timestamps_and_link_ids_are_rejected() -> None:
    with pytest.raises(ValueError, match="32 bytes"):
        Signing(b"short")
    with pytest.raises(ValueError, match="out of range"):
        Signing(KEY, timestamp=MAX_TIMESTAMP)
    with pytest.raises(ValueError, match="link_id 256"):
        Session(link_id=256)


def test_radio_status_without_a_signature_proves_nobody() -> None:
    """It is accepted on a signed link, but makes no autopilot, keeps no link up and replaces no client."""
    key = bytes(range(32))
    session = Session(signing=Signing(key))
    status = frame.encode(dialect.new("RADIO_STATUS", rssi=1), 0, 1, 1)
    assert not session.judge()(status, 0)
    signing = Signing(key)
    beat = dialect.new("HEARTBEAT", type=1, autopilot=3)
    genuine = frame.encode(beat, 0, 1, 1, lambda data: signing.sign(data, 0, 0))
    is_proven = session.judge()
    assert [is_proven(part, 0) for part in (status, genuine[:9], genuine[9:])] == [False, False, True]
    session.receive(genuine, 0)
    assert session.is_up
    for k in range(1, 8):
        session.receive(status, k * 10**9)
        session.poll(k * 10**9)
    assert not session.is_up
