"""Inputs for a replay with changes: simulated beacons, simulated outages, changed configuration keys.

Opens any log, ours or another recorder's, for its inputs only; `replay` runs the navigator over them.
"""

from __future__ import annotations

import heapq
import re
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

import msgspec
from msgspec import structs

from companion.analysis import simulated_rsbn
from companion.config import Config, ConfigError, load
from companion.importers import corrector_csv, sources
from companion.records import Stamped
from companion.storage import flight_log
from companion.storage.reader import ACTIVE, LogError
from companion.storage.run_metadata import logged_configuration

CONVERTED = "converted"  # metadata record of a converted log; its key is `from`
DERIVED = "derived"  # metadata record of a log that replay or smooth made; its keys are `by` and `from`


def apply_changes(config: Config, text: str) -> Config:
    """Return `config` with the changes KEY=VALUE,... applied.

    KEY is SECTION.KEY, or KEY alone if only one section has it, or `estimator` for estimator.output. Raises
    ConfigError, one sentence, if a key or value is invalid, or the result is inconsistent.
    """
    changes = [pair.partition("=") for pair in re.split(r",(?=[A-Za-z_.]+=)", text)]
    changed = [(_full_name(name.strip()), value) for name, _, value in changes]
    names = {name for name, _ in changed}
    kept = [
        (f"{section}.{key}", msgspec.json.encode(value).decode())
        for section in config.__struct_fields__
        for key, value in structs.asdict(getattr(config, section)).items()
        if f"{section}.{key}" not in names
    ]
    pairs = [f"{name}={value}" for name, value in kept + changed]
    try:
        return load(environment={}, pairs=pairs)
    except ConfigError as error:
        raise ConfigError(str(error).replace("--set", "--with")) from None


def choose_configuration(log: Path, config_file: Path | None, changes: Sequence[str]) -> Config:
    """Load the configuration in `config_file`, or that of our own log, or the default, with `changes`."""
    config = load(config_file) if config_file or not is_own_log(log) else logged_configuration(log)
    return apply_changes(config, ",".join(changes)) if changes else config


def _full_name(name: str) -> str:
    if "." in name:
        return name
    if name == "estimator":
        return "estimator.output"
    sections = [section for section in Config.__struct_fields__ if hasattr(getattr(Config(), section), name)]
    if len(sections) == 1:
        return f"{sections[0]}.{name}"
    why = f"sections {', '.join(sections)} all have this key" if sections else "no section has this key"
    raise ConfigError(f"--with {name}: {why}; write it as SECTION.KEY=VALUE, for example gnss.sigma_m=3.0")


class CorrectorRows:
    """Rows of corrector tables (CSV) for a log whose first record arrived at `start_ns`, t_s = 0."""

    def __init__(self, tables: Sequence[Path], start_ns: int) -> None:
        self._tables = {table: corrector_csv.read_correctors(table, start_ns) for table in tables}
        self._start_ns = self._end_ns = start_ns

    def merged(self, records: Iterable[Stamped]) -> Iterator[Stamped]:
        """Yield the records of the log and the rows by time; leave out rows outside the log."""
        rows = deque(heapq.merge(*self._tables.values(), key=lambda row: row.rx_ns))
        while rows and rows[0].rx_ns < self._start_ns:
            rows.popleft()
        for record in records:
            while rows and rows[0].rx_ns < record.rx_ns:
                yield rows.popleft()
            self._end_ns = max(self._end_ns, record.rx_ns)
            yield record
        while rows and rows[0].rx_ns <= self._end_ns:
            yield rows.popleft()

    def describe_unused(self) -> list[str]:
        """Describe the rows outside the log, by table, after the records are read."""
        notes, end_s = [], (self._end_ns - self._start_ns) * 1e-9
        for table, rows in self._tables.items():
            outside = [row.rx_ns for row in rows if not self._start_ns <= row.rx_ns <= self._end_ns]
            if outside:
                first, last = ((ns - self._start_ns) * 1e-9 for ns in (outside[0], outside[-1]))
                notes.append(
                    f"{table}: {len(outside)} of {len(rows)} rows are not used: t_s from {first:.1f} to "
                    f"{last:.1f}, and the log has 0 to {end_s:.1f} s; check that the table is of this flight"
                )
        return notes


