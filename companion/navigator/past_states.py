"""The last seconds: records in order of time, and the states that late measurements go back to."""

from __future__ import annotations

from bisect import bisect_right
from collections import deque
from collections.abc import Callable
from itertools import islice
from operator import attrgetter
from typing import NamedTuple

from msgspec import structs

from companion.navigator.state import State
from companion.records import Input

MOST_KEPT = 1024  # records
#: A state takes up to 1.1 MB: of those older than DENSE_NS one per SPARSE_NS is kept.
DENSE_NS, SPARSE_NS = 500_000_000, 1_000_000_000


class _Past(NamedTuple):
    record: Input
    before: State | None  # None: dropped; the first one of all has a state


_time: Callable[[_Past], int] = attrgetter("record.t_ns")


def _lean(state: State) -> State:
    """The state with one bank only: what follows from it is computed again where it is gone back to."""
    leading = state.leading
    if leading is not None and leading[0] is not state.bank:
        leading = None
    return structs.replace(state, newborn=None, leading=leading)


class PastStates:
    """Records and the states before them."""

    def __init__(self) -> None:
        self._past: deque[_Past] = deque()
        self._thinned_ns = self._kept_ns = 0  # until when the states are thinned out; the last one kept there

    def __len__(self) -> int:
        """Number of records."""
        return len(self._past)

    @property
    def first_ns(self) -> int:
        """Time of the oldest record: nothing before it can be folded in."""
        return _time(self._past[0])

    @property
    def last_ns(self) -> int:
        """Time of the newest record."""
        return _time(self._past[-1])

    @property
    def states_ns(self) -> list[int]:
        """Times of the records whose states are kept."""
        return [_time(past) for past in self._past if past.before is not None]

    def append(self, record: Input, before: State) -> None:
        """Append a record that is not older than the last, and the state before it."""
        self._past.append(_Past(record, before))
        if len(self._past) > MOST_KEPT:
            self._drop_first()

    def back_to(self, t_ns: int) -> tuple[State, list[Input]]:
        """Remove and return a state, and all records from it on: at least those later than `t_ns`."""
        place = bisect_right(self._past, t_ns, key=_time)
        while (before := self._past[place].before) is None:
            place -= 1
        later = [self._past.pop().record for _ in range(place, len(self._past))]
        self._thinned_ns = min(self._thinned_ns, later[-1].t_ns - 1)
        kept = (_time(past) for past in reversed(self._past) if past.before is not None)
        self._kept_ns = next((t for t in kept if t <= self._thinned_ns), 0)
        return before, later[::-1]

    def thin_out(self) -> None:
        """Drop states of the records that have become older than DENSE_NS.

        The second one is kept: after `forget` the first is from before.
        """
        past, until_ns = self._past, self.last_ns - DENSE_NS
        i = bisect_right(past, self._thinned_ns, key=_time)
        while i < len(past) and _time(past[i]) <= until_ns:
            record, before = past[i]
            self._thinned_ns = record.t_ns
            is_kept = self._thinned_ns - self._kept_ns >= SPARSE_NS or i <= 1
            if is_kept:
                self._kept_ns = self._thinned_ns
            past[i] = _Past(record, _lean(before) if is_kept and before is not None else None)
            i += 1

    def keep_last(self, span_ns: int) -> None:
        """Drop what a measurement of the last `span_ns` does not go back to."""
        oldest_ns = self.last_ns - span_ns
        while self.first_ns + SPARSE_NS < oldest_ns and self._second_ns() <= oldest_ns:
            self._drop_first()

    def _second_ns(self) -> int:
        """Time of the second state."""
        return next(_time(past) for past in islice(self._past, 1, None) if past.before is not None)

    def forget(self) -> None:
        """Drop all but the last record: it dates what is too late, and nothing goes back to its state."""
        while len(self._past) > 1:
            self._past.popleft()

    def _drop_first(self) -> None:
        """Drop the first record, and those that could only be folded again from its state."""
        self._past.popleft()
        while self._past[0].before is None:
            self._past.popleft()
