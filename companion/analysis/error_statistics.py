"""Error statistics: INS, fixes and corrected estimate against the truth, by phase of the flight.

The truth is a function of time, so that a simulator, a log or a smoothed track can provide it.
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
from companion.units import Floats

TruthAt = Callable[[int], Geodetic | None]

INS, GNSS, RSBN, CORRECTED = "INS alone", "GNSS fix", "RSBN fix", "corrected"
SOURCES = (INS, GNSS, RSBN, CORRECTED)
PHASE_START_DELAY_NS = 1_000_000_000  # maximum delay from the validity of a fix to the phase it starts
_KINDS = ((GNSS, "GNSS"), (RSBN, "RSBN"))  # source, its word in the names of phases


class FlightPhase(NamedTuple):
    """A named interval of the flight."""

    name: str
    start_ns: int
    end_ns: int


class PhaseErrors(NamedTuple):
    """Horizontal errors (m) of one phase: r.m.s. and 95th percentile by source, and the guaranteed bound.

    The bound limits the r.m.s. error, so r.m.s. values are compared: `bound` is that of the phase, `share`
    the error of the corrected estimate divided by it, `held` whether `share` is at most 1. `inside` and
    `inside_twice` are the shares of instants with an error within the bound, and within twice the bound, of
    that instant; twice a valid bound is exceeded in at most a quarter of cases (Chebyshev). None: no bound.
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


class ErrorSeries(NamedTuple):
    """Horizontal errors over a flight: times (ns), errors (m), and the bound (m), NaN if there is none."""

    t_ns: npt.NDArray[np.int64]
    error: Floats
    bound: Floats


def horizontal_errors(records: Iterable[Stamped], truth: TruthAt) -> dict[str, ErrorSeries]:
    """Return the horizontal error of every source against `truth`, which returns None where unknown."""
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
        elif isinstance(record, Gnss) and record.has_3d_fix and (last is None or not record.repeats(last)):
            last = record
            add(GNSS, record.t_ns, Geodetic(record.lat, record.lon, record.alt_msl))
        elif isinstance(record, RsbnFix):
            true = truth(record.t_ns)
            if true is not None and (place := position_from_beacon(record, true.alt)) is not None:
                add(RSBN, record.t_ns, place)
    return {
        source: ErrorSeries(*(np.array(column) for column in zip(*rows, strict=True)))
        for source, rows in found.items()
    }


def position_from_beacon(record: RsbnFix, alt: float) -> Geodetic | None:
    """Return the position from azimuth and slant range at height `alt` (m); None if either is missing."""
    if record.azimuth is None or record.slant_range is None:
        return None
    beacon = Geodetic(record.lat, record.lon, record.alt)
    return intersect_azimuth_range(beacon, record.azimuth, record.slant_range, alt)


def intersect_azimuth_range(beacon: Geodetic, azimuth: float, slant_range: float, alt: float) -> Geodetic:
    """Return the position at height `alt` (m), at `azimuth` and `slant_range` from `beacon`."""
    up = alt - beacon.alt
    distance = math.sqrt(max(slant_range**2 - up * up, 0.0))
    for _ in range(2):  # iterate the height above the tangent plane of the beacon: the earth is curved
        place = from_enu(np.array([distance * math.sin(azimuth), distance * math.cos(azimuth), up]), beacon)
        up += alt - place.alt
        distance = math.sqrt(max(slant_range**2 - up * up, 0.0))
    return place


def summarize_phases(found: dict[str, ErrorSeries], phases: Sequence[FlightPhase]) -> list[PhaseErrors]:
    """Return one row per phase. The fix that starts a phase is valid just before it and is not counted."""
    rows = []
    for phase, following in zip(phases, [*phases[1:], None]):
        starting_sources = {
            source
            for source, kind in _KINDS
            if following and kind in following.name and kind not in phase.name
        }
        rows.append(_summarize_phase(found, phase, starting_sources))
    return rows


def _summarize_phase(
    found: dict[str, ErrorSeries], phase: FlightPhase, starting_sources: set[str]
) -> PhaseErrors:
    rms, p95 = {}, {}
    compared: tuple[float, float, bool, float, float] | tuple[None, ...] = (None,) * 5
    for source, e in found.items():
        end_ns = phase.end_ns - PHASE_START_DELAY_NS * (source in starting_sources)
        within = (e.t_ns >= phase.start_ns) & (e.t_ns < end_ns)
        if not within.any():
            continue
        error = e.error[within]
        rms[source] = float(np.sqrt(np.mean(error**2)))
        p95[source] = float(np.percentile(error, 95.0))
        if np.isfinite(e.bound[within]).any():
            compared = _compare_with_bound(error, e.bound[within])
    return PhaseErrors(phase.name, (phase.end_ns - phase.start_ns) * 1e-9, rms, p95, *compared)


def _compare_with_bound(error: Floats, bound: Floats) -> tuple[float, float, bool, float, float]:
    """Return bound, share, held, inside and inside_twice of `PhaseErrors`."""
    known = np.isfinite(bound)
    error, bound = error[known], bound[known]
    bound_rms = float(np.sqrt(np.mean(bound**2)))
    share = float(np.sqrt(np.mean(error**2))) / bound_rms
    inside, twice = (float(np.mean(error <= k * bound)) for k in (1.0, 2.0))
    return bound_rms, share, share <= 1.0, inside, twice
