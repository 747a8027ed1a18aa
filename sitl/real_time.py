"""Real-time runner: what is simulated, relayed or played back, on real links and the system clock.

A subclass defines two methods: `_steps` acts and yields the seconds until it must act again, `_receive`
handles bytes. Links, waiting, signals and the exit code are here.
"""

from __future__ import annotations

import asyncio
import os
import random
import signal
import sys
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Hashable, Iterable, Iterator, Sequence
from functools import partial

import click

from companion.transport.peers import Rank
from companion.transport.reconnect import Address, CannotListen, Connection, cannot_listen, connections

LONGEST_SLEEP_S = 0.2


class RealTimeRunner(ABC):
    """One run over one or more links; `report` receives lines for the user."""

    def __init__(self, addresses: Sequence[Address], report: Callable[[str], None]) -> None:
        self._addresses, self._report = addresses, report
        self._streams: dict[int, Connection] = {}
        self._received = asyncio.Event()
        self._stopped = False
        self.started_ns = time.monotonic_ns()

    @abstractmethod
    def _steps(self) -> Iterator[float]:
        """Act, and yield the seconds until the next action, until the end or `_stopped`."""

    @abstractmethod
    def _receive(self, link: int, data: bytes) -> None:
        """Handle bytes of the link with this index."""

    def stop(self) -> None:
        """Make `run` return soon."""
        self._stopped = True
        self._received.set()

    async def run(self) -> None:
        """Run to the end or until `stop`. Raises CannotListen if an address is in use."""
        self.started_ns = time.monotonic_ns()
        try:
            async with asyncio.TaskGroup() as tasks:
                serving = [tasks.create_task(self._serve(link)) for link in range(len(self._addresses))]
                for seconds in self._steps():
                    await self._wait(min(seconds, LONGEST_SLEEP_S))
                for task in serving:
                    task.cancel()
        except ExceptionGroup as group:
            raise cannot_listen(group) from None

    def run_command(self) -> None:
        """Run to the end, SIGINT or SIGTERM. Ends the process with code 69 if an address is in use."""

        async def run() -> None:
            for number in (signal.SIGINT, signal.SIGTERM):
                asyncio.get_running_loop().add_signal_handler(number, self.stop)
            await self.run()

        try:
            asyncio.run(run())
        except CannotListen as error:
            click.echo(f"companion: {error.strerror}", err=True)
            sys.exit(os.EX_UNAVAILABLE)

    def _elapsed_ns(self) -> int:
        return time.monotonic_ns() - self.started_ns

    def _send(self, frames: Iterable[bytes], link: int = 0) -> None:
        """Send the frames, or drop them while the link is down."""
        if (stream := self._streams.get(link)) is not None:
            for data in frames:
                stream.write(data)

    async def _wait(self, seconds: float) -> None:
        """Sleep until the time is over or bytes arrive: they may need an answer at once."""
        try:
            async with asyncio.timeout(max(0.0, seconds)):
                await self._received.wait()
        except TimeoutError:
            pass
        self._received.clear()

    async def _serve(self, link: int) -> None:
        async for stream in connections(self._addresses[link], random.random, self._report):
            self._streams[link] = stream
            try:
                await stream.deliver_to(partial(self._deliver, link))
            except ConnectionError as error:
                self._report(f"{error}; reconnecting")
            del self._streams[link]

    def _deliver(self, link: int, data: bytes, peer: Hashable) -> None:
        if data:  # a client that has connected or left sends none
            self._streams[link].note(peer, Rank.ACCEPTED)
        self._receive(link, data)
        self._received.set()


def parse_address(text: str, option: str = "--connect") -> Address:
    """Parse the address given with an option. Raises BadParameter."""
    try:
        return Address.parse(text)
    except ValueError as error:
        raise click.BadParameter(str(error), param_hint=option) from None
