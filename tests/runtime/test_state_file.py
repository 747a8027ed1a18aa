"""What must outlive a restart is kept whole, soon, and waited for by nobody who navigates."""

import pytest

from companion.runtime import state_file
from companion.runtime.state_file import Kept


def test_the_last_put_is_what_is_written(tmp_path) -> None:
    path = tmp_path / "a.toml"
    text = Kept(path)
    assert text.write() is None and not path.exists()
    text.put("one")
    text.put("two")
    assert not path.exists()  # `put` touches no disk
    assert text.write() is None
    assert path.read_text() == "two"
    assert [p.name for p in tmp_path.iterdir()] == ["a.toml"]


def test_without_a_place_nothing_is_kept_and_nothing_refused() -> None:
    text = Kept(None)
    text.put("one")
    assert text.write() is None


def test_a_disk_that_refuses_is_said_and_tried_again(tmp_path) -> None:
    folder = tmp_path / "not yet there"
    text = Kept(folder / "a.toml")
    text.put("one")
    assert "cannot write" in (text.write() or "")
    with pytest.raises(OSError, match="No such file"):
        text.put("two")
    folder.mkdir()
    assert text.write() is None
    assert (folder / "a.toml").read_text() == "one"
    text.put("three")
    assert text.write() is None


def test_a_cut_at_any_step_leaves_the_old_text_or_the_new(tmp_path, monkeypatch) -> None:
    """Power goes before the sync, before the new name, after it: what stands under the name is whole."""
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
