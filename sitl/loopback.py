"""`companion loopback`: a whole flight in virtual time, the simulated autopilot and the companion joined in
process.

Only the stream and the clock are replaced: the companion's side is the `Onboard` that flies. An hour takes
seconds and is the same every time. The table at the end scores every source against the simulator's exact
truth.
"""

from __future__ import annotations

import json
import time
from collections import Counter
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import NamedTuple

import click
import msgspec
import numpy as np
from rich.console import Console
from rich.progress import Progress
from rich.table import Table

from companion.analysis import error_statistics
from companion.analysis.replay import metadata
from companion.config import Config, OutputConfig, load
from companion.nav.geometry import Geodetic
from companion.records import Event, Gnss, Rejection, Reset, RsbnFix, Solution, Stamped
from companion.runtime.core import Onboard
from companion.storage.deferred_log import Log
from companion.storage.retention import open_log
from companion.study import plot_options
from sitl.autopilot import UNIX_AT_START_NS, Autopilot
from sitl.scenarios import SCENARIOS, Phase, Scenario, named

LINK = "sitl"
SECOND = 1_000_000_000
START_NS = 1000 * SECOND  # of the companion's clock at the flight's start: any instant but 0
#: What the companion sends where [output] is left as it is.
FED = OutputConfig(profile="custom", odometry_hz=5.0, global_position_sensor_hz=2.0)
KEPT = (Solution, Gnss, RsbnFix, Rejection, Event, Reset)


class Tap:
    """A log that also keeps in memory what is scored."""

    def __init__(self, log: Log | None) -> None:
        self.kept: list[Stamped] = []
        self._log = log

    def record(self, record: Stamped, channel: str | None = None) -> None:
        """Write one record, and keep it if it is scored."""
        if isinstance(record, KEPT):
            self.kept.append(record)
        if self._log is not None:
            self._log.record(record, channel)

    def frame(self, link: str, outgoing: bool, data: bytes, t_ns: int) -> None:
        """Write one frame."""
        if self._log is not None:
            self._log.frame(link, outgoing, data, t_ns)


class Flown(NamedTuple):
    """A flight: the autopilot that flew it, what was kept of the log, and the companion at its end."""

    autopilot: Autopilot
    kept: list[Stamped]
    onboard: Onboard


def simulated(config: Config) -> Config:
    """`config` for the simulated autopilot: its local position is that of an INS of its own, which takes no
    part of what it is sent, and it is sent positions where [output] is left as it is.
    """
    inertial = msgspec.structs.replace(config.inertial, independent=True)
    output = FED if config.output == OutputConfig() else config.output
    return msgspec.structs.replace(config, inertial=inertial, output=output)


def fly(
    scenario: Scenario, config: Config, log: Log | None = None, tell: Callable[[float], None] | None = None
) -> Flown:
    """Fly `scenario` from start to end; `tell` is handed the seconds flown, once a second of flight."""
    autopilot, tap = Autopilot(scenario, START_NS), Tap(log)
    onboard = Onboard(config, tap, (LINK,))
    join(autopilot, onboard, START_NS, tell)
    return Flown(autopilot, tap.kept, onboard)


def join(
    autopilot: Autopilot, onboard: Onboard, start_ns: int, tell: Callable[[float], None] | None = None
) -> None:
    """Let the two speak with each other from `start_ns`, the flight's start, to the flight's end."""
    now, told, due = start_ns, start_ns, start_ns
    while now <= autopilot.end_ns:
        for data in autopilot.poll(now):
            onboard.receive(LINK, data, now)
        if now >= due:
            onboard.poll(now)
        for data in onboard.to_send(LINK, now):
            autopilot.receive(data, now)
        onboard.take_events()
        if tell is not None and now >= told:
            tell((now - start_ns) * 1e-9)
            told = now + SECOND
        due = onboard.deadline()
        now = max(now + 1, min(autopilot.deadline(), due))


def truth_of(autopilot: Autopilot) -> error_statistics.TruthAt:
    """The exact truth at any time of the companion's clock, height above mean sea level."""
    times = np.arange(0.0, autopilot.scenario.duration_s, 0.05)
    flight = autopilot.world.truth_at(times)
    columns = flight.lat, flight.lon, flight.alt - autopilot.scenario.geoid_height

    def truth(t_ns: int) -> Geodetic:
        t = (t_ns - START_NS) * 1e-9
        return Geodetic(*(float(np.interp(t, times, column)) for column in columns))

    return truth


def scored(flown: Flown) -> list[error_statistics.Row]:
    """The error table. A phase with fixes begins with the first solution that can know of one."""
    found = error_statistics.errors(flown.kept, truth_of(flown.autopilot))
    phases = flown.autopilot.scenario.phases()
    return error_statistics.table(found, [_from_first_fix(phase, flown.kept) for phase in phases])


