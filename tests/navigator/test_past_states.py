"""States of the last seconds: which are kept, and which one a late measurement goes back to."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from companion.estimate.bank import Layout, start
from companion.estimate.kalman import Gaussian
from companion.navigator.past_states import DENSE_NS, MOST_KEPT, SPARSE_NS, PastStates
from companion.navigator.state import Newborn, State
from companion.records import Pressure

MS = 1_000_000
LATE_NS = 6_000_000_000
START_NS = 100 * SPARSE_NS
LAYOUT = Layout(2, (), (), (), grades=(1.0,))
ESTIMATE = Gaussian(np.zeros(2), np.eye(2))


def record(t_ns: int) -> Pressure:
    return Pressure(t_ns, t_ns, 1000.0)


def before(t_ns: int) -> State:
    """A state that is recognised by its time."""
    return State(next_ns=t_ns)


class Kept:
    """Past states as the navigator uses them, and what must hold of them after each record."""

    def __init__(self) -> None:
        self.past = PastStates()
        self.times = list[int]()

    def append(self, t_ns: int) -> None:
        self.past.append(record(t_ns), before(t_ns))
        self.past.thin_out()
        self.past.keep_last(LATE_NS)
        self.times.append(t_ns)

    def fold_late(self, late_ns: int) -> None:
        states, kept = self.past.states_ns, self.times[len(self.times) - len(self.past) :]
        state, again = self.past.back_to(late_ns)
        first_later = next(t for t in kept if t > late_ns)
        assert state.next_ns == again[0].t_ns == max(t for t in states if t <= first_later)
        again_ns = [each.t_ns for each in again]
        assert again_ns == kept[len(kept) - len(again) :]
        assert len(self.past) == len(kept) - len(again)
        del self.times[len(self.times) - len(again) :]
        for t_ns in sorted([*again_ns, late_ns]):
            self.append(t_ns)

    def check(self, gap_ns: int) -> None:
        states, last = self.past.states_ns, self.times[-1]
        assert self.past.first_ns <= max(self.times[0], last - LATE_NS)  # all that may come can be folded in
        assert states[0] == self.past.first_ns
        recent = [t for t in self.times[-len(self.past) :] if t > last - DENSE_NS]
        assert states[len(states) - len(recent) :] == recent
        older = states[: len(states) - len(recent) + 1]
        assert all(b - a < SPARSE_NS + gap_ns for a, b in pairwise(older))
        assert len(older) <= 2 * LATE_NS // SPARSE_NS + 3


@given(st.lists(st.tuples(st.integers(0, 300), st.none() | st.floats(0.0, 1.0)), min_size=2, max_size=150))
def test_goes_back_to_the_last_kept_state(steps: list[tuple[int, float | None]]) -> None:
    """Records, each of which may be followed by a late one."""
    kept, t_ns = Kept(), START_NS
    for gap_ms, share in steps:
        t_ns += gap_ms * MS
        kept.append(t_ns)
        if share is not None and kept.past.first_ns < t_ns:
            kept.fold_late(kept.past.first_ns + round(share * (t_ns - 1 - kept.past.first_ns)))
        kept.check(300 * MS)


@pytest.mark.parametrize("late_ms", [30, 100, 300, 900, 2000])
def test_late_records_that_come_often_cost_no_state(late_ms: int) -> None:
    """One of ten records is late: as GNSS at 5 Hz is."""
    kept = Kept()
    for k in range(1500):
        t_ns = START_NS + 20 * k * MS
        kept.append(t_ns)
        if k % 10 == 9 and late_ms * MS < t_ns - START_NS:
            kept.fold_late(t_ns - late_ms * MS - 1)
        kept.check(20 * MS)


def test_a_kept_state_holds_one_bank() -> None:
    """What is readied or was read off before follows from the bank: a second one takes as much memory."""
    past = PastStates()
    now, old = (start(LAYOUT, float(t), np.zeros(2), np.eye(2)) for t in (1, 0))
    for leading in (old, now):
        past.append(
            record(START_NS),
            State(bank=now, newborn=Newborn(now, old, is_reduced=True), leading=(leading, ESTIMATE)),
        )
        past.append(record(START_NS + DENSE_NS), State())
        past.thin_out()
        state, _ = past.back_to(START_NS - 1)
        assert state == State(bank=now, leading=(now, ESTIMATE) if leading is now else None)


def test_nothing_goes_back_to_what_is_forgotten() -> None:
    past = PastStates()
    for k in range(400):
        if k == 100:
            past.forget()
        past.append(record(k * 20 * MS), before(k * 20 * MS))
        past.thin_out()
        past.keep_last(LATE_NS)
    state, _ = past.back_to(past.first_ns)
    assert state.next_ns >= 100 * 20 * MS


def test_number_of_records_is_limited() -> None:
    past = PastStates()
    for k in range(2 * MOST_KEPT):
        past.append(record(k), before(k))
    assert (len(past), past.first_ns, past.last_ns) == (MOST_KEPT, MOST_KEPT, 2 * MOST_KEPT - 1)


@pytest.mark.parametrize("count", [1, 2, 5])
def test_the_last_record_dates_what_is_too_late(count: int) -> None:
    past = PastStates()
    for k in range(count):
        past.append(record(k), before(k))
    past.forget()
    assert (len(past), past.first_ns) == (1, count - 1)
