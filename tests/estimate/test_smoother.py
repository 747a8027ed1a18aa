"""Smoother: two algorithms for one trajectory, reference values, consistency of the errors."""

from __future__ import annotations

import json
import math
import pathlib
import tracemalloc
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from companion.estimate import smoother, two_point_bvp
from companion.estimate.linear_system import LinearSystem
from companion.nav.discretization import discretise
from companion.nav.disturbances import accelerometer, gyro_drift
from companion.nav.error_model import aircraft_model

DATA = json.loads((pathlib.Path(__file__).parents[1] / "data/map_and_order.json").read_text())["two_state"]
AGREE = 1e-9


def example() -> tuple[Any, ...]:
    N = len(DATA["z"])
    return (
        [DATA["Phi"]] * N,
        [DATA["Gamma"]] * N,
        [DATA["D_theta"]] * N,
        [DATA["H"]] * N,
        [DATA["sigma2"]] * N,
        DATA["z"],
        DATA["m_x0"],
        DATA["B_x0"],
    )


@pytest.mark.parametrize("solve", [smoother.rts, smoother.two_point])
def test_reference_values(solve: Any) -> None:
    found = solve(LinearSystem.of(*example()))
    np.testing.assert_allclose(found.x, DATA["x_smooth"], atol=1e-13)
    np.testing.assert_allclose(found.s, DATA["s"], atol=1e-13)
    np.testing.assert_allclose(found.P[0], DATA["P_smooth_0"], atol=1e-14)
    np.testing.assert_allclose(found.x[0], [0.141426184774452, 0.975138510178567], atol=1e-14)
    forward = smoother.forward_filter(LinearSystem.of(*example()))
    np.testing.assert_allclose(forward.x, DATA["x_filter"], atol=1e-13)
    np.testing.assert_allclose(found.x[-1], forward.x[-1], atol=1e-13)
    np.testing.assert_allclose(found.P[-1], DATA["P_filter_last"], atol=1e-14)


def test_the_equations_of_the_boundary_problem_hold() -> None:
    Phi, Gamma, D, H, _, z, m, B = (np.array(a) for a in example())
    found = smoother.two_point(LinearSystem.of(*example()))
    x, s = found.x, [*found.s, np.zeros(2)]
    np.testing.assert_allclose(x[0], B @ Phi[0].T @ s[0] + m, atol=1e-14)
    for i in range(len(z)):
        theta = D[i] @ Gamma[i].T @ s[i]
        np.testing.assert_allclose(x[i + 1], Phi[i] @ x[i] + Gamma[i] @ theta, atol=1e-13)
        seen = H[i].T @ (z[i] - H[i] @ x[i + 1]) / DATA["sigma2"]
        np.testing.assert_allclose(s[i], (Phi[i].T if i < 9 else np.eye(2)) @ s[i + 1] + seen, atol=1e-13)


def random_problem(seed: int, n: int, N: int, singular: bool) -> tuple[Any, ...]:
    """Steps of all kinds: disturbances and measurements of several dimensions, none at some epochs."""
    rng = np.random.default_rng(seed)

    def covariance(k: int, rank: int) -> Any:
        root = rng.standard_normal((k, rank))
        return root @ root.T

    rank = (lambda k: int(rng.integers(0, k + 1))) if singular else (lambda k: k + 2)
    Phi, Gamma, D, H, R, z = [], [], [], [], [], []
    for _ in range(N):
        q, p = int(rng.integers(1, n + 1)), int(rng.integers(0, 3))
        Phi.append(np.linalg.qr(rng.standard_normal((n, n)))[0] * rng.uniform(0.5, 1.05))
        Gamma.append(rng.standard_normal((n, q)))
        D.append(covariance(q, rank(q)))
        H.append(rng.standard_normal((p, n)) if p else None)
        R.append(0.1 * np.eye(p) + covariance(p, p) if p else None)
        z.append(rng.standard_normal(p) if p else None)
    return Phi, Gamma, D, H, R, z, rng.standard_normal(n), covariance(n, rank(n))


