"""Which beacon answers are used: so many per second of a receiver, and of one receiver for each beacon.

On an unsigned link anyone can send answers, and each costs an update of the navigator. A receiver is a
sender's address and ids. The one that gave a beacon's answers first keeps the beacon until it is silent, so
that a stranger cannot displace a beacon that is followed. After an answer that the navigator rejected the
receiver has to wait: hostile answers cost little, and a receiver in error returns by evidence. Its beacons
then take turns, so that one whose answers are rejected does not keep out the others.
"""

from __future__ import annotations

from collections.abc import Hashable

from companion.link.rate_limiter import SenderLimiter
from companion.units import SECOND_NS

#: Answers per second and at once of one receiver, and the number of receivers.
ANSWERS_HZ, ANSWERS_BURST, MAX_RECEIVERS = 10.0, 20, 4
REJECTED_NS = SECOND_NS // 2  # wait after a rejected answer
MAX_WAITING = 8  # beacons of a receiver that wait for their turn
SILENT_NS = 3 * SECOND_NS  # a receiver silent for longer gives up its beacon
RATE_REASON = f"more than {ANSWERS_HZ:g} per second, or {MAX_RECEIVERS} receivers"
TURN_REASON = f"its receiver waits {REJECTED_NS / SECOND_NS:g} s after a rejected answer, its beacons in turn"
"""Not worth a report: two honest beacons come to it, and each rejected answer is reported itself."""


class BeaconAnswers:
    """The receivers of the last seconds and their beacons."""

    def __init__(self) -> None:
        self._limiter = SenderLimiter(ANSWERS_HZ, ANSWERS_BURST, MAX_RECEIVERS)
        self._followed: dict[str, tuple[Hashable, int]] = {}  # by source: its receiver, its last answer
        self._waits_ns: dict[Hashable, int] = {}
        # by receiver: the sources that wait, in their order, and when they last asked
        self._waiting: dict[Hashable, dict[str, int]] = {}

    def followed(self, source: str, now_ns: int) -> Hashable | None:
        """Return the receiver whose answers of a source are used, None if it is silent."""
        receiver, last_ns = self._followed.get(source, (None, now_ns - SILENT_NS))
        return receiver if now_ns - last_ns < SILENT_NS else None

    def refusal(self, receiver: Hashable, source: str, now_ns: int) -> str | None:
        """Return why an answer of a source ("beacon 7", "star 2") is not used, None if it is."""
        if not self._has_turn(receiver, source, now_ns):
            return TURN_REASON
        if not self._limiter.take(receiver, now_ns):
            return RATE_REASON
        if self.followed(source, now_ns) not in (None, receiver):
            return f"{source} is received by another receiver"
        if source not in self._followed:  # bounded by the rate of new ones
            self._followed = {s: f for s, f in self._followed.items() if now_ns - f[1] < SILENT_NS}
        self._followed[source] = receiver, now_ns
        return None

    def _has_turn(self, receiver: Hashable, source: str, now_ns: int) -> bool:
        """Whether the receiver need not wait, and no other beacon of it has waited longer than this one."""
        waiting = self._waiting.get(receiver)
        if waiting is None:
            return True
        waiting = {s: t for s, t in waiting.items() if now_ns - t < SILENT_NS}
        self._waiting[receiver] = waiting
        if now_ns >= self._waits_ns[receiver] and next(iter(waiting), source) == source:
            waiting.pop(source, None)
            return True
        if source in waiting or len(waiting) < MAX_WAITING:
            waiting[source] = now_ns  # where it was in the queue
        return False

    def note_rejected(self, receiver: Hashable, now_ns: int) -> None:
        """Let a receiver wait whose answer the navigator rejected."""
        self._waits_ns = {r: t for r, t in self._waits_ns.items() if now_ns - t < SILENT_NS}
        self._waits_ns[receiver] = now_ns + REJECTED_NS
        self._waiting = {r: self._waiting.get(r, {}) for r in self._waits_ns}
