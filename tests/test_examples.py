"""Every script of examples/ runs, and prints a result that is right."""

import dataclasses
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
from click.testing import CliRunner

from sitl import scenarios
from sitl.flight import Leg
from sitl.loopback import command

ROOT = Path(__file__).parents[1]
SCRIPTS = sorted(path.name for path in (ROOT / "examples").glob("*.py"))
RECORDING = ROOT / "tests" / "data" / "dronekit_copter_cut.tlog"


@pytest.fixture(scope="module")
def flight(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A log of a loopback of 75 seconds, 20 of them without GNSS."""
    folder = tmp_path_factory.mktemp("examples")
    plan = scenarios.SCENARIOS["short"].plan
    plan = dataclasses.replace(plan, legs=(plan.legs[0], Leg(65, 40, 38, 60)))
    scenario = scenarios.get_scenario("short", plan=plan, gnss_outages=((40.0, 60.0),), rsbn_outages=())
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(scenarios.SCENARIOS, "short", scenario)
        done = CliRunner().invoke(command, ["--scenario", "short", "--logs", str(folder)])
    assert done.exit_code == 0, done.output
    (path,) = folder.glob("*.mcap")
    return path


def run(script: str, *arguments: object) -> str:
    done = subprocess.run(
        [sys.executable, ROOT / "examples" / script, *map(str, arguments)],
        capture_output=True,
        text=True,
        timeout=300,
        cwd=ROOT,
        env=os.environ | {"PYTHONWARNINGS": "error"},
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


def numbers(text: str) -> list[float]:
    return [float(x) for x in re.findall(r"-?\d+\.?\d*", text)]


def test_at_least_six_examples_of_at_most_40_lines_and_each_in_the_readme() -> None:
    assert len(SCRIPTS) >= 6
    page = (ROOT / "examples" / "README.md").read_text()
    for name in SCRIPTS:
        assert len((ROOT / "examples" / name).read_text().splitlines()) <= 40, name
        assert f"({name})" in page


def test_read_log(flight: Path) -> None:
    lines = run("read_log.py", flight).splitlines()
    first, second = (numbers(line)[0] for line in lines)
    assert first == 0.0  # min; not the time since the autopilot's boot
    assert second - first == pytest.approx(1.0, abs=0.11)
    assert all(float(re.search(r"error +([\d.]+) m", line)[1]) < 50.0 for line in lines)  # type: ignore[index]


@pytest.mark.parametrize("script", ["read_log.py", "replay_with_another_estimator.py"])
def test_example_without_its_log_states_its_usage(script: str) -> None:
    command = [sys.executable, ROOT / "examples" / script]
    done = subprocess.run(command, capture_output=True, text=True, timeout=200)
    assert done.returncode == 1
    assert re.fullmatch(rf"usage: python examples/{script} .*\n", done.stderr)


def test_fuse_two_beacons() -> None:
    sigma, error = (
        numbers(line)
        for line in run("fuse_two_beacons.py").splitlines()
        if line.startswith(("sigma", "error"))
    )
    assert all(abs(e) < 5.0 * s for e, s in zip(error, sigma, strict=True))


def test_predict_bound_prints_1217_m_ten_minutes_ahead() -> None:
    (row,) = (
        numbers(line) for line in run("predict_bound.py").splitlines() if line.lstrip().startswith("10 ")
    )
    assert row[:2] == [10.0, 1217.0]


@pytest.mark.flight
def test_fly_loopback() -> None:
    rows = run("fly_loopback.py").splitlines()[1:]
    assert {"GNSS+RSBN", "GNSS only", "RSBN only", "neither"} == {row[:12].strip() for row in rows}
    assert all(numbers(row[12:])[0] < 50.0 for row in rows)


@pytest.mark.flight
@pytest.mark.parametrize("source", ["tlog", pytest.param("log", marks=pytest.mark.long)])
def test_replay_with_another_estimator(source: str, flight: Path) -> None:
    shown = run("replay_with_another_estimator.py", RECORDING if source == "tlog" else flight)
    default, other = re.search(r"(\d+) by default, (\d+) with", shown).groups()  # type: ignore[union-attr]
    assert int(default) > 5
    assert int(other) > 5


def test_write_a_custom_channel() -> None:
    true_n, true_e, north, east, sigma = numbers(run("write_a_custom_channel.py"))
    assert abs(north - true_n) < 5.0 * sigma
    assert abs(east - true_e) < 5.0 * sigma


def test_every_example_has_a_test() -> None:
    tests = {name.removeprefix("test_") for name in globals() if name.startswith("test_")}
    for script in SCRIPTS:
        assert any(name.startswith(script.removesuffix(".py")) for name in tests), script
