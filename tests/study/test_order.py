"""`companion study order` selects the order, detects whether the basis spans the signal, reports errors."""

import json
import pathlib

import numpy as np
import pytest
from click.testing import CliRunner

from companion.study.order import Samples, command, study


def run(*arguments):
    return CliRunner().invoke(command, [str(a) for a in arguments])


def test_data():
    result = json.loads(run("--json").output)
    rows = {row["basis"]: row for row in result["bases"]}
    assert list(rows) == ["power", "legendre", "sine", "fourier"]
    assert rows["legendre"]["order"] == rows["power"]["order"] == 4
    assert rows["legendre"]["spans"]
    assert not rows["sine"]["spans"]
    assert len(rows["sine"]["criterion"]) == 12
    assert len(rows["power"]["coefficients"]) == 4
    assert rows["legendre"]["rms_error"] < 0.1 < rows["sine"]["rms_error"]


def test_table():
    output = run("--signal", "oscillation", "--basis", "fourier", "--basis", "power").output
    assert "fourier" in output
    assert "sine" not in output
    assert "RSS/(N - r_max)" in output


def test_samples_from_a_file(tmp_path):
    file, t = tmp_path / "samples.csv", np.linspace(5.0, 9.0, 80)
    z = 3.0 * t + 0.01 * np.random.default_rng(0).standard_normal(80)
    np.savetxt(file, np.column_stack((t, z)), delimiter=",")
    (row,) = json.loads(run(file, "--sigma", 0.01, "--basis", "legendre", "--json").output)["bases"]
    assert row["order"] == 2
    assert row["spans"]
    assert row["rms_error"] is None


def test_plot(tmp_path):
    pytest.importorskip("matplotlib")
    file = tmp_path / "order.png"
    assert run("--plot", file).exit_code == 0
    assert file.read_bytes().startswith(b"\x89PNG")


@pytest.mark.parametrize(
    ("text", "options", "message"),
    [
        ("t,z\n1,2\n", (), "is not a table of numbers"),
        ("1,2,3,4\n", (), "has 4 columns"),
        ("1,2\n0,3\n4,5\n", ("--r-max", 2), "the times are not increasing"),
        ("0,2\n1,3\n", (), "r_max is 12 for 2 samples"),
    ],
)
def test_invalid_input_is_reported_in_one_sentence(tmp_path, text, options, message):
    file = tmp_path / "samples.csv"
    file.write_text(text)
    result = run(file, *options)
    assert result.exit_code == 2
    assert message in " ".join(result.output.split())


def test_short_form_selects_nine_terms_for_a_cubic():
    data = json.loads((pathlib.Path(__file__).parents[1] / "data/map_and_order.json").read_text())["order"]
    t = np.linspace(0.0, 10.0, 101)
    samples = Samples(t, np.array(data["z"]["cubic"]), 0.2 * (1.0 + 0.05 * t))
    (row,) = study(samples, ["power"], 12)
    assert row.found.order == data["results"]["cubic"]["power"]["r_J"] == 4
    assert row.short == data["results"]["cubic"]["power"]["r_simple"] == 9
