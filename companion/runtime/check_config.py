"""Command `companion check-config`: validate a configuration and print it."""

from __future__ import annotations

from pathlib import Path

import click
import msgspec

from companion.config import ConfigError, load, to_toml
from companion.config.options import override_options
from companion.config.reference import commented_toml
from companion.option_types import INPUT_PATH
from companion.printable import printable
from companion.runtime.link_addresses import check_links
from companion.runtime.signing_key import read_configured_key


@click.command("check-config")
@click.argument("file", type=INPUT_PATH, required=False)
@click.option("--defaults", is_flag=True, help="Print every key with its comment, as a file to start from.")
@override_options
@click.option("--json", "as_json", is_flag=True, help="Print the configuration in force as JSON.")
def command(
    file: Path | None, defaults: bool, preset: str | None, pairs: tuple[str, ...], as_json: bool
) -> None:
    """Check a configuration, print it, or write one to start from.

    Reads FILE, the COMPANION_SECTION__KEY variables and --set, and prints the configuration in force.
    An unknown key or an invalid value is reported with the nearest valid one; the exit code is then 78.
    A signing key that this computer cannot read is only a warning: it may be on another computer.

    \b
    A file to start from:
      companion check-config --defaults --preset stock-autopilot > companion.toml
    """
    if defaults and file is not None:
        raise click.UsageError(
            f"FILE {file} has no effect with --defaults, which prints the defaults: leave one of them out"
        )
    if defaults:
        config = load(environment={}, preset=preset, pairs=pairs)
    else:
        config = load(file, preset=preset, pairs=pairs)
    check_links(config)
    try:
        read_configured_key(config)
    except ConfigError as error:
        click.echo(f"companion: warning: {printable(str(error))}", err=True)
    if as_json:
        click.echo(msgspec.json.encode(config).decode(), nl=False)
    else:
        click.echo(commented_toml(config) if defaults else to_toml(config), nl=False)
