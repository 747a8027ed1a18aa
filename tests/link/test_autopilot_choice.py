"""The autopilot is the one that streams navigation messages: wrong heartbeats, forged ones, two aircraft."""

import pytest

from companion.link import dialect, frame
from companion.link.session import AutopilotReleased, Event, LinkUp, MessageReceived, SecondAutopilot, Session
from companion.units import SECOND_NS

GCS_TYPE, PLANE = 6, 1


def packed(name: str, system: int = 1, **values: object) -> bytes:
    return frame.encode(dialect.new(name, **values), 0, system, 1)


def heartbeat(system: int, kind: int = PLANE) -> bytes:
    return packed("HEARTBEAT", system, type=kind, autopilot=3)


class Air:
    """A link with several senders; each is a function of the tenth of a second."""

    def __init__(self, session: Session | None = None) -> None:
        self.session = session or Session()
        self.now = SECOND_NS
        self.events: list[Event] = []

    def fly(self, seconds: float, *senders) -> list[Event]:
        events: list[Event] = []
        for k in range(round(10 * seconds)):
            self.now += SECOND_NS // 10
            for sender in senders:
                for data, peer in sender(k, self.now):
                    events += self.session.receive(data, self.now, peer)
            events += self.session.poll(self.now)
            self.session.to_send()
        self.events += events
        return events


