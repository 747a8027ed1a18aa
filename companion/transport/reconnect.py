"""Reconnecting transport: byte streams over serial lines, UDP and TCP, opened again after each failure.

async for connection in connections(Address.parse("udpin:127.0.0.1:14550"), random.random, print):
    try:
        while True:
            data = await connection.read()      # all that is available; ConnectionError at the end
            connection.write(answer)            # never waits
        # or, if the answer must not wait for a turn of the event loop:
        await connection.deliver_to(receive)    # each piece as it arrives, until the connection ends
    except ConnectionError as error:
        ...                                     # the next iteration opens it again, after a pause
"""

from __future__ import annotations

import asyncio
import socket
from collections.abc import AsyncIterator, Callable, Iterator

from companion.transport.address import Address
from companion.transport.connection import Connection, reason
from companion.transport.serial_line import open_serial
from companion.transport.sockets import CannotListen, cannot_listen, open_socket
from companion.transport.tcp import Judge, Listener, tcp_connection
from companion.transport.udp import connected_udp, listening_udp

__all__ = [
    "Address",
    "CannotListen",
    "Connection",
    "back_off",
    "cannot_listen",
    "connect",
    "connections",
    "describe_failure",
]

MIN_PAUSE, MAX_PAUSE = 0.25, 10.0
#: After a connection that lasted this long (s), the pauses start again from the shortest.
GOOD_AFTER = 10.0


async def connect(address: Address, judge: Judge = lambda: bool) -> Connection:
    """Open a connection once. OSError if it fails, CannotListen if our own address cannot be used.

    `judge` judges the clients of a listening TCP link, see `Listener`.
    """
    if address.kind == "serial":
        return open_serial(address)
    sock = await open_socket(address)
    if address.kind == "tcpin":
        return Listener(str(address), sock, judge)
    if address.kind == "udpin":
        return listening_udp(str(address), sock, asyncio.get_running_loop().time)
    return {"udpout": connected_udp, "tcp": tcp_connection}[address.kind](str(address), sock)


async def connections(
    address: Address,
    random: Callable[[], float],
    report: Callable[[str], None],
    judge: Judge = lambda: bool,
) -> AsyncIterator[Connection]:
    """Open a connection, and open it again at every iteration of the `async for`, until stopped.

    CannotListen is raised by the first attempt only: then an operator is present to correct the address,
    later there may be none.

    Parameters
    ----------
    address
        Address of the link.
    random
        Returns numbers in [0, 1), for the jitter of the pauses.
    report
        Receives one line for each failure that differs from the last.
    judge
        See `connect`.
    """
    loop = asyncio.get_running_loop()
    pauses = back_off(random)
    last_report, is_first = "", True
    while True:
        try:
            connection = await connect(address, judge)
        except OSError as error:
            if is_first and isinstance(error, CannotListen):
                raise
            line = f"{describe_failure(address, error)}; trying again"
            if line != last_report:
                report(line)
            last_report = line
        else:
            last_report, opened = "", loop.time()
            try:
                yield connection
            finally:
                connection.close()
            if loop.time() - opened >= GOOD_AFTER:
                pauses = back_off(random)
        is_first = False
        await asyncio.sleep(next(pauses))


def describe_failure(address: Address, error: OSError) -> str:
    """Describe why a link cannot be opened, and what to do."""
    return f"{address}: {reason(error)}{_advice(address, error)}"


def _advice(address: Address, error: OSError) -> str:
    if isinstance(error, PermissionError) and address.kind == "serial":
        return "; add this user to the group of the serial port (usually dialout) and log in again"
    if isinstance(error, ConnectionRefusedError):
        return "; start the program that listens there, or give another port"
    if isinstance(error, socket.gaierror):
        return "; check the host name, or give an IP address"
    return ""


def back_off(random: Callable[[], float]) -> Iterator[float]:
    """Yield pauses in seconds that double up to MAX_PAUSE, each shortened by up to a half at random."""
    longest = MIN_PAUSE
    while True:
        yield longest * (1 - random() / 2)
        longest = min(2 * longest, MAX_PAUSE)
