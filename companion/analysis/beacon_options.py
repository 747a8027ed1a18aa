"""Command-line options of every command that simulates beacons: --rsbn and --seed."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

import click

Command = TypeVar("Command", bound=Callable[..., Any])


def beacon_options(command: Command) -> Command:
    """Add the options; they arrive as `beacons` and `seed`, the arguments of `with_beacons_and_outages`."""
    beacons = click.option(
        "--rsbn",
        "beacons",
        type=click.Path(path_type=Path),
        is_eager=True,  # known when the seed is checked
        help="Simulate the beacons of this CSV.",
    )
    seed = click.option(
        "--seed",
        type=click.IntRange(min=0),
        callback=_seed,
        help="Seed of the noise of simulated beacons; default: 0.",
    )
    return beacons(seed(command))


def _seed(context: click.Context, parameter: click.Parameter, seed: int | None) -> int:
    if seed is not None and context.params.get("beacons") is None:
        raise click.UsageError(
            f"--seed {seed} has no effect without --rsbn: add --rsbn BEACONS.csv, or leave --seed out"
        )
    return seed or 0
