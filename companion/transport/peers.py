"""Peers of a listening link: who is sent to. A sender is a peer after an accepted frame; on UDP it expires.

Established peers keep their places: a flood from many addresses evicts nobody, and the autopilot always has a
place.
"""

from __future__ import annotations

import enum
from collections.abc import Callable
from typing import Any

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
    """At most MAX_PEERS peers, any hashable objects."""

    def __init__(
        self, now: Callable[[], float], expires_s: float = EXPIRES_S, yields_s: float = EXPIRES_S
    ) -> None:
        """Create an empty table.

        Parameters
        ----------
        now
            Returns the time in seconds, from any origin.
        expires_s
            Seconds without an accepted frame after which a peer is not sent to.
        yields_s
            Seconds without an accepted frame after which a peer yields its place to a newcomer.
        """
        self._now, self._expires_s, self._yields_s = now, expires_s, yields_s
        self._peers: dict[Any, tuple[Rank, float]] = {}  # rank, time of the last accepted frame

    def join(self, peer: Any) -> None:
        """Give `peer`, which has sent nothing yet, a place of the lowest rank if one is free."""
        if len(self._peers) < MAX_PEERS:
            self._peers[peer] = Rank.UNKNOWN, self._now()

    def note(self, peer: Any, rank: Rank) -> Any:
        """Note what `peer` sent; return the peer that lost its place by it, or None."""
        if rank is Rank.UNKNOWN:
            return None
        now, replaced = self._now(), None
        if peer not in self._peers and len(self._peers) >= MAX_PEERS:
            replaced = self._free_place(rank, now)
            if replaced is None:
                return None
        self._peers[peer] = rank, now
        return replaced

    def remove(self, peer: Any) -> None:
        """Free the place of `peer`, if it has one."""
        self._peers.pop(peer, None)

    def active(self) -> list[Any]:
        """Return the peers to send to."""
        limit = self._now() - self._expires_s
        return [peer for peer, (_, last) in self._peers.items() if last >= limit]

    def _free_place(self, rank: Rank, now: float) -> Any:
        """Remove a silent peer, or else the newest of the lowest rank if that is below `rank`; return it."""
        silent = [
            peer
            for peer, (of_peer, last) in self._peers.items()
            if of_peer is Rank.UNKNOWN or now - last > self._yields_s
        ]
        if silent:
            replaced = min(silent, key=lambda peer: self._peers[peer])
        else:
            replaced = min(self._peers, key=lambda peer: (self._peers[peer][0], -self._peers[peer][1]))
            if self._peers[replaced][0] >= rank:
                return None
        del self._peers[replaced]
        return replaced
