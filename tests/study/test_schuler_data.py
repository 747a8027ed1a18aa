"""Five recorded Schuler periods: accuracy of the prediction and validity of its bound on a real flight."""

import json
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

from companion.estimate.schuler import SCHULER_RATE
from companion.study.schuler_data import STATED_SIGMA, command, load, run

FLIGHT = Path(__file__).parents[1] / "data" / "schuler_deepwave_ff02_10s.csv.gz"
ORIGINAL = Path(__file__).parents[2].parent / "shared" / "data" / "schuler" / "deepwave_ff02_20140601.csv"
HORIZONS = [300.0, 600.0, 1200.0, 2400.0, 3600.0]


@pytest.fixture(scope="module")
def recording():
    return load(FLIGHT)


@pytest.fixture(scope="module")
def outcomes(recording):
    return [
        outcome
        for channel in ("east", "north")
        for window in (1800.0, 3600.0, 5400.0)
        for outcome in run(recording, channel, window, HORIZONS, STATED_SIGMA)
    ]


def test_recording_oscillates_at_the_schuler_rate(recording):
    """Fit the rate by least squares over five periods."""
    seconds, east = recording.t_ns * 1e-9, recording.channels["east"]
    assert 5.0 < seconds[-1] / 3600.0 < 5.1

    def misfit(rate):
        model = np.column_stack([np.sin(rate * seconds), np.cos(rate * seconds), np.ones_like(seconds)])
        return float(np.linalg.lstsq(model, east, rcond=None)[1][0])

    rates = SCHULER_RATE * np.linspace(0.8, 1.2, 401)
    assert rates[np.argmin([misfit(rate) for rate in rates])] == pytest.approx(SCHULER_RATE, rel=0.03)


def test_prediction_is_better_than_line_and_hold(outcomes):
    assert len(outcomes) == 30 and all(o.n >= 30 for o in outcomes)
    assert all(o.minimax_rms < 0.75 * o.line_rms for o in outcomes)
    assert all(o.minimax_rms < 0.91 * o.hold_rms for o in outcomes if o.ahead_min >= 10)
    assert all(o.minimax_rms < 0.75 * o.hold_rms for o in outcomes if o.channel == "east")


def test_bound_holds_and_least_squares_claim_does_not(outcomes):
    """The comparison values are measured too: r.m.s. differences are within bound + sigma."""
    assert all(o.minimax_rms <= o.bound + o.sigma for o in outcomes)
    assert all(o.inside > 0.65 for o in outcomes)
    total = sum(o.n for o in outcomes)
    assert sum(o.n * o.inside for o in outcomes) / total > 0.80
    assert sum(o.n * o.ls_inside for o in outcomes) / total < 0.40
    assert all(o.sigma_68 < 1.0 * STATED_SIGMA for o in outcomes)


def test_bound_scales_with_the_stated_sigma(recording):
    once, twice = (run(recording, "north", 3600.0, [600.0], sigma)[0] for sigma in (0.1, 0.2))
    assert twice.bound == pytest.approx(2.0 * once.bound, rel=1e-9)
    assert twice.minimax_rms == pytest.approx(once.minimax_rms, rel=1e-6)
    assert twice.sigma_68 == pytest.approx(once.sigma_68, rel=1e-6)


def test_command():
    arguments = [str(FLIGHT), "--window-min", "60", "--ahead-min", "5,20"]
    table = CliRunner().invoke(command, arguments)
    assert table.exit_code == 0 and "minimax" in table.stdout
    answer = json.loads(CliRunner().invoke(command, [*arguments, "--json"]).stdout)
    assert [(o["channel"], o["ahead_min"]) for o in answer] == [
        ("east", 5),
        ("east", 20),
        ("north", 5),
        ("north", 20),
    ]
    assert CliRunner().invoke(command, [str(FLIGHT), "--window-min", "x"]).exit_code == 2
    assert "sigma -1.0" in CliRunner().invoke(command, [*arguments, "--sigma-mps", "-1"]).output


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


@pytest.mark.shared
@pytest.mark.skipif(not ORIGINAL.exists(), reason="the full recording stands beside the repository")
def test_sampled_data_equal_the_full_recording(recording):
    whole = load(ORIGINAL)
    assert (whole.t_ns == recording.t_ns).all()
    assert (whole.channels["east"] == recording.channels["east"]).all()
