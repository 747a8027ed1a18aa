"""Rows of H against small perturbations of the full measurement."""

import math

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from companion.nav import correctors
from companion.nav.correctors import airspeed, observation_matrix, rsbn_azimuth, rsbn_range
from companion.nav.earth import SPHERE
from companion.nav.error_model import INS_STATES
from companion.nav.geometry import Geodetic, displace, rotation_matrix, slant_range_azimuth, wrap_angle
from companion.units import Floats

lat, lon = 0.95, 0.65
states = (*INS_STATES, "wN", "wE", "dg", "dd")


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


@given(st.floats(0.1, 1.2), st.floats(-3.0, 3.0))
@settings(max_examples=50)
def test_the_axis_of_a_free_gyro(h: float, q: float) -> None:
    """dd raises the declination, dg moves the axis westward; P is the zenith's place about it, westward."""
    star_e = axes(lat, lon).T @ ned(q, h)
    zenith_e, pole_e = -axes(lat, lon)[2], np.array([0.0, 0.0, 1.0])
    westward = np.cross(star_e, pole_e)
    westward /= math.sqrt(float(westward @ westward))
    northward = pole_e - (pole_e @ star_e) * star_e
    northward /= math.sqrt(float(northward @ northward))
    P = math.atan2(float(zenith_e @ westward), float(zenith_e @ northward))

    def innovation(x: Floats) -> Floats:
        assumed = star_e + x[0] * westward + x[1] * northward
        d = seen(axes(lat, lon) @ assumed / np.linalg.norm(assumed)) - seen(ned(q, h))
        return np.array([d[0], wrap_angle(float(d[1]))])

    H = observation_matrix(states, *correctors.free_gyro(h, q, P, lat))[:, -2:]
    np.testing.assert_allclose(H, derivative(innovation, np.array([1e-5, 1e-5])), atol=1e-7)


@given(st.floats(0.0, 6.28), st.floats(20e3, 200e3), st.floats(500.0, 9000.0))
@settings(max_examples=50)
def test_a_beacon_seen_by_a_displaced_aircraft(azimuth: float, distance: float, alt: float) -> None:
    """Range and azimuth on the ellipsoid; the rows are flat, so the tolerance is the curvature's, d/R."""
    aircraft = Geodetic(lat, lon, alt)
    beacon = displace(lat, lon, 100.0, -distance * math.cos(azimuth), -distance * math.sin(azimuth), 0.0)
    sight = slant_range_azimuth(beacon, aircraft)
    bearing = math.pi + slant_range_azimuth(aircraft, beacon).azimuth
    horizontal = sight.slant_range * math.cos(sight.elevation)

    def innovation(x: Floats) -> Floats:
        moved = slant_range_azimuth(beacon, displace(*aircraft, float(x[0]), float(x[1]), 0.0))
        return np.array(
            [moved.slant_range - sight.slant_range, wrap_angle(moved.azimuth - sight.azimuth) * horizontal]
        )

    H = observation_matrix(
        ("dx", "dy"), rsbn_range(bearing, sight.elevation), rsbn_azimuth(bearing, horizontal)
    )
    H[1] *= horizontal
    tolerance = 0.01 + distance / SPHERE.R
    np.testing.assert_allclose(H, derivative(innovation, np.array([10.0, 10.0])), atol=tolerance)


def test_a_beacon_overhead_has_no_azimuth() -> None:
    with pytest.raises(ValueError, match="overhead"):
        rsbn_azimuth(0.3, 0.0)


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
    H = observation_matrix(states[:9], *airspeed(K, V_air))
    np.testing.assert_allclose(H, derivative(innovation, eps), atol=1e-8)


def test_position_velocity_and_a_second_system() -> None:
    np.testing.assert_array_equal(observation_matrix(INS_STATES, *correctors.gnss_position()), np.eye(7)[:2])
    np.testing.assert_array_equal(observation_matrix(INS_STATES, *correctors.gnss_velocity()), np.eye(7)[2:4])
    both = (*INS_STATES, *(s + "2" for s in INS_STATES))
    np.testing.assert_array_equal(
        observation_matrix(both, *correctors.second_ins()), np.hstack([np.eye(7), -np.eye(7)])
    )


def test_a_drifting_line_of_position() -> None:
    """(1.23)."""
    H = observation_matrix(
        ("dx", "dy", "O1"),
        correctors.line_of_position(0.6, 0.8, "O1"),
        correctors.line_of_position(0.8, -0.6),
    )
    np.testing.assert_array_equal(H, [[0.6, 0.8, 1.0], [0.8, -0.6, 0.0]])


def test_unknown_state_is_reported() -> None:
    with pytest.raises(ValueError, match="measures wN"):
        observation_matrix(INS_STATES, *airspeed(0.0, 60.0))
