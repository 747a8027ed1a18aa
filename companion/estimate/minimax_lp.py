"""Guaranteed linear estimation from sampled measurements: linear programme solved by exchange.

Measurements z_j = H_j x + G_j u + rho_j, E rho_j = 0, E rho_j^2 <= sigma_j^2, with ANY correlation of the
rho; inputs u_i, E u_i^2 <= d_i^2, of any correlation too: steps of an unknown force, or constants that are
unknown but bounded. Wanted is a . x + g . u. With k_i = g_i - sum_j G_ji w_j, what input i leaves in the
error, the worst r.m.s. error of an estimate w . z is sum sigma_j |w_j| + sum d_i |k_i|, attained. Of all
estimates that are unbiased in x the one whose worst error is least solves (Matasov, Martirosyan
(1.9)-(1.10), with inputs)

    minimise sum sigma_j |w_j| + sum d_i |k_i|   subject to   sum H_j w_j = a                         (primal)
    maximise a . lambda + g . u   subject to   |H_j . lambda + G_j . u| <= sigma_j,  |u_i| <= d_i       (dual)

so the dual is the motion that no measurement shows and that moves the target most. A basis has r + f rows A
and f inputs F whose effect it cancels, r the rank of H (4 on the Schuler channel): w_A follows from one small
solve, and is feasible whatever its signs, so there is no first phase. The dual follows from the signs of w_A
and of the other k; it levels the residual at +-sigma on A. The row that exceeds sigma most, or the input of F
that exceeds d most, enters, and a line search over the convex, piecewise linear cost chooses what leaves: the
simplex method, or Remez's exchange. At the end both values are equal, and that equality is the proof.

All work is done on orthonormal coordinates, H / sigma = Q S, computed once for many targets: there the
levelled polynomial is accurate to a few units of the last place however short the window, and least squares
costs one product, because the same problem with |w|_2 for |w|_1 is solved by w = Q a.

It knows neither time nor navigation. Where weights vanish, exchanges may gain nothing and never end. Then a
target close by, none of whose weights vanishes, is solved first. The dual constraints do not depend on the
target, so its optimal basis is nearly always that of the target too; the exchange goes on from there.
Unobservable targets raise `Infeasible`. The optimum need not be unique, its value is.
"""

from dataclasses import dataclass
from typing import NamedTuple, Self

import numpy as np
import numpy.typing as npt

from companion.units import Floats

Indices = npt.NDArray[np.intp]

LEVEL_TOLERANCE = 1e-12  # how far |H lambda| may exceed sigma, relative: also the duality gap left
RANK_TOLERANCE = 1e-13  # singular values below this share of the largest are rounding
ROUNDING = 1e-9  # of |H lambda| after exchanges that gained nothing
PERTURBATION = 1e-7  # of the largest term of the cost: how far a target is moved whose weights vanish
EXCHANGES_MAX = 1000  # a handful to thirty are usual


class Infeasible(ValueError):
    """The rows do not determine the target: no unbiased estimate exists."""


class Minimax(NamedTuple):
    """Minimax estimate w . z and its certificate: bound (1 - gap) <= least worst error <= bound.

    Attributes
    ----------
    weights : (n,)
        Weights w.
    bound : float
        Worst r.m.s. error, sum sigma |w| + sum d |g - G w|.
    dual : (m,)
        Feasible dual vector lambda; that of the inputs is not kept.
    gap : float
        Relative duality gap.
    active : tuple of int
        Rows of the last basis.
    cancelled : tuple of int
        Inputs whose effect it cancels; with `active` a start for the next, similar problem.
    """

    weights: Floats
    bound: float
    dual: Floats
    gap: float
    active: tuple[int, ...]
    cancelled: tuple[int, ...] = ()


