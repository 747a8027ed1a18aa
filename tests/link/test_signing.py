"""Signatures: what other implementations made and read; forged, replayed and future frames; restarts."""

import hashlib
import json
import pathlib

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pymavlink.dialects.v20 import common

from companion.link import dialect, frame, signing
from companion.link.session import MessageReceived, Refused, Session
from companion.link.signing import AHEAD, BEHIND, FARTHEST, LEAD, Refusal, Signing

VECTORS = json.loads((pathlib.Path(__file__).parents[1] / "data" / "mavlink_vectors.json").read_text())
SIGNED = [vector for vector in VECTORS if "key_hex" in vector]
KEY, OTHER_KEY = bytes(range(32)), bytes(32)
SECOND = 1_000_000_000  # ns
TICKS = 100_000  # of a stamp in a second
NOON_NS = 1_800_000_000 * SECOND  # UNIX
NOON = (NOON_NS - signing.EPOCH_NS) // 10_000


def one(data: bytes) -> frame.Frame:
    found = frame.examine(data)
    assert isinstance(found, frame.Frame)
    return found


def signed(
    stamp: int, key: bytes = KEY, link: int = 0, system: int = 255, component: int = 190
) -> frame.Frame:
    """A frame with any stamp; made without our own signer."""

    def sign(data: bytes) -> bytes:
        head = bytes([link]) + stamp.to_bytes(6, "little")
        return head + hashlib.sha256(key + data + head).digest()[:6]

    return one(frame.encode(dialect.new("HEARTBEAT", type=6, mavlink_version=3), 0, system, component, sign))


def at_noon(**options: object) -> Signing:
    """A signer whose trusted clock says NOON at instant 0."""
    here = Signing(KEY, **options)  # type: ignore[arg-type]
    here.follow(NOON_NS, 0)
    return here


@pytest.mark.parametrize("vector", SIGNED, ids=lambda vector: vector["name"])
def test_frames_signed_elsewhere_are_genuine_under_their_key_and_forged_under_another(
    vector: dict[str, str],
) -> None:
    found = one(bytes.fromhex(vector["hex"]))
    reason = Signing(bytes.fromhex(vector["key_hex"])).judge(found, 0)
    # one vector stamps the last instant of the 48 bits, which nobody could follow
    assert reason is (Refusal.FUTURE if found.raw[-12:-6] == b"\xff" * 6 else None)
    assert Signing(KEY).judge(found, 0) is Refusal.FORGED


def test_three_vectors_are_signed() -> None:
    assert len(SIGNED) == 3


@pytest.mark.parametrize("vector", SIGNED[:1], ids=lambda vector: vector["name"])
def test_we_sign_as_another_implementation_does_byte_for_byte(vector: dict[str, str]) -> None:
    raw = bytes.fromhex(vector["hex"])
    found = one(raw)
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
def test_another_implementation_reads_all_that_a_session_says_and_is_read(key: bytes | None) -> None:
    other = other_implementation(key)
    session = Session(system=1, component=191, signing=at_noon() if key else None, link_id=7)
    session.poll(0)
    session.send(dialect.new("STATUSTEXT", severity=6, text="ready"))
    for value in range(300):
        session.send(dialect.new("PING", seq=value))
    said = [other.decode(bytearray(data)) for data in session.to_send()]
    assert [m.get_type() for m in said[:3]] == ["HEARTBEAT", "STATUSTEXT", "PING"]
    assert [m.seq for m in said[2:]] == list(range(300))
    assert all(m.get_signed() == (key is not None) for m in said)

    data = b"".join(other.param_request_list_encode(1, 191).pack(other) for _ in range(300))
    heard = session.receive(data, SECOND)
    assert all(isinstance(event, MessageReceived) for event in heard) and len(heard) == 300


def test_another_implementation_refuses_us_under_another_key() -> None:
    other = other_implementation(OTHER_KEY)
    session = Session(system=1, signing=at_noon())
    session.poll(0)
    with pytest.raises(common.MAVError, match="signature"):
        other.decode(bytearray(session.to_send()[0]))


