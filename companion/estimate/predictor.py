"""Guaranteed prediction from a window of fixes: the worst r.m.s. error of any linear estimate; the least.

A `Program` holds fixes z = H x + G u + rho of a window, with what is wanted as a . x + g . u. Of u, the
inputs (steps of an unknown force, errors of the unit that are constants), two things are stated: a bound on
the r.m.s. of each, of whatever correlation, and a covariance. With k = g - G' w, what an estimate w . z
leaves of them, its error is

    worst r.m.s.    sum sigma |w| + sum d |k|        over every correlation of fixes and inputs, attained
    expected r.m.s. sqrt(w' R w + k' U k)            by the covariances

Three estimates are compared, all unbiased in x: Bayes, of least expected error (the Kalman filter's, in one
batch); minimax, of least worst error; and restricted Bayes (Hodges and Lehmann 1952), of least expected error
among those whose worst error is at most kappa times the minimax one. The worst error of the first is the
guaranteed bound of a position that a filter of the same model sends.

A `Window` accumulates the transition of the error model along the flight. `anchor` makes its program: rows
and inputs refer to the state at the last fix, so that a force that wanders is small where it matters most.
The states at the anchor are unknown constants, each with a bound but the first ones. It does not know what
the states mean, nor whether a fix deserves trust.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple, Protocol

import numpy as np
import numpy.typing as npt

from companion.estimate.minimax_lp import LEVEL_TOLERANCE, Design, Minimax
from companion.units import Floats

KAPPA = 1.2  # worst error of the restricted estimate over the least possible
RESTRICTED_TOLERANCE = 1e-2  # relative, of its worst error against the limit
RESTRICTED_ROUNDS = 20  # in flight; the next search goes on from there
RESTRICTED_GAIN = 8.0  # power of the excess over what is aimed at by which the multiplier follows it
GROUP_S, GROUP_RATIO = 10.0, 0.2  # length of the newest group of fixes, s; growth with age
WHITE = 0.1  # share of white noise in the variance of a fix, expected
UNLIKE = 4.0  # fixes so many times better or worse are not grouped
TOLERANCE = 1e-4
CONTRADICTION_SIGMA = 4.0  # residuals beyond chi-square by so many sigmas contradict the model


class Target(NamedTuple):
    """Wanted combination a . x + g . u.

    Attributes
    ----------
    a : (m,)
        Coefficients of the unknowns.
    g : (p,)
        Coefficients of the inputs.
    beyond : float
        Worst error added by inputs after the last fix, which no fix shows.
    beyond_variance : float
        Their variance.
    """

    a: Floats
    g: Floats
    beyond: float = 0.0
    beyond_variance: float = 0.0


class Estimate(NamedTuple):
    """Linear estimate of one target.

    Attributes
    ----------
    value : float
        Estimate.
    expected : float
        R.m.s. error by the covariances.
    bound : float
        Worst r.m.s. error.
    weights : (n,)
        Weights of the fixes.
    """

    value: float
    expected: float
    bound: float
    weights: Floats


@dataclass(frozen=True, eq=False)
class Program:
    """Fixes of a window and all that is unknown.

    Attributes
    ----------
    rows : (n, m)
        Rows H on the unknowns of which nothing is known.
    values : (n,)
        Measurements.
    sigmas : (n,)
        R.m.s. errors of the measurements.
    inputs : (n, p)
        Effect G of unit inputs.
    bounds : (p,)
        R.m.s. bounds of the inputs.
    covariance : (p, p)
        Covariance U of the inputs.
    noise : (n, n)
        Covariance R of the measurements' errors.
    """

    rows: Floats
    values: Floats
    sigmas: Floats
    inputs: Floats
    bounds: Floats
    covariance: Floats
    noise: Floats

    @cached_property
    def design(self) -> Design:
        """The linear programme, factored."""
        return Design.of(self.rows, self.sigmas, self.inputs, self.bounds)

    @cached_property
    def crossed(self) -> Floats:
        """Covariance of the fixes with the inputs, G U (n, p)."""
        return self.inputs @ self.covariance

    @cached_property
    def spread(self) -> Floats:
        """Covariance of the fixes at given x, R + G U G' (n, n)."""
        return self.noise + self.crossed @ self.inputs.T

    def grouped(self, fixes: Floats) -> Program:
        """Replace fixes by their means with weights (n, k), whose columns add up to one."""
        return Program(
            fixes.T @ self.rows,
            fixes.T @ self.values,
            fixes.T @ self.sigmas,
            fixes.T @ self.inputs,
            self.bounds,
            self.covariance,
            fixes.T @ self.noise @ fixes,
        )

    def bayes(self, target: Target) -> Estimate:
        """Compute the estimate of least expected square: the Kalman filter's.

        Raises
        ------
        Infeasible
            If the fixes do not determine the target.
        """
        self.design.in_coordinates(target.a)
        return self.judge(_least_square(self.rows, target.a, self.crossed @ target.g, self.spread), target)

    def minimax(
        self, target: Target, start: Minimax | None = None, tolerance: float = LEVEL_TOLERANCE
    ) -> tuple[Estimate, Minimax]:
        """Compute the estimate of least worst error, and its certificate: a start for the next."""
        best = self.design.minimax(target.a, start, target.g, tolerance)
        return self.judge(best.weights, target), best

    def restricted(
        self,
        target: Target,
        best: Estimate,
        kappa: float = KAPPA,
        start: tuple[float, Floats] | None = None,
        tolerance: float = RESTRICTED_TOLERANCE,
        rounds: int = RESTRICTED_ROUNDS,
    ) -> tuple[Estimate, float]:
        """Compute the estimate of least expected square whose worst error is at most kappa times the least.

        With a multiplier mu on the worst error its terms are replaced by parabolas that touch them: each
        round is one least-squares problem, with coarser noise where a term is small. The multiplier aims at
        the middle of what is good enough: aimed at the limit, the worst error nears it from above for
        hundreds of rounds. It may swing about the limit as long; so after a round beyond the limit the best
        estimate within it is moved towards that round's as far as the limit allows. Both errors are convex.

        Parameters
        ----------
        target : Target
            What is wanted.
        best : Estimate
            The minimax estimate.
        kappa : float
            Limit of the worst error, in those of `best`.
        start : tuple, optional
            Multiplier and weights of a similar problem.
        tolerance : float
            Relative, of the worst error against its limit and of the expected error in a round.
        rounds : int
            Most rounds: the estimate is within its limit after any of them.

        Returns
        -------
        tuple
            Estimate, and its multiplier: 0 where the Kalman filter's is within the limit.

        Raises
        ------
        ValueError
            If kappa is below 1.

        References
        ----------
        Hodges and Lehmann, The use of previous experience in reaching statistical decisions (1952).
        """
        if kappa < 1.0:
            raise ValueError(f"kappa is {kappa:g}; give 1 or more: no estimate is below the minimax bound")
        limit = kappa * best.bound
        found = self.bayes(target)
        if found.bound <= limit:
            return found, 0.0
        G, g = self.inputs * self.bounds, target.g * self.bounds
        c, floor = self.crossed @ target.g, 1e-9 * limit
        mu, weights = found.expected**2 / limit, found.weights
        if start is not None and start[0] > 0.0 and start[1].shape == weights.shape:
            mu, weights = start
        feasible, before = best, found.expected
        for _ in range(rounds):
            fine = mu * self.sigmas / np.maximum(np.abs(weights), floor / self.sigmas)
            coarse = mu / np.maximum(np.abs(g - weights @ G), floor)
            spread = self.spread + np.diag(fine) + (G * coarse) @ G.T
            weights = _least_square(self.rows, target.a, c + G @ (coarse * g), spread)
            found = self.judge(weights, target)
            excess = found.bound / limit
            settled = abs(found.expected - before) <= tolerance * before
            before = found.expected
            if excess > 1.0:
                share = (limit - feasible.bound) / (found.bound - feasible.bound)
                found = self.judge(feasible.weights + share * (weights - feasible.weights), target)
            if found.bound <= limit and found.expected < feasible.expected:
                feasible = found
                weights = found.weights
            if settled and 1.0 - tolerance < excess <= 1.0:
                break
            mu *= (excess / (1.0 - 0.5 * tolerance)) ** RESTRICTED_GAIN
        return feasible, mu

    def judge(self, weights: Floats, target: Target) -> Estimate:
        """Compute value, expected and worst error of any linear estimate that is unbiased in x."""
        left = target.g - weights @ self.inputs
        variance = weights @ self.noise @ weights + left @ self.covariance @ left + target.beyond_variance
        worst = np.abs(weights) @ self.sigmas + np.abs(left) @ self.bounds + target.beyond
        return Estimate(float(weights @ self.values), math.sqrt(variance), float(worst), weights)

    @property
    def widening(self) -> float:
        """Factor by which the residuals exceed what is stated, 1 where they do not contradict it.

        R.m.s. of the whitened residuals, if chi-square is beyond `CONTRADICTION_SIGMA`.
        """
        weighed = _solve(self.spread, np.column_stack([self.values, self.rows]))
        normal = self.rows.T @ weighed[:, 1:]
        fitted = np.linalg.lstsq(normal, self.rows.T @ weighed[:, 0], rcond=None)[0]
        degrees = len(self.values) - int(np.linalg.matrix_rank(normal))
        if degrees <= 0:
            return 1.0
        mean = float(self.values @ weighed @ np.append(1.0, -fitted)) / degrees
        return math.sqrt(mean) if mean > 1.0 + CONTRADICTION_SIGMA * math.sqrt(2.0 / degrees) else 1.0


