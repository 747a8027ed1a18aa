"""`companion loopback`: a flight in virtual time, simulated autopilot and companion in one process.

Only the stream and the clock are replaced: the companion is the `CompanionCore` used in flight. An hour of
flight takes seconds and is reproducible. The table at the end compares every source with the exact truth.
"""

from __future__ import annotations

import dataclasses
import itertools
import json
import time
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import NamedTuple

import click
import msgspec
import numpy as np
from rich.console import Console
from rich.progress import Progress

from companion.analysis import error_statistics
from companion.analysis.summary import format_share
from companion.config import Config, OutputConfig, load
from companion.config.options import configuration_options
from companion.config.required_parameters import required_parameters
from companion.nav.geometry import Geodetic
from companion.records import Event, Gnss, Rejection, Reset, RsbnFix, Solution, Stamped
from companion.runtime.core import CompanionCore
from companion.storage.deferred_log import Log, NoLog
from companion.storage.retention import create_log
from companion.storage.run_metadata import run_metadata
from companion.study.plot_options import PLOT_FILE
from companion.tables import number_table, print_tables
from companion.units import SECOND_NS
from sitl.autopilot import UNIX_AT_START_NS, SimulatedAutopilot
from sitl.own_estimate import unaided_errors
from sitl.scenarios import SCENARIOS, Scenario, SchedulePhase, parse_scenario
from sitl.world import GEOID_M

LINK = "sitl"
START_NS = 1000 * SECOND_NS  # companion's clock at the start of the flight: any value but 0
#: Output of the companion where [output] is the default.
DEFAULT_OUTPUT = OutputConfig(profile="custom", odometry_hz=5.0, global_position_sensor_hz=2.0)
COLLECTED = (Solution, Gnss, RsbnFix, Rejection, Event, Reset)


class CollectingLog:
    """Log that also collects the records needed for scoring in memory."""

    def __init__(self, log: Log | None) -> None:
        self.records: list[Stamped] = []
        self._log = log or NoLog()

    def record(self, record: Stamped, channel: str | None = None) -> None:
        """Write one record and collect it if its kind is in `COLLECTED`."""
        if isinstance(record, COLLECTED):
            self.records.append(record)
        self._log.record(record, channel)

    def frame(self, link: str, outgoing: bool, data: bytes, t_ns: int) -> None:
        """Write one frame."""
        self._log.frame(link, outgoing, data, t_ns)


class LoopbackFlight(NamedTuple):
    """Result of a flight: the simulated autopilot, the collected records, and the companion's final state."""

    autopilot: SimulatedAutopilot
    records: list[Stamped]
    core: CompanionCore


def simulator_config(config: Config, own_ins: bool = True) -> Config:
    """Adapt `config` to the simulated autopilot.

    Its local position comes from an INS of its own, so `inertial.independent` is set; without `own_ins` it is
    treated as that of a stock autopilot. A default [output] is replaced by `DEFAULT_OUTPUT`.
    """
    inertial = msgspec.structs.replace(config.inertial, independent=own_ins)
    output = DEFAULT_OUTPUT if config.output == OutputConfig() else config.output
    return msgspec.structs.replace(config, inertial=inertial, output=output)


def simulated_for(scenario: Scenario, config: Config) -> Scenario:
    """Let the autopilot take our positions where `config` feeds an ArduPilot without an INS of its own."""
    feeds = config.output.profile == scenario.autopilot == "ardupilot" and not config.inertial.independent
    return dataclasses.replace(scenario, own_estimate=True) if feeds else scenario


def fly_scenario(
    scenario: Scenario,
    config: Config,
    log: Log | None = None,
    progress: Callable[[float], None] | None = None,
) -> LoopbackFlight:
    """Fly `scenario` from start to end; call `progress` with the seconds flown once per second of flight."""
    autopilot, collected = SimulatedAutopilot(scenario, START_NS), CollectingLog(log)
    needs = required_parameters(config, scenario.autopilot)
    autopilot.parameters.values |= {need.name: need.value for need in needs}  # it is prepared
    core = CompanionCore(config, collected, (LINK,))
    fly_connected(autopilot, core, START_NS, progress)
    return LoopbackFlight(autopilot, collected.records, core)


def fly_connected(
    autopilot: SimulatedAutopilot,
    core: CompanionCore,
    start_ns: int,
    progress: Callable[[float], None] | None = None,
    stalls: Sequence[tuple[int, int]] = (),
) -> None:
    """Exchange bytes between autopilot and companion from `start_ns`, the start of the flight, to its end.

    During `stalls`, from one time to another (ns), the companion's computer does nothing.
    """
    now, reported, due = start_ns, start_ns, start_ns
    while now <= autopilot.end_ns:
        for data in autopilot.poll(now):
            core.receive(LINK, data, now)
        if now >= due:
            core.poll(now)
        for data in core.to_send(LINK, now):
            autopilot.receive(data, now)
        core.take_events()
        if progress is not None and now >= reported:
            progress((now - start_ns) * 1e-9)
            reported = now + SECOND_NS
        due = core.deadline()
        now = max(now + 1, min(autopilot.deadline(), due))
        now = max((end for begin, end in stalls if begin <= now < end), default=now)


