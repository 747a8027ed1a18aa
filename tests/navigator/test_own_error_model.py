"""The error model of the own channel, on the ground and in flight."""

from __future__ import annotations

import math

import numpy as np
import pytest

from companion.navigator.own_error_model import (
    CLEAR_M,
    GUST,
    SHEAR_M_S,
    SHEAR_TOP_M,
    Amplitudes,
    Ground,
    N,
    Propagator,
    Row,
    add_imu,
    begin,
    ground_phase,
    prior,
    wind_shear,
)


def phases(*samples: tuple[float, float, float | None]) -> list[bool]:
    """Whether it flies after each (airspeed, ground speed, height), one second apart."""
    g, found = Ground(), []
    for t, (airspeed, speed, height) in enumerate(samples):
        g = ground_phase(g, float(t), airspeed, speed, height)
        found.append(g.flying)
    return found


def test_in_the_ground_roll_airspeed_is_not_used_until_the_wheels_are_off_the_ground() -> None:
    roll = [(0.5, 0.0, 100.0)] * 3 + [(15.0, 14.0, 100.5), (25.0, 24.0, 100.0 + CLEAR_M + 0.1)]
    assert phases(*roll) == [False, False, False, False, True]


def test_below_the_parked_height_it_flies_too() -> None:
    """Launched from a hill its airspeed was never used."""
    assert phases((0.5, 0.0, 100.0), (25.0, 24.0, 100.0 - CLEAR_M - 0.1))[-1]


def test_the_wind_is_as_open_after_many_small_steps_of_height_as_after_one() -> None:
    def variance(step: float) -> float:
        g, total = Ground(False, None, 100.0), 0.0
        for k in range(1, round(300.0 / step) + 1):
            after = ground_phase(g, 0.1 * k, 25.0, 25.0, 100.0 + step * k)
            total, g = total + wind_shear(g, after), after
        return total

    assert variance(1.0) == pytest.approx(variance(300.0), rel=1e-12)
    assert variance(1.0) == pytest.approx(SHEAR_M_S**2 * math.log(SHEAR_TOP_M / CLEAR_M))
    level = Ground(True, None, 100.0, 80.0)
    assert wind_shear(level, ground_phase(level, 1.0, 25.0, 25.0, 170.0)) == 0.0  # up and down in cruise


def test_without_a_pressure_it_flies_once_it_moves() -> None:
    """The flight of UMN has none: its airspeed was never used."""
    assert phases((0.5, 0.0, None), (3.0, 3.0, None), (15.0, 14.0, None)) == [False, False, True]


def test_a_pitot_behind_a_running_propeller_is_no_flight() -> None:
    """It taught a wind of 20 m/s; the airspeed was false after lift-off, and later GNSS."""
    assert phases((21.0, 0.1, None), (21.0, 1.0, None), (18.0, 9.0, None)) == [False, False, True]


@pytest.mark.parametrize("seconds", [9, 11])
def test_a_flight_ends_after_ten_slow_seconds(seconds: int) -> None:
    assert phases((20.0, 20.0, None), *[(1.0, 1.0, None)] * (seconds + 1))[-1] == (seconds < 10)


@pytest.mark.parametrize("name", ["heading", "crab", "tilt", "accelerometer_m_s2"])
def test_the_coarsest_grade_doubts_settings_that_are_too_exact(name: str) -> None:
    usual, interval = Amplitudes(), add_imu(begin("imu", (20.0, 0.0)), 1.0, (0.0, 0.0), 0.0, 0.0)
    exact = usual._replace(**{name: getattr(usual, name) / 20.0})
    found = [(prior(s), Propagator(s).transition(interval)[1]) for s in (usual, exact)]
    for by_default, stated in zip(*found, strict=True):
        np.testing.assert_array_equal(stated[-1], by_default[-1])
        assert (np.diagonal(stated[0]) <= np.diagonal(by_default[0])).all()
        assert stated[0].trace() < by_default[0].trace()


def test_two_intervals_beside_the_imu_are_one() -> None:
    """The gust is a Gauss-Markov process: exactly, however long the interval."""
    propagator, at = Propagator(Amplitudes()), GUST.start

    def over(seconds: float) -> tuple[float, float]:
        Phi, Q = propagator.transition(add_imu(begin("imu", (20.0, 0.0)), seconds, (0.0, 0.0), 0.0, 0.0))
        return float(Phi[at, at]), float(Q[0, at, at])

    (first, q1), (second, q2), (whole, q) = over(0.2), over(0.6), over(0.8)
    assert first * second == pytest.approx(whole)
    assert second * second * q1 + q2 == pytest.approx(q)


def test_a_step_of_the_wind_shows_in_the_first_airspeed_after_it() -> None:
    """Beside the IMU; as white noise of the same strength the gusts would hide 3.4 m/s."""
    propagator = Propagator(Amplitudes())
    P, V, spread = prior(Amplitudes())[0], (20.0, 0.0), []
    P[2:4, 2:4] = 0.1**2 * np.eye(2)
    for _ in range(120):
        interval = begin("imu", V)
        for _ in range(10):
            interval = add_imu(interval, 0.05, (0.0, 0.0), 0.0, 0.0)
        Phi, Q = propagator.transition(interval)
        P = Phi @ P @ Phi.T + Q[0]
        for row in (propagator.airspeed_row(V, V), gnss_velocity(N)):
            S = row.H @ P @ row.H.T + row.R
            K = np.linalg.solve(S, row.H @ P).T
            P = P - K @ S @ K.T
            spread.append(S[0, 0])
    step = 5.0
    assert step**2 / spread[-2] > 8.0


def gnss_velocity(n: int) -> Row:
    H = np.zeros((2, n))
    H[0, 2] = H[1, 3] = 1.0
    return Row(np.zeros(2), H, 0.1**2 * np.eye(2))
