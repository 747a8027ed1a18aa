"""Error equations of an inertial system to first order: Poddubny's for ships and the full ones for aircraft.

The seven states of the INS, in this order, x north, y east, z down:

    dx, dy      position error: R dphi, R cos(phi) dlam
    dVN, dVE    velocity error; in `paper_model` dVE is the rate of dy, in `aircraft_model` that of the
    velocity PX, PY, PZ  minus the rotation of the platform (the computed n): C~_nb = (I + [P x]) C_nb,
                so the error of a computed heading is +PZ; a gyro drift E is likewise minus the physical one

Mixing the two senses of rotation turns Schuler's oscillation into a growing exponent, +-4.47 1/h.
`disturbances` extend the state, `correctors` observe it, `discretization` makes a step of it.
The equations hold on a sphere and in any consistent units: a `Sphere` defines them.

Source: V. Poddubny, a stochastic-restrictive model of navigation systems, (1.18) and section 3.
"""

from collections.abc import Sequence
from math import cos, pi, sin, tan
from typing import Literal, NamedTuple

import numpy as np

from companion.nav import correctors, disturbances
from companion.nav.discretization import discretise, euler
from companion.nav.disturbances import Disturbance, Model, compose
from companion.nav.earth import SPHERE, SPHERE_KM_H, Sphere
from companion.units import Floats

INS_STATES = ("dx", "dy", "dVN", "dVE", "PX", "PY", "PZ")


def paper_model(
    lat: float, v_north: float, v_east: float, *, added: Sequence[Disturbance] = (), sphere: Sphere = SPHERE
) -> Model:
    """Build the paper's model at a latitude and a velocity: simple, for ships and slow aircraft.

    DEPARTS FROM (1.18): restores the lost equation PY' = dVN/R - wZ PX + wX PZ + EY.

    Parameters
    ----------
    lat : float
        Latitude, rad.
    v_north, v_east : float
        Ground velocity, in the unit of `sphere`.
    added : sequence of Disturbance
        Extensions of the state.
    sphere : Sphere
        Spherical earth; defines the units.

    Returns
    -------
    Model
        INS states and disturbances.

    References
    ----------
    Poddubny (1.18).
    """
    R, G, Om = sphere
    t = tan(lat)
    lon_rate = v_east / (R * cos(lat))
    wX, wY, wZ = (Om + lon_rate) * cos(lat), -v_north / R, -(Om + lon_rate) * sin(lat)
    A = np.array(
        [
            [0, 0, 1, 0, 0, 0, 0],
            [0, 0, 0, 1, 0, 0, 0],
            [0, 0, 0, 2 * wZ, 0, -G, 0],
            [0, 0, -2 * wZ, 0, G, 0, 0],
            [-wZ / R, wY * t / R, 0, -1 / R, 0, wZ, -wY],
            [0, 0, 1 / R, 0, -wZ, 0, wX],
            [wX / R, -wY * t * t / R, 0, t / R, wY, -wX, 0],
        ]
    )
    return compose(A, INS_STATES, added)


def aircraft_model(
    lat: float,
    v_north: float,
    v_east: float,
    acceleration_n: tuple[float, float, float] = (0.0, 0.0, 0.0),
    *,
    added: Sequence[Disturbance] = (),
    sphere: Sphere = SPHERE,
) -> Model:
    """Build the model complete to first order, for any speed: the one used in flight.

    Parameters
    ----------
    lat, v_north, v_east, acceleration_n
        As in `aircraft_matrix`.
    added : sequence of Disturbance
        Extensions of the state.
    sphere : Sphere
        Spherical earth; defines the units.

    Returns
    -------
    Model
        INS states and disturbances.
    """
    return compose(aircraft_matrix(lat, v_north, v_east, acceleration_n, sphere), INS_STATES, added)


def aircraft_matrix(
    lat: float,
    v_north: float,
    v_east: float,
    acceleration_n: tuple[float, float, float] = (0.0, 0.0, 0.0),
    sphere: Sphere = SPHERE,
) -> Floats:
    """Build the dynamics of `INS_STATES` alone, complete to first order.

    Vertical errors are not included: the height channel is aided by the barometer.

    Parameters
    ----------
    lat : float
        Latitude, rad.
    v_north, v_east : float
        Ground velocity, in the unit of `sphere`.
    acceleration_n : (3,)
        Rate of change of the velocity, NED; in a turn it couples PZ into the velocity.
    sphere : Sphere
        Spherical earth; defines the units.

    Returns
    -------
    (7, 7)
        A.
    """
    R, G, Om = sphere
    s, c, t = sin(lat), cos(lat), tan(lat)
    VN, VE = v_north, v_east
    coriolis = 2 * Om * s + VE * t / R
    fN = coriolis * VE + acceleration_n[0]
    fE = -coriolis * VN + acceleration_n[1]
    fD = -(G - 2 * Om * c * VE - (VN * VN + VE * VE) / R) + acceleration_n[2]
    wX, wY, wZ = Om * c + VE / R, -VN / R, -(Om * s + VE * t / R)
    d_coriolis = (2 * Om * c + VE / (R * c * c)) / R  # of the Coriolis factor, per metre north
    return np.array(
        [
            [0, 0, 1, 0, 0, 0, 0],
            [VE * t / R, -VN * t / R, 0, 1, 0, 0, 0],
            [-d_coriolis * VE, 0, 0, -2 * (Om * s + VE * t / R), 0, fD, -fE],
            [d_coriolis * VN, 0, coriolis, VN * t / R, -fD, 0, fN],
            [Om * s / R, 0, 0, -1 / R, 0, wZ, -wY],
            [0, 0, 1 / R, 0, -wZ, 0, wX],
            [(Om * c + VE / (R * c * c)) / R, 0, 0, t / R, wY, -wX, 0],
        ]
    )


