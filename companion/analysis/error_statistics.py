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
from companion.records import PARALLEL, Gnss, RsbnFix, Solution, Stamped
from companion.units import Floats

TruthAt = Callable[[int], Geodetic | None]

INS, GNSS, RSBN, CORRECTED = "INS alone", "GNSS fix", "RSBN fix", "corrected"
FILTERS = dict(zip(PARALLEL, ("minimax filter", "R1 filter"), strict=True))  # that run beside the leader
SOURCES = (INS, GNSS, RSBN, CORRECTED, *FILTERS.values())
USEFUL = 10.0  # a bound beyond so many times the claimed error is of no use
LIMIT_M = 5000.0  # as `predictor.limit_m`
PHASE_START_DELAY_NS = 1_000_000_000  # maximum delay from the validity of a fix to the phase it starts
_NO_LIMITS = (math.nan, math.nan, math.nan)  # bound, claim and protection level
_KINDS = ((GNSS, "GNSS"), (RSBN, "RSBN"))  # source, its word in the names of phases


class FlightPhase(NamedTuple):
    """A named interval of the flight."""

    name: str
    start_ns: int
    end_ns: int

    def covers(self, t: Floats) -> npt.NDArray[np.bool_]:
        """Return which times (s) are in it."""
        inside: npt.NDArray[np.bool_] = (t >= self.start_ns * 1e-9) & (t < self.end_ns * 1e-9)
        return inside


class PhaseErrors(NamedTuple):
    """Horizontal errors (m) of one phase: r.m.s. and 95th percentile by source, and the guaranteed bound.

    `bound` is its r.m.s. over the phase, `expected` that of the error that the estimate claims, `share` the
    error of the corrected estimate divided by the bound. A bound is judged instant by instant: `held` is
    whether every error is within the bound of that instant; one flight is no ensemble, whose r.m.s. error it
    limits. `inside` and `inside_twice` are the shares of instants within the bound, and within twice the
    bound; twice a valid bound is exceeded in at most a quarter of cases (Chebyshev). None: no bound, or no
    useful one: more than `USEFUL` times the claim or `LIMIT_M` over half of the phase.
    """

    phase: str
    seconds: float
    rms: dict[str, float]
    p95: dict[str, float]
    bound: float | None = None
    share: float | None = None
    held: bool | None = None
    inside: float | None = None
    inside_twice: float | None = None
    expected: float | None = None

    @property
    def useful(self) -> bool:
        """Whether the bound of the phase, if there is one, is of use."""
        return self.held is not None


class ErrorSeries(NamedTuple):
    """Horizontal errors over a flight: times (ns), errors (m); bound, claimed r.m.s. error and protection
    level (m), NaN if there is none.
    """

    t_ns: npt.NDArray[np.int64]
    error: Floats
    bound: Floats
    claimed: Floats
    protection: Floats

    @property
    def t(self) -> Floats:
        """Times, s."""
        return np.asarray(self.t_ns * 1e-9, dtype=np.float64)


def horizontal_errors(records: Iterable[Stamped], truth: TruthAt) -> dict[str, ErrorSeries]:
    """Return the horizontal error of every source against `truth`, which returns None where unknown."""
    found: dict[str, list[tuple[float, ...]]] = defaultdict(list)

    def add(source: str, t_ns: int, place: Geodetic, limits: tuple[float, float, float] = _NO_LIMITS) -> None:
        true = truth(t_ns)
        if true is not None:
            north, east, _ = separation(place, true)
            found[source].append((t_ns, math.hypot(north, east), *limits))

    last: Gnss | None = None
    for record in records:
        if isinstance(record, Solution):
            bound = math.nan if record.bound_n is None else math.hypot(*record.bound_n)
            corrected = Geodetic(record.lat, record.lon, record.alt_msl)
            claimed = math.sqrt(record.covariance[0] + record.covariance[3])
            protection = math.nan if record.protection is None else record.protection
            add(CORRECTED, record.t_ns, corrected, (bound, claimed, protection))
            inertial = displace(*corrected, *record.error_n, 0.0)
            add(INS, record.t_ns, inertial)
            for p in record.parallel:
                add(FILTERS[p.estimator], record.t_ns, displace(*inertial, -p.error_n[0], -p.error_n[1], 0.0))
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


def root_mean_square(x: npt.ArrayLike) -> float:
    """Return the r.m.s. of all numbers of an array, in their unit."""
    return float(np.sqrt(np.mean(np.square(x))))


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
    row = PhaseErrors(phase.name, (phase.end_ns - phase.start_ns) * 1e-9, {}, {})
    for source, e in found.items():
        end_ns = phase.end_ns - PHASE_START_DELAY_NS * (source in starting_sources)
        within = (e.t_ns >= phase.start_ns) & (e.t_ns < end_ns)
        if not within.any():
            continue
        error = e.error[within]
        row.rms[source] = root_mean_square(error)
        row.p95[source] = float(np.percentile(error, 95.0))
        if np.isfinite(e.bound[within]).any():
            row = _with_bound(row, error, e.bound[within], e.claimed[within])
        if source == CORRECTED and np.isfinite(e.claimed[within]).any():
            row = row._replace(expected=float(np.sqrt(np.nanmean(e.claimed[within] ** 2))))
    return row


def _with_bound(row: PhaseErrors, error: Floats, bound: Floats, claimed: Floats) -> PhaseErrors:
    known = np.isfinite(bound)
    error, bound, claimed = error[known], bound[known], claimed[known]
    row = row._replace(bound=(bound_rms := root_mean_square(bound)))
    if np.mean((bound > LIMIT_M) | (bound > USEFUL * claimed)) > 0.5:
        return row
    inside, twice = (float(np.mean(error <= k * bound)) for k in (1.0, 2.0))
    share = root_mean_square(error) / bound_rms
    return row._replace(share=share, held=inside == 1.0, inside=inside, inside_twice=twice)