class LeastSquares(NamedTuple):
    """Least-squares estimate w . z with its claimed and its worst error.

    Attributes
    ----------
    weights : (n,)
        Weights w.
    claimed : float
        One sigma if the errors are uncorrelated.
    worst : float
        R.m.s. error under the worst correlation, sum sigma |w| + sum d |G w|.
    """

    weights: Floats
    claimed: float
    worst: float


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
    inputs : (p, n)
        Effect of each input at its bound on each measurement, in sigmas.
    bounds : (p,)
        Bounds of the inputs.
    """

    sigmas: Floats
    whitened: Floats
    q: Floats
    coordinates: Floats
    unobservable: Floats
    columns: Floats
    inputs: Floats
    bounds: Floats

    @classmethod
    def of(
        cls,
        rows: npt.ArrayLike,
        sigmas: npt.ArrayLike,
        inputs: npt.ArrayLike | None = None,
        bounds: npt.ArrayLike = (),
    ) -> Self:
        """Check and factor rows and sigmas.

        Parameters
        ----------
        rows : (n, m)
            Measurement rows.
        sigmas : (n,) or float
            R.m.s. errors, one a row or one for all.
        inputs : (n, p), optional
            Effect G of unit inputs on the measurements.
        bounds : (p,)
            R.m.s. bounds d of the inputs, zero or more.

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
        effects = np.zeros((len(rows), 0)) if inputs is None else np.asarray(inputs, dtype=np.float64)
        limits = np.asarray(bounds, dtype=np.float64)
        if limits.ndim != 1 or effects.shape != (len(rows), len(limits)):
            raise ValueError(
                f"inputs has shape {effects.shape}, bounds {limits.shape}; give ({len(rows)}, p) and (p,)"
            )
        if not (np.isfinite(effects).all() and np.isfinite(limits).all() and (limits >= 0.0).all()):
            raise ValueError("inputs and bounds must be finite, and no bound negative")
        scaled = np.ascontiguousarray(effects.T) * limits[:, None] / sigmas
        whitened = np.ascontiguousarray(rows.T) / sigmas
        columns = np.abs(whitened).max(axis=1)
        columns[columns == 0.0] = 1.0
        triangle = np.linalg.qr((whitened / columns[:, None]).T, mode="r")
        _, singular, v_t = np.linalg.svd(triangle)
        rank = int(np.count_nonzero(singular > RANK_TOLERANCE * max(singular[0], np.finfo(float).tiny)))
        observable = v_t[:rank]
        coordinates = (observable.T / singular[:rank]) / columns[:, None]
        unobservable = np.eye(len(columns)) - observable.T @ observable
        q = coordinates.T @ whitened
        return cls(sigmas, whitened, q, coordinates, unobservable, columns, scaled, limits)

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

    def minimax(
        self,
        target: npt.ArrayLike,
        start: Minimax | None = None,
        through: npt.ArrayLike | None = None,
        tolerance: float = LEVEL_TOLERANCE,
    ) -> Minimax:
        """Compute the minimax estimate of one target by exchange.

        Parameters
        ----------
        target : (m,)
            Coefficients of the wanted combination of unknowns.
        start : Minimax, optional
            Solution of a similar problem.
        through : (p,), optional
            Effect g of unit inputs on the target; zero where not given.
        tolerance : float
            Relative duality gap that is good enough.

        Returns
        -------
        Minimax
            Weights, bound and certificate.

        Raises
        ------
        Infeasible
            If the rows do not determine the target.
        ValueError
            On wrong numbers or shapes, or if inputs act on the target and all rows are zero.

        References
        ----------
        Matasov, Martirosyan (1.9), (1.10).
        """
        a, a_q = self.in_coordinates(target)
        g = self._through(through) * self.bounds
        weights = np.zeros(len(self.sigmas))
        if not (a_q.any() or g.any()):
            return Minimax(weights, 0.0, np.zeros_like(a), 0.0, ())
        if not len(self.q):
            raise ValueError("all rows are zero; give one that measures an unknown")
        rows, inputs = self._basis(start)
        best = _exchange(self.q, self.inputs, a_q, g, rows, inputs, tolerance)
        bound = best.cost
        weights[best.rows] = best.weights / self.sigmas[best.rows]
        dual, u = self.coordinates @ best.dual, best.u
        excess = float(np.abs(dual @ self.whitened + u @ self.inputs).max())
        scale = max(1.0, excess, float(np.abs(u).max(initial=0.0)))
        value = (float(a @ dual) + float(g @ u)) / scale
        order = np.argsort(best.rows)
        return Minimax(
            weights,
            bound,
            dual / scale,
            (bound - value) / bound,
            tuple(best.rows[order].tolist()),
            tuple(best.inputs.tolist()),
        )

    def worst(self, weights: Floats, through: npt.ArrayLike | None = None) -> Floats:
        """Compute the worst r.m.s. error of any estimates W z, unbiased in x, from their weights.

        Parameters
        ----------
        weights : (n,) or (k, n)
            Weights of the measurements.
        through : (p,) or (k, p), optional
            Effect of unit inputs on the targets; zero where not given.

        Returns
        -------
        float or (k,)
            sum sigma |w| + sum d |g - G w|.
        """
        whitened = weights * self.sigmas
        left = self._through(through) * self.bounds - whitened @ self.inputs.T
        worst: Floats = np.abs(whitened).sum(axis=-1) + np.abs(left).sum(axis=-1)
        return worst

    def _through(self, through: npt.ArrayLike | None) -> Floats:
        if through is None:
            return np.zeros(len(self.bounds))
        g = np.asarray(through, dtype=np.float64)
        if g.shape[-1:] != self.bounds.shape or not np.isfinite(g).all():
            raise ValueError(f"through has shape {g.shape}; give {self.bounds.shape}, one for each input")
        return g

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
        weights = a_q @ self.q / self.sigmas
        return LeastSquares(weights, float(np.linalg.norm(a_q)), float(self.worst(weights)))

    def _basis(self, start: Minimax | None) -> tuple[Indices, Indices]:
        """Choose independent rows: of `start`, else the extremal nodes of a window, else by pivoting."""
        rank, n = self.q.shape
        none = np.empty(0, dtype=np.intp)
        if start is not None:
            rows, inputs = (np.asarray(k, dtype=np.intp) for k in (start.active, start.cancelled))
            if self._is_basis(rows, inputs):
                return rows, inputs
        nodes = 0.5 * (1.0 - np.cos(np.pi * np.arange(rank) / max(rank - 1, 1)))
        rows = np.round(nodes * (n - 1)).astype(np.intp)
        if not self._is_basis(rows, none):
            rows = independent_columns(self.q)
        return rows, none

    def _is_basis(self, rows: Indices, inputs: Indices) -> bool:
        n, p = len(self.sigmas), len(self.bounds)
        within = all(not len(k) or (k.min() >= 0 and k.max() < m) for k, m in ((rows, n), (inputs, p)))
        if not within or len(rows) != len(self.q) + len(inputs):
            return False
        matrix = np.vstack([self.q[:, rows], self.inputs[inputs][:, rows]])
        return bool(np.linalg.cond(matrix / np.abs(matrix).max(axis=1, keepdims=True).clip(1e-300)) < 1e8)


