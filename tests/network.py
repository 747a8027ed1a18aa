"""Helpers of tests that use sockets and asyncio: free ports, time limits, waiting for a condition."""

from __future__ import annotations

import asyncio
import contextlib
import socket
from collections.abc import Callable, Coroutine
from typing import Any, Protocol


class Readable(Protocol):
    async def read(self) -> bytes: ...


def free_port() -> int:
    """Return a port of the loopback interface that neither TCP nor UDP uses."""
    while True:
        with (
            socket.socket(socket.AF_INET, socket.SOCK_STREAM) as tcp,
            socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as udp,
            contextlib.suppress(OSError),
        ):
            tcp.bind(("127.0.0.1", 0))
            port = int(tcp.getsockname()[1])
            udp.bind(("127.0.0.1", port))
            return port


def run(test: Coroutine[Any, Any, None], seconds: float = 120.0) -> None:
    """Run a test, for `seconds` at most."""

    async def limited() -> None:
        async with asyncio.timeout(seconds):
            await test

    asyncio.run(limited())


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
