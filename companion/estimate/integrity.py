"""Solution separation: detect the faulty source and bound its effect on the position.

Beside the filter that uses every source a row of `filterbank` uses all but one. If the models are right the
full solution is optimal, its error is orthogonal to any difference of solutions, and so the separation

    d = x_full - x_sub   has the covariance   S = P_sub - P_full                        (Brown, McBurney 1988)

whatever they used in common. d' S^-1 d over all states is the gain in likelihood by leaving the source out,
whatever its fault: so the row with the largest separation, less its degrees of freedom, names it. A fault in
position shows in the velocities and tilts that it contributed to long before it shows in position. The same
holds of a row forked from the full solution: its separation accumulates a slow drift over minutes, with an
INS and beacons that were calibrated up to the fork. A fault older than the fork is in the forked row too; the
row that never used its source has none of it, and the protection level rests on that one.

The process noise added to the row "inertial" makes its claimed P larger than its errors are, so that S errs
on the side of fewer alarms.

Horizontal protection level, for one faulty source at a time:

    |e_full| <= |d| + |e_sub| <= K_fa sigma(S) + K_md sigma(P_sub),  sigma(C) = sqrt(greatest eigenvalue),

with K = sqrt(-2 ln p), as a normal error in the plane leaves the circle K sigma with probability at most p.
While |d| exceeds its limit and no source is excluded yet, |d| itself replaces the limit. The second of two
faults that overlap is detected only after the exclusion of the first: the row of the first, from which all
restart, may have used the second.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.special import chdtri

from companion.estimate.filterbank import INERTIAL, Bank, Row
from companion.units import Floats

#: Least variance of a separation (m^2), above rounding and linearisation. It must be small: beside GNSS a
#: beacon moves the full solution by centimetres, and the excess of that shows its bias.
FLOOR = 1e-6
ROUNDING = 1e-6  # of a row's variance: a smaller difference of covariances is zero


class Separation(NamedTuple):
    """Full solution minus row, north and east (m), its covariance (m^2); d' S^-1 d of the position alone,
    chi-square of two, and of all states, chi-square of `freedom`.
    """

    row: Row
    d: Floats
    S: Floats
    position: float
    statistic: float
    freedom: int

    def limit(self, probability: float) -> float:
        """Return the limit of `statistic`, exceeded with `probability` without a fault."""
        return float(chdtri(max(self.freedom, 1), probability))

    def beyond(self, probability: float) -> bool:
        """Return whether one of both tests fails, half of `probability` each."""
        half = 0.5 * probability
        return self.position > threshold(half) or self.statistic > self.limit(half)


class Blame(NamedTuple):
    """Source with the largest separation, the limit of its statistic, and its distance to the next: certain
    once `margin` is large.
    """

    source: str
    statistic: float
    limit: float
    margin: float
    lead: float  # over the next measuring source, as a share of its own


class Protection(NamedTuple):
    """Horizontal protection level (m), exceeded with at most `probability`; `by` the source that sets it."""

    level: float
    probability: float
    by: str
    fault_free: float


def separations(bank: Bank) -> tuple[Separation, ...]:
    """Compute every row's separation in position from the full solution."""
    return _separated(bank, 0, range(1, len(bank.rows)))


def threshold(probability: float) -> float:
    """Compute the limit of a separation's statistic, exceeded with `probability` without a fault."""
    if not 0.0 < probability < 1.0:
        raise ValueError(f"probability {probability} of a false alarm: give one between 0 and 1")
    return -2.0 * math.log(probability)


def blame(found: tuple[Separation, ...], probability: float) -> Blame | None:
    """Find the source with the largest separation, if any exceeds its limit of this `probability`.

    `margin` is twice the logarithm of the likelihood by which it explains the data better than the next
    source does, each less its freedom: require `threshold(p)` of it to name the wrong one with probability p.
    """
    if not any(s.beyond(probability) for s in found):
        return None
    worst: dict[str, Separation] = {}
    for s in found:
        other = worst.setdefault(s.row.without, s)
        if s.statistic - s.freedom > other.statistic - other.freedom:
            worst[s.row.without] = s
    first, *others = sorted(worst.values(), key=lambda s: s.freedom - s.statistic)
    excess = first.statistic - first.freedom
    margin = excess - (others[0].statistic - others[0].freedom if others else 0.0)
    next_excess = max((s.statistic - s.freedom for s in others if s.row.without != INERTIAL), default=0.0)
    lead = 1.0 - max(next_excess, 0.0) / excess if excess > 0.0 else 0.0
    return Blame(first.row.without, first.statistic, first.limit(0.5 * probability), margin, lead)


