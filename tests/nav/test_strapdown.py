"""The strapdown judge against analytic motion."""

import math

import numpy as np
import pytest

from companion.nav import earth
from companion.nav.geometry import Geodetic, rotation_matrix, separation
from sitl.flight import gravity
from tests.nav.strapdown import InertialState, mechanise

LAT, ALT = math.radians(55.0), 150.0
W_IE = earth.OMEGA * np.array([math.cos(LAT), 0.0, -math.sin(LAT)])
G = float(gravity(np.float64(LAT), np.float64(ALT)))


def test_a_body_at_rest_on_the_ground_stays() -> None:
    start = state = InertialState(LAT, math.radians(37.0), ALT, np.zeros(3), np.eye(3))
    for _ in range(1000):
        state = mechanise(state, np.array([0.0, 0.0, -G]), W_IE, 0.1)
    second_order = G * (earth.OMEGA * 0.1) ** 2 / 24.0 * 100.0  # of the frame's turn in a step: 2 nm/s
    np.testing.assert_allclose(state.v_n, 0.0, atol=second_order)
    np.testing.assert_allclose(separation(Geodetic(*state[:3]), Geodetic(*start[:3])), 0.0, atol=1e-7)
    np.testing.assert_allclose(state.C_nb, np.eye(3), atol=1e-13)


def test_a_free_body_in_orbit() -> None:
    """No specific force, on a sphere with gravity G: circular flight east on the equator."""
    sphere = earth.Sphere(6371e3, 9.81, earth.OMEGA)
    # Gravity contains the centrifugal part of the earth's own rotation: V^2/R + 2 Om V = G.
    v_ground = -sphere.OMEGA * sphere.R + math.sqrt((sphere.OMEGA * sphere.R) ** 2 + sphere.G * sphere.R)
    state = InertialState(0.0, 0.0, 0.0, np.array([0.0, v_ground, 0.0]), np.eye(3))
    for _ in range(600):
        state = mechanise(state, np.zeros(3), np.zeros(3), 1.0, sphere)
    assert state.alt == pytest.approx(0.0, abs=1e-3)
    assert state.lon == pytest.approx(v_ground / sphere.R * 600.0, rel=1e-9)


def test_a_flat_turn_by_the_textbook_sensors() -> None:
    """v^2/r inwards and gravity upwards; the yaw rate plus the rate of n."""
    v, rate, dt = 20.0, 0.1, 1e-3

    def circle(t: float) -> InertialState:
        yaw = rate * t
        v_n = v * np.array([math.cos(yaw), math.sin(yaw), 0.0])
        return InertialState(LAT, 0.6, ALT, v_n, rotation_matrix(np.array([0.0, 0.0, yaw])))

    w_en = np.array([0.0, -v / (earth.radii(LAT).R_N + ALT), 0.0])
    coriolis = np.cross(2.0 * W_IE + w_en, [v, 0.0, 0.0])
    f_b, w_b = np.array([0.0, v * rate, -G]) + coriolis, np.array([0.0, 0.0, rate]) + W_IE + w_en
    after = mechanise(circle(-0.5 * dt), f_b, w_b, dt)
    np.testing.assert_allclose(after.v_n, circle(0.5 * dt).v_n, atol=1e-7 * dt)
    np.testing.assert_allclose(after.C_nb, circle(0.5 * dt).C_nb, atol=1e-9 * dt)
