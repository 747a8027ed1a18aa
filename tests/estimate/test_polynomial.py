"""Order selection: reference values, unbiasedness, and smoothing of an unknown track."""

from __future__ import annotations

import json
import math
import pathlib
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from companion.estimate.polynomial import FAMILIES, orthonormal_basis, select_order, smooth_track

DATA = json.loads((pathlib.Path(__file__).parents[1] / "data/map_and_order.json").read_text())["order"]
T = np.linspace(0.0, 10.0, 101)
SIGMA = 0.2 * (1.0 + 0.05 * T)


@pytest.mark.parametrize("signal", ["cubic", "osc"])
@pytest.mark.parametrize("basis", FAMILIES)
def test_reference_values(signal: str, basis: Any) -> None:
    reference = DATA["results"][signal][basis]
    found = select_order(T, DATA["z"][signal], SIGMA, basis, 12)
    assert found.order == reference["r_J"]
    # the reference made its power basis of t^m, which costs it five digits more than (2u - 1)^m
    digits = 1e-7 if basis == "power" else 1e-10
    np.testing.assert_allclose(found.criterion, reference["J"], atol=digits)
    np.testing.assert_allclose(found.coefficients, reference["alpha_at_rJ"], atol=digits)


def test_a_cubic_has_four_terms_and_not_nine() -> None:
    reference = DATA["results"]["cubic"]["power"]
    assert reference["r_simple"] == 9
    found = select_order(T, DATA["z"]["cubic"], SIGMA, "power", 12)
    assert found.order == 4
    assert found.spans


def test_signal_outside_the_span_shows_in_the_residuals() -> None:
    # a wave between the functions of the basis: the criterion is content, the residuals are not
    z = np.sin(10.0 * T) * 3.0 * SIGMA + DATA["z"]["cubic"]
    found = select_order(T, z, SIGMA, "legendre", 8)
    assert found.order < 8
    assert not found.spans
    assert found.consistency > 3.0


@pytest.mark.parametrize("basis", FAMILIES)
def test_the_basis_is_orthonormal_with_the_weight(basis: Any) -> None:
    functions = orthonormal_basis(T, SIGMA, basis, 9)
    fine = np.linspace(0.0, 10.0, 200_001)
    Psi = functions(fine) / np.interp(fine, T, SIGMA)[:, None]
    inner = np.trapezoid(Psi[:, :, None] * Psi[:, None, :], fine, axis=0)
    np.testing.assert_allclose(inner, np.eye(9), atol=1e-6)


@settings(max_examples=40)
@given(st.integers(0, 10**6), st.integers(13, 200), st.floats(1e-3, 1e3), st.floats(-1e6, 1e6))
def test_result_is_independent_of_units_and_origins(
    seed: int, count: int, unit: float, origin: float
) -> None:
    rng = np.random.default_rng(seed)
    t = np.linspace(0.0, 1.0, count) + rng.uniform(0.0, 0.3 / count, count)
    z = np.polynomial.polynomial.polyval(t, rng.standard_normal(3)) + 0.1 * rng.standard_normal(count)
    one = select_order(t, z, 0.1, "legendre", 6)
    other = select_order(origin + 8.0 * t, unit * z, 0.1 * unit, "legendre", 6)
    assert one.order == other.order
    tolerance = 1e-6 * unit
    np.testing.assert_allclose(unit * one.at(t).x, other.at(origin + 8.0 * t).x, atol=tolerance)
    assert one.consistency == pytest.approx(other.consistency, rel=1e-6)


@settings(max_examples=40)
@given(st.integers(0, 10**6))
def test_power_and_legendre_are_one_basis(seed: int) -> None:
    rng = np.random.default_rng(seed)
    z = rng.standard_normal(len(T))
    power, legendre = (select_order(T, z, SIGMA, basis, 9) for basis in ("power", "legendre"))
    np.testing.assert_allclose(power.criterion, legendre.criterion, rtol=1e-7, atol=1e-7)
    np.testing.assert_allclose(power.at(T).x, legendre.at(T).x, atol=1e-9)


def test_the_criterion_is_unbiased_for_the_weighted_squared_error() -> None:
    rng = np.random.default_rng(5)
    truth = np.sin(2 * np.pi * T / 10) + 0.3 * np.cos(4 * np.pi * T / 10)
    fine = np.linspace(0.0, 10.0, 2001)
    exact = np.sin(2 * np.pi * fine / 10) + 0.3 * np.cos(4 * np.pi * fine / 10)
    weight = np.interp(fine, T, SIGMA) ** -2
    runs = 400
    promised, true = np.zeros((runs, 7)), np.zeros((runs, 7))
    for run in range(runs):
        z = truth + SIGMA * rng.standard_normal(len(T))
        found = select_order(T, z, SIGMA, "fourier", 7)
        promised[run] = found.criterion
        Psi, at = found.basis(T) / SIGMA[:, None], found.basis(fine)
        for r in range(1, 8):
            a = np.linalg.lstsq(Psi[:, :r], z / SIGMA, rcond=None)[0]
            true[run, r - 1] = np.trapezoid(weight * (at[:, :r] @ a - exact) ** 2, fine)
    difference = promised - true
    error = difference.std(0) / math.sqrt(runs)
    assert (abs(difference.mean(0)) < 4.0 * error + 1e-3).all()


