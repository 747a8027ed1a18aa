"""The error equations against a nonlinear inertial system, published eigenvalues and independent matrices.

data/error_model.json holds matrices and eigenvalues computed independently of this project.
"""

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from companion.nav import disturbances as dist
from companion.nav import error_model
from companion.nav.correctors import (
    airspeed,
    observation_matrix,
    paper_velocity,
    relative_log,
)
from companion.nav.earth import SPHERE, SPHERE_KM_H
from companion.nav.error_model import INS_STATES, aircraft_model, paper_example, paper_model
from companion.nav.geometry import rotation_matrix
from companion.units import Floats
from tests.nav.strapdown import navigation_rates

GOLDEN: dict[str, Any] = json.loads((Path(__file__).parents[1] / "data" / "error_model.json").read_text())
speeds = [8.0, 30.0, 250.0]
headings = [0.0, 90.0, 180.0, 225.0]


def frequencies(A: Floats) -> Floats:
    """Imaginary parts of a spectrum that must be imaginary, from the greatest down."""
    eigenvalues = np.linalg.eigvals(A)
    np.testing.assert_allclose(eigenvalues.real, 0.0, atol=1e-9 * np.abs(eigenvalues).max())
    return np.sort(eigenvalues.imag)[::-1]


# -- independent matrices ------------------------------------------------------------------------------


@pytest.mark.parametrize(("V", "lat"), [(30.0, math.pi / 4), (250.0, math.pi / 3)])
@pytest.mark.parametrize(("name", "model"), [("A7_full", aircraft_model), ("A7_paper", paper_model)])
def test_golden_matrices(name: str, model: Any, V: float, lat: float) -> None:
    golden = np.array(GOLDEN["matrices"][f"{name} V={V:.0f} K=1.570796 phi={lat:.6f}"])
    np.testing.assert_allclose(model(lat, 0.0, V).A, golden, rtol=1e-14, atol=0.0)


def test_golden_sixteen_states() -> None:
    example = paper_example("km-h")
    matrices = GOLDEN["matrices"]
    np.testing.assert_allclose(example.A_continuous, matrices["A16_paper_kmh"], rtol=1e-14, atol=0.0)
    np.testing.assert_allclose(example.H, matrices["H_paper_kmh"], rtol=1e-14, atol=1e-16)
    assert example.states == (
        *INS_STATES,
        *("EX", "EY", "EZ"),
        *("VcX", "VcY"),
        *("GX", "GY"),
        *("AX", "AY"),
    )


@pytest.mark.parametrize("V", [30.0, 250.0])
def test_golden_airspeed_rows(V: float) -> None:
    model = aircraft_model(
        1.0,
        0.0,
        V,
        added=(dist.gyro_drift(1.0, 0.0), dist.Disturbance(("wN", "wE"), 1.0), *_gravity_and_sensors()),
    )
    H = observation_matrix(model.states, *airspeed(math.pi / 2, V))
    np.testing.assert_allclose(H, GOLDEN["matrices"][f"H_full V={V:.0f} K=1.570796"], atol=1e-15)


def _gravity_and_sensors() -> tuple[dist.Disturbance, ...]:
    return dist.gravity(30.0, 1e4, 1e-4), dist.accelerometer(20 / 3600, 1e-5)


# -- spectra -------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("golden", "model", "V"),
    [
        ("paper V=0", paper_model, 0.0),
        ("paper V=30 E", paper_model, 30.0),
        ("full V=0 E", aircraft_model, 0.0),
        ("full V=30 E", aircraft_model, 30.0),
    ],
)
def test_golden_spectra(golden: str, model: Any, V: float) -> None:
    expected = np.sort([imag for _, imag in GOLDEN["eigenvalues"][golden]])[::-1]
    A = model(math.pi / 3, 0.0, V, sphere=SPHERE_KM_H).A
    # The reference spectra took fD = -G, leaving out what Coriolis and V^2/R take off the weight: 3e-5 of the
    # Schuler frequency at 30 km/h. (The reference matrices have it.)
    A[2, 5], A[3, 4] = -SPHERE_KM_H.G, SPHERE_KM_H.G
    np.testing.assert_allclose(frequencies(A), expected, rtol=0.0, atol=1e-9)


def test_the_laws_of_the_schuler_pair() -> None:
    """Product of the two frequencies G/R, difference 2 Om sin(phi); then the earth's rate, and a zero."""
    for lat in (0.1, 0.8, math.pi / 3, 1.3):
        fast, slow, diurnal, zero = frequencies(paper_model(lat, 0.0, 0.0, sphere=SPHERE_KM_H).A)[:4]
        assert fast * slow == pytest.approx(SPHERE_KM_H.G / SPHERE_KM_H.R, rel=1e-9)
        assert fast - slow == pytest.approx(2.0 * SPHERE_KM_H.OMEGA * math.sin(lat), rel=1e-8)
        assert diurnal == pytest.approx(SPHERE_KM_H.OMEGA, rel=1e-8)
        assert zero == pytest.approx(0.0, abs=1e-9)