def test_two_sessions_of_one_key_hear_each_other_and_a_third_neither() -> None:
    here = Session(system=1, component=191, signing=at_noon())
    there = Session(system=255, component=190, signing=at_noon())
    stranger = Session(system=255, component=190, signing=Signing(OTHER_KEY))
    for second in range(100):
        now = second * SECOND
        for session in (here, there, stranger):
            session.poll(now)
        mine, theirs, strange = (b"".join(s.to_send()) for s in (here, there, stranger))
        assert all(isinstance(e, MessageReceived) for e in there.receive(mine, now))
        assert all(isinstance(e, MessageReceived) for e in here.receive(theirs, now))
        assert all(isinstance(e, Refused) for e in here.receive(strange, now))
    assert here.refused == {Refusal.FORGED: 100} and not there.refused


def test_a_forged_frame_of_the_future_does_not_lock_the_genuine_sender_out() -> None:
    session = Session(system=1, signing=at_noon())
    events = []
    for second in range(60):
        now = second * SECOND
        stamp = NOON + second * TICKS
        events += session.receive(signed(FARTHEST - 1, key=OTHER_KEY).raw, now)
        events += session.receive(signed(stamp).raw, now)
        events += session.receive(signed(stamp).raw, now)  # caught and played back
    heard = [e for e in events if isinstance(e, MessageReceived)]
    assert len(heard) == 60
    assert session.refused == {Refusal.FORGED: 60, Refusal.REPLAYED: 60}
    assert {(e.system, e.component) for e in events if isinstance(e, Refused)} == {(255, 190)}


def test_forged_and_repeated_frames_are_not_counted_as_frames_nor_as_losses() -> None:
    session, signer, forger = Session(system=1, signing=at_noon()), at_noon(), Signing(OTHER_KEY)
    for sequence in range(100):
        for who, number in ((signer, sequence), (forger, sequence + 50 & 0xFF)):
            sign = lambda data, who=who: who.sign(data, 0, 0)  # noqa: E731
            data = frame.encode(dialect.new("HEARTBEAT", type=6), number, 255, 190, sign)
            session.receive(data + data, 0)
    assert session.reader.counts == {(255, 190): frame.Counts(100, 0)}
    assert session.refused == {Refusal.FORGED: 200, Refusal.REPLAYED: 100}


@settings(deadline=None, max_examples=200)
@given(at=st.integers(1, 100), flip=st.integers(1, 255))
def test_no_byte_of_a_genuine_frame_can_be_changed(at: int, flip: int) -> None:
    raw = bytearray(signed(NOON).raw)
    at %= len(raw)
    raw[at] ^= flip
    end = len(raw) - frame.SIGNATURE_SIZE
    kind = dialect.TYPES[0]
    raw[end - 2 : end] = frame.crc16.mcrf4xx(bytes(raw[1 : end - 2]) + bytes([kind.crc_extra])).to_bytes(
        2, "little"
    )
    session = Session(system=1, signing=at_noon())
    events = session.receive(bytes(raw), 0)
    assert bytes(raw) == signed(NOON).raw or not any(isinstance(e, MessageReceived) for e in events)


def test_stamps_count_by_link_system_and_component() -> None:
    here = at_noon()
    streams = [(0, 255, 190), (1, 255, 190), (0, 254, 190), (0, 255, 191)]
    for link, system, component in streams:
        for reason in (None, Refusal.REPLAYED):
            assert here.judge(signed(NOON, KEY, link, system, component), 0) is reason


@pytest.mark.parametrize(
    ("off", "reason"),
    [
        (-BEHIND - 1, Refusal.OLD),
        (-BEHIND, None),
        (AHEAD, None),
        (AHEAD + 1, Refusal.FUTURE),
        (365 * 86_400 * TICKS, Refusal.FUTURE),
    ],
)
def test_a_new_stream_must_be_of_our_time(off: int, reason: Refusal | None) -> None:
    here = at_noon()
    assert here.judge(signed(NOON + off), 0) is reason
    assert here.judge(signed(NOON + 1, system=254), 0) is None  # nobody else is harmed
    assert here.time(0) == NOON


def test_a_known_stream_may_be_late_as_long_as_it_grows() -> None:
    here = at_noon()
    assert here.judge(signed(NOON), 0) is None
    assert here.judge(signed(NOON + 1), 3600 * SECOND) is None


def test_without_a_clock_time_is_what_genuine_frames_say() -> None:
    here = Signing(KEY)
    assert here.judge(signed(NOON, key=OTHER_KEY), 0) is Refusal.FORGED
    assert here.time(0) == 0
    assert here.judge(signed(NOON), 0) is None
    assert int.from_bytes(here.sign(b"", 0, 0)[1:7], "little") == NOON + 1


