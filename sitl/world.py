"""Simulated world of a scenario: the true trajectory and all sensor records, in flight time.

`t_ns` is the flight time, `rx_ns` the time at which the autopilot can send the record. Messages, requested
rates, links and the companion's clock belong to `sitl.autopilot`.
"""

from __future__ import annotations

import heapq
import math
from collections.abc import Iterable, Iterator, Sequence
from operator import attrgetter

import numpy as np

from companion.nav.geometry import Geodetic, geodetic_to_local
from companion.records import (
    AirData,
    Attitude,
    Gnss,
    Imu,
    LocalOrigin,
    LocalPosition,
    Pressure,
    RsbnFix,
    Solution,
    Stamped,
    Truth,
)
from companion.units import Floats
from sitl import beacon, correctors, sensors
from sitl.faults import apply_record_faults
from sitl.flight import Trajectory, fly_plan, radii
from sitl.scenarios import Scenario

#: Kinds of records that the companion receives from every autopilot.
SENSORS: tuple[type[Stamped], ...] = (LocalPosition, Attitude, Gnss, AirData, Pressure, RsbnFix)
GEOID_M = 16.0  # height of mean sea level above the ellipsoid
BOOT_S = 37.25  # the autopilot booted so long before the start
_TURN = 2.0 * np.pi


