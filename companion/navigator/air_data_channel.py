"""Air-data dead reckoning: airspeed and attitude as an inertial channel of our own.

A local position is no independent channel once the companion feeds the autopilot's estimator, and after GNSS
is lost it is itself dead reckoning, on a wind that grows stale. This channel knows of the autopilot only its
attitude, its airspeed and its static pressure: no position and no velocity of its own can come back to it
through here. It integrates the velocity through the air, as if there were no wind; so the error of its
velocity is minus the wind (`winderror`), and its track is the same `inertial.Point`s as any other channel's.

Heights are pressure altitudes of the standard atmosphere; `carry.Level` learns how far off they are. Sideslip
and the angle of attack are taken for zero: five degrees of either are 0.4 % of the speed along, and across
they look like wind.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from companion.nav.geometry import Geodetic, displace
from companion.navigator.fix_observations import place
from companion.navigator.inertial_track import Point
from companion.records import AirData, Attitude, Gnss, Pressure, RsbnFix, Vector2, Vector3

P0 = 101_325.0  # [Pa] of the standard atmosphere at sea level
LAPSE, T0 = 0.0065, 288.15  # [K/m], [K]
TROPOPAUSE = 11_000.0  # [m], where the lapse ends
HEIGHT_EXPONENT = 0.190263  # R L / (g M): T / T0 = (p / P0)^0.19
DENSITY_EXPONENT = 1.0 - HEIGHT_EXPONENT  # rho / rho0 = (p / P0) / (T / T0)
STALE_NS = 1_000_000_000  # an attitude older than this turns no airspeed into a velocity
CLIMB_S = 2.0  # time constant of the climb taken from the pressure altitude


class Reckoner(NamedTuple):
    """What is needed to go on: last attitude, airspeed, pressure (Pa), None before one; climb (m/s)."""

    attitude: Attitude | None = None
    air: AirData | None = None
    static: float | None = None
    climb: float = 0.0


def begin(r: Reckoner, fix: Gnss | RsbnFix) -> Point | None:
    """Where the channel begins: the first position anybody tells once there is an airspeed; else None."""
    at = first_place(fix, r.static)
    if at is None or r.air is None or not _fresh(r, r.air.t_ns) or abs(fix.t_ns - r.air.t_ns) > STALE_NS:
        return None
    return Point(fix.t_ns, at, (*_air_velocity(r, r.air, at.alt), 0.0))


def sense(r: Reckoner, record: Attitude | AirData | Pressure) -> Reckoner:
    """With one more attitude, airspeed or static pressure."""
    if isinstance(record, Attitude):
        return r._replace(attitude=record)
    if isinstance(record, AirData):
        return r._replace(air=record)
    return r._replace(static=record.static) if 1e3 < record.static < 2e5 else r


def advance(r: Reckoner, last: Point, record: AirData) -> tuple[Reckoner, Point] | None:
    """The point at the time of `record`; None where it is not newer or there is no fresh attitude."""
    dt = (record.t_ns - last.t_ns) * 1e-9
    if dt <= 0.0 or not _fresh(r, record.t_ns):
        return None
    north, east = _air_velocity(r, record, last.position.alt)
    before = last.v_n
    alt, climb = followed(r.static, r.climb, last.position.alt, dt)
    r = r._replace(climb=climb)
    moved = displace(*last.position, 0.5 * (before[0] + north) * dt, 0.5 * (before[1] + east) * dt, 0.0)
    v_n: Vector3 = (north, east, -r.climb)
    return r, Point(record.t_ns, moved._replace(alt=alt), v_n)


def first_place(fix: Gnss | RsbnFix, static: float | None) -> Geodetic | None:
    """The position that a fix alone tells, at the height of the pressure (Pa) if it is known; else None."""
    if isinstance(fix, RsbnFix):
        return place(fix, pressure_altitude(static) if static else fix.alt)
    alt = pressure_altitude(static) if static else fix.alt_msl
    return Geodetic(fix.lat, fix.lon, alt) if fix.has_3d_fix else None


def followed(static: float | None, climb: float, alt: float, dt: float) -> Vector2:
    """Height (m) by the pressure, dt seconds after it was `alt`, and the climb (m/s) once `climb`."""
    new = pressure_altitude(static) if static else alt
    return new, climb + min(dt / CLIMB_S, 1.0) * ((new - alt) / dt - climb)


def true_airspeed(record: AirData, static: float | None, alt: float) -> float:
    """True airspeed (m/s): equivalent airspeed times sqrt(rho0 / rho) of the standard atmosphere.

    The density is that of the pressure, or of the height (m) where no pressure is known; what a day warmer or
    colder than the standard makes of it, 1.7 % for 10 K, is one more error of scale.
    """
    if record.true:
        return record.airspeed
    ratio = static / P0 if static else (1.0 - LAPSE * min(alt, TROPOPAUSE) / T0) ** (1.0 / HEIGHT_EXPONENT)
    return float(record.airspeed / math.sqrt(ratio**DENSITY_EXPONENT))


def pressure_altitude(static: float) -> float:
    """Height (m) at which the standard atmosphere has this pressure (Pa)."""
    return float(T0 / LAPSE * (1.0 - (static / P0) ** HEIGHT_EXPONENT))


def _fresh(r: Reckoner, t_ns: int) -> bool:
    return r.attitude is not None and abs(t_ns - r.attitude.t_ns) <= STALE_NS


def _air_velocity(r: Reckoner, record: AirData, alt: float) -> Vector2:
    """Velocity through the air, north and east (m/s), along the fuselage."""
    assert r.attitude is not None
    level = true_airspeed(record, r.static, alt) * math.cos(r.attitude.pitch)
    return level * math.cos(r.attitude.heading), level * math.sin(r.attitude.heading)