def test_the_schuler_period() -> None:
    assert 2.0 * math.pi * math.sqrt(SPHERE.R / SPHERE.G) / 60.0 == pytest.approx(84.3913, abs=5e-5)


@pytest.mark.parametrize("model", [paper_model, aircraft_model])
@pytest.mark.parametrize("heading", headings)
@pytest.mark.parametrize("V", speeds)
def test_no_error_grows_faster_than_the_flight_goes(model: Any, V: float, heading: float) -> None:
    """At V = 0 the spectrum is imaginary; in motion its real part stays of the order of V/R."""
    K = math.radians(heading)
    A = model(math.pi / 3, V * math.cos(K), V * math.sin(K)).A
    assert np.abs(np.linalg.eigvals(A).real).max() < 3.0 * V / SPHERE.R


def test_mixed_senses_of_rotation_are_unstable() -> None:
    """P as minus the rotation in the tilts but plus in the velocities: Schuler turns into +-4.47 1/h."""
    mixed = paper_model(math.pi / 3, 0.0, 0.0, sphere=SPHERE_KM_H).A.copy()
    mixed[2:4, 4:7] *= -1.0
    real = np.sort(np.linalg.eigvals(mixed).real)
    schuler = math.sqrt(SPHERE_KM_H.G / SPHERE_KM_H.R)
    assert real[-1] == pytest.approx(schuler, rel=2e-3)
    assert real[0] == pytest.approx(-schuler, rel=2e-3)


# -- the nonlinear inertial system ---------------------------------------------------------------------


class Flight:
    """Level flight on the sphere, straight (a rhumb line) or circling, its ideal sensors, and an INS on them.

    Two level channels: the height is held, as the barometer holds it.
    """

    lat_0 = math.radians(50.0)
    seconds = 3600.0

    def __init__(self, V: float, heading_deg: float, turn_rate: float = 0.0) -> None:
        self.V, self.K_0, self.turn_rate = V, math.radians(heading_deg), turn_rate

    def heading(self, t: float) -> float:
        return self.K_0 + self.turn_rate * t

    def v_n(self, t: float) -> Floats:
        return np.array([self.V * math.cos(self.heading(t)), self.V * math.sin(self.heading(t)), 0.0])

    def a_n(self, t: float) -> Floats:
        return np.array([-self.turn_rate * self.v_n(t)[1], self.turn_rate * self.v_n(t)[0], 0.0])

    def lat(self, t: float) -> float:
        north = self.V * math.cos(self.K_0) * t
        if self.turn_rate:
            north = self.V * (math.sin(self.heading(t)) - math.sin(self.K_0)) / self.turn_rate
        return self.lat_0 + north / SPHERE.R

    def C_nb(self, t: float) -> Floats:
        banked: Floats = rotation_matrix(np.array([0.0, 0.0, self.heading(t)])) @ rotation_matrix(
            np.array([0.1, -0.05, 0.0])
        )
        return banked

    def sensors(self, t: float) -> tuple[Floats, Floats]:
        """Specific force balances gravity and Coriolis and gives a_n; the body turns with n and more."""
        free = navigation_rates(self.lat(t), 0.0, self.v_n(t), np.zeros(3), SPHERE)
        C_bn, yaw = self.C_nb(t).T, np.array([0.0, 0.0, self.turn_rate])
        return C_bn @ (self.a_n(t) - free.v_n), C_bn @ (free.w_in_n + yaw)

    def ins(self, x_0: Floats) -> Floats:
        """Fly the INS from initial errors x_0 (7,): its errors at the end, dy but for a constant."""
        start = [self.lat_0 + x_0[0] / SPHERE.R, x_0[1] / (SPHERE.R * math.cos(self.lat_0))]
        C_0 = rotation_matrix(x_0[4:7]) @ self.C_nb(0.0)
        y_0 = np.concatenate([start, self.v_n(0.0)[:2] + x_0[2:4], C_0.ravel()])

        def slope(t: float, y: Floats) -> Floats:
            f_b, w_b = self.sensors(t)
            C = y[4:].reshape(3, 3)
            r = navigation_rates(float(y[0]), 0.0, np.array([y[2], y[3], 0.0]), C @ f_b, SPHERE)
            C_rate = C @ _cross(w_b) - _cross(r.w_in_n) @ C
            return np.concatenate([[r.lat, r.lon], r.v_n[:2], C_rate.ravel()])

        y = solve_ivp(slope, (0.0, self.seconds), y_0, method="DOP853", rtol=1e-13, atol=1e-15).y[:, -1]
        lat = self.lat(self.seconds)
        position = [(y[0] - lat) * SPHERE.R, y[1] * SPHERE.R * math.cos(lat)]
        tilt = y[4:].reshape(3, 3) @ self.C_nb(self.seconds).T
        P = 0.5 * np.array([tilt[2, 1] - tilt[1, 2], tilt[0, 2] - tilt[2, 0], tilt[1, 0] - tilt[0, 1]])
        return np.concatenate([position, y[2:4] - self.v_n(self.seconds)[:2], P])

    def linear(self, model: Any) -> Floats:
        """The transition matrix (7, 7) of the error equations over the same flight."""

        def slope(t: float, Phi: Floats) -> Floats:
            turning = (tuple(self.a_n(t)),) if self.turn_rate else ()
            A = model(self.lat(t), *self.v_n(t)[:2].tolist(), *turning).A
            return np.asarray(A @ Phi.reshape(7, 7)).ravel()

        end = solve_ivp(
            slope, (0.0, self.seconds), np.eye(7).ravel(), method="DOP853", rtol=1e-11, atol=1e-16
        )
        return np.asarray(end.y[:, -1].reshape(7, 7))


