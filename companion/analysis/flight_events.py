"""What happened on a flight: the phases it falls into, outages, refusals in a row, the pace of messages.

Arrays in (`gather`), rows out. It knows nothing of errors and of what is true.
"""

from __future__ import annotations

import math
from itertools import groupby
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from companion.analysis import error_statistics
from companion.analysis.flight_arrays import MODES, Flight, Floats, Refused, Stream, Table, Told
from companion.nav.earth import radii
from companion.records import Mode, Source

SHORT_S = 5.0  # a phase shorter than this belongs to the one before it, the first to the next
TOGETHER_S = 3.0  # refusals of one source closer than this are one event
LOST_S = 5.0  # without GNSS for longer than this is an outage
RADIO = Source.AZIMUTH | Source.RANGE


class Group(NamedTuple):
    """Refusals of one source in a row: from, to (s), how many, the worst value against its limit."""

    start: float
    end: float
    source: str
    reason: str
    number: int
    value: float
    limit: float
    metres: float  # how far the farthest of them was off the estimate; NaN where it is not known


class Outage(NamedTuple):
    """No GNSS fix from `start` to `end` (s)."""

    start: float
    end: float


class Rate(NamedTuple):
    """One topic: messages, mean rate (Hz), longest gap (s) and its start, latency (s) median and 95 %."""

    topic: str
    number: int
    hz: float
    gap: float
    gap_at: float
    latency: float
    latency_95: float


def usable_gnss(flight: Flight) -> Table:
    """The columns of 3D fixes alone."""
    gnss = flight.tables["Gnss"]
    return {name: column[gnss["fix"] >= 3] for name, column in gnss.items()}


def latency(flight: Flight, topic: str) -> tuple[Floats, Floats]:
    """When each message of `topic` arrived and how late it was, s; of GNSS the new fixes alone."""
    of_gnss = topic == "/in/Gnss"
    t, rx = (usable_gnss(flight)[name] for name in ("t", "rx")) if of_gnss else flight.streams[topic]
    return rx, rx - t


def is_radio(flight: Flight) -> npt.NDArray[np.bool_]:
    """Which rows of "Fix" rest on beacons and not on GNSS."""
    sources = flight.tables["Fix"]["sources"].astype(int)
    found: npt.NDArray[np.bool_] = ((sources & int(RADIO)) != 0) & ((sources & int(Source.GNSS)) == 0)
    return found


def phases(solution: Table, seconds: float) -> list[error_statistics.Phase]:
    """Stretches of one footing: which fixes, or none and predicted, or not even that."""
    names = [
        _footing(MODES[int(mode)], int(sources))
        for mode, sources in zip(solution["mode"], solution["sources"], strict=True)
    ]
    runs: list[tuple[str, float]] = []
    k = 0
    for name, group in groupby(names):
        count = len(list(group))
        end = k + count
        lasts = (solution["t"][end] if end < len(names) else seconds) - solution["t"][k]
        if not runs or (lasts >= SHORT_S and runs[-1][0] != name):
            runs.append((name, float(solution["t"][k])))
        k = end
    if len(runs) > 1 and runs[1][1] - runs[0][1] < SHORT_S:
        runs[:2] = [(runs[1][0], runs[0][1])]
    starts = [round(start * 1e9) for _, start in runs] + [round(seconds * 1e9)]
    return [error_statistics.Phase(name, starts[i], starts[i + 1]) for i, (name, _) in enumerate(runs)]


def _footing(mode: Mode, sources: int) -> str:
    if mode is not Mode.FIXED:
        return {Mode.PREDICTING: "prediction", Mode.UNTRUSTED: "untrusted"}.get(mode, str(mode))
    names = [name for bits, name in ((Source.GNSS, "GNSS"), (RADIO, "RSBN")) if sources & int(bits)]
    return " + ".join(names) or "fixes"


def outages(flight: Flight) -> list[Outage]:
    """Holes between the arrivals of usable GNSS fixes, and the end without any, once there was one."""
    t = np.sort(usable_gnss(flight)["rx"])
    if not len(t):
        return []
    t = np.append(t, max(flight.seconds, t[-1]))
    return [Outage(float(t[k]), float(t[k + 1])) for k in np.flatnonzero(np.diff(t) > LOST_S)]


