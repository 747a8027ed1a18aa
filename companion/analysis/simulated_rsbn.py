"""Simulated RSBN measurements and outages for replays.

    track = extract_track(records, config)                   # the truth if logged, else the smoothed track
    fixes = simulate_measurements(beacons, track, seed=0)    # by time

A beacon gives a measurement once a second while it is above the radio horizon and within its range, with
white noise of the stated sigmas on azimuth and slant range; the receiver follows the nearest `CHANNELS` of
them. The earth is smooth with its surface at `GROUND`, the reference of the heights of beacons and track:
there is no terrain, no multipath, no bias. The result depends only on the inputs and the seed.
"""

from __future__ import annotations

import csv
import gzip
import math
import re
import sys
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from companion.analysis.smoothing import join_runs, smooth_flight
from companion.config import Config
from companion.nav.earth import E2, A
from companion.nav.geometry import Geodetic, enu_axes, radio_horizon, to_ecef
from companion.navigator import INPUTS_USED
from companion.plausibility import HIGHEST
from companion.records import Gnss, RsbnFix, Stamped, Truth
from companion.storage.reader import LogError
from companion.units import Floats

PERIOD_NS = 1_000_000_000
MAX_GAP_NS = 3 * PERIOD_NS  # no interpolation of the track across a longer gap
CHANNELS = 4
MAX_NUMBER = 65535  # of a beacon in a list of ours: 16 bits in the message
GROUND = 0.0  # m; not the height of the beacon, so that a higher beacon is never hidden
RANGE_LIMIT_M = 370_000.0  # 200 nautical miles
CONE_OF_SILENCE = math.radians(45.0)  # no azimuth in the cone above a beacon
SIGMA_AZIMUTH = math.radians(0.25)
SIGMA_RANGE, SIGMA_RANGE_SHARE = 200.0, 3e-4
_FEET = 0.3048
#: OurAirports' types of navaid: whether they give azimuth, and range. An NDB gives neither.
_KINDS = {
    "VOR-DME": (True, True),
    "VORTAC": (True, True),
    "TACAN": (True, True),
    "DME": (False, True),
    "VOR": (True, False),
}
_SOURCES: dict[type[Stamped], str] = {Gnss: "GNSS", RsbnFix: "RSBN"}  # as an outage names them
_OUTAGE = re.compile(r"(GNSS|RSBN):(\d+(?:\.\d+)?)-(\d+(?:\.\d+)?)", re.IGNORECASE)


class ListedBeacon(NamedTuple):
    """A beacon of a list: position (rad, m), range limit (m), and whether it gives azimuth and range."""

    number: int
    lat: float
    lon: float
    alt: float
    range_limit: float = RANGE_LIMIT_M
    azimuth: bool = True
    ranging: bool = True


class AircraftTrack(NamedTuple):
    """Track of the aircraft, each (n,): times, rad, rad, m; `origin` describes its source for the user."""

    t_ns: npt.NDArray[np.int64]
    lat: Floats
    lon: Floats
    alt: Floats
    origin: str


class SimulatedOutage(NamedTuple):
    """Outage of `source`, "GNSS" or "RSBN", from `start` to before `end`, s since the log's first record."""

    source: str
    start: float
    end: float

    def __str__(self) -> str:
        return f"--outage {self.source}:{self.start:g}-{self.end:g}"


