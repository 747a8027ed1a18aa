"""Strapdown navigation in the local-level frame, and its inverse: the inertial measurements of a trajectory.

`mechanise` integrates specific force f_b and angular rate w_b (means over a step, of the body against the
inertial frame) into position, ground velocity and attitude; `synthesise` takes two states and returns the
f_b and w_b between them. Each is second order in dt with the body's rotation integrated exactly; at 50-200 Hz
their disagreement is far below any sensor's noise. It does not know sensor errors, filters or the barometer:
the vertical channel alone is unstable, as in every INS, and the caller stabilises it.

Source: Groves (2013), 5.4 (local-navigation-frame equations) and 5.5; Savage's exact rotation of a step.
"""

import math
from typing import NamedTuple, Protocol

import numpy as np

import companion.nav.earth as wgs84
from companion.nav.earth import Radii
from companion.nav.geometry import wrap_angle
from companion.units import Floats

_ZERO = np.zeros(3)


class Earth(Protocol):
    """Model of the earth in the equations: the module `earth` (WGS84), or an `earth.Sphere`."""

    @property
    def OMEGA(self) -> float:
        """Return the rate of rotation, rad/s."""

    def radii(self, lat: float) -> Radii:
        """Compute the radii of curvature.

        Parameters
        ----------
        lat : float
            Geodetic latitude, rad.

        Returns
        -------
        Radii
            Meridian and prime vertical, m.
        """

    def gravity(self, lat: float, alt: float = ...) -> float:
        """Compute the acceleration of gravity.

        Parameters
        ----------
        lat : float
            Geodetic latitude, rad.
        alt : float
            Height, m.

        Returns
        -------
        float
            Downwards, m/s^2.
        """


class InertialState(NamedTuple):
    """Position, velocity and attitude of a body.

    Attributes
    ----------
    lat, lon : float
        Geodetic latitude and longitude, rad; longitude in [-pi, pi).
    alt : float
        Height above the ellipsoid, m.
    v_n : (3,)
        Ground velocity, NED, m/s.
    C_nb : (3, 3)
        Attitude, v_n = C_nb v_b.
    """

    lat: float
    lon: float
    alt: float
    v_n: Floats
    C_nb: Floats


class StepMeans(NamedTuple):
    """Readings of ideal inertial sensors, as means over a step.

    Attributes
    ----------
    f_b : (3,)
        Specific force in the body, m/s^2.
    w_b : (3,)
        Angular rate of the body against the inertial frame, rad/s.
    """

    f_b: Floats
    w_b: Floats


class Rates(NamedTuple):
    """Rates of change of position, velocity and frame n.

    Attributes
    ----------
    lat, lon : float
        rad/s.
    alt : float
        m/s.
    v_n : (3,)
        Rate of the ground velocity, NED, m/s^2.
    w_in_n : (3,)
        Angular rate of n against the inertial frame, in n, rad/s.
    """

    lat: float
    lon: float
    alt: float
    v_n: Floats
    w_in_n: Floats


def navigation_rates(lat: float, alt: float, v_n: Floats, f_n: Floats, earth: Earth = wgs84) -> Rates:
    """Evaluate the navigation equations in continuous time, with w_in_n = w_ie_n + w_en_n.

    Parameters
    ----------
    lat : float
        Geodetic latitude, rad.
    alt : float
        Height above the ellipsoid, m.
    v_n : (3,)
        Ground velocity, NED, m/s.
    f_n : (3,)
        Specific force, NED, m/s^2.
    earth : Earth
        Model of the earth.

    Returns
    -------
    Rates
        Rates of change.

    References
    ----------
    Groves (5.54), (5.56).
    """
    vN, vE, vD = v_n.tolist()
    fN, fE, fD = f_n.tolist()
    R_N, R_E = earth.radii(lat)
    s, c = math.sin(lat), math.cos(lat)
    lat_rate, lon_rate = vN / (R_N + alt), vE / ((R_E + alt) * c)
    # w_in + w_ie in n, for Coriolis
    x, y, z = (2.0 * earth.OMEGA + lon_rate) * c, -lat_rate, -(2.0 * earth.OMEGA + lon_rate) * s
    g = earth.gravity(lat, alt)
    a_n = np.array([fN - y * vD + z * vE, fE - z * vN + x * vD, fD + g - x * vE + y * vN])
    w_in = np.array([(earth.OMEGA + lon_rate) * c, -lat_rate, -(earth.OMEGA + lon_rate) * s])
    return Rates(lat_rate, lon_rate, -vD, a_n, w_in)


