"""The closed form, the exchange and a general linear programme agree, and the bound is a law."""

import json
import math
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from scipy.linalg import expm
from scipy.optimize import linprog

from companion.estimate.minimax import closed_form, closed_form_tau, continuous_tau
from companion.estimate.minimax_lp import Design, Infeasible, LeastSquares, Minimax
from companion.estimate.schuler import (
    ARCSECOND,
    DEG_PER_HOUR,
    STATE,
    Scale,
    schuler_row,
    sine_excess,
    transition,
)

REFERENCE = json.loads((Path(__file__).parents[1] / "data" / "minimax.json").read_text())
REFERENCE_DIGITS = 1e-12
UNITS = np.eye(4)


def solve(rows, target, sigmas, start: Minimax | None = None) -> Minimax:
    return Design.of(rows, sigmas).minimax(target, start)


def least_squares(rows, target, sigmas) -> LeastSquares:
    return Design.of(rows, sigmas).least_squares(target)


def worst_case_rms(weights: np.ndarray, sigmas: np.ndarray | float) -> float:
    """The r.m.s. error of w . z under the worst correlation, rho = +-sigma sign w."""
    return float(np.abs(weights * sigmas).sum())


def white_noise_rms(weights: np.ndarray, sigmas: np.ndarray | float) -> float:
    return float(np.linalg.norm(weights * sigmas))


def sampled(case):
    rows = [schuler_row(m["of"], case["T"] + case["alpha"] - m["tau"]) for m in case["measurements"]]
    return np.array(rows), np.array([m["sigma"] for m in case["measurements"]])


def highs(rows, target, sigmas):
    """Solve the primal programme by HiGHS."""
    sigmas = np.broadcast_to(sigmas, len(rows))
    unit = np.abs(rows).max(axis=0)  # coefficients below 1e-9 it takes for zero, whatever they are worth
    unit[unit == 0.0] = 1.0
    rows, target = rows / unit, target / unit
    return linprog(
        np.r_[sigmas, sigmas],
        A_eq=np.hstack([rows.T, -rows.T]),
        b_eq=target,
        bounds=(0, None),
        method="highs",
    )


def proved(result, rows, target, sigmas, gap=1e-9):
    """Check the certificate: unbiased weights, a feasible dual, equal values."""
    size = (np.abs(rows.T) @ np.abs(result.weights)).max()
    assert np.abs(rows.T @ result.weights - target).max() <= 1e-11 * size
    assert (np.abs(rows @ result.dual) <= sigmas * (1.0 + 1e-9)).all()
    assert worst_case_rms(result.weights, sigmas) == pytest.approx(result.bound, rel=1e-12)
    assert abs(result.gap) < gap
    assert abs(result.bound - target @ result.dual) <= gap * result.bound


# The channel


@pytest.mark.parametrize("s", [-2.0, -0.3, 1e-9, 0.7, 5.0])
def test_rows_and_transition_solve_the_equations_of_the_channel(s):
    A = np.array([[0.0, 0, 1, 0], [0, 0, 1, -1], [0, -1, 0, 0], [0, 0, 0, 0]])
    assert transition(s) == pytest.approx(expm(A * s), rel=1e-13, abs=1e-15)
    assert schuler_row("gamma", s) == pytest.approx(expm(-A * s)[0], rel=1e-13, abs=1e-15)
    assert schuler_row("mu", s) == pytest.approx(expm(-A * s)[2], rel=1e-13, abs=1e-15)
    assert schuler_row("mu", [s, 2 * s]) == pytest.approx(
        np.stack([schuler_row("mu", k * s) for k in (1, 2)])
    )


def test_sine_excess_keeps_its_digits_near_zero():
    x = np.array([1e-8, 1e-3, 0.1, 0.4999999, 0.5000001, 3.0])
    two_terms = x**3 / 6 - x**5 / 120 + x**7 / 5040 - x**9 / 362880 + x**11 / 39916800 - x**13 / 6227020800
    assert sine_excess(x)[:5] == pytest.approx(two_terms[:5], rel=1e-14, abs=0.0)
    assert sine_excess(x)[5] == 3.0 - math.sin(3.0)


# The closed form


