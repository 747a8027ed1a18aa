"""Linear Gaussian system as a list of stages, with validation.

    x_{i+1} = Phi_i x_i + Gamma_i theta_i,   z_{i+1} = H_{i+1} x_{i+1} + N(0, R_{i+1}),   theta_i ~ N(0, D_i)

It does not solve anything: see `smoother`.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple, Self

import numpy as np
import numpy.typing as npt

from companion.units import Floats

Arrays = Sequence[npt.ArrayLike]
OptionalArrays = Sequence[npt.ArrayLike | None]


class Stage(NamedTuple):
    """One stage: the transition from x_i to x_{i+1} and the measurement of x_{i+1}.

    Attributes
    ----------
    Phi : (n, n)
        Transition.
    Gamma : (n, q)
        Influence of the disturbance.
    D : (q, q)
        Covariance of the disturbance.
    H : (p, n)
        Measurement matrix; p = 0 for no measurement.
    R : (p, p)
        Measurement noise covariance.
    z : (p,)
        Measurement.
    """

    Phi: Floats
    Gamma: Floats
    D: Floats
    H: Floats
    R: Floats
    z: Floats

    @property
    def Q(self) -> Floats:
        """Return Gamma D Gamma' (n, n), the covariance added by the disturbance."""
        return self.Gamma @ self.D @ self.Gamma.T


class LinearSystem(NamedTuple):
    """A system that was checked.

    Attributes
    ----------
    stages : list of Stage
        Its N stages.
    m, B : (n,), (n, n)
        Mean and covariance of x_0.
    """

    stages: list[Stage]
    m: Floats
    B: Floats

    @classmethod
    def of(
        cls,
        Phi: Arrays,
        Gamma: Arrays,
        D: Arrays,
        H: OptionalArrays,
        R: OptionalArrays,
        z: OptionalArrays,
        m: npt.ArrayLike,
        B: npt.ArrayLike,
    ) -> Self:
        """Make a system of lists of matrices.

        Dimensions may differ from stage to stage; D and B may be singular, R not.

        Parameters
        ----------
        Phi, Gamma, D : sequences of N arrays
            Transition (n, n), influence (n, q_i) and covariance (q_i, q_i) of the disturbance of each stage.
        H, R, z : sequences of N arrays or None
            Measurement of x_{i+1}: (p_i, n), (p_i, p_i), (p_i,); None or no rows for no measurement.
        m, B : (n,), (n, n)
            Mean and covariance of x_0.

        Returns
        -------
        LinearSystem
            Stages, m and B as float arrays.

        Raises
        ------
        ValueError
            Names the entry that does not fit.
        """
        lengths = [len(each) for each in (Phi, Gamma, D, H, R, z)]
        if len(set(lengths)) > 1 or not lengths[0]:
            raise ValueError(
                f"Phi, Gamma, D, H, R, z have {lengths} entries: give one of each for every step"
            )
        mean, covariance = np.atleast_1d(np.asarray(m, float)), np.atleast_2d(np.asarray(B, float))
        n = len(mean)
        if not np.isfinite(mean).all():
            raise ValueError("the initial state x is not finite: give every state a finite starting value")
        if reason := find_covariance_flaw("P0", covariance, n):
            raise ValueError(reason)
        stages = []
        for i, parts in enumerate(zip(Phi, Gamma, D, H, R, z, strict=True)):
            stage = _stage(n, *parts)
            if flaw := _find_flaw(stage, n):
                raise ValueError(f"entry {i}: {flaw}")
            stages.append(stage)
        return cls(stages, mean, covariance)


def _stage(
    n: int,
    Phi: npt.ArrayLike,
    Gamma: npt.ArrayLike,
    D: npt.ArrayLike,
    H: npt.ArrayLike | None,
    R: npt.ArrayLike | None,
    z: npt.ArrayLike | None,
) -> Stage:
    transition, influence = np.asarray(Phi, float), np.asarray(Gamma, float)
    if influence.ndim < 2:
        influence = influence.reshape(-1, 1)  # one disturbance
    noise = np.atleast_2d(np.asarray(D, float))
    if z is None:
        H, R, z = None, None, ()
    matrix = np.zeros((0, n)) if H is None or np.size(H) == 0 else np.atleast_2d(np.asarray(H, float))
    covariance = np.zeros((0, 0)) if R is None else np.atleast_2d(np.asarray(R, float))
    value = np.atleast_1d(np.asarray(z, float))
    return Stage(transition, influence, noise, matrix, covariance, value)


def _find_flaw(stage: Stage, n: int) -> str | None:
    q, p = stage.Gamma.shape[-1], len(stage.z)
    if stage.Phi.shape != (n, n) or stage.Gamma.shape != (n, q):
        return f"Phi {stage.Phi.shape} and Gamma {stage.Gamma.shape} do not fit {n} states"
    if stage.H.shape != (p, n):
        return f"H {stage.H.shape} does not fit z of {p} numbers and {n} states"
    if not all(np.isfinite(each).all() for each in stage):
        return "a number is not finite: leave the measurement out (z None) or correct the model"
    noise = find_covariance_flaw("D", stage.D, q)
    return noise or (find_covariance_flaw("R", stage.R, p, definite=True) if p else None)


def find_covariance_flaw(name: str, P: Floats, n: int, *, definite: bool = False) -> str | None:
    """Describe why P cannot be a covariance.

    Parameters
    ----------
    name : str
        Name of the matrix in the text.
    P : array
        Candidate, should be (n, n).
    n : int
        Number of variables.
    definite : bool
        Also forbid a zero eigenvalue.

    Returns
    -------
    str or None
        The reason, None if P is a covariance.
    """
    if P.shape != (n, n):
        return f"covariance {name} has shape {P.shape}, it must be ({n}, {n})"
    if not np.isfinite(P).all():
        return f"covariance {name} is not finite: check the variances it is made of"
    variance = np.diag(P)
    if (variance < 0.0).any() or (definite and (variance == 0.0).any()):
        wanted = "positive" if definite else "not negative"
        return f"covariance {name} has variance {variance.min():.3g} on its diagonal, it must be {wanted}"
    scale = np.sqrt(np.where(variance > 0.0, variance, 1.0))
    rho = P / np.outer(scale, scale)
    if np.abs(rho - rho.T).max(initial=0.0) > 1e-9:
        return f"covariance {name} is not symmetric: build it as (P + P') / 2"
    least = np.linalg.eigvalsh(rho)[0] if n else 1.0
    if least < -1e-9 or (definite and least < 1e-14):
        kind = "definite" if definite else "semidefinite"
        return f"covariance {name} is not positive {kind} (least correlation eigenvalue {least:.3g})"
    return None
