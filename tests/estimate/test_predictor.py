"""Rolling window: an immutable value whose bounds in metres are those of the theory."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from companion.estimate.minimax import closed_form
from companion.estimate.minimax_lp import solve
from companion.estimate.predictor import TARGETS, Window, predict, predict_ahead
from companion.estimate.schuler import ARCSECOND, DEG_PER_HOUR, Scale, schuler_row, transition

SECOND = 1_000_000_000
START = 1_700_000_000 * SECOND  # a clock that counts from 1970 costs no digits
SCALE = Scale(6_371_000.0, 1.2387e-3)
FIFTEEN_MINUTES = Window.of(START + np.arange(901) * SECOND, "position", np.zeros(901), 30.0)


def motion(seconds, start=(0.0, 0.0, 0.0, 0.0)):
    """Errors in SI of a channel that starts with gamma, phi, mu, vartheta: (n, 4) of m, rad, m/s, rad/s."""
    state = np.array([transition(t * SCALE.rate) @ start for t in np.atleast_1d(seconds)])
    return state * SCALE.units


@pytest.mark.parametrize(
    ("minutes", "position", "velocity", "tilt"),
    [(5, 391.731747, 1.90645543, 109.928437), (20, 4558.45109, 7.44174283, None)],
)
def test_bounds_in_metres_and_arcseconds(minutes, position, velocity, tilt):
    grid = 4.03 / 900**2  # a fix a second against the continuous optimum
    p = predict(FIFTEEN_MINUTES, START + (900 + 60 * minutes) * SECOND, TARGETS, scale=SCALE)
    assert p.feasible and p.reason == ""
    assert p.position.bound == pytest.approx(position, rel=grid)
    assert p.velocity.bound == pytest.approx(velocity, rel=grid)
    assert tilt is None or p.tilt.bound / ARCSECOND == pytest.approx(tilt, rel=grid)
    assert p.drift.bound / DEG_PER_HOUR == pytest.approx(0.163481305, rel=grid)
    assert all(abs(f.gap) < 1e-9 for f in (p.position, p.velocity, p.tilt, p.drift))


def test_least_squares_is_reported_for_comparison():
    forecast = predict(FIFTEEN_MINUTES, START + 1500 * SECOND, scale=SCALE).position
    assert forecast.ls_claimed == pytest.approx(70.7, abs=0.05)
    assert forecast.ls_worst == pytest.approx(1786.5, abs=0.05)
    assert forecast.ls_claimed < forecast.bound < forecast.ls_worst


@settings(max_examples=50, deadline=None)
@given(
    seed=st.integers(0, 2**32 - 1),
    ahead=st.floats(0.0, 7200.0),
    mix=st.sampled_from([("position",), ("position", "velocity"), ("velocity", "position", "position")]),
)
def test_a_channel_without_noise_is_predicted_exactly(seed, ahead, mix):
    rng = np.random.default_rng(seed)
    start = rng.normal(size=4) * (1e-4, 1e-5, 1e-4, 1e-5)
    window = Window(span=1e5)
    times = np.cumsum(rng.integers(10 * SECOND, 60 * SECOND, 60))
    for i, t in enumerate(times.tolist()):
        position, _, velocity, _ = motion(t / SECOND, start)[0]
        value, sigma = (position, 30.0) if (what := mix[i % len(mix)]) == "position" else (velocity, 0.3)
        window = window.push(t, what, value, sigma)
    t = int(times[-1]) + round(ahead * SECOND)
    p = predict(window, t, TARGETS, scale=SCALE)
    truth = dict(zip(TARGETS, motion(t / SECOND, start)[0], strict=True))
    for target in TARGETS:
        forecast = getattr(p, target)
        assert forecast.estimate == pytest.approx(truth[target], abs=1e-8 * forecast.bound)
        assert forecast.ls_estimate == pytest.approx(truth[target], abs=1e-8 * forecast.bound)


@settings(max_examples=100, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), ahead=st.floats(0.0, 3600.0))
def test_errors_within_sigma_stay_within_the_bound(seed, ahead):
    """Where |rho| <= sigma for certain, |error| <= bound for certain."""
    rng = np.random.default_rng(seed)
    t = np.arange(0, 900, 15) * SECOND
    rho = 30.0 * np.clip(np.cumsum(rng.normal(size=len(t))) * rng.uniform(0, 1), -1.0, 1.0)
    start = rng.normal(size=4) * 1e-4
    window = Window.of(t, "position", motion(t / SECOND, start)[:, 0] + rho, 30.0)
    then = int(t[-1]) + round(ahead * SECOND)
    forecast = predict(window, then, scale=SCALE).position
    assert abs(forecast.estimate - motion(then / SECOND, start)[0, 0]) <= forecast.bound * (1.0 + 1e-9)


def test_active_fixes_determine_the_bound():
    forecast = predict(FIFTEEN_MINUTES, START + 1500 * SECOND, scale=SCALE).position
    chi = closed_form(900.0, 600.0, 30.0, SCALE).times
    seconds = np.array([t - START for t, _ in forecast.active]) / SECOND
    assert np.abs(seconds - chi).max() <= 1.0
    rows = schuler_row("gamma", (1500.0 - seconds) * SCALE.rate)
    alone = solve(rows, [1, 0, 0, 0], 30.0)
    assert alone.bound == pytest.approx(forecast.bound, rel=1e-9)


def test_horizons_in_a_row_equal_horizons_one_by_one():
    then = [START + (900 + 60 * k) * SECOND for k in range(0, 61, 5)]
    row = predict_ahead(FIFTEEN_MINUTES, then, TARGETS)
    for t, p in zip(then, row, strict=True):
        alone = predict(FIFTEEN_MINUTES, t, TARGETS)
        assert p.t_ns == alone.t_ns == t
        for target in TARGETS:
            assert getattr(p, target).bound == pytest.approx(getattr(alone, target).bound, rel=1e-11)
    assert predict_ahead(FIFTEEN_MINUTES, []) == []


def test_start_from_another_window_does_not_change_the_result():
    velocities = Window.of(START + np.arange(500) * SECOND, "velocity", np.zeros(500), 0.1)
    other = predict(velocities, START + 600 * SECOND, ("velocity",))
    then = START + 1200 * SECOND
    started = predict(FIFTEEN_MINUTES, then, ("velocity", "drift"), start=other)
    assert started.velocity.bound == pytest.approx(predict(FIFTEEN_MINUTES, then).velocity.bound, rel=1e-11)


# Flagged, not raised


def test_too_few_fixes_are_not_feasible():
    empty = predict(Window(), START, TARGETS)
    assert not empty.feasible and empty.reason == "no fixes in the window"
    window = Window()
    for k in range(4):
        p = predict(window, START + 100 * SECOND)
        assert not p.feasible and p.reason
        assert math.isnan(p.position.estimate) and p.position.bound == math.inf and not p.position.feasible
        window = window.push(START + 20 * k * SECOND, "position", 1.0, 30.0)
    assert predict(window, START + 100 * SECOND).feasible


def test_velocities_determine_all_but_position():
    window = Window.of(START + np.arange(600) * SECOND, "velocity", np.zeros(600), 0.3)
    p = predict(window, START + 900 * SECOND, TARGETS)
    assert not p.feasible
    assert p.reason == "position not observable: 600 fixes determine 3 of 4 unknowns"
    assert [getattr(p, target).feasible for target in TARGETS] == [False, True, True, True]
    assert predict(window, START + 900 * SECOND, ("velocity", "tilt")).feasible


# The window


def test_push_does_not_change_the_old_window():
    old = Window().push(START, "position", 5.0, 30.0)
    new = old.push(START + SECOND, "velocity", 0.1, 0.3)
    assert (len(old), len(new)) == (1, 2)
    for window in (old, new, FIFTEEN_MINUTES):
        for array in (window.t_ns, window.velocity, window.value, window.sigma):
            with pytest.raises(ValueError, match="read-only"):
                array[0] = 0
    with pytest.raises(AttributeError):
        old.span = 1.0


@settings(max_examples=30, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), capacity=st.integers(8, 60), velocity_every=st.integers(1, 5))
def test_window_keeps_the_longest_stretch_and_its_ends(seed, capacity, velocity_every):
    rng = np.random.default_rng(seed)
    window, t = Window(span=300.0, capacity=capacity), 0
    for k in range(250):
        t += int(rng.integers(1, 3)) * SECOND
        window = window.push(t, "position", float(k), 30.0)
        if k % velocity_every == 0:
            window = window.push(t, "velocity", float(k), 0.3)
        assert len(window) <= capacity
        assert window.t_ns[-1] == t and t - window.t_ns[0] <= 300 * SECOND
    assert (np.diff(window.t_ns) >= 0).all()
    holes = np.diff(window.t_ns[~window.velocity]) / SECOND
    assert t - window.t_ns[0] >= 0.5 * 300 * SECOND
    assert holes.max() <= 4.0 * max(np.median(holes), 2.0)


def test_thinning_hardly_changes_the_bound():
    """1 h of fixes a second apart, thinned to 300: the bound hardly moves."""
    full = Window.of(np.arange(3600) * SECOND, "position", np.zeros(3600), 30.0, capacity=3600)
    thin = Window.of(np.arange(3600) * SECOND, "position", np.zeros(3600), 30.0, capacity=300)
    assert (len(thin), thin.t_ns[0], thin.t_ns[-1]) == (300, 0, 3599 * SECOND)
    bounds = [predict(w, 4800 * SECOND).position.bound for w in (full, thin)]
    assert bounds[0] <= bounds[1] <= 1.001 * bounds[0]


@pytest.mark.parametrize(
    ("fix", "message"),
    [
        ((START - 1, "position", 0.0, 30.0), r"fix 1 is at .* before the last"),
        ((START, "position", 0.0, 30.0), "fix 1 repeats the position"),
        ((START + 1, "position", math.nan, 30.0), "fix 1: value nan"),
        ((START + 1, "position", 0.0, -30.0), "sigma -30.0"),
        ((START + 1, "position", 0.0, 0.0), "sigma 0.0"),
        ((START + 1, "height", 0.0, 30.0), "'height'; give 'position' or 'velocity'"),
    ],
)
def test_bad_fixes_are_reported(fix, message):
    with pytest.raises(ValueError, match=message):
        Window().push(START, "position", 0.0, 30.0).push(*fix)


def test_bad_windows_are_reported():
    with pytest.raises(ValueError, match=r"t_ns\[2\] does not follow t_ns\[1\]"):
        Window.of([0, 5, 5, 7], "position", np.zeros(4), 1.0)
    with pytest.raises(ValueError, match=r"t_ns\[1\] does not follow"):
        Window.of([3, 1, 5], "position", np.zeros(3), 1.0)
    with pytest.raises(ValueError, match="fix 1: value nan"):
        Window.of([0, 1, 2], "position", [0.0, math.nan, 0.0], 1.0)
    with pytest.raises(ValueError, match=r"fix 2: value 0\.0, sigma -1\.0"):
        Window.of([0, 1, 2], "position", np.zeros(3), [1.0, 1.0, -1.0])
    with pytest.raises(ValueError, match="span is -1"):
        Window(span=-1.0)
    with pytest.raises(ValueError, match="capacity is 3"):
        Window(capacity=3)
    with pytest.raises(ValueError, match="target 'height' is unknown"):
        predict(FIFTEEN_MINUTES, START, ("height",))
