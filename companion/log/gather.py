"""A flight as arrays: one pass over its records, columns of numbers by kind, times by topic.

Times become seconds since the flight's first arrival, angles stay radians, absent stays NaN. It knows what a
record holds and judges nothing; `assess` does.
"""

from __future__ import annotations

import math
from array import array
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from companion.config import Config
from companion.log import file, sources
from companion.log.opened import ACTIVE, LogError
from companion.log.replay import metadata as metadata_of
from companion.navigator import FOLDED, Navigator
from companion.records import (
    INPUTS,
    Event,
    FilterStatus,
    Fix,
    Gnss,
    LinkState,
    Mode,
    Rejection,
    Reset,
    RsbnFix,
    Solution,
    Stamped,
    Truth,
)

Floats = npt.NDArray[np.float64]
Table = dict[str, Floats]
MODES = tuple(Mode)
TRUTH = file.topic_of(Truth)
AHEAD = 4  # predictions kept of each solution


class Stream(NamedTuple):
    """When the messages of one topic were valid and when they arrived, both seconds (n,)."""

    t: Floats
    rx: Floats


class Told(NamedTuple):
    """A line of the log's own: when (s), of what kind, how grave (MAVLink's 0..7), and the text."""

    t: float
    kind: str
    severity: int
    text: str


class Refused(NamedTuple):
    """One measurement not used."""

    t: float
    source: str
    reason: str
    value: float
    limit: float


@dataclass(frozen=True, slots=True, eq=False)
class Flight:
    """All that a report needs of one log.

    `tables` holds columns (n,) by kind of record, "t" and "rx" (s) among them; a kind that never came has
    columns of length 0. `unix_ns` is the wall-clock time of t = 0. `heard` are the records themselves that a
    smoother wants, kept only where the log holds no truth.
    """

    name: str
    unix_ns: int
    zero_ns: int
    seconds: float
    tables: dict[str, Table]
    streams: dict[str, Stream]
    links: dict[str, Table]
    told: list[Told]
    refused: list[Refused]
    heard: list[Stamped]
    metadata: dict[str, dict[str, str]]
    remarks: tuple[str, ...]


def _number(value: float | None) -> float:
    return math.nan if value is None else value


def _solution(r: Solution) -> tuple[float, ...]:
    bound = r.bound_n or (math.nan, math.nan)
    ahead = [(p.ahead_s, math.hypot(*p.bound_n), math.hypot(*p.claimed_n)) for p in r.ahead[:AHEAD]]
    ahead += [(math.nan,) * 3] * (AHEAD - len(ahead))
    flat = (number for one in ahead for number in one)
    c = r.covariance
    mode = float(MODES.index(r.mode))
    return (mode, r.lat, r.lon, r.alt_msl, c[0], c[1], c[3], *r.error_n, float(r.sources), *bound, *flat)


_AHEAD = " ".join(f"ahead_{i} ahead_bound_{i} ahead_claimed_{i}" for i in range(AHEAD))
COLUMNS: dict[type[Stamped], tuple[str, Callable[[Any], tuple[float, ...]]]] = {
    Solution: (
        "mode lat lon alt nn ne ee error_north error_east sources bound_north bound_east " + _AHEAD,
        _solution,
    ),
    Fix: (
        "lat lon correction_north correction_east nn ne ee sources cost freedom normalised",
        lambda r: (
            *(r.lat, r.lon, *r.correction_n, *r.covariance),
            *(r.sources, r.cost, r.freedom, _number(r.normalised)),
        ),
    ),
    Gnss: (
        "receiver fix lat lon alt sigma",
        lambda r: (r.receiver, r.fix, r.lat, r.lon, r.alt_msl, _number(r.sigma_horizontal)),
    ),
    RsbnFix: ("beacon lat lon", lambda r: (r.beacon, r.lat, r.lon)),
    Truth: ("lat lon alt", lambda r: (r.lat, r.lon, r.alt)),
    FilterStatus: ("gnss_glitch", lambda r: (float(r.gnss_glitch),)),
}
_LINK = "connected received lost bad dropped offset round_trip"


def _link(r: LinkState) -> tuple[float, ...]:
    offset = math.nan if r.offset_ns is None else r.offset_ns * 1e-9
    trip = math.nan if r.round_trip_ns is None else r.round_trip_ns * 1e-9
    return (r.connected, r.received, r.lost, r.bad, r.dropped, offset, trip)


class _Columns:
    """Rows come in, columns go out."""

    def __init__(self, names: str) -> None:
        self._names, self._times, self._rows = names.split(), array("q"), array("d")

    def add(self, record: Stamped, row: tuple[float, ...]) -> None:
        self._times.append(record.t_ns)
        self._times.append(record.rx_ns)
        self._rows.extend(row)

    def table(self, zero_ns: int) -> Table:
        times = _seconds(self._times, zero_ns)
        rows = np.frombuffer(self._rows, dtype=np.float64).reshape(-1, len(self._names))
        return {"t": times[:, 0], "rx": times[:, 1], **dict(zip(self._names, rows.T, strict=True))}


