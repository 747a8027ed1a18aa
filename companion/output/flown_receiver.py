"""Which of two GNSS receivers the autopilot flies by, judged by its own position. No I/O.

An autopilot with two receivers chooses by itself (ArduPilot: `GPS_AUTO_SWITCH`); the navigator judges one.
Flown: the first receiver drawn off at 2 m/s, ArduPlane 0.7 m off by the second, and it was taken off GNSS.
"""

from __future__ import annotations

from companion.nav.geometry import Geodetic, displace
from companion.output.gate import distance
from companion.records import GlobalPosition, Gnss
from companion.units import SECOND_NS

APART_M = 15.0  # two receivers that are drawn off alike are nearer to each other
SHARE = 0.25  # of the distance between the receivers, within which it flies by one of them
RECENT_NS = 2 * SECOND_NS


class FlownReceiver:
    """The last fixes of the receiver in use and of the other, and the autopilot's own position."""

    def __init__(self) -> None:
        self._used: Gnss | None = None
        self._other: Gnss | None = None
        self._own: GlobalPosition | None = None

    def receive(self, record: Gnss | GlobalPosition, is_used: bool = True) -> None:
        """Note the autopilot's position, or what a receiver reports: the one in use, or the other."""
        if isinstance(record, GlobalPosition):
            self._own = record
        elif is_used:
            self._used = record if record.has_3d_fix else None
        else:
            self._other = record if record.has_3d_fix else None

    def is_other(self, now_ns: int) -> bool:
        """Return whether the autopilot is where the other receiver is, and not the one in use."""
        used, other, own = self._used, self._other, self._own
        if used is None or other is None or own is None:
            return False
        if now_ns - min(used.rx_ns, other.rx_ns, own.rx_ns) > RECENT_NS:
            return False
        false, right, here = (_at(record, now_ns) for record in (used, other, own))
        is_apart = distance(false, right) > APART_M
        return is_apart and distance(here, right) < SHARE * distance(here, false)


def _at(record: Gnss | GlobalPosition, now_ns: int) -> Geodetic:
    """Return the position at `now_ns`, by its velocity."""
    north, east, _ = record.v_n or (0.0, 0.0, 0.0)
    dt = (now_ns - record.t_ns) * 1e-9
    return displace(record.lat, record.lon, record.alt_msl, north * dt, east * dt, 0.0)
