"""`companion replay`: the navigator that flew, over any log; our own logs must give the same outputs bit for
bit.

An MCAP log of ours holds what went into the navigator, what came out and the configuration: its inputs are
handed in again and every output is compared. Any other log has inputs only (`log.sources`); what comes out is
written. So it is where the replay is to differ from the flight: another configuration (--with), beacons that
were not heard (--rsbn), fixes that did not come (--outage).
"""

from __future__ import annotations

import json
import time
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from itertools import zip_longest
from pathlib import Path
from typing import Any, NamedTuple

import click
from rich.console import Console
from rich.progress import Progress

from companion import __version__
from companion.analysis import gnss_latency, simulated_rsbn
from companion.analysis.output_guard import refuse_own_input
from companion.analysis.replay_inputs import changed, has_flown, is_own, sentences, with_radio
from companion.config import Config, load, parse, to_toml
from companion.navigator import Navigator
from companion.records import INPUTS, OUTPUTS, Event, Reboot, Solution, Stamped
from companion.storage import flight_log
from companion.storage.reader import LogError, is_closed

CONFIGURATION = "configuration"  # the metadata record, and its key `toml`


class Part(NamedTuple):
    """A flight of the log: from, to (s since the log's first input), inputs and solutions."""

    start_s: float
    end_s: float
    inputs: int
    solutions: int


class Replayed(NamedTuple):
    """What a replay saw; a reboot begins a flight. Of `compared` outputs `different` are not as in flight."""

    inputs: int
    outputs: dict[str, int]
    flights: list[Part]
    compared: int | None
    different: int
    first_difference: str | None


class _Count:
    """Counts what goes into a navigator and what comes out, by flight."""

    def __init__(self) -> None:
        self.outputs = Counter[str]()
        self._parts: list[list[int]] = []  # of each flight: first and last arrival (ns), inputs, solutions

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

    def found(self, compared: int | None, different: int = 0, first: str | None = None) -> Replayed:
        """Everything counted."""
        zero_ns = self._parts[0][0] if self._parts else 0
        parts = [Part((a - zero_ns) * 1e-9, (b - zero_ns) * 1e-9, *n) for a, b, *n in self._parts]
        inputs = sum(part.inputs for part in parts)
        return Replayed(inputs, dict(self.outputs), parts, compared, different, first)


def metadata(config: Config) -> dict[str, dict[str, str]]:
    """What every log of ours says of itself."""
    return {CONFIGURATION: {"toml": to_toml(config)}, "companion": {"version": __version__}}


def configuration(path: Path) -> Config:
    """The configuration that flew with the log at `path`, the default one where none is told."""
    text = flight_log.metadata(path).get(CONFIGURATION, {}).get("toml")
    return Config() if text is None else parse(text, f"{path} (its own configuration)")


def replay_own(path: Path, config: Config, sink: Any = None) -> Replayed:
    """Hand the log's inputs to a navigator and compare what comes out with what came out in flight."""
    navigator, count = Navigator(config), _Count()
    compared = different = 0
    first: str | None = None
    ours: list[Stamped] = []
    flown: list[Stamped] = []

    def settle() -> None:
        nonlocal compared, different, first
        for then, now in zip_longest(flown, ours):
            compared += 1
            if then != now:
                different += 1
                first = first or f"in flight {then}, now {now}"
        flown.clear()
        ours.clear()

    for entry in flight_log.read(path):
        if entry.topic.startswith("/in/") and isinstance(entry.value, Stamped):
            settle()
            count.input(entry.value)
            if sink is not None:
                sink.record(entry.value)
            ours += navigator.handle(entry.value)  # type: ignore[arg-type]
            for output in ours:
                count.output(output)
                if sink is not None:
                    sink.record(output)
        elif entry.topic.startswith("/out/") and isinstance(entry.value, Stamped):
            flown.append(entry.value)
    settle()
    return count.found(compared, different, first)


