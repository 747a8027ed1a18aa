"""Assessment of a flight: errors against the best available reference, and their consistency with sigmas.

Errors are estimate minus reference, horizontal, metres.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from companion.analysis import error_statistics, flight_events
from companion.analysis.flight_arrays import Flight, Table, TimelineEntry
from companion.analysis.flight_events import MessageRate, OutageInterval, RejectionGroup, usable_gnss
from companion.analysis.smoothing import join_runs, smooth_flight
from companion.nav.earth import radii
from companion.nav.geometry import Geodetic
from companion.storage.run_metadata import configuration_in
from companion.units import Floats

REACH_S = 2.0  # no interpolation of the reference across a longer gap

TRUTH, SMOOTHED, GNSS = "the simulator's truth", "the smoothed track", "GNSS itself"


class ReferenceTrack(NamedTuple):
    """Track that errors are measured against: its name `what`, t (s), lat, lon (rad), alt (m), all (n,)."""

    what: str
    t: Floats
    lat: Floats
    lon: Floats
    alt: Floats


class NormalizedErrors(NamedTuple):
    """Squared errors normalized by their covariance: name, times (s), values, degrees of freedom, (n,)."""

    what: str
    t: Floats
    value: Floats
    degrees_of_freedom: Floats

    @property
    def inside(self) -> float:
        """Share of the values below the 95 % quantile of chi-square."""
        return float(np.mean(self.value <= chi2_95(self.degrees_of_freedom)))

    @property
    def mean(self) -> float:
        """Mean of value / degrees of freedom: about 1 if the sigmas are correct."""
        return float(np.mean(self.value / self.degrees_of_freedom))


def chi2_95(degrees_of_freedom: Floats) -> Floats:
    """Return the 95 % quantile of chi-square."""
    from scipy.special import gammaincinv  # 0.2 s: for a report with sigmas only

    return np.asarray(2.0 * gammaincinv(0.5 * degrees_of_freedom, 0.95), dtype=np.float64)


@dataclass(frozen=True, slots=True, eq=False)
class Assessment:
    """All numbers of a report on one flight; `errors` by source, times in ns since t = 0.

    `offset` is that of the solutions from the reference, north and east (m); empty without either.
    """

    flight: Flight
    origin: tuple[float, float]
    reference: ReferenceTrack | None
    phases: list[error_statistics.FlightPhase]
    rows: list[error_statistics.PhaseErrors]
    errors: dict[str, error_statistics.ErrorSeries]
    offset: dict[str, Floats]
    normalized_errors: list[NormalizedErrors]
    groups: list[RejectionGroup]
    outages: list[OutageInterval]
    silences: list[OutageInterval]
    rates: list[MessageRate]
    timeline: list[TimelineEntry]

    @property
    def against_truth(self) -> bool:
        """Whether the reference is the truth; another track may be wrong itself."""
        return self.reference is not None and self.reference.what == TRUTH

    def north_east(self, lat: Floats, lon: Floats) -> tuple[Floats, Floats]:
        """Convert to a local plane at the first position of the flight, m; for maps."""
        R_N, R_E = radii(self.origin[0])
        lat_0, lon_0 = self.origin
        return (lat - lat_0) * R_N, _wrap(lon - lon_0) * R_E * math.cos(lat_0)


def deviation(*flights: Assessment) -> str:
    """Return the word for what is measured against the reference: an error only against a truth."""
    return "error" if all(a.against_truth for a in flights) else "distance"


def assess_flight(flight: Flight) -> Assessment:
    """Compute all numbers of the report on `flight`."""
    reference = _select_reference(flight)
    phases = flight_events.split_phases(flight.tables["Solution"], flight.seconds)
    offset = {} if reference is None else _solution_offset(flight, reference)
    errors = {} if reference is None else _source_errors(flight, reference, offset)
    groups = flight_events.group_rejections(flight)
    silences = flight_events.find_silences(flight)
    outages = flight_events.find_gnss_outages(flight, silences)
    return Assessment(
        flight=flight,
        origin=_origin(flight),
        reference=reference,
        phases=phases,
        rows=error_statistics.summarize_phases(errors, phases),
        errors=errors,
        offset=offset,
        normalized_errors=_normalized_errors(flight, reference, offset),
        groups=groups,
        outages=outages,
        silences=silences,
        rates=[flight_events.message_rate(flight, topic) for topic in flight.streams],
        timeline=flight_events.build_timeline(flight, groups, outages, silences),
    )


def _origin(flight: Flight) -> tuple[float, float]:
    for table in (flight.tables["Solution"], usable_gnss(flight), flight.tables["Truth"]):
        if len(table["t"]):
            return float(table["lat"][0]), float(table["lon"][0])
    return 0.0, 0.0


# -- reference and errors --------------------------------------------------------------------------------


def _select_reference(flight: Flight) -> ReferenceTrack | None:
    """Return the truth if logged, else the track smoothed with all fixes, else GNSS, else None."""
    truth, gnss = flight.tables["Truth"], usable_gnss(flight)
    if len(truth["t"]) > 1:
        return _track_from(TRUTH, truth["t"], truth["lat"], truth["lon"], truth["alt"])
    try:
        runs = smooth_flight(flight.smoother_inputs, configuration_in(flight.metadata, flight.name))
    except ValueError:
        if len(gnss["t"]) > 1:
            return _track_from(GNSS, gnss["t"], gnss["lat"], gnss["lon"], gnss["alt"])
        return None
    t_ns, lat, lon, alt = join_runs(runs)
    return _track_from(SMOOTHED, 1e-9 * (t_ns - flight.zero_ns), lat, lon, alt)


def _track_from(what: str, t: npt.ArrayLike, lat: Floats, lon: Floats, alt: Floats) -> ReferenceTrack:
    t, first = np.unique(np.asarray(t, dtype=np.float64), return_index=True)
    return ReferenceTrack(what, t, lat[first], np.unwrap(lon[first]), alt[first])


def _interpolate(reference: ReferenceTrack, t: Floats) -> tuple[Floats, Floats]:
    """Return latitude and longitude of the reference at times `t`, NaN beyond its ends and in its gaps."""
    k = np.clip(np.searchsorted(reference.t, t), 1, len(reference.t) - 1)
    known = (t >= reference.t[0]) & (t <= reference.t[-1]) & (reference.t[k] - reference.t[k - 1] <= REACH_S)
    lat = np.where(known, np.interp(t, reference.t, reference.lat), np.nan)
    return lat, np.where(known, np.interp(t, reference.t, reference.lon), np.nan)


def _offset_from(reference: ReferenceTrack, t: Floats, lat: Floats, lon: Floats) -> tuple[Floats, Floats]:
    """Return the offset of a track from the reference, north and east, m."""
    lat_0, lon_0 = _interpolate(reference, t)
    if not np.isfinite(lat_0).any():
        return lat_0, lon_0
    R_N, R_E = radii(float(np.nanmean(lat_0)))
    north: Floats = (lat - lat_0) * R_N
    east: Floats = _wrap(lon - lon_0) * R_E * np.cos(lat_0)
    return north, east


def _wrap(angle: Floats) -> Floats:
    wrapped: Floats = (angle + math.pi) % math.tau - math.pi
    return wrapped


def _solution_offset(flight: Flight, reference: ReferenceTrack) -> dict[str, Floats]:
    solution = flight.tables["Solution"]
    if not len(solution["t"]):
        return {}
    offset = _offset_from(reference, solution["t"], solution["lat"], solution["lon"])
    return dict(zip(("north", "east"), offset, strict=True))


def _source_errors(
    flight: Flight, reference: ReferenceTrack, offset: dict[str, Floats]
) -> dict[str, error_statistics.ErrorSeries]:
    found = dict[str, error_statistics.ErrorSeries]()
    if offset:
        found |= _solution_errors(flight.tables["Solution"], offset["north"], offset["east"])
    beacons, gnss = _beacon_positions(flight, reference), usable_gnss(flight)
    off = _offset_from(reference, beacons["t"], beacons["lat"], beacons["lon"])
    found[error_statistics.RSBN] = _error_series(beacons["t"], *off)
    if reference.what != GNSS:
        off = _offset_from(reference, gnss["t"], gnss["lat"], gnss["lon"])
        unknown = np.full(len(gnss["t"]), np.nan)
        claimed = math.sqrt(2.0) * gnss["sigma"]
        found[error_statistics.GNSS] = _error_series(gnss["t"], *off, unknown, claimed, unknown)
    return {
        source: found[source]
        for source in error_statistics.SOURCES
        if source in found and len(found[source].t_ns)
    }


def _solution_errors(solution: Table, north: Floats, east: Floats) -> dict[str, error_statistics.ErrorSeries]:
    """Return the errors of the corrected estimate, of the INS and of the filters beside the leader."""
    t = solution["t"]
    bound = np.hypot(solution["bound_north"], solution["bound_east"])
    claimed = np.sqrt(solution["nn"] + solution["ee"])
    ins_north, ins_east = north + solution["error_north"], east + solution["error_east"]
    found = {
        error_statistics.CORRECTED: _error_series(t, north, east, bound, claimed, solution["protection"]),
        error_statistics.INS: _error_series(t, ins_north, ins_east),
    }
    for name, title in error_statistics.FILTERS.items():
        off = ins_north - solution[f"{name}_north"], ins_east - solution[f"{name}_east"]
        found[title] = _error_series(t, *off)
    return found


def _beacon_positions(flight: Flight, reference: ReferenceTrack) -> Table:
    """Return the position that each beacon measurement alone gives, as in `error_statistics`."""
    fixes = flight.tables["RsbnFix"]
    complete = np.isfinite(fixes["azimuth"] + fixes["slant"])
    t, *columns = (fixes[name][complete] for name in ("t", "lat", "lon", "alt", "azimuth", "slant"))
    positions = [
        error_statistics.intersect_azimuth_range(Geodetic(lat, lon, alt), azimuth, slant, true_alt)
        for lat, lon, alt, azimuth, slant, true_alt in zip(
            *(column.tolist() for column in columns), np.interp(t, reference.t, reference.alt).tolist()
        )
    ]
    return {"t": t, "lat": np.array([p.lat for p in positions]), "lon": np.array([p.lon for p in positions])}


def _error_series(t: Floats, north: Floats, east: Floats, *limits: Floats) -> error_statistics.ErrorSeries:
    """Return the errors where they are known; `limits`: bound, claim and protection level, if there are."""
    error = np.hypot(north, east)
    known = np.isfinite(error)
    columns = [column[known] for column in limits or (np.full(len(t), np.nan),) * 3]
    return error_statistics.ErrorSeries(np.round(t[known] * 1e9).astype(np.int64), error[known], *columns)


# -- consistency -----------------------------------------------------------------------------------------


def _normalized_errors(
    flight: Flight, reference: ReferenceTrack | None, offset: dict[str, Floats]
) -> list[NormalizedErrors]:
    fix, solution = flight.tables["Fix"], flight.tables["Solution"]
    found = []
    redundant = fix["degrees_of_freedom"] > 0
    # a single GNSS position with a height has no residual
    if fix["cost"][redundant].max(initial=0.0) > 1e-9:
        columns = (fix[name][redundant] for name in ("t", "cost", "degrees_of_freedom"))
        found.append(NormalizedErrors("lines of position", *columns))
    if reference is not None and reference.what == TRUTH and offset:
        value = _mahalanobis_squared(**offset, **{name: solution[name] for name in ("nn", "ne", "ee")})
        known = np.isfinite(value)
        if known.any():
            two = np.full(int(known.sum()), 2.0)
            found.append(NormalizedErrors("NEES", solution["t"][known], value[known], two))
    return found


def _mahalanobis_squared(north: Floats, east: Floats, nn: Floats, ne: Floats, ee: Floats) -> Floats:
    value: Floats = (ee * north**2 - 2.0 * ne * north * east + nn * east**2) / (nn * ee - ne**2)
    return value
