"""`companion bench`: timing of the costly parts, interleaved in one run so that ratios are reliable.

In each round every case of a module is called in turn, so that a slowdown of the machine affects all of them;
the median of the rounds is reported.
"""

from __future__ import annotations

import json
import statistics
import time
from collections.abc import Callable, Iterator
from importlib import import_module
from typing import Any

import click
from rich.table import Table

from companion.option_types import FloatRange
from companion.tables import number_table, print_tables

SERVICES = ("latency", "live")
MODULES = ("bank", "fusion", "minimax", "kalman", "frame", "log")
ROUNDS = 15
ROUND_S = 0.02  # minimum duration of one case in a round


def measure(
    cases: Iterator[tuple[str, Callable[[], object]]], rounds: int = ROUNDS
) -> dict[str, list[float]]:
    """Measure the seconds per call of each case in each round, with the cases interleaved."""
    calls: dict[str, tuple[Callable[[], object], int]] = {}
    for name, call in cases:
        call()
        start = time.perf_counter()
        call()
        calls[name] = call, max(1, round(ROUND_S / max(time.perf_counter() - start, 1e-9)))
    times: dict[str, list[float]] = {name: [] for name in calls}
    for _ in range(rounds):
        for name, (call, repeat) in calls.items():
            start = time.perf_counter()
            for _ in range(repeat):
                call()
            times[name].append((time.perf_counter() - start) / repeat)
    return times


def table(title: str, times: dict[str, list[float]]) -> Table:
    """Build a table of median, minimum and maximum per call, and the slowest median over each median."""
    shown = number_table(title, "case", "median us", "min", "max", "slowest / this")
    medians = {name: statistics.median(values) for name, values in times.items()}
    slowest = max(medians.values())
    for name, values in times.items():
        numbers = (medians[name], min(values), max(values))
        shown.add_row(name, *(f"{1e6 * x:.1f}" for x in numbers), f"{slowest / medians[name]:.1f}")
    return shown


@click.command("bench")
@click.argument("names", nargs=-1, type=click.Choice([*MODULES, *SERVICES]))
@click.option(
    "--json",
    "as_json",
    is_flag=True,
    help="Print JSON: seconds per call, every round; of live a row a process.",
)
@click.option(
    "--flight-s",
    type=FloatRange(1.0, 36_000.0),
    default=20.0,
    show_default=True,
    help="Length of each flight of live, s.",
)
def command(names: tuple[str, ...], as_json: bool, flight_s: float) -> None:
    """Time the parts of the companion, interleaved in one run.

    NAMES are the parts; default: all except latency and live.
    `latency` sends beacon measurements by UDP on the loopback interface to a complete service and waits for
    the corrected estimate; a plain asyncio UDP echo is measured for comparison. `live` gives the share of a
    processor and the memory that a service takes in flight, beside a bare receiver.
    """
    found: dict[str, Any] = {}
    tables = []
    for name in names or MODULES:
        module = import_module(f"companion.bench.{name}")
        if name == "live":
            costs = module.measure(flight_s)
            found[name] = [cost._asdict() for cost in costs]
            tables.append(module.table(costs))
        elif name == "latency":
            found[name] = module.measure()
            tables.append(table(name, found[name]))
        else:
            found[name] = measure(module.cases(), getattr(module, "ROUNDS", ROUNDS))
            tables.append(table(name, found[name]))
    if as_json:
        click.echo(json.dumps(found))
    else:
        print_tables(*tables)
