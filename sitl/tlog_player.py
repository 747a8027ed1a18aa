"""`companion sitl play`: a recorded autopilot as a live one, over a real link.

    companion sitl play FLIGHT.tlog &                       # listens as ArduPilot's SITL does
    companion run --connect tcp:127.0.0.1:5760

What the autopilot of a telemetry log said goes out at its own times from the moment somebody connects. A
recording takes no orders: rates are as recorded, a message that is asked for is its last one, parameters are
unknown, and TIMESYNC stays unanswered.
"""

from __future__ import annotations

import asyncio
import math
import random
import signal
import sys
import time
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import click

from companion.importers import tlog
from companion.importers.tlog import Entry
from companion.link import dialect, frame
from companion.transport.links import Address, CannotListen, Stream, connections

EX_UNAVAILABLE = 69  # sysexits.h
NEVER = 2**63 - 1
LONGEST_SLEEP_S = 0.2
HEARTBEAT, TIMESYNC, COMMAND_LONG, COMMAND_ACK = 0, 111, 76, 77
AUTOPILOT_COMPONENT, NO_AUTOPILOT = 1, 8
SET_MESSAGE_INTERVAL, REQUEST_MESSAGE = 511, 512  # MAV_CMD
ACCEPTED, DENIED, UNSUPPORTED = 0, 2, 3  # MAV_RESULT
#: Answers to somebody who is not there any more.
ANSWERS = frozenset({TIMESYNC, COMMAND_ACK})


class Player:
    """A log's autopilot, without its I/O; it begins at `start_ns` of the listener's clock.

    `from_s` and `to_s` cut the log, `speed` is times real time. ValueError if no autopilot speaks in it.
    """

    def __init__(
        self,
        entries: Iterable[Entry],
        start_ns: int = 0,
        from_s: float = 0.0,
        to_s: float = math.inf,
        speed: float = 1.0,
    ) -> None:
        entries = list(entries)
        self.system = _autopilot(entries)
        ours = [
            e for e in entries if (e.frame.system, e.frame.component) == (self.system, AUTOPILOT_COMPONENT)
        ]
        first_ns = entries[0].rx_ns + round(from_s * 1e9)
        self._newest = {e.frame.msgid: e.frame for e in ours if e.rx_ns < first_ns}
        self._played = [
            (start_ns + round((e.rx_ns - first_ns) / speed), e.frame)
            for e in ours
            if 0 <= e.rx_ns - first_ns < (to_s - from_s) * 1e9 and e.frame.msgid not in ANSWERS
        ]
        if not self._played:
            raise ValueError("the autopilot says nothing in that part of the log")
        self._known = {e.frame.msgid for e in ours}
        self._next = 0
        self._sequence = self._played[0][1].sequence - 1 & 0xFF
        self._reader = frame.Reader()
        self._answers: list[bytes] = []

    @property
    def end_ns(self) -> int:
        """When the last frame is due."""
        return self._played[-1][0]

    def poll(self, now_ns: int) -> list[bytes]:
        """The answers to what was asked, and every frame due."""
        due, self._answers = self._answers, []
        while self._next < len(self._played) and self._played[self._next][0] <= now_ns:
            found = self._played[self._next][1]
            self._next += 1
            self._sequence = found.sequence
            self._newest[found.msgid] = found
            due.append(found.raw)
        return due

    def deadline(self) -> int:
        """When the next frame is due, `NEVER` after the last."""
        return self._played[self._next][0] if self._next < len(self._played) else NEVER

    def receive(self, data: bytes) -> None:
        """Take what a listener says: of commands it knows those that ask for messages."""
        for found in self._reader.receive(data):
            if isinstance(found, frame.Frame) and found.msgid == COMMAND_LONG:
                message = dialect.decode(found)
                if message.target_system in (0, self.system):
                    self._command(message, found)

    def _command(self, message: Any, asked: frame.Frame) -> None:
        result, wanted = UNSUPPORTED, int(message.param1)
        if message.command == SET_MESSAGE_INTERVAL and wanted in self._known:
            result = ACCEPTED
        elif message.command == REQUEST_MESSAGE and wanted in self._known:
            result = ACCEPTED if wanted in self._newest else DENIED
            if wanted in self._newest:
                self._answers.append(self._newest[wanted].raw)
        acknowledged = dialect.new(
            "COMMAND_ACK",
            command=message.command,
            result=result,
            target_system=asked.system,
            target_component=asked.component,
        )
        # with the number of the last frame played, so that none seems to be lost
        self._answers.append(frame.encode(acknowledged, self._sequence, self.system, AUTOPILOT_COMPONENT))