def _solve(A: Floats, b: Floats) -> Floats:
    return np.asarray(np.linalg.solve(A, b), dtype=np.float64)


def _least_square(rows: Floats, a: Floats, c: Floats, spread: Floats) -> Floats:
    """Solve min w' S w - 2 c . w subject to rows' w = a."""
    solved = _solve(spread, np.column_stack([c, rows]))
    multiplier = np.linalg.lstsq(rows.T @ solved[:, 1:], a - rows.T @ solved[:, 0], rcond=None)[0]
    weights: Floats = solved[:, 0] + solved[:, 1:] @ multiplier
    return weights


class Fix(NamedTuple):
    """Mean of some fixes of the error of the channel.

    Attributes
    ----------
    t_s : float
        Time, s.
    node : int
        Number of the node that ends the interval it lies in.
    rows : (k, m)
        Rows on the state, carried back to the epoch.
    values, sigmas : (k,)
        Measured errors, and their r.m.s. errors.
    """

    t_s: float
    node: int
    rows: Floats
    values: Floats
    sigmas: Floats


class Law(Protocol):
    """Error model of a channel whose inputs and states have bounds."""

    @property
    def n(self) -> int:
        """Number of states; position (2) and velocity (2) first."""

    @property
    def free(self) -> int:
        """Number of states, the first ones, of which nothing is known."""

    @property
    def correlation_s(self) -> float:
        """Correlation time of the fixes' errors, expected."""

    def prior(self) -> Floats:
        """R.m.s. of the states (n,) at the start."""

    def bound(self, age_s: Floats) -> Floats:
        """R.m.s. bound of the unknown input (k,) at times `age_s` from the anchor, of either sign."""

    def covariance(self, age_s: Floats) -> Floats:
        """Expected covariance of the unknown input (k, k) at such times."""