def groups(flight: Flight) -> list[Group]:
    """Refusals of one source for one reason, in a row, are one event."""
    rows: list[list[Refused]] = []
    for refused in sorted(flight.refused, key=lambda r: (r.source, r.reason, r.t)):
        last = rows[-1][-1] if rows else None
        if last is not None and last[1:3] == refused[1:3] and refused.t - last.t <= TOGETHER_S:
            rows[-1].append(refused)
        else:
            rows.append([refused])
    return sorted(_group(flight, row) for row in rows)


def _group(flight: Flight, row: list[Refused]) -> Group:
    values = [r.value for r in row if math.isfinite(r.value)]
    limits = [r.limit for r in row if math.isfinite(r.limit)]
    return Group(
        row[0].t,
        row[-1].t,
        row[0].source,
        row[0].reason,
        len(row),
        max(values, default=math.nan),
        min(limits, default=math.nan),
        _farthest(flight, row) if row[0].source.startswith("gnss") else math.nan,
    )


def _farthest(flight: Flight, row: list[Refused]) -> float:
    """How far the GNSS fixes refused in `row` were off the estimate at most, m."""
    gnss, solution = usable_gnss(flight), flight.tables["Solution"]
    within = (gnss["t"] >= row[0].t - 1e-3) & (gnss["t"] <= row[-1].t + 1e-3)
    if not within.any() or len(solution["t"]) < 2:
        return math.nan
    order = np.argsort(solution["t"], kind="stable")
    t, lat, lon = (solution[name][order] for name in ("t", "lat", "lon"))
    north = gnss["lat"][within] - np.interp(gnss["t"][within], t, lat)
    east = gnss["lon"][within] - np.interp(gnss["t"][within], t, lon)
    R_N, R_E = radii(float(lat[0]))
    return float(np.max(np.hypot(north * R_N, east * R_E * math.cos(lat[0]))))


def rate(topic: str, stream: Stream, latency: Floats) -> Rate:
    """The pace of one topic; `latency` (s) of what was new in it."""
    rx = stream.rx
    gaps = np.diff(rx)
    worst = int(np.argmax(gaps)) if len(gaps) else 0
    span = float(rx[-1] - rx[0])
    return Rate(
        topic,
        len(rx),
        (len(rx) - 1) / span if span > 0.0 else math.nan,
        float(gaps[worst]) if len(gaps) else math.nan,
        float(rx[worst]),
        float(np.median(latency)) if len(latency) else math.nan,
        float(np.percentile(latency, 95.0)) if len(latency) else math.nan,
    )


def timeline(flight: Flight, groups: list[Group], outages: list[Outage]) -> list[Told]:
    """The log's own lines, and what was found: refusals by groups, outages, what the autopilot flagged."""
    lines = list(flight.told)
    lines += [Told(group.start, "refused", 4, refusal(group)) for group in groups]
    lines += [
        Told(hole.start, "outage", 4, f"no GNSS fix for {hole.end - hole.start:.1f} s from here")
        for hole in outages
    ]
    status = flight.tables["FilterStatus"]
    rises = np.flatnonzero(np.diff(status["gnss_glitch"], prepend=0.0) > 0.0)
    said = "the autopilot's estimator reports a GNSS glitch"
    lines += [Told(float(status["t"][k]), "glitch", 4, said) for k in rises]
    return sorted(lines)


def refusal(group: Group) -> str:
    """A group of refusals in words."""
    name = group.source.upper() if group.source.lower().startswith(("gnss", "rsbn")) else group.source
    if group.number == 1:
        text = f"{name} refused once: {group.reason}"
    else:
        lasts = group.end - group.start
        text = f"{name} refused for {lasts:.1f} s, {group.number} in a row: {group.reason}"
    if math.isfinite(group.metres):
        text += f", up to {group.metres:.1f} m off the estimate"
    if math.isfinite(group.value):
        limit = f" against {group.limit:.3g}" if math.isfinite(group.limit) else ""
        text += f" (value {group.value:.3g}{limit})"
    return text
