"""`companion campaign`: scenarios x faults x seeds, flown by many workers, in one table with pass or fail.

    companion campaign --seeds 10                                  # a Dask cluster of this machine's cores
    companion campaign --scheduler tcp://...:8786 --seeds 1000     # one that is there already
    companion campaign --workers 0 --fault gnss-spoof-2            # in this process, without Dask
    companion campaign --seeds 40 --report tests/reports/campaign.md

Each flight is one line of `flights.jsonl` in the results folder, written by this process as it comes in. What
is there is not flown again, so that a campaign cut short goes on where it was; a flight whose worker died is
flown by another one, and where one after the other died under it, by the next campaign. It knows nothing of
what a flight is: `sitl.campaign.flight` does.
"""

from __future__ import annotations

import itertools
import json
import os
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import click
import numpy as np
from rich.console import Console
from rich.progress import MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn
from rich.table import Table

from companion.optional_dependencies import lacking
from sitl.campaign.flight import KINDS, SCENARIOS, Order, Result, attempt, by_records, matters

RETRIES = 3  # workers that may die under one flight before it counts as failed
LOST = "worker lost"
EX_FAILED = 1
HEADS = (
    *("fault", "flights", "detected", "median", "slowest", "excluded", "largest before", "largest"),
    *("misleading", "beyond", "wrong", "alarms/h", "bound held", "raised", "harmful", "passed"),
)


class Limits(NamedTuple):
    """What a campaign must keep to pass."""

    harmless_m: float = 300.0  # a fault not detected may do no more than this
    misleading: float = 1e-5  # share of flights with an error beyond the protection level, unflagged
    alarms_per_hour: float = 0.1


class Line(NamedTuple):
    """All flights of one kind of fault. Times s, errors m; None where nothing was detected or predicted."""

    fault: str
    flights: int
    detected: int
    median_s: float | None
    slowest_s: float | None
    excluded: int
    before_m: float
    largest_m: float
    misleading: int
    beyond: int
    wrong: int
    alarms_per_hour: float
    bound_held: bool | None
    raised: int
    harmful: int
    passed: bool


def orders(scenarios: Iterable[str], faults: Iterable[str], seeds: int) -> list[Order]:
    """Every flight, the seeds outermost: a campaign cut short has seen a little of everything.

    A fault of the link or of the autopilot, and lateness, care for no grade and no beacon: they are flown in
    the first scenario only; and none is flown where there is nothing that it concerns.
    """
    names, kinds = list(scenarios), list(faults)
    every = itertools.product(range(1, seeds + 1), names, kinds)
    once = {f for f in kinds if not by_records(f) or f.endswith("-late")}
    return [
        Order(s, f, seed)
        for seed, s, f in every
        if (s == names[0] or f not in once) and (matters(s, f) or len(names) == 1)
    ]


def stored(path: Path) -> list[Result]:
    """The results in a file; a last line that was torn off is cut away, so that what follows is whole."""
    if not path.exists():
        return []
    data = path.read_bytes()
    whole = data[: data.rfind(b"\n") + 1]
    if len(whole) < len(data):
        os.truncate(path, len(whole))
    try:
        return [Result(**json.loads(line)) for line in whole.splitlines()]
    except (ValueError, TypeError) as error:
        raise ValueError(f"{path}: a line is no result of a flight ({error}); name another folder") from None


def run(todo: Sequence[Order], scheduler: str | None, workers: int) -> Iterator[Result]:
    """Every flight's result as it comes: in this process if `workers` is 0 and there is no scheduler."""
    if scheduler is None and workers == 0:
        yield from map(attempt, todo)
        return
    try:
        from dask.distributed import Client, LocalCluster, as_completed
    except ImportError:
        without = "or fly with --workers 0"
        raise ValueError(f"{lacking('a campaign by many workers', 'Dask', 'campaign')}, {without}") from None
    cluster = None
    if scheduler is None:
        cluster = LocalCluster(n_workers=workers, threads_per_worker=1, dashboard_address="127.0.0.1:0")
    with Client(scheduler or cluster) as client:
        flown = {
            client.submit(attempt, order, key=order.key, retries=RETRIES, pure=False): order for order in todo
        }
        for future in as_completed(flown):
            if future.status == "finished":
                yield future.result()
            else:
                raised = f"{LOST}: {future.exception()}"
                yield Result(flown[future].key, *flown[future], 0.0, 0.0, raised=raised)
            future.release()
    if cluster is not None:
        cluster.close()


