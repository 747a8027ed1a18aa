"""`companion replay`: run the navigator over a log; outputs for our own logs must equal those of the flight.

Our own MCAP log contains inputs, outputs and configuration: the inputs are replayed and every output is
compared (see `comparison`). The log of another recorder contains inputs only (see `importers.sources`): the
outputs are written. The same applies to a replay with changes: another configuration (--config, --with),
simulated beacons (--rsbn), simulated outages (--outage).
"""

from __future__ import annotations

import json
import time
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import NamedTuple

import click

from companion.analysis import simulated_rsbn
from companion.analysis.beacon_options import beacon_options
from companion.analysis.comparison import TOLERANCE, OutputComparison
from companion.analysis.flights import describe_channel, sensor_of
from companion.analysis.output_guard import reject_other_flight, reject_own_input, remove_leftover
from companion.analysis.progress import show_step
from companion.analysis.replay_inputs import (
    DERIVED,
    choose_configuration,
    default_output,
    has_navigator_outputs,
    input_errors_as_log_errors,
    is_own_log,
    with_beacons_and_outages,
    with_correctors,
)
from companion.config import Config
from companion.importers import gnss_latency
from companion.navigator import Navigator
from companion.option_types import INPUT_PATH
from companion.printable import printable
from companion.records import (
    INPUTS,
    Event,
    LocalPosition,
    RangeDifference,
    Reboot,
    SecondIns,
    Solution,
    Stamped,
    StarFix,
)
from companion.storage import flight_log
from companion.storage.deferred_log import Log, NoLog
from companion.storage.reader import ACTIVE, LogError, is_closed
from companion.storage.run_metadata import PLATFORM, numerical_platform, run_metadata


class FlightPart(NamedTuple):
    """A flight in the log: start and end (s since the log's first record), counts of inputs and solutions."""

    start_s: float
    end_s: float
    inputs: int
    solutions: int


class ReplayResult(NamedTuple):
    """Counts of a replay; a reboot starts a new flight. `different` of the `compared` outputs differ from the
    flight: not bit for bit if the log was written on this platform (`exact`), beyond the tolerance otherwise.
    `apart_m` is the greatest distance between a solution in flight and the same one now (m).
    """

    inputs: int
    outputs: dict[str, int]
    flights: list[FlightPart]
    compared: int | None = None
    different: int = 0
    first_difference: str | None = None
    exact: bool = True
    apart_m: float = 0.0


class _ReplayCounter:
    """Counts the inputs and outputs of a navigator, by flight."""

    def __init__(self) -> None:
        self.outputs = Counter[str]()
        self._zero_ns: int | None = None  # arrival of the first record of the log
        self._parts: list[list[int]] = []  # per flight: first and last arrival (ns), inputs, solutions

    def record(self, record: Stamped) -> None:
        """Note any record of the log: times count from the first one."""
        if self._zero_ns is None:
            self._zero_ns = record.rx_ns

    def input(self, record: Stamped) -> None:
        """Count one input."""
        if not self._parts or isinstance(record, Reboot):
            self._parts.append([record.rx_ns, record.rx_ns, 0, 0])
        part = self._parts[-1]
        part[1] = record.rx_ns
        part[2] += 1

    def output(self, record: Stamped) -> None:
        """Count one output."""
        self.outputs[type(record).__name__] += 1
        self._parts[-1][3] += isinstance(record, Solution)

    def result(self, comparison: OutputComparison | None = None) -> ReplayResult:
        """Return everything counted."""
        zero_ns = self._zero_ns or 0
        parts = [FlightPart((a - zero_ns) * 1e-9, (b - zero_ns) * 1e-9, *n) for a, b, *n in self._parts]
        counted = ReplayResult(sum(part.inputs for part in parts), dict(self.outputs), parts)
        if comparison is None:
            return counted
        return counted._replace(
            compared=comparison.compared,
            different=comparison.different,
            first_difference=comparison.first,
            exact=comparison.exact,
            apart_m=comparison.apart_m,
        )


