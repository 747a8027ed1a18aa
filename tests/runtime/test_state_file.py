"""State file: atomic writes, errors returned and retried, `put` without disk access."""

import os

import pytest

from companion.runtime import state_file
from companion.runtime.state_file import StateFile


def test_last_text_is_written(tmp_path) -> None:
    path = tmp_path / "a.toml"
    file = StateFile(path)
    assert file.write() is None and not path.exists()
    file.put("one")
    file.put("two")
    assert not path.exists()  # `put` touches no disk
    assert file.write() is None
    assert path.read_text() == "two"
    assert [p.name for p in tmp_path.iterdir()] == ["a.toml"]


def test_without_a_path_nothing_is_stored() -> None:
    file = StateFile(None)
    file.put("one")
    assert file.write() is None


def test_disk_error_is_returned_and_retried(tmp_path) -> None:
    folder = tmp_path / "not yet there"
    file = StateFile(folder / "a.toml")
    file.put("one")
    assert "cannot write" in (file.write() or "")
    with pytest.raises(OSError, match="No such file"):
        file.put("two")
    folder.mkdir()
    assert file.write() is None
    assert (folder / "a.toml").read_text() == "one"
    file.put("three")
    assert file.write() is None


def test_interrupted_write_leaves_the_old_text_or_the_new(tmp_path, monkeypatch) -> None:
    """Power loss before the sync, before the rename and after it: the file is complete."""
    path = tmp_path / "a.toml"
    state_file.replace_text(path, "old")

    class Cut(BaseException):
        pass

    def cut(*_: object) -> None:
        raise Cut

    for step in ("fsync", "replace"):
        with monkeypatch.context() as patch, pytest.raises(Cut):
            patch.setattr(state_file.os, step, cut)
            state_file.replace_text(path, "new and longer")
        assert path.read_text() == "old"
    state_file.replace_text(path, "new")
    assert path.read_text() == "new"


def test_only_a_regular_file_is_replaced(tmp_path) -> None:
    """As root /dev/null was replaced by a file (signing.stamp_file)."""
    fifo = tmp_path / "fifo"
    os.mkfifo(fifo)
    with pytest.raises(OSError, match="not a regular file"):
        state_file.replace_text(fifo, "text")
    assert fifo.is_fifo() and list(tmp_path.iterdir()) == [fifo]