def replay_foreign(records: Iterable[Stamped], config: Config, sink: Any) -> Replayed:
    """Hand the records of a foreign log to a navigator, and write everything to `sink`."""
    navigator, count = Navigator(config), _Count()
    for record in records:
        told = isinstance(record, OUTPUTS)  # by the source, not by the navigator
        sink.record(record, f"/link/{type(record).__name__}" if told else None)
        if isinstance(record, INPUTS):
            count.input(record)
            for output in navigator.handle(record):  # type: ignore[arg-type]
                count.output(output)
                sink.record(output)
    return count.found(None)


def writer(
    path: Path, described: Mapping[str, Mapping[str, str]], start_ns: int = 0, start_unix_ns: int = 0
) -> flight_log.Writer:
    """A log for a replay: it waits for the disk, since nobody flies by it."""
    return flight_log.Writer(
        path, metadata=described, start_unix_ns=start_unix_ns, start_ns=start_ns, block=True
    )


@click.command("replay")
@click.argument("log", type=click.Path(path_type=Path))
@click.option(
    "-o", "--output", type=click.Path(path_type=Path), help="Where to write the MCAP of this replay."
)
@click.option("--config", "config_file", type=click.Path(path_type=Path), help="Fly with this configuration.")
@click.option(
    "--with", "changes", multiple=True, metavar="KEY=VALUE,...", help="Fly with these keys changed."
)
@click.option("--rsbn", "beacons", type=click.Path(path_type=Path), help="Hear the beacons of this CSV.")
@click.option(
    "--outage",
    "outages",
    multiple=True,
    metavar="GNSS:FROM-TO",
    help="Be deaf to GNSS or RSBN, s of the log.",
)
@click.option("--seed", type=click.IntRange(min=0), default=0, help="Of the simulated beacons' noise.")
@click.option("--json", "as_json", is_flag=True, help="Print JSON.")
def command(
    log: Path,
    output: Path | None,
    config_file: Path | None,
    changes: tuple[str, ...],
    beacons: Path | None,
    outages: tuple[str, ...],
    seed: int,
    as_json: bool,
) -> None:
    """Run the navigator over LOG: an MCAP of ours (outputs compared bit for bit), or another recorder's.

    Read are MAVLink .tlog, ArduPilot .bin and .log, PX4 .ulg and folders of topics as CSV, InertialNav's .mat
    and .zip. What differs from a flight of ours is written to OUTPUT (by default beside you, as
    NAME.replay.mcap). The CSV of beacons has columns id, lat_deg, lon_deg, alt_m and, if you like, range_m;
    OurAirports' navaids.csv is read too.
    """
    begun = time.perf_counter()
    try:
        silent = [simulated_rsbn.parse_outage(text) for text in outages]
    except ValueError as error:
        raise click.UsageError(str(error)) from None
    own = is_own(log)
    config = load(config_file) if config_file or not own else configuration(log)
    if changes:
        config = changed(config, ",".join(changes))
    notes: list[str] = []
    counts: dict[str, int] = {}
    if own and not is_closed(log):
        notes.append("the log was not closed: what came last is missing")
    if output is not None:
        refuse_own_input(output, log, beacons, config_file)
    if has_flown(log) and not (changes or beacons or silent):
        found = _compare(log, output, config)
    else:
        output = output or Path(f"{log.name.split('.mcap')[0] if own else log.stem}.replay.mcap")
        with sentences():
            found, more, counts = _fly(log, output, config, beacons, silent, seed)
        notes += more
    seconds = time.perf_counter() - begun
    if as_json:
        report = {"log": str(log), **counts, **found._asdict(), "notes": notes, "seconds": round(seconds, 3)}
        report["flights"] = [part._asdict() for part in found.flights]
        click.echo(json.dumps(report))
    else:
        _print(log, output, counts, found, seconds)
        for note in notes:
            click.echo(f"  {note}")
    if found.different:
        raise SystemExit(1)


