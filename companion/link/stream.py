"""An open link of any kind: a file descriptor that the event loop watches, and two closures.

One takes what is there, one puts what fits. (Draining a socket by `add_reader` costs a tenth of asyncio's
datagram transport.)
"""

from __future__ import annotations

import asyncio
import os
import socket
from collections import deque
from collections.abc import Callable

#: A link is drained by so many bytes, and so many datagrams, before others get their turn: noise made to be
#: slow to read (0.3 MB/s) then holds nobody up for more than 0.05 s.
AT_ONCE = 1 << 14
BURST = 64
INBOX_LIMIT = 1 << 20
OUTBOX_LIMIT = 1 << 16


class Stream:
    """An open link. Not for threads; belongs to the running loop."""

    def __init__(
        self,
        name: str,
        device: int | socket.socket,
        take: Callable[[], bytes | None],
        put: Callable[[bytes], int],
    ) -> None:
        """`take` returns bytes, None for an empty datagram, b"" at the end; `put` how much it took.

        Both may raise OSError; BlockingIOError means that the line is empty or full.
        """
        self.name = name
        self.dropped = 0
        self._device = device
        self._fd = device if isinstance(device, int) else device.fileno()
        self._take, self._put = take, put
        self._loop = asyncio.get_running_loop()
        self._inbox: list[bytes] = []
        self._held = 0
        self._outbox: deque[bytes] = deque()
        self._queued = 0
        self._begun = False  # the first of the outbox is the rest of a frame half written
        self._waiter: asyncio.Future[None] | None = None
        self._end: ConnectionError | None = None
        self._hand: Callable[[bytes], None] | None = None
        self._loop.add_reader(self._fd, self._on_readable)

    @property
    def port(self) -> int:
        """The local port, 0 where the link has none."""
        if isinstance(self._device, socket.socket) and self._device.family in (
            socket.AF_INET,
            socket.AF_INET6,
        ):
            return int(self._device.getsockname()[1])
        return 0

    async def read(self) -> bytes:
        """Wait for bytes and return all that came. ConnectionError when the link has ended."""
        while not self._inbox:
            if self._end is not None:
                raise self._end
            self._waiter = self._loop.create_future()
            try:
                await self._waiter
            finally:
                self._waiter = None
        return self._all()

    async def hand_to(self, receive: Callable[[bytes], None]) -> None:
        """Call `receive` with each piece as soon as it is here, until the link ends: ConnectionError, or what
        `receive` raised.
        """
        self._waiter, self._hand = self._loop.create_future(), receive
        try:
            if self._inbox:
                receive(self._all())
            if self._end is None:
                await self._waiter
        finally:
            self._waiter = self._hand = None
        assert self._end is not None
        raise self._end

    def write(self, frame: bytes) -> None:
        """Send a frame now or as soon as the line takes it. Without effect on a link that has ended."""
        if self._end is not None or not frame:
            return
        self._outbox.append(frame)
        self._queued += len(frame)
        if len(self._outbox) == 1:
            self._flush()
            if self._outbox:
                self._loop.add_writer(self._fd, self._on_writable)
        while self._queued > OUTBOX_LIMIT and len(self._outbox) > 1 + self._begun:
            oldest = self._outbox[int(self._begun)]
            del self._outbox[int(self._begun)]
            self._queued -= len(oldest)
            self.dropped += 1

    def close(self) -> None:
        """End the link; a waiting `read` raises ConnectionError."""
        self._finish("was closed")

    def _all(self) -> bytes:
        data = b"".join(self._inbox)
        self._inbox.clear()
        if self._held >= INBOX_LIMIT and self._end is None:
            self._loop.add_reader(self._fd, self._on_readable)
        self._held = 0
        return data

    def _on_readable(self) -> None:
        taken = 0
        for _ in range(BURST):
            if taken >= AT_ONCE:
                break
            try:
                data = self._take()
            except BlockingIOError:
                break
            except OSError as error:
                return self._finish(f"failed: {reason(error)}")
            if data is None:
                continue
            if not data:
                return self._finish("was closed by the other side")
            taken += len(data)
            if not self._deliver(data):
                break
        return self._wake() if self._inbox else None

    def _deliver(self, data: bytes) -> bool:
        """Whether there may be more."""
        if self._hand is not None and self._waiter is not None:
            try:
                self._hand(data)
            except Exception as error:
                if not self._waiter.done():
                    self._waiter.set_exception(error)
                return False
            return self._end is None
        self._inbox.append(data)
        self._held += len(data)
        if self._held >= INBOX_LIMIT:
            self._loop.remove_reader(self._fd)
        return self._held < INBOX_LIMIT

    def _on_writable(self) -> None:
        self._flush()
        if not self._outbox and self._end is None:
            self._loop.remove_writer(self._fd)

    def _flush(self) -> None:
        try:
            while self._outbox:
                frame = self._outbox[0]
                done = self._put(frame)
                self._queued -= done
                self._begun = done < len(frame)
                if self._begun:
                    self._outbox[0] = frame[done:]
                    return
                self._outbox.popleft()
        except BlockingIOError:
            pass
        except OSError as error:
            self._finish(f"failed: {reason(error)}")

    def _finish(self, why: str) -> None:
        if self._end is not None:
            return
        self._end = ConnectionError(f"{self.name} {why}")
        self._loop.remove_reader(self._fd)
        self._loop.remove_writer(self._fd)
        self._outbox.clear()
        if isinstance(self._device, int):
            os.close(self._device)
        else:
            self._device.close()
        self._wake()

    def _wake(self) -> None:
        if self._waiter is not None and not self._waiter.done():
            self._waiter.set_result(None)


def reason(error: OSError) -> str:
    """What failed, in the system's words; one without a number is a sentence of ours."""
    if isinstance(error, TimeoutError) and not error.errno:
        return "no answer"
    return os.strerror(error.errno) if error.errno and error.errno > 0 else error.strerror or str(error)
