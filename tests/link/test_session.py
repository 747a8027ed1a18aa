"""A session and a simulated autopilot joined without a network, with a simulated clock."""

import random
from collections import deque

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from companion.link import dialect, frame
from companion.link.session import (
    BadFrame,
    ClockJump,
    ClockRate,
    Event,
    LinkLate,
    LinkLost,
    LinkUp,
    MappingStepped,
    MessageReceived,
    NotUnderstood,
    Rebooted,
    SecondAutopilot,
    Session,
    TimesyncOutlier,
)
from tests.frames import parsed

MS = 1_000_000
SECOND = 1000 * MS
PLANE, GCS, ARDUPILOT, INVALID = 1, 6, 3, 8
LOCAL_POSITION = 32


class Autopilot:
    """The autopilot side: obeys SET_MESSAGE_INTERVAL and answers TIMESYNC unless switched off."""

    def __init__(self, system: int = 7, booted: int = 0) -> None:
        self.system, self.booted, self.sequence = system, booted, 0
        self.reader = frame.Reader()
        self.received: list[dialect.Message] = []
        self.intervals: dict[int, int] = {}
        self.obeys = self.answers = True
        self.limit_hz: float | None = None  # a faster rate is refused, in an answer that names no message

    def message(self, name: str, **values: object) -> bytes:
        self.sequence = self.sequence + 1 & 0xFF
        return frame.encode(dialect.new(name, **values), self.sequence, self.system, 1)

    def heartbeat(self) -> bytes:
        return self.message("HEARTBEAT", type=PLANE, autopilot=ARDUPILOT)

    def step(self, now: int, data: bytes) -> bytes:
        """Process `data` and return the messages that are due."""
        boot = now - self.booted
        sent = b""
        for found in self.reader.receive(data):
            assert isinstance(found, frame.Frame)
            message = dialect.decode(found)
            self.received.append(message)
            if found.msgid == 76 and message.command == 511 and self.obeys:
                is_refused = self.limit_hz is not None and message.param2 < 1e6 / self.limit_hz
                self.intervals[int(message.param1)] = SECOND if is_refused else int(message.param2) * 1000
                if self.answers and self.limit_hz is not None:
                    sent += self.message("COMMAND_ACK", command=511, result=2 if is_refused else 0)
            if found.msgid == 111 and message.tc1 == 0 and self.answers:
                sent += self.message("TIMESYNC", tc1=boot, ts1=message.ts1)
        if boot % SECOND == 0:
            sent += self.heartbeat()
        if (every := self.intervals.get(LOCAL_POSITION)) and boot % every < 10 * MS:
            sent += self.message("LOCAL_POSITION_NED", time_boot_ms=boot // MS)
        return sent

    def names(self) -> list[str]:
        return [message.get_type() for message in self.received]


def run(session: Session, peer: Autopilot | None, start: int, seconds: float, delay: int = 0) -> list[Event]:
    """Run both, `delay` each way, in steps of 10 ms; the session is polled at its deadlines only."""
    events: list[Event] = []
    to_peer: list[tuple[int, bytes]] = []
    to_session: list[tuple[int, bytes]] = []
    now = start
    while now < start + seconds * SECOND:
        if now >= session.deadline():
            events += session.poll(now)
            assert session.deadline() > now
        received = b"".join(d for at, d in to_session if at <= now)
        to_session = [(at, d) for at, d in to_session if at > now]
        events += session.receive(received, now)
        to_peer += [(now + delay, d) for d in session.to_send()]
        if peer is not None:
            data = b"".join(d for at, d in to_peer if at <= now)
            to_peer = [(at, d) for at, d in to_peer if at > now]
            if sent := peer.step(now, data):
                to_session.append((now + max(delay, 1), sent))
        now += 10 * MS
    return events


def kinds(events: list[Event]) -> list[type]:
    return [type(e) for e in events if not isinstance(e, MessageReceived)]


def test_autopilot_is_adopted_lost_and_found_again() -> None:
    session, peer = Session(), Autopilot()
    events = run(session, peer, 0, 3)
    assert kinds(events) == [LinkUp]
    assert events[0].system == 7 == session.system == session.autopilot
    assert events[0].autopilot == ARDUPILOT and session.is_up
    events = run(session, None, 3 * SECOND, 10)
    assert kinds(events) == [LinkLost]
    lost = next(e for e in events if isinstance(e, LinkLost))
    assert lost.at_ns - lost.last_received_ns == 5 * SECOND and not session.is_up
    assert kinds(run(session, peer, 13 * SECOND, 3)) == [LinkUp]


def test_heartbeat_is_sent_each_second_with_the_vehicle_s_system_id() -> None:
    session, peer = Session(component=197), Autopilot()
    run(session, peer, 0, 10)
    beats = [m for m in peer.received if m.get_type() == "HEARTBEAT"]
    assert len(beats) == 10
    assert (beats[-1].type, beats[-1].autopilot, beats[-1].system_status) == (18, INVALID, 4)
    assert (beats[-1].get_srcSystem(), beats[-1].get_srcComponent()) == (7, 197)
    assert all(counts.lost == 0 for counts in peer.reader.counts.values())


def test_only_heartbeat_is_sent_before_an_autopilot_is_received() -> None:
    session, silent = Session(rates_hz={"LOCAL_POSITION_NED": 10}), Autopilot()
    silent.step = lambda now, data: (
        silent.received.extend(  # type: ignore[method-assign]
            dialect.decode(f) for f in silent.reader.receive(data)
        )
        or b""
    )
    assert run(session, silent, 0, 5) == []
    assert set(silent.names()) == {"HEARTBEAT"}


def test_timesync_finds_the_boot_time_through_a_slow_link() -> None:
    session, peer = Session(rates_hz={"LOCAL_POSITION_NED": 10}), Autopilot(booted=-500 * SECOND)
    run(session, peer, 0, 10, delay=30 * MS)
    assert abs(session.clock.local(505 * SECOND, 10 * SECOND) - 5 * SECOND) <= 10 * MS
    peer = Autopilot(booted=-500 * SECOND)
    peer.answers = False
    session = Session(rates_hz={"LOCAL_POSITION_NED": 10})
    run(session, peer, 0, 10, delay=30 * MS)
    assert session.clock.uncertainty(10 * SECOND) is None
    assert session.clock.local(505 * SECOND, 10 * SECOND) - 5 * SECOND == pytest.approx(40 * MS, abs=11 * MS)


def test_an_answer_to_another_station_is_none_to_us() -> None:
    """A link on which the autopilot does not receive us must not lead because it answers a station."""
    session, peer = Session(), Autopilot()
    run(session, peer, 0, 3)
    assert session.is_answered(3 * SECOND)
    peer.answers = False
    for second in range(3, 20):
        run(session, peer, second * SECOND, 1)
        to_station = peer.message("TIMESYNC", tc1=second * SECOND, ts1=123_456_789_000 + second)
        session.receive(to_station, (second + 1) * SECOND)
    assert session.is_up and not session.is_answered(20 * SECOND)


def test_timesync_request_is_answered_at_once() -> None:
    session, peer = Session(), Autopilot()
    session.receive(peer.heartbeat() + peer.message("TIMESYNC", ts1=4242), 9 * SECOND)
    (answer,) = [dialect.decode(f) for data in session.to_send() for f in frame.Reader().receive(data)]
    assert (answer.get_type(), answer.tc1, answer.ts1) == ("TIMESYNC", 9 * SECOND, 4242)


def test_flood_of_timesync_requests_is_rate_limited() -> None:
    session, asked = Session(), frame.encode(dialect.new("TIMESYNC", ts1=7), 0, 255, 190)
    answers = 0
    for ms in range(2000):
        session.receive(asked, ms * 1_000_000)
        answers += len(session.to_send())
    assert answers == pytest.approx(10 + 2 * 20, abs=1)


def test_reboot_is_detected_and_rates_are_requested_again() -> None:
    session, peer = Session(rates_hz={"LOCAL_POSITION_NED": 10}), Autopilot(booted=-100 * SECOND)
    run(session, peer, 0, 10)
    peer.booted, peer.received = 9 * SECOND, []
    events = run(session, peer, 10 * SECOND, 3)
    # a TIMESYNC answer arrives before the two stamps that reveal the reboot: it seems to be of another clock
    assert kinds(events) == [TimesyncOutlier, Rebooted]
    assert "COMMAND_LONG" in peer.names()
    assert abs(session.clock.local(2 * SECOND, 20 * SECOND) - 11 * SECOND) <= 10 * MS


def test_forward_clock_jump_is_reported_once_with_its_size_and_followed() -> None:
    session, peer = Session(rates_hz={"LOCAL_POSITION_NED": 10}), Autopilot(booted=-100 * SECOND)
    run(session, peer, 0, 10)
    peer.booted -= 3600 * SECOND
    events = [e for e in run(session, peer, 10 * SECOND, 10) if isinstance(e, ClockJump)]
    assert [round(e.by_ns / SECOND) for e in events] == [3600]
    assert abs(session.clock.offset(20 * SECOND) + 3700 * SECOND) <= 10 * MS


def test_clock_set_back_is_followed_and_not_a_reboot() -> None:
    session, peer = Session(rates_hz={"LOCAL_POSITION_NED": 10}), Autopilot(booted=-5000 * SECOND)
    run(session, peer, 0, 10)
    peer.booted += 3600 * SECOND
    events = run(session, peer, 10 * SECOND, 10)
    assert set(kinds(events)) <= {
        TimesyncOutlier,
        ClockJump,
    }  # an answer arrives before two stamps
    assert [round(e.by_ns / SECOND) for e in events if isinstance(e, ClockJump)] == [-3600]
    assert abs(session.clock.offset(20 * SECOND) + 1400 * SECOND) <= 10 * MS


def test_stopped_clock_is_reported_at_the_next_answer() -> None:
    session, peer = Session(rates_hz={"LOCAL_POSITION_NED": 10}), Autopilot(booted=-5000 * SECOND)
    run(session, peer, 0, 10)
    peer.booted += 4 * SECOND
    events = [e for e in run(session, peer, 14 * SECOND, 3) if not isinstance(e, MessageReceived)]
    # the first answer arrives before a stamp
    assert kinds(events) == [TimesyncOutlier, MappingStepped, ClockJump]
    assert events[1].by_ns == -events[2].by_ns == pytest.approx(4 * SECOND, abs=SECOND // 10)
    assert abs(session.clock.offset(17 * SECOND) + 4996 * SECOND) <= 10 * MS


def test_fast_clock_is_reported_once() -> None:
    session, peer = Session(rates_hz={"LOCAL_POSITION_NED": 10}), Autopilot(booted=-5000 * SECOND)
    events = run(session, peer, 0, 3)
    for second in range(3, 40):
        peer.booted -= 2 * SECOND  # three times as fast
        events += run(session, peer, second * SECOND, 1)
    assert [e.rate for e in events if isinstance(e, ClockRate)] == [3.0]


@pytest.mark.parametrize("by_ms", [0, 50, 300, 700])
def test_pause_of_the_clock_steps_the_mapping(by_ms: int) -> None:
    session, peer = Session(rates_hz={"LOCAL_POSITION_NED": 10}), Autopilot(booted=-5000 * SECOND)
    run(session, peer, 0, 10)
    peer.booted += by_ms * MS
    steps = [e for e in run(session, peer, 10 * SECOND, 5) if isinstance(e, MappingStepped)]
    assert [round(e.by_ns / MS) for e in steps] == ([pytest.approx(by_ms, abs=10)] if by_ms > 100 else [])


def test_late_link_is_reported_and_its_recovery_too() -> None:
    """Four seconds one way: the round trips show it, and the offset does not change."""
    session, peer = Session(rates_hz={"LOCAL_POSITION_NED": 10}), Autopilot(booted=-100 * SECOND)
    run(session, peer, 0, 10)
    events, waiting = list[Event](), deque[tuple[int, bytes]]()
    for now in range(10 * SECOND, 100 * SECOND, 10 * MS):
        events += session.poll(now) if now >= session.deadline() else []
        sent = peer.step(now, b"".join(session.to_send()))
        late = 4 * SECOND if now < 80 * SECOND else 0
        waiting.append((max(now + late, waiting[-1][0] if waiting else 0), sent))
        while waiting and waiting[0][0] <= now:
            events += session.receive(waiting.popleft()[1], now)
        assert abs(session.clock.offset(now) + 100 * SECOND) <= 20 * MS
    reported = [e for e in events if not isinstance(e, MessageReceived)]
    assert [type(e) for e in reported] == [LinkLate, LinkLate]
    assert reported[0].by_ns / SECOND == pytest.approx(4, abs=0.1)
    assert reported[1].by_ns == 0


@pytest.mark.parametrize("off_s", [-7200, -12, 2, 5000])
def test_timesync_answer_of_another_clock_is_reported_and_not_used(off_s: int) -> None:
    session, peer = Session(rates_hz={"LOCAL_POSITION_NED": 10}), Autopilot(booted=-100 * SECOND)
    run(session, peer, 0, 10)
    offset, now = session.clock.offset(10 * SECOND), 10 * SECOND
    asked = session.clock.request(now)
    reading = now - offset - off_s * SECOND
    data = frame.encode(dialect.new("TIMESYNC", tc1=reading, ts1=asked), 0, peer.system, 1)
    (event,) = [e for e in session.receive(data, now + MS) if isinstance(e, TimesyncOutlier)]
    assert event.error_ns / SECOND == pytest.approx(-off_s, abs=0.05)
    assert session.clock.offset(now + MS) == offset


def test_arriving_rate_is_requested_once_and_an_overwritten_one_again() -> None:
    session, peer = Session(rates_hz={"LOCAL_POSITION_NED": 10}), Autopilot()
    run(session, peer, 0, 60)
    asked = [m for m in peer.received if m.get_type() == "COMMAND_LONG"]
    assert [(m.param1, m.param2, m.target_system, m.command) for m in asked] == [(32, 100_000, 7, 511)]
    wanted, measured = session.stream_rates.rates()[LOCAL_POSITION]
    assert measured == pytest.approx(wanted, rel=0.05)
    peer.intervals[LOCAL_POSITION] = SECOND  # a ground station
    run(session, peer, 60 * SECOND, 12)
    assert peer.intervals[LOCAL_POSITION] == 100 * MS


def requests(peer: Autopilot) -> list[float]:
    """Return the requested rates, Hz."""
    return [1e6 / m.param2 for m in peer.received if m.get_type() == "COMMAND_LONG"]


def test_request_without_effect_is_repeated_then_lowered_and_ends() -> None:
    session, peer = Session(rates_hz={"LOCAL_POSITION_NED": 8}), Autopilot()
    peer.obeys = False
    peer.intervals[LOCAL_POSITION] = 0
    run(session, peer, 0, 1500)
    assert requests(peer) == pytest.approx([8, 8, 4, 4, 2, 2, 1, 1, 0.5, 0.5])


@pytest.mark.parametrize("answers", [True, False])
def test_rate_above_the_autopilots_limit_is_lowered_and_the_refusal_believed(answers: bool) -> None:
    """As ArduPilot with a main loop of 50 Hz: 50 Hz is refused, and the stream stays at 1 Hz."""
    session, peer = Session(rates_hz={"LOCAL_POSITION_NED": 50}), Autopilot()
    peer.limit_hz, peer.answers = 40.0, answers
    run(session, peer, 0, 600)
    assert requests(peer) == pytest.approx([50, 25] if answers else [50, 50, 25])
    assert session.stream_rates.rates()[LOCAL_POSITION][1] == pytest.approx(25, rel=0.05)


def test_rate_once_reached_is_requested_until_it_is_back() -> None:
    """A ground station that overwrites it for long, or a bad line: no reason to ask for less."""
    session, peer = Session(rates_hz={"LOCAL_POSITION_NED": 10}), Autopilot()
    run(session, peer, 0, 30)
    peer.obeys = False
    peer.intervals[LOCAL_POSITION] = SECOND
    run(session, peer, 30 * SECOND, 600)
    assert set(requests(peer)) == {10.0}
    peer.obeys = True
    run(session, peer, 630 * SECOND, 70)
    assert peer.intervals[LOCAL_POSITION] == 100 * MS


def test_second_autopilot_is_reported_once_and_ignored() -> None:
    session, peer, other = Session(), Autopilot(7), Autopilot(8)
    events = session.receive(peer.heartbeat() + other.heartbeat() * 3 + other.message("ATTITUDE"), 0)
    assert kinds(events) == [LinkUp, SecondAutopilot]
    assert (events[-1].system, events[-1].kept) == (8, 7)
    assert session.receive(other.heartbeat() + other.message("ATTITUDE", time_boot_ms=5), SECOND) == []
    assert session.autopilot == 7


def test_only_the_configured_autopilot_is_accepted() -> None:
    session = Session(autopilot_system=8)
    assert kinds(session.receive(Autopilot(7).heartbeat(), 0)) == [SecondAutopilot]
    assert kinds(session.receive(Autopilot(8).heartbeat(), 0)) == [LinkUp]


def test_ground_stations_and_peripherals_are_received_but_not_as_autopilots() -> None:
    session = Session()
    gcs = frame.encode(dialect.new("HEARTBEAT", type=GCS, autopilot=INVALID), 0, 255, 190)
    odd_gcs = frame.encode(dialect.new("HEARTBEAT", type=GCS, autopilot=ARDUPILOT), 0, 254, 1)
    gimbal = frame.encode(dialect.new("HEARTBEAT", type=26, autopilot=INVALID), 0, 1, 154)
    beacon = frame.encode(dialect.new("RSBN_MEASUREMENT", beacon_id=3), 0, 1, 50)
    events = session.receive(gcs + odd_gcs + gimbal + beacon, 0)
    assert [type(e) for e in events] == [MessageReceived] * 4
    assert not any(e.from_autopilot for e in events)
    assert session.autopilot is None


@pytest.mark.parametrize("peer", [None, ("10.0.0.1", 14550)])
@pytest.mark.parametrize("at_once", [1, 2, 9])
def test_unknown_messages_are_not_lost_frames(at_once: int, peer: tuple[str, int] | None) -> None:
    """Every second frame is of an unknown message; several come in one datagram."""
    session, plane, frames = Session(), Autopilot(), list[bytes]()
    for _ in range(9):
        frames.append(plane.heartbeat())
        plane.sequence += 1
        frames.append(bytes((0xFD, 2, 0, 0, plane.sequence, 7, 1, 0x30, 0xE6, 2)) + b"ab\x12\x34")
    frames.append(plane.heartbeat())
    for k in range(0, len(frames), at_once):
        session.receive(b"".join(frames[k : k + at_once]), k, peer)
    assert session.reader.counts == {(7, 1): frame.Counts(received=10, lost=0)}


def contents(event: Event) -> object:
    if isinstance(event, MessageReceived):
        return event.received_ns, event.frame, event.from_autopilot, event.peer
    return event


def test_a_parsed_frame_has_the_effects_of_its_bytes() -> None:
    first, second, lost = Autopilot(), Autopilot(system=9), Autopilot()
    stream = [first.heartbeat(), second.heartbeat()]
    for boot in (*range(5000, 8000, 100), *range(100, 3000, 100)):  # with a reboot
        stream += [first.message("ATTITUDE", time_boot_ms=boot), lost.heartbeat()]
    stream += [first.message("TIMESYNC", tc1=0, ts1=5), frame.encode(dialect.new("HEARTBEAT"), 0, 7, 191)]
    of_bytes, of_frames = Session(), Session()
    seen: set[type] = set()
    for k, data in enumerate(stream):
        one, now = parsed(data), k * 50 * MS
        events = of_bytes.receive(data, now)
        assert list(map(contents, of_frames.receive_frame(one, now))) == list(map(contents, events))
        seen |= set(map(type, events))
        for session in (of_bytes, of_frames):
            session.poll(now)
        assert of_frames.to_send() == of_bytes.to_send()
    assert of_frames.reader.counts == of_bytes.reader.counts and of_bytes.reader.lost > 0
    assert seen >= {MessageReceived, LinkUp, SecondAutopilot, Rebooted}


def test_own_frames_sent_back_are_ignored() -> None:
    session = Session()
    session.poll(0)
    (sent,) = session.to_send()
    assert session.receive(sent, 1) == []


def test_acknowledgement_is_passed_up_with_its_frame() -> None:
    session, peer = Session(), Autopilot()
    events = session.receive(peer.heartbeat() + peer.message("COMMAND_ACK", command=511, result=0), 5)
    ack = events[-1]
    assert isinstance(ack, MessageReceived)
    assert (ack.message.command, ack.received_ns, ack.from_autopilot, ack.frame.system) == (511, 5, True, 7)


@pytest.mark.parametrize(
    ("values", "words"),
    [
        ({"component": 0}, "component 0 is not a MAVLink id"),
        ({"autopilot_system": 256}, "autopilot_system 256 is not a MAVLink id"),
        ({"rates_hz": {"LOCAL_POSITION": 1}}, "did you mean LOCAL_POSITION_NED"),
        ({"rates_hz": {"ATTITUDE": 0}}, "a rate of 0 Hz for message 30"),
    ],
)
def test_invalid_settings_are_reported(values: dict, words: str) -> None:
    with pytest.raises(ValueError, match=words):
        Session(**values)


@settings(max_examples=60)
@given(st.lists(st.one_of(st.binary(max_size=50), st.integers(0, 2**32)), max_size=20))
def test_no_input_raises_and_the_deadline_stays_in_the_future(inputs: list[bytes | int]) -> None:
    session, now = Session(rates_hz={"ATTITUDE": 5}), 0
    session.receive(Autopilot().heartbeat(), 0)
    for one in inputs:
        if isinstance(one, bytes):
            for event in session.receive(one, now):
                assert not isinstance(event, NotUnderstood) or isinstance(
                    event.what, BadFrame | frame.UnknownFrame
                )
        else:
            now += random.Random(one).randrange(3 * SECOND)
            session.receive(frame_of_anything(one), now)
        session.poll(now)
        assert session.deadline() > now
        assert session.send(dialect.new("HEARTBEAT")) is None
        assert len(session.to_send()) >= 1


def frame_of_anything(seed: int) -> bytes:
    rng = random.Random(seed)
    kind = dialect.TYPES[rng.choice(sorted(dialect.TYPES))]
    found = frame.Frame(
        kind.msgid, rng.randbytes(kind.layout.size), 0, rng.choice((7, 7, 1, 255)), 1, None, b""
    )
    return frame.encode(dialect.decode(found), 0, found.system, 1)
