"""A companion that is never restarted holds what it held: an hour's worth here, a day by `companion soak`."""

from collections import deque
from itertools import pairwise
from pathlib import Path

from sitl.endurance import soak_test as soak_module
from sitl.endurance.soak_test import (
    NAMES,
    QUIET_S,
    SORTIE_S,
    SORTIES,
    Held,
    Hour,
    failures,
    held,
    soak,
    sortie,
)


def test_a_few_short_sorties_leave_nothing_behind(tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setattr(soak_module, "SORTIES", 2)
    hours = list(soak(2, 1, tmp_path, sortie_s=150.0))
    assert all(hour.quiet_s > 30 and hour.solutions_hz > 4.0 for hour in hours)
    assert not [sentence for sentence in failures(hours) if "_hz" not in sentence]


def test_the_sorties_of_a_day_have_every_fault_and_quiet_between() -> None:
    seen = set()
    for number in range(24 * SORTIES):
        scenario = sortie(number, 1)
        assert scenario == sortie(number, 1) != sortie(number, 2)
        spans = sorted((fault.start_s, fault.end_s) for fault in scenario.faults)
        assert len(spans) >= 3 and spans[0][0] >= QUIET_S and spans[-1][1] <= SORTIE_S - QUIET_S
        assert all(later[0] - before[1] >= QUIET_S for before, later in pairwise(spans))
        seen |= {fault.name for fault in scenario.faults}
    assert seen == set(NAMES)


GOOD = Hour(1, 100.0, 4000, 128, 500.0, 0, 6.0, 11.0, 88.0, 600.0, 300, 4, 30, 60.0)


def test_the_judge_sees_what_grows() -> None:
    assert failures([GOOD, GOOD._replace(hour=2, resident_mib=104.9, solutions_hz=6.05)]) == []
    for change, word in (
        ({"resident_mib": 105.1}, "resident_mib grew from 100 to 105.1"),
        ({"objects": 4300}, "objects grew"),
        ({"longest": 5000}, "a container holds 5000"),
        ({"solutions_hz": 5.9}, "solutions_hz went"),
        ({"waiting_kib": 40_000.0}, "waited for the log"),
        ({"dropped": 1}, "1 dropped"),
    ):
        (sentence,) = failures([GOOD, GOOD._replace(hour=2, **change)])
        assert word in sentence and sentence.startswith("hour 2: ")


class Leaky:
    def __init__(self) -> None:
        self.kept = deque[list[int]](maxlen=64)
        self.self = self

    def work(self) -> None:
        self.kept.append([len(self.kept)])


def test_what_is_held_is_counted_once_and_no_deeper_than_the_object() -> None:
    it = Leaky()
    empty = held(it)
    for _ in range(1000):
        it.work()
    assert held(it) == Held(held(it).objects, 64) and 64 <= held(it).objects - empty.objects < 200
    assert held(it, but=(it.kept,)).longest < 64
