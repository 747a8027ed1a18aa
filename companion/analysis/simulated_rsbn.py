"""Beacons that a log did not hear, and outages it did not have: for replay only.

    track = track_of(records, config)           # the truth where the log has it, else its own track
    heard = answers(beacons, track, seed=0)     # RSBN answers along it, in order of time

A beacon answers once a second while it is above the radio horizon and within its range, with white noise of
the stated sigmas on azimuth and slant range; of those that could, a receiver follows the nearest few. The
earth is smooth at `GROUND`, the surface that the list and the track both count heights from: what a height
above it stands on, a mast or a hill, is not known. No terrain, no multipath, no bias. Everything follows from
the seed.
"""

from __future__ import annotations

import csv
import gzip
import math
import re
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from companion.analysis.smoothing import joined, smooth_flight
from companion.config import Config
from companion.nav.earth import E2, A
from companion.nav.geometry import enu_axes, radio_horizon
from companion.navigator import FOLDED
from companion.records import Gnss, RsbnFix, Stamped, Truth
from companion.storage.reader import LogError

Floats = npt.NDArray[np.float64]

PERIOD_NS = 1_000_000_000
REACH_NS = 3 * PERIOD_NS  # a track with a longer gap is not interpolated over it
FOLLOWED = 4
GROUND = 0.0  # m; one that followed the beacon's height would hide a higher one
RANGE_LIMIT_M = 370_000.0  # 200 nautical miles
SILENCE = math.radians(45.0)  # no azimuth in the cone above a beacon
SIGMA_AZIMUTH = math.radians(0.25)
SIGMA_RANGE, SIGMA_RANGE_SHARE = 200.0, 3e-4
_FEET = 0.3048
#: OurAirports' kinds of aid: whether they give an azimuth, whether a range. An NDB gives neither.
_KINDS = {
    "VOR-DME": (True, True),
    "VORTAC": (True, True),
    "TACAN": (True, True),
    "DME": (False, True),
    "VOR": (True, False),
}
_OUTAGE = re.compile(r"(GNSS|RSBN):(\d+(?:\.\d+)?)-(\d+(?:\.\d+)?)", re.IGNORECASE)


class Beacon(NamedTuple):
    """A beacon: position rad, m; range limit m; which of azimuth and range it gives."""

    number: int
    lat: float
    lon: float
    alt: float
    range_limit: float = RANGE_LIMIT_M
    azimuth: bool = True
    ranging: bool = True


class Track(NamedTuple):
    """Where the aircraft was (n,): times, rad, rad, m; `origin` is a phrase for the reader: whence."""

    t_ns: npt.NDArray[np.int64]
    lat: Floats
    lon: Floats
    alt: Floats
    origin: str


class Outage(NamedTuple):
    """What is silent, "GNSS" or "RSBN", from `start` to before `end`, seconds of the log."""

    source: str
    start: float
    end: float

    def __str__(self) -> str:
        return f"--outage {self.source}:{self.start:g}-{self.end:g}"


def read_beacons(path: Path) -> list[Beacon]:
    """A beacon list as CSV (`.gz` too): columns id, lat_deg, lon_deg, alt_m, optionally range_m; or
    OurAirports' navaids, of which those with an azimuth or a range are taken.

    LogError, one sentence, where it cannot be read or a line is wrong.
    """
    try:
        with gzip.open(path, "rt", newline="") if path.suffix == ".gz" else path.open(newline="") as file:
            reader = csv.DictReader(file)
            columns = set(reader.fieldnames or ())
            if {"id", "lat_deg", "lon_deg", "alt_m"} <= columns:
                read = _own
            elif {"id", "type", "latitude_deg", "longitude_deg", "elevation_ft"} <= columns:
                read = _airports
            else:
                raise LogError(f"{path} is no beacon list: it needs the columns id, lat_deg, lon_deg, alt_m")
            found = []
            for row in reader:
                try:
                    found += read(row)
                except (TypeError, ValueError) as error:
                    raise LogError(f"{path}, line {reader.line_num} is no beacon: {error}") from None
    except (OSError, EOFError, UnicodeDecodeError) as error:
        if isinstance(error, LogError):
            raise
        raise LogError(f"{path} cannot be read: {getattr(error, 'strerror', None) or error}") from None
    if not found:
        raise LogError(f"{path} lists no beacon")
    return found


