"""Position errors against the truth of a live simulator, and the error table of a GNSS outage.

Truth samples and estimates have different time stamps and arrive in any order. An estimate waits until truth
samples on both sides of it are known. Messages and links are not handled here.
"""

from __future__ import annotations

import math
from bisect import bisect_left
from collections import deque
from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np

from companion.analysis.error_statistics import root_mean_square
from companion.nav.geometry import Geodetic, separation
from companion.units import SECOND_NS

TRUTH_HISTORY_NS = 20 * SECOND_NS
MOST_WAITING = 1000  # estimates: bounds the queue when the truth stops
GAP_NS = 1 * SECOND_NS  # truth is not interpolated across a longer gap
AFTER_S = (30, 60, 120, 180)  # after the loss: the table lists the error at these times
NEAR_NS = 2 * SECOND_NS


class PositionError(NamedTuple):
    """Horizontal error of one estimate, m: estimate minus truth.

    `sigma` and `bound` are the stated sigma and guaranteed bound, m, None where not stated; `true` is the
    truth.
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
        """Horizontal distance, m."""
        return math.hypot(self.north, self.east)


class OutageErrors(NamedTuple):
    """Errors of one source during a GNSS outage, m.

    `at` maps seconds since the loss to the error (None: no estimate near); `within` is the share of errors
    within three stated sigmas.
    """

    source: str
    at: dict[int, float | None]
    rms: float
    largest: float
    samples: int
    within: float | None


class Comparison:
    """Truth and estimates of one flight. `errors` is appended nearly in order of time."""

    def __init__(self) -> None:
        self.errors: list[PositionError] = []
        self._truth: deque[tuple[int, Geodetic]] = deque()
        self._waiting: deque[tuple[int, str, Geodetic, float | None, float | None]] = deque(
            maxlen=MOST_WAITING
        )

    def add_truth(self, t_ns: int, place: Geodetic) -> None:
        """Add a truth sample. A sample not later than the last one is ignored."""
        if self._truth and t_ns <= self._truth[-1][0]:
            return
        self._truth.append((t_ns, place))
        while self._truth[0][0] < t_ns - TRUTH_HISTORY_NS:
            self._truth.popleft()
        for _ in range(len(self._waiting)):
            self.add_estimate(*self._waiting.popleft())

    def add_estimate(
        self,
        t_ns: int,
        source: str,
        place: Geodetic,
        sigma: float | None = None,
        bound: float | None = None,
    ) -> None:
        """Add an estimate of `source`, with its stated sigma (m) and guaranteed r.m.s. bound (m)."""
        if not self._truth or t_ns > self._truth[-1][0]:
            self._waiting.append((t_ns, source, place, sigma, bound))
            return
        true = self._truth_at(t_ns)
        if true is not None:
            north, east, _ = separation(place, true)
            self.errors.append(PositionError(t_ns, source, north, east, sigma, bound, true))

    def _truth_at(self, t_ns: int) -> Geodetic | None:
        """Interpolate linearly between two samples; None before the first and in a gap."""
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


def nearest_error(errors: Iterable[PositionError], source: str, t_ns: int) -> PositionError | None:
    """Return the error of `source` nearest to `t_ns`, None where none is within `NEAR_NS`."""
    near = [s for s in errors if s.source == source and abs(s.t_ns - t_ns) <= NEAR_NS]
    return min(near, key=lambda s: abs(s.t_ns - t_ns), default=None)


def outage_table(errors: Sequence[PositionError], start_ns: int, end_ns: int) -> list[OutageErrors]:
    """Return one row per source with estimates between two instants; seconds count from the first."""
    rows = []
    for source in dict.fromkeys(s.source for s in errors):
        inside = [s for s in errors if s.source == source and start_ns <= s.t_ns < end_ns]
        if not inside:
            continue
        metres = np.array([s.error for s in inside])
        marks = {s: start_ns + s * SECOND_NS for s in AFTER_S}
        at = {s: nearest_error(inside, source, mark) for s, mark in marks.items() if mark < end_ns}
        stated = [s.error <= 3.0 * s.sigma for s in inside if s.sigma is not None]
        rows.append(
            OutageErrors(
                source,
                {s: found.error if (found := at.get(s)) else None for s in AFTER_S},
                root_mean_square(metres),
                float(metres.max()),
                len(inside),
                sum(stated) / len(stated) if stated else None,
            )
        )
    return rows
