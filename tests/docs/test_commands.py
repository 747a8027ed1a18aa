"""Commands of README and docs: all are parsed, those of code blocks run or have a reason why not."""

from __future__ import annotations

import dataclasses
import re
import shlex
import shutil
from pathlib import Path

import click
import pytest
from click.testing import CliRunner

from companion.bench import live
from companion.command_line import cli
from companion.config import ConfigError
from sitl import scenarios
from sitl.flight import Leg
from sitl.loopback import command as loopback

ROOT = Path(__file__).parents[2]
RECORDING = ROOT / "tests" / "data" / "dronekit_copter_cut.tlog"
SHELL = re.compile(
    r"(?:sudo|make|git|python3|companion|venv/|/opt/|deploy/|pip|mavproxy|systemctl|journalctl)\b"
)

PAGES = [
    *(ROOT / name for name in ("README.md", "CONTRIBUTING.md", "SECURITY.md", "examples/README.md")),
    *sorted((ROOT / "docs").rglob("*.md")),
]

#: Commands that are not run by this test, and why.
NOT_RUN = {
    r"make (test|flights|loopback|lint|docs)": "a job of .ci/run",
    r"make (kills|soak|fuzz|all-flights)": "takes minutes to hours: tests/sitl",
    r"companion (campaign|study harm)": "takes an hour: tests/sitl",
    r"git|python3 -m venv|venv/bin/pip|sudo|/opt/.*pip|systemctl|journalctl": "changes the system",
    r"deploy/debian/build": "takes minutes, and the network",
    r"mavproxy": "needs MAVProxy: tests/clients",
    r"companion run (?!--set gnss.sigm=)": "flies until stopped: tests/runtime/test_service.py",
    r"companion doctor": "needs an autopilot: tests/doctor/test_command.py",
    r"companion live": "serves until stopped: tests/analysis/live",
    r"companion signing": "reads /etc: tests/doctor/test_signing_command.py",
    r"companion sitl": "flies in real time: tests/sitl/test_simulator_command.py, test_bridge.py",
    r"companion loopback": "the fixture of this test flies it",
}


def commands() -> list[tuple[str, str]]:
    """(page, command) of all code blocks, `companion` without the path of its environment."""
    found = []
    for path in PAGES:
        for block in re.findall(r"^```\w*\n(.*?)^```", path.read_text(), re.DOTALL | re.MULTILINE):
            for line in block.replace("\\\n", " ").splitlines():
                text = re.sub(r"\s+#.*", "", line).strip().removeprefix("$ ")
                if SHELL.match(text) and not text.startswith("companion:"):
                    text = re.sub(r"^(?:\S*/bin/)companion\b", "companion", " ".join(text.split()))
                    found.append((path.stem, text))
    return found


def named_in_text() -> set[str]:
    """Commands in the sentences of the pages."""
    found = set()
    for path in PAGES:
        text = re.sub(r"^```.*?^```", "", path.read_text(), flags=re.DOTALL | re.MULTILINE)
        for name in re.findall(r"`(?:venv/bin/)?(companion [a-z][^`]*)`", text):
            found.add(" ".join(name.split()))
    return found


ALL = commands()
OURS = sorted({text for _, text in ALL if text.startswith("companion ")} | named_in_text())


def arguments(text: str) -> list[str]:
    """Arguments of a companion command, without redirection, pipe and background."""
    return shlex.split(re.split(r" [>|&]", text)[0])[1:]


def test_commands_are_found_on_the_pages_that_have_them() -> None:
    assert {"README", "tutorial", "install", "logs", "sitl", "ground-station"} <= {page for page, _ in ALL}
    assert len(OURS) >= 20


@pytest.mark.parametrize("text", OURS)
def test_options_and_commands_exist(text: str) -> None:
    words, command = arguments(text), cli
    context = click.Context(cli, info_name="companion")
    while isinstance(command, click.Group) and words and not words[0].startswith("-"):
        found = command.get_command(context, words[0])
        assert found is not None, words[0]
        if not isinstance(found, click.Group) or len(words) == 1 or words[1].startswith("-"):
            command, words = found, words[1:]
            break
        command, words = found, words[1:]  # type: ignore[assignment]
    command.make_context("companion", [*words], parent=context, resilient_parsing=True)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the files that the pages name, of a flight of 45 s."""
    path = tmp_path_factory.mktemp("docs")
    plan = scenarios.SCENARIOS["short"].plan
    plan = dataclasses.replace(plan, legs=(plan.legs[0], Leg(35, 40, 38, 30)))
    flight = scenarios.get_scenario("short", plan=plan, gnss_outages=((25.0, 35.0),), rsbn_outages=())
    words = ["--scenario", "short", "--logs", str(path / "logs"), "--set", "output.profile=ardupilot"]
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(scenarios.SCENARIOS, "short", flight)
        done = CliRunner().invoke(loopback, words)
    assert done.exit_code == 0, done.output
    (log,) = (path / "logs").glob("*.mcap")
    shutil.copy(log, path / "LOG.mcap")
    shutil.copy(log, path / "LOG")
    shutil.copy(RECORDING, path / "FLIGHT.tlog")
    shutil.copy(RECORDING, path / "SOURCE.tlog")
    return path


def is_run(text: str) -> bool:
    return not any(re.match(pattern, text) for pattern in NOT_RUN)


@pytest.mark.parametrize("text", [text for text in sorted({text for _, text in ALL}) if is_run(text)])
def test_command_runs(text: str, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(folder)
    measure = live.measure
    monkeypatch.setattr(live, "measure", lambda _: measure(1.0))  # of `companion bench live`
    monkeypatch.setattr(live, "SETTLE_S", 1.0)
    assert text.startswith("companion "), f"{text}: run it here, or state in NOT_RUN why not"
    stands_for = {"SOURCE": "SOURCE.tlog", "FOLDER...": "logs", "$LOG": "LOG.mcap"}
    words = [stands_for.get(word, word) for word in arguments(text)]
    if words[0] == "fleet":
        words += ["--workers", "0"]  # in this process: processes are started in tests/analysis/test_fleet.py
    for output in ("LOG.mcap", "FLIGHT.replay.mcap", "other.mcap"):
        if words[-2:] == ["-o", output] or output == "FLIGHT.replay.mcap":
            (folder / output).unlink(missing_ok=True)
    done = CliRunner().invoke(cli, words)
    if "gnss.sigm=3" in text:  # the example of a mistake
        assert isinstance(done.exception, ConfigError)
    else:
        assert done.exit_code == 0, done.output
    shutil.copy(next(folder.glob("logs/*.mcap")), folder / "LOG.mcap")


@pytest.mark.parametrize("pattern", NOT_RUN)
def test_every_exception_is_needed(pattern: str) -> None:
    assert any(re.match(pattern, text) for _, text in ALL)
