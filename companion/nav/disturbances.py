"""What disturbs an inertial system and its correctors, one declaration per kind: Poddubny (1.24)-(1.33).

Every slow disturbance d obeys d' = -a d + w. What drives it is declared either

- stochastic: w white of spectral density 2 a sigma^2, so that sigma is the steady deviation (1.25)-(1.32);
- bounded ("restrictive"): w = u, unknown but |u| <= c (1.33), (1.36); it becomes a column of B.

A constant has a = 0 and is unknown at the start only. The units are those of the INS equations it is put
together with (`error_model`); the builders here only name states and say what they feed.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from math import cos, inf, isfinite, sin
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

Matrix = npt.NDArray[np.float64]
Feed = tuple[str, str, float]
"""(the state fed, the state feeding it, gain): fed' = ... + gain * feeding."""


@dataclass(frozen=True, slots=True)
class Disturbance:
    """A group of states alike: independent, of equal decay, of equal deviation or bound."""

    states: tuple[str, ...]
    decay: float
    """a, per unit of time; 0 for a constant."""
    sigma: float = 0.0
    """Steady (for a constant: initial) standard deviation, if stochastic."""
    bound: float | None = None
    """c of |u| <= c, unit of the state per unit of time, if bounded."""
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
    """X' = A X + B u + w, |u| <= C, w of spectral density Q: the general model (1.35), (1.36)."""

    A: Matrix
    """(n, n)."""
    states: tuple[str, ...]
    """n names, in order."""
    Q: Matrix
    """(n, n) spectral densities."""
    B: Matrix
    """(n, m), boolean."""
    C: Matrix
    """(m,) bounds of u."""
    sigma: Matrix
    """(n,) steady deviations of the stochastic disturbances, 0 elsewhere: a prior for them."""


def compose(A_ins: Matrix, ins_states: Sequence[str], disturbances: Sequence[Disturbance] = ()) -> Model:
    """The general state (1.34): the INS block first, then the disturbances in the order given.

    ValueError for a name used twice, or a feed from or into a state that is not there.
    """
    states = (*ins_states, *(s for d in disturbances for s in d.states))
    if len(set(states)) != len(states):
        twice = sorted({s for s in states if states.count(s) > 1})
        raise ValueError(f"states named twice: {', '.join(twice)}; give each disturbance names of its own")
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
    """Constant part of the drift, E0 of (1.27), (1.28); minus the physical one, as P is."""
    states = ("E0X", "E0Y", "E0Z")
    return Disturbance(states, 0.0, sigma, feeds=_pairs(("PX", "PY", "PZ"), states))


def gyro_drift(decay: float, sigma: float = 0.0, bound: float | None = None) -> Disturbance:
    """Slowly changing part of the drift, (1.29)."""
    states = ("EX", "EY", "EZ")
    return Disturbance(states, decay, sigma, bound, _pairs(("PX", "PY", "PZ"), states))


def accelerometer_fast(decay: float, sigma: float = 0.0, bound: float | None = None) -> Disturbance:
    """Fast part of the accelerometer errors, (1.24), (1.25); the only one of section 3."""
    states = ("AX", "AY")
    return Disturbance(states, decay, sigma, bound, _pairs(("dVN", "dVE"), states))


def accelerometer_slow(decay: float, sigma: float = 0.0, bound: float | None = None) -> Disturbance:
    """Slow part of the accelerometer errors, (1.24), (1.25)."""
    states = ("AsX", "AsY")
    return Disturbance(states, decay, sigma, bound, _pairs(("dVN", "dVE"), states))


def gravity(speed: float, R_G: float, sigma: float = 0.0, bound: float | None = None) -> Disturbance:
    """Gravity anomalies, stationary in space with correlation radius R_G: decay V/R_G, (1.26)."""
    states = ("GX", "GY")
    return Disturbance(states, speed / R_G, sigma, bound, _pairs(("dVN", "dVE"), states))


def current(
    speed: float, decay: float, R_c: float, sigma: float = 0.0, bound: float | None = None
) -> Disturbance:
    """Current as the paper counts it, minus the physical one: decay a_c + V/R_c, (1.30)."""
    return Disturbance(("VcX", "VcY"), decay + speed / R_c, sigma, bound)


def wind(
    speed: float, decay: float, R_w: float, sigma: float = 0.0, bound: float | None = None
) -> Disturbance:
    """Wind from its physical side, north and east velocity of the air: in the role of (1.30)."""
    return Disturbance(("wN", "wE"), decay + speed / R_w, sigma, bound)


def radio_drift(
    names: Sequence[str], decay: float, sigma: float = 0.0, bound: float | None = None
) -> Disturbance:
    """Slow drift of radio lines of position, one state per line (1.32), named for the correctors."""
    return Disturbance(tuple(names), decay, sigma, bound)


def free_gyro(
    P: float, decay: float, sigma: float = 0.0, bound: float | None = None
) -> tuple[Disturbance, Disturbance]:
    """A free gyro ("artificial star") of parallactic angle P: axis (1.21) and drift b1, b2 (1.31)."""
    axis = Disturbance(("dg", "dd"), 0.0)
    feeds = (("dg", "b1", -cos(P)), ("dg", "b2", sin(P)), ("dd", "b1", sin(P)), ("dd", "b2", cos(P)))
    return axis, Disturbance(("b1", "b2"), decay, sigma, bound, feeds)


def _pairs(fed: Sequence[str], feeding: Sequence[str]) -> tuple[Feed, ...]:
    return tuple((a, b, 1.0) for a, b in zip(fed, feeding, strict=True))
