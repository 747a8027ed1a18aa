"""Peers are those with an accepted frame; they expire, and a flood of others evicts none."""

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
