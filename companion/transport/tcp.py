"""TCP connections with fast detection of lost peers, and a listening socket with its clients.

A peer that disappeared without closing (a roaming ground station, a lost hotspot) is detected after
PEER_TIMEOUT_S: an idle connection is probed, and unacknowledged data, or a peer that does not read, ends the
connection.

A listening socket serves MAX_PEERS clients. When all places are taken, a newcomer's first valid frame takes
the place of a client that has sent none, or none for YIELDS_S; the autopilot's takes any station's. So a
client that reconnects from a new address gets in. A newcomer that sends no valid frame in WAIT_S is closed,
or earlier if MAX_WAITING others wait; none is closed on arrival, so idle connections cannot keep others out.
"""

from __future__ import annotations

import asyncio
import contextlib
import math
import socket
from collections import Counter
from collections.abc import Callable
from typing import Any, TypeAlias

from companion.transport.connection import Connection, socket_connection
from companion.transport.peers import PeerTable, Rank

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
#: Newcomers that may wait for a place: of 1,000 a second each has 0.25 s for its first frame.
MAX_WAITING = 256
#: Seconds and bytes that a newcomer has for its first frame.
WAIT_S, MAX_BYTES = 3.0, 4096
#: Silence (s) of a client after which it yields its place; a ground station sends HEARTBEAT every second.
YIELDS_S = 3.0
#: Pause (s) after a failed accept.
PAUSE_S = 0.25
#: Makes a function for each client that takes its next bytes and returns whether they complete a valid frame.
Judge: TypeAlias = Callable[[], Callable[[bytes], bool]]


def tcp_connection(name: str, sock: socket.socket) -> Connection:
    """Return a connection over a connected socket."""
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


class Listener(Connection):
    """Listening socket and its clients as one connection, open with or without clients.

    Frames are written to all clients that have a place, by a connection and send queue each; a sender is the
    connection of a client.
    """

    def __init__(self, name: str, sock: socket.socket, judge: Judge) -> None:
        self._places = PeerTable(asyncio.get_running_loop().time, math.inf, YIELDS_S)
        super().__init__(name, sock, self._accept, self._send, self._close, self._places)
        self._sock = sock
        self._judge = judge
        self._clients: dict[Connection, asyncio.Task[None]] = {}
        self._waiting: dict[Connection, str] = {}  # host of those without a place or a frame yet
        self._dropped_before = 0  # by clients that have left

    @property
    def dropped(self) -> int:
        """Number of frames dropped because the line of a client was too slow."""
        return self._dropped_before + sum(client.dropped for client in self._clients)

    def note(self, sender: Any, rank: Rank) -> None:
        """Note how much a client matters; end the one whose place it takes."""
        replaced = self._places.note(sender, rank)
        if replaced is not None:
            replaced.end("was replaced by a newer client")

    def _accept(self) -> None:
        try:
            sock, (host, *_) = self._sock.accept()
        except BlockingIOError:
            raise
        except OSError:  # out of descriptors, or the client has left
            self._loop.remove_reader(self._sock)
            self._loop.call_later(PAUSE_S, self._listen_again)
            raise BlockingIOError from None
        sock.setblocking(False)
        client = tcp_connection(self.name, sock)
        self._places.join(client)
        if client not in self._places.active():
            self._waiting[client] = host
            if len(self._waiting) > MAX_WAITING:
                self._end_waiting()
        self._clients[client] = self._loop.create_task(self._serve(client))

    def _end_waiting(self) -> None:
        """Close the client that has waited longest, of the host with most waiting ones."""
        host, _ = Counter(self._waiting.values()).most_common(1)[0]
        oldest = next(client for client, of_client in self._waiting.items() if of_client == host)
        del self._waiting[oldest]
        oldest.end("made room for a newer client")

    def _listen_again(self) -> None:
        if self.is_open:
            self._loop.add_reader(self._sock, self._on_readable)

    async def _serve(self, client: Connection) -> None:
        """Deliver what a client sends, from its first valid frame on if it has to wait for a place."""
        is_valid, first, has_frame = self._judge(), b"", False
        try:
            if client in self._places.active():
                self._pass_on(client, b"")
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(WAIT_S):
                    while not has_frame and len(first) < MAX_BYTES:
                        first += (data := await client.read())
                        has_frame = is_valid(data)
            self._waiting.pop(client, None)
            if has_frame or client in self._places.active():
                self._pass_on(client, first)
                await client.deliver_to(lambda data, _: self._pass_on(client, data))
        except ConnectionError:
            pass
        finally:
            client.close()
            self._dropped_before += client.dropped
            del self._clients[client]
            self._waiting.pop(client, None)
            self._places.remove(client)
            self._pass_on(client, b"")

    def _pass_on(self, client: Connection, data: bytes) -> None:
        if data or self._handler is not None:
            self.sender = client
            self._deliver(data)
        if client not in self._places.active():
            client.end("found no place")

    def _send(self, frame: bytes) -> int:
        for client in self._places.active():
            client.write(frame)
        return len(frame)

    def _close(self) -> None:
        self._sock.close()
        for client in list(self._clients):
            client.close()
