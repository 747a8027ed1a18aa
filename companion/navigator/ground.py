"""Phases of a flight: parked, ground roll, in the air. They decide whether airspeed measures the wind."""

from __future__ import annotations

import math
from typing import NamedTuple

FLYING_M_S = 8.0  # [m/s] airspeed from which a fixed wing may fly
PARKED_M_S = 4.0  # [m/s] below it, slow over ground, it may be parked
PARKED_S = 10.0  # [s] of it
CLEAR_M = 5.0  # [m] from the last parked height: the wheels are off the ground
#: The wind grows with the logarithm of the height: by about a quarter of itself from 20 to 100 m.
SHEAR_M_S, SHEAR_TOP_M = 2.0, 200.0  # [m/s] for a height e times as great; [m] above it is as it is
SAME_WIND = 1.25  # a height so many times smaller has the same wind


class Ground(NamedTuple):
    """Flying or not, since when slow (s, None if not slow), the height (m) where it was last parked, and the
    height (m) above that whose wind was the last one measured.
    """

    flying: bool = False
    slow_since: float | None = None
    parked_height: float | None = None
    wind_height: float = CLEAR_M


def wind_shear(before: Ground, after: Ground) -> float:
    """Variance of what the wind may have changed with height between two phases, (m/s)^2 an axis."""
    return SHEAR_M_S**2 * abs(math.log(after.wind_height / before.wind_height)) if after.flying else 0.0


def ground_phase(
    g: Ground, t: float, airspeed: float, speed: float, height: float | None, hovers: bool = False
) -> Ground:
    """Follow parking, ground roll and flight.

    Airspeed is used only in flight: parked it measures nothing, and in the ground roll the wheels, not the
    air, hold the course, so that crosswind would be taken for none. After lift-off the wind is as open as
    before. Without a parked height (in the air at the start, or no pressure) it flies once it moves: beside a
    running propeller a parked pitot measures 20 m/s (InertialNav's TestLog2). A flight ends after `PARKED_S`
    of slowness, for a light aircraft may stall or hang in the wind (UMN: airspeed 4 m/s, 1.4 m/s over ground
    at 71 m).

    Parameters
    ----------
    t
        Time (s).
    airspeed, speed
        True airspeed and speed over ground (m/s).
    height
        Pressure altitude (m), if any.
    hovers
        Whether the autopilot states that it hovers: slow, but not parked.
    """
    if airspeed < PARKED_M_S and speed < PARKED_M_S:
        since = t if g.slow_since is None else g.slow_since
        if g.flying and t - since < PARKED_S:
            return g._replace(slow_since=since)
        return g._replace(flying=False, slow_since=since) if hovers else Ground(False, since, height)
    clear = is_clear(g, height)
    flying = g.flying or (airspeed > FLYING_M_S and (speed > PARKED_M_S if clear is None else clear))
    return sunk(lifted(g, height), height) if flying else Ground(False, None, g.parked_height, g.wind_height)


def is_clear(g: Ground, height: float | None) -> bool | None:
    """Whether a pressure altitude (m) is off the ground: above, or below after a launch from a hill.

    None where it is not known, or was never parked.
    """
    if g.parked_height is None or height is None:
        return None
    return abs(height - g.parked_height) > CLEAR_M


def lifted(g: Ground, height: float | None) -> Ground:
    """In flight, at a pressure altitude (m), if any: the wind is open where it is higher than before.

    Not where it sinks: a multirotor works near the ground, and each descent would open the wind again (an
    octocopter without GNSS for a minute 47 m off, not 20).
    """
    above = _above(g, height)
    wind_height = g.wind_height if above is None else max(g.wind_height, above)
    return Ground(True, None, g.parked_height, wind_height)


def sunk(g: Ground, height: float | None) -> Ground:
    """The same, the wind open too where it is lower: for a landing."""
    above = _above(g, height)
    return g if above is None else g._replace(wind_height=min(g.wind_height, SAME_WIND * above))


def _above(g: Ground, height: float | None) -> float | None:
    """Height above the ground (m) within the limits between which the wind changes with it."""
    if g.parked_height is None or height is None:
        return None
    return min(max(abs(height - g.parked_height), CLEAR_M), SHEAR_TOP_M)
