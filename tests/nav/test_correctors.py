"""Rows of H against small perturbations of the full measurement."""

import math

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from companion.nav import correctors
from companion.nav.correctors import airspeed, observation_matrix
from companion.nav.earth import SPHERE
from companion.nav.error_model import INS_STATES
from companion.nav.geometry import rotation_matrix, wrap_angle
from companion.units import Floats

lat, lon = 0.95, 0.65
states = (*INS_STATES, "wN", "wE")


def ned(azimuth: float, altitude: float) -> Floats:
    c = math.cos(altitude)
    return np.array([c * math.cos(azimuth), c * math.sin(azimuth), -math.sin(altitude)])


def axes(lat: float, lon: float) -> npt.NDArray[np.float64]:
    """Equatorial to NED on a sphere, sidereal time zero at Greenwich."""
    return np.array(
        [
            [-math.sin(lat) * math.cos(lon), -math.sin(lat) * math.sin(lon), math.cos(lat)],
            [-math.sin(lon), math.cos(lon), 0.0],
            [-math.cos(lat) * math.cos(lon), -math.cos(lat) * math.sin(lon), -math.sin(lat)],
        ]
    )


def seen(u: Floats) -> Floats:
    """Altitude and azimuth of a direction in NED."""
    return np.array([math.asin(-u[2]), math.atan2(u[1], u[0])])


def derivative(f: object, eps: Floats) -> npt.NDArray[np.float64]:
    """Central differences of f(x) over the states, with a step per state: (k, n)."""
    assert callable(f)
    columns = []
    for i, e in enumerate(eps):
        x = np.zeros(len(eps))
        x[i] = e
        columns.append((f(x) - f(-x)) / (2.0 * e))
    return np.array(columns).T


@given(st.floats(0.1, 1.2), st.floats(-3.0, 3.0))
@settings(max_examples=50)
def test_a_star_against_a_tilted_platform(h: float, q: float) -> None:
    """(1.22): what the star should be at the computed place, less what the turned platform shows."""
    star_e = axes(lat, lon).T @ ned(q, h)

    def innovation(x: Floats) -> Floats:
        computed = axes(lat + x[0] / SPHERE.R, lon + x[1] / (SPHERE.R * math.cos(lat))) @ star_e
        measured = rotation_matrix(x[4:7]) @ ned(q, h)
        d = seen(computed) - seen(measured)
        return np.array([d[0], wrap_angle(float(d[1]))])

    eps = np.array([50.0, 50.0, 1.0, 1.0, 1e-5, 1e-5, 1e-5])
    H = observation_matrix(INS_STATES, *correctors.star(h, q, lat))
    np.testing.assert_allclose(H * eps, derivative(innovation, eps) * eps, rtol=0.0, atol=1e-12)


@given(st.floats(-3.0, 3.0), st.floats(-20.0, 20.0), st.floats(-20.0, 20.0))
@settings(max_examples=50)
def test_airspeed_in_a_wind(K: float, wind_n: float, wind_e: float) -> None:
    """INS velocity turned into the hull by the computed heading K + PZ, less the air velocity measured."""
    V_air = 60.0
    air_n = V_air * np.array([math.cos(K), math.sin(K)])

    def innovation(x: Floats) -> Floats:
        true = air_n + np.array([x[7], x[8]])  # flying on, the ground velocity takes the wind
        s, c = math.sin(K + x[6]), math.cos(K + x[6])
        hull = np.array([[c, s], [-s, c]])
        return np.asarray(hull @ (true + x[2:4]) - np.array([V_air, 0.0]))

    eps = np.array([1.0, 1.0, 1e-3, 1e-3, 1e-5, 1e-5, 1e-6, 1e-3, 1e-3])
    H = observation_matrix(states, *airspeed(K, V_air))
    np.testing.assert_allclose(H, derivative(innovation, eps), atol=1e-8)


def test_a_second_system() -> None:
    H = observation_matrix(("dx", "dy", "dx2", "dy2"), *correctors.second_ins())
    np.testing.assert_array_equal(H, np.hstack([np.eye(2), -np.eye(2)]))


def test_a_drifting_line_of_position() -> None:
    """(1.23)."""
    H = observation_matrix(("dx", "dy", "O1"), correctors.line_of_position(0.6, 0.8, "O1"))
    np.testing.assert_array_equal(H, [[0.6, 0.8, 1.0]])


def test_unknown_state_is_reported() -> None:
    with pytest.raises(ValueError, match="measures wN"):
        observation_matrix(INS_STATES, *airspeed(0.0, 60.0))
