"""Command-line options of every command that loads a configuration: --config, --preset and --set."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

import click

from companion.config.presets import PRESETS

Command = TypeVar("Command", bound=Callable[..., Any])


def configuration_options(command: Command) -> Command:
    """Add the options; they arrive as `file`, `preset` and `pairs`, the arguments of `load`."""
    file = click.option(
        "--config", "file", type=click.Path(path_type=Path), help="TOML file; see check-config."
    )
    return file(override_options(command))


def override_options(command: Command) -> Command:
    """Add --preset and --set, for a command that takes the file as an argument."""
    preset = click.option("--preset", metavar="NAME", help=f"Start from one of {', '.join(PRESETS)}.")
    pairs = click.option(
        "--set", "pairs", multiple=True, metavar="SECTION.KEY=VALUE", help="Any key of the file."
    )
    return preset(pairs(command))
