"""States of the last seconds: which are kept, and which one a late measurement goes back to."""

from __future__ import annotations

from itertools import pairwise

import pytest
from hypothesis import given
from hypothesis import strategies as st

from companion.config import Config
from companion.navigator.hypotheses import Model
from companion.navigator.past_states import DENSE_NS, MOST_KEPT, SPARSE_NS, PastStates
from companion.navigator.state import Settings, State, initial
from companion.records import Pressure

MS = 1_000_000
LATE_NS = 6_000_000_000
INITIAL = initial(Settings(Config(), Model(Config())))


def record(t_ns: int) -> Pressure:
    return Pressure(t_ns, t_ns, 1000.0)


def before(t_ns: int) -> State:
    """A state that is recognised by its time."""
    return INITIAL._replace(next_ns=t_ns)


@given(st.lists(st.integers(0, 1500), min_size=2, max_size=120), st.floats(0.0, 1.0))
def test_goes_back_to_the_last_kept_state(gaps_ms: list[int], share: float) -> None:
    past, times, t_ns = PastStates(), list[int](), 100 * SPARSE_NS
    for gap in gaps_ms:
        t_ns += gap * MS
        past.append(record(t_ns), before(t_ns))
        times.append(t_ns)
        past.thin_out()
        past.keep_last(LATE_NS)
    assert past.first_ns <= max(times[0], t_ns - LATE_NS)  # all that may still come can be folded in
    assert past.states_ns[0] == past.first_ns
    recent = [t for t in times if t > t_ns - DENSE_NS]
    assert past.states_ns[len(past.states_ns) - len(recent) :] == recent
    older = past.states_ns[: len(past.states_ns) - len(recent)]
    assert all(b - a >= SPARSE_NS for a, b in pairwise(older[1:]))

    late_ns = past.first_ns + round(share * (t_ns - 1 - past.first_ns))
    states, kept = past.states_ns, times[len(times) - len(past) :]
    later = sum(t > late_ns for t in kept)
    if not later:
        return
    state, again = past.back_to(late_ns)
    assert state.next_ns == again[0].t_ns
    assert [each.t_ns for each in again] == kept[len(kept) - len(again) :]
    assert len(again) >= later
    assert len(past) == len(kept) - len(again)
    # no kept state is nearer to the late record
    first_after = kept[len(kept) - later]
    assert state.next_ns == max(t for t in states if t <= first_after)


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
