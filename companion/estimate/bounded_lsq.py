"""Least squares with bounded unknowns: the inner problem of the restrictive filter.

Inputs are scaled by their bounds, v_i = u_i / C_i, so that the box is always |v_i| <= 1 and C_i = 0 removes
an input. It is solved by enumeration of active sets, and the active set is returned, because the filter's
covariance depends on it. The solution is unique only where the data determine every input;
`prior_information` gives the prior assumed elsewhere.

It does not know what the inputs are.
"""

from functools import lru_cache
from itertools import product
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from companion.units import Floats

Status = npt.NDArray[np.int8]

INDISTINGUISHABLE = 1e-10
"""Least eigenvalue of the inputs' correlation in the data; below it they cannot be distinguished."""


class BoxMinimum(NamedTuple):
    """Minimum of a quadratic function in the box |v_i| <= 1.

    Attributes
    ----------
    v : (..., m)
        Minimiser.
    status : (..., m)
        -1 or +1 on a bound, 0 inside (free).
    free_inverse : (..., m, m)
        Inverse of the free block of M, padded with zeros.
    """

    v: Floats
    status: Status
    free_inverse: Floats


def prior_information(M: Floats, kappa: float = np.inf) -> Floats:
    """Choose the prior information to add to M.

    An input that the data do not determine takes the weight 1 (kappa = 1) even for kappa = inf, and all
    inputs do where M is singular (fewer measurements than inputs): the step is then the minimax filter's.

    Parameters
    ----------
    M : (..., m, m)
        Information of the data on v.
    kappa : float
        Prior variance of each input over its squared bound; inf for no prior.

    Returns
    -------
    (..., m, m)
        I / kappa for finite kappa, otherwise zero except as above.
    """
    identity = np.eye(M.shape[-1])
    if np.isfinite(kappa):
        return identity / kappa
    size = np.einsum("...ii->...i", M)
    unseen = (size <= 0.0)[..., None] * identity
    scale = np.sqrt(size + (size <= 0.0))
    rho = M / (scale[..., :, None] * scale[..., None, :]) + unseen
    if (np.abs(rho).sum(-1) < 2.0 - INDISTINGUISHABLE).all():  # Gershgorin: no eigenvalue can be small
        return np.asarray(unseen)
    indistinct = np.linalg.eigvalsh(rho)[..., :1, None] < INDISTINGUISHABLE
    weight: Floats = np.where(indistinct, identity, unseen)
    return weight


class ActiveSets(NamedTuple):
    """All 3^m active sets of m inputs.

    Attributes
    ----------
    status : (3^m, m)
        -1, 0 or +1 for each input; sets with more free inputs first.
    free : (3^m, m)
        1 where the input is free, otherwise 0.
    row : (3^m,)
        Index of the set of free inputs in the result of `free_set_inverses`.
    """

    status: Status
    free: Status
    row: npt.NDArray[np.intp]


@lru_cache(maxsize=8)
def active_sets(m: int) -> ActiveSets:
    """List the active sets of a box.

    Parameters
    ----------
    m : int
        Number of inputs.

    Returns
    -------
    ActiveSets
        All 3^m candidates; there are only 2^m different sets of free inputs.
    """
    statuses = sorted(product((0, -1, 1), repeat=m), key=lambda s: sum(map(abs, s)))
    status = np.array(statuses, np.int8).reshape(len(statuses), m)
    free = status == 0
    return ActiveSets(status, free.astype(np.int8), free @ (1 << np.arange(m)))


def free_set_inverses(M: Floats) -> Floats:
    """Invert M restricted to every set of free inputs.

    By bordering, one component after another is set free: w' M w is the Schur complement of M_kk.

    Parameters
    ----------
    M : (m, m, ...)
        Positive definite matrices.

    Returns
    -------
    (2^m, m, m, ...)
        Inverses padded with zeros; bit k of the row index means that input k is free.
    """
    inverse = np.zeros((1 << len(M), *M.shape))
    for k in range(len(M)):
        without = inverse[: 1 << k]
        w = -np.add.reduce(without * M[k], 2)
        w[:, k] = 1.0
        left = np.add.reduce(w * M[k], 1)
        np.add(without, w[:, :, None] * (w / left[:, None])[:, None], out=inverse[1 << k : 2 << k])
    return inverse


def minimize_quadratic(M: Floats, g: Floats) -> BoxMinimum:
    """Minimise 1/2 v' M v - g' v over |v_i| <= 1 by enumeration.

    Every active set gives one candidate, and the Kuhn-Tucker conditions accept one. The candidate with the
    least violation is taken, so that rounding cannot leave the problem without an answer.

    Parameters
    ----------
    M : (..., m, m)
        Positive definite, m up to 4.
    g : (..., m)
        Linear term.

    Returns
    -------
    BoxMinimum
        Minimiser, active set and inverse of the free block.
    """
    m = g.shape[-1]
    sets = active_sets(m)
    g = g.T.copy()  # flights last: numpy loops over the long axis
    each = np.empty((m, *g.shape))
    each.T[...] = M
    inverse = free_set_inverses(each)
    shape = (*sets.status.shape,) + (1,) * (g.ndim - 1)
    status, free = sets.status.reshape(shape), sets.free.reshape(shape)
    pull = g - np.add.reduce(status[:, None] * each, 2)
    v = status + np.add.reduce(inverse[sets.row] * pull[:, None], 2)
    slope = g - np.add.reduce(v[:, None] * each, 2)  # gradient: points out of the box at an active bound
    violation = free * (np.abs(v) - 1.0) - status * slope
    best = np.maximum.reduce(violation, 1, initial=-np.inf).argmin(0).T
    flights, whole = tuple(np.indices(best.shape, sparse=True)), slice(None)
    return BoxMinimum(
        v.T[(*flights, whole, best)], sets.status[best], inverse.T[(*flights, whole, whole, sets.row[best])]
    )
