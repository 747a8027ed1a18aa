import json

import numpy as np
import pytest
from click.testing import CliRunner

from companion.study.restrictive import TRUTHS, command

pytestmark = pytest.mark.flight

COLUMNS = ["dx", "dy", "dVN", "dVE", "PX", "PY", "PZ", "VcX", "VcY", "GX", "GY", "AX"]
# rms error of the minimax filter divided by that of R1, from an independent program, 200 runs
RATIOS = {
    "constant": [0.59, 0.58, 1.79, 1.51, 1.21, 1.09, 0.58, 1.73, 1.49, 0.64, 0.69, 1.00],
    "telegraph": [0.89, 0.90, 2.00, 2.02, 1.67, 1.63, 0.90, 1.98, 2.00, 0.74, 0.75, 1.00],
    "slow": [0.97, 0.93, 0.76, 0.75, 0.84, 0.86, 0.95, 0.76, 0.75, 1.05, 1.04, 1.00],
    "white": [0.53, 0.53, 0.54, 0.54, 0.54, 0.55, 0.56, 0.54, 0.54, 0.69, 0.68, 1.00],
    "euler": [0.91, 0.93, 2.27, 2.17, 1.15, 1.10, 0.93, 2.18, 2.10, 0.57, 0.58, 1.00],
}


@pytest.fixture(scope="module")
def rows():
    done = CliRunner().invoke(command, ["--runs", "200", "--json"], catch_exceptions=False)
    return {row["truth"]: row for row in json.loads(done.output)}


@pytest.mark.parametrize("truth", TRUTHS)
def test_ratios(rows, truth):
    row = dict(zip(rows[truth]["states"], rows[truth]["ratio"], strict=True))
    np.testing.assert_allclose([row[c] for c in COLUMNS], RATIOS[truth], rtol=0.1)


def test_rms_errors_of_the_first_row(rows):
    row = rows["constant"]
    for name, coarse, restrictive in (
        ("dx", 0.497, 0.848),
        ("dVN", 0.855, 0.478),
        ("PZ", 1.34e-4, 2.31e-4),
        ("VcX", 0.866, 0.501),
    ):
        i = row["states"].index(name)
        assert row["rms_minimax"][i] == pytest.approx(coarse, rel=0.1)
        assert row["rms_restrictive"][i] == pytest.approx(restrictive, rel=0.1)
    assert row["rms_free"][0] < row["rms_minimax"][0] < row["rms_restrictive"][0]  # aiding costs position


def test_consistency(rows):
    """Minimax is consistent for Gaussian U; on the bound both variances are too small, R1 much more so."""
    assert rows["white"]["nees_minimax_per_dimension"] == pytest.approx(1.0, abs=0.05)
    bound = rows["constant"]
    assert 0.54 <= bound["on_bound"] <= 0.62 and 0.70 <= bound["near_bound"] <= 0.80
    for state, coarse, restrictive in (("dx", 7.3, 39), ("dVN", 3.7, 9.8)):
        i = bound["states"].index(state)
        assert bound["nees_minimax"][i] == pytest.approx(coarse, rel=0.15)
        assert bound["nees_restrictive"][i] == pytest.approx(restrictive, rel=0.15)


def test_a_number_of_flights_beyond_the_memory_is_rejected():
    done = CliRunner().invoke(command, ["--runs", "1000000000"])
    assert done.exit_code == 2 and "is not in the range 2<=x<=10000" in done.output


def test_table_and_figures(tmp_path):
    pytest.importorskip("matplotlib")
    options = ["--runs", "2", "--truth", "slow", "--plot", str(tmp_path)]
    done = CliRunner().invoke(command, options, catch_exceptions=False)
    assert "U on the bound" in done.output
    assert len(list(tmp_path.glob("slow_*.png"))) == 10
