"""Positions, lines of sight and rotations: geodetic, ECEF and local frames, the autopilots' flat earths.

It knows the ellipsoid, not motion, time, sensors or errors. A geodetic position is
`Geodetic(lat, lon, alt)`, radians and metres above WGS84; resulting longitudes are in [-pi, pi).
Vectors are metres: plain numbers, ten times faster than arrays, except in the plane tangent at an origin.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from companion.nav.earth import E2, A, radii
from companion.records import Projection
from companion.units import Floats

Triple = tuple[float, float, float]

_ARDUPILOT_R = 0.011131884502145034 * math.degrees(1e7)
"""ArduPilot's LOCATION_SCALING_FACTOR (AP_Common/Location.h), m per 1e-7 degree, as a radius."""
_PX4_R = 6371000.0
"""CONSTANTS_RADIUS_OF_EARTH of PX4's lib/geo/geo.h, m."""
_RADIO_R = 4.0 / 3.0 * 6371000.0
"""Effective radius of the earth for VHF/UHF under standard refraction (ITU-R P.834), m."""


class Geodetic(NamedTuple):
    """Position on WGS84.

    Attributes
    ----------
    lat, lon : float
        Geodetic latitude and longitude, rad.
    alt : float
        Height above the ellipsoid, m.
    """

    lat: float
    lon: float
    alt: float


class LineOfSight(NamedTuple):
    """Line of sight at its origin.

    Attributes
    ----------
    azimuth : float
        From true north clockwise, [0, 2 pi), rad.
    slant_range : float
        Distance, m.
    elevation : float
        Above the local horizontal, rad.
    """

    azimuth: float
    slant_range: float
    elevation: float


def wrap_angle(angle: float) -> float:
    """Wrap an angle to [-pi, pi).

    Parameters
    ----------
    angle : float
        Angle, rad.

    Returns
    -------
    float
        The same angle in [-pi, pi).
    """
    wrapped = math.remainder(angle, math.tau)
    return -math.pi if wrapped == math.pi else wrapped


def to_ecef(point: Geodetic) -> Triple:
    """Convert geodetic to ECEF coordinates.

    Parameters
    ----------
    point : Geodetic
        Position.

    Returns
    -------
    tuple of float
        X, Y, Z, m.

    References
    ----------
    Groves (2.112).
    """
    lat, lon, alt = point
    R_E = radii(lat).R_E
    rho = (R_E + alt) * math.cos(lat)
    return rho * math.cos(lon), rho * math.sin(lon), ((1.0 - E2) * R_E + alt) * math.sin(lat)


def from_ecef(r_e: Floats) -> Geodetic:
    """Convert ECEF to geodetic coordinates in closed form.

    Parameters
    ----------
    r_e : (3,)
        X, Y, Z, m.

    Returns
    -------
    Geodetic
        Position.

    Raises
    ------
    ValueError
        Within about 43 km of the earth's centre, where the form does not hold.

    References
    ----------
    Vermeille, Journal of Geodesy 76 (2002) 451-454, symbols as there.
    """
    X, Y, Z = (float(c) for c in r_e)
    e4 = E2 * E2
    rho = math.hypot(X, Y)
    p = (rho / A) ** 2
    q = (1.0 - E2) * (Z / A) ** 2
    r = (p + q - e4) / 6.0
    if not r > 0.0:
        raise ValueError(
            f"ECEF position ({X:g}, {Y:g}, {Z:g}) m is at the centre of the earth: check its units"
        )
    s = e4 * p * q / (4.0 * r**3)
    t = math.cbrt(1.0 + s + math.sqrt(s * (2.0 + s)))
    u = r * (1.0 + t + 1.0 / t)
    v = math.sqrt(u * u + e4 * q)
    w = E2 * (u + v - q) / (2.0 * v)
    k = math.sqrt(u + v + w * w) - w
    D = k * rho / (k + E2)
    hypot = math.hypot(D, Z)
    return Geodetic(2.0 * math.atan2(Z, D + hypot), wrap_angle(math.atan2(Y, X)), (k + E2 - 1.0) / k * hypot)


def enu_axes(lat: float, lon: float) -> tuple[Triple, Triple, Triple]:
    """Compute the east, north and up axes in ECEF.

    Parameters
    ----------
    lat, lon : float
        Geodetic latitude and longitude, rad.

    Returns
    -------
    tuple of tuple of float
        East, north and up axis: the rows of C_e^enu.
    """
    sl, cl, so, co = math.sin(lat), math.cos(lat), math.sin(lon), math.cos(lon)
    return (-so, co, 0.0), (-sl * co, -sl * so, cl), (cl * co, cl * so, sl)