def _seconds(times: array[int], zero_ns: int) -> Floats:
    """Pairs of t_ns, rx_ns as seconds (n, 2); the difference first, 1970's nanoseconds fit no double."""
    pairs = np.array(times, dtype=np.int64).reshape(-1, 2) - zero_ns
    return np.asarray(pairs * 1e-9, dtype=np.float64)


def gather(
    records: Iterable[tuple[str, Stamped]],
    name: str,
    *,
    unix_ns: int | None = None,
    metadata: dict[str, dict[str, str]] | None = None,
    remarks: tuple[str, ...] = (),
) -> Flight:
    """The flight of `records`, each with its topic, in order of arrival; `unix_ns` is the wall-clock time of
    the first (its own stamp where not told).

    ValueError where there are none.
    """
    columns = {kind: _Columns(names) for kind, (names, _) in COLUMNS.items()}
    rows = {kind: row for kind, (_, row) in COLUMNS.items()}
    links: dict[str, _Columns] = defaultdict(lambda: _Columns(_LINK))
    times: dict[str, array[int]] = defaultdict(lambda: array("q"))
    told: list[Stamped] = []
    heard: list[Stamped] = []
    last: dict[int, Gnss] = {}
    zero_ns: int | None = None
    end_ns = 0
    for topic, record in records:
        if zero_ns is None:
            zero_ns = record.rx_ns
        end_ns = max(end_ns, record.rx_ns)
        times[topic].extend((record.t_ns, record.rx_ns))
        kind = type(record)
        if isinstance(record, Gnss):
            before, last[record.receiver] = last.get(record.receiver), record
            if before is not None and record.repeats(before):
                continue
        if kind in FOLDED:
            heard.append(record)
        if kind in rows:
            columns[kind].add(record, rows[kind](record))
        elif isinstance(record, LinkState):
            links[record.link].add(record, _link(record))
        elif kind in (Event, Reset, Rejection):
            told.append(record)
    if zero_ns is None:
        raise ValueError(f"{name} holds no record: there is nothing to report")
    streams = {}
    for topic, both in sorted(times.items()):
        pair = _seconds(both, zero_ns)
        streams[topic] = Stream(pair[:, 0], pair[:, 1])
    return Flight(
        name=name,
        unix_ns=zero_ns if unix_ns is None else unix_ns,
        zero_ns=zero_ns,
        seconds=(end_ns - zero_ns) * 1e-9,
        tables={kind.__name__: column.table(zero_ns) for kind, column in columns.items()},
        streams=streams,
        links={link: column.table(zero_ns) for link, column in sorted(links.items())},
        told=[line for record in told if (line := _told(record, zero_ns)) is not None],
        refused=[
            Refused((r.t_ns - zero_ns) * 1e-9, r.source, r.reason, _number(r.value), _number(r.limit))
            for r in told
            if isinstance(r, Rejection)
        ],
        heard=[] if TRUTH in times else heard,
        metadata=metadata or {},
        remarks=remarks,
    )


def _told(record: Stamped, zero_ns: int) -> Told | None:
    t = (record.t_ns - zero_ns) * 1e-9
    match record:
        case Event(_, _, severity, text):
            return Told(t, "event", severity, text)
        case Reset(_, _, what, reason):
            return Told(t, "reset", 4, f"{what} began anew: {reason}")
    return None


def open_flight(path: Path, config: Config | None = None) -> Flight:
    """The flight in the log at `path`: our MCAP as it flew, or a foreign log with the navigator run over it.

    `config` is what the navigator of a foreign log flies with. LogError or ValueError, one sentence each,
    where the file cannot be read or holds nothing.
    """
    if path.suffix == ".mcap" or path.name.endswith(f".mcap{ACTIVE}"):
        info = file.info(path)
        first = next(iter(file.read(path)), None)
        if first is None:
            raise LogError(f"{path} holds no message: there is nothing to report")
        torn = f"The log is torn: it was not closed, and {info.bytes_lost} bytes at its end are lost."
        remarks = () if info.closed else (torn,)
        return gather(_own(path), path.name, unix_ns=first.log_time, metadata=info.metadata, remarks=remarks)
    if not path.exists():
        raise LogError(f"{path}: no such log")
    flown = config or Config()
    remark = "Another recorder's log: the navigator was run over it for this report."
    return gather(_foreign(path, flown), path.name, metadata=metadata_of(flown), remarks=(remark,))


def _own(path: Path) -> Iterator[tuple[str, Stamped]]:
    for entry in file.read(path):
        if not isinstance(entry.value, bytes):
            yield entry.topic, entry.value


def _foreign(path: Path, config: Config) -> Iterator[tuple[str, Stamped]]:
    navigator = Navigator(config)
    for record in sources.open_source(path):
        if isinstance(record, INPUTS):
            yield file.topic_of(type(record)), record
            for output in navigator.handle(record):  # type: ignore[arg-type]
                yield file.topic_of(type(output)), output
        elif isinstance(record, Truth | LinkState):
            yield file.topic_of(type(record)), record
        else:
            yield f"/link/{type(record).__name__}", record
