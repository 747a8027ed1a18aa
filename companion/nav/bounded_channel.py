"""Channels with unknown-but-bounded errors: what is stated of them is a bound on each r.m.s., by grade.

`BoundedIns` is an INS: position, velocity and tilt errors by `error_model.aircraft_matrix`, and as constants
of known effect the heading error (which turns a specific force into an error), gyro drift and accelerometer
errors fixed in the body, and scale factors. What remains is one unknown force, `WanderingForce`: the parts of
the sensor errors that are not constant. `BoundedDrift` is dead reckoning or a foreign estimator: its velocity
error wanders and jumps, nothing restores it, and no Schuler law holds.

An error that wanders is taken relative to its value at the anchor, the last fix: the constant there is a
state, and the bound of what remains grows with the time from it, to either side.

It does not know the fixes, nor vertical errors.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from companion.nav.error_model import aircraft_matrix
from companion.units import G0, Floats

TURNING_M_S = 5.0  # slower, the course does not give the heading
FAR_M = 1e5  # of a position of which nothing is known
#: White acceleration of density q makes an error sqrt(q T^3 / 3) in T, a constant d one of d T^2 / 2: equal
#: at 5 min. What it makes in less is below 3 m for 1e-3 m/s/sqrt s.
WHITE_OVER_S = 0.75 * 300.0
VELOCITY, TILT, INS = slice(2, 4), slice(4, 7), slice(0, 7)
GYRO, ACCELEROMETER, SCALE, GYRO_SCALE = slice(7, 10), slice(10, 12), slice(12, 14), 14


class UnitErrors(NamedTuple):
    """Errors of an inertial unit, one standard deviation each, SI.

    `gyro` (rad/s) and `accelerometer` (m/s^2) are Markov's with correlation times `gyro_s` and
    `accelerometer_s`; `tilt_walk` (rad/sqrt s) and `velocity_walk` (m/s/sqrt s) are white noise's integrals;
    `velocity`, `tilt`, `heading` are those of the alignment (m/s, rad); scales are relative.
    """

    gyro: float
    gyro_s: float
    tilt_walk: float
    accelerometer: float
    accelerometer_s: float
    velocity_walk: float
    velocity: float
    tilt: float
    heading: float
    gyro_scale: float = 0.0
    accelerometer_scale: float = 0.0


class WanderingForce(NamedTuple):
    """Specific force (m/s^2) on each axis, left when the errors at the anchor are taken as constants."""

    unit: UnitErrors

    def bound(self, age_s: Floats) -> Floats:
        """Compute its r.m.s. at times from the anchor.

        Parameters
        ----------
        age_s : (k,)
            Times from the anchor, s, of either sign.

        Returns
        -------
        (k,)
            R.m.s., m/s^2.
        """
        white = self.unit.velocity_walk**2 / WHITE_OVER_S
        force: Floats = np.sqrt(self._wandering(np.abs(age_s), np.abs(age_s)) + white)
        return force

    def covariance(self, age_s: Floats) -> Floats:
        """Compute its covariance between times that are the middles of consecutive steps.

        Parameters
        ----------
        age_s : (k,)
            Times from the anchor, s, increasing.

        Returns
        -------
        (k, k)
            Covariance, m^2/s^4.
        """
        one, other = np.abs(age_s)[:, None], np.abs(age_s)[None, :]
        same = np.sign(age_s)[:, None] == np.sign(age_s)
        F: Floats = np.where(same, self._wandering(one, other), 0.0)
        step = np.gradient(age_s) if len(age_s) > 1 else 2.0 * np.abs(age_s)
        return F + np.diag(self.unit.velocity_walk**2 / np.maximum(step, 1e-3))

    def _wandering(self, s: Floats, t: Floats) -> Floats:
        """Covariance between ages s and t on one side of the anchor: tilt walk, drift's integral, bias."""
        u = self.unit
        short, long = np.minimum(s, t), np.maximum(s, t)
        tilt = u.tilt_walk**2 * short
        # a drift that walks by 2 sigma^2 / tau: its integral
        tilt = tilt + 2.0 * u.gyro**2 / u.gyro_s * short**2 * (3.0 * long - short) / 6.0
        tau = u.accelerometer_s
        bias = 1.0 + np.exp(-np.abs(s - t) / tau) - np.exp(-s / tau) - np.exp(-t / tau)
        force: Floats = G0**2 * tilt + u.accelerometer**2 * bias
        return force


class Motion(NamedTuple):
    """Nominal motion over a short interval: latitude (rad), velocity at its start and end (m/s), seconds."""

    lat: float
    before: tuple[float, float]
    after: tuple[float, float]
    seconds: float


