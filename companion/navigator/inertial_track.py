"""The inertial channel: where the INS believes it is, as geodetic points on one clock.

A local position is turned to geodetic by the autopilot's own flat-earth formula, so that the error of the
channel is the INS's and not the projection's. Of the channel's errors it knows only how to notice that it
jumped. Heights are above mean sea level throughout: taken for ellipsoidal ones they misplace a beacon 60 km
away by 0.5 m.
"""

from __future__ import annotations

from typing import NamedTuple

from companion.nav.geometry import Geodetic, local_to_geodetic, separation
from companion.records import LocalOrigin, LocalPosition, Vector3

JUMP_M = 5.0  # a step beyond what velocity explains, allowing for JUMP_ACCELERATION
JUMP_ACCELERATION = 30.0  # [m/s^2]


class Point(NamedTuple):
    """Position (rad, rad, m above the ellipsoid) and velocity NED (m/s) of the inertial channel at `t_ns`."""

    t_ns: int
    position: Geodetic
    v_n: Vector3


def point(record: LocalPosition, origin: LocalOrigin) -> Point:
    """The geodetic point that the autopilot means by its local position."""
    start = Geodetic(origin.lat, origin.lon, origin.alt_msl)
    return Point(record.t_ns, local_to_geodetic(origin.projection, start, record.x_n), record.v_n)


def beyond(before: Point, after: Point) -> Vector3:
    """How far the channel moved (NED, m) beyond what its own velocities explain.

    On the earth, not from the origin: an origin that moves, received before or after the local positions that
    refer to it, is a step and its return, and moves nothing in the end.
    """
    dt = (after.t_ns - before.t_ns) * 1e-9
    moved = separation(after.position, before.position)
    north, east, down = (s - 0.5 * (v + w) * dt for s, v, w in zip(moved, before.v_n, after.v_n, strict=True))
    return north, east, down


def unnoticed(dt: float) -> float:
    """How far (m) that may be after `dt` seconds without the channel having jumped: the aircraft may have
    turned.
    """
    return JUMP_M + 0.5 * JUMP_ACCELERATION * dt * dt
