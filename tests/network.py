"""Helpers of tests that use sockets and asyncio: free ports, waiting for a condition."""

from __future__ import annotations

import asyncio
import itertools
import socket
from collections.abc import Callable
from typing import Protocol


class Readable(Protocol):
    async def read(self) -> bytes: ...


#: Below the ports that the system gives to others without being asked (net.ipv4.ip_local_port_range).
_PORTS = itertools.cycle(range(16_384, 32_768))


def free_port() -> int:
    """Return a port of the loopback interface that neither TCP nor UDP uses; only one test gets it.

    Between this call and its use no connection of another process may be given it, so it is none of those
    that the system chooses from, and a name in the abstract namespace keeps it for this process.
    """
    for port in _PORTS:
        mine = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        try:
            mine.bind(f"\0companion-tests-port-{port}")
            with socket.socket(type=socket.SOCK_STREAM) as tcp, socket.socket(type=socket.SOCK_DGRAM) as udp:
                tcp.bind(("127.0.0.1", port))
                udp.bind(("127.0.0.1", port))
        except OSError:
            mine.close()
            continue
        mine.detach()  # open until the process ends
        return port
    raise AssertionError("the ports go round")


async def until(condition: Callable[[], object], seconds: float = 60.0) -> None:
    """Wait until the condition is true; TimeoutError after `seconds`."""
    async with asyncio.timeout(seconds):
        while not condition():  # noqa: ASYNC110 (a socket, a file, another process: nothing that sets an event)
            await asyncio.sleep(0.005)


async def read_exactly(connection: Readable, count: int) -> bytes:
    """Read until there are `count` bytes."""
    data = b""
    while len(data) < count:
        data += await connection.read()
    return data
