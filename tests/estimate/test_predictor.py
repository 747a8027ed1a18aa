"""Bounds of linear estimates: Bayes is the Kalman filter, restricted the least within its limit."""

from typing import Any

import numpy as np
import pytest
from scipy.optimize import minimize

from companion.estimate import minimax_lp
from companion.estimate.minimax_lp import Infeasible
from companion.estimate.predictor import Program, Step, Target, Window, anchor
from companion.nav.bounded_channel import BoundedDrift, BoundedIns, Motion, UnitErrors
from companion.units import G0

NAVIGATION = UnitErrors(4.8e-8, 18_000.0, 5.8e-7, 50e-6 * G0, 3600.0, 1e-3, 0.5, 1e-4, 9e-4)
WEST = (0.0, -40.0)


def small(seed: int, n: int = 12, p: int = 6) -> tuple[Program, Target]:
    rng = np.random.default_rng(seed)
    rows = np.column_stack([np.ones(n), np.linspace(-1.0, 1.0, n)])
    sigmas = rng.uniform(0.5, 2.0, n)
    inputs, bounds = rng.normal(size=(n, p)), rng.uniform(0.1, 1.0, p)
    program = Program(
        rows, rng.normal(size=n), sigmas, inputs, bounds, np.diag(bounds**2), np.diag(sigmas**2)
    )
    return program, Target(np.array([1.0, 2.5]), rng.normal(size=p))


def test_bayes_is_the_kalman_filter() -> None:
    """A random walk seen with noise, by the filter's own recursion from a diffuse start."""
    rng = np.random.default_rng(1)
    n, q, r = 25, 0.3, 2.0
    z = np.cumsum(rng.normal(0.0, q, n)) + rng.normal(0.0, r, n)
    x, P = z[0], r**2
    for value in z[1:]:
        P += q**2
        K = P / (P + r**2)
        x, P = x + K * (value - x), (1.0 - K) * P
    later = np.triu(np.ones((n, n - 1)), 0) * -1.0  # the state at the end is the unknown
    bounds = np.full(n - 1, q)
    program = Program(np.ones((n, 1)), z, np.full(n, r), later, bounds, np.diag(bounds**2), np.eye(n) * r**2)
    found = program.bayes(Target(np.array([1.0]), np.zeros(n - 1)))
    assert found.value == pytest.approx(x, rel=1e-9)
    assert found.expected**2 == pytest.approx(P, rel=1e-9)


@pytest.mark.parametrize("seed", range(4))
def test_restricted_is_the_least_expected_error_within_its_limit(seed: int) -> None:
    """A general solver of the same convex problem gets no lower."""
    program, target = small(seed)
    best, _ = program.minimax(target)
    bayes = program.bayes(target)
    kappa = 1.0 + 0.3 * (bayes.bound / best.bound - 1.0)
    found, multiplier = program.restricted(target, best, kappa, tolerance=1e-5, rounds=500)
    assert multiplier > 0.0
    assert found.bound <= kappa * best.bound * (1.0 + 1e-9)
    assert bayes.expected <= found.expected <= best.expected

    n = len(program.values)

    # |w| and |k| by bounding variables: smooth constraints for the solver
    def left(w: np.ndarray) -> np.ndarray:
        return target.g - w @ program.inputs

    def slack(x: np.ndarray) -> np.ndarray:
        w, a, b = x[:n], x[n : 2 * n], x[2 * n :]
        limit = kappa * best.bound - a @ program.sigmas - b @ program.bounds
        k = left(w)
        return np.concatenate([a - w, a + w, b - k, b + k, [limit]])

    start = np.concatenate([best.weights, np.abs(best.weights), np.abs(left(best.weights))])
    solved: Any = minimize(
        lambda x: program.judge(x[:n], target).expected ** 2,
        start,
        constraints=[
            {"type": "eq", "fun": lambda x: program.rows.T @ x[:n] - target.a},
            {"type": "ineq", "fun": slack},
        ],
        method="SLSQP",
        options={"maxiter": 500, "ftol": 1e-12},
    )
    assert solved.success
    assert found.expected == pytest.approx(float(np.sqrt(solved.fun)), rel=1e-3)
    quick, _ = program.restricted(target, best, kappa)
    assert quick.bound <= kappa * best.bound
    assert quick.expected == pytest.approx(found.expected, rel=2e-2)