class LogInputs(NamedTuple):
    """The inputs of a log; `summary` returns the importer's counts after they are read.

    `outages` were removed from them and the rows of `correctors` added, if any.
    """

    records: Iterable[Stamped]
    summary: Callable[[], dict[str, int]]
    outages: simulated_rsbn.OutageFilter | None = None
    correctors: CorrectorRows | None = None


def open_inputs(log: Path, config: Config | None = None) -> LogInputs:
    """Open the inputs of a log, ours or another recorder's, with the truth if it has one.

    `config` selects the vehicle of a telemetry log with several (`link.system_id`).

    Raises LogError, one sentence, if it cannot be read.
    """
    if is_own_log(log):
        return LogInputs(_own_inputs(log), dict)
    with input_errors_as_log_errors():
        system = config.link.system_id if config is not None else 0
        source = sources.open_source(log, system or None, others=(".mcap",))
    return LogInputs(source, lambda: source.summary()._asdict())


def is_own_log(log: Path) -> bool:
    """Return whether the file name is that of our own log (MCAP)."""
    return log.name.lower().endswith((".mcap", f".mcap{ACTIVE}"))


def default_output(log: Path, kind: str) -> Path:
    """Return the name of the log of a `kind` made from `log`, in the current folder: NAME.KIND.mcap."""
    name = log.resolve().name if log.is_dir() else log.stem
    own = re.split(r"\.mcap", log.name, maxsplit=1, flags=re.IGNORECASE)[0]
    return Path(f"{own if is_own_log(log) else name}.{kind}.mcap")


def has_navigator_outputs(log: Path) -> bool:
    """Return whether a log is our own and has navigator outputs, that is, was not converted."""
    return is_own_log(log) and CONVERTED not in flight_log.metadata(log)


def _own_inputs(log: Path) -> Iterator[Stamped]:
    for entry in flight_log.read(log):
        if entry.topic.startswith(("/in/", "/truth/", "/link/")) and isinstance(entry.value, Stamped):
            yield entry.value


@contextmanager
def input_errors_as_log_errors() -> Iterator[None]:
    """Convert ValueError and OSError of the importers to LogError, which is shown to the user."""
    try:
        yield
    except ConfigError:
        raise
    except ValueError as error:
        raise LogError(str(error)) from None
    except LogError:
        raise
    except OSError as error:
        raise LogError(f"{error.filename} cannot be read: {error.strerror}") from None


def with_correctors(log_inputs: LogInputs, tables: Sequence[Path]) -> LogInputs:
    """Add the rows of corrector tables (CSV); t_s = 0 is the first record of the log."""
    first, records = sources.read_ahead(log_inputs.records)
    if first is None or not tables:
        return log_inputs._replace(records=records)
    with input_errors_as_log_errors():
        correctors = CorrectorRows(tables, first.rx_ns)
    return log_inputs._replace(records=correctors.merged(records), correctors=correctors)


def with_beacons_and_outages(
    log: Path,
    beacons: Path | None,
    outages: Sequence[simulated_rsbn.SimulatedOutage],
    seed: int,
    config: Config,
) -> tuple[LogInputs, str]:
    """Open the inputs of `log` with simulated beacons and outages. Return them and a note on the beacons.

    The outages count from the first record, as the times of a report do. With beacons the log is read twice:
    first for its track.
    """
    listed = [] if beacons is None else simulated_rsbn.read_beacons(beacons)  # a mistake costs no reading
    log_inputs = open_inputs(log, config)
    if not listed and not outages:
        return log_inputs, ""
    first, merged = sources.read_ahead(log_inputs.records)
    if first is None:
        raise LogError(f"{log} contains no messages: nothing to replay")
    note = ""
    if listed:
        track = simulated_rsbn.extract_track(open_inputs(log, config).records, config)
        measurements = simulated_rsbn.simulate_measurements(listed, track, seed)
        numbers = sorted({answer.beacon for answer in measurements})
        note = (
            f"{len(measurements)} RSBN measurements of {len(numbers)} beacons"
            f" ({', '.join(map(str, numbers))}) simulated along {track.origin}, seed {seed}"
            if measurements
            else f"no beacon of {beacons} is received along {track.origin}"
        )
        if not measurements and (why := simulated_rsbn.describe_unreached(listed, track)):
            note += f": {why}"
        merged = heapq.merge(merged, measurements, key=lambda record: record.rx_ns)
    removing = simulated_rsbn.OutageFilter(outages, first.rx_ns)
    return LogInputs(removing.left(merged), log_inputs.summary, removing), note
