"""RSBN beacon model: coverage and measurement errors.

An answer is the azimuth of the aircraft at the beacon (from true north, clockwise) and the slant range.
Beyond the range limit or the radio horizon there is no answer; in the cone of silence there is no azimuth.
Messages, time mapping and faults (`sitl.faults`) are not modelled here.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from companion.analysis.simulated_rsbn import Sight, ecef, sight_from
from companion.nav.geometry import Geodetic
from companion.records import RsbnFix
from sitl.flight import Trajectory

_RADIO_R = 4.0 / 3.0 * 6371000.0


@dataclass(frozen=True, slots=True)
class Beacon:
    """Ground beacon and the errors of its channel.

    Sigmas are one sigma (RSBN's published 0.25 degrees and 200 m + 0.03 % of the range are two sigma).
    `north_deg` is the misalignment of the beacon's north, added to every azimuth. `alt` is above the
    ellipsoid; `ground_alt` is the height of the smooth earth of the horizon computation.
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
    bias_range: float = 0.0
    north_deg: float = 0.0
    drop_out: float = 0.01
    silence_deg: float = 45.0
    latency_s: float = 0.15


def azimuth_range_elevation(beacon: Beacon, flight: Trajectory) -> Sight:
    """Return azimuth in [0, 2 pi) rad, slant range (m) and elevation (rad) of the aircraft at the beacon."""
    place = Geodetic(math.radians(beacon.lat_deg), math.radians(beacon.lon_deg), beacon.alt)
    return sight_from(place, ecef(flight.lat, flight.lon, flight.alt))


def in_reach(beacon: Beacon, flight: Trajectory) -> np.ndarray[tuple[int], np.dtype[np.bool_]]:
    """Return a mask: within the beacon's range limit and above its radio horizon (4/3 earth)."""
    _, slant, _ = azimuth_range_elevation(beacon, flight)
    mast = max(beacon.alt - beacon.ground_alt, 0.0)
    height = np.maximum(flight.alt - beacon.ground_alt, 0.0)
    horizon = math.sqrt(2.0 * _RADIO_R) * (np.sqrt(height) + math.sqrt(mast))
    reached: np.ndarray[tuple[int], np.dtype[np.bool_]] = slant <= np.minimum(horizon, beacon.range_limit)
    return reached


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
    azimuth = azimuth + math.radians(beacon.north_deg) + sigma_azimuth * rng.standard_normal(n)
    slant = slant + beacon.bias_range + sigma_range * rng.standard_normal(n)
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