def independent_columns(q: Floats) -> Indices:
    """Choose independent columns as a QR decomposition with pivoting does.

    That of scipy.linalg would take 26 MB of a flying process, and the event loop 0.3 s to import it.

    Parameters
    ----------
    q : ndarray
        (r, n), of rank r.

    Returns
    -------
    ndarray
        (r,) their numbers.
    """
    left, chosen = q.copy(), []
    for _ in range(len(q)):
        chosen.append(int(np.argmax(np.einsum("ij,ij->j", left, left))))
        unit = left[:, chosen[-1]] / np.linalg.norm(left[:, chosen[-1]])
        left -= np.outer(unit, unit @ left)
    return np.array(chosen, dtype=np.intp)


class _Basis(NamedTuple):
    """Basis found: rows A and their whitened weights, inputs F, dual lambda (r,), u (p,) in bounds, cost."""

    rows: Indices
    weights: Floats
    inputs: Indices
    dual: Floats
    u: Floats
    cost: float


def _exchange(
    q: Floats, D: Floats, a: Floats, g: Floats, rows: Indices, inputs: Indices, tolerance: float
) -> _Basis:
    """Find the optimal basis from any independent one; q (r, n), D (p, n), a (r,), g (p,).

    The sign of a weight, and of what is left of an input, is kept as part of the basis, so that a zero has
    one too.
    """
    r, n = q.shape
    p = len(D)
    wanted = a, g
    rows, inputs = rows.copy(), inputs.copy()
    sign, u = np.ones(n), np.ones(p)
    first, cost, stalled, perturbed, approximate = True, np.inf, 0, False, False
    best: _Basis | None = None
    for _ in range(EXCHANGES_MAX):
        b = np.concatenate([q[:, rows], D[inputs][:, rows]])
        goal = np.concatenate([a, g[inputs]])
        try:
            inverse = np.linalg.inv(b)
        except np.linalg.LinAlgError:
            break
        w = inverse @ goal
        w += inverse @ (goal - b @ w)
        left = g - D[:, rows] @ w
        left[inputs] = 0.0
        now = float(np.abs(w).sum() + np.abs(left).sum())
        least = 0.0 if first else -1e-13 * now  # a wrong sign by rounding, in a nearly singular basis
        sign[rows] = np.where(w * sign[rows] < least, -sign[rows], sign[rows])
        u = np.where(left * u < least, -u, u)
        first = False
        biased = np.abs(b @ w - goal).max() > 1e-10 * max(np.abs(goal).max(), 1e-3 * now * np.abs(b).max())
        if best is not None and (biased or now > cost * (1.0 + 1e-9)):
            break  # two nearly equal rows: the basis before was optimal within rounding
        u[inputs] = 0.0
        dual = (sign[rows] - u @ D[:, rows]) @ inverse
        u[inputs] = dual[r:]
        best, approximate = _Basis(rows.copy(), w, inputs.copy(), dual[:r], u.copy(), now), perturbed
        level = dual[:r] @ q + u @ D
        excess = np.concatenate([np.abs(level), np.abs(dual[r:])])
        stalled = 0 if now < cost * (1.0 - 1e-14) else stalled + 1
        cost = now
        enter, degenerate = int(excess.argmax()), stalled > len(b)
        if excess[enter] <= 1.0 + max(tolerance, ROUNDING if degenerate else 0.0):
            if not perturbed:
                break
            (a, g), cost, stalled, perturbed = wanted, np.inf, 0, False
            continue
        if degenerate:
            a, g = _perturbed(q[:, rows], D[:, rows], w, left, sign[rows], u, inputs)
            cost, stalled, perturbed = np.inf, 0, True
            continue
        if enter < n:
            side = 1.0 if level[enter] > 0.0 else -1.0
            column = np.concatenate([q[:, enter], D[inputs, enter]])
            dw = -side * (inverse @ column)
            moved = -(D[:, rows] @ dw) - side * D[:, enter]
        else:
            side = 1.0 if dual[r + enter - n] > 0.0 else -1.0
            dw = -side * inverse[:, r + enter - n]
            moved = -(D[:, rows] @ dw)
        moved[inputs] = 0.0
        rate = np.concatenate([-sign[rows] * dw, -u * moved])  # how fast each |w| and |left| falls
        size = np.concatenate([np.abs(w), np.abs(left)])
        passed, leave = _line_search(size, rate, excess[enter])
        for k in passed:
            if k < len(rows):
                sign[rows[k]] *= -1.0
            else:
                u[k - len(rows)] *= -1.0
        if enter < n:
            sign[enter] = side
            if leave < len(rows):
                rows[leave] = enter
            else:
                rows, inputs = np.append(rows, enter), np.append(inputs, leave - len(rows))
        else:
            gone = enter - n
            u[inputs[gone]] = side
            if leave < len(rows):
                rows, inputs = np.delete(rows, leave), np.delete(inputs, gone)
            else:
                inputs[gone] = leave - len(rows)
    assert best is not None
    if approximate:
        w = np.linalg.solve(
            np.concatenate([q[:, best.rows], D[best.inputs][:, best.rows]]),
            np.concatenate([wanted[0], wanted[1][best.inputs]]),
        )
        left = wanted[1] - D[:, best.rows] @ w
        left[best.inputs] = 0.0
        best = best._replace(weights=w, cost=float(np.abs(w).sum() + np.abs(left).sum()))
    return best