def test_the_claimed_sigma_is_the_spread() -> None:
    rng = np.random.default_rng(2)
    truth = 1.0 + 0.5 * T
    errors = []
    for _ in range(300):
        z = truth + SIGMA * rng.standard_normal(len(T))
        found = select_order(T, z, SIGMA, "legendre", 2)
        errors.append(((found.at(T).x - truth) / found.at(T).sigma)[::20])
    assert 0.9 < np.mean(np.square(errors)) < 1.1


def test_an_unknown_track_is_smoothed_without_joints() -> None:
    rng = np.random.default_rng(1)
    t = np.arange(0.0, 600.0, 0.5)
    truth = 300.0 * np.sin(t / 20.0) + 50.0 * np.cos(t / 7.0) + t
    found = smooth_track(t, truth + 3.0 * rng.standard_normal(truth.shape), 3.0)
    rms = np.sqrt(np.mean((found.x - truth) ** 2))
    assert rms < 1.0
    assert found.windows > 2
    assert 0.9 < found.consistency < 1.15
    assert abs(np.diff(found.x, 2)).max() < 3.0 * abs(np.diff(truth, 2)).max() + 0.1


def test_a_track_with_a_gap_is_cut_as_far_as_its_samples_allow() -> None:
    """Of two windows the second would have two samples, a gap, and fifty in its last eighth."""
    rng = np.random.default_rng(1)
    t = np.arange(0.0, 160.0, 0.2)
    t = t[(t < 80.3) | (t > 150.0)]
    truth = 50.0 * np.sin(t / 3.0)
    found = smooth_track(t, truth + rng.standard_normal(truth.shape), 1.0, r_max=12)
    assert found.windows == 1
    assert np.isfinite(found.x).all() and found.consistency > 2.0


def test_a_track_whose_samples_in_a_window_are_of_one_time_is_cut_no_further() -> None:
    rng = np.random.default_rng(1)
    t = np.concatenate((np.linspace(0.0, 10.0, 100), np.full(40, 15.0), np.linspace(20.0, 30.0, 100)))
    truth = 50.0 * np.sin(3.0 * t)
    found = smooth_track(t, truth + rng.standard_normal(t.shape), 1.0)
    assert found.windows == 2
    assert np.isfinite(found.x).all() and found.consistency > 2.0


def test_a_simple_track_takes_one_window() -> None:
    rng = np.random.default_rng(1)
    t = np.arange(0.0, 60.0)
    truth = 10.0 + 3.0 * t + 0.01 * t**2
    found = smooth_track(t, truth + rng.standard_normal(truth.shape), 1.0)
    assert found.windows == 1
    assert np.sqrt(np.mean((found.x - truth) ** 2)) < 0.35


@pytest.mark.parametrize(
    ("t", "z", "sigma", "basis", "r_max", "message"),
    [
        ([0, 1, 2], [1, 2, 3], 1.0, "spline", 2, "unknown basis 'spline'"),
        ([0, 1, 2], [1, 2], 1.0, "power", 2, "do not fit"),
        ([0, 1, 2], [1, 2, 3], 1.0, "power", 3, "r_max is 3 for 3 samples"),
        ([0, 2, 1], [1, 2, 3], 1.0, "power", 2, "the times are not increasing"),
        ([7, 7, 7], [1, 2, 3], 1.0, "power", 2, "all samples are of one time, 7 s"),
        ([0, 1, 2], [1, 2, math.nan], 1.0, "power", 2, "not finite"),
        ([0, 1, 2], [1, 2, 3], 0.0, "power", 2, "must be positive"),
        ([0, 1, 1e300], [1, 2, 3], 1.0, "power", 2, r"t is 1e\+300 somewhere"),
        ([0, 1, 2], [1, 1e300, 3], 1.0, "power", 2, r"z is 1e\+300 somewhere"),
        ([0, 1, 2], [1, -1e60, 3], 1e-60, "power", 2, r"z / sigma is -1e\+120 somewhere"),
        ([0, 1, 2], [1, 2, 3], [1.0, 1e300, 1.0], "power", 2, r"sigma is 1e\+300 somewhere"),
        ([0, 1, 2], [0, 0, 0], 1e-300, "power", 2, r"1 / sigma is 1e\+300 somewhere"),
        ([0, 1, 2], [1, 1, 1], 5e-324, "power", 2, "1 / sigma is inf somewhere"),
        (np.arange(50.0), np.arange(50.0), 1.0, "power", 45, "take fewer"),
        ([0, 1e-5, 2e-5, 3e-5, 10], [1, 2, 3, 4, 5], 1.0, "legendre", 4, "do not distinguish 4 functions"),
    ],
)
def test_bad_input_is_reported(t: Any, z: Any, sigma: Any, basis: Any, r_max: int, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        select_order(t, z, sigma, basis, r_max)
