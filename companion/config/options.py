"""Command-line options of every command that loads a configuration: --config, --preset and --set."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, TypeVar

import click

from companion.config.load import ConfigError
from companion.config.presets import PRESETS
from companion.option_types import INPUT_PATH

T = TypeVar("T")
Command = TypeVar("Command", bound=Callable[..., Any])


def configuration_options(command: Command) -> Command:
    """Add the options; they arrive as `file`, `preset` and `pairs`, the arguments of `load`."""
    file = click.option(
        "--config",
        "file",
        type=INPUT_PATH,
        multiple=True,
        callback=_only_one,
        help="TOML file; see check-config.",
    )
    return file(override_options(command))


def override_options(command: Command) -> Command:
    """Add --preset and --set, for a command that takes the file as an argument."""
    preset = click.option(
        "--preset",
        metavar="NAME",
        multiple=True,
        callback=_only_one,
        help=f"Start from one of {', '.join(PRESETS)}.",
    )
    pairs = click.option(
        "--set", "pairs", multiple=True, metavar="SECTION.KEY=VALUE", help="Any key of the file."
    )
    return preset(pairs(command))


def _only_one(_: click.Context, option: click.Parameter, values: Sequence[T]) -> T | None:
    """Return the value, or None; of two click would drop the first without a word."""
    if len(values) > 1:
        first, second = values[:2]
        raise ConfigError(
            f"{option.opts[0]} {second}: {option.opts[0]} {first} is given too: leave one out, "
            "and change single keys by --set"
        )
    return values[0] if values else None
