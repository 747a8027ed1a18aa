"""Kalman filter: reference values, agreement with dense least squares, consistency, validation."""

import json
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.linalg import block_diag
from scipy.stats import chi2

from companion.estimate import kalman, restrictive
from companion.estimate.linear_system import find_covariance_flaw
from companion.nav.error_model import paper_example
from tests.estimate import full_horizon

REFERENCE = json.loads((Path(__file__).parents[1] / "data/restrictive.json").read_text())
SMALL = REFERENCE["small"]


def problem(case):
    return [np.array(case[k], float) for k in ("A", "B", "Q", "H", "R", "C", "x0", "P0", "Z")]


def run_filter(x, P, Z, A, Q, H, R):
    X = [x]
    for z in Z:
        now = kalman.step(x, P, z, A, Q, H, R)
        x, P = now.x, now.P
        X.append(x)
    return np.array(X), P


def random_problem(rng, n=4, p=2, m=1, T=15):
    A = 0.9 * np.linalg.qr(rng.normal(size=(n, n)))[0]
    L = rng.normal(size=(n, n))
    B, H = rng.normal(size=(n, m)), rng.normal(size=(p, n))
    return A, B, 0.1 * L @ L.T + 0.1 * np.eye(n), H, 0.3 * np.eye(p), rng.normal(size=(T, p))


@pytest.mark.parametrize("case", SMALL.values(), ids=SMALL)
def test_reference_without_inputs_and_minimax(case):
    A, B, Q, H, R, C, x0, P0, Z = problem(case)
    for name, noise in (("kf_noU", Q), ("minimax_kf", kalman.minimax_noise(B, C, Q))):
        X, P = run_filter(x0, P0, Z, A, noise, H, R)
        np.testing.assert_allclose(X, case[name]["X"], atol=1e-12)
        np.testing.assert_allclose(P, case[name]["P_last"], atol=1e-12)


def test_reference_of_sixteen_states():
    s = REFERENCE["sixteen_states_euler"]
    e = paper_example(exact=False)
    for name, Q in (("minimax_kf", kalman.minimax_noise(e.B, e.C, e.Q)), ("plain_kf", e.Q_markov)):
        X, P = run_filter(e.x0, e.P0, s["Z"], e.A, Q, e.H, e.R)
        np.testing.assert_allclose(X[s["steps"]], s[name], atol=1e-9)
        if name == "minimax_kf":
            np.testing.assert_allclose(np.diag(P), s["minimax_P60_diag"], atol=1e-9)


def test_minimax_is_the_markov_filter_for_one_bound():
    e = paper_example(exact=False)
    C = np.sqrt(2 * (1 + 30 / 10) * 0.3**2 * 0.01) * np.ones(2)
    assert C[0] == pytest.approx(0.0849, abs=1e-4)
    np.testing.assert_allclose(kalman.minimax_noise(e.B, C, e.Q), e.Q_markov, atol=1e-15)


@settings(max_examples=20)
@given(st.integers(0, 2**32 - 1))
def test_all_filters_are_dense_least_squares(seed):
    """Kalman filter, R1 with zero bounds, full horizon and dense least squares agree."""
    rng = np.random.default_rng(seed)
    A, B, Q, H, R, Z = random_problem(rng)
    n, T = len(A), len(Z)
    x0, P0 = rng.normal(size=n), np.eye(n)
    # unknowns X(0..T); rows: X0, W, N, each whitened
    dynamics = np.zeros((n * (T + 1), n * (T + 1)))
    dynamics[: n * (T + 1), : n * (T + 1)] = np.eye(n * (T + 1))
    for t in range(T):
        dynamics[n * (t + 1) : n * (t + 2), n * t : n * (t + 1)] = -A
    measurements = np.hstack([np.zeros((len(R) * T, n)), block_diag(*[H] * T)])
    weight = np.linalg.inv(np.linalg.cholesky(block_diag(P0, *[Q] * T, *[R] * T)))
    rows = weight @ np.vstack([dynamics, measurements])
    right = weight @ np.concatenate([x0, np.zeros(n * T), Z.ravel()])
    dense = np.linalg.lstsq(rows, right)[0].reshape(T + 1, n)

    X, P = run_filter(x0, P0, Z, A, Q, H, R)
    np.testing.assert_allclose(X[-1], dense[-1], atol=1e-10)
    none = np.zeros(1)
    record = full_horizon.solve(x0, P0, Z, A, B, Q, H, R, none)
    np.testing.assert_allclose(record.x, dense, atol=1e-10)
    np.testing.assert_allclose(record.P, P, atol=1e-10)
    x, P1 = x0, P0
    for t, z in enumerate(Z):
        x, P1, *_ = restrictive.step(x, P1, z, A, B, Q, H, R, none)
        np.testing.assert_allclose(x, X[t + 1], atol=1e-10)


