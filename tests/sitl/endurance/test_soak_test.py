"""Soak test: short sorties here, a day by `companion soak`."""

from collections import deque
from itertools import pairwise
from pathlib import Path

import pytest

from sitl.endurance import soak_test as soak_module
from sitl.endurance.soak_test import (
    QUIET_S,
    SOAK_FAULTS,
    SORTIE_S,
    SORTIES,
    HourStatistics,
    ReachableObjects,
    count_reachable,
    find_failures,
    make_sortie,
    run_soak,
)


@pytest.mark.flight
def test_short_sorties_stay_within_the_limits(tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setattr(soak_module, "SORTIES", 2)
    monkeypatch.setattr(soak_module, "QUIET_S", 30.0)  # of 120 s there is no fault in so short a sortie
    assert all(make_sortie(number, 1, 150.0).faults for number in range(4))
    hours = list(run_soak(2, 1, tmp_path, sortie_s=150.0))
    assert all(hour.quiet_s > 30 and hour.solutions_hz > 4.0 for hour in hours)
    assert not [sentence for sentence in find_failures(hours) if "_hz" not in sentence]


def test_sorties_of_a_day_cover_every_fault_with_quiet_time_between() -> None:
    seen = set()
    for number in range(24 * SORTIES):
        scenario = make_sortie(number, 1)
        assert scenario == make_sortie(number, 1) != make_sortie(number, 2)
        spans = sorted((fault.start_s, fault.end_s) for fault in scenario.faults)
        assert len(spans) >= 3 and spans[0][0] >= QUIET_S and spans[-1][1] <= SORTIE_S - QUIET_S
        assert all(later[0] - before[1] >= QUIET_S for before, later in pairwise(spans))
        seen |= {fault.name for fault in scenario.faults}
    assert seen == set(SOAK_FAULTS)


GOOD = HourStatistics(1, 100.0, 4000, 128, 500.0, 0, 6.0, 11.0, 88.0, 600.0, 300, 4, 30, 60.0)


def test_growth_is_reported() -> None:
    near = GOOD._replace(hour=2, resident_mib=104.9, solutions_hz=6.05, messages_hz=10.4)
    assert find_failures([GOOD, near]) == []
    for change, word in (
        ({"resident_mib": 105.1}, "resident_mib grew from 100 to 105.1"),
        ({"objects": 4300}, "objects grew"),
        ({"longest": 5000}, "a container has 5000"),
        ({"solutions_hz": 5.9}, "solutions_hz went"),
        ({"received_hz": 87.0}, "received_hz went"),
        ({"messages_hz": 10.3}, "messages_hz went"),  # 5 % may have left early in the first hour
        ({"waiting_kib": 40_000.0}, "waited for the log"),
        ({"dropped": 1}, "1 dropped"),
    ):
        (sentence,) = find_failures([GOOD, GOOD._replace(hour=2, **change)])
        assert word in sentence and sentence.startswith("hour 2: ")


@pytest.mark.parametrize("change", [{"solutions_hz": 4.9}, {"messages_hz": 7.9}])
def test_rates_that_are_low_from_the_start_are_reported(change: dict[str, float]) -> None:
    """Regression: a day without any solution passed, as its hours were alike."""
    low = GOOD._replace(**change)
    (sentence,) = find_failures([low, low._replace(hour=2)])
    ((name, rate),) = change.items()
    assert sentence.startswith(f"hour 1: {name} is {rate} (configured ")


def test_a_leak_is_found_among_counts_that_differ_by_a_tenth() -> None:
    def day(leak: int) -> list[HourStatistics]:
        """A count differs by a tenth from hour to hour, in no order."""
        return [GOOD._replace(hour=h, objects=4000 + 97 * h % 400 + leak * (h - 1)) for h in range(1, 25)]

    assert find_failures(day(0)) == []
    (sentence,) = find_failures(day(20))  # half a per cent an hour
    assert sentence.startswith("hour 19: objects grew from 40")


class BoundedHolder:
    def __init__(self) -> None:
        self.kept = deque[list[int]](maxlen=64)
        self.self = self

    def work(self) -> None:
        self.kept.append([len(self.kept)])


def test_reachable_objects_are_counted_once() -> None:
    it = BoundedHolder()
    empty = count_reachable(it)
    for _ in range(1000):
        it.work()
    assert (
        count_reachable(it) == ReachableObjects(count_reachable(it).objects, 64)
        and 64 <= count_reachable(it).objects - empty.objects < 200
    )
    assert count_reachable(it, exclude=(it.kept,)).longest < 64
