"""`companion sitl`: the simulated autopilot in real time, a process of its own that `companion run` meets
over a real link.

    companion run                                               # in one terminal
    companion sitl --connect udpout:127.0.0.1:14550             # in another

The same `Autopilot` that flies the loopback, on the wall's clock. It says how far off the positions are that
it is sent, phase by phase; the truth itself it keeps to itself.
"""

from __future__ import annotations

import asyncio
import math
import random
import signal
import sys
import time
from collections.abc import Callable
from typing import Any

import click
import numpy as np

from companion.link.clock import SECOND, BootClock
from companion.nav.geometry import Geodetic, local_to_geodetic, separation
from companion.transport.links import Address, CannotListen, Stream, connections
from sitl.autopilot import Autopilot
from sitl.bridge_command import command as bridge
from sitl.scenarios import SCENARIOS, Phase, Scenario, named
from sitl.tlog_player import command as play

EX_UNAVAILABLE = 69  # sysexits.h
SILENT_AFTER = 3 * SECOND
LONGEST_SLEEP_S = 0.2


class Score:
    """How far off the positions are that the companion sends, in the phase that is flown now.

    They are stamped by the companion's clock, which is mapped by their arrival alone: late by the least delay
    of the link, some milliseconds, hence decimetres along the track.
    """

    def __init__(self, autopilot: Autopilot) -> None:
        self._autopilot = autopilot
        self._clock = BootClock()
        self._heard_ns: int | None = None
        self._errors: list[float] = []
        self._bound = math.nan

    def take(self, now_ns: int) -> list[str]:
        """Read what came since this was last asked; lines to tell where the companion comes or goes."""
        said = []
        for at_ns, message in self._autopilot.outputs:
            if self._heard_ns is None:
                said.append("the companion's navigation is heard")
            self._heard_ns = at_ns
            name = message.get_type()
            if name == "NAVIGATION_STATUS":
                self._bound = message.bound_horizontal
            elif name in ("GLOBAL_POSITION_SENSOR", "ODOMETRY"):
                stamp = message.time_usec * 1000
                self._clock.heard(stamp, at_ns)
                self._errors.append(self._error(self._place(message), self._clock.local(stamp, at_ns)))
        self._autopilot.outputs.clear()
        if self._heard_ns is not None and now_ns - self._heard_ns > SILENT_AFTER:
            self._heard_ns = None
            said.append("the companion is silent")
        return said

    def summary(self) -> str:
        """What was heard in the phase that ends now, and begin the next."""
        errors, self._errors = self._errors, []
        if not errors:
            return "no position came"
        rms = math.sqrt(sum(e * e for e in errors) / len(errors))
        bound = f", the last bound {self._bound:.1f} m" if math.isfinite(self._bound) else ""
        return f"{len(errors)} positions came, off by {rms:.1f} m r.m.s., {max(errors):.1f} m at most{bound}"

    def _place(self, message: Any) -> tuple[float, float]:
        """Latitude and longitude that a message means, rad."""
        if message.get_type() == "GLOBAL_POSITION_SENSOR":
            return math.radians(message.lat * 1e-7), math.radians(message.lon * 1e-7)
        x_n = np.array([message.x, message.y, 0.0])
        projection = self._autopilot.scenario.autopilot
        lat, lon, _ = local_to_geodetic(projection, self._autopilot.world.origin, x_n)
        return lat, lon

    def _error(self, place: tuple[float, float], t_ns: int) -> float:
        lat, lon = place
        flight = self._autopilot.world.truth_at(np.array([max(t_ns, 0) * 1e-9]))
        true = Geodetic(float(flight.lat[0]), float(flight.lon[0]), float(flight.alt[0]))
        north, east, _ = separation(Geodetic(lat, lon, true.alt), true)
        return math.hypot(north, east)


