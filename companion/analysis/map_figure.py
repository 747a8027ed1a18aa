"""Map of flights: estimate by legs, fixes, reference, beacons by name, bound; metres east and north.

It has no map tiles and needs no network.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence

import numpy as np

from companion.analysis import error_statistics, flight_events
from companion.analysis.assessment import Assessment
from companion.analysis.flight_arrays import Table
from companion.analysis.plot_data import (
    COLOURS,
    LOGS,
    Figure,
    Line,
    PlacedName,
    Style,
    cut_at_gaps,
    subsample,
)
from companion.units import Floats

ELLIPSES = 9
FAR_M = 100_000.0  # a flight that begins farther from the first one is not on its map
BOUND = "guaranteed bound"
LOST = "estimate without fixes"


def build_map(flights: Sequence[Assessment], prefixes: Sequence[str]) -> Figure:
    """Build the map of one flight or several. The initial view covers the tracks, not the whole bound."""
    plane = flights[0]
    lines: list[Line] = []
    places: dict[str, PlacedName] = {}
    elsewhere = []
    for which, (a, prefix) in enumerate(zip(flights, prefixes, strict=True)):
        alone = len(flights) == 1
        if math.hypot(*map(float, plane.north_east(*np.array(a.origin)))) > FAR_M:
            elsewhere.append(prefix.strip())
            continue
        if alone:
            lines += _context(plane, a)
        lines += _estimate(plane, a, prefix, None if alone else LOGS[which % len(LOGS)])
        for identity, lat, lon, _ in flight_events.beacon_places(a.flight):
            north, east = plane.north_east(np.array(lat), np.array(lon))
            places[f"beacon {identity}"] = PlacedName(f"beacon {identity}", float(east), float(north))
    notes = [f"Flown elsewhere, not on this map: {', '.join(elsewhere)}."] if elsewhere else []
    lines = [line for line in lines if np.isfinite(line.x).any()]
    if any(line.name == BOUND for line in lines):
        notes.append("Dashed ellipses: the guaranteed r.m.s. bound where there were no fixes.")
    framed = [line for line in lines if line.name not in (BOUND, "beacon positions")]
    return Figure(
        "map",
        "Map",
        "m",
        lines,
        " ".join(notes),
        origin=(math.degrees(plane.origin[0]), math.degrees(plane.origin[1])),
        frame=_frame(framed),
        places=tuple(places.values()),
    )


def _context(plane: Assessment, a: Assessment) -> Iterator[Line]:
    """Yield what is drawn below the estimate of a single flight."""
    fix, radio = a.flight.tables["Fix"], flight_events.rests_on_beacons(a.flight)
    at_beacons = {name: fix[name][radio] for name in ("t", "lat", "lon")}
    yield _line(plane, "beacon positions", error_statistics.RSBN, at_beacons, "dots")
    yield _ellipses(plane, a)
    yield _line(plane, "GNSS", error_statistics.GNSS, flight_events.usable_gnss(a.flight), "dots")
    if a.reference is not None:
        table = {"t": a.reference.t, "lat": a.reference.lat, "lon": a.reference.lon}
        yield _line(plane, a.reference.what, "reference", table)


def _estimate(
    plane: Assessment, a: Assessment, prefix: str, colour: tuple[str, str] | None
) -> Iterator[Line]:
    """Yield the estimate: legs with fixes, and on top of them those without."""
    solution = a.flight.tables["Solution"]
    t = solution["t"]
    lost = flight_events.in_phases_without_fixes(a.phases, t)
    for name, hidden, role, width in (
        ("estimate", lost, error_statistics.CORRECTED, 2.0),
        (LOST, ~lost, "bound", 3.0),
    ):
        if len(t) and not hidden.all():
            leg = {"t": t, "lat": np.where(hidden, np.nan, solution["lat"]), "lon": solution["lon"]}
            line = _line(plane, prefix + name, role, leg, width=width)
            yield line if colour is None else line._replace(colour=colour, dash=name == LOST)


def _line(
    plane: Assessment, name: str, role: str, table: Table, style: Style = "line", width: float = 1.6
) -> Line:
    t, lat, lon = (subsample(table[column]) for column in ("t", "lat", "lon"))
    if style != "dots":
        times = np.maximum.accumulate(table["t"])
        t, lat, lon = cut_at_gaps(t, times, flight_events.longest_step(times), lat, lon)
    north, east = plane.north_east(lat, lon)
    east = np.where(np.isfinite(north), east, np.nan)
    return Line(name, east, north, COLOURS[role], style, width=width, t=t)


def _ellipses(plane: Assessment, a: Assessment) -> Line:
    """Draw the guaranteed bound at instants evenly spaced over the phases without fixes."""
    solution = a.flight.tables["Solution"]
    alone = np.flatnonzero(np.isfinite(solution["bound_north"]) & flight_events.without_fixes(solution))
    chosen = alone[np.linspace(0, len(alone) - 1, min(ELLIPSES, len(alone))).astype(int)]
    angle = np.append(np.linspace(0.0, math.tau, 49), math.nan)
    north, east = plane.north_east(solution["lat"][chosen], solution["lon"][chosen])
    x = (east[:, None] + solution["bound_east"][chosen, None] * np.sin(angle)).ravel()
    y = (north[:, None] + solution["bound_north"][chosen, None] * np.cos(angle)).ravel()
    return Line(BOUND, x, y, COLOURS["bound"], dash=True, width=1.0)


def _frame(lines: Sequence[Line]) -> tuple[float, float, float, float] | None:
    if not lines:
        return None
    frame = []
    for axis in ("x", "y"):
        columns: list[Floats] = [getattr(line, axis) for line in lines]
        low = min(float(np.nanmin(column)) for column in columns)
        high = max(float(np.nanmax(column)) for column in columns)
        half = max(0.55 * (high - low), 5.0)
        frame += [(low + high) / 2.0 - half, (low + high) / 2.0 + half]
    return frame[0], frame[1], frame[2], frame[3]
