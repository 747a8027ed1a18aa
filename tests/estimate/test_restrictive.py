"""Restrictive filter R1 and the full-horizon solution: reference values, optimality, limits, box solvers."""

import json
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from companion.estimate import bounded_lsq, kalman, restrictive
from companion.nav.error_model import paper_example
from tests.estimate import full_horizon

REFERENCE = json.loads((Path(__file__).parents[1] / "data/restrictive.json").read_text())
SMALL = [pytest.param(case, id=name) for name, case in REFERENCE["small"].items()]
SHIP = REFERENCE["sixteen_states_euler"]


def problem(case):
    A, B, Q, H, R, C, x0, P0, Z = (
        np.array(case[k], float) for k in ("A", "B", "Q", "H", "R", "C", "x0", "P0", "Z")
    )
    return x0, P0, Z, (A, B, Q, H, R, C)


def ship():
    e = paper_example(exact=False)
    return e.x0, e.P0, np.array(SHIP["Z"]), (e.A, e.B, e.Q, e.H, e.R, e.C)


def run_r1(x, P, Z, model, kappa=np.inf):
    steps = []
    for z in Z:
        steps.append(restrictive.step(x, P, z, *model, kappa))
        x, P = steps[-1].x, steps[-1].P
    return steps


def gather(steps, name):
    return np.array([getattr(s, name) for s in steps])


@pytest.mark.parametrize("case", SMALL)
def test_r1_small(case):
    x0, P0, Z, model = problem(case)
    for name, kappa in (("restrictive_R1", np.inf), ("restrictive_R1_prior_C2", 1.0)):
        steps, want = run_r1(x0, P0, Z, model, kappa), case[name]
        np.testing.assert_allclose(gather(steps, "x"), want["X"][1:], atol=1e-12)
        np.testing.assert_allclose(gather(steps, "u"), want["U"], atol=1e-12)
        assert (gather(steps, "status") == want["status"]).all()
        np.testing.assert_allclose(steps[0].P, want["P_step1"], atol=1e-12)
        np.testing.assert_allclose(steps[-1].P, want["P_last"], atol=1e-12)


@pytest.mark.parametrize("case", SMALL)
def test_full_horizon_small(case):
    x0, P0, Z, model = problem(case)
    want = case["exact_restrictive"]
    for t in range(1, len(Z) + 1):
        record = full_horizon.solve(x0, P0, Z[:t], *model)
        np.testing.assert_allclose(record.x[-1], want["X_filter"][t - 1], atol=1e-12)
        np.testing.assert_allclose(record.u[-1], want["U_last"][t - 1], atol=1e-12)
    np.testing.assert_allclose(record.u.ravel(), want["U_smooth_T"], atol=1e-12)
    gradient = -(record.l[1:-1] @ model[1]).ravel()
    np.testing.assert_allclose(gradient, want["gradient_T"], atol=1e-12)
    assert (record.status == 0).sum() == want["free_count_T"]


def test_sixteen_states():
    x0, P0, Z, model = ship()
    shown = np.array(SHIP["steps"]) - 1
    steps = run_r1(x0, P0, Z, model)
    np.testing.assert_allclose(gather(steps, "x")[shown], SHIP["restrictive_R1"], atol=1e-9)
    np.testing.assert_allclose(gather(steps, "u"), SHIP["restrictive_R1_U"], atol=1e-9)
    assert (gather(steps, "status") == SHIP["restrictive_R1_status"]).all()
    np.testing.assert_allclose(np.diag(steps[-1].P), SHIP["restrictive_R1_P60_diag"], atol=1e-9)
    for t, want in zip(SHIP["steps"], SHIP["exact_restrictive"], strict=True):
        record = full_horizon.solve(x0, P0, Z[:t], *model)
        np.testing.assert_allclose(record.x[-1], want, atol=1e-9)
    np.testing.assert_allclose(record.u, SHIP["exact_U_smooth_60"], atol=1e-9)


@pytest.mark.parametrize("data", [*(problem(p.values[0]) for p in SMALL), ship()], ids=["1", "2", "16"])
def test_full_horizon_solves_the_two_point_problem(data):
    """The estimate satisfies the conditions of the optimum, none of which was used to find it."""
    x0, P0, Z, (A, B, Q, H, R, C) = data
    x, _, u, status, l = full_horizon.solve(x0, P0, Z, A, B, Q, H, R, C)
    # adjoint variables in units in which they multiply states of order one
    size = 1.0 + np.abs(l).max(axis=0)
    assert np.abs(x[0] - x0 - P0 @ l[0]).max() < 1e-9
    assert np.abs(x[1:] - x[:-1] @ A.T - u @ B.T - l[1:-1] @ Q).max() < 1e-9
    pull = np.linalg.solve(R, (Z - x[1:] @ H.T).T).T @ H
    assert (np.abs(l[1:-1] - l[2:] @ A - pull) / size).max() < 1e-9
    assert (np.abs(l[0] - l[1] @ A) / size).max() < 1e-9 and not l[-1].any()
    switch = l[1:-1] @ B
    assert np.abs(switch[status == 0]).max(initial=0.0) < 1e-9
    on = status != 0
    assert (switch * status)[on].min() > 0.0 and (u == status * C)[on].all()
    assert (np.abs(u) <= C).all()


