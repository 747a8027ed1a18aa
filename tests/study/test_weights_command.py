"""`companion study weights` prints table, data and plot."""

import json

import pytest
from click.testing import CliRunner

from companion.study.weights import command


def run(*arguments):
    return CliRunner().invoke(command, arguments)


def test_data():
    result = json.loads(run("--json").output)
    sensors = {s["name"]: s for s in result["sensors"]}
    by_factor = {
        name: dict(zip(result["factors"], s["rms_ratio_variance_assumed"], strict=True))
        for name, s in sensors.items()
    }
    assert result["variance"] == pytest.approx(9.34579439252336)
    assert by_factor["GNSS"][10.0] == pytest.approx(1.72103, abs=5e-6)
    assert by_factor["RSBN"][0.1] == pytest.approx(1.66973, abs=5e-6)
    assert sensors["GNSS"]["bias_one_per_cent"] == pytest.approx(0.934579439)


def test_table():
    output = run("--variances", "500,10,200").output
    assert "1.72103" in output
    assert "1.66973" in output


def test_plot(tmp_path):
    pytest.importorskip("matplotlib")
    file = tmp_path / "weights.png"
    assert run("--plot", str(file)).exit_code == 0
    assert file.read_bytes().startswith(b"\x89PNG")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("--variances", "1,2"), "3 names for 2 variances"),
        (("--variances", "1,-2,3"), "positive"),
        (("--variances", "1", "--names", "GNSS"), "two variances"),
    ],
)
def test_invalid_input_is_reported_in_one_sentence(arguments, message):
    result = run(*arguments)
    assert result.exit_code == 2
    assert message in result.output
