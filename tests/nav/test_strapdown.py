"""Synthesis and integration against each other and against analytic motion."""

import math
from collections.abc import Callable
from itertools import pairwise

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from companion.nav import earth, strapdown
from companion.nav.geometry import Geodetic, separation
from companion.nav.strapdown import InertialState, mechanise, rotation_matrix, rotation_vector, synthesise
from companion.units import Floats

vectors = st.tuples(*[st.floats(-1.0, 1.0)] * 3).map(np.array)


def start(lat_deg: float = 55.0, v_n: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> InertialState:
    return InertialState(math.radians(lat_deg), math.radians(37.0), 150.0, np.array(v_n), np.eye(3))


@given(vectors)
def test_rotation_and_its_vector(v: Floats) -> None:
    C = rotation_matrix(3.0 / math.sqrt(3.0) * v)
    np.testing.assert_allclose(C @ C.T, np.eye(3), atol=2e-15)
    np.testing.assert_allclose(rotation_vector(C), 3.0 / math.sqrt(3.0) * v, atol=1e-13)


def test_rotation_is_continuous_at_the_end_of_the_series() -> None:
    for angle in (1e-9, 9.99e-3, 1.001e-2, 1.0):
        s, c = math.sin(angle), math.cos(angle)
        np.testing.assert_allclose(
            rotation_matrix(np.array([0.0, 0.0, angle])),
            [[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]],
            atol=1e-16,
        )


def test_half_a_turn_in_a_step_is_rejected() -> None:
    with pytest.raises(ValueError, match="sample faster"):
        rotation_vector(rotation_matrix(np.array([math.pi, 0.0, 0.0])))


def test_a_body_at_rest_on_the_ground_stays() -> None:
    state = start()
    g, w = earth.gravity(state.lat, state.alt), earth.earth_rate(state.lat)
    for _ in range(1000):
        state = mechanise(state, np.array([0.0, 0.0, -g]), np.array(w), 0.1)
    second_order = g * (earth.OMEGA * 0.1) ** 2 / 24.0 * 100.0  # of the frame's turn in a step: 2 nm/s
    np.testing.assert_allclose(state.v_n, 0.0, atol=second_order)
    np.testing.assert_allclose(separation(Geodetic(*state[:3]), Geodetic(*start()[:3])), 0.0, atol=1e-7)
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


def turning(t: float) -> InertialState:
    """Circles of 200 m radius at 20 m/s, climbing at 2 m/s, banked and rocking: every term at work.

    Position is not integrated here; velocity and attitude are analytic.
    """
    rate = 0.1
    yaw, roll, pitch = rate * t, 0.2 + 0.1 * math.sin(2.0 * t), 0.1 * math.cos(1.3 * t)
    v_n = np.array([20.0 * math.cos(yaw), 20.0 * math.sin(yaw), -2.0])
    C_nb = (
        rotation_matrix(np.array([0.0, 0.0, yaw]))
        @ rotation_matrix(np.array([0.0, pitch, 0.0]))
        @ rotation_matrix(np.array([roll, 0.0, 0.0]))
    )
    return InertialState(math.radians(55.0), 0.6, 100.0 + 2.0 * t, v_n, C_nb)


def trajectory(motion: Callable[[float], InertialState], dt: float, seconds: float) -> list[InertialState]:
    """`motion` with its position integrated from its velocity in steps a hundred times finer than needed."""
    states, lat, lon, alt = [], *motion(0.0)[:3]
    nodes = (0.5 - math.sqrt(15) / 10, 0.5, 0.5 + math.sqrt(15) / 10)
    for k in range(round(seconds / dt) + 1):
        states.append(motion(k * dt)._replace(lat=lat, lon=lon, alt=alt))
        v = [motion((k + c) * dt).v_n for c in nodes]  # Gauss-Legendre, sixth order
        vN, vE, vD = (5 * v[0] + 8 * v[1] + 5 * v[2]) / 18
        R_N, R_E = earth.radii(lat)
        lat_mid = lat + 0.5 * dt * vN / (R_N + alt)
        lat, alt = lat + dt * vN / (R_N + alt), alt - dt * vD
        lon += dt * vE / ((R_E + alt + 0.5 * dt * vD) * math.cos(lat_mid))
    return states


def worst(dt: float, seconds: float = 20.0) -> tuple[float, float, float]:
    """Position (m), velocity (m/s) and attitude (rad) errors after integrating what was synthesised."""
    truth = trajectory(turning, dt, seconds)
    state = truth[0]
    for a, b in pairwise(truth):
        state = mechanise(state, *synthesise(a, b, dt), dt)
    end = truth[-1]
    return (
        float(np.linalg.norm(separation(Geodetic(*state[:3]), Geodetic(*end[:3])))),
        float(np.linalg.norm(state.v_n - end.v_n)),
        float(np.linalg.norm(rotation_vector(end.C_nb.T @ state.C_nb))),
    )


def test_integrating_the_synthesised_sensors_reproduces_the_flight() -> None:
    position, velocity, attitude = worst(0.01)
    assert position < 1e-3
    assert velocity < 1e-6
    assert attitude < 1e-10


def test_their_disagreement_falls_with_the_square_of_the_step() -> None:
    coarse, fine = worst(0.04), worst(0.02)
    assert 3.0 < coarse[0] / fine[0] < 5.0


def test_the_sensors_of_a_flat_turn_are_the_textbook_ones() -> None:
    """v^2/r inwards and gravity upwards; the yaw rate plus the rate of n: no integrator in between."""
    v, rate, dt = 20.0, 0.1, 1e-3

    def circle(t: float) -> InertialState:
        yaw = rate * t
        v_n = v * np.array([math.cos(yaw), math.sin(yaw), 0.0])
        return InertialState(math.radians(55.0), 0.6, 100.0, v_n, rotation_matrix(np.array([0.0, 0.0, yaw])))

    f_b, w_b = synthesise(circle(-0.5 * dt), circle(0.5 * dt), dt)
    w_ie = np.array(earth.earth_rate(math.radians(55.0)))
    w_en = np.array(earth.transport_rate(math.radians(55.0), 100.0, v, 0.0))
    g = earth.gravity(math.radians(55.0), 100.0)
    coriolis = np.cross(2.0 * w_ie + w_en, [v, 0.0, 0.0])
    np.testing.assert_allclose(f_b, np.array([0.0, v * rate, -g]) + coriolis, atol=1e-7)
    np.testing.assert_allclose(w_b, np.array([0.0, 0.0, rate]) + w_ie + w_en, atol=1e-9)


@given(vectors, vectors, vectors)
@settings(max_examples=100)
def test_one_step_and_its_inverse(f: Floats, w: Floats, v: Floats) -> None:
    state = start(v_n=tuple(50.0 * v))
    f_b, w_b = 30.0 * f, 5.0 * w
    back = synthesise(state, mechanise(state, f_b, w_b, 0.005), 0.005)
    np.testing.assert_allclose(back.w_b, w_b, atol=1e-9)
    # the mirror is of second order in the step: at 3 g and 5 rad/s it leaves some 4e-9 of the force
    np.testing.assert_allclose(back.f_b, f_b, rtol=1e-7, atol=1e-8 * 30.0)


def test_two_samples_compensate_coning() -> None:
    """Classical coning, 5 Hz and 1 degree: on the whole nothing turns, yet one-sample integration drifts."""
    dt, theta, omega, seconds = 0.01, math.radians(1.0), 2.0 * math.pi * 5.0, 10.0
    zero_earth = earth.Sphere(6371e3, 0.0, 0.0)

    def attitude(t: float) -> npt.NDArray[np.float64]:
        return rotation_matrix(theta * np.array([math.cos(omega * t), math.sin(omega * t), 0.0]))

    def angle(t: float) -> Floats:
        """Integral of the body rate over (t, t + dt): a constant about z and a turning part."""
        k = math.sin(theta) * (np.array([math.cos(omega * (t + dt)), math.sin(omega * (t + dt)), 0.0]))
        k -= math.sin(theta) * np.array([math.cos(omega * t), math.sin(omega * t), 0.0])
        return k + np.array([0.0, 0.0, -2.0 * omega * math.sin(0.5 * theta) ** 2 * dt])

    rest = InertialState(0.0, 0.0, 0.0, np.zeros(3), attitude(0.0))
    one = two = rest
    for k in range(0, round(seconds / dt), 2):
        w_1, w_2 = angle(k * dt) / dt, angle((k + 1) * dt) / dt
        one = mechanise(one, np.zeros(3), w_1, dt, zero_earth)
        one = mechanise(one, np.zeros(3), w_2, dt, zero_earth)
        two = mechanise(
            two, *strapdown.combine_two_samples(np.zeros(3), w_1, np.zeros(3), w_2, dt), 2 * dt, zero_earth
        )
    truth = attitude(seconds)
    drift_one = float(np.linalg.norm(rotation_vector(truth.T @ one.C_nb)))
    drift_two = float(np.linalg.norm(rotation_vector(truth.T @ two.C_nb)))
    assert drift_two < drift_one / 10.0


def test_two_samples_compensate_sculling() -> None:
    """Rocking about x and shaking along y in phase: the mean specific force downwards is kept."""
    dt, omega, amplitude, shake, seconds = 0.01, 2.0 * math.pi * 5.0, math.radians(2.0), 5.0, 4.0
    zero_earth = earth.Sphere(1e12, 0.0, 0.0)
    rest = InertialState(0.0, 0.0, 0.0, np.zeros(3), np.eye(3))

    def sample(t: float, h: float) -> tuple[Floats, Floats]:
        turned = amplitude * (math.sin(omega * (t + h)) - math.sin(omega * t))
        pushed = shake / omega * (math.cos(omega * t) - math.cos(omega * (t + h)))
        return np.array([0.0, pushed / h, 0.0]), np.array([turned / h, 0.0, 0.0])

    def flown(h: float, paired: bool) -> Floats:
        state = rest
        n = round(seconds / h)
        for k in range(0, n, 2 if paired else 1):
            f_1, w_1 = sample(k * h, h)
            if paired:
                f, w = strapdown.combine_two_samples(f_1, w_1, *sample((k + 1) * h, h), h)
                state = mechanise(state, f, w, 2 * h, zero_earth)
            else:
                state = mechanise(state, f_1, w_1, h, zero_earth)
        return state.v_n

    truth = flown(dt / 32, paired=False)
    single, double = np.linalg.norm(flown(dt, False) - truth), np.linalg.norm(flown(dt, True) - truth)
    assert double < single / 4.0
