"""Log retention: the newest logs are kept independently of the clock; nothing is deleted in vain."""

import os
import shutil
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from companion.records import Reset
from companion.storage import retention
from companion.storage.flight_log import Writer, info
from companion.storage.reader import LogError

MIB = 1 << 20
NS = 10**9


def write_log(place: Path, unix_s: int = 0, *, max_files: int = 100, min_free: int = 0) -> str:
    """Write a log of one record and return its name."""
    with retention.create_log(
        place, metadata={}, start_unix_ns=unix_s * NS, start_ns=0, max_files=max_files, min_free=min_free
    ) as log:
        log.record(Reset(1, 1, "x", "y"))
    return log.path.name


def truncate_log(place: Path, name: str) -> Path:
    """Remove the end of a closed log."""
    torn = place / f"{name}.active"
    torn.write_bytes((place / name).read_bytes()[:-60])
    (place / name).unlink()
    return torn


def names(place: Path) -> list[str]:
    return sorted(path.name for path in place.iterdir())


class SimulatedDisk:
    """A simulated disk of `total` bytes, used by the files of a folder and by `taken` bytes of others."""

    def __init__(self, patch: pytest.MonkeyPatch, place: Path, total: int, taken: int = 0) -> None:
        self.place, self.total, self.taken = place, total, taken
        patch.setattr(shutil, "disk_usage", lambda _: shutil._ntuple_diskusage(total, 0, self.free))

    @property
    def free(self) -> int:
        return self.total - self.taken - sum(one.stat().st_blocks * 512 for one in self.place.iterdir())


def filled(place: Path, name: str, size: int = MIB) -> Path:
    path = place / name
    path.write_bytes(os.urandom(size))
    return path


@settings(max_examples=30)
@given(clock=st.lists(st.integers(0, 3) | st.integers(0, 2_000_000_000), min_size=1, max_size=12))
def test_newest_logs_are_kept_independently_of_the_clock(tmp_path_factory, clock):
    """A board without a clock battery starts in 1970 each time: names differ only in the number."""
    place = tmp_path_factory.mktemp("logs")
    made = [write_log(place, unix_s, max_files=3) for unix_s in clock]
    assert names(place) == sorted(made[-3:]) == made[-3:]


def test_logs_of_earlier_versions_are_deleted_first(tmp_path):
    """Within one second the suffix -10 is later than -2."""
    old = ["19700101T000001Z.mcap", *(f"19700101T000001Z-{i}.mcap" for i in range(2, 12))]
    old += ["20260101T000000Z.mcap", "20260101T000000Z.recovered.mcap"]
    for name in old:
        (tmp_path / name).write_bytes(b"")
    (tmp_path / "mine.mcap").write_text("keep")
    (tmp_path / "00007-mine.mcap").write_text("keep")
    for left in range(len(old), 1, -1):
        new = write_log(tmp_path, max_files=left)
        kept = {*old[len(old) - left + 1 :], new, "mine.mcap", "00007-mine.mcap"}
        assert kept <= set(names(tmp_path)) and len(names(tmp_path)) == left + 2
        (tmp_path / new).unlink()


def test_new_log_number_follows_the_greatest(tmp_path):
    assert write_log(tmp_path) == "00001-19700101T000000Z.mcap"
    filled(tmp_path, "99999-20260101T000000Z.mcap", 0)  # copied from another aircraft
    assert [write_log(tmp_path, max_files=3) for _ in range(2)] == [
        "100000-19700101T000000Z.mcap",
        "100001-19700101T000000Z.mcap",
    ]
    assert "00001-19700101T000000Z.mcap" not in names(tmp_path)
    assert truncate_log(tmp_path, write_log(tmp_path)).name == "100002-19700101T000000Z.mcap.active"
    assert write_log(tmp_path) == "100003-19700101T000000Z.mcap"


def test_processes_that_start_in_one_second_each_have_a_log(tmp_path, monkeypatch):
    free = retention._next_path

    def taken_meanwhile(folder: Path, start_unix_ns: int) -> Path:
        path = free(folder, start_unix_ns)
        if not names(folder):
            (folder / f"{path.name}.active").touch()
        return path

    monkeypatch.setattr(retention, "_next_path", taken_meanwhile)
    assert write_log(tmp_path) == "00002-19700101T000000Z.mcap"
    assert names(tmp_path) == ["00001-19700101T000000Z.mcap.active", "00002-19700101T000000Z.mcap"]


