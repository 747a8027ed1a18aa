"""An open link of any kind: a file descriptor that the event loop watches, and two closures.

One takes what is there, one puts what fits. (Draining a socket by `add_reader` costs a tenth of asyncio's
datagram transport.)
"""

from __future__ import annotations

import asyncio
import os
import socket
from collections.abc import Callable
from functools import partial

from companion.transport.send_queue import Outbox

#: A link is drained by so many bytes, and so many datagrams, before others get their turn: noise made to be
#: slow to read (0.3 MB/s) then holds nobody up for more than 0.05 s.
AT_ONCE = 1 << 14
BURST = 64
INBOX_LIMIT = 1 << 20


class Stream:
    """An open link. Not for threads; belongs to the running loop."""

    def __init__(
        self,
        name: str,
        device: int | socket.socket,
        take: Callable[[], bytes | None],
        put: Callable[[bytes], int],
        release: Callable[[], None] | None = None,
    ) -> None:
        """`take` returns bytes, None for an empty datagram, b"" at the end; `put` how much it took.

        Both may raise OSError; BlockingIOError means that the line is empty or full. `release` closes the
        device, where more than that is to be done.
        """
        self.name = name
        self._device = device
        self._fd = device if isinstance(device, int) else device.fileno()
        self._take = take
        self._release = release or (partial(os.close, device) if isinstance(device, int) else device.close)
        self._loop = asyncio.get_running_loop()
        self._inbox: list[bytes] = []
        self._held = 0
        self._outbox = Outbox(put, self._loop.time)
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

    @property
    def dropped(self) -> int:
        """Frames that waited for the line too long."""
        return self._outbox.dropped

    def write(self, frame: bytes) -> None:
        """Send a frame now or as soon as the line takes it. Without effect on a link that has ended."""
        if self._end is not None or not frame:
            return
        waited = bool(self._outbox)
        try:
            self._outbox.write(frame)
        except OSError as error:
            self.end(f"failed: {reason(error)}")
        if self._outbox and not waited:
            self._loop.add_writer(self._fd, self._on_writable)

    def close(self) -> None:
        """End the link; a waiting `read` raises ConnectionError."""
        self.end("was closed")

    def end(self, why: str) -> None:
        """End the link; ConnectionError then says `why`. Without effect on one that has ended."""
        if self._end is not None:
            return
        self._end = ConnectionError(f"{self.name} {why}")
        self._loop.remove_reader(self._fd)
        self._loop.remove_writer(self._fd)
        self._outbox.clear()
        self._release()
        self._wake()

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
                return self.end(f"failed: {reason(error)}")
            if data is None:
                continue
            if not data:
                return self.end("was closed by the other side")
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
        try:
            self._outbox.flush()
        except OSError as error:
            self.end(f"failed: {reason(error)}")
        if not self._outbox:
            self._loop.remove_writer(self._fd)

    def _wake(self) -> None:
        if self._waiter is not None and not self._waiter.done():
            self._waiter.set_result(None)


def over_socket(name: str, sock: socket.socket) -> Stream:
    """Stream over a connected socket of bytes."""
    return Stream(name, sock, lambda: sock.recv(AT_ONCE), sock.send)


def pair() -> tuple[Stream, Stream]:
    """Return the two ends of a link in memory."""
    one, other = socket.socketpair()
    one.setblocking(False)
    other.setblocking(False)
    return over_socket("memory", one), over_socket("memory", other)


def reason(error: OSError) -> str:
    """What failed, in the system's words; one without a number is a sentence of ours."""
    if isinstance(error, TimeoutError) and not error.errno:
        return "no answer"
    return os.strerror(error.errno) if error.errno and error.errno > 0 else error.strerror or str(error)
