"""What became of a flight in numbers: errors against the best track there is, and whether they fit sigmas.

Arrays in (`gather`), arrays and rows out; the words are `verdict`'s and the pictures `figures`'. Errors are
estimate minus reference, horizontal, metres.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.special import gammaincinv

from companion.analysis import error_statistics, flight_events
from companion.analysis.flight_arrays import Flight, Floats, Table, Told
from companion.analysis.flight_events import Group, Outage, Rate, usable_gnss
from companion.analysis.replay import CONFIGURATION
from companion.analysis.smoothing import joined, smooth_flight
from companion.config import Config, parse
from companion.nav.earth import radii
from companion.nav.geometry import Geodetic

REACH_S = 2.0  # a reference is not carried across a longer hole

TRUTH, SMOOTHED, GNSS = "the simulator's truth", "the smoothed track", "GNSS itself"


class Reference(NamedTuple):
    """What errors are counted from: `what` it is, and a track, t (s), lat, lon (rad), alt (m), all (n,)."""

    what: str
    t: Floats
    lat: Floats
    lon: Floats
    alt: Floats


class Misfit(NamedTuple):
    """Squared errors by their covariance: times (s), values (n,), degrees of freedom (n,) and what it is."""

    what: str
    t: Floats
    value: Floats
    freedom: Floats

    @property
    def inside(self) -> float:
        """The share below the 95 % quantile of chi-square."""
        return float(np.mean(self.value <= chi2_95(self.freedom)))

    @property
    def mean(self) -> float:
        """Of the values over their degrees of freedom: about 1 where sigmas are right."""
        return float(np.mean(self.value / self.freedom))


def chi2_95(freedom: Floats) -> Floats:
    """The 95 % quantile of chi-square."""
    return np.asarray(2.0 * gammaincinv(0.5 * freedom, 0.95), dtype=np.float64)


@dataclass(frozen=True, slots=True, eq=False)
class Assessment:
    """All numbers of a report on one flight; `errors` by source as in `score`, times there ns since t = 0."""

    flight: Flight
    origin: tuple[float, float]
    reference: Reference | None
    phases: list[error_statistics.Phase]
    rows: list[error_statistics.Row]
    errors: dict[str, error_statistics.Errors]
    ins_error: dict[str, Floats]
    misfits: list[Misfit]
    groups: list[Group]
    outages: list[Outage]
    rates: list[Rate]
    timeline: list[Told]

    def north_east(self, lat: Floats, lon: Floats) -> tuple[Floats, Floats]:
        """A local plane at the flight's first position, m; for maps."""
        R_N, R_E = radii(self.origin[0])
        lat_0, lon_0 = self.origin
        return (lat - lat_0) * R_N, _wrapped(lon - lon_0) * R_E * math.cos(lat_0)


def assess(flight: Flight) -> Assessment:
    """Everything there is to say of `flight` in numbers."""
    reference = _reference(flight)
    phases = flight_events.phases(flight.tables["Solution"], flight.seconds)
    errors = {} if reference is None else _errors(flight, reference)
    groups = flight_events.groups(flight)
    outages = flight_events.outages(flight)
    return Assessment(
        flight=flight,
        origin=_origin(flight),
        reference=reference,
        phases=phases,
        rows=error_statistics.table(errors, phases),
        errors=errors,
        ins_error=_ins_error(flight, reference),
        misfits=_misfits(flight, reference),
        groups=groups,
        outages=outages,
        rates=[
            flight_events.rate(topic, stream, flight_events.latency(flight, topic)[1])
            for topic, stream in flight.streams.items()
        ],
        timeline=flight_events.timeline(flight, groups, outages),
    )


def _origin(flight: Flight) -> tuple[float, float]:
    for table in (flight.tables["Solution"], usable_gnss(flight), flight.tables["Truth"]):
        if len(table["t"]):
            return float(table["lat"][0]), float(table["lon"][0])
    return 0.0, 0.0


# -- against what ----------------------------------------------------------------------------------------


def _reference(flight: Flight) -> Reference | None:
    """Truth where the log has it, else the track smoothed with all fixes, else GNSS, else nothing."""
    truth, gnss = flight.tables["Truth"], usable_gnss(flight)
    if len(truth["t"]) > 1:
        return _ordered(TRUTH, truth["t"], truth["lat"], truth["lon"], truth["alt"])
    try:
        runs = smooth_flight(flight.heard, configuration(flight))
    except ValueError:
        if len(gnss["t"]) > 1:
            return _ordered(GNSS, gnss["t"], gnss["lat"], gnss["lon"], gnss["alt"])
        return None
    t_ns, lat, lon, alt = joined(runs)
    return _ordered(SMOOTHED, 1e-9 * (t_ns - flight.zero_ns), lat, lon, alt)


def configuration(flight: Flight) -> Config:
    """What flew, the defaults where the log does not say."""
    text = flight.metadata.get(CONFIGURATION, {}).get("toml")
    return Config() if text is None else parse(text, f"{flight.name} (its own configuration)")


def _ordered(what: str, t: npt.ArrayLike, lat: Floats, lon: Floats, alt: Floats) -> Reference:
    t, first = np.unique(np.asarray(t, dtype=np.float64), return_index=True)
    return Reference(what, t, lat[first], np.unwrap(lon[first]), alt[first])


