"""What a radio measurement says about the inertial error: records in, observations and fixes out.

Everything is brought into the plane tangent at the INS position of the same instant, through ECEF, so that a
beacon 400 km away is exact: x east, y north, z up, metres, the INS at the origin. The place the observations
find there is minus the INS error.
"""

from __future__ import annotations

import math
from functools import lru_cache
from typing import NamedTuple, cast

import numpy as np

from companion.config import GnssConfig, RsbnConfig
from companion.estimate.fusion import (
    CONE_OF_SILENCE,
    Azimuth,
    Height,
    Observation,
    Position,
    Range,
    maximum_likelihood_3d,
)
from companion.nav.geometry import Geodetic, Triple, ecef_tuple, enu_axes_tuple, from_enu, separation_tuple
from companion.navigator.error_state import Belief
from companion.navigator.inertial_track import Point
from companion.records import Gnss, RsbnFix, Source, Vector2


class Heard(NamedTuple):
    """Observations of one instant in the tangent plane at the INS, and the sources they come from."""

    t_ns: int
    observations: tuple[Observation, ...]
    sources: Source


def from_gnss(record: Gnss, ins: Point, settings: GnssConfig, drifting: bool = False) -> Heard:
    """A GNSS fix as a horizontal position at the INS; if `drifting`, with its white noise alone."""
    sigma = white_sigma(record, settings) if drifting else _stated(record, settings)
    north, east, _ = separation_tuple(Geodetic(record.lat, record.lon, record.alt_msl), ins.position)
    place = Position((east, north), ((sigma**2, 0.0), (0.0, sigma**2)))
    return Heard(record.t_ns, (place,), Source.GNSS)


def white_sigma(record: Gnss, settings: GnssConfig) -> float:
    """One sigma an axis (m) of a fix, its drift left out."""
    stated = _stated(record, settings)
    return max(math.sqrt(stated**2 - settings.sigma_m**2), settings.sigma_m / 3.0)


def _stated(record: Gnss, settings: GnssConfig) -> float:
    return max(record.sigma_horizontal or 0.0, settings.sigma_m)


def from_rsbn(record: RsbnFix, ins: Point, settings: RsbnConfig) -> tuple[Azimuth | Range, ...]:
    """A beacon's azimuth and slant range, whichever are there, with the floors of the configuration."""
    here = ins.position
    (x, y, z), axes_beacon = _on_earth(record.lat, record.lon, record.alt)
    x_0, y_0, z_0 = ecef_tuple(here)
    axes = enu_axes_tuple(here.lat, here.lon)
    place = _times(axes, (x - x_0, y - y_0, z - z_0))
    observations: list[Azimuth | Range] = []
    if record.azimuth is not None:
        sigma = max(record.sigma_azimuth, math.radians(settings.sigma_azimuth_deg))
        turned = tuple([_times(axes, axis) for axis in axes_beacon])  # C_e^b C_enu^e, row by row
        observations.append(Azimuth(place, record.azimuth, sigma, turned))
    if record.slant_range is not None:
        floor = settings.sigma_range_m + 0.01 * settings.sigma_range_percent * record.slant_range
        observations.append(Range(place, record.slant_range, max(record.sigma_range, floor)))
    return tuple(observations)


def silent(z: Azimuth, error_n: Vector2, distance: float | None) -> bool:
    """Whether the aircraft is in the cone of silence of the azimuth's beacon, the INS being off by `error_n`
    (m) and `distance` (m) measured, if it is: fusion takes nothing of an azimuth there.
    """
    x, y, z_b = cast(Triple, z.beacon)
    axes = cast(tuple[Triple, Triple, Triple], z.axes)
    east, north, up = _times(axes, (-error_n[1] - x, -error_n[0] - y, -z_b))
    slant = math.hypot(east, north, up) if distance is None else distance
    return abs(up) > math.sin(CONE_OF_SILENCE) * slant


@lru_cache(maxsize=64)
def _on_earth(lat: float, lon: float, alt: float) -> tuple[Triple, tuple[Triple, Triple, Triple]]:
    """Of a beacon, which stays where it is: ECEF position and axes east, north, up."""
    return ecef_tuple(Geodetic(lat, lon, alt)), enu_axes_tuple(lat, lon)


def _times(C: tuple[Triple, Triple, Triple], v: Triple) -> Triple:
    (a, b, c), (d, e, f), (g, h, i) = C
    x, y, z = v
    return a * x + b * y + c * z, d * x + e * y + f * z, g * x + h * y + i * z


def bias_sigma(name: str, settings: RsbnConfig) -> float:
    """One sigma of the constant error of a beacon's measurement, called as the monitor does: rad or m."""
    return math.radians(settings.bias_azimuth_deg) if name.endswith("azimuth") else settings.bias_range_m


def place(record: RsbnFix, alt: float) -> Geodetic | None:
    """Roughly where azimuth and range are at height `alt`, the earth taken for flat; None without both."""
    if record.azimuth is None or record.slant_range is None:
        return None
    up = alt - record.alt
    distance = math.sqrt(max(record.slant_range**2 - up * up, 0.0))
    east, north = distance * math.sin(record.azimuth), distance * math.cos(record.azimuth)
    beacon = Geodetic(record.lat, record.lon, record.alt)
    return from_enu(np.array([east, north, up]), beacon)._replace(alt=alt)


def innovation(heard: Heard, prior: Belief, height_sigma: float) -> tuple[Belief, float]:
    """The most likely error with what is believed of it as one more observation, and the gate's chi-square:
    the cost. The height is the INS's, within its sigma.
    """
    (north, east), (nn, ne, ee) = prior
    # the place in the plane is minus the error; x east, y north
    before = Position((-east, -north), ((ee, ne), (ne, nn)))
    found = maximum_likelihood_3d(
        (before, Height(0.0, height_sigma), *heard.observations), (-east, -north, 0.0)
    )
    x, y, _ = found.position
    (ee, ne, _), (_, nn, _), _ = found.covariance
    return Belief((-y, -x), (nn, ne, ee)), found.cost


def freedom(heard: Heard) -> int:
    """How many scalar measurements there are."""
    return sum(2 if isinstance(z, Position) else 1 for z in heard.observations)
