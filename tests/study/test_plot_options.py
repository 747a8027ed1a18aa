"""What a command draws into is looked at before any work; where nothing can be drawn is one sentence."""

import sys
from pathlib import Path

import pytest
from click.testing import CliRunner

from companion.__main__ import cli

COMMANDS = (
    ["loopback", "--scenario", "short"],
    ["study", "horizon"],
    ["study", "order"],
    ["study", "weights"],
)


@pytest.mark.parametrize("command", COMMANDS)
@pytest.mark.parametrize(
    ("name", "said"),
    [("none/x.png", "there is no folder"), ("x.xyz", "no suffix of a drawing"), ("x", "png")],
)
def test_a_place_that_cannot_be_drawn_into_is_told_before_any_work(
    command: list[str], name: str, said: str, tmp_path: Path
) -> None:
    pytest.importorskip("matplotlib")
    done = CliRunner().invoke(cli, [*command, "--plot", str(tmp_path / name)])
    assert done.exit_code == 2
    assert not done.stdout
    assert said in done.stderr
    assert len(done.stderr.splitlines()) == 4  # how it is used, where to ask, a blank line, and the sentence


def test_a_file_is_no_folder_of_drawings(tmp_path: Path) -> None:
    pytest.importorskip("matplotlib")
    (tmp_path / "x").touch()
    done = CliRunner().invoke(cli, ["study", "restrictive", "--plot", str(tmp_path / "x" / "y")])
    assert done.exit_code == 2 and "cannot be drawn into: Not a directory" in done.stderr


@pytest.mark.parametrize("command", [*COMMANDS, ["study", "restrictive"]])
def test_without_matplotlib_it_is_said_how_to_have_it(
    command: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "matplotlib.backend_bases", None)
    done = CliRunner().invoke(cli, [*command, "--plot", str(tmp_path / "x.png")])
    assert done.exit_code == 2
    assert "drawing needs matplotlib: run `pip install '.[plot]'`" in done.stderr
