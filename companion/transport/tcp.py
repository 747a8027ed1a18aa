"""TCP connections that end soon after their peer is gone, and a listener whose newest client is the link.

A peer that vanished without a word (a roaming ground station, a hotspot gone) is noticed after GONE_AFTER_S:
silence is probed, and data that nobody confirms, or a peer that reads nothing, ends the connection. A client
that comes back sooner, from a new address, is let in at once in place of what it was.
"""

from __future__ import annotations

import asyncio
import contextlib
import socket

from companion.transport.address import Address
from companion.transport.connection import Stream, over_socket
from companion.transport.sockets import open_socket

#: A peer that answers nothing for so long (s) is gone.
GONE_AFTER_S = 10
#: Bytes that the system may hold unsent: they cannot be called back, and grow old there.
UNSENT = 2048
#: By system; where one is not known, the others do what they can.
OPTIONS = {
    "TCP_NODELAY": 1,
    "TCP_USER_TIMEOUT": 1000 * GONE_AFTER_S,
    "TCP_KEEPIDLE": GONE_AFTER_S // 2,
    "TCP_KEEPALIVE": GONE_AFTER_S // 2,  # as macOS calls the line before
    "TCP_KEEPINTVL": 2,
    "TCP_KEEPCNT": 3,
    "TCP_NOTSENT_LOWAT": UNSENT,
}
#: Bytes sent and not yet acknowledged, about: more than 50 kB/s at a round trip of 0.2 s.
SEND_BUFFER = 1 << 14


def over_tcp(name: str, sock: socket.socket) -> Stream:
    """Stream over a connected socket."""
    settings = [
        (socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1),
        (socket.SOL_SOCKET, socket.SO_SNDBUF, SEND_BUFFER),
    ]
    settings += [
        (socket.IPPROTO_TCP, getattr(socket, option), value)
        for option, value in OPTIONS.items()
        if hasattr(socket, option)
    ]
    for level, option, value in settings:
        with contextlib.suppress(OSError):  # known to Python, not to this kernel; or the peer has left
            sock.setsockopt(level, option, value)
    return over_socket(name, sock)


class Listener:
    """A TCP address that is listened on for as long as this is open, with a client or without."""

    def __init__(self, address: Address, sock: socket.socket) -> None:
        self._name = str(address)
        self._sock = sock
        self._loop = asyncio.get_running_loop()

    @classmethod
    async def on(cls, address: Address) -> Listener:
        """Listen. OSError, CannotListen as `open_socket`."""
        return cls(address, await open_socket(address))

    async def accept(self) -> Stream:
        """Wait for a client, of several take the newest; its link ends when a newer one comes. OSError."""
        self._loop.remove_reader(self._sock)
        client, _ = await self._loop.sock_accept(self._sock)
        with contextlib.suppress(OSError):  # BlockingIOError: there are no more
            while True:
                newer, _ = self._sock.accept()
                client.close()
                client = newer
        client.setblocking(False)
        stream = over_tcp(self._name, client)
        self._loop.add_reader(self._sock, self._give_way, stream)
        return stream

    def _give_way(self, stream: Stream) -> None:
        self._loop.remove_reader(self._sock)
        stream.end("gives way to a newer client")

    def close(self) -> None:
        """Listen no more. A client that was accepted stays."""
        self._loop.remove_reader(self._sock)
        self._sock.close()
