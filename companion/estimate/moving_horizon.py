"""MHE(L, kappa): the restrictive filter that keeps the last L samples open.

Older data live in an arrival pair, the mean and covariance of X(t-L). The inputs of the window are found
together by the condensed box problem of `full_horizon`; then the window moves by one sample, and the input
that leaves it is treated by the status the window gave it: on a bound it becomes a known number, inside the
bounds it is marginalised with the prior N(U*, kappa C^2). kappa = inf forgets U* and keeps only that it is
free, kappa = 1/3 is the variance of a uniform law, kappa = 0 takes U* for the truth (overconfident). With the
free part of the window's first step, M = D_f' S^-1 D_f + I / (kappa C^2):

    U_f = U*_f + M^-1 D_f' S^-1 (nu - D U*),   Xa+ = A Xa + B_a U_a + B_f U_f + K (nu - D_a U_a - D_f U_f)
    Pa+ = P1 + (B_f - K D_f) M^-1 (B_f - K D_f)'

MHE(1, inf) is R1; MHE(L >= T) is the exact filter. It is not monotone in L.

It does not know about time or late data: a carry is a value, keep an old one to go back.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from companion.estimate import bounded_lsq, kalman
from companion.estimate.full_horizon import Sample, condense
from companion.estimate.kalman import Array
from companion.estimate.restrictive import Restricted


class Window(NamedTuple):
    """The carry: arrival pair x (n,), P (n, n), and the samples since."""

    x: Array
    P: Array
    samples: tuple[Sample, ...] = ()


@dataclass(frozen=True, slots=True)
class MHE:
    """Window of `length` samples; `kappa` >= 0 the prior of a free input that leaves it, in units of C^2."""

    length: int
    kappa: float = np.inf

    def __post_init__(self) -> None:
        if self.length < 1:
            raise ValueError(f"moving horizon of {self.length} samples: give it at least one")
        if not self.kappa >= 0.0:
            raise ValueError(f"kappa = {self.kappa} is a variance ratio: give 0 or more, or inf")

    def step(self, carry: Window, sample: Sample) -> tuple[Window, Restricted]:
        """Take in one sample; from Window(x0, P0) on. The result is that of t given the data up to t."""
        samples = (*carry.samples, sample)
        record = condense(carry.x, carry.P, samples)
        best = bounded_lsq.least_squares(record.D, record.r)
        m, p = len(sample.C), len(sample.z)
        left = np.linalg.cholesky(record.S) @ (record.r[-p:] - record.D[-p:] @ best.v)
        now = Restricted(
            x=record.x + record.G @ best.v,
            P=record.P + record.G @ best.free_inverse @ record.G.T,
            u=best.v[-m:] * sample.C,
            status=best.status[-m:],
            innovation=left,
            S=record.S,
            nis=left @ np.linalg.solve(record.S, left),
        )
        if len(samples) < self.length:
            return Window(carry.x, carry.P, samples), now
        x, P = arrive(carry.x, carry.P, samples[0], best.v[:m], best.status[:m], self.kappa)
        return Window(x, P, samples[1:]), now


def arrive(
    x: Array, P: Array, sample: Sample, v: Array, status: bounded_lsq.Status, kappa: float = np.inf
) -> tuple[Array, Array]:
    """Move the arrival pair over one sample whose input is v = U* / C with the given status."""
    z, A, B, Q, H, R, C = sample
    Ax, Pb = kalman.predict(x, P, A, Q)
    _, S_inverse, K = kalman.gain(Pb, H, R)
    BC = B * C
    DC = H @ BC
    SD = S_inverse @ DC
    free = np.flatnonzero(status == 0)
    nu = z - H @ Ax
    spread = np.zeros((len(C), len(C)))
    if kappa > 0.0 and len(free):
        M = DC.T @ SD
        weight = bounded_lsq.information(M, kappa)[np.ix_(free, free)]
        spread[np.ix_(free, free)] = np.linalg.inv(M[np.ix_(free, free)] + weight)
        if not np.isfinite(kappa):  # flat: U* is forgotten
            v = np.where(status == 0, 0.0, v)
    v = v + spread @ (SD.T @ (nu - DC @ v))
    W = BC - K @ DC
    return Ax + BC @ v + K @ (nu - DC @ v), kalman.joseph(Pb, K, H, R) + W @ spread @ W.T
