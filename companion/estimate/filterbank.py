"""Bank of parallel Kalman filters: one with all sources, and each other with all but one.

All have the same state, x = INS minus truth with the position errors north and east (m) first. The first
row is the full solution, which uses every source; each source has a *row* that uses all but that one. A row
may also be *forked* from the full solution and use all but its source from then on. The row "inertial" uses
everything and has process noise added. `integrity` interprets the differences of the rows.

A beacon's bias is one more state, a constant that walks slowly: estimated with the help of all other sources
and used when they are missing. The bank knows no clock, no records, and not what the other states mean.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from companion.estimate.fusion import CONE_OF_SILENCE
from companion.estimate.observations import Azimuth, Model, Range
from companion.units import Floats

INERTIAL = "inertial"


class Row(NamedTuple):
    """One solution: the source that it does not use, and since when; "" is the full one."""

    without: str
    since_ns: int
    never: bool = True  # it has not used its source before `since_ns` either


class Bank(NamedTuple):
    """Parallel solutions: m rows of means x (m, n) and covariances P (m, n, n), the full one first.

    The last len(biases) states are constant errors of the sources named there, in their measurements' unit.
    No row uses measurements of an `excluded` source.
    """

    t_ns: int
    rows: tuple[Row, ...]
    x: Floats
    P: Floats
    biases: tuple[str, ...] = ()
    excluded: tuple[str, ...] = ()

    @property
    def sources(self) -> tuple[str, ...]:
        """Return every source that has a row, in the order they were added."""
        return tuple(dict.fromkeys(row.without for row in self.rows[1:]))


class Measurement(NamedTuple):
    """Measurement by `source`: z (p,) = H (p, k) x + unit (p,) bias + N(0, R)."""

    source: str
    z: Floats
    H: Floats
    R: Floats
    unit: Floats | None = None


class Taken(NamedTuple):
    """Bank after a measurement; normalised innovation squared in the row that it fits best."""

    bank: Bank
    accepted: bool
    nis: float


def begin(t_ns: int, x: Floats, P: Floats) -> Bank:
    """Start with the full solution x (n,), P (n, n) alone, north and east position errors (m) first."""
    if x.ndim != 1 or len(x) < 2 or P.shape != (len(x), len(x)):
        raise ValueError(f"x has shape {x.shape} and P {P.shape}: give (n,) and (n, n), position first")
    return Bank(t_ns, (Row("", t_ns),), x[None].copy(), P[None].copy())


def join(bank: Bank, source: str, bias_sigma: float | None = None, forks: int = 0) -> Bank:
    """Add a source: the row that never uses it, `forks` rows for `fork`, and its bias as a state."""
    if not source or source in bank.sources:
        raise ValueError(f"source {source!r} cannot be added: give each source a unique name")
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


def leave(bank: Bank, source: str) -> Bank:
    """Remove the rows and the bias of `source`; what it contributed to the states remains."""
    kept = [i for i, row in enumerate(bank.rows) if i == 0 or row.without != source]
    x, P = bank.x[kept], bank.P[kept]
    if source in bank.biases:
        i = x.shape[1] - len(bank.biases) + bank.biases.index(source)
        x, P = np.delete(x, i, axis=1), np.delete(np.delete(P, i, axis=1), i, axis=2)
    biases, excluded = (
        tuple(name for name in names if name != source) for names in (bank.biases, bank.excluded)
    )
    return bank._replace(rows=tuple(bank.rows[i] for i in kept), x=x, P=P, biases=biases, excluded=excluded)


def carry(bank: Bank, t_ns: int, Phi: Floats, Q: Floats, loose: Floats, bias_walk: Floats) -> Bank:
    """Propagate all rows to `t_ns` by Phi (k, k), Q (k, k) of the states before the biases.

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
    """Update every row but the source's own with the measurement; none, if its NIS exceeds `limit` in all.

    One rejected by the full solution alone is used: the full solution may be the one that is wrong.
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
    """Compute the NIS in the full solution, whether the source is excluded or not."""
    return float(_innovations(bank, measurement)[4][0])


def sighted(source: str, z: Azimuth | Range, x: Floats, k: int) -> Measurement | None:
    """Linearise an azimuth or a range in the plane tangent at the INS (x east, y north) at the position
    given by `x`, whitened; None inside the beacon's cone of silence.
    """
    place = (-float(x[1]), -float(x[0]), 0.0)
    model = Model((z,), 3)
    if model.azimuths_above(place, CONE_OF_SILENCE):
        return None
    at = model.at(place)
    H = np.zeros((1, k))
    H[0, :2] = -at.J[0, 1], -at.J[0, 0]
    return Measurement(source, at.r + H[:, :2] @ x[:2], H, np.eye(1), np.array([1.0 / z.sigma]))


def fork(bank: Bank, index: int) -> Bank:
    """Restart row `index`, one of a source's forks, from the full solution."""
    if bank.rows[index].never:
        raise ValueError(f"row {index} never uses {bank.rows[index].without!r}: fork another")
    x, P = bank.x.copy(), bank.P.copy()
    x[index], P[index] = x[0], P[0]
    rows = list(bank.rows)
    rows[index] = rows[index]._replace(since_ns=bank.t_ns)
    return bank._replace(rows=tuple(rows), x=x, P=P)


def refuse(bank: Bank, source: str) -> Bank:
    """Exclude `source` from now on; nothing was used of it since its fault, so nothing is undone."""
    return bank._replace(excluded=(*bank.excluded, source))


def readmit(bank: Bank, source: str) -> Bank:
    """Re-admit `source`; its rows separate from the full solution from now on."""
    if source not in bank.excluded:
        raise ValueError(f"{source!r} is not excluded")
    rows, x, P = list(bank.rows), bank.x.copy(), bank.P.copy()
    for i, row in enumerate(rows):
        if row.without == source:
            rows[i], x[i], P[i] = row._replace(since_ns=bank.t_ns), x[0], P[0]
    left = tuple(name for name in bank.excluded if name != source)
    return bank._replace(rows=tuple(rows), x=x, P=P, excluded=left)


def widen(bank: Bank, factor: float) -> Bank:
    """Multiply every covariance: the claimed accuracy was proved wrong."""
    return bank._replace(P=bank.P * factor)


def is_sound(bank: Bank) -> bool:
    """Return whether all numbers are finite and no variance is negative."""
    variances = np.diagonal(bank.P, axis1=1, axis2=2)
    return bool(np.isfinite(bank.x).all() and np.isfinite(bank.P).all() and (variances >= 0.0).all())


def _innovations(bank: Bank, measurement: Measurement) -> tuple[Floats, Floats, Floats, Floats, Floats]:
    """Compute H of all states (p, n); of each row H P (m, p, n), S (m, p, p), innovation (m, p), NIS (m,)."""
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
