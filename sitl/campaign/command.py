"""`companion campaign`: scenarios x faults x seeds, flown in parallel, in one table with pass or fail.

    companion campaign --seeds 10                                  # a Dask cluster of this machine's cores
    companion campaign --scheduler tcp://...:8786 --seeds 1000     # an existing cluster
    companion campaign --workers 0 --fault gnss-spoof-2            # in this process, without Dask
    companion campaign --seeds 40 --report tests/reports/campaign.md

This process appends one line per finished flight to `flights.jsonl` in the results folder. Stored flights are
not repeated, so an interrupted campaign continues. A flight whose worker died is retried by another worker,
and after several failures by the next campaign. The flights themselves are defined in `sitl.campaign.flight`,
the distribution of work in `companion.analysis.jobs`.
"""

from __future__ import annotations

import itertools
import json
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import click
import numpy as np

from companion.analysis.jobs import WORKER_LOST, Journal, run_jobs
from companion.analysis.progress import show_count
from companion.analysis.worker_options import worker_options
from companion.option_types import FloatRange
from companion.tables import number_table, print_tables
from sitl.campaign.flight import (
    FAULT_CASES,
    SCENARIOS,
    FlightOrder,
    FlightResult,
    fly_order,
    is_applicable,
    is_sensor_fault,
)

HEADS = (
    *("fault", "flights", "detected", "median", "slowest", "excluded", "largest before", "largest"),
    *("misleading", "beyond", "wrong", "alarms/h", "bound held", "raised", "harmful", "passed"),
)


class CampaignLimits(NamedTuple):
    """Limits that a fault has to meet to pass."""

    harmless_m: float = 300.0  # largest error under an undetected fault
    misleading: float = 1e-5  # share of flights with an error beyond the protection level, unflagged
    alarms_per_hour: float = 0.1


class FaultSummary(NamedTuple):
    """Summary of all flights with one fault. Times s, errors m; None: nothing detected or predicted."""

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


def list_orders(scenarios: Iterable[str], faults: Iterable[str], seeds: int) -> list[FlightOrder]:
    """List the flights, seeds outermost: an interrupted campaign has covered all cases.

    A fault is not flown in a scenario without the sensor that it concerns. Faults of the link and of the
    autopilot and delays do not depend on grade and beacons: they are flown in the first of the others only.
    """
    names, kinds = list(dict.fromkeys(scenarios)), list(dict.fromkeys(faults))
    concerned = {f: [s for s in names if is_applicable(s, f)] for f in kinds}
    for f in kinds:
        if not is_sensor_fault(f) or f.endswith("-late"):
            del concerned[f][1:]
    every = itertools.product(range(1, seeds + 1), names, kinds)
    return [FlightOrder(s, f, seed) for seed, s, f in every if s in concerned[f]]


def results_in(journal: Journal) -> list[FlightResult]:
    """Return the results of a journal. Raises ValueError if it has others."""
    try:
        return [FlightResult(**entry) for entry in journal.entries]
    except TypeError as error:
        raise journal.invalid(error) from None


def fly_orders(todo: Sequence[FlightOrder], scheduler: str | None, workers: int) -> Iterator[FlightResult]:
    """Fly and yield each result when it is finished; in this process with 0 workers and no scheduler."""
    orders = {order.key: order for order in todo}
    for done in run_jobs(fly_order, orders, scheduler, workers, "campaign"):
        if done.failure:
            yield FlightResult(done.key, *orders[done.key], 0.0, raised=done.failure)
        else:
            yield done.result


def run_campaign(
    wanted: Sequence[FlightOrder], folder: Path, scheduler: str | None = None, workers: int = 0
) -> list[FlightResult]:
    """Fly the flights without a result in `folder`; return the results of all wanted flights."""
    folder.mkdir(parents=True, exist_ok=True)
    journal, keys = Journal(folder / "flights.jsonl"), {order.key for order in wanted}
    known = {result.key: result for result in results_in(journal) if result.key in keys}
    todo = [order for order in wanted if order.key not in known]
    with show_count() as progress:
        task = progress.add_task("flights", total=len(wanted), completed=len(known))
        for result in fly_orders(todo, scheduler, workers):
            if not (result.raised or "").startswith(WORKER_LOST):
                journal.append(result._asdict())
            known[result.key] = result
            progress.update(task, advance=1, description=result.key)
    return [known[order.key] for order in wanted]


def summarise(results: Sequence[FlightResult], limits: CampaignLimits) -> list[FaultSummary]:
    """Summarise the results by fault, in order of first appearance."""
    faults = dict.fromkeys(result.fault for result in results)
    return [_summarise_fault(fault, [r for r in results if r.fault == fault], limits) for fault in faults]


def _summarise_fault(fault: str, flights: list[FlightResult], limits: CampaignLimits) -> FaultSummary:
    times = [r.detected_s for r in flights if r.detected_s is not None]
    misleading = sum(r.misleading_s >= 1.0 for r in flights)
    raised = sum(r.raised is not None for r in flights)
    leaves_gnss = fault.startswith("beacon-")  # which is healthy: then no error is excused
    harmful = sum(
        (r.largest_m if leaves_gnss or r.detected_s is None else r.normal_m) > limits.harmless_m
        for r in flights
    )
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
    return FaultSummary(
        fault,
        flights=len(flights),
        detected=len(times),
        median_s=float(np.median(times)) if times else None,
        slowest_s=max(times, default=None),
        excluded=sum(r.excluded_s is not None for r in flights),
        before_m=max(r.before_m for r in flights),
        largest_m=max(r.largest_m for r in flights),
        misleading=misleading,
        beyond=sum(r.beyond_s >= 1.0 for r in flights),
        wrong=sum(r.wrong > 0 for r in flights),
        alarms_per_hour=alarms,
        bound_held=held,
        raised=raised,
        harmful=harmful,
        passed=passed,
    )


