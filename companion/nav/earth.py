"""WGS84 earth: radii of curvature, normal gravity, angular rates.

Scalars in, scalars out, by `math`: these are called once a message. It knows neither positions in
space (`geometry`) nor motion (`strapdown`). Rates are angular rates resolved in n (NED).

Sources: NIMA TR8350.2 (third edition, 2000), tables 3.1-3.4; Groves, Principles of GNSS, Inertial and
Multisensor Integrated Navigation Systems (second edition, 2013), chapter 2, equation numbers as there.
"""

import math
from typing import NamedTuple

A = 6378137.0
"""Semi-major axis, m."""
F = 1.0 / 298.257223563
"""Flattening."""
B = A * (1.0 - F)
"""Semi-minor axis, m."""
E2 = F * (2.0 - F)
"""First eccentricity squared."""
GM = 3.986004418e14
"""Geocentric gravitational constant, atmosphere included, m^3/s^2."""
OMEGA = 7.292115e-5
"""Rate of rotation, rad/s."""
G_EQUATOR = 9.7803253359
"""Normal gravity on the ellipsoid at the equator, m/s^2."""
G_POLE = 9.8321849378
"""Normal gravity on the ellipsoid at the poles, m/s^2."""

_SOMIGLIANA_K = B * G_POLE / (A * G_EQUATOR) - 1.0
_M = OMEGA**2 * A**2 * B / GM


class Radii(NamedTuple):
    """Radii of curvature of the ellipsoid, named by the direction of motion, as Groves does.

    Attributes
    ----------
    R_N : float
        In the meridian (north-south motion), m.
    R_E : float
        In the prime vertical (east-west motion), m.
    """

    R_N: float
    R_E: float


class RateN(NamedTuple):
    """Angular rate resolved in n.

    Attributes
    ----------
    north, east, down : float
        Components, rad/s.
    """

    north: float
    east: float
    down: float


class Sphere(NamedTuple):
    """Spherical earth of the INS error equations, in any consistent units.

    It can be used wherever an `Earth` (see `strapdown`) is expected.

    Attributes
    ----------
    R : float
        Radius.
    G : float
        Acceleration of gravity.
    OMEGA : float
        Rate of rotation.
    """

    R: float
    G: float
    OMEGA: float

    def radii(self, lat: float) -> Radii:
        """Return the radius, the same at every latitude.

        Parameters
        ----------
        lat : float
            Latitude, rad; not used.

        Returns
        -------
        Radii
            R twice.
        """
        return Radii(self.R, self.R)

    def gravity(self, lat: float, alt: float = 0.0) -> float:
        """Return the acceleration of gravity, the same everywhere.

        Parameters
        ----------
        lat, alt : float
            Latitude, rad, and height; not used.

        Returns
        -------
        float
            G.
        """
        return self.G


SPHERE = Sphere(6371e3, 9.81, OMEGA)
"""Sphere in SI units."""
SPHERE_KM_H = Sphere(6371.0, 9.81 * 3.6e3**2 / 1e3, OMEGA * 3.6e3)
"""Sphere in kilometres and hours, the units of Poddubny's example."""


def radii(lat: float) -> Radii:
    """Compute the radii of curvature.

    Parameters
    ----------
    lat : float
        Geodetic latitude, rad.

    Returns
    -------
    Radii
        Meridian and prime vertical, m.

    References
    ----------
    Groves (2.105), (2.106).
    """
    sin_lat = math.sin(lat)
    w2 = 1.0 - E2 * sin_lat * sin_lat
    R_E = A / math.sqrt(w2)
    return Radii(R_E * (1.0 - E2) / w2, R_E)


def gravity(lat: float, alt: float = 0.0) -> float:
    """Compute the magnitude of normal gravity.

    Somigliana's closed form on the ellipsoid, second order in height above it; accurate to 1e-6 m/s^2 up to
    20 km.

    Parameters
    ----------
    lat : float
        Geodetic latitude, rad.
    alt : float
        Height above the ellipsoid, m.

    Returns
    -------
    float
        Gravity, m/s^2.

    References
    ----------
    NIMA TR8350.2 (4-1), (4-3).
    """
    s2 = math.sin(lat) ** 2
    g_0 = G_EQUATOR * (1.0 + _SOMIGLIANA_K * s2) / math.sqrt(1.0 - E2 * s2)
    h = alt / A
    return g_0 * (1.0 - 2.0 * (1.0 + F + _M - 2.0 * F * s2) * h + 3.0 * h * h)


def earth_rate(lat: float) -> RateN:
    """Compute the rate of the earth w_ie_n.

    Parameters
    ----------
    lat : float
        Geodetic latitude, rad.

    Returns
    -------
    RateN
        Rate in n, rad/s.

    References
    ----------
    Groves (2.123).
    """
    return RateN(OMEGA * math.cos(lat), 0.0, -OMEGA * math.sin(lat))


def transport_rate(lat: float, alt: float, v_north: float, v_east: float) -> RateN:
    """Compute the rate of n over the earth w_en_n.

    It grows without limit towards the poles, where north is not defined: the caller avoids them.

    Parameters
    ----------
    lat : float
        Geodetic latitude, rad.
    alt : float
        Height above the ellipsoid, m.
    v_north, v_east : float
        Ground velocity, m/s.

    Returns
    -------
    RateN
        Rate in n, rad/s.

    References
    ----------
    Groves (5.44).
    """
    R_N, R_E = radii(lat)
    lon_rate_cos = v_east / (R_E + alt)
    return RateN(lon_rate_cos, -v_north / (R_N + alt), -lon_rate_cos * math.tan(lat))
