"""Ensembles of simulated INS errors stay below the bound; it is attained to a stated part."""

import numpy as np
import pytest
from click.testing import CliRunner

from sitl.bound_study import FIX_ERRORS, GRADES, command, curve, run


@pytest.mark.parametrize(
    ("grade", "vehicle", "path"), [("navigation", "uav", "turns"), ("mems", "jet", "orbit")]
)
def test_no_ensemble_is_beyond_its_bound(grade: str, vehicle: str, path: str) -> None:
    found = run(GRADES[grade], vehicle, path, 80.0, 900.0, 16, np.random.default_rng(7))
    assert {e.fix_errors for e in found} == set(FIX_ERRORS)
    assert all(e.ratio < 1.0 for e in found)
    assert max(e.ratio for e in found if e.fix_errors == "worst") > 0.3


def test_expected_error_is_that_of_the_flights() -> None:
    """White fix errors: the Kalman filter's claim against 64 units of the simulator."""
    found = run(GRADES["navigation"], "uav", "straight", 45.0, 900.0, 64, np.random.default_rng(3))
    for e in found:
        if e.estimate == "kalman" and e.fix_errors == "white":
            assert 0.6 < e.rms / e.expected < 1.2


def test_curve_between_minimax_and_kalman() -> None:
    points = curve(GRADES["navigation"], 900.0)
    expected, bound = [p.expected for p in points], [p.bound for p in points]
    assert bound == sorted(bound)
    assert expected == sorted(expected, reverse=True)


def test_command_reports_invalid_numbers() -> None:
    for arguments, message in (
        (("--window-min", "90"), "90.0 is not in the range 1.0<=x<=60.0"),
        (("--flights", "1"), "1 is not in the range 2<=x<=1000"),
    ):
        done = CliRunner().invoke(command, arguments)
        assert done.exit_code == 2
        assert message in done.output
