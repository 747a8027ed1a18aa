"""Byte streams over serial lines, UDP, TCP and memory, opened again for ever. Knows no MAVLink.

async for stream in connections(Address.parse("udpin:127.0.0.1:14550"), random.random, print):
    try:
        while True:
            data = await stream.read()      # all that is there; ConnectionError when the link ends
            stream.write(answer)            # never waits
        # or, where the answer must not wait for a turn of the event loop:
        await stream.hand_to(receive)       # each piece as it comes, until the link ends
    except ConnectionError as error:
        ...                                 # the next turn opens it again, after a pause
"""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Callable, Iterator

from companion.transport.address import Address
from companion.transport.connection import Stream, pair, reason
from companion.transport.serial_line import open_serial
from companion.transport.sockets import CannotListen, open_socket
from companion.transport.tcp import Listener, over_tcp
from companion.transport.udp import to_all, to_one

__all__ = ["Address", "CannotListen", "Stream", "back_off", "connect", "connections", "pair"]

SHORTEST_PAUSE, LONGEST_PAUSE = 0.25, 10.0
#: A link that lasted so long (s) had been good: its loss begins the pauses anew.
GOOD_AFTER = 10.0


async def connect(address: Address) -> Stream:
    """Open the link once. OSError if it is not to be had, CannotListen if its own address never will be."""
    if address.kind == "serial":
        return open_serial(address)
    if address.kind == "tcpin":
        listener = await Listener.on(address)
        try:
            return await listener.accept()
        finally:
            listener.close()
    over = {"udpin": to_all, "udpout": to_one, "tcp": over_tcp}[address.kind]
    return over(str(address), await open_socket(address))


async def connections(
    address: Address, random: Callable[[], float], say: Callable[[str], None]
) -> AsyncIterator[Stream]:
    """Open the link, and again whenever the body of the `async for` comes back, for ever.

    `random` returns numbers in [0, 1), for the jitter of the pauses; `say` gets one line for each failure
    that differs from the last. CannotListen ends it, at its very first attempt alone: by then an operator is
    there to settle it, later there may be none. A listening TCP link keeps listening between its clients.
    """
    loop = asyncio.get_running_loop()
    pauses = back_off(random)
    said, is_first = "", True
    listener: Listener | None = None
    try:
        while True:
            try:
                if address.kind == "tcpin":
                    listener = listener or await Listener.on(address)
                stream = await (listener.accept() if listener else connect(address))
            except OSError as error:
                if is_first and isinstance(error, CannotListen):
                    raise
                line = f"{address}: {reason(error)}; trying again"
                if line != said:
                    say(line)
                said = line
            else:
                said, opened = "", loop.time()
                try:
                    yield stream
                finally:
                    stream.close()
                if loop.time() - opened >= GOOD_AFTER:
                    pauses = back_off(random)
            is_first = False
            await asyncio.sleep(next(pauses))
    finally:
        if listener is not None:
            listener.close()


def back_off(random: Callable[[], float]) -> Iterator[float]:
    """Yield pauses in seconds that double up to LONGEST_PAUSE, each shortened by up to a half at random."""
    longest = SHORTEST_PAUSE
    while True:
        yield longest * (1 - random() / 2)
        longest = min(2 * longest, LONGEST_PAUSE)
