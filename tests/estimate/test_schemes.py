"""Correction schemes: reference values, equivalence of all mixtures, nonlinear feedback."""

import json
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from companion.estimate.schemes import (
    FEEDFORWARD,
    FeedbackFractions,
    Plant,
    SchemeState,
    feed_back,
    step,
)

LINEAR = json.loads((Path(__file__).parents[1] / "data/schemes.json").read_text())["linear"]
F, G, A, Q, H, R, P0, X0, READ, Z, TRUTH = (
    np.array(LINEAR[k], float) for k in ("F", "G", "A", "Q", "H", "R", "P0", "X_ins0", "f_meas", "Z", "truth")
)
FEEDBACK = FeedbackFractions(1.0, 1.0)
PLANT = Plant(lambda X, u: F @ X + G @ u, lambda X, u: A, lambda X: X[:1], lambda X: H, Q, R)


def linear(feed):
    """Columns p, v, k1, k2 as estimated, for all steps."""
    state, rows = SchemeState(X0, np.zeros(4), P0, np.zeros(1)), []
    for f, z in zip(READ, Z, strict=True):
        state = step(state, np.array([f]), np.array([z]), PLANT, feed)
        rows.append([*state.corrected, *state.x[2:]])
    return np.array(rows)


def rms(position):
    return np.sqrt(np.mean((position - TRUTH[1:, 0]) ** 2))


@pytest.mark.parametrize(("name", "feed"), [("feedforward", FEEDFORWARD), ("feedback", FEEDBACK)])
def test_linear_reference(name, feed):
    shown = np.array(LINEAR["steps"]) - 1
    np.testing.assert_allclose(linear(feed)[shown], LINEAR[name], rtol=1e-12, atol=1e-10)


@settings(max_examples=25)
@given(st.floats(0, 1), st.floats(0, 1))
def test_every_mixture_is_informationally_equivalent(state, readings):
    np.testing.assert_allclose(
        linear(FeedbackFractions(state, readings)), linear(FEEDFORWARD), rtol=1e-12, atol=1e-10
    )


def test_estimate_must_be_reduced_with_the_ins():
    """The INS is corrected but the estimate keeps the part taken out: no alarm, 3.24 m instead of 3.05."""
    state, wrong = SchemeState(X0, np.zeros(4), P0, np.zeros(1)), []
    for f, z in zip(READ, Z, strict=True):
        state = step(state, np.array([f]), np.array([z]), PLANT)
        state = state._replace(X=state.X - state.x[:2])  # and x untouched
        wrong.append(state.X[0])
    assert rms(linear(FEEDBACK)[:, 0]) == pytest.approx(3.05, abs=0.005)
    assert rms(np.array(wrong)) == pytest.approx(3.24, abs=0.005)


def test_feed_back_keeps_the_solution():
    state = SchemeState(np.array([5.0, 6.0]), np.array([1.0, 2.0, 3.0, 4.0]), P0, np.zeros(1))
    after = feed_back(state, FeedbackFractions(0.25, 0.5))
    np.testing.assert_array_equal(after.corrected, state.corrected)
    assert after.beta == 1.5 and after.P is state.P


def test_fractions_outside_0_to_1_are_rejected():
    with pytest.raises(ValueError, match="readings"):
        FeedbackFractions(0.5, 1.5)
