"""Positions as `foxglove.LocationFix` messages (degrees, east-north-up), shown on a map by log viewers.

Replay and report do not read them; they use the records. Altitudes are above mean sea level. A truth has a
height above the ellipsoid only; simulators have no geoid, so it is the same there.
"""

from __future__ import annotations

import math
from typing import Any

import msgspec

from companion.nav.geometry import displace
from companion.records import Gnss, Smoothed, Solution, Stamped, Truth
from companion.storage import schemas

SCHEMA_NAME = "foxglove.LocationFix"

UNKNOWN, APPROXIMATED, DIAGONAL_KNOWN, KNOWN = range(4)

SCHEMA: dict[str, Any] = {
    "title": SCHEMA_NAME,
    "description": "A navigation satellite fix for any Global Navigation Satellite System",
    "type": "object",
    "properties": {
        "timestamp": schemas.TIME,
        "frame_id": {"type": "string"},
        "latitude": {"type": "number", "description": "degrees"},
        "longitude": {"type": "number", "description": "degrees"},
        "altitude": {"type": "number", "description": "m above mean sea level"},
        "position_covariance": {
            "type": "array",
            "items": {"type": "number"},
            "minItems": 9,
            "maxItems": 9,
            "description": "m^2, row by row, east-north-up tangent to the reported position",
        },
        "position_covariance_type": {
            "title": "foxglove.PositionCovarianceType",
            "oneOf": [
                {"title": "UNKNOWN", "const": UNKNOWN},
                {"title": "APPROXIMATED", "const": APPROXIMATED},
                {"title": "DIAGONAL_KNOWN", "const": DIAGONAL_KNOWN},
                {"title": "KNOWN", "const": KNOWN},
            ],
        },
    },
}


class LocationFix(msgspec.Struct, frozen=True, gc=False):
    """One point of the map, with the field names and units of the schema."""

    timestamp: dict[str, int]
    frame_id: str
    latitude: float
    longitude: float
    altitude: float
    position_covariance: tuple[float, ...] = (0.0,) * 9
    position_covariance_type: int = UNKNOWN


def to_location_fixes(record: Stamped, unix_ns: int) -> list[tuple[str, LocationFix]]:
    """Return (topic, point) of every position in `record`: two for a solution, corrected and inertial.

    `unix_ns` is the wall-clock time of validity.
    """
    stamp = schemas.to_time(unix_ns)
    match record:
        case Truth():
            return [("/map/truth", _fix(stamp, record.lat, record.lon, record.alt))]
        case Gnss() if record.has_3d_fix:  # without a fix most receivers state 0, 0
            alt = record.alt_msl
            h, v = record.sigma_horizontal, record.sigma_vertical
            if h is None or v is None:
                return [("/map/gnss", _fix(stamp, record.lat, record.lon, alt))]
            covariance = (h * h, 0.0, 0.0, 0.0, h * h, 0.0, 0.0, 0.0, v * v)
            return [("/map/gnss", _fix(stamp, record.lat, record.lon, alt, covariance, DIAGONAL_KNOWN))]
        case Smoothed():
            nn, ne, ee = record.covariance
            covariance = (ee, ne, 0.0, ne, nn, 0.0, 0.0, 0.0, 0.0)
            place = (record.lat, record.lon, record.alt_msl)
            return [("/map/smoothed", _fix(stamp, *place, covariance, APPROXIMATED))]
        case Solution():
            nn, ne, nd, ee, ed, dd = record.covariance
            covariance = (ee, ne, -ed, ne, nn, -nd, -ed, -nd, dd)
            # error = INS - truth: the inertial position is the corrected one plus the error
            inertial = displace(record.lat, record.lon, record.alt_msl, *record.error_n, 0.0)
            return [
                ("/map/solution", _fix(stamp, record.lat, record.lon, record.alt_msl, covariance, KNOWN)),
                ("/map/inertial", _fix(stamp, *inertial)),
            ]
        case _:
            return []


def _fix(
    stamp: dict[str, int],
    lat: float,
    lon: float,
    alt: float,
    covariance: tuple[float, ...] = (0.0,) * 9,
    kind: int = UNKNOWN,
) -> LocationFix:
    return LocationFix(stamp, "", math.degrees(lat), math.degrees(lon), alt, covariance, kind)
