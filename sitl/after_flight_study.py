"""`companion study after-flight`: what replay and report of a whole flight cost here, in time and memory.

    companion study after-flight                    # an hour; exit code 1 if it is over the budget

Each in a process of its own: a scenario flown by `companion loopback`, the replay of its log, the report, and
the report of the same log without the truth, which has to smooth the flight first.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import click
from rich.console import Console
from rich.table import Table

from companion.storage import flight_log
from sitl.scenarios import SCENARIOS

BUDGET_S, BUDGET_MIB = 60.0, 1024.0  # of replay and report together, and of each


class Cost(NamedTuple):
    """Of one command: seconds by the clock and of the processor, and the most memory it held (MiB)."""

    what: str
    wall_s: float
    cpu_s: float
    peak_mib: float


#: The kernel counts to a child what the process that started it held; VmHWM is of the program alone.
_TOLD = """
import atexit, os, sys
atexit.register(lambda: os.write(int(sys.argv.pop()), open("/proc/self/status", "rb").read()))
from companion.__main__ import cli
cli(sys.argv[1:-1])
"""


def run(what: str, arguments: Sequence[str]) -> Cost:
    """Run `companion ARGUMENTS` and watch it. CalledProcessError where it fails."""
    told, tell = os.pipe()
    command = [sys.executable, "-c", _TOLD, *arguments, str(tell)]
    begun = time.perf_counter()
    with open(told, "rb") as status:
        try:
            process = subprocess.Popen(command, stdout=subprocess.DEVNULL, pass_fds=(tell,))
        finally:
            os.close(tell)
        with process:
            lines = status.read().decode().splitlines()  # until it ends
            _, ended, used = os.wait4(process.pid, 0)
            process.returncode = os.waitstatus_to_exitcode(ended)
    if process.returncode:
        raise subprocess.CalledProcessError(process.returncode, command)
    peak = next(int(line.split()[1]) for line in lines if line.startswith("VmHWM"))
    return Cost(what, time.perf_counter() - begun, used.ru_utime + used.ru_stime, peak / 1024.0)


def without_truth(whole: Path) -> Path:
    """The same log beside `whole`, but for the truth and the raw frames."""
    blind = whole.with_name("blind.mcap")
    with flight_log.Writer(
        blind, metadata=flight_log.metadata(whole), start_unix_ns=0, start_ns=0, block=True
    ) as log:
        for entry in flight_log.read(whole):
            if entry.topic.startswith(("/in/", "/out/", "/link/")):
                log.record(entry.value, entry.topic)
    return blind


@click.command("after-flight")
@click.option("--scenario", default="hour", show_default=True, help="One of the loopback's.")
def command(scenario: str) -> None:
    """Measure replay and report of one flight against a minute and 1 GiB. Exit code 1 if they are over."""
    if scenario not in SCENARIOS:
        raise click.BadParameter(f"choose one of {', '.join(SCENARIOS)}", param_hint="--scenario")
    with tempfile.TemporaryDirectory() as name:
        flight = run("flight, simulated", ["loopback", "--scenario", scenario, "--logs", name])
        (whole,) = Path(name).glob("*.mcap")
        page = str(whole.with_suffix(".html"))
        costs = [
            run("replay", ["replay", str(whole)]),
            run("report against the truth", ["report", str(whole), "-o", page]),
            run("report against the smoothed track", ["report", str(without_truth(whole)), "-o", page]),
        ]
    table = Table(title=f"{SCENARIOS[scenario].duration_s / 60.0:.0f} min of flight")
    for column in ("", "s", "s of processor", "peak, MiB"):
        table.add_column(column, justify="right" if column else "left")
    for what, *numbers in (flight, *costs):
        table.add_row(what, *(f"{number:.1f}" for number in numbers))
    Console().print(table)
    total = costs[0].wall_s + max(cost.wall_s for cost in costs[1:])
    peak = max(cost.peak_mib for cost in costs)
    budget = f"{BUDGET_S:.0f} s and {BUDGET_MIB:.0f} MiB"
    click.echo(f"replay and the dearer report: {total:.1f} s, {peak:.0f} MiB of {budget}")
    if total > BUDGET_S or peak > BUDGET_MIB:
        raise SystemExit(1)