@pytest.mark.parametrize("case", REFERENCE["chi"], ids=lambda case: f"T={case['T']:.3g}")
def test_chi_delta_and_determinant(case):
    result = closed_form_tau(case["T"], 0.1)
    t1 = 0.5 * case["T"] - result.times[1]
    N = schuler_row("gamma", 0.5 * case["T"] - result.times)  # det N is the same for every alpha
    assert result.times[1] == pytest.approx(case["chi"], rel=REFERENCE_DIGITS)
    assert result.bounds[3] == pytest.approx(2.0 * case["delta"] * math.cos(t1), rel=REFERENCE_DIGITS)
    assert abs(np.linalg.det(N)) == pytest.approx(abs(case["det_N"]), rel=REFERENCE_DIGITS)


@pytest.mark.parametrize(
    "case", REFERENCE["closed_form"], ids=lambda c: f"T={c['T']:.3g} alpha={c['alpha']:.3g}"
)
def test_closed_form_reference(case):
    result = closed_form_tau(case["T"], case["alpha"])
    assert result.fallback == ()
    for k, name in enumerate(STATE):
        assert result.bounds[k] == pytest.approx(case["d"][name], rel=REFERENCE_DIGITS)
        assert np.abs(result.weights[k] - case["weights"][name]).sum() <= REFERENCE_DIGITS * case["d"][name]
        assert result.weights[k].sum() == pytest.approx(float(name == "gamma"), abs=1e-14 * case["d"][name])


@pytest.mark.parametrize("case", REFERENCE["phi_window"], ids=lambda case: f"T={case['T']:.3g}")
def test_tilt_falls_back_exactly_where_the_closed_form_fails(case):
    T, edges = case["T"], (case["alpha_max"], case["valid_again_from"])
    inside = [closed_form_tau(T, edges[0] - 1e-7), closed_form_tau(T, edges[1] + 1e-7)]
    beyond = [closed_form_tau(T, edges[0] + 1e-7), closed_form_tau(T, edges[1] - 1e-7)]
    assert [r.fallback for r in inside] == [(), ()]
    assert [r.fallback for r in beyond] == [("phi",), ("phi",)]
    for r, other in zip(inside, beyond, strict=True):
        assert r.bounds[1] == pytest.approx(other.bounds[1], rel=1e-5)  # the bound itself has no jump
    h = 0.5 * T
    assert closed_form_tau(T, math.pi - h).bounds[1] > 1.0  # where the printed sigma |sin c| / D is zero


@pytest.mark.parametrize("T", [0.05, 0.7, 2.0, 4.7, 7.0, 12.0])
@pytest.mark.parametrize("alpha", [-0.02, 0.0, 0.4, 2.3, 3.0, 5.5])
def test_closed_form_equals_the_general_solver_everywhere(T, alpha):
    result = closed_form_tau(T, alpha, sigma=2.0)
    for k in range(4):
        rows = schuler_row("gamma", T + alpha - result.instants[k])
        size = np.abs(result.weights[k]).sum()
        assert (result.instants[k] >= 0.0).all() and (result.instants[k] <= T).all()
        assert rows.T @ result.weights[k] == pytest.approx(UNITS[k], abs=1e-12 * size)
        assert result.bounds[k] == pytest.approx(2.0 * size, rel=REFERENCE_DIGITS)
        assert result.bounds[k] == pytest.approx(
            continuous_tau(T, alpha, UNITS[k], sigma=2.0).bound, rel=1e-9
        )
        if STATE[k] not in result.fallback:
            assert (result.instants[k] == result.times).all()


@pytest.mark.parametrize("T", [0.02, 0.7, 2.0, 6.3, 9.0])
def test_closed_form_in_the_middle_of_the_window_is_the_optimum(T):
    """There the alternating sum of the weights of gamma and phi is zero, and so are the printed bounds."""
    result = closed_form_tau(T, -0.5 * T)
    assert {"gamma", "phi"} <= set(result.fallback)
    for k in range(4):
        assert result.bounds[k] == pytest.approx(np.abs(result.weights[k]).sum(), rel=REFERENCE_DIGITS)
        assert result.bounds[k] == pytest.approx(continuous_tau(T, -0.5 * T, UNITS[k]).bound, rel=1e-9)