def read_beacons(path: Path) -> list[ListedBeacon]:
    """Read a beacon list from CSV (or `.gz`): columns id, lat_deg, lon_deg, alt_m, optionally range_m.

    OurAirports' navaids.csv is also accepted; navaids without azimuth and range are skipped. Raises LogError,
    one sentence, if the file cannot be read or a line is invalid.
    """
    try:
        open_text = gzip.open if path.suffix == ".gz" else open
        with open_text(path, "rt", newline="", encoding="utf-8-sig") as file:
            reader = csv.DictReader(file)
            columns = set(reader.fieldnames or ())
            if {"id", "lat_deg", "lon_deg", "alt_m"} <= columns:
                read = _parse_row
            elif {"id", "type", "latitude_deg", "longitude_deg", "elevation_ft"} <= columns:
                read = _parse_ourairports_row
            else:
                raise LogError(
                    f"{path} is not a beacon list: it needs the columns id, lat_deg, lon_deg, alt_m,"
                    " separated by commas"
                )
            found = dict[int, ListedBeacon]()
            for row in reader:
                try:
                    if None in row:
                        raise ValueError("it has more columns than the header; write decimals with a point")
                    for beacon in read(row):
                        if found.setdefault(beacon.number, beacon) is not beacon:
                            raise ValueError(f"id {beacon.number} is given twice")
                except (TypeError, ValueError) as error:
                    raise LogError(f"{path}, line {reader.line_num} is not a valid beacon: {error}") from None
    except UnicodeDecodeError:
        raise LogError(f"{path}: not a text file in UTF-8; a list of beacons is a CSV file") from None
    except (OSError, EOFError, csv.Error) as error:
        if isinstance(error, LogError):
            raise
        raise LogError(f"{path} cannot be read: {getattr(error, 'strerror', None) or error}") from None
    if not found:
        raise LogError(f"{path} contains no beacons")
    return list(found.values())


def _parse_row(row: dict[str, str]) -> list[ListedBeacon]:
    number = row["id"].strip()
    if not (number.isascii() and number.isdecimal() and int(number) <= MAX_NUMBER):
        raise ValueError(f"id {number!r} is not an integer from 0 to {MAX_NUMBER}")
    limit = _parse_number(row, "range_m") if row.get("range_m") else RANGE_LIMIT_M
    if not limit > 0.0:
        raise ValueError(f"range_m {limit:g} is not above 0")
    lat, lon = _parse_number(row, "lat_deg", 90.0), _parse_number(row, "lon_deg", 180.0)
    alt = _parse_number(row, "alt_m", HIGHEST)
    return [ListedBeacon(int(number), math.radians(lat), math.radians(lon), alt, limit)]


def _parse_ourairports_row(row: dict[str, str]) -> list[ListedBeacon]:
    """Parse a row; a missing elevation counts as sea level, which matters little at usual ranges."""
    if row["type"] not in _KINDS:
        return []
    azimuth, ranging = _KINDS[row["type"]]
    lat, lon = _parse_number(row, "latitude_deg", 90.0), _parse_number(row, "longitude_deg", 180.0)
    alt = _parse_number(row, "elevation_ft", HIGHEST / _FEET) * _FEET if row["elevation_ft"] else 0.0
    place = math.radians(lat), math.radians(lon), alt
    return [ListedBeacon(int(row["id"]), *place, RANGE_LIMIT_M, azimuth, ranging)]


def _parse_number(row: dict[str, str], column: str, limit: float = sys.float_info.max) -> float:
    text = (row[column] or "").strip()
    if not text:
        raise ValueError(f"{column} is empty")
    try:
        value = float(text)
    except ValueError:
        raise ValueError(f"{column} {text!r} is not a number") from None
    if not abs(value) <= limit:
        wanted = "finite" if limit == sys.float_info.max else f"within +-{limit:.6g}"
        raise ValueError(f"{column} {value:g} is not {wanted}")
    return value


def parse_outage(text: str) -> SimulatedOutage:
    """Parse an outage such as GNSS:600-900. Raises ValueError, one sentence, if it is invalid."""
    match = _OUTAGE.fullmatch(text.strip())
    if match is None:
        raise ValueError(f"--outage {text}: write it as GNSS:600-900 or RSBN:600-900, in seconds of the log")
    source, start, end = match.groups()
    if float(end) <= float(start):
        raise ValueError(f"--outage {text}: the end, {end}, is not after the start, {start}")
    return SimulatedOutage(source.upper(), float(start), float(end))


