"""UDP connections: to one peer, or to the peers received most recently."""

from __future__ import annotations

import contextlib
import socket
from typing import Any

from companion.transport.connection import Connection

MAX_DATAGRAM = 65536
#: Number of most recent peers that a listening link sends to.
MAX_PEERS = 8


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


def listening_udp(name: str, sock: socket.socket) -> Connection:
    """Return a connection over a bound socket that sends to the last MAX_PEERS peers."""
    peers: dict[Any, None] = {}  # in order of their last datagram

    def receive() -> bytes | None:
        data, peer = sock.recvfrom(MAX_DATAGRAM)
        peers.pop(peer, None)
        peers[peer] = None
        if len(peers) > MAX_PEERS:
            del peers[next(iter(peers))]
        return data or None

    def send(frame: bytes) -> int:
        for peer in peers:
            with contextlib.suppress(OSError):  # the peer has left, or the line is full: one datagram lost
                sock.sendto(frame, peer)
        return len(frame)

    return Connection(name, sock, receive, send)