def to_enu(point: Geodetic, origin: Geodetic) -> Floats:
    """Convert a position to the plane tangent at an origin; exact at any distance.

    Parameters
    ----------
    point, origin : Geodetic
        Position and origin.

    Returns
    -------
    (3,)
        East, north, up, m.
    """
    away: Floats = np.subtract(to_ecef(point), to_ecef(origin))
    return np.array(enu_axes(origin.lat, origin.lon)) @ away


def from_enu(x_enu: Floats, origin: Geodetic) -> Geodetic:
    """Convert east, north, up of an origin to a position: the inverse of `to_enu`.

    Parameters
    ----------
    x_enu : (3,)
        East, north, up, m.
    origin : Geodetic
        Origin.

    Returns
    -------
    Geodetic
        Position.
    """
    return from_ecef(to_ecef(origin) + np.array(enu_axes(origin.lat, origin.lon)).T @ x_enu)


def displace(lat: float, lon: float, alt: float, north: float, east: float, down: float) -> Geodetic:
    """Displace a position by a short vector, through the radii of curvature at (lat, alt).

    First order: wrong by about d^2 tan(lat) / 2R (1 m at 2.7 km and 60 degrees; use `from_enu` beyond).
    Not usable at a pole, where east is not defined.

    Parameters
    ----------
    lat, lon : float
        Geodetic latitude and longitude, rad.
    alt : float
        Height above the ellipsoid, m.
    north, east, down : float
        Displacement, m.

    Returns
    -------
    Geodetic
        Displaced position.
    """
    R_N, R_E = radii(lat)
    return Geodetic(
        lat + north / (R_N + alt), wrap_angle(lon + east / ((R_E + alt) * math.cos(lat))), alt - down
    )


def separation(point: Geodetic, reference: Geodetic) -> Triple:
    """Compute `point` minus `reference` in NED: the inverse of `displace` from `reference`.

    An error is computed minus true, so the error of the INS against a fix is `separation(ins, fix)`.

    Parameters
    ----------
    point, reference : Geodetic
        Positions.

    Returns
    -------
    tuple of float
        North, east, down, m.
    """
    R_N, R_E = radii(reference.lat)
    north = (point.lat - reference.lat) * (R_N + reference.alt)
    east = wrap_angle(point.lon - reference.lon) * (R_E + reference.alt) * math.cos(reference.lat)
    return north, east, reference.alt - point.alt


def slant_range_azimuth(beacon: Geodetic, aircraft: Geodetic) -> LineOfSight:
    """Compute the measurement of an ideal RSBN, VOR/DME or TACAN ground beacon.

    Parameters
    ----------
    beacon, aircraft : Geodetic
        Positions.

    Returns
    -------
    LineOfSight
        From the beacon to the aircraft.
    """
    east, north, up = (float(c) for c in to_enu(aircraft, beacon))
    horizontal = math.hypot(east, north)
    azimuth = math.atan2(east, north) % math.tau
    # a tiny negative angle rounds up to 2 pi, outside [0, 2 pi)
    return LineOfSight(
        0.0 if azimuth == math.tau else azimuth, math.hypot(horizontal, up), math.atan2(up, horizontal)
    )


def radio_horizon(height_a: float, height_b: float) -> float:
    """Compute the range of direct radio sight between two antennas, over a smooth earth of 4/3 radius.

    Parameters
    ----------
    height_a, height_b : float
        Heights above that smooth earth, m; below it counts as on it.

    Returns
    -------
    float
        Distance, m.
    """
    return math.sqrt(2.0 * _RADIO_R) * (math.sqrt(max(height_a, 0.0)) + math.sqrt(max(height_b, 0.0)))


