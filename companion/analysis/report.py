"""`companion report LOG [LOG2] -o report.html`: a flight on one page, or two beside each other.

The page needs no network and no server. A log that is not ours is flown through the navigator first, in
memory. Errors are counted from the log's own truth, or else from the track smoothed with all fixes.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import click

from companion.analysis.assessment import assess
from companion.analysis.drawing import printed
from companion.analysis.figures import figures
from companion.analysis.flight_arrays import Flight
from companion.analysis.flights import open_flights
from companion.analysis.html import Block, page
from companion.analysis.output_guard import refuse_any_log, refuse_own_input
from companion.analysis.plot_data import LETTERS, Figure
from companion.analysis.replay_inputs import changed, has_flown
from companion.analysis.summary import verdict
from companion.config import load
from companion.optional_dependencies import lacking
from companion.storage.reader import LogError


@click.command("report")
@click.argument("logs", type=click.Path(path_type=Path), nargs=-1, required=True, metavar="LOG [LOG2]")
@click.option(
    "-o", "--output", type=click.Path(path_type=Path), default=Path("report.html"), show_default=True
)
@click.option("--pdf", type=click.Path(path_type=Path), help="Write the figures into this PDF too.")
@click.option("--png", type=click.Path(path_type=Path), help="Write each figure into this folder too.")
@click.option("--config", "config_file", type=click.Path(path_type=Path), help="For a log that is not ours.")
@click.option(
    "--with", "changes", multiple=True, metavar="KEY=VALUE,...", help="Of that, these keys changed."
)
def command(
    logs: tuple[Path, ...],
    output: Path,
    pdf: Path | None,
    png: Path | None,
    config_file: Path | None,
    changes: tuple[str, ...],
) -> None:
    """Write a page about LOG, or about two logs compared: our MCAP, or any other that `replay` reads.

    Where the autopilot began anew, a log holds several flights: each has its chapters, and of two logs the
    longest flights are compared.
    """
    if len(logs) > 2:
        raise click.UsageError(f"{len(logs)} logs were given: a report is about one, or compares two")
    for target in (output, pdf):
        if target is not None:
            refuse_own_input(target, *logs, config_file)
            refuse_any_log(target)
    if changes or config_file:
        _refuse_flown(logs)
    config = load(config_file)
    if changes:
        config = changed(config, ",".join(changes))
    found = [open_flights(path, config) for path in logs]
    blocks = compared(found, _names(logs)) if len(logs) == 2 else alone(found[0])
    try:
        output.write_text(page(" and ".join(_names(logs)), blocks), encoding="utf-8")
        written = [output, *(printed(_all_figures(blocks), pdf, png) if pdf or png else [])]
    except ModuleNotFoundError as error:
        raise LogError(lacking("a report", error.name, "report")) from None
    except OSError as error:
        raise LogError(f"cannot write the report to {error.filename}: {error.strerror}") from None
    for block in blocks:
        for flight in block.flights:
            click.echo(verdict(flight))
    click.echo(f"written: {', '.join(str(path) for path in written)}")


def _refuse_flown(logs: Sequence[Path]) -> None:
    """LogError where a log is of a flight with us: what flew it is in it, and nothing is flown anew here."""
    for path in logs:
        if has_flown(path):
            raise LogError(
                f"--with and --config change nothing of {path}, reported as it flew; replay it first:"
                f" companion replay {path} --with KEY=VALUE, and report what that writes"
            )


def alone(flights: Sequence[Flight]) -> list[Block]:
    """A block for each flight of one log."""
    blocks = []
    for flight in flights:
        a = assess(flight)
        blocks.append(Block([_called(flight, flight.name)], [a], figures([a])))
    return blocks


def compared(logs: Sequence[Sequence[Flight]], names: Sequence[str]) -> list[Block]:
    """One block with the longest flight of each of two logs."""
    chosen = [max(flights, key=lambda flight: flight.seconds) for flights in logs]
    called = [
        f"{letter}: {_called(flight, name)}"
        for letter, flight, name in zip(LETTERS, chosen, names, strict=True)
    ]
    both = [assess(flight) for flight in chosen]
    return [Block(called, both, figures(both))]


def _called(flight: Flight, name: str) -> str:
    k, n = flight.part
    return name if n == 1 else f"{name}, flight {k} of {n}"


def _all_figures(blocks: Sequence[Block]) -> list[Figure]:
    """Those of all blocks for paper, told apart by the flight."""
    if len(blocks) == 1:
        return list(blocks[0].figures)
    return [
        figure._replace(key=f"flight{k}_{figure.key}", title=f"Flight {k}. {figure.title}")
        for k, block in enumerate(blocks, start=1)
        for figure in block.figures
    ]


def _names(logs: tuple[Path, ...]) -> list[str]:
    """What the page calls its logs; a folder more where two have one name."""
    same = len({path.name for path in logs}) < len(logs)
    return [f"{path.resolve().parent.name}/{path.name}" if same else path.name for path in logs]
