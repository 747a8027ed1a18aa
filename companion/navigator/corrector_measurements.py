"""Measurements of the correctors of an INS, as rows on the states of `corrected_ins`.

Each is Z = INS - corrector = H x + noise (Poddubny 1.19-1.23), linearised about the corrected position:
an INS may be kilometres off. A corrector is not a hypothesis of the bank: a measurement that no row
explains is an outlier and is refused. It counts as no fix for mode, trust and the guaranteed bound.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from companion.nav import correctors
from companion.nav.geometry import Geodetic, enu_axes, separation, to_ecef, wrap_angle
from companion.navigator.corrected_ins import CorrectedIns, chain_state
from companion.navigator.inertial_track import Point
from companion.records import RangeDifference, SecondIns, StarFix, Vector2
from companion.units import Floats

SECOND_NOISE_M = 1.0  # beside a second INS: what sampling and rounding leave
HIGHEST_STAR = math.radians(80.0)  # nearer to the zenith an azimuth means nothing


class CorrectorRows(NamedTuple):
    """z (m,), H (m, n) on the states of the channel, R (m, m); rows of one kind have one meaning."""

    z: Floats
    H: Floats
    R: Floats
    kind: str


def airspeed(channel: CorrectedIns, point: Point, V: float, heading: float, gust: float) -> CorrectorRows:
    """Airspeed at the INS's heading (true, rad) as a velocity along and across the nose; no sideslip."""
    along, across = correctors.airspeed(heading, V)
    H = correctors.observation_matrix(channel.names, {**along, "scale": -V}, across)
    north, east = point.v_n[:2]
    c, s = math.cos(heading), math.sin(heading)
    z = np.array((c * north + s * east - V, -s * north + c * east))
    return CorrectorRows(z, H, gust**2 * np.eye(2), "airspeed")


def range_difference(
    channel: CorrectedIns, corrected: Point, centre: Vector2, record: RangeDifference
) -> CorrectorRows:
    """Line of position; `corrected` is the INS less its error `centre` (north, east, m)."""
    here = np.array(to_ecef(corrected.position))
    axes = np.array(enu_axes(corrected.position.lat, corrected.position.lon))
    a, b = (
        here - to_ecef(Geodetic(*station))
        for station in (
            (record.lat_a, record.lon_a, record.alt_a),
            (record.lat_b, record.lon_b, record.alt_b),
        )
    )
    d_a, d_b = float(np.linalg.norm(a)), float(np.linalg.norm(b))
    east, north, _ = (axes @ (a / max(d_a, 1.0) - b / max(d_b, 1.0))).tolist()
    H = correctors.observation_matrix(
        channel.names, correctors.line_of_position(north, east, chain_state(record.chain))
    )
    z = d_a - d_b - record.difference + north * centre[0] + east * centre[1]
    return CorrectorRows(np.array([z]), H, np.array([[record.sigma**2]]), f"chain {record.chain}")


def star(channel: CorrectedIns, corrected: Point, centre: Vector2, record: StarFix) -> CorrectorRows | None:
    """Altitude, and azimuth if there is one, of a star on the axes of the INS; None below its horizon."""
    lat, lon, _ = corrected.position
    h, q = altitude_azimuth(lat, lon, record.lat, record.lon)
    if not 0.0 < h < HIGHEST_STAR:
        return None
    rows = correctors.star(h, q, lat)
    H = correctors.observation_matrix(channel.names, *rows)
    z = [h - record.altitude]
    variances = [record.sigma_altitude**2]
    if record.azimuth is not None:
        z.append(wrap_angle(q - record.azimuth))
        variances.append(record.sigma_azimuth**2)
    m = len(z)
    kind = f"star {record.star}, {m} rows"
    return CorrectorRows(np.array(z) + H[:m, :2] @ centre, H[:m], np.diag(variances), kind)


def second_ins(channel: CorrectedIns, point: Point, record: SecondIns) -> CorrectorRows:
    """Position of the INS less that of a second one."""
    H = correctors.observation_matrix(channel.names, *correctors.second_ins())
    other = Geodetic(record.lat, record.lon, point.position.alt)
    north, east, _ = separation(point.position, other)
    kind = f"second INS {record.ins}"
    return CorrectorRows(np.array((north, east)), H, SECOND_NOISE_M**2 * np.eye(2), kind)


def altitude_azimuth(lat: float, lon: float, star_lat: float, star_lon: float) -> tuple[float, float]:
    """Altitude above the horizon of the ellipsoid and azimuth from north (rad) of a star."""
    hour = star_lon - lon
    up = math.sin(lat) * math.sin(star_lat) + math.cos(lat) * math.cos(star_lat) * math.cos(hour)
    north = math.cos(lat) * math.sin(star_lat) - math.sin(lat) * math.cos(star_lat) * math.cos(hour)
    east = math.cos(star_lat) * math.sin(hour)
    return math.atan2(up, math.hypot(north, east)), math.atan2(east, north)
