"""`companion sitl`: the simulated autopilot in real time, a process that `companion run` connects to.

    companion run                                               # in one terminal
    companion sitl --connect udpout:127.0.0.1:14550             # in another

The same `SimulatedAutopilot` as in the loopback, on the system clock. It reports the errors of the positions
it receives for each phase of the flight.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator

import click
import numpy as np

from companion.link.clock import BootClock
from companion.nav.geometry import Geodetic
from companion.option_types import FloatRange
from companion.transport.address import Address
from companion.units import SECOND_NS
from sitl.autopilot import SimulatedAutopilot
from sitl.bridge_command import command as bridge
from sitl.positions import position_of
from sitl.real_time import RealTimeRunner, parse_address
from sitl.scenarios import SCENARIOS, Scenario, SchedulePhase, parse_scenario
from sitl.tlog_player import command as play

SILENT_AFTER = 3 * SECOND_NS


class PositionScore:
    """Errors of the companion's positions in the current phase of the flight.

    Positions are stamped by the companion's clock, which is mapped by arrival times alone: late by the
    minimum delay of the link, some milliseconds, hence decimetres along the track.
    """

    def __init__(self, autopilot: SimulatedAutopilot) -> None:
        self._autopilot = autopilot
        self._clock = BootClock()
        self._received_ns: int | None = None
        self._errors: list[float] = []
        self._bound = math.nan

    def update(self, now_ns: int) -> list[str]:
        """Score the positions since the last call; return lines when the companion connects or is lost."""
        lines = []
        for at_ns, message in self._autopilot.outputs:
            if self._received_ns is None:
                lines.append("receiving the companion's navigation")
            self._received_ns = at_ns
            name = message.get_type()
            if name == "NAVIGATION_STATUS":
                self._bound = message.bound_horizontal
            elif name in ("GLOBAL_POSITION_SENSOR", "ODOMETRY"):
                origin, make = self._autopilot.origin_record(at_ns), self._autopilot.scenario.autopilot
                if (reported := position_of(message, origin, make)) is not None:
                    stamp = reported.stamp_ns
                    self._clock.update(stamp, at_ns)
                    self._errors.append(self._error(reported.place, self._clock.local(stamp, at_ns)))
        self._autopilot.outputs.clear()
        if self._received_ns is not None and now_ns - self._received_ns > SILENT_AFTER:
            self._received_ns = None
            lines.append("the companion is silent")
        return lines

    def summary(self) -> str:
        """Summarise the phase that ends now and start the next."""
        errors, self._errors = self._errors, []
        if not errors:
            return "no positions received"
        rms = math.sqrt(sum(e * e for e in errors) / len(errors))
        bound = f", last bound {self._bound:.1f} m" if math.isfinite(self._bound) else ""
        return (
            f"{len(errors)} positions received, error {rms:.1f} m r.m.s., {max(errors):.1f} m at most{bound}"
        )

    def _error(self, place: Geodetic, t_ns: int) -> float:
        at = np.array([[max(t_ns, 0) * 1e-9], [place.lat], [place.lon]])
        return float(np.hypot(*self._autopilot.world.errors_at(*at)[0]))


class SimulatorRunner(RealTimeRunner):
    """One flight over one link, `speed` times real time; `report` receives the flight time (s) and a line."""

    def __init__(
        self, scenario: Scenario, address: Address, speed: float, report: Callable[[float, str], None]
    ) -> None:
        super().__init__((address,), lambda text: report(self._flight_ns() * 1e-9, text))
        self.autopilot = SimulatedAutopilot(scenario)
        self._speed = speed
        self._score = PositionScore(self.autopilot)
        self._phases = scenario.phases()
        self._phase: SchedulePhase | None = None

    def _steps(self) -> Iterator[float]:
        while not self._stopped and (t := self._flight_ns()) <= self.autopilot.end_ns:
            self._send(self.autopilot.poll(t))
            self._report_progress(t)
            yield 1e-9 * (min(self.autopilot.deadline(), self.autopilot.end_ns + 1) - t) / self._speed
        self._end_phase()

    def _receive(self, link: int, data: bytes) -> None:
        self.autopilot.receive(data, self._flight_ns())

    def _flight_ns(self) -> int:
        return int(self._elapsed_ns() * self._speed)

    def _report_progress(self, t: int) -> None:
        for line in self._score.update(t):
            self._report(line)
        phase = next((p for p in self._phases if p.start_s <= t * 1e-9 < p.end_s), self._phase)
        if phase is not self._phase:
            self._end_phase()
            self._phase = phase
            if phase is not None:
                self._report(f"{phase.name} until {phase.end_s:g} s")

    def _end_phase(self) -> None:
        if self._phase is not None:
            self._report(f"{self._phase.name}: {self._score.summary()}")


@click.group("sitl", invoke_without_command=True, subcommand_metavar="[bridge|play ...]")
@click.pass_context
@click.option("--connect", default="udpout:127.0.0.1:14550", show_default=True, help="Link to the companion.")
@click.option("--scenario", default="default", show_default=True, help=f"One of {', '.join(SCENARIOS)}.")
@click.option("--seed", type=click.IntRange(min=0), help="Seed of the noise.")
@click.option(
    "--speed",
    type=FloatRange(0.1, 20.0),
    default=1.0,
    show_default=True,
    help="Times real time; the companion sees a clock that runs faster by this factor.",
)
@click.option("--disarmed", is_flag=True, help="Report disarmed: `companion doctor` may set parameters.")
def command(
    context: click.Context, connect: str, scenario: str, seed: int | None, speed: float, disarmed: bool
) -> None:
    """Simulate an autopilot in real time, or join a real one's.

    It flies a scenario; connect `companion run` to the link. Ends with the flight, at SIGINT or SIGTERM. Exit
    code 69: cannot listen on the address.

    `bridge` connects to the simulator of a real autopilot, `play` plays back a recorded one.
    """
    if context.invoked_subcommand is not None:
        return
    chosen = parse_scenario(scenario, seed)
    address = parse_address(connect)

    def report(seconds: float, text: str) -> None:
        click.echo(f"{seconds:8.1f} s  {text}", err=True)

    runner = SimulatorRunner(chosen, address, speed, report)
    runner.autopilot.is_armed = not disarmed
    minutes = chosen.duration_s / 60.0
    click.echo(
        f"{chosen.name}: {minutes:.0f} min as {chosen.autopilot} over {address}; stop with Ctrl-C", err=True
    )
    runner.run_command()


command.add_command(bridge)
command.add_command(play)
