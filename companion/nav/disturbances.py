"""Disturbances of an inertial system and its correctors, one declaration per kind: Poddubny (1.24)-(1.33).

Every slow disturbance d obeys d' = -a d + w. Its driving noise is declared either

- stochastic: w white of spectral density 2 a sigma^2, so that sigma is the steady deviation (1.25)-(1.32);
- bounded ("restrictive"): w = u, unknown but |u| <= c (1.33), (1.36); it becomes a column of B.

A constant has a = 0 and is unknown at the start only. The units are those of the INS equations it is
combined with (`error_model`); the builders here only name states and the states that they drive.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from math import cos, inf, isfinite, sin
from typing import NamedTuple

import numpy as np

from companion.units import Floats

Feed = tuple[str, str, float]
"""(driven state, driving state, gain): driven' = ... + gain * driving."""


@dataclass(frozen=True, slots=True)
class Disturbance:
    """Group of similar states: independent, of equal decay, of equal deviation or bound.

    Attributes
    ----------
    states : tuple of str
        Names.
    decay : float
        a, per unit of time; 0 for a constant.
    sigma : float
        Steady (for a constant: initial) standard deviation, if stochastic.
    bound : float or None
        c of |u| <= c, unit of the state per unit of time, if bounded.
    feeds : tuple of Feed
        States driven by the disturbance.
    """

    states: tuple[str, ...]
    decay: float
    sigma: float = 0.0
    bound: float | None = None
    feeds: tuple[Feed, ...] = ()

    def __post_init__(self) -> None:
        name = "/".join(self.states)
        if not (0.0 <= self.decay < inf and 0.0 <= self.sigma < inf):
            raise ValueError(
                f"{name}: decay {self.decay} and sigma {self.sigma} must be finite, not negative"
            )
        if self.bound is not None and not (self.bound >= 0.0 and isfinite(self.bound) and self.sigma == 0.0):
            raise ValueError(f"{name}: a bounded disturbance needs a finite bound >= 0 and no sigma")


class Model(NamedTuple):
    """General model X' = A X + B u + w, |u| <= C, w of spectral density Q: (1.35), (1.36).

    Attributes
    ----------
    A : (n, n)
        Dynamics.
    states : tuple of str
        n names, in order.
    Q : (n, n)
        Spectral densities.
    B : (n, m)
        Influence of the bounded inputs, 0 or 1.
    C : (m,)
        Bounds of u.
    sigma : (n,)
        Steady deviations of the stochastic disturbances, 0 elsewhere: a prior for them.
    """

    A: Floats
    states: tuple[str, ...]
    Q: Floats
    B: Floats
    C: Floats
    sigma: Floats


def compose(A_ins: Floats, ins_states: Sequence[str], disturbances: Sequence[Disturbance] = ()) -> Model:
    """Combine an INS block and disturbances to one model: the INS first, then the disturbances in order.

    Parameters
    ----------
    A_ins : (k, k)
        Dynamics of the INS errors.
    ins_states : sequence of str
        Their names.
    disturbances : sequence of Disturbance
        Extensions of the state.

    Returns
    -------
    Model
        The general model.

    Raises
    ------
    ValueError
        For a name used twice, or a feed from or into an unknown state.

    References
    ----------
    Poddubny (1.34)-(1.36).
    """
    states = (*ins_states, *(s for d in disturbances for s in d.states))
    if len(set(states)) != len(states):
        repeated = sorted({s for s in states if states.count(s) > 1})
        raise ValueError(f"states named twice: {', '.join(repeated)}; give each disturbance unique names")
    index = {s: i for i, s in enumerate(states)}
    n, n_ins = len(states), len(ins_states)
    A, Q, sigma = np.zeros((n, n)), np.zeros((n, n)), np.zeros(n)
    A[:n_ins, :n_ins] = A_ins
    bounded: list[tuple[int, float]] = []
    for d in disturbances:
        for s in d.states:
            i = index[s]
            A[i, i] = -d.decay
            Q[i, i] = 2.0 * d.decay * d.sigma**2
            sigma[i] = d.sigma
            if d.bound is not None:
                bounded.append((i, d.bound))
        for fed, feeding, gain in d.feeds:
            if fed not in index or feeding not in index:
                raise ValueError(f"{feeding} cannot feed {fed}: the model has only {', '.join(states)}")
            A[index[fed], index[feeding]] += gain
    B = np.zeros((n, len(bounded)))
    for j, (i, _) in enumerate(bounded):
        B[i, j] = 1.0
    return Model(A, states, Q, B, np.array([c for _, c in bounded]), sigma)


def gyro_constant(sigma: float) -> Disturbance:
    """Declare the constant part of the gyro drift, minus the physical one, as P is.

    Parameters
    ----------
    sigma : float
        Initial standard deviation, rad per unit of time.

    Returns
    -------
    Disturbance
        E0X, E0Y, E0Z.

    References
    ----------
    Poddubny (1.27), (1.28).
    """
    states = ("E0X", "E0Y", "E0Z")
    return Disturbance(states, 0.0, sigma, feeds=_pairs(("PX", "PY", "PZ"), states))


