"""Events of a flight: phases, GNSS outages, grouped rejections, message rates, timeline."""

from __future__ import annotations

import math
import re
from collections import defaultdict
from collections.abc import Iterable, Iterator
from itertools import groupby
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from companion.analysis import error_statistics
from companion.analysis.flight_arrays import MODES, Flight, RejectedMeasurement, Table, TimelineEntry
from companion.nav.earth import radii
from companion.records import Mode, Severity, Source
from companion.units import Floats

PHASE_MIN_S = 5.0  # a shorter phase is merged into the previous one, the first into the next
GROUP_GAP_S = 3.0  # rejections of one source closer than this form one group
OUTAGE_MIN_S = 5.0  # a longer time without GNSS is an outage
WITHOUT_FIXES = ("prediction", "untrusted")  # phases in which no fix was used
NO_ESTIMATE = "no estimate"  # phase
BEACON = Source.AZIMUTH | Source.RANGE


class RejectionGroup(NamedTuple):
    """Consecutive rejections of one source: start, end (s), count, worst value and its limit."""

    start: float
    end: float
    source: str
    reason: str
    number: int
    value: float
    limit: float
    metres: float  # greatest distance from the estimate; NaN if unknown


class OutageInterval(NamedTuple):
    """Interval without a GNSS fix, or without any message of the autopilot, `start` to `end` (s)."""

    start: float
    end: float


class MessageRate(NamedTuple):
    """Statistics of a topic: count, mean rate (Hz), longest gap and its start (s), latency (s)."""

    topic: str
    number: int
    hz: float
    gap: float
    gap_at: float
    latency: float
    latency_95: float


def usable_gnss(flight: Flight) -> Table:
    """Return the GNSS columns restricted to 3D fixes."""
    gnss = flight.tables["Gnss"]
    return {name: column[gnss["fix"] >= 3] for name, column in gnss.items()}


def message_latency(flight: Flight, topic: str) -> tuple[Floats, Floats]:
    """Return arrival and latency of each message of `topic`, s; for GNSS of new fixes only."""
    of_gnss = topic == "/in/Gnss"
    t, rx = (usable_gnss(flight)[name] for name in ("t", "rx")) if of_gnss else flight.streams[topic]
    return rx, rx - t


def beacon_places(flight: Flight) -> list[tuple[int, float, float, float]]:
    """Return identity, latitude, longitude and altitude of each beacon, where it first answered from."""
    fixes = flight.tables["RsbnFix"]
    first = np.unique(fixes["beacon"], return_index=True)[1]
    columns = (fixes[name][first].tolist() for name in ("beacon", "lat", "lon", "alt"))
    return [(int(identity), lat, lon, alt) for identity, lat, lon, alt in zip(*columns, strict=True)]


def without_fixes(solution: Table) -> npt.NDArray[np.bool_]:
    """Return which rows of "Solution" rest on no fix; airspeed is none."""
    alone: npt.NDArray[np.bool_] = (solution["sources"].astype(int) & int(Source.GNSS | BEACON)) == 0
    return alone


def in_phases_without_fixes(
    phases: Iterable[error_statistics.FlightPhase], t: Floats
) -> npt.NDArray[np.bool_]:
    """Return which times (s) are in phases in which no fix was used."""
    inside = np.zeros(len(t), dtype=np.bool_)
    for phase in phases:
        if phase.name in WITHOUT_FIXES:
            inside |= phase.covers(t)
    return inside


def rests_on_beacons(flight: Flight) -> npt.NDArray[np.bool_]:
    """Return which rows of "Fix" use beacons and not GNSS."""
    sources = flight.tables["Fix"]["sources"].astype(int)
    found: npt.NDArray[np.bool_] = ((sources & int(BEACON)) != 0) & ((sources & int(Source.GNSS)) == 0)
    return found


def longest_step(t: Floats) -> float:
    """Return the longest time between two rows of a table that follow each other without a gap, s."""
    return max(PHASE_MIN_S, 3.0 * float(np.median(np.diff(t)))) if len(t) > 1 else PHASE_MIN_S


