"""`companion study after-flight`: time and memory of replay and report of a whole flight.

    companion study after-flight                    # an hour of flight; exit code 1 if over the budget

Each command runs in its own process: `companion loopback`, the replay of its log, the report, and the report
of the same log without the truth, which smooths the flight first.
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

from companion.storage import flight_log
from companion.tables import number_table, print_tables
from sitl.scenarios import parse_scenario

#: Processor time of replay and report together, which other programs do not change; memory of each.
BUDGET_S, BUDGET_MIB = 60.0, 1024.0
BUDGET_MB = 1.5  # of the page


class CommandCost(NamedTuple):
    """Cost of one command: wall-clock and processor seconds, peak memory in MiB."""

    what: str
    wall_s: float
    cpu_s: float
    peak_mib: float


#: ru_maxrss of a child includes the memory of its parent at the fork; VmHWM is that of the program alone.
_REPORT_MEMORY = """
import atexit, os, sys
atexit.register(lambda: os.write(int(sys.argv.pop()), open("/proc/self/status", "rb").read()))
from companion.command_line import cli
cli(sys.argv[1:-1])
"""


def measure_command(what: str, arguments: Sequence[str]) -> CommandCost:
    """Run `companion ARGUMENTS` and measure it. Raises CalledProcessError if it fails."""
    read_fd, write_fd = os.pipe()
    command = [sys.executable, "-c", _REPORT_MEMORY, *arguments, str(write_fd)]
    started = time.perf_counter()
    with open(read_fd, "rb") as status:
        try:
            process = subprocess.Popen(command, stdout=subprocess.DEVNULL, pass_fds=(write_fd,))
        finally:
            os.close(write_fd)
        with process:
            lines = status.read().decode().splitlines()  # blocks until the process ends
            _, ended, used = os.wait4(process.pid, 0)
            process.returncode = os.waitstatus_to_exitcode(ended)
    if process.returncode:
        raise subprocess.CalledProcessError(process.returncode, command)
    peak = next(int(line.split()[1]) for line in lines if line.startswith("VmHWM"))
    return CommandCost(what, time.perf_counter() - started, used.ru_utime + used.ru_stime, peak / 1024.0)


def copy_without_truth(whole: Path) -> Path:
    """Copy the log without truth and raw frames to the same folder."""
    blind = whole.with_name("blind.mcap")
    with flight_log.Writer(
        blind, metadata=flight_log.metadata(whole), start_unix_ns=0, start_ns=0, block=True
    ) as log:
        for entry in flight_log.read(whole):
            if entry.topic.startswith(("/in/", "/out/", "/link/")):
                log.record(entry.value, entry.topic)
    return blind


@click.command("after-flight")
@click.option("--scenario", default="hour", show_default=True, help="A loopback scenario.")
def command(scenario: str) -> None:
    """Measure replay and report of one flight.

    Exit code 1 above 60 s of processor time, 1 GiB or a page of 1.5 MB.
    """
    minutes = parse_scenario(scenario).duration_s / 60.0
    with tempfile.TemporaryDirectory() as name:
        flight = measure_command("flight, simulated", ["loopback", "--scenario", scenario, "--logs", name])
        (whole,) = Path(name).glob("*.mcap")
        page = str(whole.with_suffix(".html"))
        costs = [
            measure_command("replay", ["replay", str(whole)]),
            measure_command("report against the truth", ["report", str(whole), "-o", page]),
            measure_command(
                "report against the smoothed track", ["report", str(copy_without_truth(whole)), "-o", page]
            ),
        ]
        size = Path(page).stat().st_size / 1e6
    table = number_table(f"{minutes:.0f} min of flight", "", "s", "s of processor", "peak, MiB")
    for what, *numbers in (flight, *costs):
        table.add_row(what, *(f"{number:.1f}" for number in numbers))
    print_tables(table)
    total = costs[0].cpu_s + max(cost.cpu_s for cost in costs[1:])
    peak = max(cost.peak_mib for cost in costs)
    budget = f"{BUDGET_S:.0f} s, {BUDGET_MIB:.0f} MiB and a page of {BUDGET_MB} MB"
    click.echo(
        f"replay and the more expensive report: {total:.1f} s of processor, {peak:.0f} MiB, {size:.2f} MB; "
        f"budget {budget}"
    )
    if total > BUDGET_S or peak > BUDGET_MIB or size > BUDGET_MB:
        raise SystemExit(1)
