"""`companion study ins-errors` prints the reference's frequencies."""

import json
import math

import pytest
from click.testing import CliRunner

from companion.study.ins_errors import command


def run(*arguments):
    return CliRunner().invoke(command, arguments)


def test_frequencies_at_rest():
    found = json.loads(run("--json").output)
    for model in found:  # reference/error_model.json
        frequencies = [imag for _, imag in found[model]][:3]
        assert frequencies == pytest.approx([4.700304420, 4.245613128, 0.262516140], abs=1e-8)
    output = run().output
    assert "4.467177425" in output and "84.3913" in output
    assert output.count("1.000000000") == 2


def test_moving_vehicle_has_other_frequencies_and_no_laws():
    output = run("--east-mps", "250", "--lat-deg", "45").output
    assert "difference of the pair" not in output
    found = json.loads(run("--east-mps", "250", "--lat-deg", "45", "--json").output)["complete"]
    # the pair splits by the rate of the local frame, Omega + VE / (R cos lat)
    rate = 7.292115e-5 + 250.0 / (6371e3 * math.cos(math.radians(45.0)))
    assert found[0][1] - found[1][1] == pytest.approx(
        2.0 * rate * math.sin(math.radians(45.0)) * 3600.0, rel=0.01
    )