def exclude(bank: Bank, source: str, probability: float) -> Bank:
    """Exclude `source` from now on, and undo its effect.

    The full solution is replaced by the source's oldest fork if that agrees with the row that never used it
    (agreement is wrongly denied with this `probability`), else by this row; all others, which used it,
    restart from there.
    """
    mine = [i for i, row in enumerate(bank.rows) if row.without == source]
    if not mine:
        raise ValueError(f"no row leaves out {source!r}: there are {', '.join(bank.sources)}")
    clean = next(i for i in mine if bank.rows[i].never)
    forks = sorted((i for i in mine if not bank.rows[i].never), key=lambda i: bank.rows[i].since_ns)
    chosen = clean
    if forks:
        (apart,) = _separated(bank, forks[0], [clean])
        if not apart.beyond(probability):
            chosen = forks[0]
    since = bank.rows[chosen].since_ns
    rows = [row if i in mine else row._replace(since_ns=bank.t_ns) for i, row in enumerate(bank.rows)]
    rows[0] = Row("", since)
    m = len(rows)
    x, P = np.repeat(bank.x[chosen][None], m, axis=0), np.repeat(bank.P[chosen][None], m, axis=0)
    return bank._replace(rows=tuple(rows), x=x, P=P, excluded=(*bank.excluded, source))


def protection(bank: Bank, false_alarm: float, integrity_risk: float) -> Protection:
    """Compute the horizontal protection level with separations tested at `false_alarm` each.

    The risk is shared equally by the sources and the case without a fault; the probability of a fault is
    taken as 1. An excluded source's row equals the full solution, unless its earlier measurements were kept.
    """
    rows = [(i, r) for i, r in enumerate(bank.rows) if i and r.never]
    K_md = math.sqrt(threshold(integrity_risk / (1 + len(rows))))
    K_fa = math.sqrt(threshold(0.5 * false_alarm))
    fault_free = float(K_md * _sigma(bank.P[0, :2, :2]))
    level, by = fault_free, ""
    index = [i for i, _ in rows]
    sub = bank.P[index, :2, :2]
    d = np.hypot(*(bank.x[0, :2] - bank.x[index, :2]).T)
    levels = np.maximum(K_fa * _sigma(sub - bank.P[0, :2, :2] + FLOOR * np.eye(2)), d) + K_md * _sigma(sub)
    for (_, row), mine in zip(rows, levels.tolist(), strict=True):
        if mine > level:
            level, by = mine, row.without
    return Protection(level, integrity_risk, by, fault_free)


def admits(
    offset: Sequence[float], bound: Sequence[float], sigma: Sequence[float], refusal: float
) -> tuple[float, float]:
    """Compute the excess of a fix's `offset` from the guaranteed prediction, and its limit.

    `bound` are guaranteed r.m.s. bounds, `sigma` the fix's own, one number a component (m, m/s). Of second
    moments alone only Markov's inequality is known: the sum of offset^2 / (bound^2 + sigma^2) over n
    components has a mean of n at most and exceeds n / refusal with probability `refusal` at most, whatever
    the distribution of the errors.
    """
    found = sum(o * o / (b * b + s * s) for o, b, s in zip(offset, bound, sigma, strict=True))
    return found, len(offset) / refusal


def _separated(bank: Bank, full: int, subs: Sequence[int]) -> tuple[Separation, ...]:
    d, S = bank.x[full] - bank.x[subs], bank.P[subs] - bank.P[full]
    # lift position eigenvalues made negative by rounding or a rejected measurement to the floor
    eigenvalues, V = np.linalg.eigh(0.5 * (S + S.mT)[:, :2, :2])
    eigenvalues = np.maximum(eigenvalues, 0.0) + FLOOR
    along = (V.mT @ d[:, :2, None])[..., 0]
    position = (along**2 / eigenvalues).sum(axis=1)
    S2 = (V * eigenvalues[:, None, :]) @ V.mT
    # states may be metres and microradians: count only differences above rounding
    scale = np.sqrt(np.maximum(np.diagonal(bank.P[subs], axis1=1, axis2=2), np.finfo(float).tiny))
    eigenvalues, V = np.linalg.eigh(0.5 * (S + S.mT) / (scale[:, :, None] * scale[:, None, :]))
    counts = eigenvalues > ROUNDING
    along = (V.mT @ (d / scale)[..., None])[..., 0]
    statistic = np.where(counts, along**2 / np.where(counts, eigenvalues, 1.0), 0.0).sum(axis=1)
    rows = [bank.rows[i] for i in subs]
    numbers = position.tolist(), statistic.tolist(), counts.sum(axis=1).tolist()
    return tuple(Separation(*each) for each in zip(rows, d[:, :2], S2, *numbers, strict=True))


def _sigma(C: Floats) -> Floats:
    """Compute the square root of the greatest eigenvalue of C (..., 2, 2)."""
    a, b, c = C[..., 0, 0], C[..., 0, 1], C[..., 1, 1]
    out: Floats = np.sqrt(np.maximum(0.5 * (a + c) + np.hypot(0.5 * (a - c), b), 0.0))
    return out
