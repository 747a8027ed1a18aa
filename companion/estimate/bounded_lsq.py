"""Least squares within a box, the inner problem of the restrictive filters: small by enumeration, large by
BVLS.

Inputs are counted in units of their bounds, v_i = u_i / C_i, so the box is always |v_i| <= 1 and C_i = 0
simply takes an input away. A box problem has a unique answer only where the data see every input;
`information` says what to assume elsewhere. Both solvers answer with the active set, because the filters'
covariance hangs on it.

It does not know what the inputs are.
"""

from functools import lru_cache
from itertools import product
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.optimize import lsq_linear

Array = npt.NDArray[np.float64]
Status = npt.NDArray[np.int8]

BLIND = 1e-10
"""Least eigenvalue of the inputs' correlation in the data below which they cannot be told apart."""


class Box(NamedTuple):
    """Minimum v in |v_i| <= 1, its status -1, 0 (free) or +1, M_ff^-1 of the free ones padded with zeros."""

    v: Array
    status: Status
    free_inverse: Array


def information(M: Array, kappa: float = np.inf) -> Array:
    """The weight (..., m, m) to add to M: I / kappa for a prior N(0, kappa C^2), nothing for kappa = inf.

    Even then an input that the data do not show at all takes the weight 1, kappa = 1, and all of them do
    where M is singular (fewer measurements than inputs): the step is then the minimax filter's.
    """
    identity = np.eye(M.shape[-1])
    if np.isfinite(kappa):
        return identity / kappa
    size = np.einsum("...ii->...i", M)
    unseen = (size <= 0.0)[..., None] * identity
    scale = np.sqrt(size + (size <= 0.0))
    rho = M / (scale[..., :, None] * scale[..., None, :]) + unseen
    if (np.abs(rho).sum(-1) < 2.0 - BLIND).all():  # Gershgorin: no eigenvalue can be small
        return np.asarray(unseen)
    blind = np.linalg.eigvalsh(rho)[..., :1, None] < BLIND
    weight: Array = np.where(blind, identity, unseen)
    return weight


class ActiveSets(NamedTuple):
    """All 3^m statuses, free ones first; their free components as 1; the row of `inverses` of each."""

    status: Status
    free: Status
    row: npt.NDArray[np.intp]


@lru_cache(maxsize=8)
def active_sets(m: int) -> ActiveSets:
    """The candidates of a box of m inputs; there are only 2^m different sets of free ones."""
    statuses = sorted(product((0, -1, 1), repeat=m), key=lambda s: sum(map(abs, s)))
    status = np.array(statuses, np.int8).reshape(-1, m)
    free = status == 0
    return ActiveSets(status, free.astype(np.int8), free @ (1 << np.arange(m)))


def inverses(M: Array) -> Array:
    """M_ff^-1 (2^m, m, m, ...) padded with zeros, of M (m, m, ...); bit k of the row says that k is free.

    By bordering, one component after another set free: w' M w is what is left of M_kk (Schur).
    """
    inverse = np.zeros((1 << len(M), *M.shape))
    for k in range(len(M)):
        without = inverse[: 1 << k]
        w = -np.add.reduce(without * M[k], 2)
        w[:, k] = 1.0
        left = np.add.reduce(w * M[k], 1)
        np.add(without, w[:, :, None] * (w / left[:, None])[:, None], out=inverse[1 << k : 2 << k])
    return inverse


def minimum(M: Array, g: Array) -> Box:
    """Minimise 1/2 v' M v - g' v over |v_i| <= 1 for M (..., m, m) positive definite, g (..., m), m up to 4.

    Every active set gives one candidate and the Kuhn-Tucker conditions accept one of them; the least
    violation is taken, so rounding cannot leave us without an answer.
    """
    m = g.shape[-1]
    sets = active_sets(m)
    g = g.T.copy()  # flights last: the loops over them are long, those over components short
    each = np.empty((m, *g.shape))
    each.T[...] = M
    inverse = inverses(each)
    shape = (-1, m) + (1,) * (g.ndim - 1)
    status, free = sets.status.reshape(shape), sets.free.reshape(shape)
    pushed = g - np.add.reduce(status[:, None] * each, 2)
    v = status + np.add.reduce(inverse[sets.row] * pushed[:, None], 2)
    slope = g - np.add.reduce(v[:, None] * each, 2)  # points out of the box where v is on its side
    best = np.maximum.reduce(free * (np.abs(v) - 1.0) - status * slope, 1).argmin(0).T
    flights, whole = tuple(np.indices(best.shape, sparse=True)), slice(None)
    return Box(
        v.T[(*flights, whole, best)], sets.status[best], inverse.T[(*flights, whole, whole, sets.row[best])]
    )


def least_squares(D: Array, r: Array) -> Box:
    """Minimise 1/2 |r - D v|^2 over |v_i| <= 1 for D (q, m) of any size, by bounded-variable least squares.

    scipy's BVLS (Stark and Parker) ends on an active set, so it is as exact as the linear algebra: on 600
    samples of two inputs it needs about two seconds where an interior-point solver needs 0.2 s and stops 1e-8
    short.
    """
    m = D.shape[1]
    M = D.T @ D
    weight = information(M)
    if weight.any():
        D, r, M = np.vstack([D, weight]), np.concatenate([r, np.zeros(m)]), M + weight
    found = lsq_linear(D, r, (-np.ones(m), np.ones(m)), method="bvls", tol=1e-15, max_iter=10 * m + 100)
    if found.status <= 0:
        raise ValueError(f"box problem of {m} inputs did not converge: {found.message}; shorten the horizon")
    status = found.active_mask.astype(np.int8)
    free = status == 0
    inverse = np.zeros((m, m))
    inverse[np.ix_(free, free)] = np.linalg.inv(M[np.ix_(free, free)])
    return Box(np.where(free, found.x, status), status, inverse)