def split_phases(solution: Table, seconds: float) -> list[error_statistics.FlightPhase]:
    """Split the flight into phases by the sources of the position: fixes, prediction, untrusted, or none."""
    names, starts = list[str](), list[float]()
    times = np.maximum.accumulate(solution["t"])
    longest = longest_step(times)
    t = times.tolist()
    for mode, sources, now, later in zip(solution["mode"], solution["sources"], t, [*t[1:], seconds]):
        missing = later - now > longest
        names += [_phase_name(MODES[int(mode)], int(sources)), *[NO_ESTIMATE] * missing]
        starts += [now, *[now + 1e-6] * missing]
    starts.append(seconds)
    runs: list[tuple[str, float]] = []
    lasting: defaultdict[str, float] = defaultdict(float)
    k = 0
    for name, group in groupby(names):
        end = k + len(list(group))
        duration = starts[end] - starts[k]
        lasting[name] += duration
        if not runs or (duration >= PHASE_MIN_S and runs[-1][0] != name):
            runs.append((name, starts[k]))
        k = end
    if len(runs) > 1 and runs[1][1] - runs[0][1] < PHASE_MIN_S:
        runs[:2] = [(runs[1][0], runs[0][1])]
    if len(runs) == 1:  # nothing else lasted long enough, perhaps not even the first
        runs = [(max(lasting, key=lambda name: lasting[name]), runs[0][1])]
    last = max([seconds, *t[-1:]])  # the last phase holds it
    bounds = [round(start * 1e9) for _, start in runs] + [round(last * 1e9) + 1]
    return [error_statistics.FlightPhase(name, *bounds[i : i + 2]) for i, (name, _) in enumerate(runs)]


def _phase_name(mode: Mode, sources: int) -> str:
    if mode is not Mode.FIXED:
        return {Mode.PREDICTING: "prediction", Mode.UNTRUSTED: "untrusted"}.get(mode, str(mode))
    names = [name for bits, name in ((Source.GNSS, "GNSS"), (BEACON, "RSBN")) if sources & int(bits)]
    return " + ".join(names) or "fixes"


def phase_title(name: str) -> str:
    """Return the name of a phase for the user."""
    return {"prediction": "no fixes", "untrusted": "no fixes, not to be trusted"}.get(name, name).replace(
        "RSBN", "beacons"
    )


def is_fix(source: str) -> bool:
    """Return whether what was rejected is a position fix of GNSS or of a beacon."""
    return source.lower().startswith(("gnss", "rsbn"))


def is_gnss_velocity(source: str) -> bool:
    """Return whether what was rejected is the velocity of a GNSS fix, whose position may have been used."""
    return source.lower().startswith("velocity of gnss")


def source_title(source: str) -> str:
    """Return the name of a source of measurements for the user: velocity of GNSS 0, beacon 7 azimuth."""
    what, of, source = source.rpartition(" of ")
    kind, _, rest = source.partition(" ")
    name = {"gnss": "GNSS", "rsbn": "beacon"}.get(kind.lower(), _NAMES.get(kind, kind))
    return f"{what}{of}{name} {rest}".strip()


#: Streams of other instruments, or made by the companion.
_NOT_OF_THE_AUTOPILOT = ("RsbnFix", "StarFix", "RangeDifference", "SecondIns", "Tuning", "Resumed")


def find_silences(flight: Flight) -> list[OutageInterval]:
    """Find gaps in which nothing arrived from the autopilot, and a final gap."""
    arrivals = [
        stream.rx
        for topic, stream in flight.streams.items()
        if topic.startswith("/in/") and topic.removeprefix("/in/") not in _NOT_OF_THE_AUTOPILOT
    ]
    return _find_gaps(np.concatenate(arrivals), flight.seconds) if arrivals else []


def find_gnss_outages(flight: Flight, silences: list[OutageInterval]) -> list[OutageInterval]:
    """Find gaps between arrivals of usable GNSS fixes, and a final gap, after the first fix.

    Where nothing arrived at all it is not GNSS that was lost.
    """
    gaps = _find_gaps(usable_gnss(flight)["rx"], flight.seconds)
    parts = (part for gap in gaps for part in _outside(gap, silences))
    return [part for part in parts if part.end - part.start > OUTAGE_MIN_S]


def _outside(gap: OutageInterval, silences: list[OutageInterval]) -> Iterator[OutageInterval]:
    start = gap.start
    for one in silences:
        if start < one.end and one.start < gap.end:
            yield OutageInterval(start, one.start)
            start = one.end
    yield OutageInterval(start, gap.end)


def _find_gaps(arrivals: Floats, seconds: float) -> list[OutageInterval]:
    t = np.sort(arrivals)
    t = np.append(t, max(seconds, t[-1])) if len(t) else t
    return [OutageInterval(float(t[k]), float(t[k + 1])) for k in np.flatnonzero(np.diff(t) > OUTAGE_MIN_S)]


