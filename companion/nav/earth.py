"""WGS84 earth: its constants and radii of curvature; the sphere of the INS error equations.

Scalars in, scalars out, by `math`: these are called once a message. It knows neither positions in
space (`geometry`) nor motion.

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


class Sphere(NamedTuple):
    """Spherical earth of the INS error equations, in any consistent units.

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
