"""What a flight costs afterwards is measured: each command in a process of its own, time and memory told."""

import subprocess

import pytest
from click.testing import CliRunner

from sitl import after_flight_study


def test_a_short_flight_is_within_the_budget_of_an_hour():
    pytest.importorskip("plotly")
    found = CliRunner().invoke(after_flight_study.command, ["--scenario", "short"])
    assert found.exit_code == 0, found.output
    for what in (
        "flight, simulated",
        "replay",
        "report against the truth",
        "report against the smoothed track",
    ):
        assert what in found.output


def test_cost_is_the_childs_own():
    ballast = b"x" * (600 << 20)
    held = after_flight_study.run("nothing", ["--version"])
    assert len(ballast) > 500 << 20
    assert 5.0 < held.peak_mib < 500.0
    assert 0.0 < held.cpu_s < 10.0 * held.wall_s
    with pytest.raises(subprocess.CalledProcessError):
        after_flight_study.run("nonsense", ["replay", "no-such.mcap"])


def test_an_unknown_scenario_is_refused():
    assert CliRunner().invoke(after_flight_study.command, ["--scenario", "none"]).exit_code == 2
