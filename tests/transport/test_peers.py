"""Peers are those with an accepted frame; they expire, and a flood of others evicts none."""

import math

from companion.transport.peers import EXPIRES_S, MAX_PEERS, PeerTable, Rank


class Clock:
    def __init__(self) -> None:
        self.now = 0.0

    def __call__(self) -> float:
        return self.now


def test_only_accepted_senders_are_peers_and_they_expire() -> None:
    clock = Clock()
    peers = PeerTable(clock)
    peers.note("stranger", Rank.UNKNOWN)
    peers.note("station", Rank.ACCEPTED)
    assert peers.active() == ["station"]
    clock.now = EXPIRES_S + 0.1
    assert peers.active() == []


def test_a_free_place_before_the_first_frame_is_of_the_lowest_rank() -> None:
    clock = Clock()
    peers = PeerTable(clock)
    for k in range(MAX_PEERS + 1):
        clock.now = float(k)
        peers.join(k)
    assert peers.active() == list(range(MAX_PEERS))
    assert peers.note(1, Rank.ACCEPTED) is None
    assert [peers.note(name, Rank.ACCEPTED) for name in ("a", "b")] == [0, 2]  # those silent for longest
    peers.remove("a")
    peers.join("c")
    assert set(peers.active()) == {1, *range(3, MAX_PEERS), "b", "c"}


def test_places_of_silent_peers_go_by_rank() -> None:
    clock = Clock()
    peers = PeerTable(clock, math.inf, yields_s=3.0)
    peers.note("autopilot", Rank.AUTOPILOT)
    for k in range(1, MAX_PEERS):
        clock.now = 0.1 * k
        peers.note(k, Rank.ACCEPTED)
    assert peers.note("early", Rank.ACCEPTED) is None and "early" not in peers.active()
    clock.now = 100.0
    peers.note(1, Rank.ACCEPTED)
    assert len(peers.active()) == MAX_PEERS  # they do not expire
    assert [peers.note(k, Rank.ACCEPTED) for k in range(10, 10 + MAX_PEERS)] == [
        *range(2, MAX_PEERS),
        "autopilot",
        None,
    ]


def test_a_flood_of_addresses_evicts_nobody_and_the_autopilot_has_a_place() -> None:
    clock = Clock()
    peers = PeerTable(clock)
    peers.note("station", Rank.ACCEPTED)
    for k in range(1000):
        clock.now += 0.001
        peers.note(k, Rank.ACCEPTED)
    assert "station" in peers.active() and len(peers.active()) == MAX_PEERS
    peers.note("autopilot", Rank.AUTOPILOT)
    for k in range(1000, 2000):
        peers.note(k, Rank.ACCEPTED)
    assert {"station", "autopilot"} <= set(peers.active())
    clock.now += EXPIRES_S + 1.0
    peers.note("next", Rank.ACCEPTED)
    assert peers.active() == ["next"]
