"""`companion log`: contents of a log, recovery, conversion of another recorder's log, export of a map."""

from __future__ import annotations

from datetime import UTC, datetime
from pathlib import Path

import click
import msgspec
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from companion.analysis.progress import show_step
from companion.option_types import INPUT_PATH, FloatRange
from companion.printable import printable
from companion.storage.flight_log import Info, info
from companion.storage.reader import LogError
from companion.storage.recovery import recover


@click.group("log")
def group() -> None:
    """Inspect, recover, convert and export logs."""


@group.command("info")
@click.argument("log", type=INPUT_PATH)
@click.option("--json", "as_json", is_flag=True, help="Print one JSON object.")
def info_command(log: Path, as_json: bool) -> None:
    """Show the contents of LOG.

    Prints messages by topic, times, metadata, and whether it was closed.
    """
    with show_step(f"read {log}"):
        found = info(log)
    if as_json:
        values = found._asdict() | {"path": str(found.path), "duration_s": found.duration_s}
        click.echo(msgspec.json.format(msgspec.json.encode(values), indent=2))
    else:
        _print(found)


@group.command("recover")
@click.argument("log", type=INPUT_PATH)
def recover_command(log: Path) -> None:
    """Recover a torn or damaged LOG.

    x.mcap.active becomes x.mcap; x.mcap is copied to x.recovered.mcap.
    A log without a message that can be read is left as it is; the exit code is then 1.
    """
    with show_step(f"recover {log}"):
        saved = recover(log, reject_empty=True)
    if saved.path == log:
        click.echo(f"{log} is complete: {saved.messages} messages in {saved.chunks} chunks")
    else:
        click.echo(
            f"{saved.path}: {saved.messages} messages in {saved.chunks} chunks saved,"
            f" {saved.bytes_lost} bytes lost"
        )


@group.command("convert")
@click.argument("source", type=INPUT_PATH)
@click.option("-o", "--output", type=click.Path(path_type=Path), required=True, help="MCAP file to write.")
@click.option(
    "--config",
    "config_file",
    type=INPUT_PATH,
    help="Configuration; its link.system_id selects the vehicle of a telemetry log with several.",
)
def convert_command(source: Path, output: Path, config_file: Path | None) -> None:
    """Convert SOURCE, a log of another recorder, to MCAP.

    Writes inputs and truth only, nothing computed.
    """
    from companion.analysis import convert
    from companion.config import load

    config = load(config_file)
    with show_step(f"convert {source}"):
        written = convert.convert_log(source, output, config)
    click.echo(f"{output}: {written.records} records, {written.reboots} reboots")


@group.command("export")
@click.argument("log", type=INPUT_PATH)
@click.option(
    "-o",
    "--output",
    "outputs",
    multiple=True,
    type=click.Path(path_type=Path),
    required=True,
    help="File to write, may be repeated: .geojson or .kml.",
)
@click.option(
    "--every",
    "every_s",
    type=FloatRange(0.01, 3600.0),
    default=1.0,
    show_default=True,
    help="Seconds between points.",
)
@click.option(
    "--config",
    "config_file",
    type=INPUT_PATH,
    help="Configuration for the log of another recorder.",
)
def export_command(log: Path, outputs: tuple[Path, ...], every_s: float, config_file: Path | None) -> None:
    """Export the map of LOG.

    It has the estimate by legs with and without fixes, GNSS, truth and beacons.
    """
    from companion.analysis import export
    from companion.analysis.flights import open_flights
    from companion.analysis.output_guard import reject_any_log, reject_own_input, reject_same_output
    from companion.analysis.replay_inputs import has_navigator_outputs
    from companion.config import load

    for output in outputs:
        export.check_suffix(output)
        reject_own_input(output, log, config_file)
        reject_any_log(output)
    reject_same_output(outputs)
    if config_file and has_navigator_outputs(log):
        raise LogError(
            f"--config {config_file} has no effect on {log}, which is exported as flown; replay it first:"
            f" companion replay {log} --config {config_file} -o REPLAY.mcap, then export that"
        )
    tracks, places = list[export.Track](), list[export.Place]()
    with show_step(f"read {log}"):
        flights = open_flights(log, load(config_file))
    for flight in flights:
        lines, beacons = export.flight_map(flight, every_s)
        places += [place for place in beacons if place not in places]
        k, n = flight.part
        tracks += [line._replace(name=f"flight {k}: {line.name}" if n > 1 else line.name) for line in lines]
    if not tracks and not places:
        raise LogError(f"{log} has no position, so there is no map: `companion report` names what is missing")
    for output in outputs:
        export.write_map(output, log.name, tracks, places)
        click.echo(f"{output}: {len(tracks)} tracks, {len(places)} beacons")


def _print(found: Info) -> None:
    console = Console()
    rate = 1.0 / found.duration_s if found.duration_s > 0 else 0.0
    lost = f"{found.bytes_lost} bytes unreadable; " if found.bytes_lost else ""
    state = "closed" if found.closed else f"torn, or still written ({lost}run companion log recover)"
    name = escape(printable(str(found.path)))
    console.print(f"[bold]{name}[/]  {found.bytes / 1e6:.3f} MB, {state}", soft_wrap=True)
    if found.messages:
        start = datetime.fromtimestamp(found.start_ns / 1e9, UTC).isoformat(timespec="milliseconds")
        console.print(f"{start}, {found.duration_s:.1f} s, {found.messages} messages, {found.chunks} chunks")
    table = Table("topic", box=None, pad_edge=False)
    table.add_column("messages", justify="right")
    table.add_column("Hz", justify="right")
    for topic, count in sorted(found.counts.items()):
        table.add_row(escape(printable(topic)), str(count), f"{count * rate:.2f}")
    console.print(table)
    for name, values in found.metadata.items():
        for key, value in values.items():
            head, *rest = value.splitlines() or [""]
            more = f" ... ({len(rest)} more lines)" if rest else ""
            line = printable(f"{name}.{key}: {head}{more}")
            console.print(escape(line), soft_wrap=True, highlight=False)