def test_restricted_is_bayes_where_that_is_within_the_limit() -> None:
    program, target = small(9)
    best, _ = program.minimax(target)
    found, multiplier = program.restricted(target, best, 100.0)
    assert multiplier == 0.0
    np.testing.assert_allclose(found.weights, program.bayes(target).weights)
    with pytest.raises(ValueError, match="give 1 or more"):
        program.restricted(target, best, 0.9)


def test_no_error_within_its_bounds_exceeds_the_worst() -> None:
    """Attained by signs; a thousand random errors of full size stay below."""
    rng = np.random.default_rng(3)
    program, target = small(5)
    estimate, _ = program.minimax(target)
    k = target.g - estimate.weights @ program.inputs
    assert estimate.bound == pytest.approx(
        np.abs(estimate.weights) @ program.sigmas + np.abs(k) @ program.bounds
    )
    rho = rng.choice([-1.0, 1.0], (1000, len(program.sigmas))) * program.sigmas
    u = rng.choice([-1.0, 1.0], (1000, len(k))) * program.bounds
    assert np.abs(rho @ estimate.weights - u @ k).max() <= estimate.bound * (1.0 + 1e-12)


def flown(minutes: int, values: np.ndarray | None = None, law: Any = None) -> tuple[Window, Any]:
    """Fixes of 2 m, one every 10 s, straight west."""
    law = law or BoundedIns(NAVIGATION, 5.0)
    window, position = Window.begin(0.0, law), np.eye(law.n)[:2]
    for k in range(6 * minutes):
        window = window.extend(10.0 * k + 10.0, *law.step(Motion(0.8, WEST, WEST, 10.0)))
        value = np.zeros(2) if values is None else values[k]
        window = window.with_fix(10.0 * k + 10.0, position @ window.C[-1], value, np.full(2, 2.0), 3600.0)
    return window, law


def steps(law: Any, seconds: float) -> list[Step]:
    Phi, B, _ = law.step(Motion(0.8, WEST, WEST, 10.0))
    return [Step(10.0, Phi, B)] * round(seconds / 10.0)


def test_bound_grows_with_the_time_without_fixes() -> None:
    window, law = flown(10)
    anchored, last = anchor(window, law), 0.0
    for ahead in (0.0, 300.0, 600.0):
        solved = anchored.solve(anchored.targets(window, (0,), steps(law, ahead))[0])
        assert last < solved.minimax.bound <= solved.restricted.bound <= 1.22 * solved.minimax.bound
        assert solved.kalman.expected <= 1.01 * solved.restricted.expected
        last = solved.minimax.bound


@pytest.mark.parametrize("law", [None, BoundedDrift(8.0, 0.1, 0.03, 0.03, correlation_s=5.0)])
@pytest.mark.parametrize("silent_s", [0.0, 60.0])
def test_what_is_carried_on_has_the_worst_error_of_any_such_estimate_and_little_more(
    law: Any, silent_s: float
) -> None:
    """Three seconds on, in a turn of 30 deg: no bound is below the least, or more than 5 % above it."""
    window, law = flown(10, law=law)
    anchored = anchor(window, law)
    before = steps(law, silent_s)
    position, rate = (anchored.solve(t) for t in anchored.targets(window, (0, 2), before))
    Phi, B, _ = law.step(
        Motion(0.8, WEST, (0.87 * WEST[0] - 0.5 * WEST[1], 0.87 * WEST[1] + 0.5 * WEST[0]), 3.0)
    )
    (target,) = anchored.targets(window, (0,), [*before, Step(3.0, Phi, B)])
    found, best = anchored.carried(position, rate, 3.0, target), anchored.solve(target)
    assert best.minimax.bound * (1.0 - best.gap) <= found.minimax.bound < 1.05 * best.minimax.bound
    assert found.restricted.bound < 1.05 * best.restricted.bound
    assert found.minimax.value == pytest.approx(position.minimax.value + 3.0 * rate.minimax.value)


