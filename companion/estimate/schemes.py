"""Feedforward and feedback correction of an INS: one step, applied in two ways and in any mixture.

After Vavilova, Golovan, Parusnikov 2008. The INS computes X from readings u; its error x = computed - true
and the errors k of the readings are one state of a linear model, and a fix Z corrects them:

    x(t+1) = A x(t) + noise,   z = Z - G(X) = H x + noise,   H = -dG/dX                     (1.1)-(1.4)

Feedforward leaves the INS alone and corrects its output, X - x. Feedback corrects inside. What makes them one
is a rule of two sentences: whatever number is taken from the INS is taken from the estimate too, and a
correction beta of the readings enters the error model as a known input,

    X <- X - c,   x <- x - c;      u <- u - beta,   x <- A x - A_k beta

(A_k the columns of A that belong to the readings). P and K are untouched. In a linear problem every mixture
therefore gives the same X - x, to rounding. In a nonlinear one A and H are taken at the INS's own X, and the
schemes part as the square of the errors: with coarse sensors feedback keeps the problem linear. If they part
as the first power, A is not the Jacobian of `mechanise`.

DEPARTS FROM the paper: x* = X* - X (the sign as printed is the opposite), and its last system reads with
Gamma2 Delta k1 and K3.

It does not know what an INS is: the plant brings its mechanisation and its Jacobians.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from companion.estimate import kalman
from companion.estimate.kalman import Array


@dataclass(frozen=True, slots=True)
class Plant:
    """An INS and its error model; the state is [x (N,), k (of the readings, q), others], n in all.

    mechanise: (X (N,), u (q,)) -> X (N,), one step; transition: its Jacobian A (n, n) at the same (X, u)
    observe: X -> G(X) (p,); sight: X -> H (p, n) = [-dG/dX, 0, ...]; Q (n, n) of a step, R (p, p)
    """

    mechanise: Callable[[Array, Array], Array]
    transition: Callable[[Array, Array], Array]
    observe: Callable[[Array], Array]
    sight: Callable[[Array], Array]
    Q: Array
    R: Array


@dataclass(frozen=True, slots=True)
class Feed:
    """The fractions of the estimate that go back: of the INS's state, and of its readings' errors, 0 to 1."""

    state: float = 0.0
    readings: float = 0.0

    def __post_init__(self) -> None:
        for name in ("state", "readings"):
            if not 0.0 <= getattr(self, name) <= 1.0:
                raise ValueError(f"feed.{name} = {getattr(self, name)}: a fraction from 0 to 1 is fed back")


FEEDFORWARD = Feed()
FEEDBACK = Feed(1.0, 1.0)


class Carry(NamedTuple):
    """INS state X (N,), estimated errors x (n,) and their P (n, n), the correction beta (q,) of readings."""

    X: Array
    x: Array
    P: Array
    beta: Array

    @property
    def corrected(self) -> Array:
        """The navigation solution X - x (N,), whatever the scheme."""
        return self.X - self.x[: len(self.X)]


def step(carry: Carry, u: Array, Z: Array | None, plant: Plant, feed: Feed = FEEDFORWARD) -> Carry:
    """Mechanise readings u (q,), take in a fix Z (p,) if there is one, and feed back what the scheme says."""
    carry = propagate(carry, u, plant)
    if Z is None:
        return carry
    H = plant.sight(carry.X)
    found = kalman.correct(carry.x, carry.P, Z - plant.observe(carry.X), H, plant.R)
    return feed_back(carry._replace(x=found.x, P=found.P), feed)


def propagate(carry: Carry, u: Array, plant: Plant) -> Carry:
    """The INS on corrected readings, and its errors: x <- A x - A_k beta."""
    X, x, P, beta = carry
    N, q = len(X), len(beta)
    A = plant.transition(X, u - beta)
    x, P = kalman.predict(x, P, A, plant.Q)
    taken = A[:, N : N + q] @ beta
    taken[N:] = 0.0  # the readings' errors themselves live on
    return Carry(plant.mechanise(X, u - beta), x - taken, P, beta)


def feed_back(carry: Carry, feed: Feed) -> Carry:
    """Take the fraction from the INS and from the estimate alike; beta follows the estimate of k."""
    X, x, P, beta = carry
    N, q = len(X), len(beta)
    c = feed.state * x[:N]
    beta = feed.readings * x[N : N + q]
    return Carry(X - c, np.concatenate([x[:N] - c, x[N:]]), P, beta)