class Flying:
    """One flight over one link in real time, `speed` times as fast; `tell` gets the flight's seconds and a
    line.
    """

    def __init__(
        self,
        scenario: Scenario,
        address: Address,
        speed: float,
        tell: Callable[[float, str], None],
        now: Callable[[], int] = time.monotonic_ns,
    ) -> None:
        self.autopilot = Autopilot(scenario)
        self._address, self._speed, self._tell, self._now = address, speed, tell, now
        self._score = Score(self.autopilot)
        self._phases = scenario.phases()
        self._phase: Phase | None = None
        self._stream: Stream | None = None
        self._news = asyncio.Event()
        self._stopped = False
        self._begun = now()

    def stop(self) -> None:
        """End `fly` soon."""
        self._stopped = True
        self._news.set()

    async def fly(self) -> None:
        """Fly to the end or until `stop`. Raises CannotListen where an address is taken."""
        self._begun = self._now()
        try:
            async with asyncio.TaskGroup() as tasks:
                carrying = tasks.create_task(self._carry())
                while not self._stopped and (t := self._flown()) <= self.autopilot.end_ns:
                    self._send(t)
                    self._report(t)
                    left = (min(self.autopilot.deadline(), self.autopilot.end_ns + 1) - t) / self._speed
                    await self._rest(min(1e-9 * left, LONGEST_SLEEP_S))
                carrying.cancel()
        except* CannotListen as group:
            raise group.exceptions[0] from None
        self._end_phase()

    def _flown(self) -> int:
        return int((self._now() - self._begun) * self._speed)

    def _send(self, t: int) -> None:
        for data in self.autopilot.poll(t):
            if self._stream is not None:
                self._stream.write(data)

    async def _rest(self, seconds: float) -> None:
        """Sleep, but no longer than to the next word of the companion: it may ask for another rate."""
        try:
            async with asyncio.timeout(max(0.0, seconds)):
                await self._news.wait()
        except TimeoutError:
            pass
        self._news.clear()

    async def _carry(self) -> None:
        async for stream in connections(self._address, random.random, self._say):
            self._stream = stream
            try:
                while True:
                    self.autopilot.receive(await stream.read(), self._flown())
                    self._news.set()
            except ConnectionError as error:
                self._say(f"{error}; opening it again")
            self._stream = None

    def _report(self, t: int) -> None:
        for line in self._score.take(t):
            self._say(line)
        phase = next((p for p in self._phases if p.start_s <= t * 1e-9 < p.end_s), self._phase)
        if phase is not self._phase:
            self._end_phase()
            self._phase = phase
            if phase is not None:
                self._say(f"{phase.name} until {phase.end_s:g} s")

    def _end_phase(self) -> None:
        if self._phase is not None:
            self._say(f"{self._phase.name}: {self._score.summary()}")

    def _say(self, text: str) -> None:
        self._tell(self._flown() * 1e-9, text)


async def _run(flying: Flying) -> None:
    loop = asyncio.get_running_loop()
    for number in (signal.SIGINT, signal.SIGTERM):
        loop.add_signal_handler(number, flying.stop)
    await flying.fly()


@click.group("sitl", invoke_without_command=True, subcommand_metavar="[bridge|play ...]")
@click.pass_context
@click.option("--connect", default="udpout:127.0.0.1:14550", show_default=True, help="Link to the companion.")
@click.option("--scenario", default="default", show_default=True, help=f"One of {', '.join(SCENARIOS)}.")
@click.option("--seed", type=int, help="Another noise for the same flight.")
@click.option(
    "--speed",
    type=click.FloatRange(0.1, 20.0),
    default=1.0,
    show_default=True,
    help="Times real time; the companion sees a clock that runs so much too fast.",
)
@click.option(
    "--disarmed", is_flag=True, help="Say that it is disarmed: `companion doctor` may set parameters."
)
def command(
    context: click.Context, connect: str, scenario: str, seed: int | None, speed: float, disarmed: bool
) -> None:
    """Fly a scenario in real time as an autopilot would, for a `companion run` at the other end of the link.

    Ends with the flight, at SIGINT or SIGTERM. Exit code 69: the address cannot be listened on.

    `bridge` attaches to the simulator of a real autopilot, `play` plays a recorded one.
    """
    if context.invoked_subcommand is not None:
        return
    try:
        chosen = named(scenario, **({} if seed is None else {"seed": seed}))
    except ValueError as error:
        raise click.BadParameter(str(error), param_hint="--scenario") from None
    try:
        address = Address.parse(connect)
    except ValueError as error:
        raise click.BadParameter(str(error), param_hint="--connect") from None

    def tell(seconds: float, text: str) -> None:
        click.echo(f"{seconds:8.1f} s  {text}", err=True)

    flying = Flying(chosen, address, speed, tell)
    flying.autopilot.is_armed = not disarmed
    minutes = chosen.duration_s / 60.0
    click.echo(f"{chosen.name}: {minutes:.0f} min as {chosen.autopilot} over {address}, ^C ends", err=True)
    try:
        asyncio.run(_run(flying))
    except CannotListen as error:
        click.echo(f"companion: {error.strerror}", err=True)
        sys.exit(EX_UNAVAILABLE)


command.add_command(bridge)
command.add_command(play)
