"""Command check-config: rejects what `run` rejects, and only warns of files of another computer."""

import os
from pathlib import Path

import pytest
from click.testing import CliRunner

from companion.command_line import cli
from companion.config import Config, ConfigError, LinkConfig
from companion.runtime.link_addresses import check_links


@pytest.mark.parametrize(
    ("links", "expected"),
    [
        (["serial:/dev/ttyAMA0"], "is not a connection string: give serial:DEVICE:BAUD"),
        (["udpin:127.0.0.1"], "'udpin:127.0.0.1' is not a connection string"),
        (["serial:/dev/ttyAMA0:abc"], "'abc' is not a baud rate: give one like 57600"),
        (["serial:/dev/ttyAMA0:0"], "0 is not a baud rate of this system: give one like 57600"),
        (["udpin:14550", "udpin:127.0.0.1:14550"], "is the same link as 'udpin:14550': remove one"),
        (["serial:/dev/ttyS0:57600", "serial:/dev/ttyS0:115200"], "is the same link as 'serial:/dev/ttyS0"),
        (["tcp:sitl.local:5760", "udpin:14550", "tcp:sitl.local:5760"], "same link as 'tcp:sitl.local:5760'"),
    ],
)
def test_links_that_run_rejects_are_rejected(links: list[str], expected: str) -> None:
    pairs = f"link.connect={links}".replace("'", '"')
    for command in ("check-config", "run"):
        done = CliRunner().invoke(cli, [command, "--set", pairs])
        assert isinstance(done.exception, ConfigError), command
        assert str(done.exception).startswith("link.connect: ") and expected in str(done.exception)


def test_different_links_are_accepted() -> None:
    links = ("udpin:14550", "udpin:14551", "tcpin:14550", "udpin:0.0.0.0:14550", "serial:/dev/ttyS0:57600")
    check_links(Config(link=LinkConfig(connect=links)))


def test_unreadable_signing_key_is_only_a_warning(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    for path, why in ((tmp_path / "none", "cannot be read"), (tmp_path / "pipe", "is not a regular file")):
        done = CliRunner().invoke(cli, ["check-config", "--set", f"signing.key_file={path}"])
        assert done.exit_code == 0 and "[signing]" in done.stdout
        (line,) = done.stderr.splitlines()
        assert line.startswith(f"companion: warning: signing.key_file: {path}") and why in line