def _own(row: dict[str, str]) -> list[Beacon]:
    limit = float(row["range_m"]) if row.get("range_m") else RANGE_LIMIT_M
    lat, lon = _degrees(row["lat_deg"], 90.0), _degrees(row["lon_deg"], 180.0)
    alt = float(row["alt_m"])
    if not (math.isfinite(alt) and 0.0 < limit < math.inf):
        raise ValueError("alt_m and range_m must be finite, range_m positive")
    return [Beacon(int(row["id"]), lat, lon, alt, limit)]


def _airports(row: dict[str, str]) -> list[Beacon]:
    """Where an elevation is missing, the sea's: the height tells little at the ranges flown."""
    if row["type"] not in _KINDS:
        return []
    azimuth, ranging = _KINDS[row["type"]]
    lat, lon = _degrees(row["latitude_deg"], 90.0), _degrees(row["longitude_deg"], 180.0)
    alt = float(row["elevation_ft"] or 0.0) * _FEET
    return [Beacon(int(row["id"]), lat, lon, alt, RANGE_LIMIT_M, azimuth, ranging)]


def _degrees(text: str, limit: float) -> float:
    value = float(text)
    if not abs(value) <= limit:
        raise ValueError(f"{value} deg is outside +-{limit:g}")
    return math.radians(value)


def parse_outage(text: str) -> Outage:
    """GNSS:600-900 as typed. ValueError, one sentence, if it is not that."""
    match = _OUTAGE.fullmatch(text.strip())
    if match is None or float(match[2]) >= float(match[3]):
        raise ValueError(f"--outage {text}: write it as GNSS:600-900 or RSBN:600-900, seconds of the log")
    return Outage(match[1].upper(), float(match[2]), float(match[3]))


def without(records: Iterable[Stamped], outages: Sequence[Outage], start_ns: int) -> Iterator[Stamped]:
    """The records but for those that fall into an outage by their time of arrival; time counts from
    `start_ns`."""
    silent: dict[type[Stamped], list[tuple[int, int]]] = {
        kind: [
            (start_ns + round(o.start * 1e9), start_ns + round(o.end * 1e9))
            for o in outages
            if o.source == name
        ]
        for name, kind in (("GNSS", Gnss), ("RSBN", RsbnFix))
    }
    for record in records:
        spans = silent.get(type(record), ())
        if not any(begin <= record.rx_ns < end for begin, end in spans):
            yield record


def track_of(records: Iterable[Stamped], config: Config) -> Track:
    """The truth in `records` where there is any, else the flight smoothed with all of its fixes.

    LogError where there is neither.
    """
    truths: list[tuple[int, float, float, float]] = []
    folded: list[Stamped] = []
    for record in records:
        if isinstance(record, Truth):
            if not truths or record.t_ns > truths[-1][0]:
                truths.append((record.t_ns, record.lat, record.lon, record.alt))
            folded.clear()
        elif not truths and isinstance(record, FOLDED):
            folded.append(record)
    if truths:
        t, lat, lon, alt = zip(*truths, strict=True)
        return Track(
            np.array(t, dtype=np.int64), np.array(lat), np.array(lon), np.array(alt), "the log's truth"
        )
    try:
        runs = smooth_flight(folded, config)
    except ValueError as error:
        raise LogError(f"there is no track to hear beacons along: {error}") from None
    return Track(*joined(runs), "the log's own smoothed track, not a truth")


