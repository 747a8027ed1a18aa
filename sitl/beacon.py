"""RSBN beacon model: coverage and measurement errors.

An answer is the azimuth of the aircraft at the beacon (from true north, clockwise) and the slant range.
Beyond the range limit or the radio horizon there is no answer; in the cone of silence there is no azimuth.
Messages, time mapping and faults (`sitl.faults`) are not modelled here.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from companion.analysis import simulated_rsbn
from companion.nav.geometry import Geodetic
from companion.records import RsbnFix
from sitl.flight import Trajectory


@dataclass(frozen=True, slots=True)
class Beacon:
    """Ground beacon and the errors of its channel.

    Sigmas are one sigma (RSBN's published 0.25 degrees and 200 m + 0.03 % of the range are two sigma).
    `alt` is above the ellipsoid; `ground_alt` is the height of the smooth earth of the horizon computation.
    """

    number: int
    lat_deg: float
    lon_deg: float
    alt: float = 60.0
    ground_alt: float = 20.0
    range_limit: float = 350e3
    sigma_azimuth_deg: float = 0.125
    sigma_range: float = 100.0
    sigma_range_share: float = 1.5e-4
    azimuth_step_deg: float = 0.01
    range_step: float = 10.0
    drop_out: float = 0.01
    silence_deg: float = 45.0
    latency_s: float = 0.15


def azimuth_range_elevation(beacon: Beacon, flight: Trajectory) -> simulated_rsbn.Sight:
    """Return azimuth in [0, 2 pi) rad, slant range (m) and elevation (rad) of the aircraft at the beacon."""
    place = Geodetic(math.radians(beacon.lat_deg), math.radians(beacon.lon_deg), beacon.alt)
    there = simulated_rsbn.ecef(flight.lat, flight.lon, flight.alt)
    return simulated_rsbn.sight_from(place, there)


def in_reach(beacon: Beacon, flight: Trajectory) -> npt.NDArray[np.bool_]:
    """Return a mask: within the beacon's range limit and above its radio horizon (4/3 earth)."""
    slant = azimuth_range_elevation(beacon, flight).slant
    mast, heights = beacon.alt - beacon.ground_alt, flight.alt - beacon.ground_alt
    return simulated_rsbn.in_reach(slant, beacon.range_limit, mast, heights)


def simulate_answers(
    beacon: Beacon,
    flight: Trajectory,
    rng: np.random.Generator,
    outages: tuple[tuple[float, float], ...] = (),
) -> list[RsbnFix]:
    """Simulate the answers at the trajectory's times; `t_ns` is flight time, `rx_ns` adds the latency."""
    azimuth, slant, elevation = azimuth_range_elevation(beacon, flight)
    n = len(flight.t)
    sigma_azimuth = math.radians(beacon.sigma_azimuth_deg)
    sigma_range = beacon.sigma_range + beacon.sigma_range_share * slant
    # drawn for every sample, received or not: an outage does not change the noise after it
    azimuth = azimuth + sigma_azimuth * rng.standard_normal(n)
    slant = slant + sigma_range * rng.standard_normal(n)
    received = in_reach(beacon, flight) & (rng.random(n) >= beacon.drop_out)
    for start, end in outages:
        received &= (flight.t < start) | (flight.t >= end)
    step = math.radians(beacon.azimuth_step_deg)
    if step:
        azimuth = np.round(azimuth / step) * step
    if beacon.range_step:
        slant = np.round(slant / beacon.range_step) * beacon.range_step
    azimuth = np.mod(azimuth, 2.0 * np.pi)
    overhead = elevation > math.radians(beacon.silence_deg)
    lat, lon = math.radians(beacon.lat_deg), math.radians(beacon.lon_deg)
    return [
        RsbnFix(
            round(t * 1e9),
            round((t + beacon.latency_s) * 1e9),
            beacon=beacon.number,
            lat=lat,
            lon=lon,
            alt=beacon.alt,
            azimuth=None if no_azimuth else a,
            slant_range=max(d, 0.0),
            sigma_azimuth=sigma_azimuth,
            sigma_range=s,
        )
        for t, a, d, s, no_azimuth, is_received in zip(
            flight.t.tolist(),
            azimuth.tolist(),
            slant.tolist(),
            sigma_range.tolist(),
            overhead.tolist(),
            received.tolist(),
        )
        if is_received
    ]
