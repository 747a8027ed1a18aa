"""TCP connections with fast detection of lost peers, and a listener that serves one client.

A peer that disappeared without closing (a roaming ground station, a lost hotspot) is detected after
PEER_TIMEOUT_S: an idle connection is probed, and unacknowledged data, or a peer that does not read, ends the
connection. A client that reconnects sooner, from a new address, replaces its old connection with its first
valid frame; what sends none, or has to wait longer than WAIT_S for its turn, is closed.
"""

from __future__ import annotations

import asyncio
import contextlib
import socket
from collections import Counter
from collections.abc import Callable

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
#: Newcomers that may wait beside a served client, in all and of one host; seconds and bytes up to a frame.
MAX_WAITING, MAX_WAITING_OF_HOST, WAIT_S, MAX_BYTES = 32, 8, 3.0, 4096
#: Newcomers accepted at once, before others have their turn, and pause (s) after a failed accept.
BURST, PAUSE_S = 16, 0.25


def tcp_connection(name: str, sock: socket.socket, first: bytes = b"") -> Connection:
    """Connection over a connected socket, from which `first` was already read."""
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
    return socket_connection(name, sock, first)


class Listener:
    """Listening TCP socket, open with or without a client.

    Without a client the first newcomer is served at once. It yields to a newcomer whose first bytes pass
    `is_valid` (by default, to any newcomer).
    """

    def __init__(
        self, address: Address, sock: socket.socket, is_valid: Callable[[bytes], bool] | None = None
    ) -> None:
        self._name = str(address)
        self._sock = sock
        self._is_valid = is_valid
        self._loop = asyncio.get_running_loop()
        self._served: Connection | None = None
        self._next: Connection | None = None
        self._waiting: dict[socket.socket, tuple[str, bytes]] = {}  # host and first bytes, oldest first
        self._arrived = asyncio.Event()
        self._loop.add_reader(self._sock, self._on_connectable)

    @classmethod
    async def open(cls, address: Address, is_valid: Callable[[bytes], bool] | None = None) -> Listener:
        """Start to listen. Raises as `open_socket`."""
        return cls(address, await open_socket(address), is_valid)

    async def accept(self) -> Connection:
        """Wait for a client. Its connection ends when a newer one replaces it."""
        if self._next is None and self._waiting:
            newest = next(reversed(self._waiting))
            self._promote(newest, self._remove(newest))
        while self._next is None or not self._next.is_open:
            self._arrived.clear()
            await self._arrived.wait()
        self._served, self._next = self._next, None
        return self._served

    def close(self) -> None:
        """Stop listening. An accepted client stays connected."""
        self._loop.remove_reader(self._sock)
        self._sock.close()
        for client in list(self._waiting):
            self._drop(client)

    def _on_connectable(self) -> None:
        for _ in range(BURST):
            try:
                client, where = self._sock.accept()
            except BlockingIOError:
                return
            except OSError:  # out of descriptors, or the client has left
                self._loop.remove_reader(self._sock)
                self._loop.call_later(PAUSE_S, self._listen_again)
                return
            client.setblocking(False)
            self._receive_newcomer(client, str(where[0]))

    def _listen_again(self) -> None:
        if self._sock.fileno() >= 0:
            self._loop.add_reader(self._sock, self._on_connectable)

    def _receive_newcomer(self, client: socket.socket, host: str) -> None:
        busy = any(one is not None and one.is_open for one in (self._served, self._next))
        if not busy or self._is_valid is None:
            self._promote(client, b"")
            return
        of_host = Counter(one for one, _ in self._waiting.values())[host]
        if len(self._waiting) >= MAX_WAITING or of_host >= MAX_WAITING_OF_HOST:
            client.close()
            return
        self._waiting[client] = host, b""
        self._loop.add_reader(client, self._on_first_bytes, client)
        self._loop.call_later(WAIT_S, self._drop, client)

    def _on_first_bytes(self, client: socket.socket) -> None:
        host, data = self._waiting[client]
        try:
            more = client.recv(MAX_BYTES)
        except BlockingIOError:
            return
        except OSError:
            more = b""
        data += more
        if not more or len(data) > MAX_BYTES:
            self._drop(client)
            return
        self._waiting[client] = host, data
        if self._is_valid is None or self._is_valid(data):
            self._promote(client, self._remove(client))

    def _promote(self, client: socket.socket, first: bytes) -> None:
        """Serve `client` next; the client that is served ends."""
        for one in (self._served, self._next):
            if one is not None:
                one.end("was replaced by a newer client")
        self._next = tcp_connection(self._name, client, first)
        self._arrived.set()

    def _remove(self, client: socket.socket) -> bytes:
        self._loop.remove_reader(client)
        return self._waiting.pop(client)[1]

    def _drop(self, client: socket.socket) -> None:
        if client in self._waiting:
            self._remove(client)
            client.close()
