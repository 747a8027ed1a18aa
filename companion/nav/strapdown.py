"""Strapdown navigation in the local-level frame, and its mirror: the inertial measurements of a trajectory.

`mechanise` integrates specific force f_b and angular rate w_b (means over a step, of the body against the
inertial frame) into position, ground velocity and attitude; `synthesise` takes two states and gives back the
f_b and w_b between them. Each is second order in dt with the body's rotation integrated exactly; at 50-200 Hz
their disagreement is far below any sensor's noise. Knows nothing of sensor errors, filters or the barometer:
the vertical channel is unstable alone, as every INS's is, and is the caller's to hold.

Source: Groves (2013), 5.4 (local-navigation-frame equations) and 5.5; Savage's exact rotation of a step.
"""

import math
from typing import NamedTuple, Protocol

import numpy as np
import numpy.typing as npt

import companion.nav.earth as wgs84
from companion.nav.earth import Radii
from companion.nav.geometry import wrap

Vector = npt.NDArray[np.float64]
Matrix = npt.NDArray[np.float64]


_ZERO = np.zeros(3)


class Earth(Protocol):
    """What the equations ask of the earth: the module `earth` (WGS84), or an `earth.Sphere`."""

    @property
    def OMEGA(self) -> float:
        """Rate of rotation."""

    def radii(self, lat: float) -> Radii:
        """Radii of curvature."""

    def gravity(self, lat: float, alt: float = ...) -> float:
        """Acceleration of gravity, downwards."""


class Inertial(NamedTuple):
    """Where a body is, how it moves and how it is turned."""

    lat: float
    """rad."""
    lon: float
    """rad, [-pi, pi)."""
    alt: float
    """m above the ellipsoid."""
    v_n: Vector
    """(3,) ground velocity, NED, m/s."""
    C_nb: Matrix
    """(3, 3), v_n = C_nb v_b."""


class Increment(NamedTuple):
    """What ideal inertial sensors tell of a step, as means over it."""

    f_b: Vector
    """(3,) specific force, m/s^2."""
    w_b: Vector
    """(3,) angular rate against the inertial frame, rad/s."""


class Rates(NamedTuple):
    """How position, velocity and the frame n itself change at a moment."""

    lat: float
    lon: float
    alt: float
    v_n: Vector
    w_in_n: Vector


def rates(lat: float, alt: float, v_n: Vector, f_n: Vector, earth: Earth = wgs84) -> Rates:
    """The navigation equations in continuous time: Groves (5.54), (5.56), and w_in_n = w_ie_n + w_en_n."""
    vN, vE, vD = v_n.tolist()
    fN, fE, fD = f_n.tolist()
    R_N, R_E = earth.radii(lat)
    s, c = math.sin(lat), math.cos(lat)
    lat_rate, lon_rate = vN / (R_N + alt), vE / ((R_E + alt) * c)
    # w_in + w_ie, resolved in n: what Coriolis takes.
    x, y, z = (2.0 * earth.OMEGA + lon_rate) * c, -lat_rate, -(2.0 * earth.OMEGA + lon_rate) * s
    g = earth.gravity(lat, alt)
    a_n = np.array([fN - y * vD + z * vE, fE - z * vN + x * vD, fD + g - x * vE + y * vN])
    w_in = np.array([(earth.OMEGA + lon_rate) * c, -lat_rate, -(earth.OMEGA + lon_rate) * s])
    return Rates(lat_rate, lon_rate, -vD, a_n, w_in)


def mechanise(state: Inertial, f_b: Vector, w_b: Vector, dt: float, earth: Earth = wgs84) -> Inertial:
    """One step of strapdown integration; f_b (3,) m/s^2 and w_b (3,) rad/s are means over dt (s)."""
    lat, lon, alt, v_n, C_nb = state
    start = rates(lat, alt, v_n, C_nb @ f_b, earth)
    v_mid = v_n + 0.5 * dt * start.v_n
    lat_mid, alt_mid = lat + 0.5 * dt * start.lat, alt + 0.5 * dt * start.alt
    free = rates(lat_mid, alt_mid, v_mid, _ZERO, earth)
    turn = free.w_in_n * dt
    f_b_mean = _mean_rotation(w_b * dt) @ f_b  # f_b turned with the body, resolved in b at the step's start
    f_n = rotation(-0.5 * turn) @ (C_nb @ f_b_mean)
    v_new = v_n + dt * (f_n + free.v_n)
    mean = rates(lat_mid, alt_mid, 0.5 * (v_n + v_new), f_n, earth)
    C_new = rotation(-turn) @ C_nb @ rotation(w_b * dt)
    return Inertial(lat + dt * mean.lat, wrap(lon + dt * mean.lon), alt + dt * mean.alt, v_new, C_new)


