"""Solution separation: which source lies, and how far off its lie can have drawn the position.

One filter hears every source; beside it a *row* a source hears all but that one. All are Kalman filters over
the same state, x = INS minus truth with the position errors north and east (m) first. If the models are right
the full solution is optimal, its error is orthogonal to any difference of solutions, and so the separation

    d = x_full - x_sub   has the covariance   S = P_sub - P_full                        (Brown, McBurney 1988)

whatever they heard together. d' S^-1 d over all states is by how much the source's absence makes the data
more likely, whatever its lie: so the row that stands apart most names it, once the freedom of S is taken
off. A lie in position shows in the velocities and tilts that it taught long before it shows in position. A
row may also be *forked* from the full solution and hear all but its source from then on: the same law
holds, its separation accumulates over minutes what a slow drift adds, with an INS and beacons that were
calibrated up to the fork. A fault older than the fork is in the forked row too; the row that never heard
its source has none of it, and the protection level rests on that one.

The row "inertial" hears everything and has process noise added: a larger claimed P than its errors have, so
that S errs on the side of fewer alarms.

Horizontal protection level, for one faulty source at a time:

    |e_full| <= |d| + |e_sub| <= K_fa sigma(S) + K_md sigma(P_sub),  sigma(C) = sqrt(greatest eigenvalue),

with K = sqrt(-2 ln p), as a normal error in the plane leaves the circle K sigma with probability at most p.
While |d| is beyond its limit and nobody is accused yet, |d| itself stands in the place of the limit.
The second of two faults that overlap is seen only from the first's exclusion on: that one's row, which all
begin from again, may have heard the second.

It knows no clock, no records, and not what the other states mean. A beacon's bias is one more state, a
constant that walks slowly: learnt from all others while they are heard and used when they are not.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.special import chdtri

from .fusion import CONE_OF_SILENCE
from .observations import Azimuth, Model, Range

Floats = npt.NDArray[np.float64]

INERTIAL = "inertial"
#: Least variance of a separation (m^2), above rounding and linearisation. It must be small: beside GNSS a
#: beacon moves the full solution by centimetres, and by how many too many is what tells its bias.
FLOOR = 1e-6
ROUNDING = 1e-6  # of a row's variance: a difference of covariances below this is none


class Row(NamedTuple):
    """One solution: which source it has not heard since when; "" is the full one, which hears all."""

    without: str
    since_ns: int
    never: bool = True  # it has not heard its source before `since_ns` either


class Bank(NamedTuple):
    """The solutions side by side: m rows of means x (m, n) and covariances P (m, n, n), the full one first.

    The last len(biases) states are constant errors of the sources named there, in their measurements' unit.
    Nothing takes what an `excluded` source says.
    """

    t_ns: int
    rows: tuple[Row, ...]
    x: Floats
    P: Floats
    biases: tuple[str, ...] = ()
    excluded: tuple[str, ...] = ()

    @property
    def sources(self) -> tuple[str, ...]:
        """Every source that has a row, in the order they joined."""
        return tuple(dict.fromkeys(row.without for row in self.rows[1:]))


class Measurement(NamedTuple):
    """What `source` says of the states before the biases: z (p,) = H (p, k) x + unit (p,) bias + N(0, R)."""

    source: str
    z: Floats
    H: Floats
    R: Floats
    unit: Floats | None = None


class Taken(NamedTuple):
    """The bank after a measurement; normalised innovation squared in the row that it fits best."""

    bank: Bank
    accepted: bool
    nis: float


class Separation(NamedTuple):
    """Full minus row, north and east (m), its covariance (m^2); d' S^-1 d of the position alone, chi-square
    of two, and of all states, chi-square of `freedom`.
    """

    row: Row
    d: Floats
    S: Floats
    position: float
    statistic: float
    freedom: int

    def limit(self, probability: float) -> float:
        """Of `statistic`, passed with `probability` where nothing is wrong."""
        return float(chdtri(max(self.freedom, 1), probability))

    def beyond(self, probability: float) -> bool:
        """Whether one of both tests fails, half of `probability` each."""
        half = 0.5 * probability
        return self.position > threshold(half) or self.statistic > self.limit(half)


class Blame(NamedTuple):
    """The source that stands apart most, the limit of its statistic, and by how much less the next does:
    clear once `margin` is large.
    """

    source: str
    statistic: float
    limit: float
    margin: float
    lead: float  # over the next of those that measure, as a share of its own


class Protection(NamedTuple):
    """Horizontal protection level (m), exceeded with at most `probability`; `by` the source that sets it."""

    level: float
    probability: float
    by: str
    fault_free: float


def begin(t_ns: int, x: Floats, P: Floats) -> Bank:
    """The full solution x (n,), P (n, n) alone, north and east position errors (m) first."""
    if x.ndim != 1 or len(x) < 2 or P.shape != (len(x), len(x)):
        raise ValueError(f"x has shape {x.shape} and P {P.shape}: give (n,) and (n, n), position first")
    return Bank(t_ns, (Row("", t_ns),), x[None].copy(), P[None].copy())


def join(bank: Bank, source: str, bias_sigma: float | None = None, forks: int = 0) -> Bank:
    """With a new source: the row that never hears it, `forks` rows for `fork`, and its bias as a state."""
    if not source or source in bank.sources:
        raise ValueError(f"source {source!r} cannot join: give each source one name of its own")
    row = Row(source, bank.t_ns)
    rows = (*bank.rows, row, *(row._replace(never=False) for _ in range(forks)))
    x = np.concatenate((bank.x, np.repeat(bank.x[:1], 1 + forks, axis=0)))
    P = np.concatenate((bank.P, np.repeat(bank.P[:1], 1 + forks, axis=0)))
    if bias_sigma is None:
        return bank._replace(rows=rows, x=x, P=P)
    m, n = x.shape
    wider = np.zeros((m, n + 1, n + 1))
    wider[:, :n, :n] = P
    wider[:, n, n] = bias_sigma**2
    x = np.concatenate((x, np.zeros((m, 1))), axis=1)
    return bank._replace(rows=rows, x=x, P=wider, biases=(*bank.biases, source))


def carry(bank: Bank, t_ns: int, Phi: Floats, Q: Floats, loose: Floats, bias_walk: Floats) -> Bank:
    """All rows at `t_ns` by Phi (k, k), Q (k, k) of the states before the biases.

    `loose` (k,) are the variances added to the row "inertial", and to all while the inertial channel is
    excluded; `bias_walk` (len(biases),) those added to every bias.
    """
    k, n = len(Phi), bank.x.shape[1]
    F, noise = np.eye(n), np.zeros((n, n))
    F[:k, :k], noise[:k, :k] = Phi, Q
    noise[range(k, n), range(k, n)] = bias_walk
    P = F @ bank.P @ F.T + noise
    for i, row in enumerate(bank.rows):
        if row.without == INERTIAL or INERTIAL in bank.excluded:
            P[i, range(k), range(k)] += loose
    return bank._replace(t_ns=t_ns, x=bank.x @ F.T, P=0.5 * (P + P.mT))


def take(bank: Bank, measurement: Measurement, limit: float) -> Taken:
    """Every row but the source's own with the measurement; none, if its NIS is beyond `limit` in all.

    One refused by the full solution alone is taken: it may be the full solution that was drawn off.
    """
    wide, HP, S, nu, nis_of_rows = _innovations(bank, measurement)
    hears = np.array([row.without != measurement.source for row in bank.rows])
    nis = float(np.min(nis_of_rows[hears]))
    if measurement.source in bank.excluded or not nis <= limit:
        return Taken(bank, False, nis)
    K = np.linalg.solve(S, HP).mT
    K[~hears] = 0.0
    J = np.eye(bank.x.shape[1]) - K @ wide
    P = J @ bank.P @ J.mT + K @ measurement.R @ K.mT
    x = bank.x + (K @ nu[:, :, None])[:, :, 0]
    return Taken(bank._replace(x=x, P=0.5 * (P + P.mT)), True, nis)


def surprise(bank: Bank, measurement: Measurement) -> float:
    """Normalised innovation squared in the full solution, whether the source is excluded or not."""
    return float(_innovations(bank, measurement)[4][0])


def sighted(source: str, z: Azimuth | Range, x: Floats, k: int) -> Measurement | None:
    """An azimuth or a range in the plane tangent at the INS (x east, y north), linearised where `x` has the
    aircraft, whitened; None inside the beacon's cone of silence.
    """
    place = (-float(x[1]), -float(x[0]), 0.0)
    model = Model((z,), 3)
    if model.above(place, CONE_OF_SILENCE):
        return None
    at = model.at(place)
    H = np.zeros((1, k))
    H[0, :2] = -at.J[0, 1], -at.J[0, 0]
    return Measurement(source, at.r + H[:, :2] @ x[:2], H, np.eye(1), np.array([1.0 / z.sigma]))


def separations(bank: Bank) -> tuple[Separation, ...]:
    """Every row's separation in position from the full solution."""
    return _separated(bank, 0, range(1, len(bank.rows)))


