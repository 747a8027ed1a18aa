"""Mutated logs of every format give records or one sentence; `make fuzz` runs many more."""

import pathlib
import random

import pytest

from companion.importers import sources
from companion.records import Event, Rejection
from companion.storage import flight_log
from sitl.endurance import file_mutants
from sitl.endurance.sample_logs import SAMPLES


@pytest.mark.parametrize("name", SAMPLES)
def test_sample_is_read_without_damage(name: str, tmp_path: pathlib.Path) -> None:
    file_name, build = SAMPLES[name]
    path = tmp_path / file_name
    path.write_bytes(build())
    if "mcap" in name:
        assert flight_log.info(path).messages > 0
        return
    records = list(sources.open_source(tmp_path if ".csv" in file_name else path))
    assert len(records) > 20
    assert not any("damaged" in record.text for record in records if isinstance(record, Event))


@pytest.mark.parametrize("name", SAMPLES)
def test_mutants_give_records_or_one_sentence(name: str) -> None:
    count = 40 if name == "mat" else 100  # the reader of .mat is a process
    found = file_mutants.read_mutants(name, count, seed=7)
    assert (found.defects, found.first_defect) == (0, "")
    assert found.read + found.rejected == count and found.read > 0


@pytest.mark.parametrize("name", ["bin", "log", "ulg", "tlog", "csv"])
@pytest.mark.parametrize("damage", [b"\n", b'"', b"\x00", b"9" * 400])
def test_one_damage_after_the_definitions_loses_its_neighbours_only(
    name: str, damage: bytes, tmp_path: pathlib.Path
) -> None:
    file_name, build = SAMPLES[name]
    path, whole, rng = tmp_path / file_name, build(), random.Random(name)

    def count() -> int:
        found = sources.open_source(tmp_path if ".csv" in file_name else path)
        return sum(not isinstance(record, Event | Rejection) for record in found)

    path.write_bytes(whole)
    complete = count()
    for at in (rng.randrange(len(whole) // 2, len(whole)) for _ in range(20)):
        path.write_bytes(whole[:at] + damage + whole[at + rng.randrange(2) :])
        assert count() >= complete - 4, at


def test_mutant_differs_and_is_repeatable() -> None:
    seed = bytes(range(256))
    first = [file_mutants.mutate(seed, random.Random(k)) for k in range(50)]
    assert first == [file_mutants.mutate(seed, random.Random(k)) for k in range(50)]
    assert sum(mutant != seed for mutant in first) > 40


@pytest.mark.parametrize("kind", [ValueError("first\nsecond"), RuntimeError("x"), None])
def test_defect_is_found(
    monkeypatch: pytest.MonkeyPatch, kind: Exception | None, tmp_path: pathlib.Path
) -> None:
    """The harness itself: an exception, a sentence of two lines, and a reader that never ends."""

    def read(path: pathlib.Path) -> None:
        if kind is None:
            while True:
                pass
        raise file_mutants.LogError(str(kind)) if "\n" in str(kind) else kind

    monkeypatch.setattr(file_mutants, "read_foreign", read)
    monkeypatch.setattr(file_mutants, "SLOWEST_S", 0.05)
    found = file_mutants.read_mutants("bin", 1, seed=1, keep=tmp_path / "kept")
    assert found.defects == 1 and len(list((tmp_path / "kept").iterdir())) == 1
