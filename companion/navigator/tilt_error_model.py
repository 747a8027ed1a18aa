"""The error of strapdown by the autopilot's attitude as a Gaussian state, as `errorstate.Grade` is an INS's.

    dx' = dVN,    dVN' = TN + c BX - s BY - psi aE + white
    dy' = dVE,    dVE' = TE + s BX + c BY + psi aN + white

dx north and dy east are position errors (m), dVN and dVE velocity errors (m/s); TN and TE what gravity adds
where the attitude tilts (m/s^2: half a degree is 0.085), BX and BY the errors of the accelerometers and of
how they are mounted, forward and right, psi the error of the heading (rad), aN and aE the acceleration, c and
s cosine and sine of the course; then GN, GE, the drift of GNSS (m).

TN, TE, BX, BY and psi are Gauss-Markov. No position error tilts this attitude, so there is no Schuler loop:
an error T of acceleration is T t^2 / 2 of position, and the bound of it is that of a double integrator. The
tilt of an attitude that an autopilot has while its own estimator is led astray is far from Gaussian.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from companion.config import GnssConfig, StrapdownConfig
from companion.navigator.error_state import VELOCITY, System
from companion.records import Vector2, Vector3
from companion.units import G0, Floats

N = 11
TILT, BODY, HEADING, DRIFT = slice(4, 6), slice(6, 8), 8, slice(9, 11)
FIRST_POSITION_M = 1000.0  # the first fix tells it


class TiltError(NamedTuple):
    """First sigmas (N,), white spectral densities (N,), decay rates (N,) 1/s, the vibration's sigma (m/s)."""

    sigma0: Floats
    density: Floats
    decay: Floats
    velocity_noise: float

    def system(self, lat: float, v_n: Vector3, a_n: Vector2) -> System:
        """x' = A x + w on the course of `v_n`, the heading's error turning `a_n`; at any latitude."""
        A = np.diag(-self.decay)
        A[:2] = self.velocity_rows(v_n)
        speed = math.hypot(v_n[0], v_n[1])
        c, s = (v_n[0] / speed, v_n[1] / speed) if speed > 0.0 else (1.0, 0.0)
        A[VELOCITY, TILT] = np.eye(2)
        A[VELOCITY, BODY] = [[c, -s], [s, c]]
        A[VELOCITY, HEADING] = -a_n[1], a_n[0]
        return System(A, np.diag(self.density))

    def velocity_rows(self, v_n: Vector3) -> Floats:
        """The velocity errors are states."""
        return np.eye(2, N, 2)


def grade(settings: StrapdownConfig, gnss: GnssConfig) -> TiltError:
    """What the configuration says of attitude and IMU, in SI."""
    tilt = G0 * math.radians(settings.tilt_deg)
    body, heading = settings.accelerometer_m_s2, math.radians(settings.heading_deg)
    sigma0 = [FIRST_POSITION_M] * 2 + [settings.velocity_m_s] * 2 + [tilt] * 2 + [body] * 2 + [heading]
    sigma0 += [gnss.sigma_m] * 2
    decay = np.zeros(N)
    decay[TILT] = 1.0 / settings.tilt_s
    decay[[*range(6, 8), HEADING]] = 1.0 / (60.0 * settings.correlation_min)
    decay[DRIFT] = 1.0 / gnss.correlation_s
    density = 2.0 * decay * np.square(sigma0)
    density[VELOCITY] = settings.velocity_noise_m_s_sqrt_s**2
    return TiltError(np.array(sigma0), density, decay, settings.vibration_m_s)


def unknown_acceleration(settings: StrapdownConfig) -> float:
    """R.m.s. of the acceleration that the guaranteed bound does not know of, m/s^2."""
    return math.hypot(G0 * math.radians(settings.tilt_deg), settings.accelerometer_m_s2)
