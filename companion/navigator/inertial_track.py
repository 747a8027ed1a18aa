"""The inertial channel: where the INS believes it is, as geodetic points on one clock.

A local position is turned to geodetic by the autopilot's own flat-earth formula, so that the error of the
channel is the INS's and not the projection's. Of the channel's errors it knows only how to notice that it
jumped. Heights are above mean sea level throughout: taken for ellipsoidal ones they misplace a beacon 60 km
away by 0.5 m.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from companion.nav.geometry import Geodetic, Projection, displace, local_to_geodetic, separation_tuple
from companion.records import LocalOrigin, LocalPosition, Vector2, Vector3

KEEP = 128  # points: 12 s at 10 Hz, more than a beacon's answer may be late
SPACING_NS = 90_000_000
REACH_S = 0.5  # a point this far beyond the track is still extrapolated
JUMP_M = 5.0  # a step beyond what velocity explains, allowing for JUMP_ACCELERATION
JUMP_ACCELERATION = 30.0  # [m/s^2]


class Point(NamedTuple):
    """Position (rad, rad, m above the ellipsoid) and velocity NED (m/s) of the inertial channel at `t_ns`."""

    t_ns: int
    position: Geodetic
    v_n: Vector3


Track = tuple[Point, ...]


def point(record: LocalPosition, origin: LocalOrigin) -> Point:
    """The geodetic point that the autopilot means by its local position."""
    projection: Projection = origin.projection  # type: ignore[assignment]
    start = Geodetic(origin.lat, origin.lon, origin.alt_msl)
    return Point(record.t_ns, local_to_geodetic(projection, start, record.x_n), record.v_n)


def extend(track: Track, new: Point) -> Track:
    """The track with one more point, its oldest dropped."""
    return (*track[-(KEEP - 1) :], new)


def renew(track: Track, new: Point) -> Track:
    """The same for a channel faster than 10 Hz: its newest point makes way unless a tenth of a second old."""
    if len(track) > 1 and track[-1].t_ns - track[-2].t_ns < SPACING_NS:
        track = track[:-1]
    return extend(track, new)


def at(track: Track, t_ns: int) -> Point | None:
    """The point at `t_ns`: between two points linearly, a little beyond the last carried on, else None."""
    if not track or t_ns < track[0].t_ns:
        return None
    last = track[-1]
    if t_ns >= last.t_ns:
        dt = (t_ns - last.t_ns) * 1e-9
        return _moved(last, acceleration(track), dt, t_ns) if dt <= REACH_S else None
    later = len(track) - 1
    while track[later - 1].t_ns > t_ns:
        later -= 1
    a, b = track[later - 1], track[later]
    part = (t_ns - a.t_ns) / (b.t_ns - a.t_ns)
    if (b.t_ns - a.t_ns) * 1e-9 > 2.0 * REACH_S:
        return None  # a hole in the channel is not bridged
    mix = [p + part * (q - p) for p, q in zip(a.position, b.position, strict=True)]
    if abs(b.position.lon - a.position.lon) > math.pi:  # across the antimeridian
        return _moved(a, acceleration(track), (t_ns - a.t_ns) * 1e-9, t_ns)
    v_n = tuple(p + part * (q - p) for p, q in zip(a.v_n, b.v_n, strict=True))
    return Point(t_ns, Geodetic(*mix), v_n)  # type: ignore[arg-type]


def beyond(before: Point, after: Point) -> Vector3:
    """How far the channel moved (NED, m) beyond what its own velocities explain.

    On the earth, not from the origin: an origin that moves, told before or after the local positions that are
    counted from it, is a step and its return, and moves nothing in the end.
    """
    dt = (after.t_ns - before.t_ns) * 1e-9
    moved = separation_tuple(after.position, before.position)
    north, east, down = (s - 0.5 * (v + w) * dt for s, v, w in zip(moved, before.v_n, after.v_n, strict=True))
    return north, east, down


def unnoticed(dt: float) -> float:
    """How far (m) that may be after `dt` seconds without the channel having jumped: the aircraft may have
    turned.
    """
    return JUMP_M + 0.5 * JUMP_ACCELERATION * dt * dt


def acceleration(track: Track) -> Vector2:
    """Horizontal acceleration north and east over the last points, m/s^2; (0, 0) before it is known."""
    if len(track) < 2:
        return 0.0, 0.0
    a, b = track[max(-3, -len(track))], track[-1]
    dt = (b.t_ns - a.t_ns) * 1e-9
    return (b.v_n[0] - a.v_n[0]) / dt, (b.v_n[1] - a.v_n[1]) / dt


def _moved(start: Point, a_n: Vector2, dt: float, t_ns: int) -> Point:
    """`start` carried on. A tenth of a second of a turn changes the velocity by ten sigmas of GNSS's."""
    v_n = (start.v_n[0] + a_n[0] * dt, start.v_n[1] + a_n[1] * dt, start.v_n[2])
    north, east, down = (0.5 * (v + w) * dt for v, w in zip(start.v_n, v_n, strict=True))
    return Point(t_ns, displace(*start.position, north, east, down), v_n)