def test_unreachable_limit_deletes_nothing(tmp_path, monkeypatch):
    made = [write_log(tmp_path, i) for i in range(5)]
    SimulatedDisk(monkeypatch, tmp_path, 100 * MIB, taken=90 * MIB)
    for limit in (1 << 44, 11 * MIB):
        with pytest.raises(LogError, match=r"deleting all of them would not leave \d+ MiB free"):
            write_log(tmp_path, 9, min_free=limit, max_files=2)
        assert names(tmp_path) == made
    assert not retention.make_room(tmp_path, 11 * MIB) and names(tmp_path) == made


def test_no_more_logs_are_deleted_than_needed(tmp_path, monkeypatch):
    for number in range(1, 9):
        filled(tmp_path, f"{number:05d}-20260101T000000Z.mcap")
    disk = SimulatedDisk(monkeypatch, tmp_path, 10 * MIB)
    assert retention.make_room(tmp_path, 2 * MIB) and len(names(tmp_path)) == 8
    assert retention.make_room(tmp_path, 2 * MIB + 1) and disk.free >= 2 * MIB + 1
    assert names(tmp_path) == [f"{number:05d}-20260101T000000Z.mcap" for number in range(2, 9)]


def test_every_deletion_is_reported(tmp_path):
    for unix_s in range(3):
        write_log(tmp_path, unix_s)
    before, deleted = names(tmp_path), []
    log = retention.create_log(
        tmp_path, metadata={}, start_unix_ns=9 * NS, start_ns=0, max_files=2, on_delete=deleted.append
    )
    log.close()
    assert [path.name for path in deleted] == before[:2]
    assert set(before) - set(names(tmp_path)) == {path.name for path in deleted}


def test_torn_logs_are_deleted_by_age_but_not_a_log_being_written(tmp_path, monkeypatch):
    filled(tmp_path, "00001-20260101T000000Z.mcap.active")
    filled(tmp_path, "00002-20260101T000000Z.mcap")
    filled(tmp_path, "00003-20260101T000000Z.mcap.active")
    disk = SimulatedDisk(monkeypatch, tmp_path, 10 * MIB)
    with Writer(tmp_path / "00000-20260101T000000Z.mcap", metadata={}, start_unix_ns=0, start_ns=0) as other:
        assert retention.make_room(tmp_path, disk.free + MIB)
        assert names(tmp_path)[1:] == ["00002-20260101T000000Z.mcap", "00003-20260101T000000Z.mcap.active"]
        assert retention.make_room(tmp_path, 0, max_files=0)
        assert names(tmp_path) == [f"{other.path.name}.active"]
    assert info(other.path).closed


def test_recovery_deletes_the_oldest_and_keeps_the_newest(tmp_path, monkeypatch):
    torn = [truncate_log(tmp_path, write_log(tmp_path, i)) for i in range(4)]
    wanted = []

    def make_room(place: Path, wanted_bytes: int, **rest) -> bool:
        wanted.append(wanted_bytes)
        return real(place, 0, max_files=3 if len(wanted) == 1 else None)

    real = retention.make_room
    monkeypatch.setattr(retention, "make_room", make_room)
    saved = retention.recover_unclosed(tmp_path, 1 << 60)  # each needs space, and only the first gets some
    assert saved == [] and names(tmp_path) == [one.name for one in torn[1:]] and len(wanted) == 3
    assert [one.path.name for one in retention.recover_unclosed(tmp_path)] == [
        one.name.removesuffix(".active") for one in torn[:0:-1]
    ]


def test_complete_log_is_only_renamed(tmp_path):
    name = write_log(tmp_path)
    (tmp_path / name).rename(tmp_path / f"{name}.active")  # killed before the rename
    node = (tmp_path / f"{name}.active").stat().st_ino
    (saved,) = retention.recover_unclosed(tmp_path, 1 << 60)
    assert (saved.path, saved.messages) == (tmp_path / name, 1)
    assert saved.path.stat().st_ino == node and names(tmp_path) == [name]
    assert retention.recover_unclosed(tmp_path) == []