class World:
    """Trajectory of a scenario and the record streams of its sensors, each in order of arrival.

    `origin` is the autopilot's local origin: the start, geodetic.
    """

    def __init__(self, scenario: Scenario) -> None:
        self.scenario = scenario
        self.flight = fly_plan(scenario.plan)
        start = self.flight
        self.origin = Geodetic(float(start.lat[0]), float(start.lon[0]), float(start.alt[0]))
        # one generator per sensor: no sensor changes the noise of another
        seeds = np.random.SeedSequence(scenario.seed).spawn(5 + len(scenario.beacons))
        ins, gnss, air, imu, faults, *beacons = (np.random.default_rng(seed) for seed in seeds)
        self.inertial_error = sensors.simulate_inertial_error(
            self.flight, sensors.GRADES[scenario.grade], ins
        )
        self.streams: dict[type[Stamped], Sequence[Stamped]] = {
            Imu: self._imu(imu),
            LocalPosition: self._local_position(),
            Attitude: self._attitude(),
            Gnss: self._gnss(gnss),
            **self._air(air),
            Truth: self._truth(),
            RsbnFix: sorted(
                (
                    fix
                    for ground, rng in zip(scenario.beacons, beacons)
                    for fix in beacon.simulate_answers(
                        ground, self._sampled(scenario.rates.rsbn), rng, scenario.rsbn_outages
                    )
                ),
                key=lambda fix: fix.rx_ns,
            ),
        }
        aircraft = correctors.Aircraft(self.flight, self.inertial_error, sensors.GRADES[scenario.grade])
        #: Records of correctors of the INS, of all kinds.
        self.corrections = correctors.simulate(aircraft, scenario.correctors, scenario.seed)
        for kind, stream in self.streams.items():
            self.streams[kind] = apply_record_faults(kind, stream, scenario.faults, faults)

    def records(self, kinds: Iterable[type[Stamped]] = SENSORS) -> Iterator[Stamped]:
        """Yield what the companion receives: the local origin, then records of `kinds` and of correctors.

        They are in order of arrival; invalid local positions are left out.
        """
        origin = self.origin
        yield LocalOrigin(0, 0, origin.lat, origin.lon, origin.alt - GEOID_M, self.scenario.autopilot)
        streams = (*(self.streams[kind] for kind in kinds), self.corrections)
        for record in heapq.merge(*streams, key=attrgetter("rx_ns")):
            if not isinstance(record, LocalPosition) or all(map(math.isfinite, record.x_n)):
                yield record

    def errors_at(self, t: Floats, lat: Floats, lon: Floats) -> Floats:
        """Return the errors north and east (n, 2) m of positions (n,) rad at flight times `t` (n,) s."""
        truth = self.flight.at(t)
        R_N, R_E = radii(truth.lat)
        north = (lat - truth.lat) * (R_N + truth.alt)
        east = np.remainder(lon - truth.lon + np.pi, _TURN) - np.pi
        return np.stack([north, east * (R_E + truth.alt) * np.cos(truth.lat)], axis=1)

    def horizontal_errors(self, records: Sequence[Solution | Gnss]) -> tuple[Floats, Floats]:
        """Return the flight times (n,) s of solutions or fixes and their horizontal errors (n,) m."""
        t = np.array([r.t_ns for r in records]) * 1e-9
        lat, lon = np.array([(r.lat, r.lon) for r in records]).reshape(-1, 2).T
        return t, np.hypot(*self.errors_at(t, lat, lon).T)

    def _sampled(self, rate_hz: float) -> Trajectory:
        count = int(self.scenario.duration_s * rate_hz * (1.0 + 1e-12)) + 1
        return self.flight.at(np.arange(count) / rate_hz)

    def _imu(self, rng: np.random.Generator) -> list[Imu]:
        flight = self._sampled(self.scenario.rates.imu)
        f_b, w_b = sensors.simulate_imu(flight, sensors.GRADES[self.scenario.grade], rng)
        rows = zip(_ns(flight.t), f_b.tolist(), w_b.tolist())
        return [Imu(t, t, 0, tuple(f), tuple(w)) for t, f, w in rows]

    def _local_position(self) -> list[LocalPosition]:
        flight = self._sampled(self.scenario.rates.local_position)
        error = sensors.interpolate_error(self.inertial_error, flight.t)
        places = np.stack(sensors.displace_positions(flight, error.x_n), axis=1).tolist()
        make = self.scenario.autopilot
        x_n = [geodetic_to_local(make, self.origin, Geodetic(*place)) for place in places]
        v_n = (flight.v_n + error.v_n).tolist()
        return [LocalPosition(t, t, x, tuple(v)) for t, x, v in zip(_ns(flight.t), x_n, v_n)]

    def _attitude(self) -> list[Attitude]:
        flight = self._sampled(self.scenario.rates.attitude)
        psi = sensors.interpolate_error(self.inertial_error, flight.t).psi
        # the platform is rotated by -psi: its tilts along the body axes are the roll and pitch errors
        s, c = np.sin(flight.attitude[:, 2]), np.cos(flight.attitude[:, 2])
        along, across = c * psi[:, 0] + s * psi[:, 1], c * psi[:, 1] - s * psi[:, 0]
        attitude = flight.attitude + np.stack([along, across, psi[:, 2]], axis=1)
        attitude[:, 2] %= _TURN
        return [
            Attitude(t, t, roll, pitch, heading, tuple(w))
            for t, (roll, pitch, heading), w in zip(_ns(flight.t), attitude.tolist(), flight.w_b.tolist())
        ]

    def _gnss(self, rng: np.random.Generator) -> list[Gnss]:
        model, scenario = sensors.GnssModel(), self.scenario
        fixes = sensors.simulate_gnss(self._sampled(scenario.rates.gnss), model, scenario.gnss_outages, rng)
        stamp_offset = round(BOOT_S * 1e6)
        stream = []
        last = (self.origin.lat, self.origin.lon, self.origin.alt)
        columns = (fixes.lat.tolist(), fixes.lon.tolist(), fixes.alt.tolist(), fixes.v_n.tolist())
        for t, lat, lon, alt, v_n, usable in zip(_ns(fixes.t), *columns, fixes.usable.tolist()):
            if usable:
                last = (lat, lon, alt)
            stream.append(
                Gnss(
                    t,
                    t,
                    receiver=0,
                    stamp_us=0 if scenario.autopilot == "px4" else t // 1000 + stamp_offset,
                    fix=3 if usable else 1,
                    lat=last[0],
                    lon=last[1],
                    alt_msl=last[2] - GEOID_M,
                    alt=last[2],
                    sigma_horizontal=model.sigma_horizontal if usable else None,
                    sigma_vertical=model.sigma_horizontal * model.vertical_ratio if usable else None,
                    v_n=tuple(v_n) if usable else None,
                    sigma_velocity=model.velocity_m_s if usable else None,
                    satellites=14 if usable else 0,
                    hdop=0.8 if usable else None,
                )
            )
        return stream

    def _air(self, rng: np.random.Generator) -> dict[type[Stamped], Sequence[Stamped]]:
        flight = self._sampled(self.scenario.rates.air)
        air = sensors.simulate_air_data(flight, sensors.AirDataModel(), rng)
        v_n = flight.v_n + sensors.interpolate_error(self.inertial_error, flight.t).v_n
        speeds = np.stack(
            [air.equivalent_airspeed, np.hypot(v_n[:, 0], v_n[:, 1]), -v_n[:, 2]], axis=1
        ).tolist()
        headings, heights = flight.attitude[:, 2].tolist(), (flight.alt - GEOID_M).tolist()
        sensed = self.scenario.airspeed_sensor
        if not sensed:  # what VFR_HUD then carries: the ground speed of an estimator that knows of no wind
            speeds = [[ground, ground, climb] for _, ground, climb in speeds]
        impact = air.impact if sensed else np.zeros_like(air.impact)
        pressures = np.stack([air.static, impact, air.temperature], axis=1).tolist()
        t_ns = _ns(flight.t)
        return {
            AirData: [
                AirData(t, t, airspeed, False, ground, climb, heading, height, sensed=sensed)
                for t, (airspeed, ground, climb), heading, height in zip(t_ns, speeds, headings, heights)
            ],
            Pressure: [Pressure(t, t, *values) for t, values in zip(t_ns, pressures)],
        }

    def _truth(self) -> list[Truth]:
        flight = self._sampled(self.scenario.rates.truth)
        places = np.stack([flight.lat, flight.lon, flight.alt], axis=1).tolist()
        return [
            Truth(t, t, lat, lon, alt, tuple(v), tuple(attitude))
            for t, (lat, lon, alt), v, attitude in zip(
                _ns(flight.t), places, flight.v_n.tolist(), flight.attitude.tolist()
            )
        ]


def _ns(t: Floats) -> list[int]:
    out: list[int] = np.rint(t * 1e9).astype(np.int64).tolist()
    return out