class Window(NamedTuple):
    """Fixes along the transition of the error model; an immutable value.

    Attributes
    ----------
    t_s : tuple of float
        Times of the nodes, s, increasing; the first is the epoch.
    C : tuple of (m, m)
        Transition from the epoch to each node.
    S : tuple of (m, 2)
        Effect of a unit input, north and east, in the interval that ends at the node, carried to the epoch.
    sigma : tuple of (m,)
        R.m.s. of the states at each node if no fix is used.
    P : (m, m)
        Their covariance at the last node.
    fixes : tuple of Fix
        Fixes, in order.
    """

    t_s: tuple[float, ...]
    C: tuple[Floats, ...]
    S: tuple[Floats, ...]
    sigma: tuple[Floats, ...]
    P: Floats
    fixes: tuple[Fix, ...] = ()

    @classmethod
    def begin(cls, t_s: float, law: Law) -> Window:
        """Start with the epoch as the only node."""
        sigma, n = law.prior(), law.n
        return cls((t_s,), (np.eye(n),), (np.zeros((n, 2)),), (sigma,), np.diag(sigma**2))

    def extend(self, t_s: float, Phi: Floats, B: Floats, Q: Floats) -> Window:
        """Append a node: transition (m, m), effect (m, 2) of a unit input and noise (m, m) since the last."""
        if not t_s > self.t_s[-1]:
            raise ValueError(f"node at {t_s:g} s, the last is at {self.t_s[-1]:g} s; give a later one")
        C, P = Phi @ self.C[-1], Phi @ self.P @ Phi.T + Q
        S = _solve(C, B)
        return self._replace(
            t_s=(*self.t_s, t_s),
            C=(*self.C, C),
            S=(*self.S, S),
            sigma=(*self.sigma, np.sqrt(P.diagonal())),
            P=P,
        )

    def with_fix(self, t_s: float, rows: Floats, values: Floats, sigmas: Floats, span_s: float) -> Window:
        """Append a fix in the interval that ends at the last node; drop those `span_s` before it."""
        fix = Fix(t_s, len(self.t_s) - 1, rows, values, sigmas)
        kept = [f for f in self.fixes if f.t_s >= t_s - span_s]
        first = max((kept[0].node if kept else len(self.t_s) - 1) - 1, 0)
        fixes = tuple(f._replace(node=f.node - first) for f in (*kept, fix))
        return Window(self.t_s[first:], self.C[first:], self.S[first:], self.sigma[first:], self.P, fixes)

    def shift(self, offset: Floats) -> Window:
        """Move every measured position with a jump (2,) of the channel."""
        fixes = tuple(f._replace(values=f.values + offset) for f in self.fixes)
        return self._replace(fixes=fixes)


