"""Opening of sockets: bound for listening addresses, connected for others; tries every resolved address."""

from __future__ import annotations

import asyncio
import errno
import socket
from functools import partial
from typing import Any

from companion.transport.address import Address
from companion.transport.connection import reason
from companion.transport.daemon_thread import run_in_daemon_thread

CONNECT_TIMEOUT = 10.0
#: Clients that the system completes while the event loop is busy.
BACKLOG = 64
#: Errors of `bind` that do not go away: address in use, forbidden, invalid.
PERMANENT_ERRORS = (errno.EADDRINUSE, errno.EACCES, errno.EINVAL)


class CannotListen(OSError):
    """The address to listen on is in use or forbidden; the operator must correct it."""


def cannot_listen(group: ExceptionGroup[Exception]) -> Exception:
    """Return the CannotListen among the errors of a task group, or the group if there is none.

    To be raised after `except`: in `except*` Python 3.11.2 (Debian 12) packs it into a group again.
    """
    found = group.subgroup(CannotListen)
    return group if found is None else found.exceptions[0]


async def open_socket(address: Address) -> socket.socket:
    """Open a non-blocking socket: bound if the address listens, else connected.

    Each resolved address has CONNECT_TIMEOUT s to connect. Raises CannotListen if our own address cannot be
    used, another OSError if a later attempt may succeed: a computer that starts, or is in flight, may lack
    some of its addresses.
    """
    kind = socket.SOCK_DGRAM if address.kind.startswith("udp") else socket.SOCK_STREAM
    # the pool of the loop's `getaddrinfo` would keep the process from its end while no name server answers
    find = partial(socket.getaddrinfo, address.place, address.number, type=kind)
    found = await run_in_daemon_thread(find)
    failed: list[OSError] = []
    # MAVLink programs use IPv4: of `localhost`, try 127.0.0.1 before ::1
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
        if error.errno not in PERMANENT_ERRORS:
            raise
        in_use = error.errno == errno.EADDRINUSE
        advice = "end the other program or choose another port" if in_use else "choose another host or port"
        raise CannotListen(error.errno, f"cannot listen on {address}: {reason(error)}; {advice}") from None
