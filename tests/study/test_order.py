"""`companion study order` selects the order, detects whether the basis spans the signal, reports errors."""

import json
import lzma
import math
import pathlib

import numpy as np
import pytest
from click.testing import CliRunner

from companion.records import Gnss
from companion.study import order
from companion.study.order import Samples, command, errors_by_order, noise_of, read_log, study, synthetic


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


def test_column_names_are_reported(tmp_path):
    file = tmp_path / "samples.csv"
    file.write_text("t,z\n1,2\n")
    result = run(file)
    assert result.exit_code == 2
    assert "without a line of column names" in " ".join(result.output.split())
    assert "without a line of column names" in " ".join(run("--help").output.split())


def test_plot(tmp_path):
    pytest.importorskip("matplotlib")
    file = tmp_path / "order.png"
    assert run("--plot", file).exit_code == 0
    assert file.read_bytes().startswith(b"\x89PNG")


def test_number_of_samples_is_checked():
    result = run("--samples", 0)
    assert result.exit_code == 2
    assert "'--samples': 0 is not in the range 2<=x<=100000" in result.output


BASES = ("--basis", "power", "--basis", "fourier")


@pytest.mark.parametrize(
    ("text", "options", "message"),
    [
        ("t,z\n1,2\n", (), "give rows of numbers t,z or t,z,sigma"),
        ("1,2,3,4\n", (), "has 4 columns"),
        ("1,2\n0,3\n4,5\n", ("--r-max", 2), "the times are not increasing"),
        ("0,2\n1,1e300\n2,3\n", ("--r-max", 2), "z is 1e+300 somewhere: at most 1e+100 can be used"),
        (
            "0,2\n1,1e300\n2,3\n",
            ("--r-max", 2, "--track"),
            "z is 1e+300 somewhere: at most 1e+100 can be used",
        ),
        ("0,2\n1,3\n", (), "r_max is 12 for 2 samples"),
        ("", (), "samples.csv is empty: give rows of numbers"),
        ("1,2,3\n2,3,3\n", ("--sigma", 3), "samples.csv has a third column, sigma: leave one out"),
        ("1,2\n2,3\n", ("--sigma", 1e-300), "is not in the range"),
        ("0,0\n1,1\n2,2\n", ("--r-max", 1, "--track", *BASES), "2 are given: leave one --basis"),
    ],
)
def test_invalid_input_is_reported_in_one_sentence(tmp_path, text, options, message):
    file = tmp_path / "samples.csv"
    file.write_text(text)
    result = run(file, *options)
    assert result.exit_code == 2
    assert message in " ".join(result.output.split())


@pytest.mark.parametrize(("option", "value"), [("--signal", "cubic"), ("--samples", 50), ("--seed", 1)])
def test_options_of_simulated_samples_beside_a_file_are_rejected(tmp_path, option, value):
    file = tmp_path / "samples.csv"
    file.write_text("".join(f"{k},{k}\n" for k in range(20)))
    result = run(file, option, value)
    assert result.exit_code == 2
    assert f"{option} {value} has no effect on the samples of {file}: leave out {option}" in result.output


def test_options_of_simulated_samples_beside_a_file_are_those_of_the_figures(tmp_path):
    file = tmp_path / "samples.csv"
    file.write_text("".join(f"{k},{k}\n" for k in range(20)))
    simulated = ("--signal", "cubic", "--samples", 50, "--seed", 1)
    drawn = run(file, *simulated, "--figures", tmp_path / "figures.png")
    assert drawn.exit_code == 0, drawn.output


def test_short_form_selects_nine_terms_for_a_cubic():
    data = json.loads((pathlib.Path(__file__).parents[1] / "data/map_and_order.json").read_text())["order"]
    t = np.linspace(0.0, 10.0, 101)
    samples = Samples(t, np.array(data["z"]["cubic"]), 0.2 * (1.0 + 0.05 * t))
    (row,) = study(samples, ["power"], 12)
    assert row.found.order == data["results"]["cubic"]["power"]["r_J"] == 4
    assert row.short == data["results"]["cubic"]["power"]["r_simple"] == 9