def conditioned(problem: tuple[Any, ...]) -> tuple[Any, Any]:
    """Dense conditioning: everything is linear in (x_0, theta), which are conditioned on all of z."""
    Phi, Gamma, D, H, R, z, m, B = problem
    n, N = len(m), len(z)
    starts = np.cumsum([n, *(len(d) for d in D)])
    prior = np.zeros((starts[-1], starts[-1]))
    prior[:n, :n] = B
    maps = [np.eye(n, starts[-1])]
    for i in range(N):
        part = slice(starts[i], starts[i + 1])
        prior[part, part] = D[i]
        maps.append(Phi[i] @ maps[-1])
        maps[-1][:, part] += Gamma[i]
    mean = np.concatenate((m, np.zeros(starts[-1] - n)))
    seen = [i for i in range(N) if z[i] is not None]
    if seen:
        A = np.vstack([H[i] @ maps[i + 1] for i in seen])
        noise = np.zeros((len(A), len(A)))
        at = 0
        for i in seen:
            k = len(z[i])
            noise[at : at + k, at : at + k] = R[i]
            at += k
        S = A @ prior @ A.T + noise
        gain = np.linalg.solve(S, A @ prior).T
        mean = mean + gain @ (np.concatenate([z[i] for i in seen]) - A @ mean)
        prior = prior - gain @ S @ gain.T
    x = np.array([M @ mean for M in maps])
    P = np.array([M @ prior @ M.T for M in maps])
    return x, P


@settings(max_examples=60)
@given(st.integers(0, 10**6), st.integers(1, 5), st.integers(1, 12), st.booleans())
def test_all_algorithms_agree(seed: int, n: int, N: int, singular: bool) -> None:
    problem = random_problem(seed, n, N, singular)
    system = LinearSystem.of(*problem)
    x, P = conditioned(problem)
    ways = [smoother.rts(system), smoother.two_point(system)]
    for found in ways:
        np.testing.assert_allclose(found.x, x, rtol=AGREE, atol=AGREE)
        np.testing.assert_allclose(found.P, P, rtol=AGREE, atol=AGREE)
        np.testing.assert_allclose(found.s, ways[0].s, rtol=AGREE, atol=AGREE * (1 + abs(ways[0].s).max()))


@settings(max_examples=30)
@given(st.integers(0, 10**6), st.integers(1, 4), st.integers(2, 10))
def test_rts_equals_the_recursion_of_rauch_tung_and_striebel(seed: int, n: int, N: int) -> None:
    problem = random_problem(seed, n, N, singular=False)
    (Phi, Gamma, D), system = problem[:3], LinearSystem.of(*problem)
    forward, found = smoother.forward_filter(system), smoother.rts(system)
    x, P = forward.x[-1], forward.P[-1]
    for i in range(N - 1, -1, -1):
        ahead = Phi[i] @ forward.P[i] @ Phi[i].T + Gamma[i] @ D[i] @ Gamma[i].T
        s = np.linalg.solve(ahead, x - Phi[i] @ forward.x[i])
        np.testing.assert_allclose(found.s[i], s, rtol=1e-7, atol=1e-9 * (1 + abs(found.s).max()))
        C = np.linalg.solve(ahead, Phi[i] @ forward.P[i]).T
        x = forward.x[i] + C @ (x - Phi[i] @ forward.x[i])
        P = forward.P[i] + C @ (P - ahead) @ C.T
        np.testing.assert_allclose(found.x[i], x, rtol=1e-7, atol=1e-8)
        np.testing.assert_allclose(found.P[i], P, rtol=1e-7, atol=1e-8)
    Q = [g @ d @ g.T for g, d in zip(Gamma, D, strict=True)]
    predicted = [Phi[i] @ forward.x[i] for i in range(N)]
    backward = smoother.rts_backward(forward.x, forward.P, predicted, Phi, Q)
    np.testing.assert_allclose(backward.x, found.x, rtol=1e-7, atol=1e-8)
    np.testing.assert_allclose(backward.P, found.P, rtol=1e-7, atol=1e-8)


@settings(max_examples=30)
@given(st.integers(0, 10**6), st.integers(1, 3), st.integers(1, 8))
def test_block_elimination_solves_the_whole_system(seed: int, n: int, N: int) -> None:
    rng = np.random.default_rng(seed)
    M, C = rng.standard_normal((N + 1, 2 * n, 2 * n)), 0.5 * rng.standard_normal((N, n, n))
    M = M + M.mT + 6.0 * n * np.eye(2 * n)
    whole = np.zeros(((N + 1) * 2 * n,) * 2)
    for i in range(N + 1):
        whole[2 * n * i : 2 * n * (i + 1), 2 * n * i : 2 * n * (i + 1)] = M[i]
    for i in range(N):
        rows, columns = slice(2 * n * (i + 1), 2 * n * (i + 1) + n), slice(2 * n * i + n, 2 * n * (i + 1))
        whole[rows, columns], whole[columns, rows] = C[i], C[i].T
    b = rng.standard_normal((N + 1, 2 * n))
    y, inverse = two_point_bvp.solve(M, C, b)
    np.testing.assert_allclose(y.ravel(), np.linalg.solve(whole, b.ravel()), atol=1e-10)
    dense = np.linalg.inv(whole)
    for i in range(N + 1):
        block = dense[2 * n * i : 2 * n * (i + 1), 2 * n * i : 2 * n * (i + 1)]
        np.testing.assert_allclose(inverse[i], block, atol=1e-10)