def group_rejections(flight: Flight) -> list[RejectionGroup]:
    """Group consecutive rejections of one source for one reason."""
    rows: list[list[RejectedMeasurement]] = []
    for rejected in sorted(flight.rejections, key=lambda r: (r.source, r.reason, r.t)):
        last = rows[-1][-1] if rows else None
        if last is not None and last[1:3] == rejected[1:3] and rejected.t - last.t <= GROUP_GAP_S:
            rows[-1].append(rejected)
        else:
            rows.append([rejected])
    return sorted(_summarize_group(flight, row) for row in rows)


def _summarize_group(flight: Flight, row: list[RejectedMeasurement]) -> RejectionGroup:
    values = [r.value for r in row if math.isfinite(r.value)]
    limits = [r.limit for r in row if math.isfinite(r.limit)]
    return RejectionGroup(
        row[0].t,
        row[-1].t,
        row[0].source,
        row[0].reason,
        len(row),
        max(values, default=math.nan),
        min(limits, default=math.nan),
        _max_distance(flight, row) if row[0].source.startswith("gnss") else math.nan,
    )


def _max_distance(flight: Flight, row: list[RejectedMeasurement]) -> float:
    """Return the greatest distance of the rejected fixes of a GNSS receiver from the estimate, m."""
    gnss, solution = usable_gnss(flight), flight.tables["Solution"]
    receiver = row[0].source.removeprefix("gnss ")
    in_group = (gnss["t"] >= row[0].t - 1e-3) & (gnss["t"] <= row[-1].t + 1e-3)
    in_group &= gnss["receiver"] == (int(receiver) if receiver.isdecimal() else -1)
    if not in_group.any() or len(solution["t"]) < 2:
        return math.nan
    order = np.argsort(solution["t"], kind="stable")
    t, lat, lon = (solution[name][order] for name in ("t", "lat", "lon"))
    north = gnss["lat"][in_group] - np.interp(gnss["t"][in_group], t, lat)
    east = gnss["lon"][in_group] - np.interp(gnss["t"][in_group], t, np.unwrap(lon))
    east = np.remainder(east + math.pi, math.tau) - math.pi
    R_N, R_E = radii(float(lat[0]))
    return float(np.max(np.hypot(north * R_N, east * R_E * math.cos(lat[0]))))


_NAMES = {
    "LocalPosition": "local position",
    "Gnss": "GNSS",
    "RsbnFix": "beacon replies",
    "Solution": "estimate",
    "AirData": "airspeed",
    "Imu": "IMU",
    "Attitude": "attitude",
    "Pressure": "pressure",
    "Wind": "wind of the autopilot",
    "GlobalPosition": "position of the autopilot",
    "LocalOrigin": "local origin",
    "HomePosition": "home",
    "FilterStatus": "autopilot's estimator flags",
    "SystemTime": "system time",
    "Rejection": "rejections",
    "Fix": "radio-only fixes",
    "LinkState": "link state",
    "AirspeedSensor": "state of the airspeed sensor",
    "Vehicle": "kind of vehicle, landed or flying",
    "GnssIntegrity": "jamming and spoofing",
    "RangeDifference": "lines of position",
    "SecondIns": "second INS",
    "StarFix": "star fixes",
    "Tuning": "changed parameters",
    "Resumed": "state of the run before",
    "Reboot": "reboots",
    "TimeStep": "steps of the autopilot's time",
    "Event": "events",
    "/link/Event": "events of the link",
    "/link/Rejection": "rejections of the link",
    "Reset": "resets",
    "Smoothed": "smoothed track",
    "Truth": "true position",
}


def topic_name(topic: str) -> str:
    """Return the name of a topic for the user."""
    kind = topic.rsplit("/", 1)[-1]
    return (
        _NAMES.get(topic, _NAMES.get(kind, kind))
        if topic.startswith(("/in/", "/out/", "/link/", "/truth/"))
        else topic.lstrip("/")
    )


def message_rate(flight: Flight, topic: str) -> MessageRate:
    """Compute the statistics of one topic; the latency is that of its new messages."""
    rx, (_, latency) = flight.streams[topic].rx, message_latency(flight, topic)
    gaps = np.diff(rx)
    worst = int(np.argmax(gaps)) if len(gaps) else 0
    span = float(rx[-1] - rx[0])
    return MessageRate(
        topic,
        len(rx),
        (len(rx) - 1) / span if span > 0.0 else math.nan,
        float(gaps[worst]) if len(gaps) else math.nan,
        float(rx[worst]),
        float(np.median(latency)) if len(latency) else math.nan,
        float(np.percentile(latency, 95.0)) if len(latency) else math.nan,
    )