def local_to_geodetic(projection: Projection, origin: Geodetic, x_n: Sequence[float] | Floats) -> Geodetic:
    """Convert an autopilot's local NED position to a geodetic position.

    Each autopilot has a flat earth of its own; reading its local position through another one is off by
    0.1-0.5 % of the distance (different radii) and more.

    - "ardupilot": Location::offset, a sphere of 6378.1 km, longitudes scaled at the mean latitude;
    - "px4": MapProjection::reproject, azimuthal equidistant on a sphere of 6371 km;
    - "tangent": the plane tangent to the ellipsoid, exact.

    Parameters
    ----------
    projection : {"ardupilot", "px4", "tangent"}
        Flat earth.
    origin : Geodetic
        Origin of the local frame.
    x_n : (3,)
        North, east, down, m.

    Returns
    -------
    Geodetic
        Position.

    Raises
    ------
    ValueError
        For an unknown projection.
    """
    north, east, down = (float(c) for c in x_n)
    lat_0, lon_0, alt_0 = origin
    if projection == "ardupilot":
        dlat = north / _ARDUPILOT_R
        dlon = east / (_ARDUPILOT_R * _longitude_scale(lat_0 + 0.5 * dlat))
        return Geodetic(lat_0 + dlat, wrap_angle(lon_0 + dlon), alt_0 - down)
    if projection == "px4":
        c = math.hypot(north, east) / _PX4_R
        if c == 0.0:
            return Geodetic(lat_0, lon_0, alt_0 - down)
        x, y = north / _PX4_R * math.sin(c) / c, east / _PX4_R * math.sin(c) / c
        sine = math.cos(c) * math.sin(lat_0) + x * math.cos(lat_0)
        lat = math.asin(max(-1.0, min(sine, 1.0)))  # beyond 1 by rounding at a pole
        dlon = math.atan2(y, math.cos(lat_0) * math.cos(c) - x * math.sin(lat_0))
        return Geodetic(lat, wrap_angle(lon_0 + dlon), alt_0 - down)
    if projection == "tangent":
        return from_enu(np.array([east, north, -down]), origin)
    raise _unknown(projection)


def geodetic_to_local(projection: Projection, origin: Geodetic, point: Geodetic) -> Triple:
    """Convert a geodetic position to an autopilot's local NED position: the inverse of `local_to_geodetic`.

    The counterparts are Location::get_distance_NED, MapProjection::project and `to_enu`.

    Parameters
    ----------
    projection : {"ardupilot", "px4", "tangent"}
        Flat earth.
    origin : Geodetic
        Origin of the local frame.
    point : Geodetic
        Position.

    Returns
    -------
    tuple of float
        North, east, down, m.

    Raises
    ------
    ValueError
        For an unknown projection.
    """
    lat_0, lon_0, alt_0 = origin
    lat, lon, alt = point
    dlon = wrap_angle(lon - lon_0)
    if projection == "ardupilot":
        scale = _longitude_scale(0.5 * (lat + lat_0))
        return (lat - lat_0) * _ARDUPILOT_R, dlon * _ARDUPILOT_R * scale, alt_0 - alt
    if projection == "px4":
        # cos(lat_0) sin(lat) - sin(lat_0) cos(lat) cos(dlon), free of cancellation.
        x = math.sin(lat - lat_0) + 2.0 * math.sin(lat_0) * math.cos(lat) * math.sin(0.5 * dlon) ** 2
        y = math.cos(lat) * math.sin(dlon)
        # PX4 takes the acos of this cosine, which rounds near the origin; the arc is the same.
        cos_c = math.sin(lat_0) * math.sin(lat) + math.cos(lat_0) * math.cos(lat) * math.cos(dlon)
        sin_c = math.hypot(x, y)
        k = math.atan2(sin_c, cos_c) / sin_c if sin_c > 0.0 else 1.0
        return k * x * _PX4_R, k * y * _PX4_R, alt_0 - alt
    if projection == "tangent":
        east, north, up = to_enu(point, origin).tolist()
        return north, east, -up
    raise _unknown(projection)


def _longitude_scale(lat: float) -> float:
    return max(math.cos(lat), 0.01)  # ArduPilot's floor: no division by zero at a pole


def _unknown(projection: str) -> ValueError:
    return ValueError(f"unknown local projection {projection!r}: choose ardupilot, px4 or tangent")


def rotation_matrix(vector: Floats) -> Floats:
    """Compute exp([vector x]): the rotation by |vector| rad about it (Rodrigues).

    Parameters
    ----------
    vector : (3,)
        Rotation vector, rad.

    Returns
    -------
    (3, 3)
        Rotation matrix.
    """
    x, y, z = vector.tolist()
    angle2 = x * x + y * y + z * z
    if angle2 < 1e-4:  # the series are exact to rounding here, the closed forms are not
        p = 1.0 - angle2 / 6.0 * (1.0 - angle2 / 20.0 * (1.0 - angle2 / 42.0))
        q = 0.5 - angle2 / 24.0 * (1.0 - angle2 / 30.0 * (1.0 - angle2 / 56.0))
    else:
        a = math.sqrt(angle2)
        p, q = math.sin(a) / a, (1.0 - math.cos(a)) / angle2
    return np.array(  # I + p [vector x] + q [vector x]^2
        [
            [1.0 - q * (y * y + z * z), q * x * y - p * z, q * x * z + p * y],
            [q * x * y + p * z, 1.0 - q * (x * x + z * z), q * y * z - p * x],
            [q * x * z - p * y, q * y * z + p * x, 1.0 - q * (x * x + y * y)],
        ]
    )
