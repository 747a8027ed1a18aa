"""INS channel: Schuler error equations with gyro drift and accelerometer errors, for an INS of its own.

The model is `nav.error_model.aircraft_matrix` with Markov gyro drift and accelerometer errors. States:
position errors north and east (m), velocity errors (m/s), P minus the rotation of the platform (3, rad), E
minus the gyro drift (3, rad/s), A accelerometer errors (2, m/s^2), GNSS drift (2, m), GNSS latency (s),
lever arm of the GNSS antenna ahead of the INS (m), lasting error of the GNSS velocity (2, m/s).
Errors of sensors that are strapped down turn with the aircraft. A grade g multiplies the amplitudes of the
unit's errors: accelerometers, velocity and tilt by g, gyros by g^1.5. Units differ more in their gyros: from
navigation to tactical to MEMS grade 1, 10, 100, where the accelerometers are 1, 4, 10.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from companion.config import Config
from companion.nav.disturbances import accelerometer, compose, gyro_drift
from companion.nav.error_model import INS_STATES, aircraft_matrix
from companion.navigator.channel import DOPPLER_S, Nominal, Transition, discretise
from companion.units import G0, Floats

N = 18
VELOCITY, TILT, INS = slice(2, 4), slice(4, 7), slice(0, 7)
GYROS = slice(7, 10)
GYRO, ACCELEROMETER = (7, 8), (10, 11)  # north and east
DRIFT, LATENCY, ARM, DOPPLER = slice(12, 14), 14, 15, slice(16, 18)
TURNING_M_S = 5.0  # slower, the course does not give the heading
LATENCY_S, LATENCY_WALK = 0.15, 1e-4  # one sigma of the latency (s) and its random walk (s/sqrt s)
LASTING = 0.3  # share of the velocity error of GNSS that lasts: more hides one that is drawn off gently
ARM_M = 1.5  # one sigma of the antenna's lever arm along the fuselage
FIRST_POSITION_M = 1000.0  # the first fix gives the place of the INS
AMPLITUDES = (1.0, 2.0, 4.0, 8.0, 16.0, 32.0, 64.0)
WEIGHTS = (1.0, 0.5, 0.35, 0.25, 0.18, 0.12, 0.09)
GYRO_POWER = 1.5


class InsChannel(NamedTuple):
    """Error model of an INS: A (N, N) of disturbances alone, spectral densities and first variances by grade
    (grades, N, N); `body_fixed` where the sensors are strapped down.
    """

    composed: Floats
    density: Floats
    variance: Floats
    body_fixed: bool
    n: int = N
    drift: slice = DRIFT
    doppler: slice = DOPPLER
    latency: int = LATENCY
    arm: int | None = ARM
    grades: tuple[float, ...] = WEIGHTS
    velocity_noise: float = 0.0
    wind: tuple[int, ...] = ()

    def prior(self) -> Floats:
        """First covariances (grades, N, N)."""
        return self.variance

    def transition(self, nominal: Nominal) -> Transition:
        """Phi and Q since the bank's time; the acceleration is the mean one, so that a whole turn counts."""
        dt = nominal.pending_s
        v_n, before = nominal.point.v_n, nominal.since.v_n
        a_n = ((v_n[0] - before[0]) / dt, (v_n[1] - before[1]) / dt) if dt > 0.0 else nominal.a_n
        A = self.composed.copy()
        A[INS, INS] = aircraft_matrix(nominal.point.position.lat, v_n[0], v_n[1], (*a_n, 0.0))
        speed2 = v_n[0] ** 2 + v_n[1] ** 2
        if self.body_fixed and speed2 > TURNING_M_S**2:
            # a strapped-down sensor's error turns with the aircraft: b_n' = (course rate) down x b_n
            rate = (v_n[0] * a_n[1] - v_n[1] * a_n[0]) / speed2
            for north, east in (GYRO, ACCELEROMETER):
                A[north, east] -= rate
                A[east, north] += rate
        return discretise(A, self.density, dt)


def ins_channel(config: Config) -> InsChannel:
    """Build the error model from the configuration."""
    unit, gnss = config.inertial, config.gnss
    drift = math.radians(unit.gyro_drift_deg_h) / 3600.0
    bias = unit.accelerometer_bias_ug * 1e-6 * G0
    tilt = math.radians(unit.tilt_arcsec / 3600.0)
    heading = math.radians(unit.heading_arcmin / 60.0)
    doppler = LASTING * gnss.sigma_velocity_m_s
    slow = (
        gyro_drift(1.0 / (3600.0 * unit.gyro_correlation_h), drift),
        accelerometer(1.0 / (3600.0 * unit.accelerometer_correlation_h), bias),
    )
    bare = compose(np.zeros((7, 7)), INS_STATES, slow)
    A, ours = np.zeros((N, N)), len(bare.A)
    A[:ours, :ours] = bare.A
    A[DRIFT, DRIFT] = -np.eye(2) / gnss.correlation_s
    A[DOPPLER, DOPPLER] = -np.eye(2) / DOPPLER_S
    density = np.zeros(N)
    density[:ours] = bare.Q.diagonal()
    density[VELOCITY] = unit.velocity_noise_m_s_sqrt_s**2
    density[TILT] = (math.radians(unit.angle_random_walk_deg_sqrt_h) / 60.0) ** 2
    sigma = np.array(
        [max(unit.position_m, FIRST_POSITION_M)] * 2
        + [unit.velocity_m_s] * 2
        + [tilt, tilt, heading]
        + [drift] * 3
        + [bias] * 2
        + [gnss.sigma_m] * 2
        + [LATENCY_S, ARM_M]
        + [doppler] * 2
    )
    amplitude = np.ones((len(AMPLITUDES), N))
    amplitude[:, :ours] = np.array(AMPLITUDES)[:, None]
    amplitude[:, GYROS] **= GYRO_POWER
    first = amplitude.copy()
    first[:, :2] = 1.0  # the first fix gives the position whatever the grade
    amplitude[:, TILT] **= GYRO_POWER  # random walk of the gyros
    scaled = density * amplitude**2
    scaled[:, DRIFT] = 2.0 * gnss.sigma_m**2 / gnss.correlation_s
    scaled[:, LATENCY] = LATENCY_WALK**2
    scaled[:, DOPPLER] = 2.0 * doppler**2 / DOPPLER_S
    one = np.eye(N)
    return InsChannel(A, scaled[:, :, None] * one, (sigma * first)[:, :, None] ** 2 * one, unit.strapped_down)
