"""`companion report LOG [LOG2] -o report.html`: a flight on one page, or two beside each other.

The page needs no network and no server. A log that is not ours is flown through the navigator first, in
memory. Errors are counted from the log's own truth, or else from the track smoothed with all fixes.
"""

from __future__ import annotations

from pathlib import Path

import click

from companion.config import ConfigError, load
from companion.log.assess import assess
from companion.log.draw import printed
from companion.log.figures import figures
from companion.log.gather import open_flight
from companion.log.opened import LogError
from companion.log.page import page
from companion.log.verdict import verdict


@click.command("report")
@click.argument("logs", type=click.Path(path_type=Path), nargs=-1, required=True, metavar="LOG [LOG2]")
@click.option(
    "-o", "--output", type=click.Path(path_type=Path), default=Path("report.html"), show_default=True
)
@click.option("--pdf", type=click.Path(path_type=Path), help="Write the figures into this PDF too.")
@click.option("--png", type=click.Path(path_type=Path), help="Write each figure into this folder too.")
@click.option("--config", "config_file", type=click.Path(path_type=Path), help="For a log that is not ours.")
def command(
    logs: tuple[Path, ...], output: Path, pdf: Path | None, png: Path | None, config_file: Path | None
) -> None:
    """Write a page about LOG, or about two logs compared: our MCAP, a MAVLink .tlog, a folder of topics."""
    if len(logs) > 2:
        raise click.UsageError(f"{len(logs)} logs were given: a report is about one, or compares two")
    config = load(config_file) if config_file else None
    try:
        flights = [assess(open_flight(path, config)) for path in logs]
    except (LogError, ConfigError):
        raise
    except ValueError as error:
        raise LogError(str(error)) from None
    drawn = figures(flights)
    try:
        output.write_text(page(flights, _names(logs), drawn), encoding="utf-8")
        written = [output, *(printed(drawn, pdf, png) if pdf or png else [])]
    except ModuleNotFoundError as error:
        raise LogError(
            f"a report needs {error.name}: install it by `pip install 'navigation-companion[report]'`"
        ) from None
    except OSError as error:
        raise LogError(f"cannot write the report to {error.filename}: {error.strerror}") from None
    for flight in flights:
        click.echo(verdict(flight))
    click.echo(f"written: {', '.join(str(path) for path in written)}")


def _names(logs: tuple[Path, ...]) -> list[str]:
    """What the page calls its logs; a folder more where two have one name."""
    same = len({path.name for path in logs}) < len(logs)
    return [f"{path.resolve().parent.name}/{path.name}" if same else path.name for path in logs]