Start = tuple[Minimax, tuple[float, Floats]]  # of the exchange, and of the restricted estimate


class Solved(NamedTuple):
    """Estimates of one target.

    Attributes
    ----------
    kalman, minimax, restricted : Estimate
        Of least expected error, of least worst error, and of least expected error among those whose worst
        error is at most `KAPPA` times the least.
    gap : float
        Relative distance within which the minimax error is proved to be the least, for the grouped fixes.
    start : tuple
        Start for a similar problem.
    """

    kalman: Estimate
    minimax: Estimate
    restricted: Estimate
    gap: float
    start: Start


class Anchored(NamedTuple):
    """Program of a window, on the state at its last fix, and what carries targets there.

    Estimates are sought among those that weigh neighbouring fixes alike, on `grouped`: a sixth of the fixes,
    a hundredth of the work. Their errors are computed on `program`, where they are exact: there a force in
    the interval of a fix counts too, from the fix on. Sought with it, a force that is constant over a group
    would be separated from the means of the fixes.

    Attributes
    ----------
    program : Program
        Unknowns: the free states; inputs: the unknown force by interval, north and east, oldest first, then
        the states with a bound.
    grouped : Program
        The same with means of fixes, and with a force that is constant over longer intervals.
    fixes : (n, k)
        Weights of the fixes in each mean.
    node, t_s : int, float
        Node and time of the last fix.
    back : (m, m)
        Transition from the state there to the epoch.
    law : Law
        Error model.
    """

    program: Program
    grouped: Program
    fixes: Floats
    node: int
    t_s: float
    back: Floats
    law: Law

    def solve(self, target: Target, start: Start | None = None, tolerance: float = TOLERANCE) -> Solved:
        """Compute the three estimates of a target.

        Parameters
        ----------
        target : Target
            What is wanted.
        start : tuple, optional
            Start of a similar problem.
        tolerance : float
            Relative gap of the minimax error that is good enough.

        Returns
        -------
        Solved
            Estimates with their exact errors.

        Raises
        ------
        Infeasible
            If the fixes do not determine the target.
        """
        coarse = self.coarse(target)
        kalman = self.grouped.bayes(coarse)
        best, basis = self.grouped.minimax(coarse, start[0] if start else None, tolerance)
        restricted, mu = self.grouped.restricted(coarse, best, start=start[1] if start else None)
        k, m, r = (self.program.judge(self.fixes @ e.weights, target) for e in (kalman, best, restricted))
        return Solved(k, m, r, basis.gap, (basis, (mu, restricted.weights)))

    def coarse(self, target: Target) -> Target:
        """The target on the inputs of `grouped`: no force before the anchor is in one."""
        return target._replace(g=target.g[len(self.program.bounds) - len(self.grouped.bounds) :])

    def carried(self, solved: Solved, rate: Solved | None, seconds: float, target: Target) -> Solved:
        """Judge the estimates of a target anew for a time `seconds` later, without seeking better ones.

        Parameters
        ----------
        solved : Solved
            Estimates of the target, by this program.
        rate : Solved, optional
            Those of its rate, by which they are carried on.
        seconds : float
            Time since they were found.
        target : Target
            The target then.

        Returns
        -------
        Solved
            Linear estimates with their exact errors; the gap is that of the time they were found at.
        """
        weights = [e.weights for e in solved[:3]]
        if rate is not None:
            weights = [w + seconds * e.weights for w, e in zip(weights, rate[:3], strict=True)]
        k, m, r = (self.program.judge(w, target) for w in weights)
        return solved._replace(kalman=k, minimax=m, restricted=r)

    def targets(self, window: Window, which: Sequence[int], ahead: Sequence[Step] = ()) -> list[Target]:
        """Build the targets of some states at the last node, or after further steps from there."""
        rows = np.eye(self.law.n)[list(which)]
        effects, ages, t_s = list[Floats](), list[float](), window.t_s[-1] + sum(s.seconds for s in ahead)
        for step in reversed(ahead):
            effects.append(rows @ step.B)
            ages.append(t_s - 0.5 * step.seconds - self.t_s)
            rows, t_s = rows @ step.Phi, t_s - step.seconds
        rows = rows @ window.C[-1]  # on the state at the epoch
        for k in range(len(window.t_s) - 1, self.node, -1):
            effects.append(rows @ window.S[k])
            ages.append(0.5 * (window.t_s[k] + window.t_s[k - 1]) - self.t_s)
        rows = rows @ self.back
        age = np.array(ages[::-1])
        d, F = self.law.bound(age), self.law.covariance(age)
        free, p = self.law.free, len(self.program.bounds)
        found = []
        for k, row in enumerate(rows):
            beyond = np.array([effect[k] for effect in effects[::-1]]).reshape(-1, 2)
            g = np.zeros(p)
            g[p - self.law.n + free :] = row[free:]
            worst = float(d @ np.abs(beyond).sum(axis=1))
            variance = float(np.einsum("iq,ij,jq->", beyond, F, beyond))
            found.append(Target(row[:free], g, worst, variance))
        return found