def test_closed_form_is_accurate_in_a_very_short_window():
    """h -> 0: chi -> T/4 and the bounds go as powers of T: the channel becomes a cubic."""
    short, shorter = closed_form_tau(1e-5, 0.0), closed_form_tau(5e-6, 0.0)
    assert short.times[1] / 1e-5 == pytest.approx(0.25, rel=1e-10)
    assert shorter.bounds / short.bounds == pytest.approx([1.0, 4.0, 2.0, 8.0], rel=1e-9)


def test_prediction_in_metres():
    """Matasov, Martirosyan's channel at 1.2387e-3 rad/s: 15 min of 30 m positions."""
    scale = Scale(6_371_000.0, 1.2387e-3)
    units = np.array([1.0, 1 / ARCSECOND, 1.0, 1 / DEG_PER_HOUR])

    def bounds(minutes):
        return closed_form(900.0, 60.0 * minutes, 30.0, scale).bounds * units

    assert closed_form(900, 600, 30).bounds[0] == pytest.approx(1216.97846, rel=1e-8)
    found, tau = closed_form(900.0, 300.0, 30.0), closed_form_tau(900.0 * scale.rate, 300.0 * scale.rate)
    assert found.times == pytest.approx(tau.times / scale.rate, rel=1e-14)
    assert 30.0 * np.abs(found.weights).sum(axis=1) == pytest.approx(found.bounds, rel=1e-12)
    assert bounds(5) == pytest.approx([391.731747, 109.928437, 1.90645543, 0.163481305], rel=1e-8)
    assert bounds(10)[0] == pytest.approx(1216.97846, rel=1e-8)
    assert bounds(20)[[0, 2, 3]] == pytest.approx([4558.45109, 7.44174283, 0.163481305], rel=1e-8)


def test_least_squares_is_overconfident():
    """15 min of 30 m positions a second apart, ten minutes ahead."""
    scale = Scale(6_371_000.0, 1.2387e-3)
    rows = schuler_row("gamma", scale.rate * (1500.0 - np.arange(901)))
    ls, minimax = (f(rows, UNITS[0], 30.0) for f in (least_squares, solve))
    assert (ls.claimed, ls.worst) == pytest.approx((70.7, 1786.5), abs=0.05)
    assert minimax.bound == pytest.approx(1216.97846, rel=4.03 / 900**2)
    assert white_noise_rms(closed_form(900.0, 600.0, 30.0, scale).weights[0], 30.0) == pytest.approx(
        651, abs=0.5
    )
    assert (ls.claimed, ls.worst) == pytest.approx(
        (white_noise_rms(ls.weights, 30.0), worst_case_rms(ls.weights, 30.0))
    )


# The general solver


@pytest.mark.parametrize("case", REFERENCE["sampled"], ids=lambda case: case["name"])
def test_sampled_reference(case):
    rows, sigmas = sampled(case)
    result = solve(rows, case["a"], sigmas)
    assert result.bound == pytest.approx(case["d"], rel=1e-9)
    proved(result, rows, np.array(case["a"]), sigmas, gap=1e-12)


@pytest.mark.parametrize("case", REFERENCE["arbitrary_target"], ids=lambda c: f"T={c['T']} {c['a']}")
def test_arbitrary_target_reference(case):
    result = continuous_tau(case["T"], case["alpha"], case["a"])
    rows = schuler_row("gamma", case["T"] + case["alpha"] - result.times)
    assert result.bound == pytest.approx(1.0 if case["d"] is None else case["d"], rel=1e-9)
    assert rows.T @ result.weights == pytest.approx(case["a"], abs=1e-11 * result.bound)
    near = np.abs(result.times[:, None] - case["tau"]).min(axis=1)
    assert (near < 1e-4).all()
    everywhere = schuler_row("gamma", case["T"] + case["alpha"] - np.linspace(0, case["T"], 3001))
    assert np.abs(everywhere @ result.dual).max() <= 1.0 + 1e-9
    assert abs(result.gap) < 1e-9


