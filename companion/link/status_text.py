"""Changes of state told to people: records of Event as STATUSTEXT, so many and no more. No clock, no link.

    speaker.tell(event, now_ns)
    for message in speaker.to_send(now_ns): ...     # after it, and at speaker.deadline()

A few may come at once, then one every EVERY. Of those that come too fast the gravest (of equals, the latest)
is told as soon as one may, with the number of the others: "GNSS lost (and 11 more)". A text longer than 50
bytes goes out in chunks.
"""

from __future__ import annotations

from companion.link import dialect
from companion.link.dialect import Message
from companion.link.rate_limiter import SECOND, Bucket
from companion.records import Event

EVERY = 2 * SECOND
BURST = 5
CHUNK = 50
#: Longer texts are cut: four chunks.
LONGEST = 4 * CHUNK - 1
#: MAV_SEVERITY_INFO: what is less grave is for the log.
LEAST_GRAVE = 6


class StatusText:
    """The one voice of the companion."""

    def __init__(self) -> None:
        self._bucket = Bucket(SECOND / EVERY, BURST)
        self._outbox: list[Message] = []
        self._waiting: Event | None = None
        self._more = 0  # how many were dropped for the one that waits
        self._id = 0
        self._deadline: int | None = None

    def tell(self, event: Event, now_ns: int) -> None:
        """Have `event` told, now if it may be."""
        if event.severity > LEAST_GRAVE:
            return
        if self._waiting is None:
            self._waiting = event
        else:
            self._more += 1
            if event.severity <= self._waiting.severity:
                self._waiting = event
        self._speak(now_ns)

    def to_send(self, now_ns: int) -> list[Message]:
        """The messages to be sent now."""
        self._speak(now_ns)
        sent, self._outbox = self._outbox, []
        return sent

    def deadline(self) -> int | None:
        """When `to_send` is next worth calling without news; None: not before there are any."""
        return self._deadline

    def _speak(self, now: int) -> None:
        if (event := self._waiting) is not None and self._bucket.take(now):
            more = f" (and {self._more} more)" if self._more else ""
            self._waiting, self._more = None, 0
            self._outbox += self._chunks(event.severity, event.text, more)
        self._deadline = None if self._waiting is None else self._bucket.ready_at(now)

    def _chunks(self, severity: int, text: str, more: str) -> list[Message]:
        data = text.replace("\0", " ").encode(errors="replace")[: LONGEST - len(more)]
        data = data.decode(errors="ignore").encode() + more.encode()
        severity = max(severity, 0)
        if len(data) <= CHUNK:
            return [dialect.new("STATUSTEXT", severity=severity, text=data)]
        self._id = self._id % 0xFFFF + 1
        # A zero byte ends the text: where the last chunk is full an empty one follows.
        return [
            dialect.new(
                "STATUSTEXT",
                severity=severity,
                text=data[at : at + CHUNK],
                id=self._id,
                chunk_seq=at // CHUNK,
            )
            for at in range(0, len(data) + 1, CHUNK)
        ]
