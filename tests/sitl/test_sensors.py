import dataclasses
import math

import numpy as np
import pytest

from companion.nav.error_model import aircraft_model
from sitl.flight import FlightPlan, Leg, WindChange, fly_plan
from sitl.scenarios import get_scenario
from sitl.sensors import (
    DEG_H,
    GRADES,
    AirDataModel,
    GnssModel,
    error_rates,
    gauss_markov,
    interpolate_error,
    propagate,
    simulate_air_data,
    simulate_gnss,
    simulate_imu,
    simulate_inertial_error,
)


@pytest.fixture(scope="module")
def flight():
    return fly_plan(get_scenario("default").plan)


@pytest.fixture(scope="module")
def cruise():
    """Seven hours northwards at 8 m/s from latitude 2 degrees, sampled every ten seconds."""
    whole = fly_plan(FlightPlan((Leg(60, 0, 8, 0), Leg(25140, 0, 8, 0)), lat_deg=2.0))
    return whole.at(np.arange(0.0, 25200.0, 10.0))


def test_error_rates_agree_with_the_error_model():
    plan = FlightPlan(
        (Leg(5, 40, 0, 0), Leg(60, 40, 38, 0), Leg(80, 150, 36, 50)), winds=(WindChange(0, 4, 5),)
    )
    flight = fly_plan(plan)
    acceleration = np.gradient(flight.v_n, 0.02, axis=0)
    rates = error_rates(flight)
    for k in (100, 2000, 4000, 5000):
        model = aircraft_model(flight.lat[k], *flight.v_n[k, :2], tuple(acceleration[k]))
        scale = np.maximum(np.abs(model.A), 1e-12)
        # real gravity and curvature against the sphere's 9.81 m/s^2: 0.3 % of the specific force
        force_terms = [(2, 5), (2, 6), (3, 4), (3, 6)]
        for i, j in force_terms:
            assert rates[k, i, j] == pytest.approx(model.A[i, j], abs=0.02)
            rates[k, i, j] = model.A[i, j]
        assert np.abs((rates[k] - model.A) / scale).max() < 1e-6


def test_constant_gyro_bias_oscillates_with_the_schuler_period(cruise):
    drive = np.zeros((len(cruise.t), 7))
    drive[:, 5] = 0.01 * DEG_H
    states = propagate(cruise, np.zeros(7), drive)
    # spectral line by least squares, with a parabola for the slow daily oscillation
    t = cruise.t
    periods = np.arange(75.0, 95.0, 0.05) * 60.0
    left = []
    for period in periods:
        wave = 2.0 * np.pi * t / period
        basis = np.stack([np.ones_like(t), t, t**2, np.sin(wave), np.cos(wave)], axis=1)
        left.append(np.linalg.lstsq(basis, states[:, 2])[1][0])
    # 84.4 min; the vertical component of the earth's rate splits it by 1 % at a few degrees of latitude
    assert periods[np.argmin(left)] / 60.0 == pytest.approx(84.4, abs=1.0)
    assert min(left) < 1e-2 * np.sum(np.square(states[:, 2] - np.mean(states[:, 2])))
    # velocity R eps (1 - cos w t): mean R eps over the first period, before the earth has rotated far
    assert abs(np.mean(states[t < 5063.0, 2])) == pytest.approx(6371e3 * 0.01 * DEG_H, rel=0.1)


def test_accelerometer_bias_cancelled_by_tilt_has_no_effect(cruise):
    bias = 1e-3
    drive = np.zeros((len(cruise.t), 7))
    drive[:, 2] = bias
    level = np.zeros(7)
    level[5] = bias / 9.78  # initial condition of simulate_inertial_error: fD PY + AX = 0
    free = propagate(cruise, np.zeros(7), drive)
    aided = propagate(cruise, level, drive)
    quarter = cruise.t < 1200.0
    assert np.abs(aided[quarter, 0]).max() < 0.05 * np.abs(free[quarter, 0]).max()


def test_result_does_not_depend_on_the_step(flight):
    fine, coarse = flight.at(np.arange(0, 1200, 0.25)), flight.at(np.arange(0, 1200, 0.5))
    start = np.array([0, 0, 0.1, -0.1, 1e-4, -1e-4, 1e-3])
    ends = [propagate(f, start, np.zeros((len(f.t), 7)))[-1 if f is coarse else -2] for f in (fine, coarse)]
    assert ends[0][:2] == pytest.approx(ends[1][:2], abs=0.5)