@st.composite
def problems(draw):
    """Small programmes: dense, integer and so degenerate, with repeated rows, with tiny columns."""
    m = draw(st.integers(1, 5))
    n = draw(st.integers(1, 14))
    seed = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    kind = draw(st.sampled_from(["dense", "integer", "repeated", "scaled"]))
    rows = (
        seed.normal(size=(n, m))
        if kind in ("dense", "scaled")
        else seed.integers(-2, 3, (n, m)).astype(float)
    )
    if kind == "repeated":
        rows = np.vstack([rows, rows[: n // 2], -rows[: n // 3]])
    sigmas = seed.uniform(0.1, 10.0, len(rows)) if draw(st.booleans()) else np.ones(len(rows))
    target = rows[0].copy() if draw(st.booleans()) else seed.integers(-2, 3, m).astype(float)
    return rows, target, sigmas, seed.choice([1e-6, 1.0, 1e5], m) if kind == "scaled" else np.ones(m)


@settings(max_examples=500)
@given(problems())
def test_exchange_equals_a_linear_programme(problem):
    rows, target, sigmas, columns = problem
    reference = highs(rows, target, sigmas)
    scaled = rows * columns, target * columns
    if reference.status != 0:
        with pytest.raises(Infeasible, match="not observable in component"):
            solve(*scaled, sigmas)
        return
    result = solve(*scaled, sigmas)
    assert result.bound == pytest.approx(reference.fun, rel=1e-8, abs=1e-12)
    if result.bound:
        proved(result, *scaled, sigmas)
    again = solve(*scaled, sigmas, start=result)
    assert again.bound == pytest.approx(result.bound, rel=1e-11)


@settings(max_examples=40)
@given(
    T=st.floats(0.05, 6.0),
    alpha=st.floats(-0.5, 6.0),
    seed=st.integers(0, 2**32 - 1),
    k=st.integers(0, 3),
)
def test_exchange_equals_a_linear_programme_on_the_channel(T, alpha, seed, k):
    rng = np.random.default_rng(seed)
    tau = np.sort(rng.uniform(0.0, T, 60))
    rows = np.vstack([schuler_row("gamma", T + alpha - tau), schuler_row("mu", T + alpha - tau[::2])])
    sigmas = np.r_[np.full(60, 1.0), rng.uniform(0.5, 20.0, 30)]
    result = solve(rows, UNITS[k], sigmas)
    proved(result, rows, UNITS[k], sigmas)
    assert result.bound == pytest.approx(highs(rows, UNITS[k], sigmas).fun, rel=1e-7)  # HiGHS's own tolerance


@pytest.mark.parametrize("T", [1e-3, 1e-2, 0.1])
def test_short_windows_are_solved_in_the_middle_of_the_window(T):
    """Where the rows at T + alpha have lost their rank, those about the middle have not."""
    alpha, x = 0.3, np.linspace(-0.5, 0.5, 4001) * T
    target = transition(0.5 * T + alpha)[0]
    result = solve(schuler_row("gamma", -x), target, 1.0)
    assert result.bound == pytest.approx(
        closed_form_tau(T, alpha).bounds[0], rel=3e-7
    )  # the grid's 4.03 / (n - 1)^2
    assert abs(result.gap) < 1e-9


@settings(max_examples=200)
@given(
    exponent=st.floats(-4.0, 1.2),
    ahead=st.floats(-1.0, 8.0),
    seed=st.integers(0, 2**32 - 1),
    k=st.integers(0, 3),
)
def test_every_window_has_a_certificate(exponent, ahead, seed, k):
    """From a tenth of a second to three Schuler periods, with velocities of any quality."""
    rng, T = np.random.default_rng(seed), 10.0**exponent
    x = np.sort(rng.uniform(-0.5, 0.5, rng.integers(6, 300))) * T
    rows = np.vstack([schuler_row("gamma", -x), schuler_row("mu", -x)])
    sigmas = np.r_[np.ones(len(x)), np.full(len(x), 10.0 ** rng.uniform(-2, 3))] * rng.uniform(
        0.5, 2.0, 2 * len(x)
    )
    target = transition(0.5 * T + max(ahead, -T))[k]
    result = solve(rows, target, sigmas)
    size = np.abs(rows).max(axis=0) * np.abs(result.weights).sum()
    assert (np.abs(rows.T @ result.weights - target) <= 1e-11 * size).all()
    assert (np.abs(rows @ result.dual) <= sigmas * (1.0 + 1e-12)).all()
    assert abs(result.gap) < 1e-9


def test_bad_start_does_not_change_the_result():
    rows = schuler_row("gamma", 1.5 - np.linspace(0, 1, 101))
    good = solve(rows, UNITS[0], 1.0)
    for rows_of_start in ((), (0, 0, 0, 0), (0, 1, 2, 3), (-1, 5, 7, 9), (5, 50, 99, 101), (1, 2, 3)):
        start = good._replace(active=rows_of_start)
        assert solve(rows, UNITS[0], 1.0, start).bound == pytest.approx(good.bound, rel=1e-12)
    assert solve(rows, np.zeros(4), 1.0).bound == 0.0


# Laws


@settings(max_examples=100)
@given(st.data())
def test_bound_is_attained_and_never_exceeded(data):
    seed = np.random.default_rng(data.draw(st.integers(0, 2**32 - 1)))
    n = data.draw(st.integers(4, 12))
    rows, sigmas = schuler_row("gamma", 1.5 - np.sort(seed.uniform(0, 1, n))), seed.uniform(0.5, 2.0, n)
    assume((cond := np.linalg.cond(rows)) < 1e8)
    rounding = 1e-9 + cond * np.finfo(float).eps  # of weights: where they are unique, both differ by that
    w, bound = (result := solve(rows, UNITS[0], sigmas)).weights, result.bound
    worst = sigmas * np.sign(w)  # rho = +-worst with even odds is an admissible error
    assert w @ np.outer(worst, worst) @ w == pytest.approx(bound**2, rel=1e-12)
    factors = data.draw(hnp.arrays(float, (n, n), elements=st.floats(-1, 1)))
    factors += 1e-3 * np.eye(n)
    factors /= np.linalg.norm(factors, axis=1, keepdims=True) + 1e-300
    correlation = factors @ factors.T  # any correlation matrix there is
    variance = w @ (correlation * np.outer(sigmas, sigmas)) @ w
    assert variance <= bound**2 * (1.0 + 1e-9)
    for other in (least_squares(rows, UNITS[0], sigmas).weights, w):
        assert worst_case_rms(other, sigmas) >= bound * (1.0 - rounding)
        assert white_noise_rms(other, sigmas) <= worst_case_rms(other, sigmas)


@settings(max_examples=100)
@given(seed=st.integers(0, 2**32 - 1), velocity=st.booleans(), k=st.integers(0, 3))
def test_one_more_measurement_never_raises_the_bound(seed, velocity, k):
    rng = np.random.default_rng(seed)
    rows = schuler_row("gamma", 1.5 - np.linspace(0, 1, 9) + rng.uniform(-0.05, 0.05, 9))
    more = schuler_row("mu" if velocity else "gamma", rng.uniform(0.5, 1.5))
    before = solve(rows, UNITS[k], 1.0).bound
    after = solve(np.vstack([rows, more]), UNITS[k], np.r_[np.ones(9), rng.uniform(0.1, 10)]).bound
    assert after <= before * (1.0 + 1e-10)


@settings(max_examples=50)
@given(seed=st.integers(0, 2**32 - 1), factor=st.floats(1e-3, 1e3))
def test_scaling(seed, factor):
    rng = np.random.default_rng(seed)
    rows, sigmas = rng.normal(size=(20, 3)), rng.uniform(0.5, 2.0, 20)
    target, A = rng.normal(size=3), rng.normal(size=(3, 3)) + 3.0 * np.eye(3)
    bound = solve(rows, target, sigmas).bound
    assert solve(rows, target, factor * sigmas).bound == pytest.approx(factor * bound, rel=1e-10)
    assert solve(rows, factor * target, sigmas).bound == pytest.approx(factor * bound, rel=1e-10)
    assert solve(rows, -target, sigmas).bound == pytest.approx(bound, rel=1e-10)
    assert solve(factor * rows, target, factor * sigmas).bound == pytest.approx(bound, rel=1e-10)
    assume(np.linalg.cond(A) < 1e4)  # other coordinates, the same question
    assert solve(rows @ A, target @ A, sigmas).bound == pytest.approx(bound, rel=1e-9)
    assert solve(np.repeat(rows, 3, axis=0), target, np.repeat(sigmas, 3)).bound == pytest.approx(
        bound, rel=1e-10
    )


def test_bounds_of_parts_measured_by_different_sensors_add():
    """Two sensors, each measuring its own part of the target: the bounds add, not their squares."""
    rng = np.random.default_rng(5)
    first, second = rng.normal(size=(9, 2)), rng.normal(size=(7, 2))
    rows = np.block([[first, np.zeros((9, 2))], [np.zeros((7, 2)), second]])
    a, b = np.array([1.0, -0.5]), np.array([0.3, 2.0])
    parts = solve(first, a, 2.0).bound, solve(second, b, 5.0).bound
    whole = solve(rows, np.r_[a, b], np.r_[np.full(9, 2.0), np.full(7, 5.0)])
    assert whole.bound == pytest.approx(sum(parts), rel=1e-12)


def test_denser_grid_converges_to_the_continuous_optimum():
    exact = closed_form_tau(1.0, 0.5).bounds[0]
    excess = [
        solve(schuler_row("gamma", 1.5 - np.linspace(0, 1, n)), UNITS[0], 1.0).bound / exact - 1.0
        for n in (26, 51, 101, 401, 1601)
    ]
    rounding = 1e-13  # two optima that are equal differ by the order of additions of the BLAS kernel
    assert all(
        -rounding <= e <= 4.1 / (n - 1) ** 2 for e, n in zip(excess, (26, 51, 101, 401, 1601), strict=True)
    )
    assert all(fine <= coarse + rounding for coarse, fine in pairwise(excess))


# Bad input


@pytest.mark.parametrize(
    ("rows", "target", "sigmas", "message"),
    [
        (np.eye(2), [1, 0], [1.0, -2.0], r"sigmas\[1\] is -2.0"),
        (np.eye(2), [1, 0], [0.0, 1.0], r"sigmas\[0\] is 0.0"),
        (np.eye(2), [1, 0], [1.0, math.nan], r"sigmas\[1\] is nan"),
        ([[1, 0], [math.nan, 1]], [1, 0], 1.0, r"rows\[1\] is not finite"),
        (np.eye(2), [1, math.inf], 1.0, r"target\[1\] is not finite"),
        (np.eye(2), [1, 0, 0], 1.0, r"target has shape \(3,\); give \(2,\)"),
        (np.eye(2), [1, 0], [1.0], r"sigmas has shape \(1,\)"),
        (np.ones(3), [1], 1.0, r"rows has shape \(3,\)"),
        (np.empty((0, 4)), UNITS[0], 1.0, r"rows has shape \(0, 4\)"),
        (schuler_row("gamma", [0.5, 0.7, 0.9]), UNITS[3], 1.0, "3 rows have rank 3 of 4; add measurements"),
        (
            schuler_row("mu", [0.5, 0.7, 0.9, 1.1]),
            UNITS[0],
            1.0,
            "not observable in component 0: 4 rows have rank 3",
        ),
        (np.zeros((3, 2)), [1, 0], 1.0, "rank 0 of 2"),
    ],
)
def test_bad_problems_are_reported(rows, target, sigmas, message):
    for solver in (solve, least_squares):
        with pytest.raises(ValueError, match=message):
            solver(rows, target, sigmas)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((0.0, 600.0, 30.0), "window_s is 0.0"),
        ((900.0, math.nan, 30.0), "ahead_s is nan"),
        ((900.0, 600.0, 0.0), "sigma_m is 0.0"),
    ],
)
def test_bad_dimensional_arguments_are_reported(arguments, message):
    with pytest.raises(ValueError, match=message):
        closed_form(*arguments)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((0.0, 0.1), "T is 0.0"),
        ((-1.0, 0.1), "T is -1.0"),
        ((math.nan, 0.1), "T is nan"),
        ((1.0, math.inf), "alpha is inf"),
        ((1.0, 0.1, -1.0), "sigma is -1.0"),
    ],
)
def test_bad_arguments_of_the_closed_form_are_reported(arguments, message):
    with pytest.raises(ValueError, match=message):
        closed_form_tau(*arguments)
    with pytest.raises(ValueError, match=r"'gamma' \(position\) or 'mu'"):
        schuler_row("phi", 0.0)
