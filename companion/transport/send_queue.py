"""Bounded send queue of a slow line: frames that wait too long are dropped, oldest first.

A position half a second old must not be sent: it would be taken for a new one and delay all that follow. So
the oldest frames are dropped and counted, and the line carries as many of the newest as it can. The rest of a
partly written frame is always sent; otherwise the receiver would lose two frames.

Bytes accepted by the system cannot be recalled. For TCP their number is bounded (see `tcp`). A serial driver
has no portable bound: Linux buffers up to 4 KiB, which is 0.7 s at 57600 baud and adds to the wait in this
queue.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable

#: Seconds that a frame may wait.
MAX_WAIT_S = 0.5
#: Bytes that may wait: bounds a flood that is faster than MAX_WAIT_S.
LIMIT = 1 << 16


class SendQueue:
    """Frames that wait for a line. True while something waits."""

    def __init__(self, send: Callable[[bytes], int], now: Callable[[], float]) -> None:
        """Create an empty queue.

        Parameters
        ----------
        send
            Returns how many bytes the line accepted; raises BlockingIOError if none.
        now
            Returns the time in seconds, from any origin.
        """
        self.dropped = 0
        self._send, self._now = send, now
        self._rest = b""  # of a partly written frame
        self._waiting: deque[tuple[float, bytes]] = deque()  # (queued at, frame)
        self._bytes = 0

    def __bool__(self) -> bool:
        return bool(self._rest or self._waiting)

    def write(self, frame: bytes) -> None:
        """Send a frame at once if nothing waits and the line accepts it, else queue it. Raises as `send`."""
        if not self:
            sent = self._try_send(frame)
            if sent:
                self._rest = frame[sent:]
                return
        now = self._now()
        self._waiting.append((now, frame))
        self._bytes += len(frame)
        self._drop_old(now)

    def flush(self) -> None:
        """Send as much of the queue as the line accepts. Raises as `send`."""
        self._drop_old(self._now())
        if self._rest:
            self._rest = self._rest[self._try_send(self._rest) :]
        while self._waiting and not self._rest:
            _, frame = self._waiting[0]
            sent = self._try_send(frame)
            if not sent:
                return
            self._remove_first()
            self._rest = frame[sent:]

    def clear(self) -> None:
        """Discard the queue without counting it as dropped: the line is closed."""
        self._rest = b""
        self._waiting.clear()
        self._bytes = 0

    def _try_send(self, data: bytes) -> int:
        try:
            return self._send(data)
        except BlockingIOError:
            return 0

    def _drop_old(self, now: float) -> None:
        while self._waiting and (now - self._waiting[0][0] > MAX_WAIT_S or self._bytes > LIMIT):
            self._remove_first()
            self.dropped += 1

    def _remove_first(self) -> None:
        _, frame = self._waiting.popleft()
        self._bytes -= len(frame)