class Step(NamedTuple):
    """Step ahead of the last node: seconds, transition (m, m), effect of a unit input (m, 2)."""

    seconds: float
    Phi: Floats
    B: Floats


def anchor(window: Window, law: Law) -> Anchored:
    """Build the program of a window with its state at the last fix as the unknown.

    Parameters
    ----------
    window : Window
        One fix or more.
    law : Law
        Error model.

    Returns
    -------
    Anchored
        The program.

    Raises
    ------
    ValueError
        Without fixes.
    """
    if not window.fixes:
        raise ValueError("the window has no fixes; give one or more")
    first, last = window.fixes[0].node, window.fixes[-1].node
    back = _solve(window.C[last], np.eye(law.n))
    nodes = np.array(window.t_s[first : last + 1])
    ends = np.array([window.t_s[f.node] for f in window.fixes])
    begins = np.array([window.t_s[max(f.node - 1, 0)] for f in window.fixes])
    taken = np.array([f.t_s for f in window.fixes]).clip(begins, ends)
    kind = _kinds(window)
    noise = _noise(window, law, kind)
    silent = {*nodes[:-1].tolist()} - {*ends.tolist()}
    cuts = np.array(sorted({*taken.tolist(), *silent, nodes[-1]}))
    program = _program(window, law, back, taken, cuts, noise)
    each = [len(f.values) for f in window.fixes]
    fixes = _groups(np.repeat(_by_age(nodes[-1] - taken), each) * 512 + kind)
    fixes /= program.sigmas[:, None] ** 2
    fixes /= fixes.sum(axis=0)
    is_cut = np.diff(_by_age(nodes[-1] - nodes[1:]), prepend=-1, append=-2) != 0
    grouped = _program(window, law, back, ends, nodes[is_cut], noise).grouped(fixes)
    return Anchored(program, grouped, fixes, last, window.t_s[last], back, law)


