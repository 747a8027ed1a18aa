"""Estimates against the truth of a live simulator: errors as they come, and the table after a loss of GNSS.

Truth comes in samples, estimates with times of their own, each a little before or after the other. An
estimate waits until the truth is known on both sides of it. It knows no message and no link.
"""

from __future__ import annotations

import math
from bisect import bisect_left
from collections import deque
from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np

from companion.nav.geometry import Geodetic, separation

SECOND = 1_000_000_000
REMEMBERED_NS = 20 * SECOND
MOST_WAITING = 1000  # estimates: truth that comes no more is not waited for
GAP_NS = 1 * SECOND  # nor is it drawn across a longer hole
AFTER_S = (30, 60, 120, 180)  # at which the table tells the error
NEAR_NS = 2 * SECOND


class Scored(NamedTuple):
    """The horizontal error of one estimate, m: estimate minus truth; the sigma and the guaranteed bound that
    it stated, m, None where it did not; and the truth.
    """

    t_ns: int
    source: str
    north: float
    east: float
    sigma: float | None
    bound: float | None
    true: Geodetic

    @property
    def error(self) -> float:
        """Its length."""
        return math.hypot(self.north, self.east)


class _Estimate(NamedTuple):
    t_ns: int
    source: str
    place: Geodetic
    sigma: float | None
    bound: float | None


class Row(NamedTuple):
    """One source while GNSS was lost: errors (m) by seconds since the loss, None where there was none, their
    r.m.s. and maximum, and the share within three stated sigmas."""

    source: str
    at: dict[int, float | None]
    rms: float
    largest: float
    samples: int
    within: float | None


class Comparison:
    """One flight's truth and estimates; `scored` grows in order of time, nearly."""

    def __init__(self) -> None:
        self.scored: list[Scored] = []
        self._truth: deque[tuple[int, Geodetic]] = deque()
        self._waiting: deque[_Estimate] = deque(maxlen=MOST_WAITING)

    def truth(self, t_ns: int, place: Geodetic) -> None:
        """The aircraft was at `place`. What is not later than the last is not used."""
        if self._truth and t_ns <= self._truth[-1][0]:
            return
        self._truth.append((t_ns, place))
        while self._truth[0][0] < t_ns - REMEMBERED_NS:
            self._truth.popleft()
        for _ in range(len(self._waiting)):
            self._score(self._waiting.popleft())

    def estimate(
        self,
        t_ns: int,
        source: str,
        place: Geodetic,
        sigma: float | None = None,
        bound: float | None = None,
    ) -> None:
        """`source` says that it was at `place`, to `sigma` metres and by `bound` metres r.m.s. at most."""
        self._score(_Estimate(t_ns, source, place, sigma, bound))

    def _score(self, said: _Estimate) -> None:
        if not self._truth or said.t_ns > self._truth[-1][0]:
            self._waiting.append(said)
            return
        true = self._truth_at(said.t_ns)
        if true is not None:
            north, east, _ = separation(said.place, true).tolist()
            self.scored.append(Scored(said.t_ns, said.source, north, east, said.sigma, said.bound, true))

    def _truth_at(self, t_ns: int) -> Geodetic | None:
        """Linear between two samples; None before the first, and in a hole."""
        k = bisect_left(self._truth, t_ns, key=lambda sample: sample[0])
        after_ns, after = self._truth[k]
        if after_ns == t_ns:
            return after
        if k == 0:
            return None
        before_ns, before = self._truth[k - 1]
        if after_ns - before_ns > GAP_NS:
            return None
        part = (t_ns - before_ns) / (after_ns - before_ns)
        east = math.remainder(after.lon - before.lon, math.tau)
        return Geodetic(
            before.lat + part * (after.lat - before.lat),
            before.lon + part * east,
            before.alt + part * (after.alt - before.alt),
        )


def nearest(scored: Iterable[Scored], source: str, t_ns: int) -> Scored | None:
    """What `source` said next to `t_ns`, None where nothing is near."""
    near = [s for s in scored if s.source == source and abs(s.t_ns - t_ns) <= NEAR_NS]
    return min(near, key=lambda s: abs(s.t_ns - t_ns), default=None)


def table(scored: Sequence[Scored], start_ns: int, end_ns: int) -> list[Row]:
    """A row for each source heard between two instants; seconds count from the first."""
    rows = []
    for source in dict.fromkeys(s.source for s in scored):
        inside = [s for s in scored if s.source == source and start_ns <= s.t_ns < end_ns]
        if not inside:
            continue
        errors = np.array([s.error for s in inside])
        marks = {s: start_ns + s * SECOND for s in AFTER_S}
        at = {s: nearest(inside, source, mark) for s, mark in marks.items() if mark < end_ns}
        stated = [s.error <= 3.0 * s.sigma for s in inside if s.sigma is not None]
        rows.append(
            Row(
                source,
                {s: found.error if (found := at.get(s)) else None for s in AFTER_S},
                float(np.sqrt(np.mean(errors**2))),
                float(errors.max()),
                len(inside),
                sum(stated) / len(stated) if stated else None,
            )
        )
    return rows
