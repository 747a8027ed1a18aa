"""Datagrams: to one place, or to all who were heard lately."""

from __future__ import annotations

import contextlib
import socket
from typing import Any

from companion.transport.connection import Stream

LONGEST_DATAGRAM = 65536
#: Peers that a listening link answers to: the last ones heard.
PEERS = 8


def to_one(name: str, sock: socket.socket) -> Stream:
    """Stream over a connected socket; a datagram that nobody took is no end."""

    def take() -> bytes | None:
        try:
            return sock.recv(LONGEST_DATAGRAM) or None
        except ConnectionRefusedError:
            return None

    def put(frame: bytes) -> int:
        try:
            return sock.send(frame)
        except ConnectionRefusedError:
            return len(frame)

    return Stream(name, sock, take, put)


def to_all(name: str, sock: socket.socket) -> Stream:
    """Stream over a bound socket, to the last PEERS who spoke."""
    peers: dict[Any, None] = {}  # in the order of their last word

    def take() -> bytes | None:
        data, peer = sock.recvfrom(LONGEST_DATAGRAM)
        peers.pop(peer, None)
        peers[peer] = None
        if len(peers) > PEERS:
            del peers[next(iter(peers))]
        return data or None

    def put(frame: bytes) -> int:
        for peer in peers:
            with contextlib.suppress(OSError):  # a peer that is gone, or a full line: one datagram lost
                sock.sendto(frame, peer)
        return len(frame)

    return Stream(name, sock, take, put)
