"""How far off everything was: the INS alone, each fix and the corrected estimate against the truth, by phase.

Records in, a table of numbers out. The truth is a function of time, so that a simulator's exact one, a logged
one and a smoothed track serve alike. It knows nothing of files and of where the phases come from.
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Callable, Iterable, Sequence
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from companion.nav.geometry import Geodetic, displace, from_enu, separation
from companion.records import Gnss, RsbnFix, Solution, Stamped

Floats = npt.NDArray[np.float64]
TruthAt = Callable[[int], Geodetic | None]

INS, GNSS, RSBN, CORRECTED = "INS alone", "GNSS fix", "RSBN fix", "corrected"
SOURCES = (INS, GNSS, RSBN, CORRECTED)
OPENING_NS = 1_000_000_000  # a fix opens a phase no later than this after the time it is valid for
_KINDS = ((GNSS, "GNSS"), (RSBN, "RSBN"))  # as they stand in the names of phases


class Phase(NamedTuple):
    """A stretch of the flight."""

    name: str
    start_ns: int
    end_ns: int


class Row(NamedTuple):
    """Horizontal errors (m) of one phase: r.m.s. and 95th percentile by source, and the guaranteed bound.

    The bound is on the r.m.s. error, so it is judged by r.m.s.: `bound` is its own over the phase, `share`
    the corrected estimate's as a part of it, `held` whether that is at most 1. For information, `inside` and
    `inside_twice` are the shares of instants within the bound, and within twice the bound, of their own
    moment; twice a bound that holds is passed in a quarter of cases at most (Chebyshev). None without bound.
    """

    phase: str
    seconds: float
    rms: dict[str, float]
    p95: dict[str, float]
    bound: float | None
    share: float | None
    held: bool | None
    inside: float | None
    inside_twice: float | None


class Errors(NamedTuple):
    """Horizontal errors over a flight: times (ns), metres, and the bound where there is one, else NaN."""

    t_ns: npt.NDArray[np.int64]
    error: Floats
    bound: Floats


def errors(records: Iterable[Stamped], truth: TruthAt) -> dict[str, Errors]:
    """The horizontal error of every source against `truth`, which is None where it is not known."""
    found: dict[str, list[tuple[int, float, float]]] = defaultdict(list)

    def add(source: str, t_ns: int, place: Geodetic, bound: float = math.nan) -> None:
        true = truth(t_ns)
        if true is not None:
            north, east, _ = separation(place, true)
            found[source].append((t_ns, math.hypot(north, east), bound))

    last: Gnss | None = None
    for record in records:
        if isinstance(record, Solution):
            bound = math.nan if record.bound_n is None else math.hypot(*record.bound_n)
            corrected = Geodetic(record.lat, record.lon, record.alt_msl)
            add(CORRECTED, record.t_ns, corrected, bound)
            add(INS, record.t_ns, displace(*corrected, *record.error_n, 0.0))
        elif isinstance(record, Gnss) and record.fix >= 3 and (last is None or not record.repeats(last)):
            last = record
            add(GNSS, record.t_ns, Geodetic(record.lat, record.lon, record.alt_msl))
        elif isinstance(record, RsbnFix):
            true = truth(record.t_ns)
            if true is not None and (place := beacon_fix(record, true.alt)) is not None:
                add(RSBN, record.t_ns, place)
    return {
        source: Errors(*(np.array(column) for column in zip(*rows, strict=True)))
        for source, rows in found.items()
    }


def beacon_fix(record: RsbnFix, alt: float) -> Geodetic | None:
    """The place that a beacon's azimuth and slant range alone give at height `alt` (m); None without both."""
    if record.azimuth is None or record.slant_range is None:
        return None
    beacon = Geodetic(record.lat, record.lon, record.alt)
    return beacon_place(beacon, record.azimuth, record.slant_range, alt)


def beacon_place(beacon: Geodetic, azimuth: float, slant_range: float, alt: float) -> Geodetic:
    """The place at height `alt` (m) that is seen from `beacon` under `azimuth` at `slant_range`."""
    up = alt - beacon.alt
    distance = math.sqrt(max(slant_range**2 - up * up, 0.0))
    for _ in range(2):  # the height over the beacon's tangent plane, the earth falling away below it
        place = from_enu(np.array([distance * math.sin(azimuth), distance * math.cos(azimuth), up]), beacon)
        up += alt - place.alt
        distance = math.sqrt(max(slant_range**2 - up * up, 0.0))
    return place


def table(found: dict[str, Errors], phases: Sequence[Phase]) -> list[Row]:
    """One row a phase. The fix that opens a phase is valid a moment before it, and counts in none."""
    rows = []
    for phase, following in zip(phases, [*phases[1:], None]):
        opening = {
            source
            for source, kind in _KINDS
            if following and kind in following.name and kind not in phase.name
        }
        rows.append(_row(found, phase, opening))
    return rows


def _row(found: dict[str, Errors], phase: Phase, opening: set[str]) -> Row:
    rms, p95 = {}, {}
    judged: tuple[float, float, bool, float, float] | tuple[None, ...] = (None,) * 5
    for source, e in found.items():
        end_ns = phase.end_ns - OPENING_NS * (source in opening)
        within = (e.t_ns >= phase.start_ns) & (e.t_ns < end_ns)
        if not within.any():
            continue
        error = e.error[within]
        rms[source] = float(np.sqrt(np.mean(error**2)))
        p95[source] = float(np.percentile(error, 95.0))
        if np.isfinite(e.bound[within]).any():
            judged = _judged(error, e.bound[within])
    return Row(phase.name, (phase.end_ns - phase.start_ns) * 1e-9, rms, p95, *judged)


def _judged(error: Floats, bound: Floats) -> tuple[float, float, bool, float, float]:
    """Bound, share, held, inside and inside_twice of `Row`, where there is a bound."""
    known = np.isfinite(bound)
    error, bound = error[known], bound[known]
    promised = float(np.sqrt(np.mean(bound**2)))
    share = float(np.sqrt(np.mean(error**2))) / promised
    inside, twice = (float(np.mean(error <= k * bound)) for k in (1.0, 2.0))
    return promised, share, share <= 1.0, inside, twice
