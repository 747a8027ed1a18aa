"""That a parked aircraft stands, a measurement while GNSS is not received.

The autopilot states that it does not fly, nothing moves the IMU, and a fix has shown no speed since then: the
IMU is as still on a ship that sails.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from companion.records import Gnss, Imu, Vector3
from companion.units import SECOND_NS

#: Mean acceleration and rates that a wrong attitude, a bias or an engine may show; speed of a GNSS at rest.
STILL_M_S2, STILL_RAD_S, STANDS_M_S = 0.6, 0.05, 0.7
EVERY_NS = SECOND_NS


class Standing(NamedTuple):
    """Since when nothing moves the IMU, whether a fix has shown no speed since, and the last measurement."""

    since_ns: int
    is_shown: bool = False
    measured_ns: int = -EVERY_NS

    def is_due(self, t_ns: int) -> bool:
        """Whether it stands, and has not been measured lately."""
        return self.is_shown and t_ns - self.measured_ns >= EVERY_NS


def follow(
    before: Standing | None, record: Imu, landed: bool, mean: Vector3, fix: Gnss | None
) -> Standing | None:
    """Return the standing after one more IMU sample; None while it moves, or may fly.

    Parameters
    ----------
    before
        What was returned for the last sample.
    landed
        Whether the autopilot states that it does not fly.
    mean
        Mean acceleration, north, east and down (m/s^2).
    fix
        The last one of GNSS.
    """
    if not landed or math.hypot(*mean[:2]) > STILL_M_S2 or max(map(abs, record.w_b)) > STILL_RAD_S:
        return None
    now = before or Standing(record.t_ns)
    if fix is None or fix.v_n is None or fix.t_ns < now.since_ns:
        return now
    return now._replace(is_shown=True) if math.hypot(*fix.v_n[:2]) < STANDS_M_S else Standing(record.t_ns)