def test_position_within_1000_m_for_twenty_minutes() -> None:
    """After 25 min of 2 m fixes, navigation grade, on each axis."""
    window, law = flown(25)
    anchored = anchor(window, law)
    for target in anchored.targets(window, (0, 1), steps(law, 1200.0)):
        assert anchored.solve(target).restricted.bound < 1000.0


@pytest.mark.parametrize("minutes", [13, 19, 25])
def test_hardly_observable_states_have_a_certificate_too(minutes: int) -> None:
    """Gyro drift and accelerometer bias: all weights of the estimate vanish. Exchanges that gained nothing
    went on for 0.2 s, and ended with nothing proved: a duality gap of 0.9999.
    """
    window, law = flown(minutes)
    anchored = anchor(window, law)
    for target in anchored.targets(window, range(law.n)):
        assert -1e-9 < anchored.solve(target).gap < 1e-4


def test_an_exchange_that_is_stopped_gives_an_estimate_of_the_target(monkeypatch: pytest.MonkeyPatch) -> None:
    """Whenever it is, also while a target close by is solved: unbiased, with the bound and gap it states."""
    window, law = flown(13)
    anchored = anchor(window, law)
    program = anchored.grouped
    for wanted in anchored.targets(window, (0, 7)):
        target = anchored.coarse(wanted)
        least = program.minimax(target)[0].bound
        for exchanges in range(1, 60):
            monkeypatch.setattr(minimax_lp, "EXCHANGES_MAX", exchanges)
            estimate, best = program.minimax(target)
            assert program.rows.T @ estimate.weights == pytest.approx(target.a, abs=1e-9)
            assert estimate.bound == pytest.approx(best.bound, rel=1e-9)
            assert best.bound * (1.0 - best.gap) <= least * (1.0 + 1e-9)
            assert best.bound >= least * (1.0 - 1e-9)
        monkeypatch.undo()


def test_neighbours_weighed_alike_cost_two_per_cent() -> None:
    window, law = flown(10)
    anchored = anchor(window, law)
    target = anchored.targets(window, (0,), steps(law, 600.0))[0]
    least, _ = anchored.program.minimax(target, tolerance=1e-6)
    assert least.bound * (1.0 - 1e-6) <= anchored.solve(target).minimax.bound < 1.02 * least.bound


def test_a_jump_of_the_channel_moves_the_estimate_and_no_bound() -> None:
    window, law = flown(10, np.random.default_rng(2).normal(0.0, 2.0, (60, 2)))
    jumped = window.shift(np.array([30.0, -40.0]))
    for state, offset in ((0, 30.0), (1, -40.0), (2, 0.0)):
        before, after = (
            (a := anchor(w, law)).solve(a.targets(w, (state,))[0]).restricted for w in (window, jumped)
        )
        assert after.value - before.value == pytest.approx(
            offset, abs=1e-3
        )  # a jump starts no motion but by the Earth
        assert after.bound == before.bound


def test_contradicted_errors_widen() -> None:
    rng = np.random.default_rng(4)
    window, law = flown(10, rng.normal(0.0, 2.0, (60, 2)))
    assert anchor(window, law).grouped.widening == 1.0
    wild, _ = flown(10, rng.normal(0.0, 40.0, (60, 2)))
    assert 10.0 < anchor(wild, law).grouped.widening < 40.0


