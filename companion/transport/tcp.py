"""TCP connections with fast detection of lost peers, and a listener that serves the newest client.

A peer that disappeared without closing (a roaming ground station, a lost hotspot) is detected after
PEER_TIMEOUT_S: an idle connection is probed, and unacknowledged data, or a peer that does not read, ends the
connection. A client that reconnects sooner, from a new address, replaces its old connection at once.
"""

from __future__ import annotations

import asyncio
import contextlib
import socket

from companion.transport.address import Address
from companion.transport.connection import Connection, socket_connection
from companion.transport.sockets import open_socket

#: A peer that does not answer for this time (s) is lost.
PEER_TIMEOUT_S = 10
#: Unsent bytes that the system may buffer: they cannot be recalled when they are too old.
MAX_UNSENT = 2048
#: Socket options; those unknown to the system are left out.
OPTIONS = {
    "TCP_NODELAY": 1,
    "TCP_USER_TIMEOUT": 1000 * PEER_TIMEOUT_S,
    "TCP_KEEPIDLE": PEER_TIMEOUT_S // 2,
    "TCP_KEEPALIVE": PEER_TIMEOUT_S // 2,  # the name of TCP_KEEPIDLE on macOS
    "TCP_KEEPINTVL": 2,
    "TCP_KEEPCNT": 3,
    "TCP_NOTSENT_LOWAT": MAX_UNSENT,
}
#: Bytes sent and not yet acknowledged, about: more than 50 kB/s at a round trip of 0.2 s.
SEND_BUFFER = 1 << 14


def tcp_connection(name: str, sock: socket.socket) -> Connection:
    """Connection over a connected socket."""
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
        with contextlib.suppress(OSError):  # unknown to this kernel, or the peer has left
            sock.setsockopt(level, option, value)
    return socket_connection(name, sock)


class Listener:
    """Listening TCP socket, open with or without a client."""

    def __init__(self, address: Address, sock: socket.socket) -> None:
        self._name = str(address)
        self._sock = sock
        self._loop = asyncio.get_running_loop()

    @classmethod
    async def open(cls, address: Address) -> Listener:
        """Start to listen. Raises as `open_socket`."""
        return cls(address, await open_socket(address))

    async def accept(self) -> Connection:
        """Wait for a client; accept the newest of several. Its connection ends when a newer one arrives."""
        self._loop.remove_reader(self._sock)
        client, _ = await self._loop.sock_accept(self._sock)
        with contextlib.suppress(OSError):  # BlockingIOError: no further client
            while True:
                newer, _ = self._sock.accept()
                client.close()
                client = newer
        client.setblocking(False)
        connection = tcp_connection(self._name, client)
        self._loop.add_reader(self._sock, self._end_for_newer, connection)
        return connection

    def _end_for_newer(self, connection: Connection) -> None:
        self._loop.remove_reader(self._sock)
        connection.end("was replaced by a newer client")

    def close(self) -> None:
        """Stop listening. An accepted client stays connected."""
        self._loop.remove_reader(self._sock)
        self._sock.close()