class Example(NamedTuple):
    """One step of the paper's section 3, in the form the filters take.

    Attributes
    ----------
    states : tuple of str
        16 names.
    A : (16, 16)
        Transition.
    B : (16, 2)
        Influence of the current's increments in a step, 0 or 1.
    Q : (16, 16)
        Process noise where the current is driven by the bounded input alone.
    Q_markov : (16, 16)
        Process noise where the current is Markov's (1.30) and no input is bounded: for the plain Kalman
        filter.
    H : (2, 16)
        The log, along and across.
    R : (2, 2)
        Its noise covariance.
    C : (2,)
        Bounds of the increments of a step.
    x0 : (16,)
        Zero.
    P0 : (16, 16)
        Zero: exact alignment.
    dt : float
        Step.
    A_continuous : (16, 16)
        Continuous dynamics.
    units : (16,)
        One unit of km-h-rad in the units chosen, state by state.
    """

    states: tuple[str, ...]
    A: Floats
    B: Floats
    Q: Floats
    Q_markov: Floats
    H: Floats
    R: Floats
    C: Floats
    x0: Floats
    P0: Floats
    dt: float
    A_continuous: Floats
    units: Floats


def paper_example(
    units: Literal["km-h", "SI"] = "km-h", *, exact: bool = True, sigma_E: float = 1e-5, C: float = 0.3
) -> Example:
    """Build section 3: a ship at 60 degrees north, east at 30 km/h, a log in unknown currents, 0.01 h a step.

    Parameters
    ----------
    units : {"km-h", "SI"}
        Units of the result.
    exact : bool
        Van Loan's step, otherwise the paper's Euler.
    sigma_E : float
        Gyro drift, rad/h whatever the units (lost in the text; this value fits its figures).
    C : float
        Bound of the current, km/h a step whatever the units (lost in the text as well).

    Returns
    -------
    Example
        Matrices of a step.

    Raises
    ------
    ValueError
        For other units.

    References
    ----------
    Poddubny, section 3.
    """
    if units not in ("km-h", "SI"):
        raise ValueError(f"units {units!r}: choose km-h or SI")
    sphere = SPHERE_KM_H if units == "km-h" else SPHERE
    km, h = (1.0, 1.0) if units == "km-h" else (1e3, 3600.0)
    lat, K, V, dt = pi / 3, pi / 2, 30.0 * km / h, 0.01 * h
    R_G = R_c = 10.0 * km
    a_c, a_E, a_A = 1.0 / h, 0.2 / h, 20.0 / h
    drift = disturbances.gyro_drift(a_E, sigma_E / h)
    others = (
        disturbances.gravity(V, R_G, 1e-5 * sphere.G),
        disturbances.accelerometer(a_A, 1e-6 * sphere.G),
    )

    def at_sea(current: Disturbance) -> Model:
        return paper_model(lat, 0.0, V, added=(drift, current, *others), sphere=sphere)

    bounded = at_sea(disturbances.current(V, a_c, R_c, bound=C * km / h / dt))
    markov = at_sea(disturbances.current(V, a_c, R_c, sigma=0.3 * km / h))
    velocity = correctors.paper_velocity(lat, 0.0, V, sphere)
    step = (discretise if exact else euler)(bounded.A, bounded.Q, bounded.B, dt)
    step_markov = (discretise if exact else euler)(markov.A, markov.Q, markov.B, dt)
    n = len(bounded.states)
    return Example(
        states=bounded.states,
        A=step.A,
        B=bounded.B,  # as in the paper for either step: the increment acts at the end of the step
        Q=step.Q,
        Q_markov=step_markov.Q,
        H=correctors.observation_matrix(bounded.states, *correctors.relative_log(K, V, velocity)),
        R=np.eye(2) * (0.05 * km / h) ** 2,
        C=bounded.C * dt,
        x0=np.zeros(n),
        P0=np.zeros((n, n)),
        dt=dt,
        A_continuous=bounded.A,
        units=np.array([km] * 2 + [km / h] * 2 + [1.0] * 3 + [1 / h] * 3 + [km / h] * 2 + [km / h**2] * 4),
    )