def test_dead_reckoning_has_its_own_law() -> None:
    """Wind of 0.1 m/s/sqrt s: the r.m.s. of its wander, and what the fixes leave of the velocity."""
    law = BoundedDrift(8.0, 0.1, correlation_s=5.0)
    window, _ = flown(10, law=law)
    anchored = anchor(window, law)
    bound = anchored.solve(anchored.targets(window, (0,), steps(law, 600.0))[0]).restricted.bound
    wander = 0.1 * 600.0**1.5 * 2.0 / 3.0
    assert wander < bound < 2.0 * wander


@pytest.mark.parametrize("count", [30, 2, 1])
@pytest.mark.parametrize("before_s", [6.0, 1.0])
def test_what_comes_up_between_a_fix_and_the_end_of_its_interval_counts(before_s: float, count: int) -> None:
    """A velocity error that wanders, integrated by the estimate's own weights on the fixes.

    The bound of an airspeed channel was a quarter below what is attained; of a window of one fix too.
    """
    law, at_rest = BoundedDrift(8.0, 0.1, wander=0.7, wander_s=20.0, correlation_s=5.0), (0.0, 0.0)
    window, end = Window.begin(0.0, law), 10.0 * count
    times = np.arange(10.0, end + 5.0, 10.0) - before_s
    position = np.eye(law.n)[:2]
    position[:, 2:4] = -before_s * np.eye(2)
    for t in times:
        window = window.extend(t + before_s, *law.step(Motion(0.8, at_rest, at_rest, 10.0)))
        window = window.with_fix(t, position @ window.C[-1], np.zeros(2), np.full(2, 2.0), 3600.0)
    anchored = anchor(window, law)
    solved = anchored.solve(anchored.targets(window, (0,))[0])
    s = np.arange(times[0], end, 0.05) + 0.025
    for found in solved[:3]:
        north = found.weights[::2]
        left = np.array([north[times <= at].sum() for at in s])
        constant = abs(north @ (end - times)) * window.sigma[-1][2]
        worst = np.abs(north).sum() * 2.0 + np.abs(left) @ law.bound(s - end) * 0.05 + constant
        assert worst * (1.0 - 1e-3) < found.bound < 1.01 * worst


def test_a_first_fix_after_all_others_are_dropped_keeps_its_interval() -> None:
    law, at_rest = BoundedDrift(8.0, 0.1, wander=0.7, wander_s=20.0, correlation_s=5.0), (0.0, 0.0)
    window = Window.begin(0.0, law)
    for t in (10.0, 20.0, 30.0):
        window = window.extend(t, *law.step(Motion(0.8, at_rest, at_rest, 10.0)))
        window = window.with_fix(t - 5.0, np.eye(law.n)[:2] @ window.C[-1], np.zeros(2), np.full(2, 2.0), 3.0)
        assert window.t_s == (t - 10.0, t)
        assert [fix.node for fix in window.fixes] == [1]


def test_two_nodes_of_one_time_are_rejected() -> None:
    law = BoundedDrift(8.0, 0.1)
    step = law.step(Motion(0.8, WEST, WEST, 10.0))
    with pytest.raises(ValueError, match="node at 10 s, the last is at 10 s"):
        Window.begin(0.0, law).extend(10.0, *step).extend(10.0, *step)


def test_without_fixes_there_is_nothing_to_predict() -> None:
    law = BoundedIns(NAVIGATION)
    with pytest.raises(ValueError, match="no fixes"):
        anchor(Window.begin(0.0, law), law)
    law = BoundedDrift(8.0, 0.1)
    window = Window.begin(0.0, law).extend(10.0, *law.step(Motion(0.8, WEST, WEST, 10.0)))
    velocity = np.eye(law.n)[2:4] @ window.C[-1]
    window = window.with_fix(10.0, velocity, np.zeros(2), np.full(2, 0.1), 3600.0)
    anchored = anchor(window, law)
    with pytest.raises(Infeasible):
        anchored.solve(anchored.targets(window, (0,))[0])
