"""The error of air-data dead reckoning as a Gaussian state: what `errorstate.Grade` is to an INS.

    dx' = dVN + k VN - psi VE + white,    dVN' = random walk
    dy' = dVE + k VE + psi VN + white,    dVE' = random walk

dx north and dy east are position errors (m), dVN and dVE minus the wind (m/s), k the relative error of the
airspeed, psi that of the heading (rad), V the velocity through the air; then GN, GE, the drift of GNSS (m).
k and psi look like wind while the course is straight and show themselves in a turn. The white noise is the
gusts: half a metre a second in half a second. Wind is unknown-but-bounded rather than random; its random walk
is the minimax filter's Q = B C C' B' of an increment bounded by C in each second (Poddubny, section 2).
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from companion.config import AirDataConfig, GnssConfig
from companion.navigator.error_state import FRONT_S, System
from companion.records import Vector2, Vector3
from companion.units import Floats

N = 8
WIND, SCALE, HEADING, DRIFT = slice(2, 4), 4, 5, slice(6, 8)
FIRST_POSITION_M = 2000.0  # nothing is known: the first fix, by which the channel begins, tells all
EDDY = 16.0  # times longer than `gust_s` a gust may last: 8 s, an eddy of 300 m at 38 m/s


class WindError(NamedTuple):
    """First sigmas (N,), white spectral densities (N,), decay rates (N,) 1/s, and the sigmas of gusts and of
    jumps of the wind (m/s).
    """

    sigma0: Floats
    density: Floats
    decay: Floats
    velocity_noise: float
    jump: float

    def system(self, lat: float, v_n: Vector3, a_n: Vector2) -> System:
        """x' = A x + w, the channel flying through the air at `v_n`; neither latitude nor `a_n` matters."""
        A = np.diag(-self.decay)
        A[:2] = self.velocity_rows(v_n)
        return System(A, np.diag(self.density))

    def velocity_rows(self, v_n: Vector3) -> Floats:
        """H (2, N): the error of the channel's velocity over ground, north and east, is H x."""
        H = np.zeros((2, N))
        H[:, WIND] = np.eye(2)
        H[:, SCALE] = v_n[0], v_n[1]
        H[:, HEADING] = -v_n[1], v_n[0]
        return H


def grade(settings: AirDataConfig, gnss: GnssConfig) -> WindError:
    """What the configuration says of wind and air data, in SI."""
    heading = math.radians(settings.heading_deg)
    scale = 0.01 * settings.airspeed_percent
    sigma0 = [FIRST_POSITION_M] * 2 + [settings.wind_m_s] * 2 + [scale, heading] + [gnss.sigma_m] * 2
    decay = np.zeros(N)
    decay[[SCALE, HEADING]] = 1.0 / (60.0 * settings.correlation_min)
    decay[DRIFT] = 1.0 / gnss.correlation_s
    density = 2.0 * decay * np.square(sigma0)
    density[:2] = 2.0 * settings.gust_m_s**2 * settings.gust_s
    density[WIND] = settings.wind_change_m_s_sqrt_s**2
    return WindError(np.array(sigma0), density, decay, settings.gust_m_s, settings.wind_jump_m_s)


def overbound(unit: WindError) -> WindError:
    """For the integrity monitor, which must not take a jump of the wind for the fault of a beacon."""
    density = unit.density.copy()
    density[WIND] = unit.jump**2 / FRONT_S
    density[:2] *= EDDY
    return unit._replace(density=density, velocity_noise=math.sqrt(EDDY) * unit.velocity_noise)