def streaming(system: int, peer: object):
    def frames(k: int, now: int):
        if k % 10 == 0:
            yield heartbeat(system), peer
        yield packed("ATTITUDE", system, time_boot_ms=now // 1_000_000), peer

    return frames


def beating(system: int, peer: object):
    def frames(k: int, now: int):
        if k % 10 == 0:
            yield heartbeat(system), peer

    return frames


def ups(events: list[Event]) -> list[int]:
    return [event.system for event in events if isinstance(event, LinkUp)]


@pytest.mark.parametrize("wrong", [beating(7, "a"), streaming(7, "a")])
def test_the_first_heartbeat_alone_does_not_win(wrong) -> None:
    """One frame of another system arrives before the autopilot's; the other then is silent."""
    air = Air()
    air.fly(0.1, wrong)
    events = air.fly(10.0, streaming(1, "b"))
    assert ups(events) == [1] and air.session.autopilot == 1 and air.session.is_up
    assert [e.by for e in events if isinstance(e, AutopilotReleased)] == [1]


def test_a_wrong_one_that_goes_on_with_heartbeats_is_released_for_one_that_streams() -> None:
    air = Air()
    air.fly(60.0, beating(7, "a"))
    assert air.session.autopilot == 7
    air.fly(6.0, beating(7, "a"), streaming(1, "b"))
    assert air.session.autopilot == 1
    air.fly(120.0, beating(7, "a"), streaming(1, "b"))
    assert air.session.autopilot == 1


def test_without_streams_the_candidates_are_tried_in_turn() -> None:
    """An autopilot that sends HEARTBEAT only until streams are requested gets the requests in the end."""
    air = Air()
    events = air.fly(60.0, beating(7, "a"), beating(1, "b"))
    assert set(ups(events)) == {1, 7}


def test_a_confirmed_autopilot_is_not_left_for_another_aircraft() -> None:
    air = Air()
    air.fly(300.0, streaming(1, "b"))
    events = air.fly(200.0, streaming(9, "c"))  # its own has fallen silent
    assert air.session.autopilot == 1 and ups(events) == []
    assert not any(isinstance(e, MessageReceived) for e in events)
    air.fly(200.0, streaming(9, "c"))  # silent for longer than it was received
    assert air.session.autopilot == 9


def test_the_autopilots_system_at_another_address_is_not_believed_until_the_old_one_is_silent() -> None:
    air = Air()
    air.fly(10.0, streaming(1, "router"))
    events = air.fly(10.0, streaming(1, "router"), streaming(1, "forger"))
    by_peer = {(e.peer, e.from_autopilot) for e in events if isinstance(e, MessageReceived)}
    assert by_peer == {("router", True), ("forger", False)}
    assert sum(isinstance(e, SecondAutopilot) for e in events) == 1
    events = air.fly(4.0, streaming(1, "restarted router"))
    assert any(e.from_autopilot for e in events if isinstance(e, MessageReceived))
    assert ups(events) == []  # the link was never lost


def test_the_autopilot_is_taken_over_at_once_when_its_connection_has_ended() -> None:
    air = Air()
    air.fly(10.0, streaming(1, "old"))
    assert air.session.receive(b"", air.now, "another") == air.session.receive(b"", air.now, "old") == []
    assert list(air.session._readers) == []
    events = air.fly(1.0, streaming(1, "new"))
    assert all(e.from_autopilot for e in events if isinstance(e, MessageReceived))
    assert not any(isinstance(e, SecondAutopilot) for e in events) and ups(events) == []


def test_forged_vehicle_heartbeats_do_not_mute_a_ground_station() -> None:
    """System 255 forged as a vehicle from one address; the station at another is still received."""
    air = Air()
    air.fly(5.0, streaming(1, "a"), beating(255, "forger"))
    station = frame.encode(dialect.new("HEARTBEAT", type=GCS_TYPE, autopilot=8), 0, 255, 190)
    events = air.session.receive(station, air.now, "station")
    assert any(isinstance(event, MessageReceived) for event in events)


def test_other_senders_bytes_do_not_swallow_the_autopilots_frames() -> None:
    """Half frames and unknown headers of chosen length between the datagrams of the autopilot."""
    session = Session()
    header = bytes((0xFD, 255, 0, 0, 0, 7, 1, 0xFF, 0xFF, 0x0F))  # an unknown id, 255 bytes follow
    received = 0
    for k in range(200):
        now = SECOND_NS + k * 10_000_000
        for data, peer in ((heartbeat(1), "a"), (header, "b"), (heartbeat(1)[:-3], "c")):
            received += sum(isinstance(e, MessageReceived) for e in session.receive(data, now, peer))
    assert received == 200


def test_a_frame_may_span_datagrams_of_a_known_peer() -> None:
    """Serial bridges cut the stream anywhere."""
    session = Session()
    session.receive(heartbeat(1), 0, "bridge")
    data = b"".join(packed("ATTITUDE", time_boot_ms=k) for k in range(50))
    events = [e for at in range(0, len(data), 7) for e in session.receive(data[at : at + 7], at, "bridge")]
    assert sum(isinstance(e, MessageReceived) for e in events) == 50


def test_a_frame_may_begin_at_the_end_of_a_peers_first_bytes() -> None:
    session, second = Session(), packed("ATTITUDE", time_boot_ms=1)
    session.receive(heartbeat(1) + second[:5], 0, "a")
    session.receive(heartbeat(2) + second[:7], 0, "b")
    received = [session.receive(second[n:], 1, peer) for n, peer in ((5, "a"), (7, "b"))]
    assert [e.from_autopilot for events in received for e in events] == [True, False]


def test_readers_are_bounded() -> None:
    session = Session()
    for k in range(1000):
        session.receive(heartbeat(1), k, ("address", k))
    assert len(session._readers) <= 16 and len(session._choice._candidates) <= 16


def test_timesync_of_the_autopilot_is_answered_during_a_flood() -> None:
    air = Air()
    air.fly(6.0, streaming(1, "a"))
    answers = 0
    for k in range(5000):
        air.now += 1_000_000
        air.session.receive(packed("TIMESYNC", 77, ts1=k + 1), air.now, ("forger", k % 50))
        if k % 100 == 0:
            air.session.to_send()
            air.session.receive(heartbeat(1) + packed("TIMESYNC", 1, ts1=10**9 + k), air.now, "a")
            (sent,) = [dialect.decode(f) for d in air.session.to_send() for f in frame.Reader().receive(d)]
            answers += sent.ts1 == 10**9 + k
    assert answers == 50