def _autopilot(entries: Iterable[Entry]) -> int:
    """The system that first sends the heartbeat of an autopilot."""
    for entry in entries:
        found = entry.frame
        beats = found.msgid == HEARTBEAT and found.component == AUTOPILOT_COMPONENT
        if beats and dialect.decode(found).autopilot != NO_AUTOPILOT:
            return found.system
    raise ValueError("no autopilot speaks in it: it holds no HEARTBEAT of one")


class Playing:
    """A player on the wall's clock, over one link; it begins when the link is first there."""

    def __init__(
        self,
        make: Callable[[int], Player],
        address: Address,
        tell: Callable[[str], None],
        now: Callable[[], int] = time.monotonic_ns,
    ) -> None:
        self._make, self._address, self._tell, self._now = make, address, tell, now
        self._stream: Stream | None = None
        self._player: Player | None = None
        self._begun, self._news = asyncio.Event(), asyncio.Event()
        self._stopped = False

    def stop(self) -> None:
        """End `play` soon."""
        self._stopped = True
        self._begun.set()
        self._news.set()

    async def play(self) -> None:
        """Play to the end or until `stop`. Raises CannotListen where an address is taken."""
        try:
            async with asyncio.TaskGroup() as tasks:
                carrying = tasks.create_task(self._carry())
                await self._begun.wait()
                player = self._player
                while not self._stopped and player is not None and player.deadline() < NEVER:
                    self._send()
                    left = 1e-9 * (player.deadline() - self._now())
                    await self._rest(min(left, LONGEST_SLEEP_S))
                carrying.cancel()
        except* CannotListen as group:
            raise group.exceptions[0] from None

    async def _rest(self, seconds: float) -> None:
        try:
            async with asyncio.timeout(max(0.0, seconds)):
                await self._news.wait()
        except TimeoutError:
            pass
        self._news.clear()

    def _send(self) -> None:
        assert self._player is not None
        for data in self._player.poll(self._now()):
            if self._stream is not None:
                self._stream.write(data)

    async def _carry(self) -> None:
        async for stream in connections(self._address, random.random, self._tell):
            if self._player is None:
                self._player = self._make(self._now())
                self._tell("somebody listens: playing")
            self._stream = stream
            self._begun.set()
            try:
                while True:
                    self._player.receive(await stream.read())
                    self._news.set()
            except ConnectionError as error:
                self._tell(f"{error}; opening it again")
            self._stream = None


@click.command("play")
@click.argument("log", type=click.Path(path_type=Path))
@click.option("--connect", default="tcpin:127.0.0.1:5760", show_default=True, help="Link to whoever listens.")
@click.option(
    "--from", "from_s", type=click.FloatRange(0.0), default=0.0, help="Second of the log to begin at."
)
@click.option(
    "--to", "to_s", type=click.FloatRange(0.0), default=math.inf, help="Second of the log to end at."
)
@click.option(
    "--speed",
    type=click.FloatRange(0.1, 20.0),
    default=1.0,
    show_default=True,
    help="Times real time; whoever listens sees a clock that runs so much too fast.",
)
def command(log: Path, connect: str, from_s: float, to_s: float, speed: float) -> None:
    """Play the autopilot of a telemetry log (.tlog) as a live one.

    Begins when somebody connects; ends with the log, at SIGINT or SIGTERM. It takes no orders. Exit codes: 1
    the log cannot be played, 69 the address cannot be listened on.
    """
    try:
        address = Address.parse(connect)
    except ValueError as error:
        raise click.BadParameter(str(error), param_hint="--connect") from None
    try:
        entries = list(tlog.read(log))
        Player(entries, 0, from_s, to_s, speed)
    except (OSError, ValueError) as error:
        reason = f"cannot be read: {error.strerror}" if isinstance(error, OSError) else str(error)
        click.echo(f"companion: {log}: {reason}", err=True)
        sys.exit(1)
    playing = Playing(
        lambda start_ns: Player(entries, start_ns, from_s, to_s, speed),
        address,
        lambda text: click.echo(text, err=True),
    )

    async def run() -> None:
        loop = asyncio.get_running_loop()
        for number in (signal.SIGINT, signal.SIGTERM):
            loop.add_signal_handler(number, playing.stop)
        await playing.play()

    click.echo(f"{log} over {address}, ^C ends", err=True)
    try:
        asyncio.run(run())
    except CannotListen as error:
        click.echo(f"companion: {error.strerror}", err=True)
        sys.exit(EX_UNAVAILABLE)