def test_joseph_keeps_covariance_for_a_wrong_gain():
    rng = np.random.default_rng(0)
    e = paper_example()
    P = e.Q + 1e-3 * kalman.minimax_noise(e.B, e.C, e.Q)
    K = rng.normal(size=(16, 2))
    wrong = kalman.joseph(P, K, e.H, e.R)
    assert (wrong == wrong.T).all()
    best = kalman.joseph(P, kalman.gain(P, e.H, e.R).K, e.H, e.R)
    assert np.linalg.eigvalsh(wrong - best)[0] > -1e-9 * np.abs(wrong).max()


def test_batch_equals_one_by_one():
    rng = np.random.default_rng(1)
    A, _, Q, H, R, Z = random_problem(rng, T=7)
    x = rng.normal(size=(7, 4))
    shared = kalman.step(x, Q, Z, A, Q, H, R)
    own = kalman.step(x, np.tile(Q, (7, 1, 1)), Z, A, Q, H, R)
    for i in range(7):
        alone = kalman.step(x[i], Q, Z[i], A, Q, H, R)
        np.testing.assert_allclose(shared.x[i], alone.x, atol=1e-13)
        np.testing.assert_allclose(own.P[i], alone.P, atol=1e-13)


def test_filter_with_the_true_model_is_consistent():
    """NIS and NEES of a filter with the true model stay within their chi-square limits."""
    rng = np.random.default_rng(2)
    A, _, Q, H, R, _ = random_problem(rng)
    runs, n, p = 400, 4, 2
    x = np.zeros((runs, n))
    truth = rng.multivariate_normal(np.zeros(n), np.eye(n), runs)
    P = np.eye(n)
    for _ in range(20):
        truth = truth @ A.T + rng.multivariate_normal(np.zeros(n), Q, runs)
        z = truth @ H.T + rng.multivariate_normal(np.zeros(p), R, runs)
        before = kalman.predict(x, P, A, Q)
        nis = kalman.nees(z - before.x @ H.T, H @ before.P @ H.T + R)
        x, P = kalman.update(*before, z, H, R)
    for value, dof in ((nis, p), (kalman.nees(x - truth, P), n)):
        low, high = chi2.ppf((0.5e-3, 1.0 - 0.5e-3), dof * runs) / runs
        assert low < value.mean() < high
    assert (nis > kalman.nis_gate(p)).mean() < 0.01


def test_nees_leaves_out_directions_of_zero_variance():
    P = np.diag([1e6, 1e-12, 0.0])
    assert kalman.nees(np.array([1e3, 1e-6, 0.0]), P) == pytest.approx(2.0)


def test_gate_is_chi_square():
    assert kalman.nis_gate(2, 0.05) == pytest.approx(5.991, abs=1e-3)


@pytest.mark.parametrize(
    ("P", "message"),
    [
        (np.diag([1.0, -1.0]), "variance -1"),
        (np.array([[1.0, 2.0], [2.0, 1.0]]), "semidefinite"),
        (np.array([[1.0, 0.5], [0.0, 1.0]]), "symmetric"),
        (np.diag([1.0, np.nan]), "finite"),
        (np.eye(3), "shape"),
    ],
)
def test_the_flaw_of_a_covariance_is_named(P, message):
    assert message in find_covariance_flaw("P0", P, 2)


def test_exact_alignment_is_a_covariance():
    assert find_covariance_flaw("P0", np.zeros((2, 2)), 2) is None
