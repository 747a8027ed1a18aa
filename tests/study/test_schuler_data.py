"""Five recorded Schuler periods: accuracy of the prediction and validity of its bound on a real flight."""

import json
import re
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

from companion.estimate.schuler import SCHULER_RATE
from companion.study.schuler_data import STATED_SIGMA, command, load, run

FLIGHT = Path(__file__).parents[1] / "data" / "schuler_deepwave_ff02_10s.csv.gz"
ORIGINAL = Path(__file__).parents[2].parent / "shared" / "data" / "schuler" / "deepwave_ff02_20140601.csv"
HORIZONS = [300.0, 600.0, 1200.0, 2400.0]


@pytest.fixture(scope="module")
def recording():
    return load(FLIGHT)


@pytest.fixture(scope="module")
def outcomes(recording):
    return [o for window in (1200.0, 3600.0) for o in run(recording, window, HORIZONS, STATED_SIGMA)]


def test_recording_oscillates_at_the_schuler_rate(recording):
    """Fit the rate by least squares over five periods."""
    seconds, east = recording.t_ns * 1e-9, recording.channels["east"]
    assert 5.0 < seconds[-1] / 3600.0 < 5.1

    def misfit(rate):
        model = np.column_stack([np.sin(rate * seconds), np.cos(rate * seconds), np.ones_like(seconds)])
        return float(np.linalg.lstsq(model, east, rcond=None)[1][0])

    rates = SCHULER_RATE * np.linspace(0.8, 1.2, 401)
    assert rates[np.argmin([misfit(rate) for rate in rates])] == pytest.approx(SCHULER_RATE, rel=0.03)


def test_prediction_is_better_than_simple_rules(outcomes):
    assert len(outcomes) == 16 and all(o.n >= 40 for o in outcomes)
    assert all(o.restricted_rms < 0.65 * min(o.line_rms, o.hold_rms) for o in outcomes)
    assert all(o.restricted_rms < 1.65 * o.ls_rms for o in outcomes)
    assert np.mean([o.restricted_rms < o.ls_rms for o in outcomes]) >= 0.5


def test_bound_holds_and_the_restricted_estimate_is_as_good_as_the_kalman_filter(outcomes):
    total = sum(o.n for o in outcomes)
    assert sum(o.n * o.inside for o in outcomes) / total >= 0.97
    assert all(o.restricted_rms <= 1.1 * o.kalman_rms for o in outcomes)
    assert all(o.optimum <= o.bound <= 1.25 * o.optimum for o in outcomes)
    assert all(o.kalman_rms < 1.3 * o.expected for o in outcomes)


def test_command():
    arguments = [str(FLIGHT), "--window-min", "60", "--ahead-min", "5,20"]
    table = CliRunner().invoke(command, [str(FLIGHT), "--window-min", "20", "--ahead-min", "5"])
    assert table.exit_code == 0 and "minimax" in table.stdout
    answer = json.loads(CliRunner().invoke(command, [*arguments, "--json"]).stdout)
    assert [(o["channel"], o["ahead_min"]) for o in answer] == [
        ("east", 5),
        ("east", 20),
        ("north", 5),
        ("north", 20),
    ]
    assert CliRunner().invoke(command, [str(FLIGHT), "--window-min", "x"]).exit_code == 2
    for option in ("--window-min", "--ahead-min"):
        for number in ("nan", "inf"):
            done = CliRunner().invoke(command, [str(FLIGHT), option, f"20,{number}"])
            assert done.exit_code == 2
            assert f"Invalid value for '{option}': {number} is not a finite number." in done.stderr
    assert (
        "-1.0 is not in the range 1e-06<=x<=1000000.0"
        in CliRunner().invoke(command, [*arguments, "--sigma-mps", "-1"]).output
    )


@pytest.mark.parametrize(
    ("option", "value", "wanted"),
    [
        (
            "--ahead-min",
            "1000",
            "no window of 20 or 30 or 60 min has four samples and a measurement 1000 min later",
        ),
        ("--window-min", "1000", "no window of 1000 min has"),
        ("--window-min", "0.1", "no window of 0.1 min has"),
    ],
)
def test_a_window_or_horizon_beyond_the_recording_is_rejected(option, value, wanted):
    done = CliRunner().invoke(command, [str(FLIGHT), option, value])
    assert done.exit_code == 2
    assert f"nothing to predict: in {FLIGHT}, 304 min long, {wanted}" in done.stderr
    assert "change --window-min or --ahead-min" in done.stderr


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("empty.csv", b""),
        ("heading.csv", b"# a\n# b\nutc_s_of_day,ve,vn\n"),
        ("one_line.csv", b"# a\n# b\n# c\n1.0,2.0,3.0\n"),
        ("narrow.csv", b"# a\n# b\n# c\n1.0,2.0\n2.0,2.0\n"),
        ("flight.tlog", bytes(range(256))),
        ("mine.toml", b"[gnss]\nsigma_m = 3.0\n\nevery_s = 1\n"),
        ("flight.csv.gz", b"no gzip"),
    ],
)
def test_invalid_recording_is_reported_with_its_name(name, content, tmp_path):
    file = tmp_path / name
    file.write_bytes(content)
    done = CliRunner().invoke(command, [str(file)])
    assert done.exit_code == 2
    assert f"Error: {file} is not a recording of velocity errors: " in done.stderr
    assert len(done.stderr.splitlines()) == 4


@pytest.mark.parametrize(
    ("row", "wanted"),
    [
        ("nan,0.1,0.1", "row 2 is nan,0.1,0.1: "),
        ("1e12,0.1,0.1", "row 2 is 1e+12,0.1,0.1: seconds must be from 0 to 1e+09"),
        ("11,1e300,0.1", "row 2 is 11,1e+300,0.1: "),
        (
            "11,0.1,-inf",
            "row 2 is 11,0.1,-inf: seconds must be from 0 to 1e+09, errors from -1e+06 to 1e+06 m/s: leave",
        ),
    ],
)
def test_an_impossible_number_is_reported_with_its_row(row, wanted, tmp_path):
    """A time that is not a number had a warning of numpy, and a recording of -1.5e8 min."""
    file = tmp_path / "flight.csv"
    file.write_text(f"\n\n\n0,0.1,0.1\n{row}\n20,0.1,0.1\n")
    with pytest.raises(ValueError, match=re.escape(wanted)):
        load(file)


@pytest.mark.shared
@pytest.mark.skipif(not ORIGINAL.exists(), reason="the full recording stands beside the repository")
def test_sampled_data_equal_the_full_recording(recording):
    whole = load(ORIGINAL)
    assert (whole.t_ns == recording.t_ns).all()
    assert (whole.channels["east"] == recording.channels["east"]).all()