def build_timeline(
    flight: Flight,
    groups: list[RejectionGroup],
    outages: list[OutageInterval],
    silences: list[OutageInterval],
) -> list[TimelineEntry]:
    """Merge the log's entries with grouped rejections, outages, silences and the autopilot's glitch flags."""
    lines = [line._replace(text=event_title(line.text)) for line in flight.log_entries]
    lines += [
        TimelineEntry(group.start, "rejected", Severity.WARNING, describe_rejections(group))
        for group in groups
    ]
    for gaps, what in ((outages, "no GNSS fix"), (silences, "nothing from the autopilot")):
        lines += [
            TimelineEntry(
                gap.start, "outage", Severity.WARNING, f"{what} for the next {gap.end - gap.start:.1f} s"
            )
            for gap in gaps
        ]
    status = flight.tables["FilterStatus"]
    rises = np.flatnonzero(np.diff(status["gnss_glitch"], prepend=0.0) > 0.0)
    text = "the autopilot's estimator reports a GNSS glitch"
    lines += [TimelineEntry(float(status["t"][k]), "glitch", Severity.WARNING, text) for k in rises]
    return sorted(lines)


#: Reason of a rejection: for the user, and its value and limit with their unit. Other reasons state their own
#: numbers.
_REASONS = {
    "late: not used": ("too late", "{value:.1f} s old (limit {limit:g} s)"),
    "older than the oldest kept state: not used": ("from before the estimate began", "{value:.1f} s old"),
    "late, and the last late answers were rejected: not used": (
        "late, as rejected ones before",
        "{value:.1f} s",
    ),
    "no channel at its time": ("no inertial channel at its time", ""),
    "excluded: false with probability": ("source excluded", "false with probability {value:.4g}"),
    "outlier: normalised squared innovation": ("outlier", "squared innovation {value:.4g} sigma²"),
    "outlier: innovation, m": ("outlier", "{value:.1f} m off"),
    "it steps: not used": ("it steps", "by {value:.1f} m/s (limit {limit:.1f} m/s)"),
    "its altitude steps: not used": ("its altitude steps", "by {value:.1f} m (limit {limit:.1f} m)"),
    "airspeed too low for the speed over ground: not used": (
        "airspeed too low for the speed over ground",
        "{value:.1f} m/s (limit {limit:g} m/s)",
    ),
    "its time stands still": ("its time stands still", "for {value:.1f} s"),
    "it is frozen: old numbers under a new time": (
        "frozen: old numbers under a new time",
        "for {value:.1f} s",
    ),
    "TIMESYNC reply of another clock": ("TIMESYNC reply of another clock", "{value:.3g} s off"),
}
#: Texts of the navigator's events, for the user.
_EVENTS = (
    (r"^navigation fixed: (.*) fixes$", r"position from \1"),
    (r"^navigation predicting: ", "position predicted: "),
    (r"^navigation untrusted: ", "position not to be trusted: "),
    (r"\bgnss\b", "GNSS"),
    (r"\brsbn (?=\d)", "beacon "),
    (r"^position from (GNSS and )?(azimuth|range)", r"position from \1beacon \2"),
    (r"\bby imu\b", "by IMU"),
    (r"^(?:sitl|(?:serial|udpin|udpout|tcp|tcpin):\S+): ", ""),
)


def reason_title(reason: str) -> str:
    """Return the reason of a rejection for the user."""
    return _REASONS.get(reason, (reason, ""))[0]


def event_title(text: str) -> str:
    """Return the text of an event for the user."""
    for pattern, words in _EVENTS:
        text = re.sub(pattern, words, text)
    return text


def describe_reason(group: RejectionGroup) -> str:
    """Describe why a group was rejected, with the worst value and its limit."""
    title, numbers = _REASONS.get(group.reason, (group.reason, ""))
    if not numbers or not math.isfinite(group.value):
        return title
    return f"{title}, {numbers.format(value=group.value, limit=group.limit)}"


def describe_rejections(group: RejectionGroup) -> str:
    """Describe a group of rejections in one line."""
    name = source_title(group.source)
    if group.number == 1:
        text = f"{name} rejected once: {describe_reason(group)}"
    else:
        duration = group.end - group.start
        text = f"{name} rejected for {duration:.1f} s, {group.number} in a row: {describe_reason(group)}"
    if math.isfinite(group.metres):
        text += f", up to {group.metres:.1f} m from the estimate"
    return text
