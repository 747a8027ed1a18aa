"""State of a bank: Gaussian hypotheses with weights and labels, and changes made by the caller."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from companion.estimate.bank.layout import FAULT_CODES, NEVER, NONE, Bools, Ints, Layout
from companion.units import Floats


class Bank(NamedTuple):
    """R hypotheses of n states at time t.

    Attributes
    ----------
    t : time, s.
    L : (R,) log weights, normalised.
    x, P : (R, n) means and (R, n, n) covariances.
    grade : (R,) index into the ladder of grades.
    fault : (R, groups) active fault per group of lie states, or NONE.
    event : (R,) what happened to the row last: 0 nothing, 1 + f fault f began, 1 + F + f it ended,
        1 + 2 F + j jump j, with F faults.
    since : (R,) time of that event, s.
    scale : (R,) index of the lie's scale at its birth.
    noise : (R, offsets) density of the lie rates' random walk.
    seen : (sources,) time of the last measurement.
    born_t, jumped_t : time of the last births, and of the last births of jumps that are born often.
    leading : code of the leading explanation, see `explanations`.
    excluded : (sources,) whether a source is excluded (with hysteresis).
    """

    t: float
    L: Floats
    x: Floats
    P: Floats
    grade: Ints
    fault: Ints
    event: Ints
    since: Floats
    scale: Ints
    noise: Floats
    seen: Floats
    born_t: float
    jumped_t: float
    leading: int
    excluded: Bools

    @property
    def weights(self) -> Floats:
        """(R,) weights, their sum is 1."""
        return np.exp(self.L)


def start(layout: Layout, t: float, x0: Floats, P0: Floats, prior: Sequence[float] | None = None) -> Bank:
    """Start a bank: one row per grade, nothing false.

    Parameters
    ----------
    layout : the states and faults.
    t : time, s.
    x0 : (n_base,) mean.
    P0 : (n_base, n_base) covariance, or (grades, n_base, n_base).
    prior : weight of each grade; falls by 2 a rung by default.

    Returns
    -------
    Bank : as many rows as grades.
    """
    k, n, nb = len(layout.grades), layout.n, layout.n_base
    w = np.asarray(prior if prior is not None else [0.5**i for i in range(k)], dtype=np.float64)
    x, P = np.zeros((k, n)), np.zeros((k, n, n))
    x[:, :nb], P[:, :nb, :nb] = x0, P0
    return Bank(
        t=t,
        L=np.log(w / w.sum()),
        x=x,
        P=P,
        grade=np.arange(k),
        fault=np.full((k, len(layout.groups)), NONE, dtype=np.int64),
        event=np.zeros(k, dtype=np.int64),
        since=np.full(k, t),
        scale=np.zeros(k, dtype=np.int64),
        noise=np.zeros((k, len(layout.offsets))),
        seen=np.full(len(layout.sources), NEVER),
        born_t=t,
        jumped_t=t,
        leading=0,
        excluded=np.zeros(len(layout.sources), dtype=np.bool_),
    )


def picked(bank: Bank, at: Sequence[int] | Ints | slice) -> Bank:
    """Return the bank with some of its rows, their weights as they were.

    Parameters
    ----------
    bank : the bank.
    at : indices of the rows; a row may come more than once.

    Returns
    -------
    Bank : with the rows in the order of `at`.
    """
    return bank._replace(
        L=bank.L[at],
        x=bank.x[at],
        P=bank.P[at],
        grade=bank.grade[at],
        fault=bank.fault[at],
        event=bank.event[at],
        since=bank.since[at],
        scale=bank.scale[at],
        noise=bank.noise[at],
    )


def families(bank: Bank) -> Ints:
    """Return the code of each row's set of active faults.

    Parameters
    ----------
    bank : the bank.

    Returns
    -------
    (R,) codes; 0 is "nothing false". They are the same with groups added behind.
    """
    code: Ints = (bank.fault + 1) @ FAULT_CODES ** np.arange(bank.fault.shape[1])
    return code


def false_rows(bank: Bank, layout: Layout, source: int) -> Bools:
    """Return which rows hold a source to be false.

    Parameters
    ----------
    bank, layout : the bank.
    source : index of the source.

    Returns
    -------
    (R,) booleans.
    """
    out: Bools = layout.concerns[:, source][bank.fault[:, layout.sources[source].group]]
    return out


def normalised(L: Floats) -> Floats:
    """Return log weights whose weights sum to 1.

    Parameters
    ----------
    L : (R,) log weights.

    Returns
    -------
    (R,) log weights.
    """
    L = L - L.max()
    out: Floats = L - math.log(float(np.exp(L).sum()))
    return out


def shift(bank: Bank, correction: Floats) -> Bank:
    """Add a known increment to the first states of all rows: feedback or a known jump.

    Parameters
    ----------
    bank : the bank.
    correction : (k,) increment of the first k states.

    Returns
    -------
    Bank : at the same time, with the same weights and covariances.
    """
    x = bank.x.copy()
    x[:, : len(correction)] += correction
    return bank._replace(x=x)


def inflate(bank: Bank, states: Sequence[int], sigma: float) -> Bank:
    """Add independent errors of one sigma to some states of all rows.

    Parameters
    ----------
    bank : the bank.
    states : indices of the states.
    sigma : one sigma of the error that is added to each, in the unit of the states.

    Returns
    -------
    Bank : with the same means and weights.
    """
    P = bank.P.copy()
    P[:, list(states), list(states)] += sigma**2
    return bank._replace(P=P)


def renew(bank: Bank, states: Sequence[int], sigma: Sequence[float]) -> Bank:
    """Forget some states of all rows: zero mean, independent, of the given sigmas.

    Parameters
    ----------
    bank : the bank.
    states : indices of the states.
    sigma : one sigma of each of them.

    Returns
    -------
    Bank : what is known of all other states, and the weights, are unchanged.
    """
    x, P, at = bank.x.copy(), bank.P.copy(), list(states)
    x[:, at] = 0.0
    P[:, at, :] = 0.0
    P[:, :, at] = 0.0
    P[:, at, at] = np.square(sigma)
    return bank._replace(x=x, P=P)


def enlarge(bank: Bank, old: Layout, new: Layout, variance: Floats) -> Bank:
    """Add base states of the given variances, and the sources, faults and groups that `new` has beyond `old`.

    Parameters
    ----------
    bank, old : the bank and its layout.
    new : the same sources, faults, groups and jumps first, in the same order.
    variance : (new.n_base - old.n_base,) of the states that are added behind the base states.

    Returns
    -------
    Bank : in the layout `new`.
    """
    rows, k = len(bank.L), new.n_base - old.n_base
    at = np.concatenate((np.arange(old.n_base), np.arange(old.n_base, old.n) + k))
    x, P = np.zeros((rows, new.n)), np.zeros((rows, new.n, new.n))
    x[:, at] = bank.x
    P[:, at[:, None], at] = bank.P
    added = np.arange(old.n_base, new.n_base)
    P[:, added, added] = variance
    more = len(new.sources) - len(old.sources)
    was, now = len(old.faults), len(new.faults)
    # codes of ends and jumps stand behind those of all faults
    event = bank.event + np.where(
        bank.event > 2 * was, 2 * (now - was), np.where(bank.event > was, now - was, 0)
    )
    groups, offsets = len(new.groups) - len(old.groups), len(new.offsets) - len(old.offsets)
    return bank._replace(
        x=x,
        P=P,
        fault=np.pad(bank.fault, ((0, 0), (0, groups)), constant_values=NONE),
        noise=np.pad(bank.noise, ((0, 0), (0, offsets))),
        event=event,
        seen=np.concatenate((bank.seen, np.full(more, NEVER))),
        excluded=np.concatenate((bank.excluded, np.zeros(more, dtype=np.bool_))),
    )


def is_sound(bank: Bank) -> bool:
    """Report whether all numbers are finite and no variance is negative.

    Parameters
    ----------
    bank : the bank.

    Returns
    -------
    bool : False after a numerical failure; the bank must then be started again.
    """
    n = bank.x.shape[1]
    diagonal = bank.P.reshape(len(bank.L), -1)[:, :: n + 1]
    return bool(np.isfinite(bank.L.sum() + bank.x.sum() + bank.P.sum()) and diagonal.min() >= -1e-9)