def print_table(lines: Sequence[FaultSummary], limits: CampaignLimits) -> None:
    """Print the table."""
    flights, passed = sum(line.flights for line in lines), sum(line.passed for line in lines)
    table = number_table(f"{flights} flights; horizontal errors in m, times to detect in s", *HEADS)
    for line in lines:
        table.add_row(*(_cell(value) for value in line))
    print_tables(table)
    click.echo(f"{_explain_limits(limits)} {passed} of {len(lines)} passed.")


def markdown_report(results: Sequence[FlightResult], limits: CampaignLimits, made_by: str) -> str:
    """Return the tables of all scenarios as Markdown; `made_by` is the command that reproduces them."""
    scenarios = dict.fromkeys(result.scenario for result in results)
    quiet = sum(r.quiet_s for r in results) / 3600.0
    text = [
        "# Campaign",
        "",
        f"{len(results)} flights of at least {min(r.flown_s for r in results) / 60.0:.0f} minutes, by",
        "",
        f"    {made_by}",
        "",
        "Horizontal errors in m, times to detect in s. " + _explain_limits(limits),
        f"{sum(r.alarms for r in results)} false alarms in {quiet:.1f} h of flight before the faults;"
        f" {sum(r.misleading_s >= 1.0 for r in results)} flights with misleading information.",
    ]
    for scenario in scenarios:
        lines = summarise([r for r in results if r.scenario == scenario], limits)
        rows = [
            HEADS,
            ("-" * 3,) + ("--:",) * (len(HEADS) - 1),
            *([_cell(v) for v in line] for line in lines),
        ]
        text += ["", f"## {scenario}", "", *("| " + " | ".join(row) + " |" for row in rows)]
    return "\n".join(text) + "\n"


def _explain_limits(limits: CampaignLimits) -> str:
    return (
        f"passed: no exception; error at most {limits.harmless_m:g} m while the fault is undetected or trust"
        " is normal, and always where a beacon is at fault; misleading (error above the protection level, not"
        f" flagged) in at most {limits.misleading:g} of the flights; at most {limits.alarms_per_hour:g} false"
        " alarms per hour."
        " beyond: flights with an error above the protection level, flagged; wrong: flights in which another"
        " source was excluded."
    )


def _cell(value: Any) -> str:
    if value is None:
        return "-"
    if isinstance(value, bool):
        return "yes" if value else "NO"
    return f"{value:.1f}" if isinstance(value, float) else str(value)


@click.command("campaign")
@click.option(
    "--scenario", "scenarios", multiple=True, type=click.Choice(list(SCENARIOS)), help="Default: all."
)
@click.option("--fault", "faults", multiple=True, type=click.Choice(list(FAULT_CASES)), help="Default: all.")
@click.option(
    "--seeds",
    type=click.IntRange(1, 10_000),
    default=1,
    show_default=True,
    help="Seeds per scenario and fault.",
)
@click.option(
    "-o",
    "--results",
    type=click.Path(path_type=Path, file_okay=False),
    default=Path("logs/campaign"),
    show_default=True,
    help="Folder; flights with a result in it are not repeated.",
)
@worker_options
@click.option(
    "--harmless-m",
    type=FloatRange(0.0),
    default=CampaignLimits().harmless_m,
    show_default=True,
    help="Limit of the error while a fault is undetected or trust is normal [m].",
)
@click.option(
    "--misleading",
    type=FloatRange(0.0),
    default=CampaignLimits().misleading,
    show_default=True,
    help="Limit of the share of flights with an error above the protection level, not flagged.",
)
@click.option(
    "--alarms-per-hour",
    type=FloatRange(0.0),
    default=CampaignLimits().alarms_per_hour,
    show_default=True,
    help="Limit of the false alarms per hour.",
)
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
    """Fly every scenario with every fault and many seeds.

    Tabulates detection times and position errors. Exit code 1 if a limit is exceeded.
    """
    if page is not None and (page.suffix != ".md" or page.is_dir()):
        raise click.UsageError(f"--report {page}: the tables are Markdown: give a file that ends with .md")
    limits = CampaignLimits(harmless_m, misleading, alarms_per_hour)
    wanted = list_orders(scenarios or SCENARIOS, faults or FAULT_CASES, seeds)
    if not wanted:
        raise click.UsageError("no flight: the scenarios do not have the sensor that the faults concern")
    try:
        flown = run_campaign(wanted, results, scheduler, workers)
        if page is not None:
            options = [
                f"--{name} {value}"
                for name, many in (("scenario", scenarios), ("fault", faults))
                for value in many
            ]
            options += [
                f"--{name.replace('_', '-')} {value}"
                for name, value in limits._asdict().items()
                if value != CampaignLimits._field_defaults[name]
            ]
            made_by = " ".join(["companion campaign", *options, f"--seeds {seeds} --report {page}"])
            page.parent.mkdir(parents=True, exist_ok=True)
            page.write_text(markdown_report(flown, limits, made_by))
    except ValueError as error:
        raise SystemExit(f"companion: {error}") from None
    lines = summarise(flown, limits)
    if as_json:
        click.echo(json.dumps([line._asdict() for line in lines]))
    else:
        print_table(lines, limits)
    if not all(line.passed for line in lines):
        raise SystemExit(1)
