"""A linear Gaussian problem as a list of steps: what it takes, and what can be wrong with it.

    x_{i+1} = Phi_i x_i + Gamma_i theta_i,   z_{i+1} = H_{i+1} x_{i+1} + N(0, R_{i+1}),   theta_i ~ N(0, D_i)

It does not know how to solve it: see `smoother`.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from companion.estimate import kalman

Array = npt.NDArray[np.float64]
Lists = Sequence[npt.ArrayLike]
Gaps = Sequence[npt.ArrayLike | None]


class Stage(NamedTuple):
    """From x_i to x_{i+1}, and what is measured there; z (p,), H (p, n), R (p, p), p = 0 for nothing."""

    Phi: Array
    Gamma: Array
    D: Array
    H: Array
    R: Array
    z: Array

    @property
    def Q(self) -> Array:
        """Gamma D Gamma', what the disturbance adds to the covariance."""
        return self.Gamma @ self.D @ self.Gamma.T


def stages_of(
    Phi: Lists, Gamma: Lists, D: Lists, H: Gaps, R: Gaps, z: Gaps, m: npt.ArrayLike, B: npt.ArrayLike
) -> tuple[list[Stage], Array, Array]:
    """The lists as stages. ValueError names the entry that does not fit."""
    lengths = [len(each) for each in (Phi, Gamma, D, H, R, z)]
    if len(set(lengths)) > 1 or not lengths[0]:
        raise ValueError(f"Phi, Gamma, D, H, R, z have {lengths} entries: give one of each for every step")
    start = kalman.Start(0, np.atleast_1d(np.asarray(m, float)), np.atleast_2d(np.asarray(B, float)))
    n = len(start.x)
    stages = []
    for i, parts in enumerate(zip(Phi, Gamma, D, H, R, z, strict=True)):
        stage = _stage(n, *parts)
        flaw = _flaw(stage, n)
        if flaw:
            raise ValueError(f"entry {i}: {flaw}")
        stages.append(stage)
    return stages, start.x, start.P


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
    if z is None or H is None or R is None or np.size(H) == 0:
        return Stage(transition, influence, noise, np.zeros((0, n)), np.zeros((0, 0)), np.zeros(0))
    seen = np.atleast_2d(np.asarray(H, float))
    accuracy, value = np.atleast_2d(np.asarray(R, float)), np.atleast_1d(np.asarray(z, float))
    return Stage(transition, influence, noise, seen, accuracy, value)


def _flaw(stage: Stage, n: int) -> str | None:
    q, p = stage.Gamma.shape[-1], len(stage.z)
    if stage.Phi.shape != (n, n) or stage.Gamma.shape != (n, q):
        return f"Phi {stage.Phi.shape} and Gamma {stage.Gamma.shape} do not fit {n} states"
    if stage.H.shape != (p, n):
        return f"H {stage.H.shape} does not fit z of {p} numbers and {n} states"
    if not all(np.isfinite(each).all() for each in stage):
        return "a number is not finite: leave the measurement out (z None) or mend the model"
    noise = kalman.covariance_flaw("D", stage.D, q)
    return noise or (kalman.covariance_flaw("R", stage.R, p, definite=True) if p else None)