def test_limits_of_the_bound():
    """No inputs or zero bounds: the Kalman filter. Wide: unknown inputs, R1 and the full horizon agree."""
    x0, P0, Z, (A, B, Q, H, R, C) = ship()
    x, P = x0, P0
    for z in Z:
        x, P, *_ = kalman.step(x, P, z, A, Q, H, R)
    for inputs, bounds in ((B, 0 * C), (B[:, :0], C[:0])):
        tight = run_r1(x0, P0, Z, (A, inputs, Q, H, R, bounds))[-1]
        np.testing.assert_allclose(tight.x, x, atol=1e-10)
        np.testing.assert_allclose(tight.P, P, atol=1e-10)
    wide = (A, B, Q, H, R, 1e6 * C)
    loose = run_r1(x0, P0, Z, wide)[-1]
    assert not loose.status.any()
    np.testing.assert_allclose(loose.x, full_horizon.solve(x0, P0, Z, *wide).x[-1], atol=1e-8)


@pytest.mark.parametrize("C", [[0.0, 0.3], [0.3, 0.3]])
def test_undetermined_inputs_take_the_minimax_prior(C):
    """One row cannot distinguish two inputs; no measurement at all is the minimax prediction."""
    e = paper_example()
    C = np.array(C)
    unmeasured = restrictive.step(
        e.x0, 1e-4 * e.Q, np.zeros(0), e.A, e.B, e.Q, np.zeros((0, 16)), np.zeros((0, 0)), C
    )
    assert not unmeasured.u.any()
    Q = kalman.minimax_noise(e.B, C, e.Q)
    np.testing.assert_allclose(unmeasured.P, kalman.predict(e.x0, 1e-4 * e.Q, e.A, Q).P, atol=1e-12)
    partly = restrictive.step(e.x0, e.Q, np.array([0.1]), e.A, e.B, e.Q, np.ones((1, 16)), np.eye(1), C)
    assert np.isfinite(partly.P).all() and np.linalg.eigvalsh(partly.P)[0] > -1e-9


@settings(max_examples=60)
@given(st.integers(0, 2**32 - 1), st.integers(1, 4))
def test_box_by_enumeration_and_by_bvls_agree(seed, m):
    rng = np.random.default_rng(seed)
    D, r = rng.normal(size=(m + 2, m)), 3 * rng.normal(size=m + 2)
    small, large = bounded_lsq.minimize_quadratic(D.T @ D, D.T @ r), full_horizon.least_squares(D, r)
    np.testing.assert_allclose(small.v, large.v, atol=1e-9)
    assert (small.status == large.status).all()
    np.testing.assert_allclose(small.free_inverse, large.free_inverse, rtol=1e-6, atol=1e-9)
    v = np.clip(rng.normal(size=(200, m)), -1, 1)
    assert (np.sum((r - v @ D.T) ** 2, 1) >= np.sum((r - D @ small.v) ** 2) - 1e-12).all()


def test_clipping_is_not_optimal():
    M, g = np.array([[1.0, 0.9], [0.9, 1.0]]), np.array([2.0, 1.0])
    clipped = np.clip(np.linalg.solve(M, g), -1, 1)
    best = bounded_lsq.minimize_quadratic(M, g).v
    cost = [0.5 * v @ M @ v - g @ v for v in (best, clipped)]
    assert cost[0] < cost[1] - 0.1


def test_interior_point_solver_agrees():
    piqp = pytest.importorskip("piqp")
    rng = np.random.default_rng(3)
    D, r = rng.normal(size=(60, 40)), 3 * rng.normal(size=60)
    solver = piqp.DenseSolver()
    solver.setup(D.T @ D, -D.T @ r, x_l=-np.ones(40), x_u=np.ones(40))
    solver.solve()
    np.testing.assert_allclose(full_horizon.least_squares(D, r).v, solver.result.x, atol=1e-5)


def test_batch_equals_one_by_one():
    e = paper_example()
    z = 0.5 * np.random.default_rng(4).standard_normal((8, 30, 2))
    x, P = np.tile(e.x0, (8, 1)), np.tile(e.P0, (8, 1, 1))
    together = []
    for t in range(30):
        together.append(restrictive.step(x, P, z[:, t], e.A, e.B, e.Q, e.H, e.R, e.C))
        x, P = together[-1].x, together[-1].P
    for i in range(8):
        alone = run_r1(e.x0, e.P0, z[i], (e.A, e.B, e.Q, e.H, e.R, e.C))
        for many, one in zip(together, alone, strict=True):
            np.testing.assert_allclose(many.x[i], one.x, atol=1e-9)
            assert (many.status[i] == one.status).all()
        np.testing.assert_allclose(together[-1].P[i], one.P, atol=1e-9)
