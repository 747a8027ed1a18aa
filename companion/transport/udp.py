"""UDP connections: to one peer, or to the peers that are received."""

from __future__ import annotations

import contextlib
import socket
from collections.abc import Callable

from companion.transport.connection import Connection
from companion.transport.peers import PeerTable

MAX_DATAGRAM = 65536


def connected_udp(name: str, sock: socket.socket) -> Connection:
    """Return a connection over a connected socket; a refused datagram does not end it."""

    def receive() -> bytes | None:
        try:
            return sock.recv(MAX_DATAGRAM) or None
        except ConnectionRefusedError:
            return None

    def send(frame: bytes) -> int:
        try:
            return sock.send(frame)
        except ConnectionRefusedError:
            return len(frame)

    return Connection(name, sock, receive, send)


def listening_udp(name: str, sock: socket.socket, now: Callable[[], float]) -> Connection:
    """Return a connection over a bound socket that sends to its peers; `now` returns seconds."""
    peers = PeerTable(now)

    def receive() -> bytes | None:
        data, connection.sender = sock.recvfrom(MAX_DATAGRAM)
        return data or None

    def send(frame: bytes) -> int:
        for peer in peers.active():
            with contextlib.suppress(OSError):  # the peer has left, or the line is full: one datagram lost
                sock.sendto(frame, peer)
        return len(frame)

    connection = Connection(name, sock, receive, send, peers=peers)
    return connection