def test_grades_are_ordered_and_navigation_grade_is_a_mile_per_hour(flight):
    ends = {
        name: [
            simulate_inertial_error(flight, grade, np.random.default_rng(s)).x_n[-1, :2] for s in range(15)
        ]
        for name, grade in GRADES.items()
    }
    rms = {name: np.sqrt(np.mean(np.sum(np.square(e), axis=1))) for name, e in ends.items()}
    hours = flight.t[-1] / 3600.0
    assert 0.5 < rms["navigation"] / 1852.0 / hours < 2.0
    assert 3.0 < rms["tactical"] / rms["navigation"] < 30.0
    assert 3.0 < rms["mems"] / rms["tactical"] < 30.0


def test_velocity_error_is_the_derivative_of_the_position_error(flight):
    error = simulate_inertial_error(flight, GRADES["tactical"], np.random.default_rng(3))
    assert np.gradient(error.x_n[:, 0], 0.5)[1:-1] == pytest.approx(error.v_n[1:-1, 0], abs=0.02)
    at = interpolate_error(error, np.array([10.25]))
    assert at.x_n[0] == pytest.approx((error.x_n[20] + error.x_n[21]) / 2.0)


def test_gauss_markov_has_unit_variance_and_correlation_time():
    x = gauss_markov(4_000, 1.0, 20.0, np.random.default_rng(1), columns=100)
    assert np.std(x) == pytest.approx(1.0, abs=0.03)
    assert np.mean(x[20:] * x[:-20]) == pytest.approx(math.exp(-1.0), abs=0.04)


def test_gnss_errors_match_stated_sigmas_and_outages_have_no_fix(flight):
    model = GnssModel()
    at = flight.at(np.arange(0.0, 2520.0, 0.2))
    north, east, white = [], [], []
    for seed in range(20):
        fixes = simulate_gnss(at, model, ((100.0, 160.0),), np.random.default_rng(seed))
        n = (fixes.lat - at.lat) * 6.39e6
        north.append(n)
        east.append((fixes.lon - at.lon) * 6.39e6 * np.cos(at.lat))
        white.append(np.diff(n))
    assert np.std(north) == pytest.approx(model.sigma_horizontal, rel=0.1)
    assert np.std(east) == pytest.approx(model.sigma_horizontal, rel=0.1)
    assert np.std(white) == pytest.approx(
        math.sqrt(
            2 * model.white_m**2 + 2 * model.correlated_m**2 * (1 - math.exp(-0.2 / model.correlation_s))
        ),
        rel=0.05,
    )
    assert not fixes.usable[(at.t >= 100.0) & (at.t < 160.0)].any()
    assert fixes.usable.sum() == len(at.t) - 300


def test_airspeed_has_turbulence_noise_and_one_scale_factor(flight):
    at = flight.at(np.arange(200.0, 2500.0, 0.1))
    model = AirDataModel(scale=0.0)
    air = simulate_air_data(at, model, np.random.default_rng(2))
    assert np.std(air.true_airspeed - at.airspeed) == pytest.approx(
        math.hypot(model.turbulence_m_s, model.noise_m_s), rel=0.1
    )
    wrong = simulate_air_data(at, dataclasses.replace(model, scale=0.05), np.random.default_rng(2))
    ratio = wrong.true_airspeed / air.true_airspeed
    assert np.std(ratio) < 0.01 < abs(np.mean(ratio) - 1.0)
    # ratio of equivalent to true airspeed at 1000 m of the standard atmosphere: 0.9529
    high = flight.at(at.t[at.alt > 1000.0])
    air = simulate_air_data(
        high, AirDataModel(pressure_noise_pa=0.0, pressure_wander_pa=0.0), np.random.default_rng(2)
    )
    nearest = np.argmin(np.abs(high.alt - 1000.0))
    expected = math.sqrt(0.9075)  # density ratio at 1000 m, ICAO table
    assert air.equivalent_airspeed[nearest] / air.true_airspeed[nearest] == pytest.approx(expected, abs=2e-3)


def test_imu_noise_matches_the_grade(flight):
    at = flight.at(np.arange(100.0, 1100.0, 0.02))
    f_b, w_b = simulate_imu(at, GRADES["tactical"], np.random.default_rng(4))
    arw = math.radians(0.07) / 60.0 / math.sqrt(0.02)
    assert np.std(w_b - at.w_b, axis=0) == pytest.approx(arw, rel=0.03)
    assert np.std(f_b - at.f_b, axis=0) == pytest.approx(100e-6 * 9.81 / math.sqrt(0.02), rel=0.03)