def test_stamps_always_grow_and_keep_with_the_clock() -> None:
    here = at_noon()
    instants = [0, 0, 0, SECOND, SECOND, 10 * SECOND]
    stamps = [int.from_bytes(here.sign(b"", 0, now)[1:7], "little") for now in instants]
    assert stamps == sorted(set(stamps))
    assert stamps[-1] == NOON + 10 * TICKS
    here.follow(NOON_NS - 3600 * SECOND, 10 * SECOND)  # the clock is set back
    assert int.from_bytes(here.sign(b"", 0, 10 * SECOND)[1:7], "little") == stamps[-1] + 1


def test_unsigned_frames_are_refused_but_for_those_let_in_by_configuration() -> None:
    heartbeat = one(frame.encode(dialect.new("HEARTBEAT"), 0, 1, 1))
    radio = one(frame.encode(dialect.new("RADIO_STATUS"), 0, 51, 68))
    assert at_noon().judge(heartbeat, 0) is Refusal.UNSIGNED
    assert at_noon().judge(radio, 0) is None
    assert at_noon(always_accepted=()).judge(radio, 0) is Refusal.UNSIGNED
    lenient = at_noon(refuse_unsigned=False)
    assert lenient.judge(heartbeat, 0) is None
    assert (
        lenient.judge(signed(NOON, key=OTHER_KEY), 0) is Refusal.FORGED
    )  # a wrong signature is never let in


@settings(deadline=None, max_examples=60)
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
        heard = signed(NOON + now // 10_000 + int(off * TICKS))
        if here.judge(heard, now) is None:
            accepted.append(heard)
        here.sign(b"", 0, now)
        if here.wants_storing:
            disk = here.to_store()
        assert (
            disk > max([here.time(0), *(int.from_bytes(a.raw[-12:-6], "little") for a in accepted)]) + BEHIND
        )
    after = Signing(KEY, timestamp=disk)
    after.follow(NOON_NS + now, int(pause * SECOND))
    for heard in accepted:
        assert after.judge(heard, int(pause * SECOND)) is Refusal.OLD


def test_after_a_restart_our_stamps_are_at_least_a_minute_ahead_of_the_last_ones() -> None:
    here = at_noon()
    last = int.from_bytes(here.sign(b"", 0, 0)[1:7], "little")
    after = Signing(KEY, timestamp=here.to_store())
    assert int.from_bytes(after.sign(b"", 0, 0)[1:7], "little") > last + 60 * TICKS
    assert LEAD == 60 * TICKS


def test_a_peer_just_restarted_is_believed_at_once() -> None:
    here, there = at_noon(), at_noon()
    there.sign(b"", 0, 0)
    there = Signing(KEY, timestamp=there.to_store())
    there.follow(NOON_NS, SECOND)

    def said(signer: Signing, system: int) -> frame.Frame:
        sign = lambda data: signer.sign(data, 0, SECOND)  # noqa: E731
        return one(frame.encode(dialect.new("HEARTBEAT"), 0, system, 1, sign))

    assert here.judge(said(there, 2), SECOND) is None
    assert there.judge(said(here, 1), SECOND) is None


def test_the_stamp_on_disk_survives_and_says_when_it_is_none(tmp_path: pathlib.Path) -> None:
    path = tmp_path / "stamp"
    assert signing.stored(path) == 0
    signing.store(path, NOON)
    signing.store(path, NOON + 1)
    assert signing.stored(path) == NOON + 1
    assert [p.name for p in tmp_path.iterdir()] == ["stamp"]
    for torn in ("", "-5", "12x"):
        path.write_text(torn)
        with pytest.raises(ValueError, match="holds no stamp"):
            signing.stored(path)


def test_a_key_is_read_raw_or_in_hexadecimal_and_must_be_secret(tmp_path: pathlib.Path) -> None:
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
        with pytest.raises(ValueError, match="no signing key"):
            signing.read_key(path)


def test_impossible_keys_stamps_and_links_are_refused() -> None:
    with pytest.raises(ValueError, match="32 bytes"):
        Signing(b"short")
    with pytest.raises(ValueError, match="no stamp of this century"):
        Signing(KEY, timestamp=FARTHEST)
    with pytest.raises(ValueError, match="link_id 256"):
        Session(link_id=256)
