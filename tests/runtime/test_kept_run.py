"""What a run keeps of a flight: taken once, by the next run of the same boot, version and links."""

import os
from pathlib import Path

import pytest

from companion.config import Config, load, to_toml
from companion.runtime import kept_run
from companion.runtime.kept_run import Flown, KeptRun

CONFIG = Config()
FLOWN = Flown(1, -5, to_toml(CONFIG), bytes(range(256)))


@pytest.fixture(autouse=True)
def without_systemd(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("RUNTIME_DIRECTORY", raising=False)


@pytest.fixture
def boot(tmp_path: Path) -> Path:
    path = tmp_path / "boot_id"
    path.write_text("one\n")
    return path


def test_the_next_run_takes_it_once(tmp_path: Path, boot: Path) -> None:
    """What crashed one run, and the next, does not crash the third."""
    assert KeptRun(tmp_path, boot).keep(FLOWN) == ""
    assert KeptRun(tmp_path, boot).take(CONFIG) == FLOWN
    assert KeptRun(tmp_path, boot).take(CONFIG) is None
    assert [path.name for path in tmp_path.iterdir()] == ["boot_id"]


def test_systemd_has_a_better_place_for_it(tmp_path: Path, boot: Path, monkeypatch) -> None:
    monkeypatch.setenv("RUNTIME_DIRECTORY", str(tmp_path))
    KeptRun(tmp_path / "logs", boot).keep(FLOWN)
    assert (tmp_path / kept_run.NAME).exists()


def test_a_run_that_ended_as_requested_leaves_nothing(tmp_path: Path, boot: Path) -> None:
    kept = KeptRun(tmp_path, boot)
    kept.keep(FLOWN)
    kept.end()
    kept.keep(FLOWN)  # was on its way to the disk
    assert [path.name for path in tmp_path.iterdir()] == ["boot_id"]


def test_a_run_that_ends_while_its_file_is_replaced_leaves_nothing(
    tmp_path: Path, boot: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    kept, replace = KeptRun(tmp_path, boot), os.replace

    def slow(new: Path, path: Path) -> None:
        kept.end()
        replace(new, path)

    monkeypatch.setattr(os, "replace", slow)
    assert kept.keep(FLOWN) == ""
    assert [path.name for path in tmp_path.iterdir()] == ["boot_id"]


def test_it_is_of_this_boot_this_version_and_these_links_only(
    tmp_path: Path, boot: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def taken(config: Config = CONFIG) -> Flown | None:
        return KeptRun(tmp_path, boot).take(config)

    KeptRun(tmp_path, boot).keep(FLOWN)
    assert taken(load(flags={"link.connect": ("tcp:127.0.0.1:5760",)}, environment={})) is None
    KeptRun(tmp_path, boot).keep(FLOWN)
    boot.write_text("two\n")
    assert taken() is None
    KeptRun(tmp_path, boot).keep(FLOWN)
    monkeypatch.setattr(kept_run, "__version__", "0.0")
    assert taken() is None


@pytest.mark.parametrize(
    "data",
    [b"", b"\x00", b"{}", bytes(1000), b"\x83\xa4boot\xa1\xff", b"\x81\xa3abc" + b"\x91" * 100_000],
    ids=["empty", "number", "text", "zeros", "no UTF-8", "nested"],
)
def test_what_is_no_such_file_is_not_used(tmp_path: Path, boot: Path, data: bytes) -> None:
    (tmp_path / kept_run.NAME).write_bytes(data)
    assert KeptRun(tmp_path, boot).take(CONFIG) is None


def test_a_pipe_in_its_place_does_not_hold_up_the_start(tmp_path: Path, boot: Path) -> None:
    os.mkfifo(tmp_path / kept_run.NAME)
    assert KeptRun(tmp_path, boot).take(CONFIG) is None


def test_a_disk_that_fails_is_named(tmp_path: Path, boot: Path) -> None:
    kept = KeptRun(tmp_path / "none", boot)
    assert kept.take(CONFIG) is None
    assert kept.keep(FLOWN) == f"cannot write {tmp_path / 'none' / kept_run.NAME}: No such file or directory"