def _compare(log: Path, output: Path | None, config: Config) -> Replayed:
    """A log of ours as it flew."""
    first = next(iter(flight_log.read(log)), None)
    if first is None:
        raise LogError(f"{log} holds no message: there is nothing to replay")
    sink = None
    if output is not None:
        sink = writer(output, metadata(config), getattr(first.value, "rx_ns", 0), first.log_time)
    found = replay_own(log, config, sink)
    if sink is not None:
        sink.close()
    if not found.inputs:
        raise LogError(f"{log} holds nothing that a navigator was given: there is nothing to replay")
    return found


def _fly(
    log: Path,
    output: Path,
    config: Config,
    beacons: Path | None,
    outages: Sequence[simulated_rsbn.Outage],
    seed: int,
) -> tuple[Replayed, list[str], dict[str, int]]:
    """Any log, otherwise than it flew, written to `output`: what came out, notes for the reader, counts."""
    opened, note = with_radio(log, beacons, outages, seed, config)
    watch, told = gnss_latency.Watch(), set[Stamped]()
    with Progress(console=Console(stderr=True), transient=True) as progress:
        records = progress.track(_watched(opened.records, watch, told), description=f"replay {log.name}")
        sink = writer(output, metadata(config), *_start(log))
        try:
            found = replay_foreign(records, config, sink)
            seen = [gnss_latency.look(track) for track in watch.tracks()]
            for event in set(gnss_latency.events(seen)) - told:
                sink.record(event, "/link/Event")
        finally:
            sink.close()
    notes = [note] if note else []
    if outages and config.channel == "local_position" and not config.inertial.independent:
        notes.append("the log's local position is as the autopilot had it, its own GNSS included")
    end_s = found.flights[-1].end_s if found.flights else 0.0
    late = (outage for outage in outages if outage.start > end_s)
    notes += [f"{outage} silenced nothing: the log ends at {end_s:.0f} s" for outage in late]
    return found, [*notes, *gnss_latency.sentences(seen)], opened.summary()


def _start(log: Path) -> tuple[int, int]:
    """A record's time and the wall clock's at it: a foreign log's times are UNIX already, or since boot."""
    if not is_own(log):
        return 0, 0
    first = next(iter(flight_log.read(log)), None)
    return (0, 0) if first is None else (getattr(first.value, "rx_ns", 0), first.log_time)


def _watched(records: Iterable[Stamped], watch: gnss_latency.Watch, told: set[Stamped]) -> Iterator[Stamped]:
    for record in records:
        watch.see(record)
        if isinstance(record, Event):
            told.add(record)
        yield record


def _print(log: Path, output: Path | None, counts: dict[str, int], found: Replayed, seconds: float) -> None:
    click.echo(f"{log}: {found.inputs} inputs in {seconds:.1f} s")
    if counts:
        click.echo("  " + ", ".join(f"{value} {name}" for name, value in counts.items()))
    click.echo(
        "  out: " + (", ".join(f"{n} {name}" for name, n in sorted(found.outputs.items())) or "nothing")
    )
    if len(found.flights) > 1:
        click.echo(f"  {len(found.flights)} flights, the autopilot having begun anew in between:")
        for k, part in enumerate(found.flights, start=1):
            span = f"{part.start_s:.1f} to {part.end_s:.1f} s"
            click.echo(f"    {k}: {span}, {part.inputs} inputs, {part.solutions} solutions")
    if not found.outputs.get(Solution.__name__):
        click.echo("  no solution: the log has no local position with an origin, or no fix that was believed")
    if found.compared is not None:
        same = "all the same, bit for bit" if not found.different else f"{found.different} DIFFERENT"
        click.echo(f"  compared with the flight: {found.compared} outputs, {same}")
        if found.first_difference:
            click.echo(f"  first difference: {found.first_difference}")
    if output is not None:
        click.echo(f"  written to {output}")