def replay_own(path: Path, config: Config, sink: Log) -> ReplayResult:
    """Replay the inputs of our own log and compare the outputs with those that it has of the flight."""
    navigator, count = Navigator(config), _ReplayCounter()
    comparison = OutputComparison(flight_log.metadata(path).get(PLATFORM) == numerical_platform())
    ours: list[Stamped] = []
    flown: list[Stamped] = []

    for entry in flight_log.read(path):
        if isinstance(entry.value, Stamped):
            count.record(entry.value)
        if entry.topic.startswith("/in/") and isinstance(entry.value, Stamped):
            comparison.add(flown, ours)
            count.input(entry.value)
            sink.record(entry.value)
            ours += navigator.handle(entry.value)
            for output in ours:
                count.output(output)
                sink.record(output)
        elif entry.topic.startswith("/out/") and isinstance(entry.value, Stamped):
            flown.append(entry.value)
    comparison.add(flown, ours[: len(flown)])  # a log that was cut lacks outputs of its last input
    return count.result(comparison)


def replay_foreign(records: Iterable[Stamped], config: Config, sink: Log) -> ReplayResult:
    """Replay the records of another recorder's log and write inputs and outputs to `sink`."""
    navigator, count = Navigator(config), _ReplayCounter()
    for record in records:
        sink.record(record, flight_log.topic_of_input(record))
        count.record(record)
        if isinstance(record, INPUTS):
            count.input(record)
            for output in navigator.handle(record):
                count.output(output)
                sink.record(output)
    return count.result()


@contextmanager
def create_replay_log(
    path: Path, log: Path, described: Mapping[str, Mapping[str, str]]
) -> Iterator[flight_log.Writer]:
    """Create a log made from `log`, which waits for the disk instead of dropping messages, and close it.

    If the disk failed for a while and recovered, the number of lost messages is stated on stderr. After an
    exception, also Ctrl-C, the log stays ".active", as stderr states: an older log of its name is kept.
    Raises LogError if the disk fails, and unless the name is that of a log: no other command would read it.
    """
    if path.suffix.lower() != ".mcap":
        raise LogError(f"{path}: a log is written as .mcap: give a name that ends with it")
    remove_leftover(path)
    start_ns, start_unix_ns = start_times(log)
    sink = flight_log.Writer(
        path, metadata=described, start_unix_ns=start_unix_ns, start_ns=start_ns, block=True
    )
    try:
        yield sink
    except BaseException:
        sink.close(finish=False)
        name = printable(f"{path}{ACTIVE}")
        click.echo(f"companion: {name} is incomplete: run the command again", err=True)
        raise
    if not sink.close():
        raise LogError(f"{sink.trouble}; {path}{ACTIVE} is incomplete: run the command again")
    if sink.dropped:
        lost = f"{sink.dropped} messages were lost while {path} could not be written: run the command again"
        click.echo(f"companion: {printable(lost)}", err=True)


def derived_metadata(config: Config, by: str, log: Path) -> dict[str, dict[str, str]]:
    """Return the metadata of a log that the command `by` makes from `log`: it may be replaced."""
    return {DERIVED: {"by": by, "from": printable(log.name)}, **run_metadata(config)}