def mechanise(
    state: InertialState, f_b: Floats, w_b: Floats, dt: float, earth: Earth = wgs84
) -> InertialState:
    """Integrate one step of strapdown navigation.

    Parameters
    ----------
    state : InertialState
        State before the step.
    f_b : (3,)
        Mean specific force over the step, m/s^2.
    w_b : (3,)
        Mean angular rate over the step, rad/s.
    dt : float
        Step, s.
    earth : Earth
        Model of the earth.

    Returns
    -------
    InertialState
        State after the step.

    References
    ----------
    Groves (2013), 5.4, 5.5.
    """
    lat, lon, alt, v_n, C_nb = state
    start = navigation_rates(lat, alt, v_n, C_nb @ f_b, earth)
    v_mid = v_n + 0.5 * dt * start.v_n
    lat_mid, alt_mid = lat + 0.5 * dt * start.lat, alt + 0.5 * dt * start.alt
    unforced = navigation_rates(lat_mid, alt_mid, v_mid, _ZERO, earth)
    turn = unforced.w_in_n * dt
    f_b_mean = _mean_rotation(w_b * dt) @ f_b  # mean of f_b in b at the start of the step
    f_n = rotation_matrix(-0.5 * turn) @ (C_nb @ f_b_mean)
    v_new = v_n + dt * (f_n + unforced.v_n)
    mean = navigation_rates(lat_mid, alt_mid, 0.5 * (v_n + v_new), f_n, earth)
    C_new = rotation_matrix(-turn) @ C_nb @ rotation_matrix(w_b * dt)
    return InertialState(
        lat + dt * mean.lat, wrap_angle(lon + dt * mean.lon), alt + dt * mean.alt, v_new, C_new
    )


def synthesise(state: InertialState, after: InertialState, dt: float, earth: Earth = wgs84) -> StepMeans:
    """Compute the mean f_b and w_b that lead from one state to another: the inverse of `mechanise`.

    The positions are taken as given at the two ends; the trajectory must make them consistent with the
    velocity.

    Parameters
    ----------
    state, after : InertialState
        States at the two ends of the step.
    dt : float
        Step, s.
    earth : Earth
        Model of the earth.

    Returns
    -------
    StepMeans
        Mean specific force and angular rate.
    """
    lat_mid, alt_mid = 0.5 * (state.lat + after.lat), 0.5 * (state.alt + after.alt)
    unforced = navigation_rates(lat_mid, alt_mid, 0.5 * (state.v_n + after.v_n), _ZERO, earth)
    turn = unforced.w_in_n * dt
    w_b_dt = rotation_vector(state.C_nb.T @ rotation_matrix(turn) @ after.C_nb)
    f_n = (after.v_n - state.v_n) / dt - unforced.v_n
    f_b_mean = state.C_nb.T @ (rotation_matrix(0.5 * turn) @ f_n)
    f_b = np.asarray(np.linalg.solve(_mean_rotation(w_b_dt), f_b_mean), dtype=np.float64)
    return StepMeans(f_b, w_b_dt / dt)


