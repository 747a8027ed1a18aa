"""Flights as arrays: one pass over the records of a log gives columns by record type and times by topic.

Times become seconds since the first arrival of the flight, angles stay in radians, missing values are NaN.
"""

from __future__ import annotations

import math
from array import array
from collections import defaultdict
from collections.abc import Callable, Iterable, Set
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from companion.importers import gnss_latency
from companion.importers.gnss_latency import Latency
from companion.navigator import INPUTS_USED
from companion.records import (
    PARALLEL,
    Event,
    FilterStatus,
    Fix,
    Gnss,
    LinkState,
    Mode,
    Reboot,
    Rejection,
    Reset,
    RsbnFix,
    Severity,
    Solution,
    Stamped,
    Truth,
)
from companion.storage import flight_log
from companion.units import Floats

Table = dict[str, Floats]
MODES = tuple(Mode)
TRUTH = flight_log.topic_of(Truth)
AHEAD = 4  # predictions stored per solution


class Stream(NamedTuple):
    """Times of validity and of arrival of the messages of one topic, both in seconds (n,)."""

    t: Floats
    rx: Floats


class TimelineEntry(NamedTuple):
    """A line of the timeline: time (s), kind, severity (MAVLink's 0..7) and text."""

    t: float
    kind: str
    severity: int
    text: str


class RejectedMeasurement(NamedTuple):
    """A measurement that was not used."""

    t: float
    source: str
    reason: str
    value: float
    limit: float


@dataclass(frozen=True, slots=True, eq=False)
class Flight:
    """All data that a report needs of one flight, `part` k of n of the log `name`.

    `tables` has columns (n,) by record type, including "t" and "rx" (s); the columns of an absent type have
    length 0. `unix_ns` is the wall-clock time of t = 0. `latencies` are those of GNSS relative to the local
    position. `smoother_inputs` are the records for the smoother, stored only if there is no truth.
    """

    name: str
    part: tuple[int, int]
    unix_ns: int
    zero_ns: int
    seconds: float
    tables: dict[str, Table]
    streams: dict[str, Stream]
    links: dict[str, Table]
    log_entries: list[TimelineEntry]
    rejections: list[RejectedMeasurement]
    latencies: list[Latency]
    smoother_inputs: list[Stamped]
    metadata: dict[str, dict[str, str]]
    remarks: tuple[str, ...]


def _or_nan(value: float | None) -> float:
    return math.nan if value is None else value


def _solution(r: Solution) -> tuple[float, ...]:
    bound = r.bound_n or (math.nan, math.nan)
    ahead = [(p.ahead_s, math.hypot(*p.bound_n), math.hypot(*p.claimed_n)) for p in r.ahead[:AHEAD]]
    ahead += [(math.nan,) * 3] * (AHEAD - len(ahead))
    flat = (number for one in ahead for number in one)
    beside = {p.estimator: p.error_n for p in r.parallel}
    parallel = (number for name in PARALLEL for number in beside.get(name, (math.nan, math.nan)))
    nn, ne, _, ee, *_ = r.covariance
    return (
        *(float(MODES.index(r.mode)), r.lat, r.lon, r.alt_msl, nn, ne, ee),
        *(*r.error_n, float(r.sources), *bound, _or_nan(r.protection), *flat, *parallel),
    )


_AHEAD = " ".join(f"ahead_{i} ahead_bound_{i} ahead_claimed_{i}" for i in range(AHEAD))
_PARALLEL = " ".join(f"{name}_north {name}_east" for name in PARALLEL)
COLUMNS: dict[type[Stamped], tuple[str, Callable[[Any], tuple[float, ...]]]] = {
    Solution: (
        "mode lat lon alt nn ne ee error_north error_east sources bound_north bound_east protection "
        f"{_AHEAD} {_PARALLEL}",
        _solution,
    ),
    Fix: (
        "lat lon sources cost degrees_of_freedom",
        lambda r: (r.lat, r.lon, r.sources, r.cost, r.degrees_of_freedom),
    ),
    Gnss: (
        "receiver fix lat lon alt sigma",
        lambda r: (r.receiver, r.fix, r.lat, r.lon, r.alt_msl, _or_nan(r.sigma_horizontal)),
    ),
    RsbnFix: (
        "beacon lat lon alt azimuth slant",
        lambda r: (r.beacon, r.lat, r.lon, r.alt, _or_nan(r.azimuth), _or_nan(r.slant_range)),
    ),
    Truth: ("lat lon alt", lambda r: (r.lat, r.lon, r.alt)),
    FilterStatus: ("gnss_glitch", lambda r: (float(r.gnss_glitch),)),
}
_LINK = "received lost bad dropped offset round_trip"


def _link(r: LinkState) -> tuple[float, ...]:
    offset = math.nan if r.offset_ns is None else r.offset_ns * 1e-9
    trip = math.nan if r.round_trip_ns is None else r.round_trip_ns * 1e-9
    return (r.received, r.lost, r.bad, r.dropped, offset, trip)


class _Columns:
    """Table builder: rows in, columns out."""

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
    """Convert pairs of t_ns, rx_ns to seconds (n, 2). UNIX ns exceed double precision: subtract integers."""
    pairs = np.array(times, dtype=np.int64).reshape(-1, 2) - zero_ns
    return np.asarray(pairs * 1e-9, dtype=np.float64)


