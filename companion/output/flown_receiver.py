"""Which of two GNSS receivers the autopilot flies by, judged by its own position. No I/O.

An autopilot with two receivers chooses by itself (ArduPilot: `GPS_AUTO_SWITCH`), and the navigator judges
one. Flown on ArduPlane: the first receiver was drawn off at 2 m/s, the autopilot flew by the second, 0.7 m
off, and the companion requested source set 2. It needs GLOBAL_POSITION_INT, which is not requested beside an
INS of its own.
"""

from __future__ import annotations

import math

from companion.output.gate import distance, place_at
from companion.records import GlobalPosition, Gnss, Solution
from companion.units import SECOND_NS

MOST_M = 15.0  # from the other receiver; an autopilot that is further off blends the two
SHARE = 0.25  # of its distance from the receiver in use, at most so far from the other
LATE_S = 0.2  # fixes may be so late, the autopilot's own position is not
RECENT_NS = 2 * SECOND_NS
KEPT_NS = 10 * SECOND_NS  # a gap in the streams does not mean that it flies by the one in use


class FlownReceiver:
    """The last fixes of the receiver in use and of the other, and the autopilot's own position."""

    def __init__(self) -> None:
        self._used: Gnss | None = None
        self._other: Gnss | None = None
        self._own: GlobalPosition | None = None
        self._kept_ns = 0  # until when the last answer holds

    def note_used(self, record: Gnss) -> None:
        """Note what the receiver in use reports."""
        self._used = record if record.has_3d_fix else None

    def note_other(self, record: Gnss) -> None:
        """Note what the other receiver reports."""
        self._other = record if record.has_3d_fix else None

    def note_own(self, record: GlobalPosition) -> None:
        """Note the autopilot's own position."""
        self._own = record

    def is_other(self, ours: Solution, now_ns: int) -> bool:
        """Return whether the autopilot flies by the other receiver, or did within `KEPT_NS`.

        The other one must be nearer to our position (`ours`) than to the one in use: both may be false.
        """
        used, other, own = self._used, self._other, self._own
        if other is None:  # it has no fix
            return False
        if used is None or own is None or now_ns - min(r.rx_ns for r in (used, other, own)) > RECENT_NS:
            return now_ns < self._kept_ns
        at_used, at_other, at_own, at_ours = (place_at(record, now_ns) for record in (used, other, own, ours))
        off_m = distance(at_own, at_other) - LATE_S * math.hypot(*own.v_n[:2])
        is_there = off_m < min(MOST_M, SHARE * distance(at_own, at_used))
        if is_there and distance(at_other, at_ours) < 0.5 * distance(at_other, at_used):
            self._kept_ns = now_ns + KEPT_NS
        return now_ns < self._kept_ns