def gyro_drift(decay: float, sigma: float = 0.0, bound: float | None = None) -> Disturbance:
    """Declare the slowly changing part of the gyro drift.

    Parameters
    ----------
    decay : float
        Decay rate, per unit of time.
    sigma : float
        Steady deviation, if stochastic.
    bound : float, optional
        Bound of its rate of change, if bounded.

    Returns
    -------
    Disturbance
        EX, EY, EZ.

    References
    ----------
    Poddubny (1.29).
    """
    states = ("EX", "EY", "EZ")
    return Disturbance(states, decay, sigma, bound, _pairs(("PX", "PY", "PZ"), states))


def accelerometer_fast(decay: float, sigma: float = 0.0, bound: float | None = None) -> Disturbance:
    """Declare the fast part of the accelerometer errors; the only one of section 3.

    Parameters
    ----------
    decay, sigma, bound
        As in `gyro_drift`.

    Returns
    -------
    Disturbance
        AX, AY.

    References
    ----------
    Poddubny (1.24), (1.25).
    """
    states = ("AX", "AY")
    return Disturbance(states, decay, sigma, bound, _pairs(("dVN", "dVE"), states))


def accelerometer_slow(decay: float, sigma: float = 0.0, bound: float | None = None) -> Disturbance:
    """Declare the slow part of the accelerometer errors.

    Parameters
    ----------
    decay, sigma, bound
        As in `gyro_drift`.

    Returns
    -------
    Disturbance
        AsX, AsY.

    References
    ----------
    Poddubny (1.24), (1.25).
    """
    states = ("AsX", "AsY")
    return Disturbance(states, decay, sigma, bound, _pairs(("dVN", "dVE"), states))


def gravity(speed: float, R_G: float, sigma: float = 0.0, bound: float | None = None) -> Disturbance:
    """Declare gravity anomalies, stationary in space: decay V/R_G.

    Parameters
    ----------
    speed : float
        Speed of the vehicle.
    R_G : float
        Correlation radius.
    sigma, bound
        As in `gyro_drift`.

    Returns
    -------
    Disturbance
        GX, GY.

    References
    ----------
    Poddubny (1.26).
    """
    states = ("GX", "GY")
    return Disturbance(states, speed / R_G, sigma, bound, _pairs(("dVN", "dVE"), states))


def current(
    speed: float, decay: float, R_c: float, sigma: float = 0.0, bound: float | None = None
) -> Disturbance:
    """Declare the current with the paper's sign, minus the physical one: decay a_c + V/R_c.

    Parameters
    ----------
    speed : float
        Speed of the vehicle.
    decay : float
        Decay rate in time, per unit of time.
    R_c : float
        Correlation radius.
    sigma, bound
        As in `gyro_drift`.

    Returns
    -------
    Disturbance
        VcX, VcY.

    References
    ----------
    Poddubny (1.30).
    """
    return Disturbance(("VcX", "VcY"), decay + speed / R_c, sigma, bound)


def wind(
    speed: float, decay: float, R_w: float, sigma: float = 0.0, bound: float | None = None
) -> Disturbance:
    """Declare the wind with its physical sign, north and east velocity of the air.

    Parameters
    ----------
    speed : float
        Speed of the vehicle.
    decay : float
        Decay rate in time, per unit of time.
    R_w : float
        Correlation radius.
    sigma, bound
        As in `gyro_drift`.

    Returns
    -------
    Disturbance
        wN, wE.

    References
    ----------
    Poddubny (1.30), for the wind instead of the current.
    """
    return Disturbance(("wN", "wE"), decay + speed / R_w, sigma, bound)


def radio_drift(
    names: Sequence[str], decay: float, sigma: float = 0.0, bound: float | None = None
) -> Disturbance:
    """Declare the slow drift of radio lines of position, one state per line.

    Parameters
    ----------
    names : sequence of str
        Names of the states, as given to the correctors.
    decay, sigma, bound
        As in `gyro_drift`.

    Returns
    -------
    Disturbance
        One state for each name.

    References
    ----------
    Poddubny (1.32).
    """
    return Disturbance(tuple(names), decay, sigma, bound)


def free_gyro(
    P: float, decay: float, sigma: float = 0.0, bound: float | None = None
) -> tuple[Disturbance, Disturbance]:
    """Declare a free gyro ("artificial star"): axis errors dg, dd and drift b1, b2.

    Parameters
    ----------
    P : float
        Parallactic angle, rad.
    decay, sigma, bound
        Of the drift, as in `gyro_drift`.

    Returns
    -------
    tuple of Disturbance
        Axis and drift.

    References
    ----------
    Poddubny (1.21), (1.31).
    """
    axis = Disturbance(("dg", "dd"), 0.0)
    feeds = (("dg", "b1", -cos(P)), ("dg", "b2", sin(P)), ("dd", "b1", sin(P)), ("dd", "b2", cos(P)))
    return axis, Disturbance(("b1", "b2"), decay, sigma, bound, feeds)


def _pairs(fed: Sequence[str], feeding: Sequence[str]) -> tuple[Feed, ...]:
    return tuple((a, b, 1.0) for a, b in zip(fed, feeding, strict=True))
