"""From continuous equations to one step: exactly (Van Loan), and as the papers do (Euler).

X' = A X + B u + w, w white of spectral density Q, becomes X(t + dt) = A_d X(t) + B_d U + W. On both ways
U is what the bounded input adds to its state in one step (u = U/dt, constant over the step), so that the
bounds are C dt, U keeps the unit of the state, and B_d tends to B as dt tends to 0.
Knows nothing of what the states mean.
"""

from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.linalg import expm

Matrix = npt.NDArray[np.float64]


class Discrete(NamedTuple):
    """One step of a linear system."""

    A: Matrix
    """(n, n) transition."""
    Q: Matrix
    """(n, n) covariance of what the white noise adds in a step."""
    B: Matrix
    """(n, m) influence of the increments U."""


def discretise(A: Matrix, Q: Matrix, B: Matrix, dt: float) -> Discrete:
    """The exact step: Van Loan, IEEE Transactions on Automatic Control 23 (1978) 395-404.

    A (n, n), spectral densities Q (n, n), B (n, m), dt > 0. Digits are lost once a decay rate times dt
    passes about 10: take shorter steps there.
    """
    n, m = _check(A, Q, B, dt)
    M = np.zeros((2 * n, 2 * n))
    M[:n, :n], M[:n, n:], M[n:, n:] = -A, Q, A.T
    E = expm(M * dt)
    A_d = E[n:, n:].T
    Q_d = A_d @ E[:n, n:]
    if m == 0:
        return Discrete(A_d, 0.5 * (Q_d + Q_d.T), B.copy())
    M = np.zeros((n + m, n + m))
    M[:n, :n], M[:n, n:] = A * dt, B
    return Discrete(A_d, 0.5 * (Q_d + Q_d.T), expm(M)[:n, n:])


def euler(A: Matrix, Q: Matrix, B: Matrix, dt: float) -> Discrete:
    """The first-order step of Poddubny (1.43), (1.44): for comparison only, it amplifies oscillations.

    DEPARTS FROM (1.43): there B is multiplied by dt and U is not; here U is the step's increment.
    """
    n, _ = _check(A, Q, B, dt)
    return Discrete(np.eye(n) + A * dt, Q * dt, B.copy())


def _check(A: Matrix, Q: Matrix, B: Matrix, dt: float) -> tuple[int, int]:
    n = A.shape[0]
    if A.shape != (n, n) or Q.shape != (n, n) or B.ndim != 2 or B.shape[0] != n:
        raise ValueError(f"A {A.shape}, Q {Q.shape} and B {B.shape} do not fit: need (n, n), (n, n), (n, m)")
    if not dt > 0.0:
        raise ValueError(f"dt is {dt}: a step of time must be positive")
    return n, B.shape[1]
