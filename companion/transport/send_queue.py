"""What waits for a line that is slower than what is sent: little, and nothing that is old.

A position half a second old is worth less than the place it takes: it would go out as if it were new, and
make all that follow it later still. So the oldest frames are dropped and counted, and the line carries as
many of the newest as it can. Of a frame half written the rest always goes out, or the reader lost two.

What the system took cannot be called back. For TCP that is bounded (see `tcp`). A serial driver has no
portable bound: Linux holds up to 4 KiB, which is 0.7 s at 57600 baud and adds to what is waited here.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable

#: Seconds that a frame may wait.
LONGEST_WAIT_S = 0.5
#: Bytes that may: for a flood that comes faster than time passes.
LIMIT = 1 << 16


class Outbox:
    """Frames on their way into a line. True while something waits."""

    def __init__(self, put: Callable[[bytes], int], now: Callable[[], float]) -> None:
        """`put` returns how much the line took, or raises BlockingIOError where that is nothing; `now` tells
        seconds, from any beginning.
        """
        self.dropped = 0
        self._put, self._now = put, now
        self._rest = b""  # of a frame half written
        self._waiting: deque[tuple[float, bytes]] = deque()  # since when
        self._bytes = 0

    def __bool__(self) -> bool:
        return bool(self._rest or self._waiting)

    def write(self, frame: bytes) -> None:
        """Send a frame at once if nothing waits and the line takes it, else let it wait. Raises as `put`."""
        if not self:
            taken = self._taken(frame)
            if taken:
                self._rest = frame[taken:]
                return
        now = self._now()
        self._waiting.append((now, frame))
        self._bytes += len(frame)
        self._drop(now)

    def flush(self) -> None:
        """Send of what waits as much as the line takes. Raises as `put`."""
        self._drop(self._now())
        if self._rest:
            self._rest = self._rest[self._taken(self._rest) :]
        while self._waiting and not self._rest:
            _, frame = self._waiting[0]
            taken = self._taken(frame)
            if not taken:
                return
            self._forget_first()
            self._rest = frame[taken:]

    def clear(self) -> None:
        """Forget what waits, uncounted: the line is gone."""
        self._rest = b""
        self._waiting.clear()
        self._bytes = 0

    def _taken(self, data: bytes) -> int:
        try:
            return self._put(data)
        except BlockingIOError:
            return 0

    def _drop(self, now: float) -> None:
        while self._waiting and (now - self._waiting[0][0] > LONGEST_WAIT_S or self._bytes > LIMIT):
            self._forget_first()
            self.dropped += 1

    def _forget_first(self) -> None:
        _, frame = self._waiting.popleft()
        self._bytes -= len(frame)
