"""`companion study weights` prints tables, data and plot; its numbers are the reference's."""

import json
import math

import numpy as np
import pytest
from click.testing import CliRunner

from companion.estimate.readings import Reading, error_covariance
from companion.study.weights import PAPER, command, cost_of_factor, exact_azimuth, misprinted

AXIS = (
    "--reading=INS.x=105,22.360679775",
    "--reading=GNSS.x=101,3.16227766",
    "--reading=RSBN.x=98.994949,14.142135624",
)
NEAR_NORTH = (
    *("--reading=INS.x=2400,1500", "--reading=INS.y=139500,1500", "--reading=GNSS.x=2440,100"),
    *("--reading=GNSS.y=139970,100", "--reading=RSBN.azimuth=1,0.25", "--reading=RSBN.range=140000,200"),
)


def run(*arguments):
    return CliRunner().invoke(command, arguments)


def data(*arguments):
    return json.loads(run("--json", *arguments).output)


def test_worked_example():
    result = data()
    x, y = result["axes"]
    assert (x["value"], y["value"]) == pytest.approx((100.981072400285825, 100.476399503089563), rel=1e-12)
    assert x["variance"] == pytest.approx(9.34579439252336, rel=1e-13)
    assert list(x["weights"].values()) == pytest.approx(
        [0.0186915887850467, 0.934579439252336, 0.0467289719626168], rel=1e-12
    )
    # reference/ml_fusion.json, case 1: computed with multi-precision arithmetic
    assert result["joint"]["position"] == pytest.approx([100.98128612192838, 100.4762138564679], rel=1e-11)
    assert result["joint"]["covariance"][0] == pytest.approx(
        [9.35322256131724, -0.00746550859697283], rel=1e-8
    )
    output = run().output
    for number in ("101.139", "101.138939", "100.981072", "100.892406", "100.981286"):
        assert number in output


def test_printed_x_and_the_corrected_row():
    # R's entries squared once more (read as deviations) and z_P = D with the printed sin A for a gain
    assert misprinted(PAPER) == pytest.approx(101.13893902309513, rel=1e-14)
    # entry 1/sin A instead, the azimuth taken for exact
    value, claimed, _ = exact_azimuth(PAPER, error_covariance(PAPER), "x")
    assert (value, claimed) == pytest.approx((100.89240619340327, 2.98807152334), rel=1e-11)


def test_weight_that_is_not_rescaled_biases_the_estimate():
    # one per cent of the weight of GNSS, times 100 km
    same = ("--reading=INS.x=100,22.360679775", "--reading=GNSS.x=100,3.16227766")
    output = run(*same, "--reading=RSBN.x=100,14.142135624").output
    (row,) = [line for line in output.splitlines() if "not rescaled" in line]
    assert "0.93458" in row


def test_wrong_variances():
    H, R = np.ones((3, 1)), np.diag([500.0, 10.0, 200.0])
    root = math.sqrt(10.0)
    gnss, rsbn = (False, True, False), (False, False, True)
    assert cost_of_factor(H, R, gnss, root).actual == pytest.approx(1.72103, abs=5e-6)
    assert cost_of_factor(H, R, rsbn, 1.0 / root).actual == pytest.approx(1.66973, abs=5e-6)


def test_wrong_sigmas_of_one_coordinate():
    result = data(*AXIS)
    assert result["joint"] is None
    at = {source: [c["actual"] for c in costs] for source, costs in result["sigma_assumed"].items()}
    by_variance = dict(
        zip((0.1, 10.0), (result["factors"].index(0.1**0.5), result["factors"].index(10.0**0.5)), strict=True)
    )
    assert at["GNSS"][by_variance[10.0]] == pytest.approx(1.72103, abs=5e-6)
    assert at["RSBN"][by_variance[0.1]] == pytest.approx(1.66973, abs=5e-6)


def test_row_of_the_paper_near_north_claims_what_it_has_not():
    output = run(*NEAR_NORTH).output
    assert "3.4883" in output and "610.03" in output  # MATH: claims 3.5 m where the true error is 610 m
    assert data(*NEAR_NORTH)["joint"]["covariance"][0][0] ** 0.5 == pytest.approx(98.5, abs=0.05)


