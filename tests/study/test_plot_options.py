"""Plot targets are checked before any work; errors are one sentence."""

import sys
from pathlib import Path

import pytest
from click.testing import CliRunner

from companion.command_line import cli

COMMANDS = (
    ["loopback", "--scenario", "short"],
    ["study", "horizon"],
    ["study", "order"],
    ["study", "weights"],
)


@pytest.mark.parametrize("command", COMMANDS)
@pytest.mark.parametrize(
    ("name", "message"),
    [("none/x.png", "no folder"), ("x.xyz", "no image suffix"), ("x", "png")],
)
def test_invalid_plot_target_is_reported_before_any_work(
    command: list[str], name: str, message: str, tmp_path: Path
) -> None:
    pytest.importorskip("matplotlib")
    done = CliRunner().invoke(cli, [*command, "--plot", str(tmp_path / name)])
    assert done.exit_code == 2
    assert not done.stdout
    assert message in done.stderr
    assert len(done.stderr.splitlines()) == 4  # how it is used, where to ask, a blank line, and the sentence


def test_file_as_plot_folder_is_rejected(tmp_path: Path) -> None:
    pytest.importorskip("matplotlib")
    (tmp_path / "x").touch()
    for folder, message in (("x", "it is a file; give a folder"), ("x/y", "Not a directory")):
        done = CliRunner().invoke(cli, ["study", "restrictive", "--plot", str(tmp_path / folder)])
        assert done.exit_code == 2 and f"cannot be created: {message}" in done.stderr


def test_a_line_that_a_shell_completes_creates_no_folder(tmp_path: Path) -> None:
    pytest.importorskip("matplotlib")
    environment = {"_COMPANION_COMPLETE": "bash_complete", "COMP_CWORD": "5"}
    environment["COMP_WORDS"] = f"companion study restrictive --plot {tmp_path / 'x'} --"
    done = CliRunner().invoke(cli, [], prog_name="companion", env=environment)
    assert "--plot" in done.stdout or "--help" in done.stdout
    assert not (tmp_path / "x").exists()


@pytest.mark.parametrize("command", [*COMMANDS, ["study", "restrictive"]])
def test_missing_matplotlib_is_reported_with_the_remedy(
    command: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "matplotlib.backend_bases", None)
    done = CliRunner().invoke(cli, [*command, "--plot", str(tmp_path / "x.png")])
    assert done.exit_code == 2
    assert (
        "plotting needs matplotlib: run `pip install matplotlib`, or `pip install '.[plot]'` in a checkout"
        in done.stderr
    )
