"""The simulated autopilot's own estimate of its position: ArduPilot's filter along a simulated flight.

    estimate.receive(message, origin, t_ns)   # a position or a source set from the companion
    estimate.advance(t_ns)                    # sensors up to the flight time
    estimate.local_position()                 # what LOCAL_POSITION_NED states

The filter gets the records of the world with their faults: GNSS, airspeed, heading; velocity increments are
true ones with the error of a stock IMU. The aircraft flies its plan whatever the estimate is: errors of the
estimate are seen, the path that they lead to is not.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from companion.analysis.error_statistics import root_mean_square
from companion.link.dialect import mavlink
from companion.nav.geometry import Geodetic, geodetic_to_local
from companion.records import AirData, Attitude, Gnss, LocalOrigin, LocalPosition
from companion.units import SECOND_NS, Floats
from sitl.ekf3 import AirSample, Ekf3
from sitl.positions import position_of
from sitl.world import World

RATE_HZ = 10.0
FLIES_M = 10.0  # [m] height above the start from which it flies
IMU_BIAS, IMU_NOISE = 0.02, 0.02
"""Error of a velocity increment, m/s^2 (a tilt of 0.1 deg) and m/s per root second."""
_LAPSE, _POWER = 2.25577e-5, 2.12794  # true / equivalent airspeed of the standard atmosphere


class OwnErrors(NamedTuple):
    """Errors of the estimate, north and east (n, 2), m, at flight times `t` (n,), s."""

    t: Floats
    error_n: Floats

    def between(self, start_s: float, end_s: float) -> tuple[float, float]:
        """Return the r.m.s. and the greatest horizontal error between two times, m; NaN without any."""
        within = (self.t >= start_s) & (self.t < end_s)
        size = np.hypot(*self.error_n[within].T)
        return (root_mean_square(size), float(size.max())) if len(size) else (np.nan, np.nan)


class OwnEstimate:
    """ArduPilot's filter on the sensors of `world`; `version` is the firmware's.

    `truth_n` is the true position (n, 2) at each step, from the world's origin.
    """

    def __init__(self, world: World, version: tuple[int, int]) -> None:
        self.filter = Ekf3()
        self._world, self._version = world, version
        count = int(world.scenario.duration_s * RATE_HZ)
        self._t = np.arange(1, count + 1) / RATE_HZ
        truth = world.flight.at(np.concatenate(([0.0], self._t)))
        rng = np.random.default_rng([world.scenario.seed, 2])
        bias = IMU_BIAS * rng.standard_normal(2) / RATE_HZ
        noise = IMU_NOISE / np.sqrt(RATE_HZ) * rng.standard_normal((count, 2))
        self._dv = np.diff(truth.v_n[:, :2], axis=0) + bias + noise
        places = zip(truth.lat[1:], truth.lon[1:], truth.alt[1:])
        self.truth_n = np.array([self._local(Geodetic(*place)) for place in places])
        self._down = world.origin.alt - truth.alt[1:]
        self._climb = truth.v_n[1:, 2]
        self._next = dict.fromkeys((Gnss, AirData, Attitude), 0)
        self._heading = float(truth.attitude[0, 2])
        self._airspeed: float | None = None
        self._waiting: list[tuple[int, Any, LocalOrigin]] = []
        self._errors: list[Floats] = []

    @property
    def errors(self) -> OwnErrors:
        """The errors so far."""
        return OwnErrors(self._t[: len(self._errors)], np.array(self._errors).reshape(-1, 2))

    def receive(self, message: Any, origin: LocalOrigin, t_ns: int) -> None:
        """Process a position from the companion, relative to `origin`, or a command for a source set."""
        self._waiting.append((t_ns, message, origin))

    def advance(self, t_ns: int, gnss_is_on: bool = True) -> None:
        """Process all sensors up to flight time `t_ns`."""
        while len(self._errors) < len(self._t) and self._t[len(self._errors)] * 1e9 <= t_ns:
            self._step(len(self._errors), gnss_is_on)

    def local_position(self) -> LocalPosition:
        """Return the estimate at the last step, relative to the world's origin."""
        k = max(len(self._errors) - 1, 0)
        t, x = round(self._t[k] * SECOND_NS), self.filter.x.tolist()
        return LocalPosition(t, t, (x[0], x[1], float(self._down[k])), (x[2], x[3], float(self._climb[k])))

    def _step(self, k: int, gnss_is_on: bool) -> None:
        ekf, t = self.filter, float(self._t[k])
        t_ns = round(t * 1e9)
        flies = -float(self._down[k]) > FLIES_M
        ekf.propagate(self._dv[k], 1.0 / RATE_HZ, t, float(self._climb[k]), flies)
        for attitude in self._taken(Attitude, t_ns):
            self._heading = attitude.heading
        for air in self._taken(AirData, t_ns):
            ratio = (1.0 - _LAPSE * (self._world.origin.alt - self._down[k])) ** -_POWER
            self._airspeed = air.airspeed * float(ratio) if air.sensed else None
        if flies:
            ekf.fuse_air(AirSample(self._airspeed, self._heading), t)
        for fix in self._taken(Gnss, t_ns):
            if gnss_is_on and fix.has_3d_fix:
                velocity = None if fix.v_n is None else np.array(fix.v_n[:2])
                ekf.fuse_gnss(self._local(Geodetic(fix.lat, fix.lon, fix.alt)), velocity, t)
        while self._waiting and self._waiting[0][0] <= t_ns:
            self._take(*self._waiting.pop(0)[1:], t)
        self._errors.append(ekf.x[0:2] - self.truth_n[k])

    def _take(self, message: Any, origin: LocalOrigin, t: float) -> None:
        if message.get_type() in ("COMMAND_LONG", "COMMAND_INT"):
            if message.command == mavlink.MAV_CMD_SET_EKF_SOURCE_SET:
                self.filter.select(int(message.param1))
            return
        reported = position_of(message, origin, "ardupilot", self._version)
        if reported is not None and reported.sigma is not None:
            self.filter.fuse_outside(self._local(reported.place), reported.sigma, message.reset_counter, t)

    def _local(self, place: Geodetic) -> Floats:
        return np.array(geodetic_to_local("ardupilot", self._world.origin, place)[:2])

    def _taken(self, kind: Any, t_ns: int) -> list[Any]:
        """Return the records of `kind` that arrived up to `t_ns` and were not returned before."""
        stream: Any = self._world.streams[kind]
        first = last = self._next[kind]
        while last < len(stream) and stream[last].rx_ns <= t_ns:
            last += 1
        self._next[kind] = last
        return list(stream[first:last])


def unaided_errors(world: World) -> OwnErrors:
    """Return the errors of the estimate on the same sensors without a companion."""
    alone = OwnEstimate(world, (0, 0))
    alone.advance(round(world.scenario.duration_s * SECOND_NS))
    return alone.errors
