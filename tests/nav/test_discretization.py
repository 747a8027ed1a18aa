"""Discretization: Van Loan against the integral, Euler as its first order."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import quad_vec
from scipy.linalg import expm

from companion.nav.discretization import discretise, euler
from companion.units import Floats


def system(seed: int, n: int = 5, m: int = 2) -> tuple[Floats, Floats, Floats]:
    rng = np.random.default_rng(seed)
    G = rng.normal(size=(n, n - 1))
    return rng.normal(size=(n, n)), G @ G.T, rng.normal(size=(n, m))


@given(st.integers(0, 10**6), st.floats(1e-3, 1.5))
@settings(max_examples=30)
def test_van_loan_is_the_integral(seed: int, dt: float) -> None:
    A, Q, B = system(seed)
    step = discretise(A, Q, B, dt)
    Q_d, _ = quad_vec(lambda s: expm(A * s) @ Q @ expm(A * s).T, 0.0, dt, epsrel=1e-12, epsabs=1e-13)
    B_d, _ = quad_vec(lambda s: expm(A * s) @ B, 0.0, dt, epsrel=1e-12, epsabs=1e-13)
    np.testing.assert_allclose(step.A, expm(A * dt), rtol=1e-11, atol=1e-11)
    np.testing.assert_allclose(step.Q, Q_d, rtol=1e-9, atol=1e-10 * np.abs(Q_d).max())
    np.testing.assert_allclose(step.B * dt, B_d, rtol=1e-9, atol=1e-10 * np.abs(B_d).max())


@given(st.integers(0, 10**6))
@settings(max_examples=20)
def test_two_half_steps_are_one(seed: int) -> None:
    A, Q, B = system(seed)
    half, whole = discretise(A, Q, B, 0.2), discretise(A, Q, B, 0.4)
    np.testing.assert_allclose(half.A @ half.A, whole.A, rtol=1e-10, atol=1e-11)
    np.testing.assert_allclose(half.A @ half.Q @ half.A.T + half.Q, whole.Q, rtol=1e-10, atol=1e-10)
    np.testing.assert_allclose(0.5 * (half.A @ half.B + half.B), whole.B, rtol=1e-10, atol=1e-10)


def test_a_markov_process_keeps_its_variance() -> None:
    a, sigma = 0.7, 3.0
    step = discretise(np.array([[-a]]), np.array([[2 * a * sigma**2]]), np.zeros((1, 0)), 0.4)
    assert step.A[0, 0] ** 2 * sigma**2 + step.Q[0, 0] == pytest.approx(sigma**2, rel=1e-13)
    assert step.B.shape == (1, 0)


def test_euler_is_the_first_order_of_the_exact_step() -> None:
    A, Q, B = system(3)
    errors = []
    for dt in (1e-3, 5e-4):
        exact, first = discretise(A, Q, B, dt), euler(A, Q, B, dt)
        errors.append([np.abs(x - y).max() for x, y in zip(exact, first, strict=True)])
    assert np.array(errors[0]) / np.array(errors[1]) == pytest.approx([4.0, 4.0, 2.0], rel=0.05)


@pytest.mark.parametrize("step", [discretise, euler])
def test_wrong_shapes_are_rejected(step: type) -> None:
    with pytest.raises(ValueError, match="do not fit"):
        step(np.eye(3), np.eye(2), np.zeros((3, 0)), 1.0)
    with pytest.raises(ValueError, match="positive step"):
        step(np.eye(3), np.eye(3), np.zeros((3, 0)), 0.0)
