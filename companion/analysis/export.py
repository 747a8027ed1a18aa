"""Tracks and places for maps: GeoJSON (RFC 7946) and KML (OGC 2.3), chosen by the suffix of the file.

Coordinates are degrees. KML's `absolute` heights are above mean sea level, as ours are. GeoJSON's third
coordinate is above the ellipsoid, so it is left out; the property `alt_m` has the heights point by point.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from datetime import UTC, datetime, timedelta
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple
from xml.etree import ElementTree

import msgspec
import numpy as np
import numpy.typing as npt

from companion.analysis import error_statistics
from companion.analysis.flight_arrays import Flight, Table
from companion.analysis.flight_events import WITHOUT_FIXES, beacon_places, split_phases, usable_gnss
from companion.analysis.plot_data import COLOURS
from companion.storage.reader import LogError
from companion.units import Floats
from companion.write_errors import describe_write_error, write_whole

SUFFIXES = (".geojson", ".json", ".kml")
GAP_S = 10.0  # a line is cut where no point is known for longer, unless its points are wanted farther apart
_EPOCH = datetime(1970, 1, 1, tzinfo=UTC)
_KML = "http://www.opengis.net/kml/2.2"
_GX = "http://www.google.com/kml/ext/2.2"
_NOT_XML = re.compile("[^\t\n\r\u0020-\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]")


class Track(NamedTuple):
    """A line on the map: points (n,) at wall-clock times; NaN positions are gaps.

    `colour` is "#rrggbb"; `about` are its properties in GeoJSON. Points more than `gap_s` apart are not
    joined.
    """

    name: str
    unix_ns: npt.NDArray[np.int64]
    lat: Floats
    lon: Floats
    alt_msl: Floats
    colour: str
    about: Mapping[str, Any] = MappingProxyType({})
    gap_s: float = GAP_S


class Place(NamedTuple):
    """A named point on the map, such as a beacon; angles in radians."""

    name: str
    lat: float
    lon: float
    colour: str
    about: Mapping[str, Any]


def write_map(path: Path, title: str, tracks: Sequence[Track], places: Sequence[Place] = ()) -> None:
    """Write tracks and places to `path`, as KML or GeoJSON by its suffix.

    Raises LogError, one sentence, if the suffix is unknown or the file cannot be written.
    """
    check_suffix(path)
    write = to_kml if path.suffix.lower() == ".kml" else to_geojson
    write_file(path, write(_NOT_XML.sub("\ufffd", title), tracks, places).encode())


def write_file(path: Path, data: bytes) -> None:
    """Write a file at once. Raises LogError, one sentence, if it cannot be written."""
    try:
        write_whole(path, data)
    except OSError as error:
        raise LogError(f"{path} cannot be written: {describe_write_error(error)}") from None


def check_suffix(path: Path) -> None:
    """Raise LogError if no format belongs to the suffix of `path`."""
    if path.suffix.lower() not in SUFFIXES:
        raise LogError(
            f"{path}: a map is written as {', '.join(SUFFIXES)}; give a name that ends with one of them"
        )


def to_geojson(title: str, tracks: Iterable[Track], places: Iterable[Place] = ()) -> str:
    """Return a FeatureCollection: a MultiLineString a track, with times and heights point by point."""
    features = [_track_feature(track) for track in tracks if np.isfinite(track.lat).any()]
    for place in places:
        about = {"name": place.name, "marker-color": place.colour, **place.about}
        point = {"type": "Point", "coordinates": _degrees(place.lon, place.lat)}
        features.append({"type": "Feature", "properties": about, "geometry": point})
    found = {"type": "FeatureCollection", "name": title, "features": features}
    return msgspec.json.format(msgspec.json.encode(found), indent=1).decode()


def _track_feature(track: Track) -> dict[str, Any]:
    parts = list(_parts(track))
    about = {
        "name": track.name,
        "stroke": track.colour,
        "stroke-width": 2,
        "coordTimes": [[_utc(t) for t in track.unix_ns[part].tolist()] for part in parts],
        "altitude": "above mean sea level",
        "alt_m": [[round(alt, 2) for alt in track.alt_msl[part].tolist()] for part in parts],
        **track.about,
    }
    lines = [
        [_degrees(lon, lat) for lon, lat in zip(track.lon[part].tolist(), track.lat[part].tolist())]
        for part in parts
    ]
    geometry = {"type": "MultiLineString", "coordinates": lines}
    return {"type": "Feature", "properties": about, "geometry": geometry}


def to_kml(title: str, tracks: Iterable[Track], places: Iterable[Place] = ()) -> str:
    """Return a KML document with a gx:MultiTrack a track, which viewers can play back, and placemarks."""
    ElementTree.register_namespace("", _KML)
    ElementTree.register_namespace("gx", _GX)
    root = ElementTree.Element(f"{{{_KML}}}kml")
    document = _child(root, "Document")
    _child(document, "name", title)
    for track in tracks:
        if not np.isfinite(track.lat).any():
            continue
        mark = _child(document, "Placemark")
        _child(mark, "name", track.name)
        style = _child(_child(mark, "Style"), "LineStyle")
        _child(style, "color", _kml_colour(track.colour))
        _child(style, "width", "2")
        many = _child(mark, "MultiTrack", space=_GX)
        _child(many, "altitudeMode", "absolute")
        for part in _parts(track):
            line = _child(many, "Track", space=_GX)
            _child(line, "altitudeMode", "absolute")
            for t in track.unix_ns[part].tolist():
                _child(line, "when", _utc(t))
            for lon, lat, alt in zip(
                *(column[part].tolist() for column in (track.lon, track.lat, track.alt_msl))
            ):
                _child(line, "coord", "{} {} {:.2f}".format(*_degrees(lon, lat), alt), space=_GX)
    for place in places:
        mark = _child(document, "Placemark")
        _child(mark, "name", place.name)
        if place.about:
            _child(mark, "description", "; ".join(f"{key}: {value}" for key, value in place.about.items()))
        _child(_child(mark, "Point"), "coordinates", "{},{}".format(*_degrees(place.lon, place.lat)))
    ElementTree.indent(root, " ")
    return '<?xml version="1.0" encoding="UTF-8"?>\n' + ElementTree.tostring(root, "unicode") + "\n"


def flight_map(flight: Flight, every_s: float) -> tuple[list[Track], list[Place]]:
    """Return what a flight shows on a map: legs of the estimate by their fixes, GNSS, truth, beacons.

    At most one point in `every_s` seconds.
    """
    solution = flight.tables["Solution"]
    tracks = []
    for phase in split_phases(solution, flight.seconds):
        start, end = phase.start_ns * 1e-9, phase.end_ns * 1e-9
        inside = phase.covers(solution["t"])
        leg = {name: column[inside] for name, column in solution.items()}
        lost = phase.name in WITHOUT_FIXES
        what = "no fixes" if lost else phase.name
        colour = COLOURS["bound" if lost else error_statistics.CORRECTED][0]
        about = {"leg": what, "from_s": round(start, 1), "to_s": round(end, 1)}
        tracks.append(_track(flight, f"estimate, {what}", leg, colour, every_s, about))
    for name, table, colour in (
        ("GNSS", usable_gnss(flight), COLOURS[error_statistics.GNSS][0]),
        ("truth", flight.tables["Truth"], COLOURS["reference"][0]),
    ):
        about = {"altitude": "above the ellipsoid"} if name == "truth" else {}
        tracks.append(_track(flight, name, table, colour, every_s, about))
    places = [
        Place(f"beacon {identity}", lat, lon, COLOURS[error_statistics.RSBN][0], {"alt_m": round(alt, 1)})
        for identity, lat, lon, alt in beacon_places(flight)
    ]
    return [track for track in tracks if len(track.lat)], places


def _track(
    flight: Flight, name: str, table: Table, colour: str, every_s: float, about: dict[str, Any]
) -> Track:
    t, thin = table["t"], np.zeros(len(table["t"]), dtype=np.bool_)
    if len(t):
        thin[np.unique(np.floor(t / every_s), return_index=True)[1]] = True
        thin[-1] = True
    unix_ns = flight.unix_ns + np.round(t[thin] * 1e9).astype(np.int64)
    lat, lon, alt = (table[key][thin] for key in ("lat", "lon", "alt"))
    return Track(name, unix_ns, lat, lon, alt, colour, about, max(GAP_S, 2.0 * every_s))


def _parts(track: Track) -> Iterator[npt.NDArray[np.int64]]:
    """Yield the indices of each unbroken line: cut at gaps and at the antimeridian (RFC 7946, 3.1.9)."""
    known = np.flatnonzero(np.isfinite(track.lat) & np.isfinite(track.lon))
    far = np.diff(track.unix_ns[known]) > track.gap_s * 1e9
    across = np.abs(np.diff(track.lon[known])) > np.pi
    broken = far | across | (np.diff(known) > 1)
    yield from (part for part in np.split(known, np.flatnonzero(broken) + 1) if len(part) > 1)


def _degrees(lon: float, lat: float) -> list[float]:
    return [round(float(np.degrees(lon)), 8), round(float(np.degrees(lat)), 8)]


def _utc(unix_ns: int) -> str:
    when = _EPOCH + timedelta(microseconds=unix_ns // 1000)
    return when.isoformat(timespec="milliseconds").replace("+00:00", "Z")


def _kml_colour(colour: str) -> str:
    """Convert "#rrggbb" to KML's aabbggrr."""
    return f"ff{colour[5:7]}{colour[3:5]}{colour[1:3]}"


def _child(parent: ElementTree.Element, name: str, text: str = "", space: str = _KML) -> ElementTree.Element:
    child = ElementTree.SubElement(parent, f"{{{space}}}{name}")
    child.text = _NOT_XML.sub("\ufffd", text) or None
    return child
