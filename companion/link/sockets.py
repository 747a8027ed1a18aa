"""UDP, TCP and memory."""

from __future__ import annotations

import asyncio
import contextlib
import errno
import socket
from typing import Any

from companion.link.address import Address
from companion.link.stream import AT_ONCE, Stream, reason

LONGEST_DATAGRAM = 65536
#: Peers that a listening UDP link answers to: the last ones heard.
PEERS = 8
CONNECT_TIMEOUT = 10.0


class CannotListen(OSError):
    """The address to listen on is not to be had: for the operator to settle, so no reconnect helps."""


def pair() -> tuple[Stream, Stream]:
    """Return the two ends of a link in memory."""
    one, other = socket.socketpair()
    return _over_socket("memory", one), _over_socket("memory", other)


async def open_socket(address: Address) -> Stream:
    """Bind where the address listens, else connect. OSError, CannotListen where the own address is not to be
    had.
    """
    loop = asyncio.get_running_loop()
    datagrams = address.kind.startswith("udp")
    kind = socket.SOCK_DGRAM if datagrams else socket.SOCK_STREAM
    found = await loop.getaddrinfo(address.place, address.number, type=kind)
    family, _, _, _, where = found[0]
    sock = socket.socket(family, kind)
    sock.setblocking(False)
    try:
        if address.kind in ("udpin", "tcpin"):
            _bind(address, sock, where)
        if address.kind == "udpin":
            return _listen_udp(address, sock)
        if address.kind == "udpout":
            sock.connect(where)
            return _over_socket(str(address), sock, forgiving=True)
        if address.kind == "tcpin":
            sock.listen(1)
            listener, (sock, _) = sock, await loop.sock_accept(sock)
            listener.close()
        else:
            async with asyncio.timeout(CONNECT_TIMEOUT):
                await loop.sock_connect(sock, where)
        sock.setblocking(False)
        sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        return _over_socket(str(address), sock)
    except BaseException:
        sock.close()
        raise


def _bind(address: Address, sock: socket.socket, where: Any) -> None:
    if address.kind == "tcpin":
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    try:
        sock.bind(where)
    except OSError as error:
        in_use = error.errno == errno.EADDRINUSE
        advice = "end the other program or choose another port" if in_use else "choose another host or port"
        raise CannotListen(error.errno, f"cannot listen on {address}: {reason(error)}; {advice}") from None


def _over_socket(name: str, sock: socket.socket, forgiving: bool = False) -> Stream:
    """Stream over a connected socket. `forgiving`: a datagram that nobody took is no end."""
    sock.setblocking(False)

    def take() -> bytes | None:
        try:
            data = sock.recv(LONGEST_DATAGRAM if forgiving else AT_ONCE)
        except ConnectionRefusedError:
            if forgiving:
                return None
            raise
        return data or (None if forgiving else b"")

    def put(frame: bytes) -> int:
        try:
            return sock.send(frame)
        except (ConnectionRefusedError, BlockingIOError) as error:
            if forgiving and isinstance(error, ConnectionRefusedError):
                return len(frame)
            raise

    return Stream(name, sock, take, put)


def _listen_udp(address: Address, sock: socket.socket) -> Stream:
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

    return Stream(str(address), sock, take, put)