class OutageFilter:
    """Outages of a log whose first record arrived at `start_ns`; `removed` counts what each took away."""

    def __init__(self, outages: Sequence[SimulatedOutage], start_ns: int) -> None:
        self.removed = dict.fromkeys(outages, 0)
        self._start_ns = self._end_ns = start_ns

    def left(self, records: Iterable[Stamped]) -> Iterator[Stamped]:
        """Yield the records that do not arrive during an outage."""
        for record in records:
            self._end_ns = max(self._end_ns, record.rx_ns)
            during = list(self._outages_at(record))
            for outage in during:
                self.removed[outage] += 1
            if not during:
                yield record

    def _outages_at(self, record: Stamped) -> Iterator[SimulatedOutage]:
        source = _SOURCES.get(type(record))
        if source is not None:
            at = record.rx_ns - self._start_ns
            for o in self.removed:
                if o.source == source and round(o.start * 1e9) <= at < round(o.end * 1e9):
                    yield o

    def describe_unused(self) -> list[str]:
        """Describe the outages that removed nothing, after the records are read."""
        end_s = (self._end_ns - self._start_ns) * 1e-9
        beyond = f"the log ends at {end_s:.0f} s"
        return [
            f"{o} has no effect: {beyond if o.start > end_s else f'no {o.source} arrives then'}"
            for o, number in self.removed.items()
            if not number
        ]


def extract_track(records: Iterable[Stamped], config: Config) -> AircraftTrack:
    """Return the truth in `records` if there is one, else the flight smoothed with all of its fixes.

    Raises LogError if there is neither.
    """
    truths: list[tuple[int, float, float, float]] = []
    folded: list[Stamped] = []
    for record in records:
        if isinstance(record, Truth):
            if not truths or record.t_ns > truths[-1][0]:
                truths.append((record.t_ns, record.lat, record.lon, record.alt))
            folded.clear()
        elif not truths and isinstance(record, INPUTS_USED):
            folded.append(record)
    if truths:
        t, lat, lon, alt = zip(*truths, strict=True)
        return AircraftTrack(
            np.array(t, dtype=np.int64), np.array(lat), np.array(lon), np.array(alt), "the log's truth"
        )
    try:
        runs = smooth_flight(folded, config)
    except ValueError as error:
        raise LogError(f"there is no track to simulate beacons along: {error}") from None
    return AircraftTrack(*join_runs(runs), "the log's own smoothed track, not a truth")


def simulate_measurements(
    beacons: Sequence[ListedBeacon], track: AircraftTrack, seed: int = 0
) -> list[RsbnFix]:
    """Simulate the measurements of a receiver on the track, by time; reproducible by the seed."""
    t_ns, lat, lon, alt = _sample_track(track)
    if not t_ns.size:
        return []
    place = ecef(lat, lon, alt)
    visible = []
    for beacon in beacons:
        geometry = sight_from(Geodetic(beacon.lat, beacon.lon, beacon.alt), place)
        if (reach := in_reach(geometry.slant, beacon.range_limit, beacon.alt - GROUND, alt - GROUND)).any():
            visible.append((beacon, geometry, reach))
    if not visible:
        return []
    slants = np.array([np.where(reach, geometry.slant, np.inf) for _, geometry, reach in visible])
    rank = np.argsort(np.argsort(slants, axis=0, kind="stable"), axis=0)
    found: list[RsbnFix] = []
    for (beacon, geometry, reach), order in zip(visible, rank, strict=True):
        found += _simulate_beacon(beacon, geometry, t_ns, reach & (order < CHANNELS), seed)
    return sorted(found, key=lambda answer: (answer.rx_ns, answer.beacon))


def describe_unreached(beacons: Sequence[ListedBeacon], track: AircraftTrack) -> str:
    """Describe the beacon that comes nearest to being received; empty if one is in reach."""
    place = ecef(track.lat, track.lon, track.alt)
    passes = []
    for beacon in beacons:
        slant = sight_from(Geodetic(beacon.lat, beacon.lon, beacon.alt), place).slant
        k = int(np.argmin(slant))
        horizon = radio_horizon(beacon.alt - GROUND, float(track.alt[k]) - GROUND)
        limit, what = min((beacon.range_limit, "range limit"), (horizon, "radio horizon"))
        passes.append((float(slant[k]) - limit, limit, what, beacon))
    if not passes or min(passes)[0] <= 0.0:
        return ""
    beyond, limit, what, nearest = min(passes)
    lat_deg, lon_deg = math.degrees(nearest.lat), math.degrees(nearest.lon)
    return (
        f"the nearest, {nearest.number} at {lat_deg:.7g}, {lon_deg:.7g} deg and {nearest.alt:.6g} m, is"
        f" {round((beyond + limit) / 1e3, 1):.6g} km away, its {what} is {limit / 1e3:.3g} km;"
        " check its numbers, in degrees and metres"
    )