def truth_function(autopilot: SimulatedAutopilot) -> error_statistics.TruthAt:
    """Return a function: companion's clock (ns) -> true position, height above mean sea level."""
    times = np.arange(0.0, autopilot.scenario.duration_s, 0.05)
    flight = autopilot.world.flight.at(times)
    columns = flight.lat, flight.lon, flight.alt - GEOID_M

    def truth(t_ns: int) -> Geodetic:
        t = (t_ns - START_NS) * 1e-9
        return Geodetic(*(float(np.interp(t, times, column)) for column in columns))

    return truth


def source_errors(flown: LoopbackFlight) -> dict[str, error_statistics.ErrorSeries]:
    """Return the horizontal error of every source against the exact truth."""
    return error_statistics.horizontal_errors(flown.records, truth_function(flown.autopilot))


def error_table(flown: LoopbackFlight) -> list[error_statistics.PhaseErrors]:
    """Compute the errors of every source in each phase."""
    return error_statistics.summarize_phases(source_errors(flown), flown_phases(flown))


def flown_phases(flown: LoopbackFlight) -> list[error_statistics.FlightPhase]:
    """List the phases. One with fixes starts at the first solution after its first fix."""
    return [_from_first_fix(phase, flown.records) for phase in flown.autopilot.scenario.phases()]


class OwnPhase(NamedTuple):
    """Error of the autopilot's own position in one phase, m: with the companion and without it."""

    phase: str
    rms: float
    most: float
    rms_alone: float
    most_alone: float


def own_table(autopilot: SimulatedAutopilot) -> list[OwnPhase]:
    """Compute the error of the autopilot's own position in each phase; empty without an own estimate."""
    if autopilot.estimate is None:
        return []
    ours, alone = autopilot.estimate.errors, unaided_errors(autopilot.world)
    return [
        OwnPhase(p.name, *ours.between(p.start_s, p.end_s), *alone.between(p.start_s, p.end_s))
        for p in autopilot.scenario.phases()
    ]


class PhaseProtection(NamedTuple):
    """Protection level in one phase: median (m), and the share of solutions with the error within it."""

    level: float
    inside: float

    @property
    def held(self) -> bool:
        """Whether no error was beyond it."""
        return self.inside == 1.0


def protection_table(
    corrected: error_statistics.ErrorSeries | None, phases: Sequence[error_statistics.FlightPhase]
) -> list[PhaseProtection | None]:
    """Compute the protection level of each phase; None where there is no solution with one."""
    if corrected is None:
        return [None] * len(phases)
    found: list[PhaseProtection | None] = []
    for phase in phases:
        within = phase.covers(corrected.t) & np.isfinite(corrected.protection)
        levels = corrected.protection[within]
        inside = corrected.error[within] <= levels
        found.append(PhaseProtection(float(np.median(levels)), float(inside.mean())) if len(levels) else None)
    return found


def _from_first_fix(phase: SchedulePhase, records: Iterable[Stamped]) -> error_statistics.FlightPhase:
    start, end = (START_NS + round(s * SECOND_NS) for s in (phase.start_s, phase.end_s))
    kinds = tuple(kind for name, kind in (("GNSS", Gnss), ("RSBN", RsbnFix)) if name in phase.name)
    begin = start
    if kinds:
        since = itertools.dropwhile(
            lambda r: not (isinstance(r, kinds) and r.t_ns >= start and getattr(r, "has_3d_fix", True)),
            records,
        )
        begin = next((r.t_ns for r in since if isinstance(r, Solution)), start)
    return error_statistics.FlightPhase(phase.name, min(begin, end), end)