@click.command("replay")
@click.argument("log", type=INPUT_PATH)
@click.option("-o", "--output", type=click.Path(path_type=Path), help="MCAP file to write.")
@click.option("--config", "config_file", type=INPUT_PATH, help="Use this configuration.")
@click.option(
    "--with", "changes", multiple=True, metavar="KEY=VALUE,...", help="Change these configuration keys."
)
@beacon_options
@click.option(
    "--correctors",
    "tables",
    multiple=True,
    type=click.Path(path_type=Path),
    help="Add the star fixes, lines of position or second INS of this CSV; may be repeated.",
)
@click.option(
    "--outage",
    "outages",
    multiple=True,
    metavar="GNSS:FROM-TO",
    help="Remove GNSS or RSBN in this interval, s since the first record of the log.",
)
@click.option("--json", "as_json", is_flag=True, help="Print JSON.")
def command(
    log: Path,
    output: Path | None,
    config_file: Path | None,
    changes: tuple[str, ...],
    beacons: Path | None,
    tables: tuple[Path, ...],
    outages: tuple[str, ...],
    seed: int,
    as_json: bool,
) -> None:
    """Run the navigator over a log.

    LOG is our own MCAP (outputs are compared with the flight), or another recorder's. Supported logs:
    MAVLink .tlog, ArduPilot .bin and .log, PX4 .ulg and folders of topics as CSV, InertialNav .mat and
    .zip. A replay of another recorder's log, or with changes, is written to OUTPUT (by default
    NAME.replay.mcap in the current folder). The CSV of beacons has the columns id, lat_deg, lon_deg,
    alt_m and optionally range_m; OurAirports' navaids.csv is also accepted.
    """
    start = time.perf_counter()
    try:
        simulated_outages = [simulated_rsbn.parse_outage(text) for text in outages]
    except ValueError as error:
        raise click.UsageError(str(error)) from None
    config = choose_configuration(log, config_file, changes)
    notes: list[str] = []
    counts: dict[str, int] = {}
    if is_own_log(log) and not is_closed(log):
        notes.append("the log was not closed: its last messages may be missing")
    changed = config_file or changes or beacons or tables or simulated_outages
    as_flown = has_navigator_outputs(log) and not changed
    if output is None and not as_flown:
        output = default_output(log, "replay")
    if output is not None:
        reject_own_input(output, log, beacons, config_file, *tables)
        reject_other_flight(output)
    if output is None or as_flown:
        found = _replay_as_flown(log, output, config)
    else:
        with input_errors_as_log_errors():
            found, more, counts = _replay_changed(
                log, output, config, beacons, tables, simulated_outages, seed
            )
        notes += more
    seconds = time.perf_counter() - start
    if as_json:
        report = {"log": str(log), **counts, **found._asdict(), "notes": notes, "seconds": round(seconds, 3)}
        report["flights"] = [part._asdict() for part in found.flights]
        click.echo(json.dumps(report))
    else:
        _print(log, output, counts, found, seconds)
        for note in notes:
            click.echo(f"  {printable(note)}")
    if found.different:
        raise SystemExit(1)


def _replay_as_flown(log: Path, output: Path | None, config: Config) -> ReplayResult:
    """Replay our own log unchanged."""
    if next(iter(flight_log.read(log)), None) is None:
        raise LogError(f"{log} contains no messages: nothing to replay")
    with show_step(f"replay {log}"), ExitStack() as stack:
        sink: Log = NoLog()
        if output is not None:
            described = derived_metadata(config, "replay", log)
            sink = stack.enter_context(create_replay_log(output, log, described))
        found = replay_own(log, config, sink)
    if not found.inputs:
        raise LogError(f"{log} contains no inputs of a navigator: nothing to replay")
    return found


