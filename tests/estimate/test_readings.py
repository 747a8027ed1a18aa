"""Correlated readings: partials by differences, agreement with independent observations, a law of large
samples."""

import math

import numpy as np
import pytest

from companion.estimate.fusion import Azimuth, Position, Range, maximum_likelihood
from companion.estimate.readings import Reading, axis_rows, error_covariance, estimate_joint, predict_readings

READINGS = (
    Reading("INS", "x", 99_950.0, 1500.0),
    Reading("INS", "y", 98_120.0, 1500.0),
    Reading("GNSS", "x", 99_012.0, 100.0),
    Reading("GNSS", "y", 98_731.0, 100.0),
    Reading("RSBN", "azimuth", math.radians(45.1), math.radians(0.25)),
    Reading("RSBN", "range", 139_950.0, 200.0),
)


def test_reference_of_independent_readings():
    # reference/ml_fusion.json, case 2
    found = estimate_joint(READINGS, error_covariance(READINGS))
    assert found.position == pytest.approx([99034.31197392425, 98744.9153659941], rel=1e-12)
    assert found.covariance[0] == pytest.approx([8831.55445231755, -862.418265232926], rel=1e-9)


def test_partials_against_differences():
    at = np.array([99_000.0, 98_000.0])
    H = predict_readings(READINGS, at)[1]
    for k in range(2):
        step = np.zeros(2)
        step[k] = 10.0
        ahead, behind = (predict_readings(READINGS, at + s)[0] for s in (step, -step))
        assert H[:, k] == pytest.approx((ahead - behind) / 20.0, rel=1e-6, abs=1e-12)


def test_correlated_coordinates_are_one_position_with_a_full_covariance():
    pairs = {("GNSS.x", "GNSS.y"): 0.7}
    found = estimate_joint(READINGS, error_covariance(READINGS, pairs))
    C = np.array([[1.0, 0.7], [0.7, 1.0]]) * 100.0**2
    independent = maximum_likelihood(
        [
            Position([99_950.0, 98_120.0], np.eye(2) * 1500.0**2),
            Position([99_012.0, 98_731.0], C),
            Azimuth([0.0, 0.0], math.radians(45.1), math.radians(0.25)),
            Range([0.0, 0.0], 139_950.0, 200.0),
        ]
    )
    assert found.position == pytest.approx(independent.position, rel=1e-10)
    assert found.covariance == pytest.approx(independent.covariance, rel=1e-7)


def test_errors_of_correlated_readings_are_as_claimed():
    pairs = {("INS.x", "GNSS.x"): 0.8, ("GNSS.y", "RSBN.range"): -0.5}
    R = error_covariance(READINGS, pairs)
    truth = np.array([99_000.0, 98_700.0])
    h = predict_readings(READINGS, truth)[0]
    noise = np.random.default_rng(1).multivariate_normal(np.zeros(6), R, size=400)
    nees = []
    for e in noise:
        read = [r._replace(value=float(v)) for r, v in zip(READINGS, h + e, strict=True)]
        found = estimate_joint(read, R)
        d = found.position - truth
        nees.append(float(d @ np.linalg.solve(found.covariance, d)))
    assert np.mean(nees) == pytest.approx(2.0, abs=0.3)  # three standard errors of the mean of 400


def test_correlations_that_cannot_occur_together():
    pairs = {("INS.x", "GNSS.x"): 0.9, ("GNSS.x", "GNSS.y"): 0.9, ("INS.x", "GNSS.y"): -0.9}
    with pytest.raises(ValueError, match="cannot occur together"):
        error_covariance(READINGS, pairs)


def test_without_readings_there_is_nothing_to_estimate():
    R = error_covariance([])
    assert R.shape == (0, 0)
    assert axis_rows([], "x").T.shape == (0, 0)
    with pytest.raises(ValueError, match="no observations"):
        estimate_joint([], R)
