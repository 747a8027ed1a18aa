"""Guaranteed linear estimation from sampled measurements: linear programme solved by exchange.

Measurements z_j = H_j x + rho_j, E rho_j = 0, E rho_j^2 <= sigma_j^2, with ANY correlation between the rho.
Of all linear unbiased estimates of a . x the one whose worst r.m.s. error is least solves (Matasov,
Martirosyan (1.9)-(1.10))

    minimise sum sigma_j |w_j|   subject to   sum H_j w_j = a                            (primal)
    maximise a . lambda          subject to   |H_j . lambda| <= sigma_j                  (dual)

A basis of r independent rows, r the rank (4 on the Schuler channel), gives weights by one small solve and is
feasible whatever their signs, so there is no first phase. Its dual vector is a generalised polynomial H .
lambda that levels at +-sigma on the basis. The row with the largest excess enters, and a line search over
its weight chooses the row that leaves: the simplex method, or Remez's exchange. At the end both values are
equal, and that equality is the proof.

All work is done on orthonormal coordinates, H / sigma = Q S, computed once for many targets: there the
levelled polynomial is accurate to a few units of the last place however short the window, and least squares
costs one product, because the same problem with |w|_2 for |w|_1 is solved by w = Q a.

It knows neither time nor navigation. Degenerate targets (weights that vanish) are handled by Bland's rule
after a stall; unobservable ones raise `Infeasible`. The optimum need not be unique, its value is.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple, Self

import numpy as np
import numpy.typing as npt

from companion.units import Floats

Indices = npt.NDArray[np.intp]

LEVEL_TOLERANCE = 1e-12  # how far |H lambda| may exceed sigma, relative: also the duality gap left
RANK_TOLERANCE = 1e-13  # singular values below this share of the largest are rounding
EXCHANGES_MAX = 1000  # a handful to thirty are usual


class Infeasible(ValueError):
    """The rows do not determine the target: no unbiased estimate exists."""


class Minimax(NamedTuple):
    """Minimax estimate w . z and its certificate: a . dual <= least worst error <= bound.

    Attributes
    ----------
    weights : (n,)
        Weights w.
    bound : float
        Worst r.m.s. error, sum sigma |w|.
    dual : (m,)
        Feasible dual vector lambda.
    gap : float
        Relative duality gap, (bound - a . dual) / bound.
    active : tuple of int
        Rows of the last basis; a start for the next, similar problem.
    """

    weights: Floats
    bound: float
    dual: Floats
    gap: float
    active: tuple[int, ...]


class LeastSquares(NamedTuple):
    """Least-squares estimate w . z with its claimed and its worst error.

    Attributes
    ----------
    weights : (n,)
        Weights w.
    claimed : float
        One sigma if the errors are uncorrelated.
    worst : float
        R.m.s. error under the worst correlation, sum sigma |w|.
    """

    weights: Floats
    claimed: float
    worst: float


def worst_case_rms(weights: npt.ArrayLike, sigmas: npt.ArrayLike) -> float:
    """Compute the r.m.s. error of w . z under the worst correlation, rho = +-sigma sign w.

    Parameters
    ----------
    weights : (n,)
        Weights w.
    sigmas : (n,) or float
        R.m.s. errors of the measurements.

    Returns
    -------
    float
        sum sigma |w|.
    """
    return float(np.sum(np.abs(np.asarray(weights) * np.asarray(sigmas))))


def white_noise_rms(weights: npt.ArrayLike, sigmas: npt.ArrayLike) -> float:
    """Compute the r.m.s. error of w . z under uncorrelated errors.

    Parameters
    ----------
    weights : (n,)
        Weights w.
    sigmas : (n,) or float
        R.m.s. errors of the measurements.

    Returns
    -------
    float
        sqrt(sum sigma^2 w^2).
    """
    return float(np.linalg.norm(np.asarray(weights) * np.asarray(sigmas)))


def solve(
    rows: npt.ArrayLike, target: npt.ArrayLike, sigmas: npt.ArrayLike, start: Sequence[int] | None = None
) -> Minimax:
    """Compute the minimax estimate of one target.

    Parameters
    ----------
    rows : (n, m)
        Measurement rows.
    target : (m,)
        Coefficients of the wanted combination of unknowns.
    sigmas : (n,) or float
        R.m.s. errors, one a row or one for all.
    start : sequence of int, optional
        `active` of a similar problem.

    Returns
    -------
    Minimax
        Weights, bound and certificate.

    Raises
    ------
    Infeasible
        If the rows do not determine the target.
    ValueError
        On wrong shapes, numbers that are not finite, or sigmas that are not positive.

    References
    ----------
    Matasov, Martirosyan (1.9), (1.10).
    """
    return Design.of(rows, sigmas).minimax(target, start)


def least_squares(rows: npt.ArrayLike, target: npt.ArrayLike, sigmas: npt.ArrayLike) -> LeastSquares:
    """Compute the weighted least-squares estimate of one target.

    Parameters
    ----------
    rows : (n, m)
        Measurement rows.
    target : (m,)
        Coefficients of the wanted combination of unknowns.
    sigmas : (n,) or float
        R.m.s. errors, one a row or one for all.

    Returns
    -------
    LeastSquares
        Weights, claimed and worst error.

    Raises
    ------
    Infeasible, ValueError
        As in `solve`.
    """
    return Design.of(rows, sigmas).least_squares(target)


@dataclass(frozen=True, slots=True, eq=False)
class Design:
    """Rows and sigmas, checked and factored once, for any number of targets.

    Attributes
    ----------
    sigmas : (n,)
        R.m.s. errors.
    whitened : (m, n)
        H / sigma, by columns: numpy is fastest along the long axis.
    q : (r, n)
        Rows in orthonormal coordinates, q q^T = I.
    coordinates : (m, r)
        q = coordinates^T @ whitened.
    unobservable : (m, m)
        Projector, in scaled columns, on the directions that no row measures.
    columns : (m,)
        Scale of each column.
    """

    sigmas: Floats
    whitened: Floats
    q: Floats
    coordinates: Floats
    unobservable: Floats
    columns: Floats

    @classmethod
    def of(cls, rows: npt.ArrayLike, sigmas: npt.ArrayLike) -> Self:
        """Check and factor rows and sigmas.

        Parameters
        ----------
        rows : (n, m)
            Measurement rows.
        sigmas : (n,) or float
            R.m.s. errors, one a row or one for all.

        Returns
        -------
        Design
            Factored rows.

        Raises
        ------
        ValueError
            On wrong shapes, numbers that are not finite, or sigmas that are not positive.
        """
        rows = np.asarray(rows, dtype=np.float64)
        if rows.ndim != 2 or rows.shape[0] == 0 or rows.shape[1] == 0:
            raise ValueError(f"rows has shape {rows.shape}; give (n, m) with one measurement or more")
        sigmas = np.asarray(sigmas, dtype=np.float64)
        if sigmas.ndim == 0:
            sigmas = np.full(len(rows), sigmas)
        if sigmas.shape != (len(rows),):
            raise ValueError(
                f"sigmas has shape {sigmas.shape}, rows {rows.shape}; give one sigma for each row"
            )
        if not np.isfinite(rows).all():
            i = int(np.argmin(np.isfinite(rows).all(axis=1)))
            raise ValueError(f"rows[{i}] is not finite; leave a missing measurement out")
        if not (np.isfinite(sigmas) & (sigmas > 0.0)).all():
            i = int(np.argmin(np.isfinite(sigmas) & (sigmas > 0.0)))
            raise ValueError(f"sigmas[{i}] is {sigmas[i]}; give a positive one or leave the row out")
        whitened = np.ascontiguousarray(rows.T) / sigmas
        columns = np.abs(whitened).max(axis=1)
        columns[columns == 0.0] = 1.0
        triangle = np.linalg.qr((whitened / columns[:, None]).T, mode="r")
        _, singular, v_t = np.linalg.svd(triangle)
        rank = int(np.count_nonzero(singular > RANK_TOLERANCE * max(singular[0], np.finfo(float).tiny)))
        observable = v_t[:rank]
        coordinates = (observable.T / singular[:rank]) / columns[:, None]
        unobservable = np.eye(len(columns)) - observable.T @ observable
        return cls(sigmas, whitened, coordinates.T @ whitened, coordinates, unobservable, columns)

    def in_coordinates(self, target: npt.ArrayLike) -> tuple[Floats, Floats]:
        """Transform a target to the orthonormal coordinates.

        Parameters
        ----------
        target : (m,)
            Coefficients of the wanted combination of unknowns.

        Returns
        -------
        tuple
            Target (m,) as floats, and in the coordinates (r,).

        Raises
        ------
        Infeasible
            If the rows do not determine it.
        ValueError
            On a wrong shape or a number that is not finite.
        """
        a = np.asarray(target, dtype=np.float64)
        m = len(self.columns)
        if a.shape != (m,):
            raise ValueError(f"target has shape {a.shape}; give ({m},), one number for each unknown")
        if not np.isfinite(a).all():
            raise ValueError(f"target[{int(np.argmin(np.isfinite(a)))}] is not finite; give numbers")
        scaled = a / self.columns
        component = np.abs(self.unobservable @ scaled)
        size = float(np.linalg.norm(scaled))
        if component.max() > 1e-9 * size:
            indices = ", ".join(str(i) for i in np.flatnonzero((component > 1e-9 * size) & (a != 0.0)))
            rank, n = self.q.shape
            raise Infeasible(
                f"target is not observable in component {indices}: {n} rows have rank {rank} of {m}; "
                "add measurements at other times or of another quantity"
            )
        return a, a @ self.coordinates

    def minimax(self, target: npt.ArrayLike, start: Sequence[int] | None = None) -> Minimax:
        """Compute the minimax estimate of one target by exchange.

        Parameters
        ----------
        target : (m,)
            Coefficients of the wanted combination of unknowns.
        start : sequence of int, optional
            Rows to start from, if they are a basis.

        Returns
        -------
        Minimax
            Weights, bound and certificate.
        """
        a, a_q = self.in_coordinates(target)
        weights = np.zeros(len(self.sigmas))
        if not a_q.any():
            return Minimax(weights, 0.0, np.zeros_like(a), 0.0, ())
        basis, w, dual_q = _exchange(self.q, a_q, self._basis(start))
        bound = float(np.abs(w).sum())
        weights[basis] = w / self.sigmas[basis]
        dual = self.coordinates @ dual_q
        dual /= max(1.0, float(np.abs(dual @ self.whitened).max()))
        return Minimax(
            weights, bound, dual, (bound - float(a @ dual)) / bound, tuple(np.sort(basis).tolist())
        )

    def least_squares(self, target: npt.ArrayLike) -> LeastSquares:
        """Compute the least-squares estimate of one target.

        Parameters
        ----------
        target : (m,)
            Coefficients of the wanted combination of unknowns.

        Returns
        -------
        LeastSquares
            Weights, claimed and worst error.
        """
        _, a_q = self.in_coordinates(target)
        whitened_weights = a_q @ self.q
        return LeastSquares(
            whitened_weights / self.sigmas, float(np.linalg.norm(a_q)), float(np.abs(whitened_weights).sum())
        )

    def _basis(self, start: Sequence[int] | None) -> Indices:
        """Choose r independent rows: `start`, else the extremal nodes of a window, else by pivoting."""
        rank, n = self.q.shape
        nodes = 0.5 * (1.0 - np.cos(np.pi * np.arange(rank) / max(rank - 1, 1)))
        for rows in (start, np.round(nodes * (n - 1))):
            if rows is None or len(rows) != rank:
                continue
            basis = np.asarray(rows, dtype=np.intp)
            if basis.min() >= 0 and basis.max() < n and np.linalg.cond(self.q[:, basis]) < 1e6:
                return basis
        from scipy.linalg import qr  # 0.2 s: not before the first frame is received

        return np.asarray(qr(self.q, mode="r", pivoting=True)[-1][:rank], dtype=np.intp)


def _exchange(q: Floats, a: Floats, basis: Indices) -> tuple[Indices, Floats, Floats]:
    """Find the optimal basis, its whitened weights and the dual vector, from any independent basis.

    q (r, n), a (r,). The sign of a weight is kept as part of the basis, so that a weight of zero has one too.
    """
    basis = basis.copy()
    sign = np.where(np.linalg.solve(q[:, basis], a) < 0.0, -1.0, 1.0)
    cost, stalled = np.inf, 0
    best: tuple[Indices, Floats, Floats] | None = None
    for _ in range(EXCHANGES_MAX):
        b = q[:, basis]
        inverse = np.linalg.inv(b)
        w = inverse @ a
        w += inverse @ (a - b @ w)
        size = sign * w
        wrong = size < -1e-13 * np.abs(size).sum()  # by rounding, in a nearly singular basis
        sign[wrong], size[wrong] = -sign[wrong], -size[wrong]
        now = float(size.sum())
        biased = np.abs(b @ w - a).max() > 1e-10 * max(np.abs(a).max(), 1e-3 * now * np.abs(b).max())
        if best is not None and (biased or now > cost * (1.0 + 1e-9)):
            break  # two nearly equal rows: the basis before was optimal within rounding
        dual = sign @ inverse
        best = (basis.copy(), w, dual)
        level = dual @ q
        excess = np.abs(level)
        stalled = 0 if now < cost * (1.0 - 1e-14) else stalled + 1
        cost = now
        bland = stalled > 3 * len(a)
        enter = int(np.argmax(excess > 1.0 + LEVEL_TOLERANCE)) if bland else int(excess.argmax())
        if excess[enter] <= 1.0 + LEVEL_TOLERANCE:
            break
        side = 1.0 if level[enter] > 0.0 else -1.0
        rate = sign * (inverse @ q[:, enter]) * side  # how fast each |w| of the basis falls
        leave = _first_to_vanish(size, rate, basis) if bland else _long_step(size, rate, sign, excess[enter])
        basis[leave], sign[leave] = enter, side
    assert best is not None
    return best


def _long_step(size: Floats, rate: Floats, sign: Floats, excess: float) -> int:
    """Choose the weight that leaves, changing `sign` of those passed on the way.

    The cost is convex in the entering weight and its slope, 1 - excess at first, grows by twice the rate of
    each weight that vanishes; while the slope is negative that weight changes sign instead of leaving.
    """
    falling = np.flatnonzero(rate > 1e-11 * np.abs(rate).max())
    slope = 1.0 - excess
    for i in falling[np.argsort(size[falling] / rate[falling], kind="stable")]:
        slope += 2.0 * rate[i]
        if slope >= 0.0:
            break
        sign[i] = -sign[i]
    return int(i)


def _first_to_vanish(size: Floats, rate: Floats, basis: Indices) -> int:
    """Choose the weight that vanishes first, of several the lowest row: Bland's rule."""
    falling = np.flatnonzero(rate > 1e-11 * np.abs(rate).max())
    when = np.maximum(size[falling], 0.0) / rate[falling]
    first = falling[when <= when.min() * (1.0 + 1e-12) + 1e-300]
    return int(first[np.argmin(basis[first])])
