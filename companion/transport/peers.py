"""Peers of a listening UDP link: who is sent to. A sender is a peer after an accepted frame, and expires.

Established peers keep their places: a flood from many addresses evicts nobody, and the autopilot always has a
place.
"""

from __future__ import annotations

import enum
from collections.abc import Callable, Hashable

#: Number of peers that a listening link sends to.
MAX_PEERS = 8
#: Seconds without an accepted frame after which a peer is not sent to any more.
EXPIRES_S = 30.0


class Rank(enum.IntEnum):
    """How much the sender of some bytes matters."""

    UNKNOWN = 0
    ACCEPTED = 1
    AUTOPILOT = 2


class PeerTable:
    """At most MAX_PEERS peers; `now` returns the time in seconds, from any origin."""

    def __init__(self, now: Callable[[], float]) -> None:
        self._now = now
        self._peers: dict[Hashable, tuple[Rank, float]] = {}  # rank, time of the last accepted frame

    def note(self, peer: Hashable, rank: Rank) -> None:
        """Note what `peer` sent."""
        if rank is Rank.UNKNOWN:
            return
        now = self._now()
        if peer not in self._peers and len(self._peers) >= MAX_PEERS and not self._free_place(rank, now):
            return
        self._peers[peer] = rank, now

    def active(self) -> list[Hashable]:
        """Return the peers to send to."""
        limit = self._now() - EXPIRES_S
        return [peer for peer, (_, last) in self._peers.items() if last >= limit]

    def _free_place(self, rank: Rank, now: float) -> bool:
        oldest = min(self._peers, key=lambda peer: self._peers[peer][1])
        lowest = min(self._peers, key=lambda peer: (self._peers[peer][0], -self._peers[peer][1]))
        if now - self._peers[oldest][1] > EXPIRES_S:
            del self._peers[oldest]
        elif self._peers[lowest][0] < rank:
            del self._peers[lowest]
        else:
            return False
        return True