def synthesise(state: Inertial, after: Inertial, dt: float, earth: Earth = wgs84) -> Increment:
    """The mean f_b and w_b that lead from `state` to `after` in dt: the inverse of `mechanise`.

    Position is taken at the two ends as given; that it moves with the velocity is the trajectory's affair.
    """
    lat_mid, alt_mid = 0.5 * (state.lat + after.lat), 0.5 * (state.alt + after.alt)
    free = rates(lat_mid, alt_mid, 0.5 * (state.v_n + after.v_n), _ZERO, earth)
    turn = free.w_in_n * dt
    w_b_dt = rotation_vector(state.C_nb.T @ rotation(turn) @ after.C_nb)
    f_n = (after.v_n - state.v_n) / dt - free.v_n
    f_b_mean = state.C_nb.T @ (rotation(0.5 * turn) @ f_n)
    f_b = np.asarray(np.linalg.solve(_mean_rotation(w_b_dt), f_b_mean), dtype=np.float64)
    return Increment(f_b, w_b_dt / dt)


def two_samples(f_1: Vector, w_1: Vector, f_2: Vector, w_2: Vector, dt: float) -> Increment:
    """Two successive samples of dt made one of 2 dt for `mechanise`, coning and sculling compensated.

    Savage's two-sample algorithms: 2/3 a_1 x a_2 for the rotation, and for the velocity
    2/3 (a_1 x u_2 + u_1 x a_2); the rotation term 1/2 a x u is `mechanise`'s own.
    """
    a_1, a_2, u_1, u_2 = w_1 * dt, w_2 * dt, f_1 * dt, f_2 * dt
    angle = a_1 + a_2 + 2.0 / 3.0 * np.cross(a_1, a_2)
    velocity = u_1 + u_2 + 2.0 / 3.0 * (np.cross(a_1, u_2) + np.cross(u_1, a_2))
    return Increment(velocity / (2.0 * dt), angle / (2.0 * dt))


def rotation(vector: Vector) -> Matrix:
    """exp([vector x]) (3, 3): turns by |vector| rad about it (Rodrigues)."""
    x, y, z = vector.tolist()
    angle2 = x * x + y * y + z * z
    return _polynomial(x, y, z, *_rodrigues(angle2)[:2])


def rotation_vector(C: Matrix) -> Vector:
    """The inverse of `rotation`, for turns below pi."""
    axis = 0.5 * np.array([C[2, 1] - C[1, 2], C[0, 2] - C[2, 0], C[1, 0] - C[0, 1]])
    s = math.sqrt(axis @ axis)
    angle = math.atan2(s, 0.5 * (float(C[0, 0] + C[1, 1] + C[2, 2]) - 1.0))
    if angle > 3.1:
        raise ValueError(f"a step turns by {angle:.3f} rad: sample faster, near pi its axis is not defined")
    return np.asarray(axis * (angle / s) if s > 1e-12 else axis)


def _mean_rotation(vector: Vector) -> Matrix:
    """Mean of exp([s vector x]) over s in (0, 1): exact for a constant rate."""
    x, y, z = vector.tolist()
    angle2 = x * x + y * y + z * z
    return _polynomial(x, y, z, *_rodrigues(angle2)[1:])


def _rodrigues(angle2: float) -> tuple[float, float, float]:
    """sin(a)/a, (1 - cos(a))/a^2 and (a - sin(a))/a^3."""
    if angle2 < 1e-4:  # the series are exact to rounding here, the closed forms are not
        return (
            1.0 - angle2 / 6.0 * (1.0 - angle2 / 20.0 * (1.0 - angle2 / 42.0)),
            0.5 - angle2 / 24.0 * (1.0 - angle2 / 30.0 * (1.0 - angle2 / 56.0)),
            1.0 / 6.0 - angle2 / 120.0 * (1.0 - angle2 / 42.0 * (1.0 - angle2 / 72.0)),
        )
    a = math.sqrt(angle2)
    return math.sin(a) / a, (1.0 - math.cos(a)) / angle2, (a - math.sin(a)) / (a * angle2)


def _polynomial(x: float, y: float, z: float, p: float, q: float) -> Matrix:
    """I + p [v x] + q [v x]^2 of v = (x, y, z)."""
    return np.array(
        [
            [1.0 - q * (y * y + z * z), q * x * y - p * z, q * x * z + p * y],
            [q * x * y + p * z, 1.0 - q * (x * x + z * z), q * y * z - p * x],
            [q * x * z - p * y, q * y * z + p * x, 1.0 - q * (x * x + y * y)],
        ]
    )
