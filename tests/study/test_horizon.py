"""`companion study horizon` agrees with the closed form."""

import json
import math
from itertools import pairwise

import numpy as np
import pytest
from click.testing import CliRunner

from companion.estimate.minimax import closed_form
from companion.estimate.schuler import ARCSECOND, DEG_PER_HOUR, MEAN_EARTH
from companion.study.horizon import Horizon, command


def run(*arguments):
    return CliRunner().invoke(command, arguments)


def test_bounds_match_the_closed_form():
    answer = json.loads(
        run("--sigma-m", "30", "--window-min", "15", "--ahead-min", "5,10,20", "--json").stdout
    )
    assert [row["ahead_min"] for row in answer["table"]] == [5, 10, 20]
    grid = 4.03 / 900**2
    assert [row["position_m"] for row in answer["table"]] == pytest.approx(
        [391.731747, 1216.97846, 4558.45109], rel=grid
    )
    assert answer["table"][0]["velocity_mps"] == pytest.approx(1.90645543, rel=grid)
    assert answer["table"][0]["tilt_arcsec"] == pytest.approx(109.928437, rel=grid)
    assert all(row["drift_deg_h"] == pytest.approx(0.163481305, rel=grid) for row in answer["table"])
    assert answer["table"][1]["ls_claimed_m"] == pytest.approx(70.7, abs=0.05)
    assert answer["table"][1]["ls_worst_m"] == pytest.approx(1786.5, abs=0.05)


@pytest.mark.parametrize(
    ("window", "ahead", "bound_m"), [(9.8334, 5, 90), (24.8334, 10, 164), (24.8334, 20, 582)]
)
def test_unknown_force_is_one_process(window, ahead, bound_m):
    """The reference's fixes are at 5, 15, ... s of 10 and 25 min: the window ends with the last."""
    arguments = ("--sigma-m", "2", "--every-s", "10", "--disturbance-ug", "20", "--window-min", str(window))
    answer = json.loads(run(*arguments, "--ahead-min", f"{ahead},{ahead}", "--json").stdout)
    row = answer["table"][0]
    assert round(row["position_m"]) == bound_m
    assert row["gap"] < 1e-9 and row["closed_form_m"] is None
    assert row["ls_worst_m"] > row["position_m"]


def test_closed_form_stands_beside_the_sampled_optimum():
    answer = json.loads(run("--ahead-min", "5,20", "--json").stdout)
    for row in answer["table"]:
        assert row["closed_form_m"] <= row["position_m"] <= row["closed_form_m"] * (1.0 + 4.03 / 900**2)


def test_longest_time_without_fixes():
    horizon = Horizon(30.0, 900.0)
    longest = horizon.longest(1000.0)
    assert horizon.position(longest) <= 1000.0 < horizon.position(longest + 1.0)
    ahead = [closed_form(900.0, t, 30.0).bounds[0] for t in (longest, longest + 1)]
    assert ahead[0] <= 1000.0 < ahead[1]
    assert horizon.longest(1.0) == 0.0  # already exceeded at the last fix
    assert f"below 1000 m for {longest / 60:.1f} min" in run("--limit-m", "1000").stdout


def test_known_drift_never_increases_the_bound():
    free = Horizon(30.0, 900.0)
    kept = [Horizon(30.0, 900.0, drift=grade * DEG_PER_HOUR) for grade in (0.01, 0.1, 10.0)]
    for minutes in (0, 10, 40, 120):
        bounds = [horizon.position(60.0 * minutes) for horizon in (*kept, free)]
        assert all(a <= b * (1 + 1e-10) for a, b in pairwise(bounds))
    assert kept[0].at(600.0).drift_deg_h == pytest.approx(0.01, rel=1e-9)
    assert kept[0].longest(1000.0) > 2.0 * free.longest(1000.0)