class BoundedIns(NamedTuple):
    """INS of bounded errors, by the errors of its unit.

    States: position (m), velocity (m/s), P minus the rotation of the platform (3, rad), gyro drift (3,
    rad/s), accelerometer errors (2, m/s^2), accelerometer scales along and across the course, gyro scale.
    """

    unit: UnitErrors
    correlation_s: float = 0.0
    strapped_down: bool = True
    n: int = 15
    free: int = 2

    def prior(self) -> Floats:
        """Return the r.m.s. of the states (15,) at alignment; of the position nothing is known."""
        u = self.unit
        return np.array(
            [FAR_M] * 2
            + [u.velocity] * 2
            + [u.tilt, u.tilt, u.heading]
            + [u.gyro] * 3
            + [u.accelerometer] * 2
            + [u.accelerometer_scale] * 2
            + [u.gyro_scale]
        )

    def bound(self, age_s: Floats) -> Floats:
        """Return the r.m.s. bound of the unknown force, m/s^2, at times from the anchor, s."""
        return WanderingForce(self.unit).bound(age_s)

    def covariance(self, age_s: Floats) -> Floats:
        """Return its expected covariance."""
        return WanderingForce(self.unit).covariance(age_s)

    def step(self, motion: Motion) -> tuple[Floats, Floats, Floats]:
        """Compute transition (15, 15), effect of a unit force (15, 2) and noise (15, 15) of an interval.

        Parameters
        ----------
        motion : Motion
            Nominal motion; its acceleration is the mean one, so that a whole turn counts.

        Returns
        -------
        tuple
            Phi, B, Q.
        """
        dt, (vn, ve) = motion.seconds, motion.after
        mean = (0.5 * (vn + motion.before[0]), 0.5 * (ve + motion.before[1]))
        a = ((vn - motion.before[0]) / dt, (ve - motion.before[1]) / dt)
        A = np.zeros((15, 15))
        A[INS, INS] = aircraft_matrix(motion.lat, *mean, (*a, 0.0))
        A[TILT, GYRO] = np.eye(3)
        A[VELOCITY, ACCELEROMETER] = np.eye(2)
        speed = math.hypot(*mean)
        if speed > TURNING_M_S:
            n, e = mean[0] / speed, mean[1] / speed
            along, across = n * a[0] + e * a[1], n * a[1] - e * a[0]
            A[2, SCALE], A[3, SCALE] = (n * along, -e * across), (e * along, n * across)
            rate = across / speed
            A[6, GYRO_SCALE] = rate
            if self.strapped_down:
                # a sensor's error turns with the aircraft: b' = (course rate) down x b
                for north, east in ((7, 8), (10, 11)):
                    A[north, east] -= rate
                    A[east, north] += rate
        M = A * dt
        M2 = M @ M
        Phi = np.eye(15) + M + 0.5 * M2 + M2 @ M / 6.0
        B = np.zeros((15, 2))
        B[VELOCITY] = np.eye(2)
        B = dt * (B + 0.5 * M @ B + M2 @ B / 6.0)
        u = self.unit
        density = np.zeros(15)
        density[VELOCITY], density[TILT] = u.velocity_walk**2, u.tilt_walk**2
        return Phi, B, np.diag(density * dt)


class BoundedDrift(NamedTuple):
    """Channel whose velocity error wanders and jumps: wind on dead reckoning, a foreign estimator.

    States: position (m) and velocity (m/s), north and east, relative error of the speed, error of the heading
    (rad). `velocity` is the r.m.s. of the first velocity error, `walk` that of its change (m/s/sqrt s), jumps
    of stated size and rate included. `wander` (m/s) is an error of the velocity that lasts `wander_s`: crab.
    """

    velocity: float
    walk: float
    scale: float = 0.0
    heading: float = 0.0
    wander: float = 0.0
    wander_s: float = 1.0
    correlation_s: float = 0.0
    n: int = 6
    free: int = 2

    def prior(self) -> Floats:
        """Return the r.m.s. of the states (6,) at the start; of the position nothing is known."""
        return np.array([FAR_M] * 2 + [self.velocity] * 2 + [self.scale, self.heading])

    def bound(self, age_s: Floats) -> Floats:
        """Return the r.m.s. bound of the velocity's change, m/s, at times from the anchor, s."""
        return np.asarray(np.sqrt(self.walk**2 * np.abs(age_s) + self.wander**2), dtype=np.float64)

    def covariance(self, age_s: Floats) -> Floats:
        """Return its expected covariance."""
        same = np.sign(age_s)[:, None] == np.sign(age_s)
        short = np.minimum(np.abs(age_s)[:, None], np.abs(age_s))
        F: Floats = np.where(same, self.walk**2 * short, 0.0)
        return F + self.wander**2 * np.exp(-np.abs(age_s[:, None] - age_s) / self.wander_s)

    def step(self, motion: Motion) -> tuple[Floats, Floats, Floats]:
        """Compute transition (6, 6), effect of a unit change of velocity (6, 2) and noise of an interval.

        The nominal velocity is the one through the air where its errors turn with the heading.
        """
        dt = motion.seconds
        n, e = (0.5 * dt * (a + b) for a, b in zip(motion.before, motion.after, strict=True))
        Phi, B = np.eye(6), np.zeros((6, 2))
        Phi[:2, 2:4] = B[:2] = dt * np.eye(2)
        Phi[:2, 4:] = (n, -e), (e, n)
        return Phi, B, np.diag([0.0, 0.0, self.walk**2 * dt, self.walk**2 * dt, 0.0, 0.0])