def _from_first_fix(phase: Phase, kept: Iterable[Stamped]) -> error_statistics.Phase:
    start, end = (START_NS + round(s * SECOND) for s in (phase.start_s, phase.end_s))
    kinds = tuple(kind for name, kind in (("GNSS", Gnss), ("RSBN", RsbnFix)) if name in phase.name)
    if kinds:
        records = iter(kept)
        next(
            (r for r in records if isinstance(r, kinds) and r.t_ns >= start and getattr(r, "fix", 3) >= 3),
            None,
        )
        start = next((r.t_ns for r in records if isinstance(r, Solution)), start)
    return error_statistics.Phase(phase.name, min(start, end), end)


@click.command("loopback")
@click.option("--scenario", default="default", show_default=True, help=f"One of {', '.join(SCENARIOS)}.")
@click.option("--seed", type=int, help="Another noise for the same flight.")
@click.option("--config", "file", type=click.Path(path_type=Path), help="TOML file; see check-config.")
@click.option("--set", "pairs", multiple=True, metavar="SECTION.KEY=VALUE", help="Any key of the file.")
@click.option("--logs", help="Folder for the log.")
@click.option(
    "--plot",
    type=click.Path(path_type=Path),
    callback=plot_options.file,
    help="Draw the errors and the bound into this file.",
)
@click.option("--json", "as_json", is_flag=True, help="Print JSON.")
def command(
    scenario: str,
    seed: int | None,
    file: Path | None,
    pairs: tuple[str, ...],
    logs: str | None,
    plot: Path | None,
    as_json: bool,
) -> None:
    """Fly a scenario in virtual time, write its log, and print how far off each source was in each phase."""
    try:
        chosen = named(scenario, **({} if seed is None else {"seed": seed}))
    except ValueError as error:
        raise click.BadParameter(str(error), param_hint="--scenario") from None
    # the truth goes into the log, for reports
    flags = {"log.folder": logs, "rates.truth_hz": 10.0, "inertial.independent": True}
    config = simulated(load(file, flags, pairs=pairs))
    begun = time.perf_counter()
    settings = config.log
    log = open_log(
        settings.folder,
        metadata=metadata(config) | {"scenario": {"name": chosen.name, "seed": str(chosen.seed)}},
        start_unix_ns=UNIX_AT_START_NS,
        start_ns=START_NS,
        max_files=settings.maximum_files,
        min_free=settings.minimum_free_mib << 20,
        chunk_bytes=settings.chunk_kib << 10,
        block=True,
    )
    with log, Progress(console=Console(stderr=True), transient=True) as progress:
        task = progress.add_task(f"flying {chosen.name}", total=chosen.duration_s)
        flown = fly(chosen, config, log, lambda flown_s: progress.update(task, completed=flown_s))
    seconds = time.perf_counter() - begun
    rows = scored(flown)
    if plot is not None:
        from sitl.loopback_plot import draw

        draw(plot, error_statistics.errors(flown.kept, truth_of(flown.autopilot)), chosen, START_NS)
    if as_json:
        rate = chosen.duration_s / seconds
        summary = {"log": str(log.path), "seconds": seconds, "times_real_time": rate}
        click.echo(json.dumps({**summary, "phases": [row._asdict() for row in rows]}))
    else:
        _print(flown, rows, seconds)
        click.echo(f"log: {log.path}")
    if log.trouble is not None:
        raise SystemExit(f"companion: the log is not whole: {log.trouble}")


def _print(flown: Flown, rows: list[error_statistics.Row], seconds: float) -> None:
    scenario = flown.autopilot.scenario
    table = Table(title=f"{scenario.name}: horizontal error, r.m.s. / 95 % [m]")
    for column in ("phase", "min", *error_statistics.SOURCES, "bound", "held"):
        table.add_column(column, justify="left" if column == "phase" else "right")
    for row in rows:
        cells = [
            f"{row.rms[s]:.1f} / {row.p95[s]:.1f}" if s in row.rms else "-" for s in error_statistics.SOURCES
        ]
        bound = "-" if row.bound is None else f"{row.bound:.1f}"
        held = (
            "-"
            if row.held is None or row.inside is None
            else f"{'yes' if row.held else 'NO'} ({row.inside:.0%})"
        )
        table.add_row(row.phase, f"{row.seconds / 60.0:.1f}", *cells, bound, held)
    Console(width=max(110, Console().width)).print(table)
    click.echo(
        "bound: r.m.s. over the phase of the guaranteed bound; held: the r.m.s. error is within it"
        " (share of instants within it)"
    )
    told = Counter(type(record).__name__ for record in flown.kept)
    rate = scenario.duration_s / seconds
    click.echo(
        f"{scenario.duration_s / 60.0:.1f} min flown in {seconds:.1f} s, {rate:.0f} times real time;"
        f" {told['Solution']} solutions, {told['Rejection']} rejections, {told['Reset']} resets"
    )
    for record in flown.kept:
        if isinstance(record, Event | Reset):
            text = record.text if isinstance(record, Event) else f"{record.what}: {record.reason}"
            click.echo(f"  {(record.t_ns - START_NS) * 1e-9:8.1f} s  {text}")


def _m(metres: float) -> str:
    return f"{metres:.1f}" if metres < 99.95 else f"{metres:.0f}"
