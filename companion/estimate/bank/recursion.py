"""Recursion of a bank: all rows are propagated and updated as one batch of Kalman filters.

The weight of a row is multiplied by the likelihood of its innovation. A row that holds the source to be false
sees the source's lie in the measurement: its columns of H are filled in here.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from companion.estimate.bank.branching import births, returns
from companion.estimate.bank.layout import NEVER, Angle, Bools, Layout
from companion.estimate.bank.reduction import reduce
from companion.estimate.bank.settings import DEFAULT, Settings
from companion.estimate.bank.state import Bank, false_rows, normalised
from companion.units import Floats

LOG_2PI = math.log(2.0 * math.pi)

Measurement = tuple[Floats, Floats]
"""z (R, m) and H (R, m, k), linearised for each row."""

#: A mean so near to the centre has no direction; the variance of an angle that is known (rad^2), of the
#: measurement of the radius, and of a cosine that is known: of a small angle it is taken for 1. A row without
#: a direction is none of an angle where the square of its radius is further off, in variances.
LEAST_RADIUS, ANGLE_KNOWN, RADIUS_NOISE, RADIUS_KNOWN, NO_ANGLE = 0.3, 0.1, 1e-4, 1e-6, 9.0


class Innovation(NamedTuple):
    """What an update saw, per row of the bank that was updated, children included.

    Attributes
    ----------
    S : (R, m, m) covariances of the innovations.
    nis : (R,) normalised squared innovations.
    born : whether births took place before the update.
    refused : (R,) whether the row took the measurement for an outlier.
    leading : the heaviest row after the update.
    """

    S: Floats
    nis: Floats
    born: bool
    refused: Bools
    leading: int


def propagate(bank: Bank, layout: Layout, dt: float, Phi: Floats, Q: Floats) -> Bank:
    """Propagate all rows by dt seconds: x = Phi x, P = Phi P Phi' + Q, offsets += rates dt.

    Parameters
    ----------
    bank, layout : the bank.
    dt : s.
    Phi : (k, k) transition; k is n_base or n. With n the caller may let a lie feed base states; the motion of
        the lies themselves is filled in here.
    Q : process noise, (k, k) for all or (grades, k, k) by grade.

    Returns
    -------
    Bank : at t + dt.
    """
    R, n = bank.x.shape
    F = _padded(layout, Phi, dt)
    P = _transformed(bank.P, F)
    i, j = np.nonzero(Q.any(axis=0) if Q.ndim == 3 else Q)
    flat = P.reshape(R, -1)
    flat[:, i * n + j] += Q[:, i, j][bank.grade] if Q.ndim == 3 else Q[i, j]
    if len(layout.rates):
        flat[:, (n + 1) * layout.rates] += bank.noise * dt
    return bank._replace(t=bank.t + dt, x=bank.x @ F.T, P=P)


def _transformed(P: Floats, F: Floats) -> Floats:
    """F P F' of all rows. Most states only decay: the others' rows of F are multiplied alone."""
    decay = F.diagonal()
    mixed = np.flatnonzero((F - np.diag(decay)).any(axis=1))
    Fm = F[mixed]
    FmP = Fm @ P
    across = FmP * decay
    across[:, :, mixed] = FmP @ Fm.T
    out: Floats = P * np.outer(decay, decay)
    out[:, mixed] = across
    out[:, :, mixed] = across.transpose(0, 2, 1)
    return out


def _padded(layout: Layout, Phi: Floats, dt: float) -> Floats:
    """Phi over all states, the lies moving on by their rates."""
    k, n = len(Phi), layout.n
    F = np.zeros((n, n))
    F[:k, :k] = Phi
    lies = np.arange(layout.n_base, n)
    F[lies, lies] = 1.0
    times = layout.rate_correlation_times
    F[layout.rates, layout.rates] = np.exp(-dt / times)
    F[layout.offsets, layout.rates] = -times * np.expm1(-dt / times)
    if layout.accelerations[0].size:
        offsets, rates, accelerations = layout.accelerations
        F[offsets, accelerations] = 0.5 * dt * dt
        F[rates, accelerations] = dt
    return F


def update(
    bank: Bank,
    layout: Layout,
    z: Floats | Callable[[Bank], Measurement],
    H: Floats | None,
    R: Floats,
    source: int | None,
    settings: Settings = DEFAULT,
    outlier: float = NEVER,
    rare: float = math.inf,
    has_lie: bool = False,
) -> tuple[Bank, Innovation]:
    """Update all rows by one measurement z = H x + lie + white noise, and reweight them.

    The first measurement of a source after silence bears "captured" children first; a measurement far from
    the leading row bears children at once. Rows are reduced after the measurement has judged the children: a
    newborn is too light to be kept before. Births in flight are `births`, on the caller's clock. A row for
    which the measurement is less likely than an outlier does not use it and pays the price of one.

    Parameters
    ----------
    bank, layout : the bank, propagated to the time of the measurement.
    z : (m,) for all rows, or a function of the bank that returns z (R, m) and H (R, m, k): a measurement that
        is nonlinear, or that depends on the hypothesis.
    H : (m, k) for all rows; k is n_base or n. The lie's columns are filled in here, unless `has_lie`. None
        where z is a function.
    R : (m, m) covariance of the white noise.
    source : index of the source, None for a measurement that cannot be false.
    settings : births on return and on surprise.
    outlier : log density of a measurement that has nothing to do with its quantity, prior included.
    rare : log of that prior. Where the heaviest row itself expects the measurement over a wider place than
        `outlier` is spread over, outliers are spread as widely: nothing would be taken after a long silence.

    Returns
    -------
    Bank, Innovation

    Raises
    ------
    ValueError : a covariance is not positive definite, or z is no number.
    """
    born = False

    def innovations(bank: Bank) -> _Step:
        z_rows, H_rows = z(bank) if callable(z) else (z, H)
        assert H_rows is not None
        if not np.isfinite(z_rows).all():
            raise ValueError("measurement is not a number")
        return _innovations(bank, layout, z_rows, H_rows, R, None if has_lie else source)

    if source is not None and bank.t - bank.seen[source] > layout.sources[source].silence_s:
        bank, born = returns(bank, layout, source, settings)
    step = innovations(bank)
    passed = min((bank.t - bank.born_t) / settings.surprise_gap_s, 1.0)  # since births
    nis = float(step.nis[int(np.argmax(bank.L))]) * passed**2
    may_bear = source is not None and not born and settings.surprise < math.inf
    if may_bear and nis > settings.surprise * step.S.shape[-1]:
        bank = births(bank, layout, settings, reduced=False)
        born = True
        step = innovations(bank)
    heaviest = int(np.argmax(bank.L))
    outlier = min(outlier, float(step.log_likelihood[heaviest] + 0.5 * step.nis[heaviest]) + rare)
    refused = step.log_likelihood < outlier
    G, white = step.G, step.white
    if refused.any():
        taken = np.where(refused, 0.0, 1.0)
        G, white = G * taken[:, None, None], white * taken[:, None]
    P = G @ G.transpose(0, 2, 1).copy()  # of a view, numpy's symmetric product takes three times as long
    np.subtract(bank.P, P, out=P)  # 0.8 MB: another array would push the rest of the flight out of the cache
    x = bank.x + (G @ white[:, :, None])[:, :, 0]
    L = normalised(bank.L + np.maximum(step.log_likelihood, outlier))
    seen = bank.seen
    if source is not None:
        seen = seen.copy()
        seen[source] = bank.t
    bank = bank._replace(L=L, x=x, P=P, seen=seen)
    seen_by = Innovation(step.S, step.nis, born, refused, int(np.argmax(L)))
    return (reduce(bank, layout, settings) if born else bank), seen_by


def on_circle(bank: Bank, angle: Angle) -> Bank:
    """Update by sine^2 + cosine^2 = 1, linearised, the rows that know the angle but not its radius.

    Without it a radius of 0.6 is as good as an angle. Where the angle is spread along its arc the mean is
    within the circle. A mean near the centre has no direction: the square of its radius, to second order,
    moves nothing, and costs weight only where it fits no angle.

    Parameters
    ----------
    bank, angle : the bank, and an angle of it.

    Returns
    -------
    Bank
    """
    s, v = angle
    rows = np.flatnonzero(bank.P[:, v, v] > RADIUS_KNOWN)
    sine, cosine = bank.x[rows, s], 1.0 - bank.x[rows, v]
    radius = np.maximum(np.hypot(sine, cosine), LEAST_RADIUS)
    us, uc = sine / radius, cosine / radius
    Ps, Psc, Pc = bank.P[rows, s, s], -bank.P[rows, s, v], bank.P[rows, v, v]
    along = uc * uc * Ps - 2.0 * us * uc * Psc + us * us * Pc
    known = (radius > LEAST_RADIUS) & (along < ANGLE_KNOWN)
    second = 1.0 - sine * sine - cosine * cosine - Ps - Pc
    expected = 4.0 * (sine * sine * Ps + 2.0 * sine * cosine * Psc + cosine * cosine * Pc)
    expected += 2.0 * (Ps * Ps + 2.0 * Psc * Psc + Pc * Pc) + RADIUS_NOISE
    no_angle = ~known & (second * second > NO_ANGLE * expected)
    if not (known | no_angle).any():
        return bank
    across = us * us * Ps + 2.0 * us * uc * Psc + uc * uc * Pc
    innovation = 1.0 - 0.5 * along - radius
    precision = np.where(known, 1.0 / (across + 0.5 * along * along + RADIUS_NOISE), 0.0)
    x, P, L = bank.x.copy(), bank.P.copy(), bank.L.copy()
    PHt = us[:, None] * P[rows, :, s] - uc[:, None] * P[rows, :, v]
    x[rows] += PHt * (precision * innovation)[:, None]
    P[rows] -= PHt[:, :, None] * PHt[:, None] * precision[:, None, None]
    L[rows] -= 0.5 * np.where(no_angle, second * second / expected, precision * innovation * innovation)
    return bank._replace(x=x, P=P, L=normalised(L))


class _Step(NamedTuple):
    """Per row: covariance S of the innovation, S^-1/2 times it, P H' S^-T/2, NIS, log likelihood.

    Beyond the components of the innovation `white` and `G` are zero.
    """

    S: Floats
    white: Floats
    G: Floats
    nis: Floats
    log_likelihood: Floats


def _innovations(bank: Bank, layout: Layout, z: Floats, H: Floats, R: Floats, source: int | None) -> _Step:
    """Innovations and square-root gains of all rows; P - G G' is the posterior covariance."""
    rows, n = bank.x.shape
    m, k = H.shape[-2:]
    if H.ndim == 2:
        HT = np.zeros((n, m))
        HT[:k] = H.T
        PHt = (bank.P.reshape(-1, n) @ HT).reshape(rows, n, m)
        nu = z - bank.x @ HT
    else:
        HT = np.zeros((rows, n, m))
        HT[:, :k] = H.transpose(0, 2, 1)
        PHt = bank.P @ HT
        nu = z - (bank.x[:, None, :] @ HT)[:, 0]
    lie, false = None, None
    if source is not None:
        false = false_rows(bank, layout, source)
        if false.any():
            lie = layout.lie_states(source)
            a, b = int(lie[0]), int(lie[-1]) + 1
            mask = false.astype(np.float64)
            PHt = PHt + mask[:, None, None] * bank.P[:, :, a:b]
            nu = nu - mask[:, None] * bank.x[:, a:b]
    PHt_T = PHt.transpose(0, 2, 1)
    S = PHt_T @ HT
    if lie is not None:
        S += mask[:, None, None] * PHt_T[:, :, a:b]
    S += R
    # lower triangular root of S, in closed form for one and two components
    if m <= 2:
        s00 = S[:, 0, 0]
        if not s00.min() > 0.0:
            raise ValueError("covariance not positive definite")
        r0 = np.sqrt(s00)
        # of one component the second stays zero: BLAS takes five times as long for one column as for two
        white, G = np.zeros((rows, 2)), np.zeros((rows, n, 2))
        white[:, 0] = nu[:, 0] / r0
        np.divide(PHt[:, :, 0], r0[:, None], out=G[:, :, 0])
        log_root = np.log(r0)
        if m == 2:
            c = S[:, 1, 0] / r0
            s11 = S[:, 1, 1] - c * c
            if not s11.min() > 0.0:
                raise ValueError("covariance not positive definite")
            r1 = np.sqrt(s11)
            white[:, 1] = (nu[:, 1] - c * white[:, 0]) / r1
            G[:, :, 1] = (PHt[:, :, 1] - c[:, None] * G[:, :, 0]) / r1[:, None]
            log_root = log_root + np.log(r1)
    else:
        try:
            root = np.linalg.cholesky(S)
        except np.linalg.LinAlgError:
            raise ValueError("covariance not positive definite") from None
        white = np.linalg.solve(root, nu[:, :, None])[:, :, 0]
        G = np.linalg.solve(root, PHt_T).transpose(0, 2, 1)
        log_root = np.log(np.diagonal(root, axis1=1, axis2=2)).sum(axis=1)
        if not np.isfinite(log_root).all():  # LAPACK accepts NaN
            raise ValueError("covariance not positive definite")
    nis = (white * white).sum(axis=1)
    return _Step(S, white, G, nis, -0.5 * (nis + m * LOG_2PI) - log_root)