def campaign(
    wanted: Sequence[Order], folder: Path, scheduler: str | None = None, workers: int = 0, quiet: bool = False
) -> list[Result]:
    """Fly what `folder` does not have yet, and return the results of all wanted flights."""
    folder.mkdir(parents=True, exist_ok=True)
    path, keys = folder / "flights.jsonl", {order.key for order in wanted}
    known = {result.key: result for result in stored(path) if result.key in keys}
    todo = [order for order in wanted if order.key not in known]
    columns = TextColumn("{task.description}"), MofNCompleteColumn(), TimeRemainingColumn()
    with (
        path.open("ab") as file,
        Progress(*columns, console=Console(stderr=True), transient=True, disable=quiet) as progress,
    ):
        task = progress.add_task("flights", total=len(wanted), completed=len(known))
        for result in run(todo, scheduler, workers):
            if not (result.raised or "").startswith(LOST):
                file.write(json.dumps(result._asdict()).encode() + b"\n")
                file.flush()
                os.fsync(file.fileno())
            known[result.key] = result
            progress.update(task, advance=1, description=result.key)
    return [known[order.key] for order in wanted]


def table(results: Sequence[Result], limits: Limits) -> list[Line]:
    """One line a fault, in the order in which they first come."""
    faults = dict.fromkeys(result.fault for result in results)
    return [_line(fault, [r for r in results if r.fault == fault], limits) for fault in faults]


def _line(fault: str, flights: list[Result], limits: Limits) -> Line:
    times = [r.detected_s for r in flights if r.detected_s is not None]
    misleading = sum(r.misleading_s >= 1.0 for r in flights)
    raised = sum(r.raised is not None for r in flights)
    harmful = sum((r.largest_m if r.detected_s is None else r.normal_m) > limits.harmless_m for r in flights)
    hours = sum(r.quiet_s for r in flights) / 3600.0
    alarms = sum(r.alarms for r in flights) / hours if hours else 0.0
    predicted = [(r.rms_error, r.rms_bound) for r in flights if r.rms_error is not None and r.rms_bound]
    held = None
    if predicted:
        error, bound = np.sqrt(np.mean(np.square(np.array(predicted, dtype=float)), axis=0))
        held = bool(error <= bound)
    passed = (
        not raised
        and not harmful
        and misleading <= limits.misleading * len(flights)
        and alarms <= limits.alarms_per_hour
    )
    return Line(
        fault,
        len(flights),
        len(times),
        float(np.median(times)) if times else None,
        max(times, default=None),
        sum(r.excluded_s is not None for r in flights),
        max(r.before_m for r in flights),
        max(r.largest_m for r in flights),
        misleading,
        sum(r.beyond_s >= 1.0 for r in flights),
        sum(r.wrong > 0 for r in flights),
        alarms,
        held,
        raised,
        harmful,
        passed,
    )


def show(lines: Sequence[Line], limits: Limits, console: Console) -> None:
    """Print the table."""
    flights, failed = sum(line.flights for line in lines), sum(not line.passed for line in lines)
    grid = Table(title=f"{flights} flights; horizontal errors in m, times to detect in s")
    for head in HEADS:
        grid.add_column(head, justify="left" if head == "fault" else "right", no_wrap=head == "fault")
    for line in lines:
        grid.add_row(*(_cell(value) for value in line))
    console.print(grid)
    console.print(f"{_meaning(limits)} {len(lines) - failed} of {len(lines)} did.", soft_wrap=True)


