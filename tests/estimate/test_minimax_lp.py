"""Exchange method with inputs: exact against HiGHS; the bound is attained by an integrated force."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.linalg import qr
from scipy.optimize import linprog

from companion.estimate import minimax_lp
from companion.estimate.minimax_lp import Design
from companion.estimate.schuler import MEAN_EARTH, force_response, schuler_row, transition
from companion.units import G0

FORCE = 20e-6 * G0
SIGMA_M = 2.0


def channel(window_s: float, ahead_s: float, step_s: float = 10.0):
    """Position fixes every 10 s at 5, 15, ... s, in metres on the state at the last fix; force in steps."""
    t = np.arange(5.0, window_s, 10.0)
    rows = schuler_row("gamma", (t[-1] - t) * MEAN_EARTH.rate) * MEAN_EARTH.radius
    past = np.arange(t[0], t[-1] + 0.5 * step_s, step_s)
    effect = force_response("gamma", t[:, None], past[:-1], past[1:], t[-1])
    later = np.linspace(t[-1], t[-1] + ahead_s, round(ahead_s / step_s) + 1)
    beyond = force_response("gamma", later[-1:], later[:-1], later[1:], t[-1])
    target = transition(ahead_s * MEAN_EARTH.rate)[0] * MEAN_EARTH.radius
    return t, rows, effect, past, target, later, beyond


@pytest.mark.parametrize(
    ("window_min", "ahead_min", "bound_m"), [(10, 5, 90), (10, 10, 349), (25, 10, 164), (25, 20, 582)]
)
def test_bound_of_the_reference(window_min: float, ahead_min: float, bound_m: float) -> None:
    _, rows, effect, _, target, _, beyond = channel(60.0 * window_min, 60.0 * ahead_min)
    best = Design.of(rows, SIGMA_M, effect, np.full(effect.shape[1], FORCE)).minimax(target)
    assert round(best.bound + FORCE * float(np.abs(beyond).sum())) == bound_m
    assert abs(best.gap) < 1e-9


def test_bound_is_attained_by_a_force_through_the_channel() -> None:
    """Integrate the four equations under the worst force; fix errors have the signs of the weights."""
    t, rows, effect, past, target, later, beyond = channel(600.0, 300.0)
    best = Design.of(rows, SIGMA_M, effect, np.full(effect.shape[1], FORCE)).minimax(target)
    edges = np.concatenate([past, later[1:]])
    left = np.concatenate([-best.weights @ effect, beyond])
    rate, radius = MEAN_EARTH.rate, MEAN_EARTH.radius

    def slope(s: float, x: np.ndarray) -> list[float]:
        k = min(max(int(np.searchsorted(edges, s, "right")) - 1, 0), len(left) - 1)
        force = FORCE * float(np.sign(left[k])) if s >= edges[0] else 0.0
        _, tilt, velocity, drift = x
        return [velocity, velocity / radius - drift, force - radius * rate**2 * tilt, 0.0]

    start = [30.0, 1e-5, 0.4, 1e-8]
    times = np.append(t, later[-1])
    flown = solve_ivp(slope, (t[0], later[-1]), start, t_eval=times, max_step=5.0, rtol=1e-9, atol=1e-12)
    fixes = flown.y[0, :-1] - SIGMA_M * np.sign(best.weights)
    error = flown.y[0, -1] - best.weights @ fixes
    bound = best.bound + FORCE * float(np.abs(beyond).sum())
    assert error == pytest.approx(bound, rel=2e-3)


def highs(rows, sigmas, effect, d, target, through) -> float:
    n, p = effect.shape
    h, e = rows / sigmas[:, None], effect / sigmas[:, None] * d
    zero = np.zeros((rows.shape[1], 2 * p))
    equal = np.block([[h.T, -h.T, zero], [e.T, -e.T, np.eye(p), -np.eye(p)]])
    goal = np.concatenate([target, through * d])
    tight = {"primal_feasibility_tolerance": 1e-10, "dual_feasibility_tolerance": 1e-10}
    return float(linprog(np.ones(2 * (n + p)), A_eq=equal, b_eq=goal, method="highs", options=tight).fun)


@pytest.mark.parametrize("seed", range(4))
def test_random_problems_against_highs(seed: int) -> None:
    """Positions and velocities of the channel, or any rows; forces, constants, unused inputs; any target."""
    rng = np.random.default_rng(seed)
    for trial in range(50):
        n, p = int(rng.integers(8, 80)), int(rng.integers(0, 50))
        sigmas = 10.0 ** rng.uniform(-1.0, 1.0, n)
        if trial % 2:
            s = np.sort(rng.uniform(0.0, 2.0, n))
            velocity = rng.random(n) < 0.3
            rows = np.where(velocity[:, None], schuler_row("mu", s), schuler_row("gamma", s))
            steps = np.sort(rng.uniform(0.0, 2.0, p))
            effect = np.where(s[:, None] > steps, np.sin(s[:, None] - steps), 0.0)
        else:
            rows = rng.normal(size=(n, int(rng.integers(1, 6))))
            effect = rng.normal(size=(n, p)) * (rng.random((n, p)) < 0.7)
        d = 10.0 ** rng.uniform(-3.0, 1.0, p) * (rng.random(p) < 0.9)
        target = rng.normal(size=rows.shape[1])
        through = rng.normal(size=p) * (rng.random(p) < 0.7)
        design = Design.of(rows, sigmas, effect, d)
        best = design.minimax(target, through=through)
        least = highs(rows, sigmas, effect, d, target, through)
        assert best.bound == pytest.approx(least, rel=1e-6)
        assert float(design.worst(best.weights, through)) == pytest.approx(best.bound, rel=1e-9)
        assert np.abs(rows.T @ best.weights - target).max() < 1e-7 * max(1.0, float(np.abs(target).max()))
        again = design.minimax(target, best, through)
        assert again.bound == pytest.approx(best.bound, rel=1e-9)
        rough = design.minimax(target, through=through, tolerance=1e-3)
        assert best.bound * (1.0 - 1e-9) <= rough.bound <= 1.001 * best.bound / (1.0 - 1e-3)


@pytest.mark.parametrize("exchanges", [1, 3, 10])
@pytest.mark.parametrize("through", [0.0, 1.0])
def test_the_gap_says_how_far_an_unfinished_exchange_may_be_off(
    monkeypatch: pytest.MonkeyPatch, exchanges: int, through: float
) -> None:
    """Of a target without inputs it was 0 whatever the dual: bound 25 for an optimum of 1.8."""
    monkeypatch.setattr(minimax_lp, "EXCHANGES_MAX", exchanges)
    rng = np.random.default_rng(exchanges)
    rows, effect, sigmas = rng.normal(size=(60, 4)), rng.normal(size=(60, 30)), np.ones(60)
    target, g, d = rng.normal(size=4), through * rng.normal(size=30), np.ones(30)
    best = Design.of(rows, sigmas, effect, d).minimax(target, through=g)
    least = highs(rows, sigmas, effect, d, target, g)
    assert best.bound > 1.05 * least
    assert best.bound * (1.0 - best.gap) <= least * (1.0 + 1e-9)


def test_inputs_are_checked() -> None:
    rows = np.ones((3, 1))
    with pytest.raises(ValueError, match="give \\(3, p\\)"):
        Design.of(rows, 1.0, np.ones((2, 4)), np.ones(4))
    with pytest.raises(ValueError, match="no bound negative"):
        Design.of(rows, 1.0, np.ones((3, 1)), [-1.0])
    with pytest.raises(ValueError, match="one for each input"):
        Design.of(rows, 1.0, np.ones((3, 2)), [1.0, 1.0]).minimax([1.0], through=[1.0])
    with pytest.raises(ValueError, match="all rows are zero"):
        Design.of(0.0 * rows, 1.0, np.ones((3, 1)), [1.0]).minimax([0.0], through=[1.0])


@pytest.mark.parametrize("seed", range(20))
def test_the_columns_to_start_from_are_those_of_a_pivoted_qr(seed: int) -> None:
    rng = np.random.default_rng(seed)
    r = int(rng.integers(1, 9))
    q = rng.standard_normal((r, 40)) * 10.0 ** rng.uniform(-3.0, 3.0, 40)
    assert minimax_lp.independent_columns(q).tolist() == qr(q, mode="r", pivoting=True)[-1][:r].tolist()