@pytest.fixture(scope="module")
def log(tmp_path_factory):
    packed = pathlib.Path(__file__).parents[1] / "data/plane_wind_change_cut.tlog.xz"
    path = tmp_path_factory.mktemp("order") / "plane.tlog"
    path.write_bytes(lzma.decompress(packed.read_bytes()))
    return path


def test_column_of_a_log(log):
    for topic in ("/in/AirData", "AirData"):
        samples = read_log(log, topic, "airspeed", None)
        assert len(samples.t) > 400
        assert samples.t[0] == 0.0
        assert 0.0 < samples.sigma[0] < 1.0  # m/s, of an airspeed sensor
    east = read_log(log, "Gnss", "v_n.1", 0.1)
    assert set(east.sigma) == {0.1}


def test_a_receiver_without_a_fix_has_no_position(monkeypatch):
    """It sends 0 deg and 0 m: samples, and an estimate of the noise, of nothing."""
    rows = [Gnss(k * 10**9, 0, 0, 0, 3 * (k > 3), 0.9 * (k > 3), 0.6, 150.0 * (k > 3)) for k in range(20)]
    monkeypatch.setattr(order, "_messages", lambda log: (("/in/Gnss", row) for row in rows))
    assert set(read_log(pathlib.Path("x"), "Gnss", "alt_msl", 1.0).z) == {150.0}
    assert read_log(pathlib.Path("x"), "Gnss", "lat", None).sigma[0] < 1e-8
    assert set(read_log(pathlib.Path("x"), "Gnss", "fix", 1.0).z) == {0.0, 3.0}


def test_track_of_a_log_is_cut_into_windows(log, tmp_path):
    pytest.importorskip("matplotlib")
    plot = tmp_path / "track.png"
    column = (log, "--topic", "AirData", "--field", "airspeed", "--track")
    assert "windows of at most 12 legendre functions" in run(*column, "--plot", plot).output
    found = json.loads(run(*column, "--json").output)
    residual = np.array(found["z"]) - found["x"]
    assert 0.5 < found["consistency"] < 2.0
    assert np.std(residual) < 1.2 * np.median(read_log(log, "AirData", "airspeed", None).sigma)
    assert plot.stat().st_size > 10_000


def test_noise_is_estimated_beside_a_smooth_function():
    t = np.linspace(0.0, 10.0, 2001)
    z = 5.0 * np.sin(t) + 0.3 * np.random.default_rng(1).standard_normal(len(t))
    assert noise_of(z) == pytest.approx(0.3, rel=0.05)


def test_errors_by_order_are_those_of_many_fits():
    """The methodical and the random error add up to what a hundred seeds have, term by term."""
    one = synthetic("cubic", 101, 0.2, 0)
    predicted = np.hypot(*errors_by_order(one, 6))
    squares = np.zeros(6)
    for seed in range(100):
        samples = synthetic("cubic", 101, 0.2, seed)
        (row,) = study(samples, ["legendre"], 6)
        Psi = row.found.basis(samples.t) / samples.sigma[:, None]
        for r in range(1, 7):
            a = np.linalg.lstsq(Psi[:, :r], samples.z / samples.sigma, rcond=None)[0]
            squares[r - 1] += np.mean((Psi[:, :r] @ a * samples.sigma - samples.truth) ** 2)
    np.testing.assert_allclose(np.sqrt(squares / 100), predicted, rtol=0.05)
    assert predicted.argmin() == 3  # four terms
    assert math.isclose(errors_by_order(one, 6)[0][3], 0.0, abs_tol=1e-9)


def test_figures(tmp_path):
    pytest.importorskip("matplotlib")
    file = tmp_path / "figures.png"
    assert run("--figures", file, "--basis", "power").exit_code == 0
    assert file.read_bytes().startswith(b"\x89PNG")


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("--topic", "Gnss"), "needs FILE, --topic and --field"),
        ((), "is a log: give --topic and --field"),
        (("--topic", "Gns", "--field", "lat"), "no values of lat in Gns: it has"),
        (("--topic", "Gnss", "--field", "v_n"), "give a component"),
        (("--topic", "Gnss", "--field", "height"), "has no field"),
    ],
)
def test_wrong_column_is_reported_in_one_sentence(log, options, message):
    result = run(log, *options)
    assert result.exit_code != 0
    assert message in result.output + str(result.exception)