def report(results: Sequence[Result], limits: Limits, made_by: str) -> str:
    """The tables of all scenarios as Markdown; `made_by` is the command that makes them again."""
    scenarios = dict.fromkeys(result.scenario for result in results)
    quiet = sum(r.quiet_s for r in results) / 3600.0
    text = [
        "# Campaign",
        "",
        f"{len(results)} flights of {min(r.flown_s for r in results) / 60.0:.0f} minutes or longer, by",
        "",
        f"    {made_by}",
        "",
        "Horizontal errors in m, times to detect in s. " + _meaning(limits),
        f"{sum(r.alarms for r in results)} false alarms in {quiet:.1f} h of flight before the faults;"
        f" {sum(r.misleading_s >= 1.0 for r in results)} flights misled.",
    ]
    for scenario in scenarios:
        lines = table([r for r in results if r.scenario == scenario], limits)
        rows = [
            HEADS,
            ("-" * 3,) + ("--:",) * (len(HEADS) - 1),
            *([_cell(v) for v in line] for line in lines),
        ]
        text += ["", f"## {scenario}", "", *("| " + " | ".join(row) + " |" for row in rows)]
    return "\n".join(text) + "\n"


def _meaning(limits: Limits) -> str:
    return (
        f"passed: no exception; an undetected fault never more than {limits.harmless_m:g} m off, nor a"
        " detected one while trust is normal; misleading (beyond the protection level, unflagged) in at most"
        f" {limits.misleading:g} of the flights; at most {limits.alarms_per_hour:g} false alarms an hour."
        " beyond: flights beyond the protection level though flagged; wrong: another source was excluded too."
    )


def _cell(value: Any) -> str:
    if value is None:
        return "-"
    if isinstance(value, bool):
        return "yes" if value else "NO"
    return f"{value:.1f}" if isinstance(value, float) else str(value)


@click.command("campaign")
@click.option(
    "--scenario", "scenarios", multiple=True, type=click.Choice(list(SCENARIOS)), help="All without it."
)
@click.option("--fault", "faults", multiple=True, type=click.Choice(list(KINDS)), help="All without it.")
@click.option("--seeds", type=click.IntRange(1), default=1, show_default=True, help="Noises for each.")
@click.option("--results", type=click.Path(path_type=Path, file_okay=False), default=Path("logs/campaign"))
@click.option("--scheduler", help="Address of a Dask scheduler; a cluster of this machine without it.")
@click.option("--workers", type=click.IntRange(0), default=os.cpu_count() or 1, help="0: in this process.")
@click.option("--harmless-m", type=float, default=Limits().harmless_m, show_default=True)
@click.option("--misleading", type=float, default=Limits().misleading, show_default=True)
@click.option("--alarms-per-hour", type=float, default=Limits().alarms_per_hour, show_default=True)
@click.option("--report", "page", type=click.Path(path_type=Path), help="Write the tables to this .md file.")
@click.option("--json", "as_json", is_flag=True, help="Print JSON.")
def command(
    scenarios: tuple[str, ...],
    faults: tuple[str, ...],
    seeds: int,
    results: Path,
    scheduler: str | None,
    workers: int,
    harmless_m: float,
    misleading: float,
    alarms_per_hour: float,
    page: Path | None,
    as_json: bool,
) -> None:
    """Fly every scenario with every fault and many seeds, and say what was detected, and how far off it led.

    Ends with 1 where a limit was passed.
    """
    limits = Limits(harmless_m, misleading, alarms_per_hour)
    wanted = orders(scenarios or SCENARIOS, faults or KINDS, seeds)
    try:
        flown = campaign(wanted, results, scheduler, workers)
        if page is not None:
            asked = [
                f"--{name} {value}"
                for name, many in (("scenario", scenarios), ("fault", faults))
                for value in many
            ]
            made_by = " ".join(["companion campaign", *asked, f"--seeds {seeds} --report {page}"])
            page.parent.mkdir(parents=True, exist_ok=True)
            page.write_text(report(flown, limits, made_by))
    except (ValueError, OSError) as error:
        raise SystemExit(f"companion: {error}") from None
    lines = table(flown, limits)
    if as_json:
        click.echo(json.dumps([line._asdict() for line in lines]))
    else:
        show(lines, limits, Console(width=max(150, Console().width)))
    if not all(line.passed for line in lines):
        raise SystemExit(EX_FAILED)
