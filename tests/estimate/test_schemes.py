"""Correction schemes: reference values, equivalence of all mixtures, nonlinear feedback."""

import json
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from companion.estimate.schemes import (
    FEEDBACK,
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


@settings(deadline=None, max_examples=25)
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


# A planar INS: position, velocity, heading; a gyro and two accelerometers with biases.

DT, SPEED = 0.1, 20.0


def turned(heading, f):
    c, s = np.cos(heading), np.sin(heading)
    return np.array([c * f[0] - s * f[1], s * f[0] + c * f[1]])


def mechanise(X, u):
    a = turned(X[4], u[1:])
    v = X[2:4]
    return np.concatenate([X[:2] + DT * v + DT**2 / 2 * a, v + DT * a, [X[4] + DT * u[0]]])


def transition(X, u):
    a = turned(X[4], u[1:])
    pull = np.column_stack([[-a[1], a[0]], turned(X[4], [1, 0]), turned(X[4], [0, 1])])
    A = np.eye(8)
    A[0, 2] = A[1, 3] = A[4, 5] = DT
    A[:2, [4, 6, 7]] = DT**2 / 2 * pull
    A[2:4, [4, 6, 7]] = DT * pull
    return A


def planar(gyro, accelerometer, feed, seed, scale=1.0):
    """Errors of position at the fixes, one a second for 300 s, 2 m; every error times `scale`."""
    rng = np.random.default_rng(seed)
    noise = scale * np.array([1e-3, 0.02, 0.02])
    Q = np.diag(np.concatenate([[0, 0], (DT * noise[1:]) ** 2, [(DT * noise[0]) ** 2], [0, 0, 0]]))
    H = np.zeros((2, 8))
    H[0, 0] = H[1, 1] = -1.0
    plant = Plant(mechanise, transition, lambda X: X[:2], lambda X: H, Q, (2 * scale) ** 2 * np.eye(2))
    biases = np.array([gyro, accelerometer, accelerometer])
    sigma = scale * np.concatenate([[2, 2, 0.2, 0.2, 0.02], biases])
    X = np.array([0, 0, SPEED, 0, 0.0])
    state = SchemeState(X + sigma[:5] * rng.standard_normal(5), np.zeros(8), np.diag(sigma**2), np.zeros(3))
    biases = scale * biases * rng.choice([-1, 1], 3)
    errors = []
    for k in range(1, 3001):
        w = 0.05 + 0.1 * np.sin(2 * np.pi * k * DT / 60)
        u = np.array([w, 0.5 * np.sin(2 * np.pi * k * DT / 30), SPEED * w])
        X = mechanise(X, u)
        fix = X[:2] + 2 * scale * rng.standard_normal(2) if k % 10 == 0 else None
        state = step(state, u + biases + noise * rng.standard_normal(3), fix, plant, feed)
        if fix is not None:
            errors.append(state.corrected[:2] - X[:2])
    return np.array(errors)


def test_jacobian_is_that_of_the_mechanisation():
    X, u, h = np.array([1.0, 2, 18, 7, 0.6]), np.array([0.1, 0.4, 2.0]), 1e-6
    A = transition(X, u)
    for i in range(8):
        d = h * np.eye(8)[i]
        slope = (mechanise(X + d[:5], u + d[5:]) - mechanise(X - d[:5], u - d[5:])) / (2 * h)
        np.testing.assert_allclose(A[:5, i], slope, atol=1e-8)


def test_coarse_sensors_need_feedback():
    """A MEMS gyro: with feedback the biases have no effect, without it the linearisation fails."""

    def error(gyro_deg, accelerometer, feed):
        square = [np.sum(planar(np.radians(gyro_deg), accelerometer, feed, s) ** 2, 1).mean() for s in (0, 1)]
        return np.sqrt(np.mean(square))

    fine = [error(0.1, 0.05, feed) for feed in (FEEDFORWARD, FEEDBACK)]
    coarse = [error(0.5, 0.2, feed) for feed in (FEEDFORWARD, FEEDBACK)]
    assert coarse[1] < 1.1 * fine[1] < 1.5
    assert fine[0] > 2 * fine[1] and coarse[0] > 40 * coarse[1]


def test_schemes_differ_by_the_square_of_the_errors():
    apart = [
        np.abs(
            planar(np.radians(0.1), 0.05, FEEDFORWARD, 1, s) - planar(np.radians(0.1), 0.05, FEEDBACK, 1, s)
        ).max()
        for s in (0.02, 0.04, 0.08)
    ]
    assert apart[1] / apart[0] == pytest.approx(4.0, rel=0.02)
    assert apart[2] / apart[1] == pytest.approx(4.0, rel=0.02)
