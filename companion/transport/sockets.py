"""Sockets bound where an address listens, connected where it does not; every answer to a name is tried."""

from __future__ import annotations

import asyncio
import errno
import socket
from typing import Any

from companion.transport.address import Address
from companion.transport.connection import reason

CONNECT_TIMEOUT = 10.0
#: Clients of a listening TCP link that may wait while another is served.
BACKLOG = 4
#: What no waiting mends: taken by somebody, forbidden, no address at all.
REFUSALS = (errno.EADDRINUSE, errno.EACCES, errno.EINVAL)


class CannotListen(OSError):
    """Somebody has the address to listen on, or it is forbidden: for the operator to settle."""


async def open_socket(address: Address) -> socket.socket:
    """Bind where the address listens, else connect, within CONNECT_TIMEOUT s for each answer to its name.

    The socket does not block. CannotListen where its own address is not to be had, any other OSError where
    trying again may help: a computer at its start, or in the air, has not all of its addresses.
    """
    kind = socket.SOCK_DGRAM if address.kind.startswith("udp") else socket.SOCK_STREAM
    found = await asyncio.get_running_loop().getaddrinfo(address.place, address.number, type=kind)
    failed: list[OSError] = []
    # What speaks MAVLink does so over IPv4: of `localhost`, 127.0.0.1 before ::1.
    for family, _, _, _, where in sorted(found, key=lambda answer: answer[0] != socket.AF_INET):
        try:
            return await _open(address, family, kind, where)
        except CannotListen:
            raise
        except OSError as error:
            failed.append(error)
    raise failed[0]


async def _open(address: Address, family: int, kind: int, where: Any) -> socket.socket:
    sock = socket.socket(family, kind)
    try:
        sock.setblocking(False)
        if address.listens:
            _bind(address, sock, where)
        else:
            async with asyncio.timeout(CONNECT_TIMEOUT):
                await asyncio.get_running_loop().sock_connect(sock, where)
    except BaseException:
        sock.close()
        raise
    return sock


def _bind(address: Address, sock: socket.socket, where: Any) -> None:
    if address.kind == "tcpin":
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    try:
        sock.bind(where)
        if address.kind == "tcpin":
            sock.listen(BACKLOG)
    except OSError as error:
        if error.errno == errno.EADDRNOTAVAIL:
            raise OSError(f"this computer has no address {address.place} at present") from None
        if error.errno not in REFUSALS:
            raise
        in_use = error.errno == errno.EADDRINUSE
        advice = "end the other program or choose another port" if in_use else "choose another host or port"
        raise CannotListen(error.errno, f"cannot listen on {address}: {reason(error)}; {advice}") from None
