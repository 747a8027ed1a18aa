import math

import numpy as np
import pytest

from companion.nav import earth
from companion.nav.geometry import Geodetic, separation
from sitl.flight import (
    CLIMB_RATE,
    FlightPlan,
    Leg,
    WindChange,
    fly_plan,
    gravity,
    radii,
    rotation,
    smooth_step,
)
from sitl.scenarios import get_scenario
from tests.nav.strapdown import InertialState, mechanise

PLAN = FlightPlan(
    (
        Leg(5, 40, 0, 0),
        Leg(40, 40, 38, 0),
        Leg(80, 120, 36, 100),
        Leg(80, 350, 40, 60),
    ),
    winds=(WindChange(0, 4, 5), WindChange(120, -3, 8)),
)


@pytest.fixture(scope="module")
def flight():
    return fly_plan(PLAN)


def test_integrated_imu_reproduces_the_flight(flight):
    # mechanise() takes means over a step: Simpson's rule
    state = InertialState(
        flight.lat[0], flight.lon[0], flight.alt[0], flight.v_n[0], rotation(flight.attitude[:1])[0]
    )
    for k in range(0, len(flight.t) - 2, 2):
        f_b = (flight.f_b[k] + 4.0 * flight.f_b[k + 1] + flight.f_b[k + 2]) / 6.0
        w_b = (flight.w_b[k] + 4.0 * flight.w_b[k + 1] + flight.w_b[k + 2]) / 6.0
        state = mechanise(state, f_b, w_b, 0.04)
    end = len(flight.t) - 1 - (len(flight.t) - 1) % 2
    true = Geodetic(flight.lat[end], flight.lon[end], flight.alt[end])
    away = separation(Geodetic(state.lat, state.lon, state.alt), true)
    assert np.linalg.norm(away) < 0.3  # m after 205 s of turns and climbs
    assert np.abs(state.v_n - flight.v_n[end]).max() < 5e-3
    assert np.abs(state.C_nb - rotation(flight.attitude[end : end + 1])[0]).max() < 1e-5


def test_turns_are_coordinated(flight):
    assert np.abs(flight.f_b[:, 1]).max() < 1e-9
    # bank of a coordinated turn in still air: tan(roll) = V psi'/g
    still = fly_plan(FlightPlan((Leg(5, 0, 0, 0), Leg(40, 0, 38, 0), Leg(80, 120, 38, 0))))
    turn_rate = np.gradient(still.attitude[:, 2], 0.02)
    middle = (still.t > 60.0) & (still.t < 80.0)
    bank = np.arctan(38.0 * turn_rate[middle] / 9.82)
    assert still.attitude[middle, 0] == pytest.approx(bank, abs=1e-3)
    assert 10.0 < np.degrees(still.attitude[:, 0].max()) < 20.0


def test_wind_is_the_difference_of_ground_and_air_velocity(flight):
    forward = rotation(flight.attitude)[:, :, 0]
    aloft = flight.t > 70.0
    air_n = flight.v_n - flight.wind_n
    assert air_n[aloft] == pytest.approx((flight.airspeed[:, None] * forward)[aloft], abs=1e-9)


def test_position_is_the_integral_of_velocity(flight):
    R_N, R_E = radii(flight.lat)
    north = np.gradient(flight.lat, 0.02) * (R_N + flight.alt)
    east = np.gradient(flight.lon, 0.02) * (R_E + flight.alt) * np.cos(flight.lat)
    assert np.stack([north, east], axis=1)[1:-1] == pytest.approx(flight.v_n[1:-1, :2], abs=1e-3)
    assert np.gradient(flight.alt, 0.02)[1:-1] == pytest.approx(-flight.v_n[1:-1, 2], abs=1e-3)
    assert np.abs(flight.v_n[:, 2]).max() <= CLIMB_RATE + 1e-6


def test_interpolation_is_linear_and_headings_wrap(flight):
    t = np.array([0.0, 61.237, 100.011, 205.0])
    at = flight.at(t)
    assert at.lat == pytest.approx(np.interp(t, flight.t, flight.lat), abs=1e-15)
    assert np.all((at.attitude[:, 2] >= 0.0) & (at.attitude[:, 2] < 2 * np.pi))
    exact = flight.at(flight.t[[0, 17, -1]])
    assert exact.attitude == pytest.approx(flight.attitude[[0, 17, -1]], abs=1e-12)