def _program(
    window: Window, law: Law, back: Floats, seen_s: Floats, cuts_s: Floats, noise: Floats
) -> Program:
    """The program whose fixes show the state at times `seen_s`, with a force constant between the cuts."""
    last, free, n = window.fixes[-1].node, law.free, law.n
    rows = np.concatenate([f.rows for f in window.fixes]) @ back
    each = [len(f.values) for f in window.fixes]
    until = (window.C[last] @ _effect_until(window, np.append(cuts_s, seen_s))).transpose(1, 0, 2)
    at_cuts = (rows @ until[:, : len(cuts_s)].reshape(n, -1)).reshape(len(rows), -1, 2)
    at_fix = np.einsum("in,nij->ij", rows, np.repeat(until[:, len(cuts_s) :], each, axis=1))
    later = np.repeat(seen_s, each)[:, None] < cuts_s  # a force before the fix is in the state it measures
    effect = -np.diff(np.where(later[..., None], at_cuts, at_fix[:, None]), axis=1)
    age = 0.5 * (cuts_s[1:] + cuts_s[:-1]) - window.t_s[last]
    d, sigma = np.repeat(law.bound(age), 2), window.sigma[last][free:]
    U = np.diag(np.concatenate([0.0 * d, sigma**2]))
    U[: len(d) : 2, : len(d) : 2] = U[1 : len(d) : 2, 1 : len(d) : 2] = law.covariance(age)
    return Program(
        rows[:, :free],
        np.concatenate([f.values for f in window.fixes]),
        np.concatenate([f.sigmas for f in window.fixes]),
        np.concatenate([effect.reshape(len(rows), len(d)), rows[:, free:]], axis=1),
        np.concatenate([d, sigma]),
        U,
        noise,
    )


def _noise(window: Window, law: Law, kind: npt.NDArray[np.intp]) -> Floats:
    """Covariance of the fixes' errors."""
    each = [len(f.values) for f in window.fixes]
    t = np.repeat([f.t_s for f in window.fixes], each)
    decay = np.exp(-np.abs(t[:, None] - t) / max(law.correlation_s, 1e-3))
    noise = np.where(kind[:, None] == kind, (1.0 - WHITE) * decay, 0.0) + WHITE * np.eye(len(t))
    sigmas = np.concatenate([f.sigmas for f in window.fixes])
    noise *= sigmas[:, None] * sigmas
    return noise


def _effect_until(window: Window, t_s: Floats) -> Floats:
    """Effect (k, m, 2) of a unit input from the first node to some times (k,), carried to the epoch."""
    S = np.array(window.S)
    S[0] = 0.0
    S, nodes = np.cumsum(S, axis=0), np.array(window.t_s)
    if len(nodes) < 2:
        return np.zeros((len(t_s), *S.shape[1:]))
    k = np.searchsorted(nodes, t_s).clip(1, len(nodes) - 1)
    share = ((t_s - nodes[k - 1]) / (nodes[k] - nodes[k - 1]))[:, None, None]
    until: Floats = S[k - 1] + share * (S[k] - S[k - 1])
    return until


def _kinds(window: Window) -> npt.NDArray[np.intp]:
    """Number of the component and the size of each fix: those as unlike are of different sources."""
    sigmas = np.concatenate([f.sigmas for f in window.fixes])
    component = np.concatenate([np.arange(len(f.values)) for f in window.fixes])
    size = np.rint(np.log(sigmas / sigmas.min()) / math.log(UNLIKE)).astype(np.intp).clip(0, 63)
    kind: npt.NDArray[np.intp] = component * 64 + size
    return kind


def _by_age(age_s: Floats) -> npt.NDArray[np.intp]:
    """Number of the group of each age: groups grow with it."""
    found = np.log1p(np.maximum(age_s, 0.0) * (GROUP_RATIO / GROUP_S)) / math.log1p(GROUP_RATIO)
    return np.ceil(found - 1e-9).astype(np.intp)


def _groups(number: npt.NDArray[np.intp]) -> Floats:
    """One 1 in each row: the group of that row, the oldest first within the order of their numbers."""
    present = np.flatnonzero(np.bincount(number))  # np.unique imports numpy.ma, 8 ms in flight
    group: Floats = (number[:, None] == present).astype(np.float64)
    return group
