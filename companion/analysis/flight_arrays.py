"""Flights as arrays: one pass over the records of a log, columns of numbers by kind, times by topic.

Times become seconds since the flight's first arrival, angles stay radians, absent stays NaN. It knows what a
record holds and judges nothing; `assess` does.
"""

from __future__ import annotations

import math
from array import array
from collections import defaultdict
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from companion.analysis import gnss_latency
from companion.analysis.gnss_latency import Latency
from companion.navigator import FOLDED
from companion.records import (
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
    Solution,
    Stamped,
    Truth,
)
from companion.storage import flight_log

Floats = npt.NDArray[np.float64]
Table = dict[str, Floats]
MODES = tuple(Mode)
TRUTH = flight_log.topic_of(Truth)
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
    """All that a report needs of one flight, `part` k of n of the log `name`.

    `tables` holds columns (n,) by kind of record, "t" and "rx" (s) among them; a kind that never came has
    columns of length 0. `unix_ns` is the wall-clock time of t = 0. `latencies` are of GNSS behind the
    local position. `heard` are the records themselves that a smoother wants, kept where there is no truth.
    """

    name: str
    part: tuple[int, int]
    unix_ns: int
    zero_ns: int
    seconds: float
    tables: dict[str, Table]
    streams: dict[str, Stream]
    links: dict[str, Table]
    told: list[Told]
    refused: list[Refused]
    latencies: list[Latency]
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
        "lat lon sources cost freedom normalised",
        lambda r: (r.lat, r.lon, r.sources, r.cost, r.freedom, _number(r.normalised)),
    ),
    Gnss: (
        "receiver fix lat lon alt sigma",
        lambda r: (r.receiver, r.fix, r.lat, r.lon, r.alt_msl, _number(r.sigma_horizontal)),
    ),
    RsbnFix: (
        "beacon lat lon alt azimuth slant",
        lambda r: (r.beacon, r.lat, r.lon, r.alt, _number(r.azimuth), _number(r.slant_range)),
    ),
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
) -> list[Flight]:
    """The flights of `records`, each with its topic, in order of arrival: a reboot of the autopilot begins a
    new one. `unix_ns` is the wall-clock time of the first record (its own stamp where not told).

    ValueError where there are none.
    """
    parts = [_Gathered()]
    for topic, record in records:
        if isinstance(record, Reboot) and parts[-1].began:
            parts.append(_Gathered())
        parts[-1].see(topic, record)
    if not parts[0].began:
        raise ValueError(f"{name} holds no record: there is nothing to report")
    shift = 0 if unix_ns is None else unix_ns - parts[0].zero_ns
    about = metadata or {}
    return [
        part.flight(name, (k, len(parts)), shift, about, remarks) for k, part in enumerate(parts, start=1)
    ]


class _Gathered:
    """What was seen so far of one flight."""

    def __init__(self) -> None:
        self.began = False
        self.zero_ns = self._end_ns = 0
        self._columns = {kind: _Columns(names) for kind, (names, _) in COLUMNS.items()}
        self._links: dict[str, _Columns] = defaultdict(lambda: _Columns(_LINK))
        self._times: dict[str, array[int]] = defaultdict(lambda: array("q"))
        self._told: list[Stamped] = []
        self._heard: list[Stamped] = []
        self._last: dict[int, Gnss] = {}
        self._watch = gnss_latency.Watch()

    def see(self, topic: str, record: Stamped) -> None:
        """Take one record. A fix repeated at the stream's rate counts for the rate alone."""
        if not self.began:
            self.began, self.zero_ns = True, record.rx_ns
        self._end_ns = max(self._end_ns, record.rx_ns)
        self._times[topic].extend((record.t_ns, record.rx_ns))
        if isinstance(record, Gnss):
            before, self._last[record.receiver] = self._last.get(record.receiver), record
            if before is not None and record.repeats(before):
                return
        kind = type(record)
        if kind in FOLDED:
            self._heard.append(record)
            self._watch.see(record)
        if kind in COLUMNS:
            self._columns[kind].add(record, COLUMNS[kind][1](record))
        elif isinstance(record, LinkState):
            self._links[record.link].add(record, _link(record))
        elif kind in (Event, Reset, Rejection):
            self._told.append(record)

    def flight(
        self,
        name: str,
        part: tuple[int, int],
        shift_ns: int,
        metadata: dict[str, dict[str, str]],
        remarks: tuple[str, ...],
    ) -> Flight:
        """All of it as arrays. What was heard is let go where the truth is known."""
        pairs = {topic: _seconds(both, self.zero_ns) for topic, both in sorted(self._times.items())}
        seen = [gnss_latency.look(track) for track in self._watch.tracks()]
        lines = [_told(r, self.zero_ns) for r in self._told if isinstance(r, Event | Reset)]
        glitches = [_told(event, self.zero_ns)._replace(kind="glitch") for event in gnss_latency.events(seen)]
        found = {(line.t, line.text) for line in glitches}  # a replay has told them already
        return Flight(
            name=name,
            part=part,
            unix_ns=self.zero_ns + shift_ns,
            zero_ns=self.zero_ns,
            seconds=(self._end_ns - self.zero_ns) * 1e-9,
            tables={kind.__name__: column.table(self.zero_ns) for kind, column in self._columns.items()},
            streams={topic: Stream(pair[:, 0], pair[:, 1]) for topic, pair in pairs.items()},
            links={link: column.table(self.zero_ns) for link, column in sorted(self._links.items())},
            told=[*glitches, *(line for line in lines if (line.t, line.text) not in found)],
            refused=[_refused(r, self.zero_ns) for r in self._told if isinstance(r, Rejection)],
            latencies=[one.latency for one in seen if one.latency is not None],
            heard=[] if TRUTH in self._times else self._heard,
            metadata=metadata,
            remarks=remarks,
        )


def _told(record: Event | Reset, zero_ns: int) -> Told:
    t = (record.t_ns - zero_ns) * 1e-9
    if isinstance(record, Event):
        return Told(t, "event", record.severity, record.text)
    return Told(t, "reset", 4, f"{record.what} began anew: {record.reason}")


def _refused(r: Rejection, zero_ns: int) -> Refused:
    t_ns = r.t_ns if r.t_ns >= zero_ns else r.rx_ns  # of a time before the flight: when it was heard
    return Refused((t_ns - zero_ns) * 1e-9, r.source, r.reason, _number(r.value), _number(r.limit))