def collect_flights(
    records: Iterable[tuple[str, Stamped]],
    name: str,
    *,
    unix_ns: int | None = None,
    metadata: dict[str, dict[str, str]] | None = None,
    remarks: tuple[str, ...] = (),
) -> list[Flight]:
    """Collect the flights in `records` (topic, record), in order of arrival. A reboot starts a new flight.

    `unix_ns` is the wall-clock time of the first record; by default its own time stamp.

    Raises ValueError if there are no records.
    """
    parts, reboots_ns = [_FlightCollector()], set[int]()
    for topic, record in records:
        if isinstance(record, Reboot):
            reboots_ns.add(record.rx_ns)
            if parts[-1].started:
                parts.append(_FlightCollector())
        parts[-1].add(topic, record)
    if not parts[0].started:
        raise ValueError(f"{name} contains no records of the companion")
    shift = 0 if unix_ns is None else unix_ns - parts[0].zero_ns
    about = metadata or {}
    return [
        part.flight(name, (k, len(parts)), shift, about, remarks, reboots_ns)
        for k, part in enumerate(parts, start=1)
    ]


class _FlightCollector:
    """The data of one flight collected so far."""

    def __init__(self) -> None:
        self.started = False
        self.zero_ns = self._end_ns = 0
        self._columns = {kind: _Columns(names) for kind, (names, _) in COLUMNS.items()}
        self._links: dict[str, _Columns] = defaultdict(lambda: _Columns(_LINK))
        self._times: dict[str, array[int]] = defaultdict(lambda: array("q"))
        self._messages: list[Stamped] = []
        self._smoother_inputs: list[Stamped] = []
        self._last: dict[int, Gnss] = {}
        self._latency_tracks = gnss_latency.TrackCollector()

    def add(self, topic: str, record: Stamped) -> None:
        """Add one record. A repeated fix counts only for the message rate."""
        if not self.started:
            self.started, self.zero_ns = True, record.rx_ns
        self._end_ns = max(self._end_ns, record.rx_ns)
        self._times[topic].extend((record.t_ns, record.rx_ns))
        if isinstance(record, Gnss):
            before, self._last[record.receiver] = self._last.get(record.receiver), record
            if before is not None and record.repeats(before):
                return
        kind = type(record)
        if kind in INPUTS_USED:
            self._smoother_inputs.append(record)
            self._latency_tracks.add(record)
        if kind in COLUMNS:
            self._columns[kind].add(record, COLUMNS[kind][1](record))
        elif isinstance(record, LinkState):
            self._links[record.link].add(record, _link(record))
        elif kind in (Event, Reset, Rejection):
            self._messages.append(record)

    def flight(
        self,
        name: str,
        part: tuple[int, int],
        shift_ns: int,
        metadata: dict[str, dict[str, str]],
        remarks: tuple[str, ...],
        reboots_ns: Set[int],
    ) -> Flight:
        """Return the flight as arrays. What is reset by a reboot, at its time, is part of the reboot."""
        pairs = {topic: _seconds(both, self.zero_ns) for topic, both in sorted(self._times.items())}
        analyses = [gnss_latency.analyze_track(track) for track in self._latency_tracks.tracks()]
        lines = [
            _timeline_entry(r, self.zero_ns, reboots_ns)
            for r in self._messages
            if isinstance(r, Event | Reset)
        ]
        glitches = [
            _timeline_entry(event, self.zero_ns, reboots_ns)._replace(kind="glitch")
            for event in gnss_latency.glitch_events(analyses)
        ]
        found = {(line.t, line.text) for line in glitches}  # a replay has logged them already
        return Flight(
            name=name,
            part=part,
            unix_ns=self.zero_ns + shift_ns,
            zero_ns=self.zero_ns,
            seconds=(self._end_ns - self.zero_ns) * 1e-9,
            tables={kind.__name__: column.table(self.zero_ns) for kind, column in self._columns.items()},
            streams={topic: Stream(pair[:, 0], pair[:, 1]) for topic, pair in pairs.items()},
            links={link: column.table(self.zero_ns) for link, column in sorted(self._links.items())},
            log_entries=[*glitches, *(line for line in lines if (line.t, line.text) not in found)],
            rejections=[
                _rejected_measurement(r, self.zero_ns) for r in self._messages if isinstance(r, Rejection)
            ],
            latencies=[one.latency for one in analyses if one.latency is not None],
            smoother_inputs=[] if TRUTH in self._times else self._smoother_inputs,
            metadata=metadata,
            remarks=remarks,
        )


def _timeline_entry(record: Event | Reset, zero_ns: int, reboots_ns: Set[int]) -> TimelineEntry:
    t = (record.t_ns - zero_ns) * 1e-9
    if isinstance(record, Event):
        return TimelineEntry(t, "event", record.severity, record.text)
    kind = "reboot" if record.rx_ns in reboots_ns else "reset"
    return TimelineEntry(t, kind, Severity.WARNING, f"{record.what} reset: {record.reason}")


def _rejected_measurement(r: Rejection, zero_ns: int) -> RejectedMeasurement:
    t_ns = r.t_ns if r.t_ns >= zero_ns else r.rx_ns  # stamped before the flight: use the arrival
    return RejectedMeasurement(
        (t_ns - zero_ns) * 1e-9, r.source, r.reason, _or_nan(r.value), _or_nan(r.limit)
    )
