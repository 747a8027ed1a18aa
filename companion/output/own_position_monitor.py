"""Report of an autopilot whose own position stays far from ours: it does not fly by what we believe. No I/O.

Flown on ArduPlane with two blended receivers, the second drawn off: the autopilot was 110 m off, our position
1 m, and nothing was reported. Nothing is sent for it and nothing withheld: a person has to look. Not used
beside an INS of its own: what arrives there as the autopilot's position may be the INS's, which drifts.
"""

from __future__ import annotations

from collections.abc import Callable

from companion.nav.geometry import Geodetic
from companion.output.gate import Position, distance
from companion.records import Event, Severity
from companion.units import SECOND_NS

MOST_M, MOST_SIGMAS = 50.0, 5.0  # the greater of both, and half of it for the return
HELD_NS = 10 * SECOND_NS  # a filter that is reset to ours, or steps to it, is there sooner
GAP_NS = 3 * SECOND_NS  # nothing is known of a longer time without both positions


class OwnPositionMonitor:
    """Whether the autopilot's own position is far from ours; each change is reported once."""

    def __init__(self) -> None:
        self._is_far = False
        self._since_ns = self._last_ns = 0  # since when it is otherwise than reported, and when last compared

    def update(
        self, own: Geodetic | None, ours: Position, why: Callable[[], str], now_ns: int
    ) -> Event | None:
        """Compare the autopilot's own position with `ours`, both of `now_ns`; return an event on a change.

        Parameters
        ----------
        own : None where it is not known; then nothing changes.
        why : returns what a person should look at, added to the report of a far one.
        """
        if own is None:
            return None
        off_m, limit_m = distance(own, ours.place), max(MOST_M, MOST_SIGMAS * ours.sigma)
        is_changed = off_m < 0.5 * limit_m if self._is_far else off_m > limit_m
        if not is_changed or now_ns - self._last_ns > GAP_NS:
            self._since_ns = now_ns
        self._last_ns = now_ns
        if now_ns - self._since_ns < HELD_NS:
            return None
        self._is_far = not self._is_far
        text = f"autopilot's own position {off_m:.0f} m off ours"
        if self._is_far:
            return Event(now_ns, now_ns, Severity.WARNING, f"{text} (sigma {ours.sigma:.0f} m): {why()}")
        return Event(now_ns, now_ns, Severity.NOTICE, f"{text} again")
