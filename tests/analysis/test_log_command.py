"""`companion log recover` overwrites no file; `companion log info` cannot control the terminal."""

from pathlib import Path

import pytest
from click.testing import CliRunner

from companion.analysis.log_command import group
from companion.records import Event
from companion.storage.flight_log import Writer
from companion.storage.reader import LogError


@pytest.fixture
def whole(tmp_path: Path) -> bytes:
    log = tmp_path / "written.mcap"
    with Writer(log, metadata={}, start_unix_ns=10**18, start_ns=0, block=True, chunk_bytes=2000) as writer:
        for k in range(100):
            writer.record(Event(k, k, 6, "hello"))
    return log.read_bytes()


@pytest.mark.parametrize("damage", ["torn", "changed"])
def test_existing_copy_is_not_overwritten(damage: str, whole: bytes, tmp_path: Path) -> None:
    log, copy = tmp_path / "flight.mcap", tmp_path / "flight.recovered.mcap"
    at = whole.index(b"zstd", len(whole) // 2) + 40  # within a chunk that is not the first
    log.write_bytes(whole[:at] if damage == "torn" else whole[:at] + bytes(20) + whole[at + 20 :])
    copy.write_bytes(b"existing")
    done = CliRunner().invoke(group, ["recover", str(log)])
    assert isinstance(done.exception, LogError)
    assert str(done.exception) == f"{copy} already exists: move it away first"
    assert copy.read_bytes() == b"existing"
    copy.unlink()
    assert CliRunner().invoke(group, ["recover", str(log)]).exit_code == 0
    assert copy.exists()


def test_recovery_without_copy_ignores_an_existing_copy(whole: bytes, tmp_path: Path) -> None:
    log, copy = tmp_path / "flight.mcap", tmp_path / "flight.recovered.mcap"
    copy.write_bytes(b"existing")
    log.write_bytes(whole)
    complete = "is complete: 200 messages"  # each event is a Foxglove log line too
    assert complete in CliRunner().invoke(group, ["recover", str(log)]).stdout
    log.unlink()
    (tmp_path / "flight.mcap.active").write_bytes(whole[:-30])
    assert CliRunner().invoke(group, ["recover", f"{log}.active"]).exit_code == 0
    assert log.exists() and copy.read_bytes() == b"existing"


@pytest.mark.parametrize("name", ["flight.mcap", "flight.mcap.active"])
@pytest.mark.parametrize("damage", ["empty", "torn", "changed"])
def test_a_log_without_messages_is_left_as_it_is(
    damage: str, name: str, whole: bytes, tmp_path: Path
) -> None:
    at = whole.index(b"zstd") + 40  # within the first chunk
    end = whole.index(b"zstd", at)  # within the head of the second
    changed = whole[:at] + bytes(20) + whole[at + 20 : end]
    left = {"empty": b"", "torn": whole[:at], "changed": changed}[damage]
    log = tmp_path / "flights" / name
    log.parent.mkdir()
    log.write_bytes(left)
    done = CliRunner().invoke(group, ["recover", str(log)])
    assert isinstance(done.exception, LogError)
    nothing = f"{log} contains no message that can be read: nothing to recover"
    assert str(done.exception) == (nothing if left else f"{log} is empty: nothing was recorded")
    assert [one.name for one in log.parent.iterdir()] == [name] and log.read_bytes() == left


def test_text_of_a_log_cannot_control_the_terminal(tmp_path: Path) -> None:
    log = tmp_path / "hostile.mcap"
    names = {"a\x1b[2J": {"k\x07": "v\x9b31m [bold]x[/]"}, "b\nc": {"d\n": "e\nf"}}
    with Writer(log, metadata=names, start_unix_ns=10**18, start_ns=0, block=True) as writer:
        writer.record(Event(1, 1, 6, "x"), "/\x1b]0;title\x07")
        writer.record(Event(2, 2, 6, "x"), "/y\nok: closed")
    shown = CliRunner().invoke(group, ["info", str(log)]).stdout
    assert r"/\x1b]0;title\x07" in shown and r"a\x1b[2J.k\x07: v\x9b31m [bold]x[/]" in shown
    assert not {"\x1b", "\x07", "\x9b"} & set(shown)
    assert r"/y\nok: closed" in shown and r"b\nc.d\n: e ... (1 more lines)" in shown
    assert not any(line.startswith(("ok", "c.d", ":")) for line in shown.splitlines())
    bad = tmp_path / "no\x1b[2J.mcap"
    bad.write_bytes(b"x")
    assert "\x1b" not in CliRunner().invoke(group, ["info", str(bad)]).stderr


def test_export_of_a_log_as_flown_rejects_a_configuration(whole: bytes, tmp_path: Path) -> None:
    log, file, output = tmp_path / "written.mcap", tmp_path / "mine.toml", tmp_path / "map.kml"
    file.write_text("[gnss]\nsigma_m = 3.0\n")
    done = CliRunner().invoke(group, ["export", str(log), "-o", str(output), "--config", str(file)])
    assert isinstance(done.exception, LogError)
    assert str(done.exception).startswith(
        f"--config {file} has no effect on {log}, which is exported as flown"
    )
    assert not output.exists()
