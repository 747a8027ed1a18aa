"""Map of a flight: fixes, estimate, reference and guaranteed bound, in metres north and east.

It has no map tiles and needs no network.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence

import numpy as np

from companion.analysis import error_statistics, flight_events
from companion.analysis.assessment import Assessment
from companion.analysis.plot_data import COLOURS, Figure, Line, subsample
from companion.units import Floats

ELLIPSES = 9
BOUND = "guaranteed bound"


def build_map(flights: Sequence[Assessment], prefixes: Sequence[str]) -> Figure:
    """Build the map of one flight or two. The initial view covers the tracks, not the whole bound."""
    plane = flights[0]
    lines: list[Line] = []
    frame: list[Line] = []
    for which, (a, prefix) in enumerate(zip(flights, prefixes, strict=True)):
        framed = list(_track_lines(plane, a, prefix, which))
        frame += framed
        lines += framed
        lines += _far_lines(plane, a, prefix, which)
    bounded = any(line.name.endswith(BOUND) and len(line.x) for line in lines)
    return Figure(
        "track",
        "North and east of the first position",
        "east, m",
        "north, m",
        [line for line in lines if len(line.x)],
        "Ellipses: the guaranteed r.m.s. bound in phases without fixes." if bounded else "",
        equal=True,
        view=_view([line for line in frame if np.isfinite(line.x).any()]),
    )


def _track_lines(plane: Assessment, a: Assessment, prefix: str, which: int) -> Iterator[Line]:
    """Yield the lines that the initial view covers: GNSS, reference, estimate."""
    gnss, solution = flight_events.usable_gnss(a.flight), a.flight.tables["Solution"]
    yield _line(
        plane, f"{prefix}GNSS fixes", error_statistics.GNSS, which, gnss["lat"], gnss["lon"], dots=True
    )
    if a.reference is not None:
        yield _line(plane, prefix + a.reference.what, "reference", which, a.reference.lat, a.reference.lon)
    yield _line(
        plane, f"{prefix}estimate", error_statistics.CORRECTED, which, solution["lat"], solution["lon"]
    )


def _far_lines(plane: Assessment, a: Assessment, prefix: str, which: int) -> Iterator[Line]:
    """Yield the lines that may be far away: beacon fixes, bound, beacons."""
    fix, radio, rsbn = (
        a.flight.tables["Fix"],
        flight_events.rests_on_beacons(a.flight),
        a.flight.tables["RsbnFix"],
    )
    lat, lon = fix["lat"][radio], fix["lon"][radio]
    yield _line(plane, f"{prefix}RSBN fixes", error_statistics.RSBN, which, lat, lon, dots=True)
    yield _ellipses(plane, a, prefix, which)
    first = np.unique(rsbn["beacon"], return_index=True)[1]
    yield _line(
        plane, f"{prefix}beacons", "rejected", which, rsbn["lat"][first], rsbn["lon"][first], dots=True
    )


def _line(
    plane: Assessment, name: str, role: str, which: int, lat: Floats, lon: Floats, dots: bool = False
) -> Line:
    north, east = plane.north_east(subsample(lat), subsample(lon))
    return Line(name, east, north, COLOURS[role][which], "dots" if dots else "line")


def _ellipses(plane: Assessment, a: Assessment, prefix: str, which: int) -> Line:
    """Draw the guaranteed bound at instants evenly spaced over the phases without fixes."""
    solution = a.flight.tables["Solution"]
    without_fixes = np.flatnonzero(np.isfinite(solution["bound_north"]) & (solution["sources"] <= 1))
    chosen = without_fixes[
        np.linspace(0, len(without_fixes) - 1, min(ELLIPSES, len(without_fixes))).astype(int)
    ]
    angle = np.append(np.linspace(0.0, math.tau, 49), math.nan)
    north, east = plane.north_east(solution["lat"][chosen], solution["lon"][chosen])
    x = (east[:, None] + solution["bound_east"][chosen, None] * np.sin(angle)).ravel()
    y = (north[:, None] + solution["bound_north"][chosen, None] * np.cos(angle)).ravel()
    return Line(prefix + BOUND, x, y, COLOURS["bound"][which], width=1.0)


def _view(frame: Sequence[Line]) -> tuple[float, float, float, float] | None:
    if not frame:
        return None
    view = []
    for axis in ("x", "y"):
        low = min(float(np.nanmin(getattr(line, axis))) for line in frame)
        high = max(float(np.nanmax(getattr(line, axis))) for line in frame)
        half = max(0.55 * (high - low), 5.0)
        view += [(low + high) / 2.0 - half, (low + high) / 2.0 + half]
    return view[0], view[1], view[2], view[3]
