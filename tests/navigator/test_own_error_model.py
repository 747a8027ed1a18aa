"""The error model of the own channel."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from companion.config import Config
from companion.nav.discretization import discretise
from companion.navigator.own_channel import OwnChannel
from companion.navigator.own_error_model import (
    GUST,
    HOVER_S,
    POSITION,
    TILT,
    USUAL,
    VELOCITY,
    Amplitudes,
    By,
    N,
    Propagator,
    Row,
    add_held,
    add_imu,
    begin,
    prior,
)


@pytest.mark.parametrize("name", ["heading", "crab", "tilt", "accelerometer_m_s2"])
def test_the_coarsest_grade_doubts_settings_that_are_too_exact(name: str) -> None:
    assert getattr(OwnChannel(Config()).settings, name) == getattr(USUAL, name)
    usual, interval = USUAL, add_imu(begin("imu", (20.0, 0.0)), 1.0, (0.0, 0.0), 0.0, 0.0)
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


@pytest.mark.parametrize(("noise", "tilt_s"), [(0.15, 30.0), (1e-6, 30.0), (1e-6, 1.0), (1e-6, 3600.0)])
def test_a_tilt_that_comes_up_moves_velocity_and_position(noise: float, tilt_s: float) -> None:
    """As by Van Loan's integral; without the two, an IMU stated as quiet had negative variances."""
    settings = Amplitudes(velocity_noise_m_s_sqrt_s=noise, tilt_s=tilt_s)
    interval = add_imu(begin("imu", (20.0, 0.0)), 0.5, (0.0, 0.0), 0.0, 0.0)
    at = np.array([POSITION.start, VELOCITY.start, TILT.start])
    Q = Propagator(settings).transition(interval)[1][0][np.ix_(at, at)]
    A = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [0.0, 0.0, -1.0 / tilt_s]])
    density = np.diag([0.0, noise**2, 2.0 * settings.tilt**2 / tilt_s])
    exact = discretise(A, density, np.zeros((3, 0)), 0.5).Q
    size = np.sqrt(np.outer(exact.diagonal(), exact.diagonal()))
    np.testing.assert_allclose(Q / size, exact / size, atol=1e-4)
    assert np.linalg.eigvalsh(Q / size)[0] > 0.0


@given(
    first=st.floats(0.01, 5.0),
    second=st.floats(0.01, 5.0),
    v=st.tuples(st.floats(-20, 20), st.floats(-20, 20)),
)
def test_a_multirotor_that_is_held_in_two_intervals_is_held_in_one(
    first: float, second: float, v: tuple[float, float]
) -> None:
    """Its errors are propagated as the difference of two nominal trajectories is."""
    propagator, interval = Propagator(Amplitudes()), begin("hover", v)
    both = first + second
    (A, Qa), (B, Qb), (C, Qc) = (
        propagator.transition(interval._replace(seconds=T)) for T in (first, second, both)
    )
    own = slice(POSITION.start, VELOCITY.stop)
    np.testing.assert_allclose((B @ A)[own, own], C[own, own], atol=1e-12)
    np.testing.assert_allclose((B @ Qa @ B.T + Qb)[:, own, own], Qc[:, own, own], atol=1e-9)
    held = add_held(add_held(interval, first), second)
    np.testing.assert_allclose((*held.moved, *held.velocity), C[own, own] @ (0.0, 0.0, *v), atol=1e-12)
    assert held.seconds == pytest.approx(both)


def test_a_multirotor_that_is_held_changes_as_any_aircraft_at_once_and_stays_slow() -> None:
    def grown(by: By, seconds: float) -> float:
        _, Q = Propagator(Amplitudes()).transition(begin(by, (0.0, 0.0))._replace(seconds=seconds))
        return float(Q[0, VELOCITY.start, VELOCITY.start])

    assert grown("hover", 0.01) == pytest.approx(grown("hold", 0.01), rel=0.01)
    assert grown("hover", 600.0) == pytest.approx(grown("hold", 0.5 * HOVER_S))


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