def test_radii_on_arrays_are_those_of_nav_earth():
    lats = np.radians([0.0, 30.0, 59.3, -75.0])
    assert np.stack(radii(lats), axis=1) == pytest.approx(
        np.array([tuple(earth.radii(lat)) for lat in lats]), rel=1e-14
    )


@pytest.mark.parametrize(
    ("lat_deg", "alt", "published"),
    [
        (0.0, 0.0, 9.7803253359),
        (90.0, 0.0, 9.8321849378),
        (-90.0, 0.0, 9.8321849378),
        (45.0, 0.0, 9.8061977694),  # Somigliana with k = 0.00193185265241, TR8350.2 (4-1)
    ],
)
def test_normal_gravity(lat_deg: float, alt: float, published: float) -> None:
    assert gravity(np.radians(lat_deg), alt) == pytest.approx(published, abs=1e-7)


@pytest.mark.parametrize("lat_deg", [0.0, 30.0, 60.0, 90.0])
def test_gravity_falls_with_height_as_the_exact_field_of_the_ellipsoid(lat_deg: float) -> None:
    assert gravity(np.radians(lat_deg), 10e3) == pytest.approx(_exact_gravity(lat_deg, 10e3), abs=1e-6)


def _exact_gravity(lat_deg: float, alt: float) -> float:
    """The closed field of a rotating equipotential ellipsoid (Heiskanen and Moritz, Physical Geodesy 2-7)."""
    lat = math.radians(lat_deg)
    R_E = earth.radii(lat).R_E
    x, z = (R_E + alt) * math.cos(lat), ((1 - earth.E2) * R_E + alt) * math.sin(lat)
    E = math.sqrt(earth.A**2 - earth.B**2)

    def q_of(u: float) -> float:
        return 0.5 * ((1 + 3 * u**2 / E**2) * math.atan(E / u) - 3 * u / E)

    def potential(x: float, z: float) -> float:
        d = x * x + z * z - E * E
        u = math.sqrt(0.5 * d * (1 + math.sqrt(1 + 4 * E * E * z * z / (d * d))))
        sin2_beta = (z / u) ** 2
        rotation = earth.OMEGA**2
        return (
            earth.GM / E * math.atan(E / u)
            + 0.5 * rotation * earth.A**2 * q_of(u) / q_of(earth.B) * (sin2_beta - 1 / 3)
            + 0.5 * rotation * x * x
        )

    h = 200.0  # fourth-order differences, so that neither rounding nor truncation reaches 1e-7 m/s^2

    def slope(f: object) -> float:
        assert callable(f)
        return float(8 * (f(h) - f(-h)) - (f(2 * h) - f(-2 * h))) / (12 * h)

    g_x = slope(lambda d: potential(x + d, z))
    g_z = slope(lambda d: potential(x, z + d))
    return math.hypot(g_x, g_z)


def test_step_is_smooth_and_monotone():
    y = smooth_step(np.linspace(-1.0, 3.0, 401), 0.0, 2.0)
    assert (y[0], y[-1]) == (0.0, 1.0)
    assert np.all(np.diff(y) >= 0.0)
    assert np.diff(y).max() * 100.0 == pytest.approx(2.1875 / 2.0, rel=1e-3)


def test_default_flight_duration_and_speed_range():
    flight = fly_plan(get_scenario("default").plan)
    assert flight.t[-1] >= 40 * 60
    cruise = flight.airspeed[flight.t > 120.0]
    assert cruise.min() >= 30.0 and cruise.max() <= 45.0
    origin = Geodetic(flight.lat[0], flight.lon[0], 0.0)
    away = [
        np.linalg.norm(separation(Geodetic(a, b, 0.0), origin))
        for a, b in zip(flight.lat[::500], flight.lon[::500])
    ]
    assert 60e3 < max(away) < 100e3


@pytest.mark.parametrize(
    ("legs", "message"),
    [
        ((), "no legs"),
        ((Leg(0, 0, 30, 0),), "duration"),
        ((Leg(10, 0, 0, 0), Leg(10, 180, 0, 0)), "too short"),
    ],
)
def test_invalid_plans_are_rejected(legs, message):
    with pytest.raises(ValueError, match=message):
        fly_plan(FlightPlan(legs))