def _perturbed(
    q: Floats, D: Floats, w: Floats, left: Floats, sign: Floats, u: Floats, inputs: Indices
) -> tuple[Floats, Floats]:
    """Return a target close by for which no term of the cost vanishes on the basis; all keep their signs."""
    size = PERTURBATION * max(float(np.abs(w).max()), float(np.abs(left).max(initial=0.0)))
    uneven = 1.0 + np.modf(0.618034 * np.arange(len(w) + len(left)))[0]  # no two steps of equal length
    w = w + size * uneven[: len(w)] * sign
    left = left + size * uneven[len(w) :] * np.where(u < 0.0, -1.0, 1.0)
    left[inputs] = 0.0
    return q @ w, D @ w + left


def _line_search(size: Floats, rate: Floats, excess: float) -> tuple[list[int], int]:
    """Return the terms that change sign on the way, and the one that ends at zero.

    The cost is convex along the way and its slope, 1 - excess at first, grows by twice the rate of each term
    that vanishes; while the slope is negative that term changes sign instead of ending there.
    """
    falling = np.flatnonzero(rate > 1e-11 * np.abs(rate).max())
    when = size[falling] / rate[falling]
    slope, passed = 1.0 - excess, list[int]()
    order = falling[np.argsort(when, kind="stable")].tolist()
    for k in order:
        slope += 2.0 * float(rate[k])
        if slope >= 0.0:
            return passed, k
        passed.append(k)
    return passed[:-1], order[-1]