def _cross(v: Floats) -> Floats:
    x, y, z = v
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])


@pytest.mark.parametrize(
    ("V", "heading", "turn_rate"),
    [(V, heading, 0.0) for V in speeds for heading in headings]
    + [(30.0, 0.0, 0.01), (250.0, 45.0, -0.005)],  # orbits of 3 and 50 km radius
)
def test_aircraft_is_the_jacobian_of_a_nonlinear_inertial_system(
    V: float, heading: float, turn_rate: float
) -> None:
    """An hour of flight, every initial error perturbed both ways: 1e-6 of the error scale (is 1e-8)."""
    flight = Flight(V, heading, turn_rate)
    scale = np.array([1e3, 1e3, 1.0, 1.0, 2e-4, 2e-4, 2e-4])  # comparable errors of a Schuler cycle
    Phi = flight.linear(aircraft_model)
    rng = np.random.default_rng(7)
    for _ in range(2):
        x_0 = 0.02 * scale * rng.uniform(0.5, 1.0, 7) * rng.choice([-1.0, 1.0], 7)
        nonlinear = 0.5 * (flight.ins(x_0) - flight.ins(-x_0))
        error_scale = np.abs(Phi) @ np.abs(x_0)
        assert (np.abs(nonlinear - Phi @ x_0) / error_scale).max() < 1e-6


def test_paper_is_only_approximate_at_aircraft_speed() -> None:
    """Why there are two models: at 250 m/s the paper's is per cents off, at 8 m/s per mille."""
    scale = 0.02 * np.array([1e3, 1e3, 1.0, 1.0, 2e-4, 2e-4, 2e-4])

    def discrepancy(V: float) -> float:
        flight = Flight(V, 90.0)
        Phi, Psi = flight.linear(aircraft_model), flight.linear(paper_model)
        # the paper's dVE is the rate of dy: its true velocity error is a row, not a state
        H = observation_matrix(INS_STATES, *paper_velocity(flight.lat_0, 0.0, V))
        to_true = np.eye(7)
        to_true[2:4] = H
        Psi = to_true @ Psi @ np.linalg.inv(to_true)
        return float((np.abs((Psi - Phi) @ scale) / (np.abs(Phi) @ scale)).max())

    assert discrepancy(250.0) > 0.01
    assert discrepancy(8.0) < 0.01


# -- units, composition --------------------------------------------------------------------------------


def _kalman(example: error_model.Example, Q: Floats, Z: Floats) -> Floats:
    """A plain Joseph filter, so that this file proves the model without the package's filters."""
    x, P, out = example.x0, example.P0, []
    for z in Z:
        x, P = example.A @ x, example.A @ P @ example.A.T + Q
        S = example.H @ P @ example.H.T + example.R
        K = np.linalg.solve(S, example.H @ P).T
        x = x + K @ (z - example.H @ x)
        L = np.eye(len(x)) - K @ example.H
        P = L @ P @ L.T + K @ example.R @ K.T
        out.append(x)
    return np.array(out)