def test_table_grade_and_plot(tmp_path):
    result = run("--ins", "navigation", "--ahead-min", "30", "--plot", str(tmp_path / "bound.png"))
    assert result.exit_code == 0, result.output
    assert "INS drift 0.01 deg/h" in result.stdout and "squares" in result.stdout
    assert (tmp_path / "bound.png").read_bytes().startswith(b"\x89PNG")
    assert math.isinf(Horizon(1.0, 3600.0, 10.0, drift=1e-12).longest(1e9))


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("--ahead-min", "ten"), "neither a number nor a list"),
        (("--ahead-min", "-5,3"), "'-5,3': give minutes from 0 to 100000"),
        (("--ahead-min", "1e300"), "'1e300': give minutes from 0 to 100000"),
        (("--ins", "best"), "neither a grade"),
        (("--ins", "1e300"), "nor a drift in deg/h above 0, at most 1e+06"),
        (("--target", "1e300,0,0,0"), "four numbers A,B,C,D, the greatest from 1e-12 to 1e+12"),
        (("--target", "1e-300,0,0,0"), "four numbers A,B,C,D, the greatest from 1e-12 to 1e+12"),
        (("--target", "0,0,0,0"), "four numbers A,B,C,D, the greatest from 1e-12 to 1e+12"),
        (("--sigma-m", "-3"), "'--sigma-m': -3.0 is not in the range 0.001<=x<=1000000.0"),
        (("--disturbance-ug", "1e300"), "1e+300 is not in the range"),
        (
            ("--window-min", "1e9"),
            "6e+10 fixes, at most 1000000: give a shorter window or a longer interval",
        ),
        (("--sigma-m", "nan"), "'--sigma-m': nan is not a finite number"),
        (("--limit-m", "-5"), "'--limit-m': -5.0 is not in the range x>0.0"),
        (("--window-min", "0"), "0.0 is not in the range x>0.0"),
        (("--window-min", "1", "--every-s", "60"), "too few fixes"),
    ],
)
def test_invalid_options_are_reported(arguments, message):
    result = run(*arguments)
    assert result.exit_code == 2
    assert message in " ".join(result.output.replace("│", " ").split())


def test_target_combines_the_quantities():
    horizon = Horizon(30.0, 900.0)
    row = horizon.at(600.0)
    assert horizon.combination(600.0, (1, 0, 0, 0)) == pytest.approx(row.position_m)
    assert horizon.combination(600.0, (0, 1, 0, 0)) == pytest.approx(row.tilt_arcsec * ARCSECOND)
    assert horizon.combination(600.0, (0, 0, 1, 0)) == pytest.approx(row.velocity_mps)
    assert horizon.combination(600.0, (0, 0, 0, -2)) == pytest.approx(2 * row.drift_deg_h * DEG_PER_HOUR)
    both = horizon.combination(600.0, (1, 0, 60.0, 0))  # a sum is bounded by the sum of the bounds
    assert both <= (row.position_m + 60.0 * row.velocity_mps) * (1.0 + 1e-9)
    answer = json.loads(run("--ahead-min", "5,10", "--target", "1,0,60,0", "--json").stdout)
    assert answer["target_bound"][1] == pytest.approx(both)


def test_a_measured_velocity_lowers_the_bounds_and_agrees_with_linear_programming():
    from scipy.optimize import linprog

    horizon = Horizon(30.0, 900.0, 30.0, velocity=0.5)
    scale = MEAN_EARTH
    s = (600.0 + np.linspace(900.0, 0.0, 31)) * scale.rate  # from each fix to the target
    H = np.concatenate(
        [
            np.stack([np.ones_like(s), np.cos(s) - 1, -np.sin(s), np.sin(s) - s], axis=1),
            np.stack([0 * s, np.sin(s), np.cos(s), 1 - np.cos(s)], axis=1),
        ]
    )
    sigma = np.repeat([30.0 / scale.radius, 0.5 / (scale.radius * scale.rate)], 31)
    best = linprog(np.r_[sigma, sigma], A_eq=np.hstack([H.T, -H.T]), b_eq=[1.0, 0.0, 0.0, 0.0])
    assert horizon.position(600.0) == pytest.approx(scale.radius * best.fun, rel=1e-6)
    assert horizon.position(600.0) < 0.9 * Horizon(30.0, 900.0, 30.0).position(600.0)


def test_bad_target():
    assert "four numbers" in run("--target", "1,2").output
