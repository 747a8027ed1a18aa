"""Velocity that a latency multiplies in a position: that of GNSS, and that of a beacon's answers."""

from __future__ import annotations

import math

from msgspec import structs

from companion.navigator.progress import driver, estimated_velocity
from companion.navigator.state import State, VelocityError
from companion.records import Vector2

MEAN_S = 60.0  # of the estimated velocity error
#: The mean may be off by so much: 1 m at a latency of 0.35 s. With 42 m/s the position was 16 m off.
MEAN_OFF_M_S = 3.0


def of_gnss(state: State, t_ns: int, is_measured: bool, stated: Vector2 | None) -> tuple[State, Vector2]:
    """Return the velocity that GNSS latency multiplies in a position, north and east, m/s.

    The noise of the estimated velocity is also in the estimated position: as a coefficient it made straight
    flight seem to measure the latency, as 0.08 s after ten minutes where it was 0. So does that of the
    velocity that GNSS states. By IMU, and by airspeed where GNSS states no velocity (`is_measured`), the
    nominal velocity is taken less a slow mean of its estimated error; a held velocity is far off in every
    turn. A wrong accelerometer leaves the mean behind: it begins again where it is `MEAN_OFF_M_S` off the
    velocity that GNSS states, if that is believed (`stated`). After a silence the velocity must be that of
    the fix: 5 m/s off in the first of two positions, they seemed to measure a latency of 0.13 s.
    """
    v_n, by = estimated_velocity(state), driver(state)
    if by != "imu" and (is_measured or by not in ("air", "foreign")):
        return structs.replace(state, velocity_error=None), v_n
    assert state.nominal is not None
    nominal, mean = state.nominal.point.v_n, state.velocity_error
    north, east = nominal[0] - v_n[0], nominal[1] - v_n[1]
    if mean is not None:
        part = -math.expm1(-max(t_ns - mean.t_ns, 0) * 1e-9 / MEAN_S)
        slow = mean.north + part * (north - mean.north), mean.east + part * (east - mean.east)
        smooth = nominal[0] - slow[0], nominal[1] - slow[1]
        if stated is None or math.dist(smooth, stated) <= MEAN_OFF_M_S:
            north, east = slow
    state = structs.replace(state, velocity_error=VelocityError(t_ns, north, east))
    return state, smoothed(state)


def smoothed(state: State) -> Vector2:
    """The nominal velocity less the slow mean of its error, if there is one; else the estimated one, m/s."""
    mean = state.velocity_error
    if mean is None or state.nominal is None:
        return estimated_velocity(state)
    north, east, _ = state.nominal.point.v_n
    return north - mean.north, east - mean.east