def threshold(probability: float) -> float:
    """Limit of a separation's statistic, passed with `probability` where nothing is wrong."""
    if not 0.0 < probability < 1.0:
        raise ValueError(f"probability {probability} of a false alarm: give one between 0 and 1")
    return -2.0 * math.log(probability)


def blame(found: tuple[Separation, ...], probability: float) -> Blame | None:
    """The source whose row stands apart most, if any is beyond its limit of this `probability`.

    `margin` is twice the logarithm of the likelihood by which it explains the data better than the next
    source does, each less its freedom: ask for `threshold(p)` of it to accuse the wrong one with
    probability p.
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


def fork(bank: Bank, index: int) -> Bank:
    """Row `index`, one of a source's forks, begun again from the full solution."""
    if bank.rows[index].never:
        raise ValueError(f"row {index} never hears {bank.rows[index].without!r}: fork another")
    return _copied(bank, 0, index, bank.rows[index]._replace(since_ns=bank.t_ns))


def exclude(bank: Bank, source: str, probability: float) -> Bank:
    """Without `source` from now on, and without what it has done.

    The full solution is taken from the source's oldest fork if that agrees with the row that never heard it
    (it is taken for disagreeing with this `probability` though it does not), else from this one; all others,
    which heard it, begin again from there.
    """
    mine = [i for i, row in enumerate(bank.rows) if row.without == source]
    if not mine:
        raise ValueError(f"no row is without {source!r}: there are {', '.join(bank.sources)}")
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


