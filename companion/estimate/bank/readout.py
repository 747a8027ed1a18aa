"""Read-offs: estimate, probabilities, decisions with hysteresis, and the protection level."""

from __future__ import annotations

import numpy as np

from companion.estimate.bank.layout import Ints, Layout
from companion.estimate.bank.protection import exceedance, level
from companion.estimate.bank.settings import DEFAULT, Settings
from companion.estimate.bank.state import Bank, false_rows, families
from companion.estimate.kalman import Gaussian
from companion.units import Floats


def explanations(bank: Bank, layout: Layout) -> Ints:
    """Return the code of each row's explanation: its family, and a recent jump that stands apart.

    A jump explains any disagreement at once. Within the family it would lead as soon as the rows without it
    have lost their weight, although a false source is the likelier explanation.

    Parameters
    ----------
    bank, layout : the bank.

    Returns
    -------
    (R,) codes; 0 is "nothing false, no such jump".
    """
    code = families(bank) * (len(layout.jumps) + 1)
    for j, jump in enumerate(layout.jumps):
        if jump.apart_s > 0.0:
            code += (j + 1) * ((bank.event == layout.jump_event(j)) & (bank.t - bank.since < jump.apart_s))
    return code


def decide(bank: Bank, layout: Layout, settings: Settings = DEFAULT) -> Bank:
    """Advance the decisions that have hysteresis: leading explanation, excluded sources. Call after updates.

    Parameters
    ----------
    bank, layout : the bank.
    settings : thresholds and hysteresis.

    Returns
    -------
    Bank : with `leading` and `excluded` renewed.
    """
    p = false_probability(bank, layout)
    excluded = np.where(bank.excluded, p >= settings.believed, p > settings.excluded)
    w, code = bank.weights, explanations(bank, layout)
    for s, source in enumerate(layout.sources):
        is_silent = bank.t - bank.seen[s] > source.silence_s
        if source.presumed and not excluded[s] and not is_silent:
            w[false_rows(bank, layout, s)] = 0.0
    totals: dict[int, float] = {}
    for c, v in zip(code.tolist(), w.tolist()):
        totals[c] = totals.get(c, 0.0) + v
    best = max(totals, key=lambda c: totals[c])
    leading = bank.leading
    if totals[best] > settings.hysteresis * totals.get(leading, 0.0):
        leading = best
    return bank._replace(leading=leading, excluded=excluded)


def estimate(bank: Bank, layout: Layout) -> Gaussian:
    """Return the moments of the leading explanation (see `decide`), the spread of its rows' means included.

    Those of the heaviest row if it has no rows left.

    Parameters
    ----------
    bank, layout : the bank.

    Returns
    -------
    Gaussian : of all states.
    """
    w = _leading_weights(bank, layout)
    mean = w @ bank.x
    d = (bank.x - mean) * np.sqrt(w)[:, None]
    n = len(mean)
    P = (w @ bank.P.reshape(len(w), -1)).reshape(n, n) + d.T @ d
    return Gaussian(mean, P)


def _leading_weights(bank: Bank, layout: Layout) -> Floats:
    """Weights of the rows of the leading explanation, their sum 1; the heaviest row's if it has none."""
    w = np.where(explanations(bank, layout) == bank.leading, bank.weights, 0.0)
    total = float(w.sum())
    if total == 0.0:
        w[int(np.argmax(bank.L))] = total = 1.0
    w = np.where(w > 1e-9 * total, w, 0.0)
    out: Floats = w / w.sum()
    return out


def false_probability(bank: Bank, layout: Layout) -> Floats:
    """Return the probability that each source is false now.

    Parameters
    ----------
    bank, layout : the bank.

    Returns
    -------
    (sources,) probabilities.
    """
    w = bank.weights
    out = np.zeros(len(layout.sources))
    for s in range(len(out)):
        out[s] = float(w[false_rows(bank, layout, s)].sum())
    return out


def grade_probability(bank: Bank, layout: Layout) -> Floats:
    """Return the probability of each grade.

    Parameters
    ----------
    bank, layout : the bank.

    Returns
    -------
    (grades,) probabilities.
    """
    out: Floats = np.bincount(bank.grade, bank.weights, len(layout.grades)).astype(np.float64)
    return out


def protection_level(
    bank: Bank, layout: Layout, risk: float | None = None, about: Floats | None = None
) -> float:
    """Return the radius that the position error exceeds with probability `risk` at most.

    The least r with sum_i w_i P(|x_i - x_hat + e_i| > r) <= risk, e_i of covariance P_i.

    Parameters
    ----------
    bank, layout : the bank.
    risk : probability, 1e-7 by default.
    about : (2,) the position that is sent; the estimate by default.

    Returns
    -------
    float : radius, in the unit of the position states.
    """
    d, C = about_estimate(bank, layout, about)
    return level(bank.weights, d, C, DEFAULT.risk if risk is None else risk)


def about_estimate(bank: Bank, layout: Layout, about: Floats | None = None) -> tuple[Floats, Floats]:
    """Return the rows' positions relative to the estimate.

    Parameters
    ----------
    bank, layout : the bank.
    about : (2,) another centre.

    Returns
    -------
    (R, 2) means and (R, 2, 2) covariances.
    """
    at = list(layout.position)
    centre = (_leading_weights(bank, layout) @ bank.x)[at] if about is None else about
    return bank.x[:, at] - centre, bank.P[:, at][:, :, at]


def level_rows(bank: Bank, layout: Layout, count: int, risk: float) -> Ints:
    """Return the rows that contribute most to the risk at the protection level.

    Parameters
    ----------
    bank, layout : the bank.
    count : number of rows.
    risk : probability.

    Returns
    -------
    (count,) indices of rows.
    """
    d, C = about_estimate(bank, layout)
    w = bank.weights
    r = level(w, d, C, risk)
    return np.argsort(-w * exceedance(r, d, C))[:count]
