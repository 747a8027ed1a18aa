"""Horizontal part of ArduPilot's estimator (EKF3), by which the simulated autopilot takes our positions.

State: position, velocity, wind, north and east of the origin (m, m/s). The rules are those of AP_NavEKF3
(4.7.0-dev, 46ae785) with the parameters of ArduPlane:

- velocity increments of the IMU; their noise stands for tilt and biases too, which are no states here: it is
  chosen so that without positions the velocity follows the airspeed within 3 s, as in the real filter. The
  noise of the wind is ArduPilot's (0.1 m/s^2 at 50 Hz, more in a climb), from take-off on;
- airspeed (1.4 m/s) and zero sideslip (0.17 rad) correct the wind only, and the velocity too once no position
  was accepted for a second; after 7 s without one the wind is kept as truth, and estimated afresh afterwards;
- source set 1: position and velocity of GNSS; source set 2: positions from outside, their accuracy limited to
  0.2 ... 100 m. Both coordinates are tested together at five sigmas;
- a new source set, or a change of `reset_counter`, sets the position; so does a position after 10 s of
  rejected or missing ones, with a standard deviation of 12.5 m.

Attitude and height are not states. The caller gives the error of the IMU, and whether the aircraft flies.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from companion.units import Floats

GNSS_SET, OUTSIDE_SET = 1, 2
VELOCITY_NOISE = 0.15  # [m/s per root second]
WIND_NOISE, IMU_HZ = 0.1, 50.0
AIRSPEED_NOISE, SIDESLIP_VARIANCE = 1.4, 0.03
GNSS_POSITION_NOISE, GNSS_VELOCITY_NOISE = 0.5, 0.5
LEAST_SIGMA_M, MOST_SIGMA_M = 0.2, 100.0
POSITION_GATE, VELOCITY_GATE, AIRSPEED_GATE = 5.0, 5.0, 4.0
DEAD_RECKONING_S, WIND_KEPT_S, RESET_S = 1.0, 7.0, 10.0
RESET_SIGMA_M = 12.5
WIND_FORGOTTEN = 20.0  # [m/s] one sigma of a wind that is estimated afresh
MIN_AIRSPEED = 8.0  # [m/s] below it air data are not used


class AirSample(NamedTuple):
    """True airspeed (m/s, None without a sensor) and heading (rad)."""

    airspeed: float | None
    heading: float


class Ekf3:
    """Position, velocity, wind; times are seconds of flight and must not decrease."""

    def __init__(self) -> None:
        self.x: Floats = np.zeros(6)
        self.P: Floats = np.diag([1.0, 1.0, 0.25, 0.25, 0.0, 0.0])
        self.source_set = GNSS_SET
        self.resets = 0
        self._accepted_s = 0.0  # a position was last accepted
        self._set_is_new = True
        self._reset_counter: int | None = None
        self._wind_is_kept = True

    def select(self, number: int) -> None:
        """Use this source set; the next position of it sets the position."""
        self._set_is_new = self._set_is_new or number != self.source_set
        self.source_set = number

    def propagate(self, dv: Floats, dt: float, t: float, climb: float, flies: bool) -> None:
        """Propagate over `dt` by the velocity increment `dv` (2,), m/s, to the time `t`; `climb` in m/s."""
        x, P = self.x, self.P
        x[0:2] += (x[2:4] + 0.5 * dv) * dt
        x[2:4] += dv
        F = np.eye(6)
        F[0, 2] = F[1, 3] = dt
        self.P = P = F @ P @ F.T
        kept = not flies or t - self._accepted_s > WIND_KEPT_S
        for i in (4, 5):
            if kept:
                P[i, :] = P[:, i] = 0.0
            elif self._wind_is_kept:
                P[i, i] = WIND_FORGOTTEN**2
            P[i - 2, i - 2] += VELOCITY_NOISE**2 * dt
            P[i, i] += 0.0 if kept else (WIND_NOISE * (1.0 + abs(climb))) ** 2 * dt / IMU_HZ
        self._wind_is_kept = kept

    def fuse_air(self, air: AirSample, t: float) -> None:
        """Update by airspeed along the nose and zero sideslip."""
        s, c = math.sin(air.heading), math.cos(air.heading)
        v_n, v_e, w_n, w_e = self.x[2:]
        along = c * (v_n - w_n) + s * (v_e - w_e)
        if along < MIN_AIRSPEED and (air.airspeed is None or air.airspeed < MIN_AIRSPEED):
            return
        reckons = t - self._accepted_s > DEAD_RECKONING_S
        if air.airspeed is not None and air.airspeed >= MIN_AIRSPEED:
            h = np.array([0.0, 0.0, c, s, -c, -s])
            self._update(h, air.airspeed - along, AIRSPEED_NOISE**2, AIRSPEED_GATE, wind_only=not reckons)
        v_n, v_e, w_n, w_e = self.x[2:]
        across = c * (v_e - w_e) - s * (v_n - w_n)
        h = np.array([0.0, 0.0, -s, c, s, -c])
        variance = SIDESLIP_VARIANCE * max(along, MIN_AIRSPEED) ** 2
        self._update(h, -across, variance, math.inf, wind_only=not reckons)

    def fuse_gnss(self, position: Floats, v_n: Floats | None, t: float) -> None:
        """Update by a GNSS fix, position (2,) and velocity (2,), on source set 1."""
        if self.source_set != GNSS_SET:
            return
        self._fuse_position(position, GNSS_POSITION_NOISE, t, is_reset=False)
        if v_n is None:
            return
        S = self.P[2, 2] + self.P[3, 3] + 2.0 * GNSS_VELOCITY_NOISE**2
        innovation = np.asarray(v_n) - self.x[2:4]
        if innovation @ innovation < VELOCITY_GATE**2 * S:
            for i, nu in enumerate(innovation):
                h = np.zeros(6)
                h[2 + i] = 1.0
                self._update(h, float(nu), GNSS_VELOCITY_NOISE**2, math.inf)

    def fuse_outside(self, position: Floats, sigma: float, reset_counter: int, t: float) -> None:
        """Update by a position from outside (2,), on source set 2."""
        is_reset = self._reset_counter is not None and reset_counter != self._reset_counter
        self._reset_counter = reset_counter
        if self.source_set == OUTSIDE_SET:
            self._fuse_position(position, min(max(sigma, LEAST_SIGMA_M), MOST_SIGMA_M), t, is_reset)

    def _fuse_position(self, position: Floats, sigma: float, t: float, is_reset: bool) -> None:
        if is_reset or self._set_is_new:
            self._set_is_new = False
            self._set_position(position)
        innovation = position - self.x[0:2]
        S = self.P[0, 0] + self.P[1, 1] + 2.0 * sigma**2
        if innovation @ innovation >= POSITION_GATE**2 * S:
            if t - self._accepted_s <= RESET_S:
                return
            self._set_position(position)
            self.P[0:2, :] = self.P[:, 0:2] = 0.0
            self.P[0, 0] = self.P[1, 1] = RESET_SIGMA_M**2
        self._accepted_s = t
        for i in (0, 1):
            h = np.zeros(6)
            h[i] = 1.0
            self._update(h, float(position[i] - self.x[i]), sigma**2, math.inf)

    def _set_position(self, position: Floats) -> None:
        self.x[0:2] = position
        self.resets += 1

    def _update(self, h: Floats, nu: float, r: float, gate: float, wind_only: bool = False) -> None:
        Ph = self.P @ h
        s = float(h @ Ph) + r
        if nu * nu >= gate * gate * s:
            return
        k = Ph / s
        if wind_only:
            k[:4] = 0.0
        elif self._wind_is_kept:
            k[4:] = 0.0
        self.x += k * nu
        kPh = k[:, None] * Ph
        self.P = self.P - kPh - kPh.T + s * (k[:, None] * k)  # Joseph's form: k need not be optimal