class Sight(NamedTuple):
    """Azimuth in [0, 2 pi) rad, slant range (m) and elevation (rad) at a beacon, each (n,)."""

    azimuth: Floats
    slant: Floats
    elevation: Floats


def _simulate_beacon(
    beacon: ListedBeacon,
    geometry: Sight,
    t_ns: npt.NDArray[np.int64],
    visible: npt.NDArray[np.bool_],
    seed: int,
) -> Iterator[RsbnFix]:
    rng = np.random.default_rng([seed, beacon.number])  # noise independent of the other beacons in the list
    sigma = SIGMA_RANGE + SIGMA_RANGE_SHARE * geometry.slant
    azimuth = (geometry.azimuth + SIGMA_AZIMUTH * rng.standard_normal(t_ns.size)) % math.tau
    slant = np.maximum(geometry.slant + sigma * rng.standard_normal(t_ns.size), 1.0)
    has_azimuth = beacon.azimuth & (geometry.elevation < CONE_OF_SILENCE)
    for k in np.flatnonzero(visible & (has_azimuth | beacon.ranging)).tolist():
        yield RsbnFix(
            int(t_ns[k]),
            int(t_ns[k]),
            beacon.number,
            beacon.lat,
            beacon.lon,
            beacon.alt,
            float(azimuth[k]) if has_azimuth[k] else None,
            float(slant[k]) if beacon.ranging else None,
            SIGMA_AZIMUTH,
            float(sigma[k]),
        )


def _sample_track(track: AircraftTrack) -> tuple[npt.NDArray[np.int64], Floats, Floats, Floats]:
    """Interpolate the track at every `PERIOD_NS`, except in its gaps."""
    t_ns = np.arange(track.t_ns[0], track.t_ns[-1] + 1, PERIOD_NS)
    k = np.clip(np.searchsorted(track.t_ns, t_ns), 1, max(track.t_ns.size - 1, 1))
    if track.t_ns.size > 1:
        t_ns = t_ns[track.t_ns[k] - track.t_ns[k - 1] <= MAX_GAP_NS]
    at, known = ((ns - track.t_ns[0]) * 1e-9 for ns in (t_ns, track.t_ns))
    lat, alt = (np.interp(at, known, values) for values in (track.lat, track.alt))
    return t_ns, lat, np.interp(at, known, np.unwrap(track.lon)), alt


def ecef(lat: Floats, lon: Floats, alt: Floats) -> Floats:
    """Convert to earth-centred coordinates (n, 3), m."""
    N = A / np.sqrt(1.0 - E2 * np.sin(lat) ** 2)
    level = (N + alt) * np.cos(lat)
    return np.stack([level * np.cos(lon), level * np.sin(lon), (N * (1.0 - E2) + alt) * np.sin(lat)], axis=1)


def sight_from(beacon: Geodetic, place: Floats) -> Sight:
    """Compute `nav.geometry.slant_range_azimuth` for many earth-centred positions (n, 3), with elevations."""
    east, north, up = np.array(enu_axes(beacon.lat, beacon.lon)) @ (place - to_ecef(beacon)).T
    level = np.hypot(east, north)
    return Sight(np.arctan2(east, north) % math.tau, np.hypot(level, up), np.arctan2(up, level))


def in_reach(slant: Floats, limit: float, mast: float, heights: Floats) -> npt.NDArray[np.bool_]:
    """Return where an aircraft is within a beacon's range limit and above its radio horizon.

    Heights of its antenna, `mast`, and of the aircraft, `heights` (n,), are above the smooth earth, m.
    """
    near: npt.NDArray[np.bool_] = slant <= limit
    if near.any():
        near &= slant <= [radio_horizon(mast, height) for height in heights.tolist()]
    return near