def test_smoothing_makes_every_variance_smaller() -> None:
    system = LinearSystem.of(*random_problem(3, 4, 40, singular=False))
    forward, found = smoother.forward_filter(system), smoother.rts(system)
    for k in range(41):
        assert np.linalg.eigvalsh(forward.P[k] - found.P[k]).min() > -1e-12
    np.testing.assert_allclose(found.x[-1], forward.x[-1], atol=1e-12)


def test_the_error_model_of_an_ins_for_a_flight() -> None:
    """Metres, microradians and radians per second in one state, an outage in the middle."""
    drift, bias = gyro_drift(1.0 / 18000.0, 5e-8), accelerometer(1.0 / 3600.0, 5e-4)
    model = aircraft_model(math.radians(60.0), 150.0, 100.0, added=(drift, bias))
    step = discretise(model.A, model.Q + np.diag([0.0, 0.0, 1e-5, 1e-5] + [0.0] * 8), model.B, 2.0)
    N, H = 900, np.eye(2, 12)
    B = np.diag([20.0, 20.0, 0.5, 0.5, 1e-4, 1e-4, 1e-3, 5e-8, 5e-8, 5e-8, 5e-4, 5e-4]) ** 2
    rng = np.random.default_rng(0)
    z = [None if 300 <= i < 600 else 3.0 * rng.standard_normal(2) for i in range(N)]
    system = LinearSystem.of(
        [step.A] * N, [np.eye(12)] * N, [step.Q] * N, [H] * N, [9.0 * np.eye(2)] * N, z, np.zeros(12), B
    )
    one, other = smoother.rts(system), smoother.two_point(system)
    sigma = np.sqrt(np.einsum("ijj->ij", one.P))
    assert (abs(one.x - other.x) < AGREE * sigma).all()
    assert (abs(one.P - other.P) < AGREE * sigma[:, :, None] * sigma[:, None, :]).all()


@pytest.mark.parametrize("solve", [smoother.rts, smoother.two_point])
def test_uninformative_prior(solve: Any) -> None:
    """Least squares without a prior; no negative variance by differences of large covariances."""
    N = 30
    rng = np.random.default_rng(0)
    z = list(rng.standard_normal((N, 1)))
    step = np.array([[1.0, 1.0], [0.0, 1.0]])
    problem = [step] * N, [np.eye(2)] * N, [np.zeros((2, 2))] * N, [[1.0, 0.0]] * N, [1.0] * N, z
    found = solve(LinearSystem.of(*problem, np.zeros(2), 1e12 * np.eye(2)))
    A = np.column_stack((np.ones(N), np.arange(1.0, N + 1.0)))
    np.testing.assert_allclose(found.P[0], np.linalg.inv(A.T @ A), rtol=1e-3)
    best = np.linalg.lstsq(A, np.array(z)[:, 0], rcond=None)[0]
    np.testing.assert_allclose(found.x[0], best, atol=1e-3)
    assert np.linalg.eigvalsh(found.P).min() > 0.0


@pytest.mark.parametrize("solve", [smoother.rts, smoother.two_point])
def test_memory_grows_as_the_length(solve: Any) -> None:
    peak = []
    for N in (100, 200, 400):
        system = LinearSystem.of(*random_problem(0, 6, N, singular=False))
        tracemalloc.start()
        solve(system)
        peak.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    assert peak[2] < 2.2 * peak[1] < 4.84 * peak[0]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({5: [1.0, 2.0]}, "entries: give one of each"),
        ({0: [np.eye(3)] * 10}, r"entry 0: Phi \(3, 3\)"),
        ({3: [np.eye(2)] * 10}, "entry 0: H"),
        ({3: [None] * 10}, r"entry 0: H \(0, 2\) does not fit z of 1 numbers"),
        ({4: [None] * 10}, r"entry 0: covariance R has shape \(0, 0\), it must be \(1, 1\)"),
        ({4: [0.0] * 10}, "entry 0: covariance R has variance 0"),
        ({2: [-1.0] * 10}, "entry 0: covariance D has variance -1"),
        ({5: [math.nan] * 10}, "entry 0: a number is not finite"),
        ({6: [math.nan, 0.0]}, "initial state x is not finite"),
        ({7: [[1.0, 2.0], [2.0, 1.0]]}, "P0 is not positive semidefinite"),
    ],
)
def test_bad_input_is_reported(change: dict[int, Any], message: str) -> None:
    problem = list(example())
    for k, value in change.items():
        problem[k] = value
    with pytest.raises(ValueError, match=message):
        LinearSystem.of(*problem)
