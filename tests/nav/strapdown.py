"""Strapdown navigation in the local-level frame: the judge of the error equations and of the simulated IMU.

`mechanise` integrates specific force f_b and angular rate w_b (means over a step, of the body against the
inertial frame) into position, ground velocity and attitude. It is second order in dt with the body's rotation
integrated exactly.

Source: Groves (2013), 5.4 (local-navigation-frame equations) and 5.5; gravity NIMA TR8350.2 (4-1), (4-3).
"""

import math
from typing import NamedTuple

import numpy as np

from companion.nav import earth as wgs84
from companion.nav.geometry import rotation_matrix, wrap_angle
from companion.units import Floats
from sitl.flight import gravity


class InertialState(NamedTuple):
    """Latitude, longitude (rad), height (m), ground velocity (3,) NED (m/s), and C_nb with v_n = C_nb v_b."""

    lat: float
    lon: float
    alt: float
    v_n: Floats
    C_nb: Floats


class Rates(NamedTuple):
    """Rates of change of an `InertialState`, and the rate of frame n against the inertial frame, in n."""

    lat: float
    lon: float
    alt: float
    v_n: Floats
    w_in_n: Floats


def navigation_rates(lat: float, alt: float, v_n: Floats, f_n: Floats, sphere: wgs84.Sphere | None) -> Rates:
    """The navigation equations in continuous time, on WGS84 or a sphere: Groves (5.54), (5.56)."""
    vN, vE, vD = v_n.tolist()
    R_N, R_E = wgs84.radii(lat) if sphere is None else (sphere.R, sphere.R)
    g = float(gravity(np.float64(lat), np.float64(alt))) if sphere is None else sphere.G
    omega = wgs84.OMEGA if sphere is None else sphere.OMEGA
    lat_rate, lon_rate = vN / (R_N + alt), vE / ((R_E + alt) * math.cos(lat))
    w_ie = omega * np.array([math.cos(lat), 0.0, -math.sin(lat)])
    w_in = w_ie + np.array([lon_rate * math.cos(lat), -lat_rate, -lon_rate * math.sin(lat)])
    a_n = f_n + np.array([0.0, 0.0, g]) - np.cross(w_in + w_ie, v_n)
    return Rates(lat_rate, lon_rate, -vD, a_n, w_in)


def mechanise(
    state: InertialState, f_b: Floats, w_b: Floats, dt: float, sphere: wgs84.Sphere | None = None
) -> InertialState:
    """The state one step later: Groves (2013), 5.4, 5.5."""
    lat, lon, alt, v_n, C_nb = state
    start = navigation_rates(lat, alt, v_n, C_nb @ f_b, sphere)
    lat_mid, alt_mid = lat + 0.5 * dt * start.lat, alt + 0.5 * dt * start.alt
    unforced = navigation_rates(lat_mid, alt_mid, v_n + 0.5 * dt * start.v_n, np.zeros(3), sphere)
    turn = unforced.w_in_n * dt
    f_n = rotation_matrix(-0.5 * turn) @ (C_nb @ (_mean_rotation(w_b * dt) @ f_b))
    v_new = v_n + dt * (f_n + unforced.v_n)
    mean = navigation_rates(lat_mid, alt_mid, 0.5 * (v_n + v_new), f_n, sphere)
    C_new = rotation_matrix(-turn) @ C_nb @ rotation_matrix(w_b * dt)
    return InertialState(
        lat + dt * mean.lat, wrap_angle(lon + dt * mean.lon), alt + dt * mean.alt, v_new, C_new
    )


def _mean_rotation(vector: Floats) -> Floats:
    """The mean of exp([s vector x]) over s in (0, 1), by Gauss and Legendre to the sixth order."""
    half, off = rotation_matrix(0.5 * vector), math.sqrt(15.0) / 10.0
    before, after = rotation_matrix((0.5 - off) * vector), rotation_matrix((0.5 + off) * vector)
    mean: Floats = (5.0 * before + 8.0 * half + 5.0 * after) / 18.0
    return mean
