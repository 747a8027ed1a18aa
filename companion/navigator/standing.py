"""That a parked aircraft stands, a measurement while GNSS is not received.

The autopilot states that it does not fly, nothing moves the IMU, and a fix has shown no speed since then: the
IMU is as still on a ship that sails. What took off from where a fix had shown no speed and has landed without
GNSS stands again once neither the IMU nor the height has moved for ten seconds: a glider's IMU is as still.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from companion.records import Gnss, Imu, Vector3
from companion.units import SECOND_NS

#: Mean acceleration and rates that a wrong attitude, a bias or an engine may show; speed of a GNSS at rest.
STILL_M_S2, STILL_RAD_S, STANDS_M_S = 0.6, 0.05, 0.7
EVERY_NS = SECOND_NS
LANDED_NS, LEVEL_M = 10 * SECOND_NS, 3.0


class Standing(NamedTuple):
    """Since when nothing moves the IMU (None: it is moved, or may fly), the specific force at which it stands
    (m/s^2), the height then (m), whether a fix has shown no speed since, or had before, whether it has flown
    since that, and the last measurement.
    """

    since_ns: int | None = None
    force_b: Vector3 = (0.0, 0.0, 0.0)
    height: float = 0.0
    is_shown: bool = False
    was_shown: bool = False
    has_flown: bool = False
    measured_ns: int = -EVERY_NS

    def is_due(self, t_ns: int) -> bool:
        """Whether it stands, and has not been measured lately."""
        return t_ns - self.measured_ns >= EVERY_NS and (self.is_shown or self.has_landed(t_ns))

    def has_landed(self, t_ns: int) -> bool:
        """Whether it stands after a flight from where a fix had shown no speed."""
        is_still = self.since_ns is not None and t_ns - self.since_ns >= LANDED_NS
        return is_still and self.was_shown and self.has_flown


def follow(
    before: Standing,
    record: Imu,
    landed: bool,
    acceleration_n: Vector3,
    force_b: Vector3,
    height: float,
    fix: Gnss | None,
) -> Standing:
    """Return the standing after one more IMU sample.

    The acceleration shows that nothing moves it; once it stands, the specific force. The attitude runs off by
    five degrees where an autopilot without GNSS is fed positions that wander.

    Parameters
    ----------
    before
        What was returned for the last sample.
    landed
        Whether the autopilot states that it does not fly.
    acceleration_n, force_b
        Means of the last seconds: acceleration north, east and down, specific force in the body (m/s^2).
    height
        Pressure altitude, m.
    fix
        The last one of GNSS.
    """
    stands = before.is_shown or before.has_landed(record.t_ns)
    pushed = math.dist(force_b, before.force_b) if stands else math.hypot(*acceleration_n[:2])
    if not landed or pushed > STILL_M_S2 or max(map(abs, record.w_b)) > STILL_RAD_S:
        has_flown = not landed or (before.has_flown and not stands)  # or it is carried off
        moved = before._replace(since_ns=None, is_shown=False, has_flown=has_flown)
        return before if moved == before else moved
    now = before if stands else before._replace(force_b=force_b)
    if now.since_ns is None or (not now.is_shown and abs(height - now.height) > LEVEL_M):
        now = now._replace(since_ns=record.t_ns, height=height)
    assert now.since_ns is not None
    if fix is None or fix.v_n is None or fix.t_ns < now.since_ns:
        return now
    shown = math.hypot(*fix.v_n[:2]) < STANDS_M_S
    since_ns = now.since_ns if shown else record.t_ns
    return now._replace(since_ns=since_ns, is_shown=shown, was_shown=shown, has_flown=False)
