"""`companion report LOG... -o report.html`: report on one flight, or comparison of several, in one HTML file.

The file needs no network and no server. The navigator is first run, in memory, over the log of another
recorder. Errors are relative to the truth of the log, or else to the track smoothed with all fixes.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import click

from companion.analysis.assessment import assess_flight
from companion.analysis.drawing import write_figures
from companion.analysis.figures import build_figures
from companion.analysis.flight_arrays import Flight
from companion.analysis.flights import open_flights
from companion.analysis.html import ReportBlock, render_report
from companion.analysis.output_guard import reject_any_log, reject_own_input, reject_same_output
from companion.analysis.plot_data import LETTERS, Figure
from companion.analysis.progress import show_step
from companion.analysis.replay_inputs import apply_changes, has_navigator_outputs
from companion.analysis.summary import summarize_flight
from companion.analysis.verdict import judge_flight
from companion.config import load
from companion.option_types import INPUT_PATH
from companion.optional_dependencies import first_missing, missing_package
from companion.printable import printable
from companion.storage.reader import LogError
from companion.write_errors import describe_write_error, write_whole


@click.command("report")
@click.argument("logs", type=INPUT_PATH, nargs=-1, required=True, metavar="LOG...")
@click.option(
    "-o",
    "--output",
    type=click.Path(path_type=Path),
    default=Path("report.html"),
    show_default=True,
    help="Page to write.",
)
@click.option("--pdf", type=click.Path(path_type=Path), help="Also write the figures to this PDF.")
@click.option("--png", type=click.Path(path_type=Path), help="Also write each figure to this folder.")
@click.option(
    "--config",
    "config_file",
    type=INPUT_PATH,
    help="Configuration for the log of another recorder.",
)
@click.option(
    "--with", "changes", multiple=True, metavar="KEY=VALUE,...", help="Change these configuration keys."
)
def command(
    logs: tuple[Path, ...],
    output: Path,
    pdf: Path | None,
    png: Path | None,
    config_file: Path | None,
    changes: tuple[str, ...],
) -> None:
    """Write a report on LOG, or a comparison of several.

    LOG is our own MCAP, or any log that `replay` supports. A reboot of the autopilot starts a new flight in a
    log: each flight has its own chapters; of several logs the longest flights are compared.
    """
    if len(logs) > len(LETTERS):
        raise click.UsageError(f"{len(logs)} logs given; at most {len(LETTERS)} can be compared")
    outputs = [target for target in (output, pdf) if target is not None]
    reject_same_output(outputs)
    for target in outputs:
        reject_own_input(target, *logs, config_file)
        reject_any_log(target)
    _check_suffix(output, "a report", ".html", ".htm")
    if pdf is not None:
        _check_suffix(pdf, "the PDF of the figures", ".pdf")
    if png is not None and png.exists() and not png.is_dir():
        raise LogError(f"cannot write the figures to {png}: it is a file; give a folder")
    if (package := first_missing("jinja2", *(["matplotlib"] if pdf or png else []))) is not None:
        raise LogError(missing_package("a report", package, "report"))
    if changes or config_file:
        _reject_flown(logs)
    config = load(config_file)
    if changes:
        config = apply_changes(config, ",".join(changes))
    with show_step("report") as step:
        found = []
        for path in logs:
            step(f"read {path.name}")
            found.append(open_flights(path, config))
        step("smooth the track and assess the errors")
        blocks = comparison_block(found, _names(logs)) if len(logs) > 1 else blocks_of_log(found[0])
        step(f"write {output}")
        try:
            write_whole(output, render_report(_title(_names(logs)), blocks).encode(errors="replace"))
            written = [output, *(write_figures(_all_figures(blocks), pdf, png) if pdf or png else [])]
        except OSError as error:
            raise LogError(
                f"cannot write the report to {error.filename}: {describe_write_error(error)}"
            ) from None
    several = sum(len(block.flights) for block in blocks) > 1
    for block in blocks:
        for name, flight in zip(block.names, block.flights, strict=True):
            verdict, head = judge_flight(flight), f"{printable(name)}: " if several else ""
            click.echo(f"{head}{verdict.word}: {printable(verdict.reason)} {verdict.number} {verdict.what}.")
            click.echo(printable(" ".join(summarize_flight(flight))))
    click.echo(f"written: {', '.join(str(path) for path in written)}")


def _check_suffix(path: Path, what: str, *suffixes: str) -> None:
    """Raise LogError if `path` has the suffix of another format: no viewer would open it."""
    if path.suffix and path.suffix.lower() not in suffixes:
        raise LogError(f"{path}: {what} is written as {suffixes[0]}: give a name that ends with it")


def _reject_flown(logs: Sequence[Path]) -> None:
    """Raise LogError if a log has navigator outputs, as configuration options would have no effect on it."""
    for path in logs:
        if has_navigator_outputs(path):
            raise LogError(
                f"--with and --config have no effect on {path}, which is reported as flown; replay it first:"
                f" companion replay {path} --with KEY=VALUE, then report the replay"
            )


def blocks_of_log(flights: Sequence[Flight]) -> list[ReportBlock]:
    """Build a block for each flight of one log."""
    blocks = []
    for flight in flights:
        a = assess_flight(flight)
        blocks.append(ReportBlock([_flight_title(flight, flight.name)], [a], build_figures([a])))
    return blocks


def comparison_block(logs: Sequence[Sequence[Flight]], names: Sequence[str]) -> list[ReportBlock]:
    """Build one block with the longest flight of each log."""
    chosen = [max(flights, key=lambda flight: flight.seconds) for flights in logs]
    names_of_flights = [
        f"{letter}: {_flight_title(flight, name)}" for letter, flight, name in zip(LETTERS, chosen, names)
    ]
    assessed = [assess_flight(flight) for flight in chosen]
    return [ReportBlock(names_of_flights, assessed, build_figures(assessed))]


def _title(names: Sequence[str]) -> str:
    return " and ".join(names) if len(names) <= 2 else f"{names[0]} and {len(names) - 1} other logs"


def _flight_title(flight: Flight, name: str) -> str:
    k, n = flight.part
    return name if n == 1 else f"{name}, flight {k} of {n}"


def _all_figures(blocks: Sequence[ReportBlock]) -> list[Figure]:
    """Return the figures of all blocks, with the flight number in keys and titles if there are several."""
    if len(blocks) == 1:
        return list(blocks[0].figures)
    return [
        figure._replace(key=f"flight{k}_{figure.key}", title=f"Flight {k}. {figure.title}")
        for k, block in enumerate(blocks, start=1)
        for figure in block.figures
    ]


def _names(logs: tuple[Path, ...]) -> list[str]:
    """Return the names of the logs, with their folder if two names are equal."""
    same = len({path.name for path in logs}) < len(logs)
    return [f"{path.resolve().parent.name}/{path.name}" if same else path.name for path in logs]
