"""Command `companion check-config`: validate a configuration and print it."""

from __future__ import annotations

from pathlib import Path

import click
import msgspec

from companion.config import Config, load, to_toml


@click.command("check-config")
@click.argument("file", type=click.Path(path_type=Path), required=False)
@click.option("--defaults", is_flag=True, help="Print the defaults, as a file to start from.")
@click.option("--json", "as_json", is_flag=True, help="Print the configuration in force as JSON.")
def command(file: Path | None, defaults: bool, as_json: bool) -> None:
    """Check FILE and the COMPANION_SECTION__KEY variables, and print the configuration in force.

    An unknown key or an invalid value is reported with the nearest valid one; the exit code is then 78.
    """
    config = Config() if defaults else load(file)
    click.echo(msgspec.json.encode(config).decode() if as_json else to_toml(config), nl=False)
