"""Feedforward and feedback correction of an INS, and any mixture of the two, by one step.

After Vavilova, Golovan, Parusnikov 2008. The INS computes X from readings u. Its error x = computed - true
and the errors k of the readings form one state of a linear model, and a fix Z corrects them:

    x(t+1) = A x(t) + noise,   z = Z - G(X) = H x + noise,   H = -dG/dX                     (1.1)-(1.4)

Feedforward leaves the INS alone and corrects its output, X - x. Feedback corrects inside. Two rules make them
one: whatever is subtracted from the INS is subtracted from the estimate too, and a correction beta of the
readings enters the error model as a known input,

    X <- X - c,   x <- x - c;      u <- u - beta,   x <- A x - A_k beta

(A_k the columns of A that belong to the readings). P and K are unchanged. In a linear problem every mixture
therefore gives the same X - x, to rounding. In a nonlinear one A and H are taken at the INS's own X, and the
schemes differ by the square of the errors: with coarse sensors feedback keeps the problem linear. If they
differ by the first power, A is not the Jacobian of `mechanise`.

DEPARTS FROM the paper: x* = X* - X (the sign as printed is the opposite), and its last system reads with
Gamma2 Delta k1 and K3.

It does not know what an INS is: the plant supplies mechanisation and Jacobians.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from companion.estimate import kalman
from companion.units import Floats


@dataclass(frozen=True, slots=True)
class Plant:
    """INS and its error model; the state is [x (N,), k (of the readings, q), others], n in all.

    Attributes
    ----------
    mechanise : callable
        (X (N,), u (q,)) -> X (N,), one step.
    transition : callable
        (X, u) -> A (n, n), the Jacobian of the error state there.
    observe : callable
        X -> G(X) (p,), the computed measurement.
    observation_matrix : callable
        X -> H (p, n) = [-dG/dX, 0, ...].
    Q : (n, n)
        Process noise covariance of a step.
    R : (p, p)
        Fix covariance.
    """

    mechanise: Callable[[Floats, Floats], Floats]
    transition: Callable[[Floats, Floats], Floats]
    observe: Callable[[Floats], Floats]
    observation_matrix: Callable[[Floats], Floats]
    Q: Floats
    R: Floats


@dataclass(frozen=True, slots=True)
class FeedbackFractions:
    """Fractions of the estimate that are fed back, 0 to 1; ValueError outside.

    Attributes
    ----------
    state : float
        Fraction of the estimated error of the INS's state.
    readings : float
        Fraction of the estimated errors of its readings.
    """

    state: float = 0.0
    readings: float = 0.0

    def __post_init__(self) -> None:
        for name in ("state", "readings"):
            if not 0.0 <= getattr(self, name) <= 1.0:
                raise ValueError(f"{name} = {getattr(self, name)}: a fraction from 0 to 1 is fed back")


FEEDFORWARD = FeedbackFractions()


class SchemeState(NamedTuple):
    """State of a correction scheme.

    Attributes
    ----------
    X : (N,)
        State of the INS.
    x : (n,)
        Estimated errors.
    P : (n, n)
        Their covariance.
    beta : (q,)
        Correction subtracted from the readings.
    """

    X: Floats
    x: Floats
    P: Floats
    beta: Floats

    @property
    def corrected(self) -> Floats:
        """Return the navigation solution X - x (N,), the same in every scheme."""
        return self.X - self.x[: len(self.X)]


def step(
    state: SchemeState, u: Floats, Z: Floats | None, plant: Plant, fractions: FeedbackFractions = FEEDFORWARD
) -> SchemeState:
    """Mechanise one step, update by a fix, and feed fractions of the estimate back.

    Parameters
    ----------
    state : SchemeState
        State before the step.
    u : (q,)
        Readings.
    Z : (p,) or None
        Fix, None if there is none.
    plant : Plant
        INS and its error model.
    fractions : FeedbackFractions
        What is fed back after a fix: nothing (`FEEDFORWARD`), all or any share.

    Returns
    -------
    SchemeState
        State after the step.

    References
    ----------
    Vavilova, Golovan, Parusnikov (1.1)-(1.4).
    """
    state = propagate(state, u, plant)
    if Z is None:
        return state
    H = plant.observation_matrix(state.X)
    found = kalman.update(state.x, state.P, Z - plant.observe(state.X), H, plant.R)
    return feed_back(state._replace(x=found.x, P=found.P), fractions)


def propagate(state: SchemeState, u: Floats, plant: Plant) -> SchemeState:
    """Mechanise the INS on corrected readings and predict its errors: x <- A x - A_k beta.

    Parameters
    ----------
    state : SchemeState
        State before the step.
    u : (q,)
        Readings.
    plant : Plant
        INS and its error model.

    Returns
    -------
    SchemeState
        State before the fix.
    """
    X, x, P, beta = state
    N, q = len(X), len(beta)
    A = plant.transition(X, u - beta)
    x, P = kalman.predict(x, P, A, plant.Q)
    taken = A[:, N : N + q] @ beta
    taken[N:] = 0.0  # the errors of the readings themselves are unchanged
    return SchemeState(plant.mechanise(X, u - beta), x - taken, P, beta)


def feed_back(state: SchemeState, fractions: FeedbackFractions) -> SchemeState:
    """Subtract a fraction of the estimate from the INS and from the estimate; beta follows the estimate of k.

    Parameters
    ----------
    state : SchemeState
        State after a fix.
    fractions : FeedbackFractions
        What is fed back.

    Returns
    -------
    SchemeState
        The same solution X - x, in the chosen scheme.
    """
    X, x, P, beta = state
    N, q = len(X), len(beta)
    c = fractions.state * x[:N]
    beta = fractions.readings * x[N : N + q]
    return SchemeState(X - c, np.concatenate([x[:N] - c, x[N:]]), P, beta)