def answers(beacons: Sequence[Beacon], track: Track, seed: int = 0) -> list[RsbnFix]:
    """What a receiver on the track hears of the beacons, by time; the same for the same seed."""
    t_ns, lat, lon, alt = _sampled(track)
    if not t_ns.size:
        return []
    place = _ecef(lat, lon, alt)
    heard = []
    for beacon in beacons:
        sight = _sight(beacon, place)
        if (reach := _in_reach(beacon, sight, alt)).any():
            heard.append((beacon, sight, reach))
    if not heard:
        return []
    slants = np.array([np.where(reach, sight.slant, np.inf) for _, sight, reach in heard])
    rank = np.argsort(np.argsort(slants, axis=0, kind="stable"), axis=0)
    found: list[RsbnFix] = []
    for (beacon, sight, reach), order in zip(heard, rank, strict=True):
        found += _answers(beacon, sight, t_ns, reach & (order < FOLLOWED), seed)
    return sorted(found, key=lambda answer: (answer.rx_ns, answer.beacon))


class _Sight(NamedTuple):
    azimuth: Floats
    slant: Floats
    elevation: Floats


def _answers(
    beacon: Beacon, sight: _Sight, t_ns: npt.NDArray[np.int64], heard: npt.NDArray[np.bool_], seed: int
) -> Iterator[RsbnFix]:
    rng = np.random.default_rng([seed, beacon.number])  # its own noise, whatever else is in the list
    sigma = SIGMA_RANGE + SIGMA_RANGE_SHARE * sight.slant
    azimuth = (sight.azimuth + SIGMA_AZIMUTH * rng.standard_normal(t_ns.size)) % math.tau
    slant = np.maximum(sight.slant + sigma * rng.standard_normal(t_ns.size), 1.0)
    told = beacon.azimuth & (sight.elevation < SILENCE)
    for k in np.flatnonzero(heard & (told | beacon.ranging)).tolist():
        yield RsbnFix(
            int(t_ns[k]),
            int(t_ns[k]),
            beacon.number,
            beacon.lat,
            beacon.lon,
            beacon.alt,
            float(azimuth[k]) if told[k] else None,
            float(slant[k]) if beacon.ranging else None,
            SIGMA_AZIMUTH,
            float(sigma[k]),
        )


def _sampled(track: Track) -> tuple[npt.NDArray[np.int64], Floats, Floats, Floats]:
    """The track every `PERIOD_NS`, but for its gaps."""
    t_ns = np.arange(track.t_ns[0], track.t_ns[-1] + 1, PERIOD_NS)
    k = np.clip(np.searchsorted(track.t_ns, t_ns), 1, max(track.t_ns.size - 1, 1))
    if track.t_ns.size > 1:
        t_ns = t_ns[track.t_ns[k] - track.t_ns[k - 1] <= REACH_NS]
    at, known = ((ns - track.t_ns[0]) * 1e-9 for ns in (t_ns, track.t_ns))
    lat, alt = (np.interp(at, known, values) for values in (track.lat, track.alt))
    return t_ns, lat, np.interp(at, known, np.unwrap(track.lon)), alt


def _ecef(lat: Floats, lon: Floats, alt: Floats) -> Floats:
    """(n, 3), m."""
    N = A / np.sqrt(1.0 - E2 * np.sin(lat) ** 2)
    level = (N + alt) * np.cos(lat)
    return np.stack([level * np.cos(lon), level * np.sin(lon), (N * (1.0 - E2) + alt) * np.sin(lat)], axis=1)


def _sight(beacon: Beacon, place: Floats) -> _Sight:
    """`nav.geometry.slant_range_azimuth` of many places (n, 3) at once."""
    lat, lon, alt = (np.array([value]) for value in (beacon.lat, beacon.lon, beacon.alt))
    east, north, up = enu_axes(beacon.lat, beacon.lon) @ (place - _ecef(lat, lon, alt)).T
    level = np.hypot(east, north)
    return _Sight(np.arctan2(east, north) % math.tau, np.hypot(level, up), np.arctan2(up, level))


def _in_reach(beacon: Beacon, sight: _Sight, alt: Floats) -> npt.NDArray[np.bool_]:
    near = sight.slant <= beacon.range_limit
    if not near.any():
        return near
    horizon = np.array([radio_horizon(beacon.alt - GROUND, height) for height in (alt - GROUND).tolist()])
    reach: npt.NDArray[np.bool_] = near & (sight.slant <= horizon)
    return reach
