"""Discretization of a continuous linear system: exact (Van Loan) and Euler.

X' = A X + B u + w, w white of spectral density Q, becomes X(t + dt) = A_d X(t) + B_d U + W. In both methods
U is the increment of the state by the bounded input in one step (u = U/dt, constant over the step), so that
the bounds are C dt, U keeps the unit of the state, and B_d tends to B as dt tends to 0.
It does not know what the states mean.
"""

from typing import NamedTuple

import numpy as np

from companion.units import Floats


class Discrete(NamedTuple):
    """One step of a linear system.

    Attributes
    ----------
    A : (n, n)
        Transition.
    Q : (n, n)
        Covariance of the white noise added in a step.
    B : (n, m)
        Influence of the increments U.
    """

    A: Floats
    Q: Floats
    B: Floats


def discretise(A: Floats, Q: Floats, B: Floats, dt: float) -> Discrete:
    """Discretise a system exactly.

    Digits are lost once a decay rate times dt exceeds about 10: take shorter steps there.

    Parameters
    ----------
    A : (n, n)
        Continuous dynamics.
    Q : (n, n)
        Spectral density of the white noise.
    B : (n, m)
        Influence of the bounded inputs.
    dt : float
        Step, in the time unit of A, positive.

    Returns
    -------
    Discrete
        Transition, noise covariance and influence of a step.

    Raises
    ------
    ValueError
        If the shapes do not fit or dt is not positive.

    References
    ----------
    Van Loan, IEEE Transactions on Automatic Control 23 (1978) 395-404.
    """
    from scipy.linalg import expm

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


def euler(A: Floats, Q: Floats, B: Floats, dt: float) -> Discrete:
    """Discretise a system to first order: for comparison only, it amplifies oscillations.

    DEPARTS FROM (1.43): there B is multiplied by dt and U is not; here U is the step's increment.

    Parameters
    ----------
    A, Q, B, dt
        As in `discretise`.

    Returns
    -------
    Discrete
        Transition, noise covariance and influence of a step.

    Raises
    ------
    ValueError
        If the shapes do not fit or dt is not positive.

    References
    ----------
    Poddubny (1.43), (1.44).
    """
    n, _ = _check(A, Q, B, dt)
    return Discrete(np.eye(n) + A * dt, Q * dt, B.copy())


def _check(A: Floats, Q: Floats, B: Floats, dt: float) -> tuple[int, int]:
    n = A.shape[0]
    if A.shape != (n, n) or Q.shape != (n, n) or B.ndim != 2 or B.shape[0] != n:
        raise ValueError(f"A {A.shape}, Q {Q.shape} and B {B.shape} do not fit: need (n, n), (n, n), (n, m)")
    if not dt > 0.0:
        raise ValueError(f"dt is {dt}: give a positive step")
    return n, B.shape[1]
