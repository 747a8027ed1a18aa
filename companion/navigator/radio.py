"""What a radio measurement says about the inertial error: records in, observations and fixes out.

Everything is brought into the plane tangent at the INS position of the same instant, through ECEF, so that a
beacon 400 km away is exact: x east, y north, z up, metres, the INS at the origin. The place the observations
find there is minus the INS error.
"""

from __future__ import annotations

import math
from functools import lru_cache
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from companion.config import GnssSection, Rsbn
from companion.estimate.fusion import Azimuth, Fix, Observation, Position, Range, maximum_likelihood
from companion.nav.geometry import Geodetic, enu_axes, from_enu, separation, to_ecef
from companion.records import Gnss, RsbnFix, Source

from .inertial import Point

Floats = npt.NDArray[np.float64]


class Heard(NamedTuple):
    """Observations of one instant in the tangent plane at the INS, and the sources they come from."""

    t_ns: int
    observations: tuple[Observation, ...]
    sources: Source


def from_gnss(record: Gnss, ins: Point, settings: GnssSection, drifting: bool = False) -> Heard:
    """A GNSS fix as a horizontal position at the INS; if `drifting`, with its white noise alone."""
    sigma = white_sigma(record, settings) if drifting else _stated(record, settings)
    north, east, _ = separation(Geodetic(record.lat, record.lon, record.alt_msl), ins.position)
    place = Position(np.array([east, north]), sigma**2 * np.eye(2))
    return Heard(record.t_ns, (place,), Source.GNSS)


def white_sigma(record: Gnss, settings: GnssSection) -> float:
    """One sigma an axis (m) of a fix, its drift left out."""
    stated = _stated(record, settings)
    return max(math.sqrt(stated**2 - settings.sigma_m**2), settings.sigma_m / 3.0)


def _stated(record: Gnss, settings: GnssSection) -> float:
    return max(record.sigma_horizontal or 0.0, settings.sigma_m)


def from_rsbn(record: RsbnFix, ins: Point, settings: Rsbn) -> Heard:
    """A beacon's azimuth and slant range, whichever are there, with the floors of the configuration."""
    here = ins.position
    r_beacon, axes_beacon = _on_earth(record.lat, record.lon, record.alt)
    axes = enu_axes(here.lat, here.lon)
    place = axes @ (r_beacon - to_ecef(here))
    observations: list[Observation] = []
    sources = Source(0)
    if record.azimuth is not None:
        sigma = max(record.sigma_azimuth, math.radians(settings.sigma_azimuth_deg))
        observations.append(Azimuth(place, record.azimuth, sigma, axes_beacon @ axes.T))
        sources |= Source.AZIMUTH
    if record.slant_range is not None:
        floor = settings.sigma_range_m + 0.01 * settings.sigma_range_percent * record.slant_range
        observations.append(Range(place, record.slant_range, max(record.sigma_range, floor)))
        sources |= Source.RANGE
    return Heard(record.t_ns, tuple(observations), sources)


@lru_cache(maxsize=64)
def _on_earth(lat: float, lon: float, alt: float) -> tuple[Floats, Floats]:
    """Of a beacon, which stays where it is: ECEF position (3,) and axes east, north, up (3, 3)."""
    return to_ecef(Geodetic(lat, lon, alt)), enu_axes(lat, lon)


def place(record: RsbnFix, alt: float) -> Geodetic | None:
    """Roughly where azimuth and range are at height `alt`, the earth taken for flat; None without both."""
    if record.azimuth is None or record.slant_range is None:
        return None
    up = alt - record.alt
    distance = math.sqrt(max(record.slant_range**2 - up * up, 0.0))
    east, north = distance * math.sin(record.azimuth), distance * math.cos(record.azimuth)
    beacon = Geodetic(record.lat, record.lon, record.alt)
    return from_enu(np.array([east, north, up]), beacon)._replace(alt=alt)


def innovation(heard: Heard, prior: Position) -> Fix:
    """The most likely place with the INS as one more observation; its cost is the gate's chi-square."""
    return maximum_likelihood((prior, *heard.observations), start=np.asarray(prior.value))


def freedom(heard: Heard) -> int:
    """How many scalar measurements there are."""
    return sum(2 if isinstance(z, Position) else 1 for z in heard.observations)
