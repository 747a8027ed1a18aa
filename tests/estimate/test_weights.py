"""The paper's worked example, every reading of it, and the laws of wrong weights."""

import math

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from companion.estimate.fusion import Azimuth, Position, Range, maximum_likelihood
from companion.estimate.weights import (
    estimate_axis,
    estimate_covariance,
    excess_covariance,
    optimal_gain,
    perturb_weight,
    relative_bias,
    rms_ratio,
    rms_ratio_assuming,
    rsbn_row,
)

R = [500.0, 10.0, 200.0]  # INS, GNSS, RSBN as printed
X, Y, D, A = [105.0, 101.0], [103.0, 100.5], 140.0, math.radians(45.0)

variances = st.lists(st.floats(0.01, 1e4), min_size=2, max_size=6)


def printed(z_I, z_C, z_P, I, C, P, s):
    """The paper's scalar formula with the third numerator as it must be, I C, and one denominator."""
    total = C * P * s + I * P * s + I * C
    return (C * P * s * z_I + I * P * s * z_C + I * C * z_P) / total


class TestWorkedExample:
    """Printed: X = 101.139, Y = 100. Variances 500, 10, 200; D = 140 km, A = 45 deg."""

    def test_the_correct_estimator_gives_neither(self):
        # entries of R are variances, z_P = D sin A (D cos A), all gains 1
        x, y = estimate_axis([*X, D * math.sin(A)], R), estimate_axis([*Y, D * math.cos(A)], R)
        assert x.value == pytest.approx(100.981072400285825, rel=1e-14)
        assert y.value == pytest.approx(100.476399503089563, rel=1e-14)
        assert x.variance == pytest.approx(9.34579439252336, rel=1e-14)
        assert x.weights == pytest.approx(
            [0.0186915887850467, 0.934579439252336, 0.0467289719626168], rel=1e-14
        )

    def test_printed_x_takes_r_for_deviations_and_the_slant_range_for_x(self):
        # R's entries squared once more (read as deviations) and z_P = D with the printed sin A for a gain
        I, C, P = (v * v for v in R)
        assert printed(*X, D, I, C, P, math.sin(A)) == pytest.approx(101.13893902309513, rel=1e-14)
        # Not the only way to 101.139: the third term's own, misprinted, denominator rounds to it as well
        s = math.sin(A)
        total, third = C * P * s + I * P * s + I * C, C * P * s + I * P * s + I * C * s
        other = (C * P * s * X[0] + I * P * s * X[1]) / total + I * C * D / third
        assert other == pytest.approx(101.13944810060137, rel=1e-14)

    def test_printed_y_cannot_be_reproduced(self):
        squared = [v * v for v in R]
        c = math.cos(A)
        readings = {
            estimate_axis([*Y, D * c], R).value,
            estimate_axis([*Y, D * c], squared).value,
            estimate_axis([*Y, D], R, [1.0, 1.0, 1.0 / c]).value,
            estimate_axis([*Y, D], squared, [1.0, 1.0, 1.0 / c]).value,
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

    def test_the_corrected_gain_is_one_over_the_sine(self):
        row = rsbn_row(D, A, math.sqrt(200.0), 0.0, "x")
        fix = estimate_axis([*X, D], [500.0, 10.0, row.claimed], [1.0, 1.0, row.gain])
        assert fix.value == pytest.approx(100.89240619340327, rel=1e-13)
        assert math.sqrt(fix.variance) == pytest.approx(2.98807152334, rel=1e-11)

    def test_the_joint_estimator_agrees_with_the_scalar_one_where_rsbn_is_isotropic(self):
        # sigma_D = D sigma_A makes the converted measurement's errors equal and uncorrelated
        positions = [Position([X[i], Y[i]], np.eye(2) * R[i]) for i in (0, 1)]
        s = math.sqrt(200.0)
        joint = maximum_likelihood([*positions, Azimuth([0, 0], A, s / D), Range([0, 0], D, s)])
        scalar = [
            estimate_axis([*X, D * math.sin(A)], R).value,
            estimate_axis([*Y, D * math.cos(A)], R).value,
        ]
        np.testing.assert_allclose(joint.position, scalar, atol=5e-4)


class TestSingularAzimuths:
    def test_the_scalar_row_claims_3_metres_and_errs_by_610(self):
        row = rsbn_row(140e3, math.radians(1.0), 200.0, math.radians(0.25), "x")
        assert math.sqrt(row.claimed) / row.gain == pytest.approx(3.49, abs=0.005)
        assert math.sqrt(row.actual) / row.gain == pytest.approx(610.78, abs=0.005)
        fix = estimate_axis([0.0, 0.0, 0.0], [1500.0**2, 100.0**2, row.claimed], [1.0, 1.0, row.gain])
        actual = estimate_covariance([fix.weights], np.diag([1500.0**2, 100.0**2, row.actual]))[0, 0]
        assert math.sqrt(fix.variance) < 3.5
        assert math.sqrt(actual) > 600.0

    @pytest.mark.parametrize(("axis", "A_deg"), [("x", 0.0), ("x", 180.0), ("y", 90.0), ("y", 270.0)])
    def test_there_is_no_row_at_the_singular_azimuth_itself(self, axis, A_deg):
        with pytest.raises(ValueError, match=f"does not measure {axis}.*joint estimator"):
            rsbn_row(140e3, math.radians(A_deg), 200.0, 0.004, axis)


class TestSensitivity:
    def test_the_papers_variances(self):
        assert rms_ratio_assuming([500.0, 100.0, 200.0], R) == pytest.approx(1.72103, abs=5e-6)
        assert rms_ratio_assuming([500.0, 10.0, 20.0], R) == pytest.approx(1.66973, abs=5e-6)

    @settings(max_examples=80)
    @given(r=variances, eps=st.floats(-2.0, 2.0), data=st.data())
    def test_one_weight_changed(self, r, eps, data):
        w = estimate_axis(np.zeros(len(r)), r).weights
        i = data.draw(st.integers(0, len(r) - 1))
        new = perturb_weight(w, i, eps)
        assert new.sum() == pytest.approx(1.0, abs=1e-9)
        rest = 1.0 - w[i] if w[i] < 0.5 else np.delete(w, i).sum()
        assert rms_ratio(new, r) == pytest.approx(math.sqrt(1.0 + eps**2 * w[i] / rest), rel=1e-8)

    @settings(max_examples=80)
    @given(r=variances, seed=st.integers(0, 2**32 - 1))
    def test_any_weights_of_sum_one(self, r, seed):
        r = np.array(r)
        best = estimate_axis(np.zeros(len(r)), r)
        w = np.random.default_rng(seed).normal(size=len(r))
        w += (1.0 - w.sum()) / len(r)
        law = best.variance + float(r @ (w - best.weights) ** 2)
        assert float(r @ w**2) == pytest.approx(law, rel=1e-9)

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
        if np.abs(relative_bias(K, H)).max() < 1e-10:
            P = estimate_covariance(K, R)
            np.testing.assert_allclose(
                P,
                estimate_covariance(K_opt, R) + excess_covariance(K, H, R),
                rtol=1e-7,
                atol=1e-8 * np.abs(P).max(),
            )

    def test_weights_that_do_not_add_up_to_one_are_biased(self):
        w = estimate_axis(np.zeros(3), R).weights
        w[1] *= 1.01
        H = np.ones((3, 1))
        assert 100.0 * relative_bias([w], H)[0, 0] == pytest.approx(
            0.934579439252336, rel=1e-9
        )  # km at 100 km
        with pytest.raises(ValueError, match="biased"):
            excess_covariance([w], H, np.diag(R))


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: estimate_axis([1.0, 2.0], [1.0]), "one length"),
        (lambda: estimate_axis([1.0, 2.0], [1.0, -1.0]), "variances must be positive"),
        (lambda: estimate_axis([1.0, math.nan], [1.0, 1.0]), "finite"),
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