def combine_two_samples(f_1: Floats, w_1: Floats, f_2: Floats, w_2: Floats, dt: float) -> StepMeans:
    """Combine two samples of dt into one of 2 dt for `mechanise`, with coning and sculling compensation.

    2/3 a_1 x a_2 for the rotation, and for the velocity 2/3 (a_1 x u_2 + u_1 x a_2); the rotation term
    1/2 a x u is `mechanise`'s own.

    Parameters
    ----------
    f_1, w_1, f_2, w_2 : (3,)
        Mean specific forces, m/s^2, and angular rates, rad/s, of the two samples.
    dt : float
        Duration of each, s.

    Returns
    -------
    StepMeans
        Means over 2 dt.

    References
    ----------
    Savage's two-sample algorithms.
    """
    a_1, a_2, u_1, u_2 = w_1 * dt, w_2 * dt, f_1 * dt, f_2 * dt
    angle = a_1 + a_2 + 2.0 / 3.0 * np.cross(a_1, a_2)
    velocity = u_1 + u_2 + 2.0 / 3.0 * (np.cross(a_1, u_2) + np.cross(u_1, a_2))
    return StepMeans(velocity / (2.0 * dt), angle / (2.0 * dt))


def rotation_matrix(vector: Floats) -> Floats:
    """Compute exp([vector x]): the rotation by |vector| rad about it (Rodrigues).

    Parameters
    ----------
    vector : (3,)
        Rotation vector, rad.

    Returns
    -------
    (3, 3)
        Rotation matrix.
    """
    x, y, z = vector.tolist()
    angle2 = x * x + y * y + z * z
    return _polynomial(x, y, z, *_rodrigues(angle2)[:2])


def rotation_vector(C: Floats) -> Floats:
    """Compute the rotation vector of a matrix: the inverse of `rotation_matrix`, for rotations below pi.

    Parameters
    ----------
    C : (3, 3)
        Rotation matrix.

    Returns
    -------
    (3,)
        Rotation vector, rad.

    Raises
    ------
    ValueError
        Near pi, where the axis is not defined.
    """
    axis = 0.5 * np.array([C[2, 1] - C[1, 2], C[0, 2] - C[2, 0], C[1, 0] - C[0, 1]])
    s = math.sqrt(axis @ axis)
    angle = math.atan2(s, 0.5 * (float(C[0, 0] + C[1, 1] + C[2, 2]) - 1.0))
    if angle > 3.1:
        raise ValueError(
            f"a step rotates by {angle:.3f} rad (limit 3.1): sample faster, near pi the axis is not defined"
        )
    return np.asarray(axis * (angle / s) if s > 1e-12 else axis)


def _mean_rotation(vector: Floats) -> Floats:
    """Average exp([s vector x]) over s in (0, 1): exact for a constant rate."""
    x, y, z = vector.tolist()
    angle2 = x * x + y * y + z * z
    return _polynomial(x, y, z, *_rodrigues(angle2)[1:])


def _rodrigues(angle2: float) -> tuple[float, float, float]:
    """Compute sin(a)/a, (1 - cos(a))/a^2 and (a - sin(a))/a^3."""
    if angle2 < 1e-4:  # the series are exact to rounding here, the closed forms are not
        return (
            1.0 - angle2 / 6.0 * (1.0 - angle2 / 20.0 * (1.0 - angle2 / 42.0)),
            0.5 - angle2 / 24.0 * (1.0 - angle2 / 30.0 * (1.0 - angle2 / 56.0)),
            1.0 / 6.0 - angle2 / 120.0 * (1.0 - angle2 / 42.0 * (1.0 - angle2 / 72.0)),
        )
    a = math.sqrt(angle2)
    return math.sin(a) / a, (1.0 - math.cos(a)) / angle2, (a - math.sin(a)) / (a * angle2)


def _polynomial(x: float, y: float, z: float, p: float, q: float) -> Floats:
    """Compute I + p [v x] + q [v x]^2 of v = (x, y, z)."""
    return np.array(
        [
            [1.0 - q * (y * y + z * z), q * x * y - p * z, q * x * z + p * y],
            [q * x * y + p * z, 1.0 - q * (x * x + z * z), q * y * z - p * x],
            [q * x * z - p * y, q * y * z + p * x, 1.0 - q * (x * x + y * y)],
        ]
    )
