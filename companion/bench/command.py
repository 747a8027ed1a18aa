"""`companion bench`: what things cost, side by side in one run, so that ratios can be trusted.

Every case of a module is called in turn, round after round, so that a machine that slows down slows all of
them; the median of the rounds is quoted.
"""

from __future__ import annotations

import json
import statistics
import time
from collections.abc import Callable, Iterator
from importlib import import_module

import click
from rich.console import Console
from rich.table import Table

MODULES = ("fusion", "minimax", "kalman", "frame", "log")
ROUNDS = 15
ROUND_S = 0.02  # a round of one case lasts at least this long


def measure(
    cases: Iterator[tuple[str, Callable[[], object]]], rounds: int = ROUNDS
) -> dict[str, list[float]]:
    """Seconds a call for each case and round, the cases interleaved."""
    calls: dict[str, tuple[Callable[[], object], int]] = {}
    for name, call in cases:
        call()
        begun = time.perf_counter()
        call()
        calls[name] = call, max(1, round(ROUND_S / max(time.perf_counter() - begun, 1e-9)))
    times: dict[str, list[float]] = {name: [] for name in calls}
    for _ in range(rounds):
        for name, (call, repeat) in calls.items():
            begun = time.perf_counter()
            for _ in range(repeat):
                call()
            times[name].append((time.perf_counter() - begun) / repeat)
    return times


def table(title: str, times: dict[str, list[float]]) -> Table:
    """Median, least and greatest per call, and each median against the dearest case's."""
    shown = Table(title=title)
    for column in ("case", "median us", "min", "max", "dearest / this"):
        shown.add_column(column, justify="left" if column == "case" else "right")
    medians = {name: statistics.median(values) for name, values in times.items()}
    dearest = max(medians.values())
    for name, values in times.items():
        numbers = (medians[name], min(values), max(values))
        shown.add_row(name, *(f"{1e6 * x:.1f}" for x in numbers), f"{dearest / medians[name]:.1f}")
    return shown


@click.command("bench")
@click.argument("names", nargs=-1, type=click.Choice([*MODULES, "latency"]))
@click.option("--json", "as_json", is_flag=True, help="Print JSON: seconds a call, every round.")
def command(names: tuple[str, ...], as_json: bool) -> None:
    """Time the parts NAMES (all but latency where none is named), interleaved in one run.

    `latency` sends beacon answers over UDP on loopback to a whole service and waits for the corrected
    estimate, beside a bare asyncio UDP echo.
    """
    found = {}
    for name in names or MODULES:
        module = import_module(f"companion.bench.{name}")
        found[name] = (
            module.measure()
            if name == "latency"
            else measure(module.cases(), getattr(module, "ROUNDS", ROUNDS))
        )
    if as_json:
        click.echo(json.dumps(found))
        return
    console = Console()
    for name, times in found.items():
        console.print(table(name, times))
