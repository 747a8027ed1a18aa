"""Messages leave at their rates, whatever the number of solutions; fixes raise them by 5 % at most."""

import itertools

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from companion.output.pace import EARLY_SHARE, Pace

MS = 1_000_000
PERIOD = 100 * MS


def sent(times: list[int], fixes: set[int], at_least: tuple[str, ...] = ()) -> list[int]:
    pace = Pace(at_least)
    return [t for t in times if pace.due({"X": PERIOD}, t, ("X",) if t in fixes else ())]


def test_without_fixes_the_rate_is_exact() -> None:
    times = list(range(0, 60_000 * MS, 20 * MS))
    assert len(sent(times, set())) == 600


@settings(max_examples=50)
@given(st.sets(st.integers(0, 30_000), max_size=3000))
def test_fixes_raise_the_rate_by_five_per_cent_at_most_and_leave_no_gap(fixes: set[int]) -> None:
    early = {7 * MS * fix for fix in fixes}
    times = sorted({*range(0, 210_000 * MS, 25 * MS), *early})
    found = sent(times, early)
    assert len(found) <= (1.0 + EARLY_SHARE) * 2100 + 2
    gaps = [b - a for a, b in itertools.pairwise(found)]
    assert max(gaps) <= PERIOD + 25 * MS  # never a period missed: the solutions come every 25 ms


def test_a_fix_once_a_second_goes_out_at_once() -> None:
    """The phase follows the fixes: after a while the budget always suffices."""
    fixes = {k * 1000 * MS + 533 * MS for k in range(5, 60)}
    times = sorted({*range(0, 60_000 * MS, 10 * MS), *fixes})
    found = set(sent(times, fixes))
    assert len(fixes & found) >= 0.9 * len(fixes)


def test_a_fix_at_the_time_of_a_message_is_in_the_next_one() -> None:
    """An autopilot takes one of two messages with the same time; the budget is kept for a later fix."""
    times = sorted([*range(0, 60_000 * MS, 100 * MS), *range(0, 60_000 * MS, 1000 * MS)])
    found = sent(times, set(times))
    assert len(found) == len(set(found)) == 600


@pytest.mark.parametrize("late_ms", [30, 250])
def test_a_minimum_period_is_never_shortened(late_ms: int) -> None:
    times = [k * 10 * MS for k in range(100) if not 20 < k < 20 + late_ms // 10]
    found = sent(times, set(), ("X",))
    assert min(b - a for a, b in itertools.pairwise(found)) >= PERIOD
