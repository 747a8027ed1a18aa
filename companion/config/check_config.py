"""Command `companion check-config`: validate a configuration and print it."""

from __future__ import annotations

from pathlib import Path

import click
import msgspec

from companion.config import load, to_toml
from companion.config.presets import PRESETS
from companion.config.reference import commented_toml


@click.command("check-config")
@click.argument("file", type=click.Path(path_type=Path), required=False)
@click.option("--defaults", is_flag=True, help="Print every key with its comment, as a file to start from.")
@click.option("--preset", metavar="NAME", help=f"Start from one of {', '.join(PRESETS)}.")
@click.option("--json", "as_json", is_flag=True, help="Print the configuration in force as JSON.")
def command(file: Path | None, defaults: bool, preset: str | None, as_json: bool) -> None:
    """Check a configuration, print it, or write one to start from.

    Reads FILE and the COMPANION_SECTION__KEY variables, and prints the configuration in force.
    An unknown key or an invalid value is reported with the nearest valid one; the exit code is then 78.

    \b
    A file to start from:
      companion check-config --defaults --preset stock-autopilot > companion.toml
    """
    config = load(environment={}, preset=preset) if defaults else load(file, preset=preset)
    if as_json:
        click.echo(msgspec.json.encode(config).decode(), nl=False)
    else:
        click.echo(commented_toml(config) if defaults else to_toml(config), nl=False)
