"""`companion fleet FOLDER...`: assessment of logs, a Parquet table with one row a flight, a summary page.

    companion fleet logs --results fleet                         # a Dask cluster of this machine's cores
    companion fleet logs --scheduler tcp://...:8786              # an existing cluster
    companion fleet logs --workers 0                             # in this process, without Dask

Every finished log is one line in `logs.jsonl` in the results folder: an interrupted run continues, and only
new or changed logs are read. A log that cannot be read is a row with its reason. `flights.parquet` has all
rows, `index.html` lists the worst flights first, with links to the reports of the worst.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, NamedTuple, get_args, get_type_hints

import click
from rich.progress import Progress

from companion.analysis import error_statistics
from companion.analysis.assessment import Assessment, assess_flight
from companion.analysis.fleet_page import render_page
from companion.analysis.flights import open_flights
from companion.analysis.html import BOOTED_NS, render_report
from companion.analysis.jobs import Journal, run_jobs
from companion.analysis.progress import show_count
from companion.analysis.replay_inputs import has_navigator_outputs, is_own_log
from companion.analysis.report import blocks_of_log
from companion.analysis.summary import longest_outage, rms_after_start, worst_of
from companion.analysis.verdict import judge_flight
from companion.analysis.worker_options import worker_options
from companion.config import Config, load, to_toml
from companion.importers.foreign_file import one_line
from companion.option_types import INPUT_PATH
from companion.optional_dependencies import first_missing, missing_package
from companion.printable import printable
from companion.records import Severity
from companion.storage.reader import LogError
from companion.write_errors import make_folder, write_whole

SUFFIXES = (".mcap", ".tlog", ".bin", ".ulg", ".ulog", ".log")
TABLE, PAGE, JOURNAL, REPORTS = "flights.parquet", "index.html", "logs.jsonl", "reports"


class FlightRow(NamedTuple):
    """One row of the table. Errors are horizontal, relative to `reference`; None where they are not known."""

    log: str
    flight: int = 0  # of `flights` in the log
    flights: int = 0
    verdict: str | None = None  # Good, Caution or Fault, as in the report
    verdict_reason: str | None = None  # in one sentence
    start_utc: str | None = None
    duration_s: float = 0.0
    solutions: int = 0
    gnss_outage_s: float = 0.0  # the longest; the duration if GNSS never had a fix
    reference: str | None = None
    rms_m: float | None = None
    largest_m: float | None = None
    ins_largest_m: float | None = None
    phases_held: int = 0  # phases whose error was within the guaranteed bound, of `phases_bound`
    phases_bound: int = 0
    rejections: int = 0
    warnings: int = 0
    reason: str | None = None  # why the log could not be assessed
    report: str | None = None  # file name in the results folder


class LogJob(NamedTuple):
    """A log to assess, and where to write its report (None: nowhere)."""

    path: Path
    config: Config
    report: Path | None = None


def find_logs(folders: Sequence[Path], results: Path) -> list[Path]:
    """Return the logs in the folders and their subfolders, sorted; not those in the folder of the results."""
    own = Path(os.path.realpath(results))
    found = {
        path.resolve()
        for folder in folders
        for path in ([folder] if folder.is_file() else folder.rglob("*"))
        if (path.suffix.lower() in SUFFIXES or is_own_log(path)) and path.is_file()
    }
    return sorted(path for path in found if own not in path.parents)


def log_key(path: Path, config_digest: str) -> str:
    """Return a key that changes when the log or the configuration does."""
    status = path.stat()
    return f"{path}|{status.st_size}|{status.st_mtime_ns}|{config_digest}"


def assess_log(job: LogJob) -> list[FlightRow]:
    """Return the rows of a log: one a flight, or one with the reason why there is none. Never raises."""
    name = str(job.path)
    try:
        return [_row(name, assess_flight(flight)) for flight in open_flights(job.path, job.config)]
    except Exception as error:  # one log must not end the assessment of thousands
        text = str(error) if isinstance(error, LogError) else one_line(error)
        return [FlightRow(name, reason=text.removeprefix(f"{name}: ").removeprefix(f"{name} "))]


def _row(name: str, a: Assessment) -> FlightRow:
    corrected = a.errors.get(error_statistics.CORRECTED)
    ins = a.errors.get(error_statistics.INS)
    held = [row.held for row in a.rows if row.held is not None]
    verdict = judge_flight(a)
    start = datetime.fromtimestamp(a.flight.unix_ns * 1e-9, UTC) if a.flight.unix_ns > BOOTED_NS else None
    return FlightRow(
        log=name,
        flight=a.flight.part[0],
        flights=a.flight.part[1],
        verdict=verdict.word,
        verdict_reason=verdict.reason,
        start_utc=None if start is None else start.isoformat(timespec="seconds"),
        duration_s=round(a.flight.seconds, 3),
        solutions=len(a.flight.tables["Solution"]["t"]),
        gnss_outage_s=round(longest_outage(a), 3),
        reference=a.reference and a.reference.what,
        rms_m=rms_after_start(a, error_statistics.CORRECTED),
        largest_m=None if corrected is None else worst_of(a).estimate,
        ins_largest_m=None if ins is None else float(ins.error.max()),
        phases_held=sum(held),
        phases_bound=len(held),
        rejections=len(a.flight.rejections),
        warnings=sum(e.kind == "event" and e.severity <= Severity.WARNING for e in a.flight.log_entries),
    )


def write_report(job: LogJob) -> str:
    """Write the report of a log; return why it could not be written, "" if it was."""
    assert job.report is not None
    try:
        page = render_report(job.path.name, blocks_of_log(open_flights(job.path, job.config)))
        write_whole(job.report, page.encode(errors="replace"))
    except Exception as error:
        return one_line(error)
    return ""


def worst_first(rows: Sequence[FlightRow]) -> list[FlightRow]:
    """Sort: the largest error first, then flights without a known error, then logs that cannot be read."""
    return sorted(
        rows, key=lambda row: (row.reason is not None, -(row.largest_m or 0.0), row.log, row.flight)
    )


def _is_flown(path: Path) -> bool:
    """Whether a log is assessed as flown, or cannot be read: the configuration has no effect on it."""
    try:
        return has_navigator_outputs(path)
    except OSError:
        return True


class Fleet:
    """A run over many logs with its results folder."""

    def __init__(self, results: Path, config: Config, scheduler: str | None, workers: int) -> None:
        try:
            make_folder(results)
        except OSError as error:
            raise LogError(f"cannot keep results in {results}: {error.strerror}: give --results") from None
        self._results, self._config = results, config
        self._config_digest = _digest(to_toml(config))
        self._scheduler, self._workers = scheduler, workers
        self._journal = Journal(results / JOURNAL)

    def assess(self, logs: Sequence[Path], progress: Progress) -> list[FlightRow]:
        """Assess the logs that are new or changed; return the rows of all of them."""
        keys = {log_key(path, self._config_digest): path for path in logs}
        found = {entry["key"]: entry["rows"] for entry in self._journal.entries if entry["key"] in keys}
        known = {key: rows for key, rows in found.items() if all(map(_is_current, rows))}
        if old := len(found) - len(known):
            click.echo(
                f"companion: {self._journal.path}: {old} of {len(keys)} logs were assessed by another"
                " version, with other columns: they are assessed again",
                err=True,
            )
        todo = {key: LogJob(path, self._config) for key, path in keys.items() if key not in known}
        task = progress.add_task("logs", total=len(keys), completed=len(known))
        rows = [FlightRow(**row) for rows in known.values() for row in rows]
        for done in run_jobs(assess_log, todo, self._scheduler, self._workers, "fleet"):
            if done.failure:  # not in the journal: the next run tries again
                rows.append(FlightRow(str(keys[done.key]), reason=done.failure))
            else:
                self._journal.append({"key": done.key, "rows": [row._asdict() for row in done.result]})
                rows += done.result
            progress.update(task, advance=1)
        return rows

    def report(self, rows: Sequence[FlightRow], count: int, progress: Progress) -> list[FlightRow]:
        """Write the reports of the worst `count` logs that have none; return the rows with their names."""
        worst = list(dict.fromkeys(row.log for row in worst_first(rows) if row.reason is None))[:count]
        folder = self._results / REPORTS
        folder.mkdir(exist_ok=True)
        digests = {log: _digest(log_key(Path(log), self._config_digest)) for log in worst}
        names = {log: f"{_safe(Path(log).stem)}-{digest}.html" for log, digest in digests.items()}
        jobs = {
            f"report {log}": LogJob(Path(log), self._config, (folder / name).resolve())
            for log, name in names.items()
            if not (folder / name).exists()
        }
        task = progress.add_task("reports", total=len(jobs))
        for _ in run_jobs(write_report, jobs, self._scheduler, self._workers, "fleet"):
            progress.update(task, advance=1)
        written = {log: f"{REPORTS}/{name}" for log, name in names.items() if (folder / name).exists()}
        return [row._replace(report=written.get(row.log)) for row in rows]


def _is_current(row: Mapping[str, Any]) -> bool:
    """Whether a row of the journal has the columns of this version."""
    return row.keys() == set(FlightRow._fields)


def _digest(text: str) -> str:
    return hashlib.sha256(text.encode(errors="replace")).hexdigest()[:10]


def _safe(name: str) -> str:
    return "".join(c if c.isascii() and c.isalnum() else "_" for c in name)[:80]


def write_table(rows: Sequence[FlightRow], path: Path) -> None:
    """Write the rows as Parquet; the file is replaced at once."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    kinds = {str: pa.string(), int: pa.int64(), float: pa.float64()}
    hints = {name: [*get_args(hint), hint][0] for name, hint in get_type_hints(FlightRow).items()}
    schema = pa.schema([(name, kinds[hint]) for name, hint in hints.items()])
    values = [{name: _storable(value) for name, value in row._asdict().items()} for row in rows]
    table = pa.BufferOutputStream()
    pq.write_table(pa.Table.from_pylist(values, schema=schema), table)
    write_whole(path, table.getvalue())