@pytest.mark.parametrize("exact", [True, False])
def test_the_example_in_kilometre_hours_and_in_si_gives_the_same_estimates(exact: bool) -> None:
    km, si = paper_example("km-h", exact=exact), paper_example("SI", exact=exact)
    T, T_inv = np.diag(km_to_si := si.units), np.diag(1.0 / si.units)
    assert km.units == pytest.approx(1.0)
    for a, b in ((T @ km.A @ T_inv, si.A), (T @ km.Q @ T, si.Q), (T @ km.Q_markov @ T, si.Q_markov)):
        size = np.sqrt(np.outer(np.abs(np.diag(b)), np.abs(np.diag(b)))) + 1e-300
        assert a == pytest.approx(b, rel=1e-9, abs=float(size.max()) * 1e-12)
    np.testing.assert_allclose(km.H @ T_inv, si.H / (1e3 / 3600.0), rtol=1e-13, atol=1e-18)
    np.testing.assert_allclose(km.C / 3.6, si.C, rtol=1e-14)
    rng = np.random.default_rng(1)
    Z = 0.3 * np.cumsum(rng.normal(size=(600, 2)), axis=0) * 0.1 + rng.normal(size=(600, 2)) * 0.05
    for Q_km, Q_si in ((km.Q_markov, si.Q_markov), (_minimax(km), _minimax(si))):
        x_km, x_si = _kalman(km, Q_km, Z) * km_to_si, _kalman(si, Q_si, Z / 3.6)
        assert (np.abs(x_km - x_si) / np.abs(x_si).max(axis=0)).max() < 1e-11


def _minimax(example: error_model.Example) -> Floats:
    return np.asarray(example.Q + example.B @ np.diag(example.C**2) @ example.B.T)


def test_the_markov_current_is_the_bounded_one_at_the_equivalent_bound() -> None:
    """C^2 = 2 (a_c + V/R_c) sigma^2 dt, 0.0849 km/h: the Euler minimax filter is then the plain one."""
    C = math.sqrt(2.0 * (1.0 + 3.0) * 0.3**2 * 0.01)
    assert pytest.approx(0.0849, abs=5e-5) == C
    example = paper_example("km-h", exact=False, C=C)
    np.testing.assert_allclose(_minimax(example), example.Q_markov, rtol=1e-13)


def test_euler_magnifies_schuler_and_the_exact_step_does_not() -> None:
    """Six hours of Euler's 0.01 h multiply the amplitude by 1.94."""
    growth = [
        np.abs(np.linalg.eigvals(paper_example(exact=exact).A[:7, :7])).max() ** 600
        for exact in (True, False)
    ]
    assert growth[0] == pytest.approx(1.0, abs=1e-6)
    assert growth[1] == pytest.approx(1.94, abs=0.01)


def test_unknown_units_are_reported() -> None:
    with pytest.raises(ValueError, match="km-h or SI"):
        paper_example("miles")  # type: ignore[arg-type]


def test_the_log_with_the_paper_velocity_has_the_printed_rows() -> None:
    """(1.19) term by term, at a velocity with both components."""
    lat, K, V = 0.9, 0.7, 12.0
    vN, vE = V * math.cos(K), V * math.sin(K)
    lat_rate, lon_rate = vN / SPHERE.R, vE / (SPHERE.R * math.cos(lat))
    s, t, sK, cK = math.sin(lat), math.tan(lat), math.sin(K), math.cos(K)
    states = (*INS_STATES, "VcX", "VcY")
    along = [-lon_rate * s * sK, lat_rate * t * sK, cK, sK, 0, 0, 0, -cK, -sK]
    across = [-lon_rate * s * cK, lat_rate * t * cK, -sK, cK, 0, 0, -V, sK, -cK]
    velocity = paper_velocity(lat, vN, vE)
    np.testing.assert_allclose(
        observation_matrix(states, *relative_log(K, V, velocity)), [along, across], atol=1e-18
    )


def test_the_example_carries_the_numbers_of_section_3() -> None:
    """(1.44), (1.45) term by term on the Euler step, in km and h."""
    example = paper_example("km-h", exact=False)
    G, dt, densities = SPHERE_KM_H.G, 0.01, dict.fromkeys(example.states, 0.0)
    densities |= dict.fromkeys(("EX", "EY", "EZ"), 2 * 0.2 * 1e-5**2)
    densities |= dict.fromkeys(("GX", "GY"), 2 * 3.0 * (1e-5 * G) ** 2)
    densities |= dict.fromkeys(("AX", "AY"), 2 * 20.0 * (1e-6 * G) ** 2)
    np.testing.assert_allclose(example.Q, np.diag(list(densities.values())) * dt, rtol=1e-14)
    densities |= dict.fromkeys(("VcX", "VcY"), 2 * 4.0 * 0.3**2)
    np.testing.assert_allclose(example.Q_markov, np.diag(list(densities.values())) * dt, rtol=1e-14)
    np.testing.assert_allclose(example.A, np.eye(16) + example.A_continuous * dt, rtol=1e-14)
    np.testing.assert_array_equal(np.argwhere(example.B), [[10, 0], [11, 1]])
    np.testing.assert_allclose(example.R, 0.05**2 * np.eye(2), rtol=1e-14)
    np.testing.assert_allclose(example.C, [0.3, 0.3], rtol=1e-14)
    assert not example.P0.any() and not example.x0.any()
