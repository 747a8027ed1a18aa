"""`companion study schemes`: the planar INS, its Jacobian, and what feedback is good for."""

import json

import numpy as np
import pytest
from click.testing import CliRunner

from companion.study.schemes import (
    COARSE,
    FINE,
    SCALES,
    SCHEMES,
    command,
    distance,
    mechanise,
    rms,
    transition,
)


def test_jacobian_is_that_of_the_mechanisation():
    X, u, h = np.array([1.0, 2, 18, 7, 0.6]), np.array([0.1, 0.4, 2.0]), 1e-6
    A = transition(X, u)
    for i in range(8):
        d = h * np.eye(8)[i]
        slope = (mechanise(X + d[:5], u + d[5:]) - mechanise(X - d[:5], u - d[5:])) / (2 * h)
        np.testing.assert_allclose(A[:5, i], slope, atol=1e-8)


def test_coarse_sensors_need_feedback():
    """A MEMS gyro: with feedback the biases have no effect, without it the linearisation fails."""
    fine, coarse = ([rms(s, SCHEMES[f], 2) for f in ("feedforward", "feedback")] for s in (FINE, COARSE))
    assert coarse[1] < 1.1 * fine[1] < 1.5
    assert fine[0] > 2 * fine[1] and coarse[0] > 40 * coarse[1]


@pytest.mark.parametrize("name", ["feedback", "0.3"])
def test_schemes_differ_by_the_square_of_the_errors(name):
    apart = [distance(SCHEMES[name], s) for s in SCALES]
    assert apart[1] / apart[0] == pytest.approx(4.0, rel=0.02)
    assert apart[2] / apart[1] == pytest.approx(4.0, rel=0.02)


def test_command(monkeypatch):
    monkeypatch.setattr("companion.study.schemes.SAMPLES", 200)
    result = json.loads(CliRunner().invoke(command, ["--seeds", "1", "--json"]).output)
    assert set(result["rms_m"]) == set(SCHEMES)
    assert "feedforward" not in result["distance_m"]
    assert "feedback" in CliRunner().invoke(command, ["--seeds", "1"]).output