def _storable(value: Any) -> Any:
    return value.encode(errors="replace").decode() if isinstance(value, str) else value


@click.command("fleet")
@click.argument("folders", type=click.Path(path_type=Path, exists=True), nargs=-1, required=True)
@click.option(
    "-o",
    "--results",
    type=click.Path(path_type=Path, file_okay=False),
    default=Path("fleet"),
    show_default=True,
    help="Folder to write to.",
)
@worker_options
@click.option(
    "--reports", type=click.IntRange(0), default=20, show_default=True, help="Write this many reports."
)
@click.option(
    "--config",
    "config_file",
    type=INPUT_PATH,
    help="Configuration for the logs of other recorders.",
)
def command(
    folders: tuple[Path, ...],
    results: Path,
    scheduler: str | None,
    workers: int,
    reports: int,
    config_file: Path | None,
) -> None:
    """Assess all logs in FOLDERS, the worst flights first.

    Writes one row a flight to RESULTS/flights.parquet, and a summary page.
    Logs that were assessed before are not read again. A log that cannot be read is a row with its reason.
    Exit code 1 if no log could be read.
    """
    logs = find_logs(folders, results)
    if not logs:
        raise LogError(f"{', '.join(map(str, folders))}: no logs ({', '.join(SUFFIXES)})")
    if config_file and all(map(_is_flown, logs)):
        raise LogError(
            f"--config {config_file} has no effect: all logs are our own, assessed as flown; replay them:"
            f" companion replay LOG --config {config_file} -o REPLAY.mcap, then assess the replays"
        )
    if (package := first_missing("pyarrow", "jinja2")) is not None:
        raise LogError(missing_package("a table of flights", package, "fleet"))
    config = load(config_file)
    try:
        fleet = Fleet(results, config, scheduler, workers)
        with show_count() as progress:
            rows = fleet.report(fleet.assess(logs, progress), reports, progress)
    except ValueError as error:
        raise LogError(str(error)) from None
    rows = worst_first(rows)
    write_table(rows, results / TABLE)
    write_whole(results / PAGE, render_page(rows).encode(errors="replace"))
    good = [row for row in rows if row.reason is None]
    hours = sum(row.duration_s for row in good) / 3600.0
    click.echo(
        f"{len(logs)} logs: {len(good)} flights of {hours:.1f} h, {len(rows) - len(good)} not readable"
    )
    for row in good[:5]:
        worst = (
            "no reference" if row.largest_m is None else f"at most {row.largest_m:.1f} m from {row.reference}"
        )
        click.echo(f"  {printable(row.log)}: {row.verdict}, {worst}")
    for row in [row for row in rows if row.reason is not None][:5]:
        click.echo(f"  {printable(row.log)}: {printable(row.reason or '')}")
    click.echo(f"written: {results / TABLE}, {results / PAGE}")
    if not good:
        raise SystemExit(1)
