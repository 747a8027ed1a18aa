"""An open connection of any kind: a file descriptor watched by the event loop, and two closures.

`receive` reads what is available, `send` writes what fits. (Reading a socket by `add_reader` costs a tenth of
asyncio's datagram transport.)
"""

from __future__ import annotations

import asyncio
import os
import socket
from collections.abc import Callable, Hashable
from functools import partial
from typing import TypeAlias

from companion.transport.peers import PeerTable, Rank
from companion.transport.send_queue import SendQueue

#: A connection is read up to this number of bytes, and for so long, before others have their turn: input made
#: to be slow to parse (0.3 MB/s) then delays the others by 0.05 s at most.
READ_SIZE = 1 << 14
TURN_S = 0.003
INBOX_LIMIT = 1 << 20


#: Takes bytes and their sender (None if there is only one); b"" when the stream of one of several begins or
#: ends.
Handler: TypeAlias = Callable[[bytes, Hashable], None]


class Connection:
    """An open connection. Not thread-safe; belongs to the running loop."""

    def __init__(
        self,
        name: str,
        device: int | socket.socket,
        receive: Callable[[], bytes | None],
        send: Callable[[bytes], int],
        release: Callable[[], None] | None = None,
        peers: PeerTable | None = None,
    ) -> None:
        """Watch an open device.

        Parameters
        ----------
        name
            Name of the connection in error messages.
        device
            File descriptor or socket, in non-blocking mode.
        receive
            Returns the available bytes, None for an empty datagram, b"" at the end. May raise OSError;
            BlockingIOError means that nothing is available.
        send
            Returns how many bytes were accepted. May raise OSError; BlockingIOError: the line is full.
        release
            Closes the device; by default, it is only closed.
        peers
            Peers of a link that receives from several; `receive` then sets `sender`.
        """
        self.name = name
        self._device = device
        self._fd = device if isinstance(device, int) else device.fileno()
        self._receive = receive
        self._release = release or (partial(os.close, device) if isinstance(device, int) else device.close)
        self._loop = asyncio.get_running_loop()
        self.sender: Hashable = None  # of the last bytes received
        self._peers = peers
        self._inbox: list[tuple[bytes, Hashable]] = []
        self._inbox_size = 0
        self._send_queue = SendQueue(send, self._loop.time)
        self._waiter: asyncio.Future[None] | None = None
        self._end: str | None = None  # why it ended
        self._handler: Handler | None = None
        self._loop.add_reader(self._fd, self._on_readable)

    @property
    def port(self) -> int:
        """The local port, 0 if the connection has none."""
        if isinstance(self._device, socket.socket) and self._device.family in (
            socket.AF_INET,
            socket.AF_INET6,
        ):
            return int(self._device.getsockname()[1])
        return 0

    async def read(self) -> bytes:
        """Wait for bytes and return all that arrived. ConnectionError when the connection has ended."""
        while not self._inbox:
            if self._end is not None:
                raise ConnectionError(self._end)
            self._waiter = self._loop.create_future()
            try:
                await self._waiter
            finally:
                self._waiter = None
        return b"".join(data for data, _ in self._take_inbox())

    async def deliver_to(self, handler: Handler) -> None:
        """Call `handler` with each piece as soon as it arrives, until the connection ends.

        Raises ConnectionError at the end, or what `handler` raised.
        """
        self._waiter, self._handler = self._loop.create_future(), handler
        try:
            for data, sender in self._take_inbox():
                handler(data, sender)
            if self._end is None:
                await self._waiter
        finally:
            self._waiter = self._handler = None
        raise ConnectionError(self._end)

    def note(self, sender: Hashable, rank: Rank) -> None:
        """Note how much a sender matters: on a link with several, those that do are sent to."""
        if self._peers is not None:
            self._peers.note(sender, rank)

    @property
    def is_open(self) -> bool:
        """Whether the connection has not ended."""
        return self._end is None

    @property
    def dropped(self) -> int:
        """Number of frames dropped because the line was too slow."""
        return self._send_queue.dropped

    def write(self, frame: bytes) -> None:
        """Send a frame now or as soon as the line accepts it. No effect after the end."""
        if self._end is not None or not frame:
            return
        was_waiting = bool(self._send_queue)
        try:
            self._send_queue.write(frame)
        except OSError as error:
            self.end(f"failed: {reason(error)}")
        if self._send_queue and not was_waiting:
            self._loop.add_writer(self._fd, self._on_writable)

    def close(self) -> None:
        """End the connection; a waiting `read` raises ConnectionError."""
        self.end("was closed")

    def end(self, why: str) -> None:
        """End the connection with `why` as the text of its ConnectionError. No effect after the end."""
        if self._end is not None:
            return
        self._end = f"{self.name} {why}"
        self._loop.remove_reader(self._fd)
        self._loop.remove_writer(self._fd)
        self._send_queue.clear()
        self._release()
        self._wake()

    def _take_inbox(self) -> list[tuple[bytes, Hashable]]:
        taken, self._inbox = self._inbox, []
        if self._inbox_size >= INBOX_LIMIT and self._end is None:
            self._loop.add_reader(self._fd, self._on_readable)
        self._inbox_size = 0
        return taken

    def _on_readable(self) -> None:
        size, until = 0, self._loop.time() + TURN_S
        while size < READ_SIZE and self._loop.time() < until:
            try:
                data = self._receive()
            except BlockingIOError:
                break
            except OSError as error:
                return self.end(f"failed: {reason(error)}")
            if data is None:
                continue
            if not data:
                return self.end("was closed by the other side")
            size += len(data)
            if not self._deliver(data):
                break
        return None

    def _deliver(self, data: bytes) -> bool:
        """Pass `data` on; return whether reading may continue."""
        if self._handler is not None and self._waiter is not None:
            try:
                self._handler(data, self.sender)
            except Exception as error:
                if not self._waiter.done():
                    self._waiter.set_exception(error)
                return False
            return self._end is None
        self._inbox.append((data, self.sender))
        if self._handler is None:
            self.note(self.sender, Rank.ACCEPTED)  # `read` does not judge
        self._inbox_size += len(data)
        self._wake()
        if self._inbox_size >= INBOX_LIMIT:
            self._loop.remove_reader(self._fd)
        return self._inbox_size < INBOX_LIMIT

    def _on_writable(self) -> None:
        try:
            self._send_queue.flush()
        except OSError as error:
            self.end(f"failed: {reason(error)}")
        if not self._send_queue:
            self._loop.remove_writer(self._fd)

    def _wake(self) -> None:
        if self._waiter is not None and not self._waiter.done():
            self._waiter.set_result(None)


def socket_connection(name: str, sock: socket.socket) -> Connection:
    """Return a connection over a connected stream socket."""
    return Connection(name, sock, lambda: sock.recv(READ_SIZE), sock.send)


def reason(error: OSError) -> str:
    """Return the system's text of an error; an error without a number already has a text of ours."""
    if isinstance(error, TimeoutError) and not error.errno:
        return "no answer"
    return os.strerror(error.errno) if error.errno and error.errno > 0 else error.strerror or str(error)
