"""Rate-limited STATUSTEXT messages for Event records. No clock, no link.

    status_text.add(event, now_ns)
    for message in status_text.to_send(now_ns): ...     # after it, and at status_text.deadline()

BURST texts may be sent at once, then one every INTERVAL. Of the events that exceed this rate, the most severe
one (of equals, the latest) is sent next, with the number of the others: "GNSS lost (and 11 more)". A text
longer than 50 bytes is sent in chunks.
"""

from __future__ import annotations

from companion.link import dialect
from companion.link.dialect import Message
from companion.link.rate_limiter import RateLimiter
from companion.records import Event, Severity
from companion.units import SECOND_NS

INTERVAL = 2 * SECOND_NS
BURST = 5
CHUNK = 50
#: Longer texts are cut: four chunks.
MAX_LENGTH = 4 * CHUNK - 1
#: Less severe events are logged only.
LEAST_SEVERE = Severity.INFO


class StatusText:
    """STATUSTEXT sender of the companion."""

    def __init__(self) -> None:
        self._limiter = RateLimiter(SECOND_NS / INTERVAL, BURST)
        self._send_queue: list[Message] = []
        self._waiting: Event | None = None
        self._dropped = 0  # events dropped in favour of the waiting one
        self._id = 0
        self._deadline: int | None = None

    def add(self, event: Event, now_ns: int) -> None:
        """Send `event` now if the rate allows it, else keep it waiting."""
        if event.severity > LEAST_SEVERE:
            return
        if self._waiting is None:
            self._waiting = event
        else:
            self._dropped += 1
            if event.severity <= self._waiting.severity:
                self._waiting = event
        self._queue_waiting(now_ns)

    def to_send(self, now_ns: int) -> list[Message]:
        """Return the messages to send now."""
        self._queue_waiting(now_ns)
        sent, self._send_queue = self._send_queue, []
        return sent

    def deadline(self) -> int | None:
        """Return when `to_send` has something to send without a new event; None if nothing waits."""
        return self._deadline

    def _queue_waiting(self, now: int) -> None:
        if (event := self._waiting) is not None and self._limiter.take(now):
            more = f" (and {self._dropped} more)" if self._dropped else ""
            self._waiting, self._dropped = None, 0
            self._send_queue += self._chunks(event.severity, event.text, more)
        self._deadline = None if self._waiting is None else self._limiter.ready_at(now)

    def _chunks(self, severity: int, text: str, more: str) -> list[Message]:
        data = text.replace("\0", " ").encode(errors="replace")[: MAX_LENGTH - len(more)]
        data = data.decode(errors="ignore").encode() + more.encode()
        severity = max(severity, 0)
        if len(data) <= CHUNK:
            return [dialect.new("STATUSTEXT", severity=severity, text=data)]
        self._id = self._id % 0xFFFF + 1
        # a zero byte ends the text: if the last chunk is full, an empty one follows
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