def _at(reference: Reference, t: Floats) -> tuple[Floats, Floats]:
    """Latitude and longitude of the reference at times `t`, NaN beyond its ends and in its holes."""
    k = np.clip(np.searchsorted(reference.t, t), 1, len(reference.t) - 1)
    known = (t >= reference.t[0]) & (t <= reference.t[-1]) & (reference.t[k] - reference.t[k - 1] <= REACH_S)
    lat = np.where(known, np.interp(t, reference.t, reference.lat), np.nan)
    return lat, np.where(known, np.interp(t, reference.t, reference.lon), np.nan)


def _off(reference: Reference, t: Floats, lat: Floats, lon: Floats) -> tuple[Floats, Floats]:
    """North and east of a track from the reference, m."""
    lat_0, lon_0 = _at(reference, t)
    if not np.isfinite(lat_0).any():
        return lat_0, lon_0
    R_N, R_E = radii(float(np.nanmean(lat_0)))
    north: Floats = (lat - lat_0) * R_N
    east: Floats = _wrapped(lon - lon_0) * R_E * np.cos(lat_0)
    return north, east


def _wrapped(angle: Floats) -> Floats:
    wrapped: Floats = (angle + math.pi) % math.tau - math.pi
    return wrapped


def _errors(flight: Flight, reference: Reference) -> dict[str, error_statistics.Errors]:
    solution, gnss = flight.tables["Solution"], usable_gnss(flight)
    bound = np.hypot(solution["bound_north"], solution["bound_east"])
    tracks: list[tuple[str, Table]] = [
        (error_statistics.CORRECTED, solution),
        (error_statistics.RSBN, _beacon_places(flight, reference)),
    ]
    if reference.what != GNSS:
        tracks.append((error_statistics.GNSS, gnss))
    found = {}
    for source, table in tracks:
        north, east = _off(reference, table["t"], table["lat"], table["lon"])
        found[source] = _known(table["t"], np.hypot(north, east), bound if table is solution else None)
        if table is solution:
            ins = np.hypot(north + table["error_north"], east + table["error_east"])
            found[error_statistics.INS] = _known(table["t"], ins, None)
    return {
        source: found[source]
        for source in error_statistics.SOURCES
        if source in found and len(found[source].t_ns)
    }


def _beacon_places(flight: Flight, reference: Reference) -> Table:
    """Where each answer of a beacon alone puts the aircraft, whatever else is heard: as `score.errors`."""
    heard = flight.tables["RsbnFix"]
    whole = np.isfinite(heard["azimuth"] + heard["slant"])
    t, *columns = (heard[name][whole] for name in ("t", "lat", "lon", "alt", "azimuth", "slant"))
    places = [
        error_statistics.beacon_place(Geodetic(lat, lon, alt), azimuth, slant, true_alt)
        for lat, lon, alt, azimuth, slant, true_alt in zip(
            *(column.tolist() for column in columns), np.interp(t, reference.t, reference.alt).tolist()
        )
    ]
    return {"t": t, "lat": np.array([p.lat for p in places]), "lon": np.array([p.lon for p in places])}


def _known(t: Floats, error: Floats, bound: Floats | None) -> error_statistics.Errors:
    known = np.isfinite(error)
    bound = np.full(len(t), np.nan) if bound is None else bound
    return error_statistics.Errors(np.round(t[known] * 1e9).astype(np.int64), error[known], bound[known])


def _ins_error(flight: Flight, reference: Reference | None) -> dict[str, Floats]:
    """The error of the inertial channel against the reference, beside what `Solution` says of it."""
    solution = flight.tables["Solution"]
    if reference is None or not len(solution["t"]):
        return {}
    north, east = _off(reference, solution["t"], solution["lat"], solution["lon"])
    return {
        "t": solution["t"],
        "north": north + solution["error_north"],
        "east": east + solution["error_east"],
    }


# -- consistency -----------------------------------------------------------------------------------------


def _misfits(flight: Flight, reference: Reference | None) -> list[Misfit]:
    fix, solution = flight.tables["Fix"], flight.tables["Solution"]
    found = []
    if len(fix["t"]):
        told = np.isfinite(fix["normalised"])
        found.append(Misfit("NIS", fix["t"][told], fix["normalised"][told], np.full(int(told.sum()), 2.0)))
        many = fix["freedom"] > 0
        if many.any() and fix["cost"][many].max() > 1e-9:  # one GNSS position and a height have no residual
            found.append(Misfit("fix residuals", fix["t"][many], fix["cost"][many], fix["freedom"][many]))
    if reference is not None and reference.what == TRUTH and len(solution["t"]):
        north, east = _off(reference, solution["t"], solution["lat"], solution["lon"])
        value = _squared(north, east, solution["nn"], solution["ne"], solution["ee"])
        known = np.isfinite(value)
        if known.any():
            two = np.full(int(known.sum()), 2.0)
            found.append(Misfit("NEES", solution["t"][known], value[known], two))
    return [misfit for misfit in found if len(misfit.t)]


def _squared(north: Floats, east: Floats, nn: Floats, ne: Floats, ee: Floats) -> Floats:
    value: Floats = (ee * north**2 - 2.0 * ne * north * east + nn * east**2) / (nn * ee - ne**2)
    return value
