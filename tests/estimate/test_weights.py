"""The paper's scalar form and its misprints; the exact laws of coefficients that are not the best."""

import math

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from companion.estimate.weights import estimate_covariance, optimal_gain, perturb_weight

R = [500.0, 10.0, 200.0]  # INS, GNSS, RSBN as printed
X, Y, D, A = [105.0, 101.0], [103.0, 100.5], 140.0, math.radians(45.0)

variances = st.lists(st.floats(0.01, 1e4), min_size=2, max_size=6)


def axis_weights(r, gains=None):
    """Best weights (m,) of readings of one coordinate, each `gains` times it, with variances r."""
    h = np.ones(len(r)) if gains is None else np.array(gains)
    return optimal_gain(h[:, None], np.diag(r))[0]


def printed(z_I, z_C, z_P, I, C, P, s):
    """The paper's scalar formula with the third numerator as it must be, I C, and one denominator."""
    total = C * P * s + I * P * s + I * C
    return (C * P * s * z_I + I * P * s * z_C + I * C * z_P) / total


class TestWorkedExample:
    """Printed: X = 101.139, Y = 100. Variances 500, 10, 200; D = 140 km, A = 45 deg."""

    def test_the_correct_estimator_gives_neither(self):
        # entries of R are variances, z_P = D sin A (D cos A), all gains 1
        w = axis_weights(R)
        assert w == pytest.approx([0.0186915887850467, 0.934579439252336, 0.0467289719626168], rel=1e-14)
        assert w @ [*X, D * math.sin(A)] == pytest.approx(100.981072400285825, rel=1e-14)
        assert w @ [*Y, D * math.cos(A)] == pytest.approx(100.476399503089563, rel=1e-14)
        assert estimate_covariance([w], np.diag(R))[0, 0] == pytest.approx(9.34579439252336, rel=1e-14)

    def test_printed_x_has_more_than_one_origin(self):
        # R's entries squared once more (read as deviations) and z_P = D with the printed sin A for a gain
        I, C, P = (v * v for v in R)
        s = math.sin(A)
        assert printed(*X, D, I, C, P, s) == pytest.approx(101.13893902309513, rel=1e-14)
        # the third term's own, misprinted, denominator rounds to it as well
        total, third = C * P * s + I * P * s + I * C, C * P * s + I * P * s + I * C * s
        other = (C * P * s * X[0] + I * P * s * X[1]) / total + I * C * D / third
        assert other == pytest.approx(101.13944810060137, rel=1e-14)

    def test_printed_y_cannot_be_reproduced(self):
        squared = [v * v for v in R]
        c = math.cos(A)
        across = [1.0, 1.0, 1.0 / c]
        readings = {
            *(float(axis_weights(r) @ [*Y, D * c]) for r in (R, squared)),
            *(float(axis_weights(r, across) @ [*Y, D]) for r in (R, squared)),
            printed(*Y, D, *R, c),
            printed(*Y, D, *squared, c),
            printed(*Y, D * c, *squared, c),
        }
        assert min(abs(y - 100.0) for y in readings) > 0.4

    def test_the_third_numerator_as_printed_is_not_a_mean(self):
        I, C, P, s = *R, math.sin(A)
        total = C * P * s + I * P * s + I * C
        weights = np.array([C * P * s, I * P * s, I * P * s]) / total  # printed: I P sin A twice
        assert weights.sum() > 1.8
        assert weights @ [*X, D] > 200.0


class TestSensitivity:
    @settings(max_examples=80)
    @given(r=variances, eps=st.floats(-2.0, 2.0), data=st.data())
    def test_one_weight_changed(self, r, eps, data):
        w = axis_weights(r)
        i = data.draw(st.integers(0, len(r) - 1))
        new = perturb_weight(w, i, eps)
        assert new.sum() == pytest.approx(1.0, abs=1e-9)
        least, actual = (estimate_covariance([k], np.diag(r))[0, 0] for k in (w, new))
        rest = 1.0 - w[i] if w[i] < 0.5 else np.delete(w, i).sum()
        assert math.sqrt(actual / least) == pytest.approx(math.sqrt(1.0 + eps**2 * w[i] / rest), rel=1e-8)

    @settings(max_examples=80)
    @given(r=variances, seed=st.integers(0, 2**32 - 1))
    def test_any_weights_of_sum_one(self, r, seed):
        best = axis_weights(r)
        w = np.random.default_rng(seed).normal(size=len(r))
        w += (1.0 - w.sum()) / len(r)
        least, actual = (estimate_covariance([k], np.diag(r))[0, 0] for k in (best, w))
        assert actual == pytest.approx(least + float(r @ (w - best) ** 2), rel=1e-9)

    @settings(max_examples=80)
    @given(n=st.integers(1, 4), extra=st.integers(0, 4), seed=st.integers(0, 2**32 - 1))
    def test_the_matrix_form(self, n, extra, seed):
        rng = np.random.default_rng(seed)
        m = n + extra
        H, S = rng.normal(size=(m, n)), rng.normal(size=(m, m))
        R = S @ S.T + np.eye(m)
        K_opt = optimal_gain(H, R)
        F = H.T @ np.linalg.solve(R, H)
        assume(np.linalg.cond(F) < 1e7)  # rounding is that much larger than eps
        np.testing.assert_allclose(F @ estimate_covariance(K_opt, R), np.eye(n), atol=1e-7)
        # any K with K H = I: add what H does not see
        K = K_opt + rng.normal(size=(n, m)) @ (np.eye(m) - H @ np.linalg.pinv(H))
        if np.abs(K @ H - np.eye(n)).max() < 1e-10:
            P = estimate_covariance(K, R)
            np.testing.assert_allclose(
                P,
                estimate_covariance(K_opt, R) + estimate_covariance(K - K_opt, R),
                rtol=1e-7,
                atol=1e-8 * np.abs(P).max(),
            )

    def test_weights_that_do_not_add_up_to_one_are_biased(self):
        w = axis_weights(R)
        w[1] *= 1.01
        truth = 100.0  # km
        assert w @ np.full(3, truth) - truth == pytest.approx(0.934579439252336, rel=1e-9)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: optimal_gain(np.ones((2, 1)), np.eye(3)), "shape"),
        (lambda: optimal_gain(np.full((2, 1), math.nan), np.eye(2)), "finite"),
        (lambda: optimal_gain(np.ones((2, 1)), -np.eye(2)), "positive definite"),
        (lambda: optimal_gain(np.ones((3, 2)), np.eye(3)), "does not determine"),
        (lambda: perturb_weight([1.0], 0, 0.1), "only one"),
    ],
)
def test_bad_input_is_rejected(call, message):
    with pytest.raises(ValueError, match=message):
        call()