def _replay_changed(
    log: Path,
    output: Path,
    config: Config,
    beacons: Path | None,
    tables: Sequence[Path],
    outages: Sequence[simulated_rsbn.SimulatedOutage],
    seed: int,
) -> tuple[ReplayResult, list[str], dict[str, int]]:
    """Replay any log, with changes, and write it to `output`. Return result, notes, counts."""
    log_inputs, note = with_beacons_and_outages(log, beacons, outages, seed, config)
    log_inputs = with_correctors(log_inputs, tables)
    tracks, logged, kinds = gnss_latency.TrackCollector(), set[Stamped](), set[type[Stamped]]()
    sensors = set[str | None]()
    described = derived_metadata(config, "replay", log)
    with (
        show_step(f"replay {log}"),
        create_replay_log(output, log, described) as sink,
    ):
        records = _observe(log_inputs.records, tracks, logged, kinds, sensors)
        found = replay_foreign(records, config, sink)
        analyses = [gnss_latency.analyze_track(track) for track in tracks.tracks()]
        for event in set(gnss_latency.glitch_events(analyses)) - logged:
            sink.record(event, "/link/Event")
    notes = [note] if note else []
    removed = log_inputs.outages.removed if log_inputs.outages is not None else {}
    without_gnss = any(number for outage, number in removed.items() if outage.source == "GNSS")
    if without_gnss and LocalPosition in kinds and config.uses_local_velocity:
        notes.append(
            "the velocity in the log's local position includes the effect of the autopilot's own GNSS during "
            "the outage"
        )
    if log_inputs.outages is not None:
        notes += log_inputs.outages.describe_unused()
    if log_inputs.correctors is not None:
        notes += log_inputs.correctors.describe_unused()
    used = config.inertial.correctors if config.has_own_ins else ()
    for kind, name in ((StarFix, "stars"), (RangeDifference, "hyperbolic"), (SecondIns, "second_ins")):
        if tables and kind in kinds and name not in used:
            notes.append(
                f"records of {name} have no effect: give --with inertial.independent=true,"
                f"inertial.correctors={name}"
            )
    if Solution.__name__ not in found.outputs:
        notes.append(f"no estimate: {describe_channel(config, sensors)}")
    return found, [*notes, *gnss_latency.describe_analyses(analyses)], log_inputs.summary()


def start_times(log: Path) -> tuple[int, int]:
    """Return time and wall-clock time of the first record; (0, 0) for the log of another recorder."""
    if not is_own_log(log):
        return 0, 0
    first = next(iter(flight_log.read(log)), None)
    return (0, 0) if first is None else (getattr(first.value, "rx_ns", 0), first.log_time)


def _observe(
    records: Iterable[Stamped],
    tracks: gnss_latency.TrackCollector,
    logged: set[Stamped],
    kinds: set[type[Stamped]],
    sensors: set[str | None],
) -> Iterator[Stamped]:
    """Yield the records; collect the tracks of GNSS, the events, the kinds of record and the sensors."""
    for record in records:
        tracks.add(record)
        kinds.add(type(record))
        sensors.add(sensor_of(record))
        if isinstance(record, Event):
            logged.add(record)
        yield record


def _print(
    log: Path, output: Path | None, counts: dict[str, int], found: ReplayResult, seconds: float
) -> None:
    click.echo(f"{log}: {found.inputs} inputs in {seconds:.1f} s")
    if counts:
        click.echo("  " + ", ".join(f"{value} {name}" for name, value in counts.items()))
    click.echo(
        "  out: " + (", ".join(f"{n} {name}" for name, n in sorted(found.outputs.items())) or "nothing")
    )
    if len(found.flights) > 1:
        click.echo(f"  {len(found.flights)} flights, separated by reboots of the autopilot:")
        for k, part in enumerate(found.flights, start=1):
            span = f"{part.start_s:.1f} to {part.end_s:.1f} s"
            click.echo(f"    {k}: {span}, {part.inputs} inputs, {part.solutions} solutions")
    if not found.outputs.get(Solution.__name__):
        click.echo(
            "  no solution: no fix was accepted, or the log lacks attitude with airspeed or an IMU"
            " (with an INS of its own: local position with its origin); companion report names it"
        )
    if found.compared is not None:
        click.echo(f"  compared with the flight: {found.compared} outputs, {_comparison(found)}")
        if found.first_difference:
            click.echo(f"  first difference: {printable(found.first_difference)}")
    if output is not None:
        click.echo(f"  written to {output}")


def _comparison(found: ReplayResult) -> str:
    distance = f"greatest distance {found.apart_m:.2g} m"
    if found.exact:
        same, where = "all the same bit for bit", "computed on this platform"
    else:
        same, where = f"all the same within {TOLERANCE}", "computed on another platform"
    if not found.different:
        return f"{same} ({where}{'' if found.exact else f': {distance}'})"
    return f"{found.different} DIFFERENT ({where}; {distance})"
