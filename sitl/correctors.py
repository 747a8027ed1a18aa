"""Simulated correctors of an INS: star fixes, lines of position of a hyperbolic system, a second INS.

Records with the errors that `companion.navigator.corrected_ins` assumes. `RECORDS` has them by the name of
`inertial.correctors`; airspeed needs no record of its own.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from companion.nav.earth import OMEGA
from companion.nav.geometry import Geodetic, enu_axes, to_ecef
from companion.navigator.corrected_ins import CHAIN_BIAS_M
from companion.records import RangeDifference, SecondIns, Stamped, StarFix
from companion.units import SECOND_NS, Floats
from sitl import sensors
from sitl.flight import Trajectory

STAR_EVERY_S, STAR_SIGMA = 60.0, math.radians(20.0 / 3600.0)
LINE_EVERY_S, LINE_SIGMA_M = 5.0, 50.0
SECOND_EVERY_S = 2.0


#: A master and two secondaries of a hyperbolic system, 300 to 500 km round the flights.
MASTER, *SECONDARIES = (
    Geodetic(math.radians(lat), math.radians(lon), 50.0)
    for lat, lon in ((61.5, 26.0), (58.0, 27.0), (60.0, 36.0))
)
#: Declination and hour angle at the start, deg: in the west, south-east and north-east of 60 N, 30 E.
STARS = ((20.0, -20.0), (10.0, 70.0), (50.0, 100.0))


class Aircraft(NamedTuple):
    """True flight, errors of the INS that is corrected, and its grade."""

    flight: Trajectory
    error: sensors.InertialError
    grade: sensors.InertialGrade

    def every(self, seconds: float) -> Trajectory:
        """Sample the flight."""
        return self.flight.at(np.arange(1.0, float(self.flight.t[-1]), seconds))


def star_fixes(aircraft: Aircraft, rng: np.random.Generator) -> list[StarFix]:
    """One star a minute, in turn: its altitude and azimuth on the axes of the INS."""
    flight = aircraft.every(STAR_EVERY_S)
    psi = sensors.interpolate_error(aircraft.error, flight.t).psi
    found = []
    for k, t in enumerate(flight.t.tolist()):
        number = k % len(STARS)
        declination, hour = STARS[number]
        lon = math.radians(hour) - OMEGA * t
        s_n = direction(float(flight.lat[k]), float(flight.lon[k]), math.radians(declination), lon)
        seen = s_n + np.cross(psi[k], s_n)  # the platform is turned by -psi
        altitude = math.asin(-seen[2] / float(np.linalg.norm(seen))) + STAR_SIGMA * rng.standard_normal()
        azimuth = math.atan2(seen[1], seen[0]) + STAR_SIGMA / math.cos(altitude) * rng.standard_normal()
        t_ns = round(t * SECOND_NS)
        sigma_azimuth = STAR_SIGMA / math.cos(altitude)
        place = (math.radians(declination), lon)
        found.append(StarFix(t_ns, t_ns, number, *place, altitude, azimuth, STAR_SIGMA, sigma_azimuth))
    return found


def direction(lat: float, lon: float, star_lat: float, star_lon: float) -> Floats:
    """Unit vector (3,) north, east, down to a star, from its vector in the earth's frame."""
    s_e = np.array(
        (math.cos(star_lat) * math.cos(star_lon), math.cos(star_lat) * math.sin(star_lon), math.sin(star_lat))
    )
    east, north, up = np.array(enu_axes(lat, lon)) @ s_e
    return np.array((north, east, -up))


def range_differences(aircraft: Aircraft, rng: np.random.Generator) -> list[RangeDifference]:
    """Two lines of position every five seconds, each with a bias of its own."""
    flight = aircraft.every(LINE_EVERY_S)
    bias = 0.5 * CHAIN_BIAS_M * rng.standard_normal(len(SECONDARIES))
    found = []
    for k, t in enumerate(flight.t.tolist()):
        here = np.array(to_ecef(Geodetic(float(flight.lat[k]), float(flight.lon[k]), float(flight.alt[k]))))
        d = [float(np.linalg.norm(here - to_ecef(place))) for place in (MASTER, *SECONDARIES)]
        t_ns = round(t * SECOND_NS)
        for chain, secondary in enumerate(SECONDARIES):
            value = d[0] - d[chain + 1] + float(bias[chain]) + LINE_SIGMA_M * rng.standard_normal()
            found.append(RangeDifference(t_ns, t_ns, chain, *MASTER, *secondary, value, LINE_SIGMA_M))
    return found


def second_positions(aircraft: Aircraft, rng: np.random.Generator) -> list[SecondIns]:
    """Positions of a second INS of the same grade, with errors of its own."""
    error = sensors.simulate_inertial_error(aircraft.flight, aircraft.grade, rng)
    flight = aircraft.every(SECOND_EVERY_S)
    lat, lon, _ = sensors.displace_positions(flight, sensors.interpolate_error(error, flight.t).x_n)
    times = [round(t * SECOND_NS) for t in flight.t.tolist()]
    return [SecondIns(t, t, 2, *place) for t, *place in zip(times, lat.tolist(), lon.tolist(), strict=True)]


RECORDS: dict[str, Callable[[Aircraft, np.random.Generator], Sequence[Stamped]]] = {
    "hyperbolic": range_differences,
    "stars": star_fixes,
    "second_ins": second_positions,
}


def simulate(aircraft: Aircraft, names: Sequence[str], seed: int) -> list[Stamped]:
    """Simulate the records of the named correctors, in order of arrival."""
    numbers = {name: number for number, name in enumerate(RECORDS)}
    found = [
        record
        for name in names
        if name in RECORDS
        for record in RECORDS[name](aircraft, np.random.default_rng([seed, 2, numbers[name]]))
    ]
    return sorted(found, key=lambda record: record.rx_ns)
