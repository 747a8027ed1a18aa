"""Study of time and memory after a flight: each command is measured in its own process."""

import subprocess

import pytest
from click.testing import CliRunner

from sitl import after_flight_study


@pytest.mark.flight
@pytest.mark.long
def test_short_flight_is_within_the_budget():
    pytest.importorskip("jinja2")
    found = CliRunner().invoke(after_flight_study.command, ["--scenario", "short"])
    assert found.exit_code == 0, found.output
    for what in (
        "flight, simulated",
        "replay",
        "report against the truth",
        "report against the smoothed track",
    ):
        assert what in found.output


def test_cost_excludes_the_parent_process():
    ballast = b"x" * (600 << 20)
    cost = after_flight_study.measure_command("nothing", ["--version"])
    assert len(ballast) > 500 << 20
    assert 5.0 < cost.peak_mib < 500.0
    assert 0.0 < cost.cpu_s < 10.0 * cost.wall_s
    with pytest.raises(subprocess.CalledProcessError):
        after_flight_study.measure_command("nonsense", ["replay", "no-such.mcap"])


def test_unknown_scenario_is_rejected():
    assert CliRunner().invoke(after_flight_study.command, ["--scenario", "none"]).exit_code == 2