@click.command("loopback")
@click.option("--scenario", default="default", show_default=True, help=f"One of {', '.join(SCENARIOS)}.")
@click.option("--seed", type=click.IntRange(min=0), help="Seed of the noise.")
@configuration_options
@click.option("--logs", help="Folder for the log.")
@click.option("--plot", type=PLOT_FILE, help="Plot the errors and the bound to this file.")
@click.option("--json", "as_json", is_flag=True, help="Print JSON.")
def command(
    scenario: str,
    seed: int | None,
    file: Path | None,
    preset: str | None,
    pairs: tuple[str, ...],
    logs: str | None,
    plot: Path | None,
    as_json: bool,
) -> None:
    """Fly a scenario in virtual time and print the errors.

    Writes the log of the flight, and prints the error of each source in each phase.
    """
    chosen = parse_scenario(scenario, seed)
    # log the truth: reports use it
    flags: dict[str, object] = {"log.folder": logs, "rates.truth_hz": 10.0}
    if preset is None:
        flags["inertial.independent"] = True
    loaded = load(file, flags, pairs=pairs, preset=preset)
    if loaded.has_own_ins and chosen.correctors:
        flags["inertial.correctors"] = list(chosen.correctors)
        loaded = load(file, flags, pairs=pairs, preset=preset)
    config = simulator_config(loaded, own_ins=loaded.inertial.independent)
    chosen = simulated_for(chosen, config)
    started = time.perf_counter()
    settings = config.log
    log = create_log(
        settings.folder,
        metadata=run_metadata(config) | {"scenario": {"name": chosen.name, "seed": str(chosen.seed)}},
        start_unix_ns=UNIX_AT_START_NS,
        start_ns=START_NS,
        max_files=settings.maximum_files,
        min_free=settings.minimum_free_mib << 20,
        chunk_bytes=settings.chunk_kib << 10,
        block=True,
    )
    console = Console(stderr=True)
    with log, Progress(console=console, transient=True, disable=not console.is_terminal) as progress:
        task = progress.add_task(f"flying {chosen.name}", total=chosen.duration_s)
        flown = fly_scenario(chosen, config, log, lambda flown_s: progress.update(task, completed=flown_s))
    seconds = time.perf_counter() - started
    errors, phases = source_errors(flown), flown_phases(flown)
    rows = error_statistics.summarize_phases(errors, phases)
    levels = protection_table(errors.get(error_statistics.CORRECTED), phases)
    if plot is not None:
        from sitl.loopback_plot import draw

        draw(plot, errors, chosen, START_NS)
    if as_json:
        rate = chosen.duration_s / seconds
        summary = {"log": str(log.path), "seconds": seconds, "times_real_time": rate}
        table = [
            row._asdict() | {"protection": level._asdict() | {"held": level.held} if level else None}
            for row, level in zip(rows, levels, strict=True)
        ]
        own = [row._asdict() for row in own_table(flown.autopilot)]
        click.echo(json.dumps({**summary, "phases": table, "own": own}))
    else:
        _print_table(flown, rows, levels, seconds)
        click.echo(f"log: {log.path}")
    if log.trouble is not None:
        raise SystemExit(f"companion: the log is incomplete: {log.trouble}")


def _metres(value: float | None) -> str:
    if value is None:
        return "-"
    return f"{value:.1f}" if abs(value) < 100.0 else f"{value:.0f}"


def _bound(row: error_statistics.PhaseErrors) -> str:
    if row.bound is None:
        return "-"
    if not row.useful:
        return "no use"
    return _metres(row.bound) + ("" if row.held else f" {format_share(row.inside or 0.0)}")


def _print_own(rows: list[OwnPhase]) -> None:
    if not rows:
        return
    title = "the autopilot's own position: error, r.m.s. / most [m]"
    table = number_table(title, "phase", "with us", "without")
    for row in rows:
        pairs = (row.rms, row.most), (row.rms_alone, row.most_alone)
        table.add_row(row.phase, *(f"{_metres(rms)} / {_metres(most)}" for rms, most in pairs))
    print_tables(table)


def _print_table(
    flown: LoopbackFlight,
    rows: list[error_statistics.PhaseErrors],
    levels: list[PhaseProtection | None],
    seconds: float,
) -> None:
    scenario = flown.autopilot.scenario
    sources = [
        s
        for s in error_statistics.SOURCES
        if s not in error_statistics.FILTERS.values() or any(s in row.rms for row in rows)
    ]
    names = (source.replace(" ", "\n") for source in sources)
    heads = "phase", "min", *names, "expected", "95 %", "protected", "bound"
    table = number_table(f"{scenario.name}: horizontal error, r.m.s. [m]", *heads)
    for row, level in zip(rows, levels, strict=True):
        cells = [_metres(row.rms.get(source)) for source in sources]
        percentile = _metres(row.p95.get(error_statistics.CORRECTED))
        protected = "-" if level is None else _metres(level.level) + ("" if level.held else " NO")
        bound = _bound(row)
        table.add_row(
            row.phase,
            f"{row.seconds / 60.0:.1f}",
            *cells,
            _metres(row.expected),
            percentile,
            protected,
            bound,
        )
    print_tables(table)
    click.echo(
        "expected: r.m.s. error that the corrected estimate claims; 95 %: percentile of\n"
        "its error; protected: median protection level, NO if an error was beyond it;\n"
        "bound: r.m.s. of the guaranteed bound, with the share of errors within that of\n"
        "their moment if not all are; no use: above 10 times the claim or above 5 km"
    )
    _print_own(own_table(flown.autopilot))
    reported = Counter(type(record).__name__ for record in flown.records)
    rate = scenario.duration_s / seconds
    click.echo(
        f"{scenario.duration_s / 60.0:.1f} min flown in {seconds:.1f} s, {rate:.0f} times real time;"
        f" {reported['Solution']} solutions, {reported['Rejection']} rejections, {reported['Reset']} resets"
    )
    for record in flown.records:
        if isinstance(record, Event | Reset):
            text = record.text if isinstance(record, Event) else f"{record.what}: {record.reason}"
            click.echo(f"  {(record.t_ns - START_NS) * 1e-9:8.1f} s  {text}")
