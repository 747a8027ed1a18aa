"""Disturbances of an inertial system and its log, one declaration per kind: Poddubny (1.24)-(1.33).

Every slow disturbance d obeys d' = -a d + w. Its driving noise is declared either

- stochastic: w white of spectral density 2 a sigma^2, so that sigma is the steady deviation (1.25)-(1.32);
- bounded ("restrictive"): w = u, unknown but |u| <= c (1.33), (1.36); it becomes a column of B.

The units are those of the INS equations it is combined with (`error_model`); the builders here only name
states and the states that they drive.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from math import inf, isfinite
from typing import NamedTuple

import numpy as np

from companion.units import Floats


@dataclass(frozen=True, slots=True)
class Disturbance:
    """Group of similar states: independent, of equal decay, of equal deviation or bound.

    Attributes
    ----------
    states : tuple of str
        Names.
    decay : float
        a, per unit of time.
    sigma : float
        Steady standard deviation, if stochastic.
    bound : float or None
        c of |u| <= c, unit of the state per unit of time, if bounded.
    drives : tuple of str
        The state whose rate each contains; none where a corrector contains it.
    """

    states: tuple[str, ...]
    decay: float
    sigma: float = 0.0
    bound: float | None = None
    drives: tuple[str, ...] = ()

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
    """

    A: Floats
    states: tuple[str, ...]
    Q: Floats
    B: Floats
    C: Floats


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
        For a name used twice, or an unknown state that is driven.

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
    A, Q = np.zeros((n, n)), np.zeros((n, n))
    A[:n_ins, :n_ins] = A_ins
    bounded: list[tuple[int, float]] = []
    for d in disturbances:
        for s in d.states:
            i = index[s]
            A[i, i] = -d.decay
            Q[i, i] = 2.0 * d.decay * d.sigma**2
            if d.bound is not None:
                bounded.append((i, d.bound))
        for driven, driving in zip(d.drives, d.states):
            if driven not in index:
                raise ValueError(f"{driving} cannot drive {driven}: the model has only {', '.join(states)}")
            A[index[driven], index[driving]] = 1.0
    B = np.zeros((n, len(bounded)))
    for j, (i, _) in enumerate(bounded):
        B[i, j] = 1.0
    return Model(A, states, Q, B, np.array([c for _, c in bounded]))


def gyro_drift(decay: float, sigma: float) -> Disturbance:
    """Declare the slowly changing part of the gyro drift.

    Parameters
    ----------
    decay : float
        Decay rate, per unit of time.
    sigma : float
        Steady deviation.

    Returns
    -------
    Disturbance
        EX, EY, EZ.

    References
    ----------
    Poddubny (1.29).
    """
    return Disturbance(("EX", "EY", "EZ"), decay, sigma, drives=("PX", "PY", "PZ"))


def accelerometer(decay: float, sigma: float) -> Disturbance:
    """Declare the accelerometer errors: in section 3 their fast part, in flight the slow one.

    Parameters
    ----------
    decay, sigma : float
        As in `gyro_drift`.

    Returns
    -------
    Disturbance
        AX, AY.

    References
    ----------
    Poddubny (1.24), (1.25).
    """
    return Disturbance(("AX", "AY"), decay, sigma, drives=("dVN", "dVE"))


def gravity(speed: float, R_G: float, sigma: float) -> Disturbance:
    """Declare gravity anomalies, stationary in space: decay V/R_G.

    Parameters
    ----------
    speed : float
        Speed of the vehicle.
    R_G : float
        Correlation radius.
    sigma : float
        Steady deviation.

    Returns
    -------
    Disturbance
        GX, GY.

    References
    ----------
    Poddubny (1.26).
    """
    return Disturbance(("GX", "GY"), speed / R_G, sigma, drives=("dVN", "dVE"))


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
    sigma : float
        Steady deviation, if stochastic.
    bound : float, optional
        Bound of its rate of change, if bounded.

    Returns
    -------
    Disturbance
        VcX, VcY.

    References
    ----------
    Poddubny (1.30).
    """
    return Disturbance(("VcX", "VcY"), decay + speed / R_c, sigma, bound)