@pytest.mark.parametrize(("axis", "A_deg"), [("x", 1.0), ("x", 179.0), ("y", 91.0), ("y", 271.0)])
def test_row_near_its_singular_azimuth_claims_3_metres_and_errs_by_610(axis, A_deg):
    _, claimed, actual = exact_azimuth(*beacon_alone(A_deg), axis)
    assert (claimed, actual) == pytest.approx((3.49048, 610.78), rel=1e-5)


@pytest.mark.parametrize(("axis", "A_deg"), [("x", 0.0), ("x", 180.0), ("y", 90.0), ("y", 270.0)])
def test_no_row_at_the_singular_azimuth_itself(axis, A_deg):
    assert exact_azimuth(*beacon_alone(A_deg), axis) is None
    assert exact_azimuth(*beacon_alone(A_deg), "y" if axis == "x" else "x") is not None


def beacon_alone(A_deg):
    """Azimuth and range, their covariance."""
    pair = (
        Reading("RSBN", "azimuth", math.radians(A_deg), math.radians(0.25)),
        Reading("RSBN", "range", 140e3, 200.0),
    )
    return pair, error_covariance(pair)


def test_correlated_readings_count_less():
    # two readings of equal error: variance s^2 (1 + rho) / 2, and the mean whatever rho
    pair = ("--reading=A.x=10,2", "--reading=B.x=12,2")
    for rho in (-0.5, 0.0, 0.5):
        (axis,) = data(*pair, f"--correlation=A.x,B.x={rho}")["axes"]
        assert axis["value"] == pytest.approx(11.0)
        assert axis["variance"] == pytest.approx(2.0 * (1.0 + rho))


def test_ignored_correlation_of_unequal_readings():
    # two readings, sigma 1 and s: weights by variance, exact law of the mean
    rho, s = 0.9, 3.0
    (axis,) = data("--reading=A.x=0,1", "--reading=B.x=0,3")["axes"]
    found = next(e["cost"] for e in axis["correlation_ignored"] if e["rho"] == rho)
    w = s**2 / (1 + s**2)
    actual = w**2 + (1 - w) ** 2 * s**2 + 2 * w * (1 - w) * rho * s
    best = s**2 * (1 - rho**2) / (1 + s**2 - 2 * rho * s)
    assert found["actual"] == pytest.approx((actual / best) ** 0.5)
    assert found["claimed"] == pytest.approx((s**2 / (1 + s**2) / actual) ** 0.5)


def test_plot(tmp_path):
    pytest.importorskip("matplotlib")
    file = tmp_path / "weights.png"
    assert run("--plot", str(file)).exit_code == 0
    assert file.read_bytes().startswith(b"\x89PNG")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("--reading=GNSS.x=1",), "two numbers"),
        (("--reading=GNSS.z=1,2",), "kind of x, y, azimuth, range"),
        (("--reading=GNSS.x=1,2",), "at least two"),
        (("--reading=GNSS.x=1,2", "--reading=INS.x=1,-2"), "positive sigma"),
        (("--reading=GNSS.x=1,2", "--reading=GNSS.x=1,2"), "same name"),
        (("--correlation=INS.x,GNSS.x=1.5",), "(-1, 1)"),
        (("--correlation=INS.x,VOR.x=0.5",), "no reading 'VOR.x'"),
        (("--correlation=INS.x=0.5",), "no reading ''"),
        (("--reading=A.x=1,2", "--reading=B.azimuth=0,1"), "azimuths that do not meet"),
        (("--reading=A.x=1,2", "--reading=A.range=1,2", "--beacon=A=nan,2"), "'A=nan,2': give two finite"),
        (("--reading=A.range=1e300,1", "--reading=B.range=1,1"), "'A.range=1e300,1': give two finite"),
        (("--reading=A.x=1,1e-300", "--reading=B.x=1,1"), "sigma is 1e-300: give one from 1e-50 to 1e+50"),
        (("--beacon=VOR=1,2",), "no reading of beacon VOR"),
        (("--beacon=A=1,2", "--beacon=A=3,2"), "'A=3,2': the place of A is given twice: leave one out"),
        (
            ("--correlation=INS.x,GNSS.x=0.5", "--correlation=GNSS.x,INS.x=0.1"),
            "the correlation of GNSS.x and INS.x is given twice: leave one out",
        ),
    ],
)
def test_invalid_input_is_reported_in_one_sentence(arguments, message):
    result = run(*arguments)
    assert result.exit_code == 2
    assert message in result.output.replace("\n", " ")