def refuse(bank: Bank, source: str) -> Bank:
    """Without `source` from now on: nothing was taken of it since it went wrong, so nothing is undone."""
    return bank._replace(excluded=(*bank.excluded, source))


def readmit(bank: Bank, source: str) -> Bank:
    """With `source` heard again; its rows part from the full solution now."""
    if source not in bank.excluded:
        raise ValueError(f"{source!r} is not excluded")
    rows, x, P = list(bank.rows), bank.x.copy(), bank.P.copy()
    for i, row in enumerate(rows):
        if row.without == source:
            rows[i], x[i], P[i] = row._replace(since_ns=bank.t_ns), x[0], P[0]
    left = tuple(name for name in bank.excluded if name != source)
    return bank._replace(rows=tuple(rows), x=x, P=P, excluded=left)


def shift(bank: Bank, north: float, east: float) -> Bank:
    """After the inertial channel itself jumped by (north, east) m: every solution's error jumped with it."""
    x = bank.x.copy()
    x[:, :2] += north, east
    return bank._replace(x=x)


def widen(bank: Bank, factor: float) -> Bank:
    """With every covariance multiplied: what the solutions claimed was proved wrong."""
    return bank._replace(P=bank.P * factor)


def protection(bank: Bank, false_alarm: float, integrity_risk: float) -> Protection:
    """The horizontal protection level with separations tested at `false_alarm` each.

    The risk is shared equally by the sources and the case without a fault; that a fault is there counts as
    certain. An excluded source's row is the full solution's equal, unless what it said before was kept.
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
    """How far a fix's `offset` from the guaranteed prediction goes beyond what is guaranteed, and the limit.

    `bound` are guaranteed r.m.s. bounds, `sigma` the fix's own, one number a component (m, m/s). Of second
    moments alone nothing more than Markov's inequality is known: the sum of offset^2 / (bound^2 + sigma^2)
    over n components has a mean of n at most and is beyond n / refusal with probability `refusal` at most,
    however the errors are distributed.
    """
    found = sum(o * o / (b * b + s * s) for o, b, s in zip(offset, bound, sigma, strict=True))
    return found, len(offset) / refusal


def is_sound(bank: Bank) -> bool:
    """Whether the numbers are numbers and no variance is negative."""
    variances = np.diagonal(bank.P, axis1=1, axis2=2)
    return bool(np.isfinite(bank.x).all() and np.isfinite(bank.P).all() and (variances >= 0.0).all())


def _innovations(bank: Bank, measurement: Measurement) -> tuple[Floats, Floats, Floats, Floats, Floats]:
    """H of all states (p, n); of each row H P (m, p, n), S (m, p, p), innovation (m, p) and its NIS (m,)."""
    source, z, H, R, unit = measurement
    n, p = bank.x.shape[1], len(z)
    k = n - len(bank.biases)
    if H.shape != (p, k) or R.shape != (p, p):
        raise ValueError(f"{source}: H has shape {H.shape} and R {R.shape}: give {(p, k)} and {(p, p)}")
    wide = np.zeros((p, n))
    wide[:, :k] = H
    if unit is not None and source in bank.biases:
        wide[:, k + bank.biases.index(source)] = unit
    HP = wide @ bank.P
    S = HP @ wide.T + R
    nu = z - bank.x @ wide.T
    weighted = np.linalg.solve(S, nu[:, :, None])[:, :, 0]
    return wide, HP, S, nu, (nu * weighted).sum(axis=1)


def _separated(bank: Bank, full: int, subs: Sequence[int]) -> tuple[Separation, ...]:
    d, S = bank.x[full] - bank.x[subs], bank.P[subs] - bank.P[full]
    # what rounding or a refused measurement has made negative in position is lifted to the floor
    eigenvalues, V = np.linalg.eigh(0.5 * (S + S.mT)[:, :2, :2])
    eigenvalues = np.maximum(eigenvalues, 0.0) + FLOOR
    along = (V.mT @ d[:, :2, None])[..., 0]
    position = (along**2 / eigenvalues).sum(axis=1)
    S2 = (V * eigenvalues[:, None, :]) @ V.mT
    # metres and microradians: only what the row knows less by more than rounding counts
    scale = np.sqrt(np.maximum(np.diagonal(bank.P[subs], axis1=1, axis2=2), np.finfo(float).tiny))
    eigenvalues, V = np.linalg.eigh(0.5 * (S + S.mT) / (scale[:, :, None] * scale[:, None, :]))
    counts = eigenvalues > ROUNDING
    along = (V.mT @ (d / scale)[..., None])[..., 0]
    statistic = np.where(counts, along**2 / np.where(counts, eigenvalues, 1.0), 0.0).sum(axis=1)
    rows = [bank.rows[i] for i in subs]
    numbers = position.tolist(), statistic.tolist(), counts.sum(axis=1).tolist()
    return tuple(Separation(*each) for each in zip(rows, d[:, :2], S2, *numbers, strict=True))


def _sigma(C: Floats) -> Floats:
    """Square root of the greatest eigenvalue of C (..., 2, 2)."""
    a, b, c = C[..., 0, 0], C[..., 0, 1], C[..., 1, 1]
    out: Floats = np.sqrt(np.maximum(0.5 * (a + c) + np.hypot(0.5 * (a - c), b), 0.0))
    return out


def _copied(bank: Bank, source: int, target: int, row: Row) -> Bank:
    x, P = bank.x.copy(), bank.P.copy()
    x[target], P[target] = x[source], P[source]
    return bank._replace(x=x, P=P, rows=(*bank.rows[:target], row, *bank.rows[target + 1 :]))
