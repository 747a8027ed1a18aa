"""Births and deaths: children of the rows, each with one event more than its parent, at the prior rate.

A child is born when a fault may have started, changed or ended, when base states may have jumped, when the
amplitude of the noise may be another, and when a source returns after silence.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from companion.estimate.bank.layout import NEVER, NONE, Ints, Jump, Layout, Lie
from companion.estimate.bank.readout import level_rows
from companion.estimate.bank.reduction import reduce
from companion.estimate.bank.settings import DEFAULT, Settings
from companion.estimate.bank.state import Bank, families, normalised, picked
from companion.units import Floats

HOUR_S = 3600.0


class _Child(NamedTuple):
    """A row to be born: parent, log of the prior, what changes."""

    parent: int
    log_prior: float
    fault: int = NONE
    lie: Lie | None = None
    lie_of: int = NONE  # the fault whose lie it is: another than `fault` where that is of two
    scale: int = 0
    ends: bool = False
    undone: tuple[int, ...] = ()
    jump: int = NONE
    grade: int = NONE


def births_due(bank: Bank, settings: Settings = DEFAULT) -> bool:
    """Report whether `births` is due.

    Parameters
    ----------
    bank : at the present time.
    settings : interval of births.

    Returns
    -------
    bool : whether the interval has passed since the last births.
    """
    return bank.t - bank.born_t >= settings.birth_s


def births(
    bank: Bank,
    layout: Layout,
    settings: Settings = DEFAULT,
    rate_factor: dict[int, float] | None = None,
    reduced: bool = True,
) -> Bank:
    """Bear children for what may have started or ended since the last births, and reduce the rows.

    Faults of a silent source are frozen: they neither begin nor end. Grades change while a source is heard.

    Parameters
    ----------
    bank, layout, settings : the bank.
    rate_factor : factor on the prior rate by fault, e.g. 100 while the receiver itself reports jamming.
    reduced : False leaves all rows to the caller, whose measurement judges them first.

    Returns
    -------
    Bank : with at most `settings.rows` rows if reduced.
    """
    hours = (bank.t - bank.born_t) / HOUR_S
    if hours <= 0.0:
        return bank
    factor = rate_factor or {}
    parents = _parents(bank, layout, settings)
    heard = heard_sources(bank, layout)
    children: list[_Child] = []
    for p in parents:
        for f, fault in enumerate(layout.faults):
            if not all(heard[s] for s in fault.sources):
                continue
            now = bank.fault[p, layout.fault_group(f)]
            if now == NONE:
                rate = fault.rate_h * factor.get(f, 1.0)
                children += _lie_children(int(p), f, fault.lies, rate * hours)
            elif now == f:
                children.append(_Child(int(p), _log(min(fault.death_h * hours, 0.5)), f, ends=True))
                children += _lie_children(int(p), f, fault.lies, fault.change_h * hours)
            elif (both := layout.joint.get((int(now), f))) is not None:  # the second of two is added
                second = _lie_children(int(p), f, fault.lies, fault.rate_h * factor.get(f, 1.0) * hours)
                children += [child._replace(fault=both) for child in second]
        children += [_jump_child(bank, layout, int(p), j) for j in range(len(layout.jumps))]
    if any(heard):
        children += _grade_children(bank, layout, settings, hours)
    grown = _with_children(bank, layout, children)
    grown = grown._replace(born_t=bank.t, jumped_t=bank.t)
    return reduce(grown, layout, settings) if reduced else grown


def jump_births_due(bank: Bank, layout: Layout, settings: Settings = DEFAULT) -> bool:
    """Report whether `jump_births` is due.

    Parameters
    ----------
    bank, layout, settings : the bank at the present time.

    Returns
    -------
    bool : whether there are jumps that are born often, and their interval has passed.
    """
    return bank.t - bank.jumped_t >= settings.jump_s and any(jump.often for jump in layout.jumps)


def jump_births(bank: Bank, layout: Layout, settings: Settings = DEFAULT) -> Bank:
    """Bear the children of jumps that are born often, where that is due; rows are reduced at the next births.

    Parameters
    ----------
    bank, layout, settings : the bank.

    Returns
    -------
    Bank : with a child of the heaviest row of each grade more for each such jump.
    """
    if not jump_births_due(bank, layout, settings):
        return bank
    often = [j for j, jump in enumerate(layout.jumps) if jump.often]
    heaviest = _heaviest_of_grades(bank)
    children = [_jump_child(bank, layout, p, j) for p in heaviest for j in often]
    return _with_children(bank, layout, children)._replace(jumped_t=bank.t)


def returns(bank: Bank, layout: Layout, source: int, settings: Settings) -> tuple[Bank, bool]:
    """Bear "captured" children at the first measurement of a source after silence; report whether any.

    A row that held the source to be false before keeps it so, and gets children whose lie is redrawn.

    Parameters
    ----------
    bank, layout, settings : the bank before the measurement.
    source : index of the source that was silent.

    Returns
    -------
    Bank, bool : the bank to be updated, not yet reduced, and whether children were born.
    """
    children: list[_Child] = []
    for p in _parents(bank, layout, settings):
        for f, fault in enumerate(layout.faults):
            if source not in fault.sources:
                continue
            now = bank.fault[p, layout.fault_group(f)]
            if now == NONE:
                children += _lie_children(p, f, fault.first_lies, fault.first)
            elif now == f:
                children += _lie_children(p, f, fault.first_lies, 0.3)
    grown = _with_children(bank, layout, children)
    if len(grown.L) == len(bank.L):
        return bank, False
    return grown, True


def false_since_first(
    bank: Bank,
    layout: Layout,
    settings: Settings,
    lies: dict[int, tuple[Lie, ...]],
    prior: float,
    states: tuple[int, ...],
) -> Bank:
    """Bear children whose source was false by an offset that stood still since its first measurement.

    For a source that could not be doubted before. What it added about the base states is taken back: their
    sum with the lie, which was measured, stays known, and each alone becomes as unknown as the lie.

    Parameters
    ----------
    bank, layout, settings : the bank.
    lies : scales of the lie by fault.
    prior : probability of each fault.
    states : the base states that the source measures, in the order of its lie.

    Returns
    -------
    Bank : with at most `settings.rows` rows.
    """
    heaviest = _heaviest_of_grades(bank)
    children = [
        child._replace(undone=states)
        for f, scales in lies.items()
        for p in heaviest
        if bank.fault[p, layout.fault_group(f)] == NONE
        for child in _lie_children(p, f, scales, prior)
    ]
    return reduce(_with_children(bank, layout, children), layout, settings)


def jumped_before(bank: Bank, layout: Layout, prior: dict[int, float]) -> Bank:
    """Bear a child of every row for each of some jumps: what may have jumped before the start.

    Parameters
    ----------
    bank, layout : the bank as it starts.
    prior : probability by jump.

    Returns
    -------
    Bank : not reduced.
    """
    children = [_Child(p, _log(w), jump=j) for p in range(len(bank.L)) for j, w in prior.items()]
    return _with_children(bank, layout, children)


def _heaviest_of_grades(bank: Bank) -> list[int]:
    """The heaviest row of each grade."""
    heaviest: dict[int, int] = {}
    for i in np.argsort(-bank.L).tolist():
        heaviest.setdefault(int(bank.grade[i]), i)
    return list(heaviest.values())


def _lie_children(parent: int, fault: int, lies: tuple[Lie, ...], prior: float) -> list[_Child]:
    """Children of one parent for one fault, one for each scale of the lie."""
    total = sum(lie.share for lie in lies)
    return [
        _Child(parent, _log(prior * lie.share / total), fault, lie, fault, i) for i, lie in enumerate(lies)
    ]


def _jump_child(bank: Bank, layout: Layout, parent: int, jump: int) -> _Child:
    """Child of one parent that jumped since the last births of such children."""
    j = layout.jumps[jump]
    since = bank.jumped_t if j.often else bank.born_t
    again = bank.event[parent] == layout.jump_event(jump)
    rate_h = j.again_h if again and j.again_h is not None else j.rate_h
    return _Child(parent, _log(rate_h * (bank.t - since) / HOUR_S), jump=jump)


def _grade_children(bank: Bank, layout: Layout, settings: Settings, hours: float) -> list[_Child]:
    """The heaviest row of a family with another grade, where no row of it has that with a change's weight.

    Of the leading family, and of others where the child may bear in turn: where grades change often, the
    leading explanation would win by changing its grade alone.
    """
    if settings.switch_h <= 0.0 or len(layout.grades) < 2:
        return []
    family = families(bank)
    prior = _log(settings.switch_h * hours / (len(layout.grades) - 1))
    out: list[_Child] = []
    met: set[int] = set()
    for i in np.argsort(-bank.L).tolist():
        if met and bank.L[i] + prior < settings.parent_floor:
            break
        if int(family[i]) in met:
            continue
        met.add(int(family[i]))
        for g in range(len(layout.grades)):
            rows = (bank.grade == g) & (family == family[i])
            if g != bank.grade[i] and (not rows.any() or bank.L[rows].max() < bank.L[i] + prior):
                out.append(_Child(i, prior, grade=g))
    return out


def _parents(bank: Bank, layout: Layout, settings: Settings) -> list[int]:
    """Rows that bear: the heaviest, those of the level, and the heaviest of each family and grade."""
    order = np.lexsort((bank.since, bank.scale, bank.event, np.round(-bank.L, 9)))
    if settings.parents == 0:
        return [int(i) for i in order]
    chosen = [int(i) for i in order[: settings.parents]]
    chosen += [int(i) for i in level_rows(bank, layout, settings.level_parents, settings.risk)]
    met: set[tuple[int, int]] = set()
    for i, code, grade in zip(order, families(bank)[order].tolist(), bank.grade[order].tolist()):
        if bank.L[i] < settings.parent_floor:
            break
        if (code, grade) not in met:
            met.add((code, grade))
            chosen.append(int(i))
    return list(dict.fromkeys(chosen))


def heard_sources(bank: Bank, layout: Layout) -> list[bool]:
    """Return which sources are not silent.

    Parameters
    ----------
    bank, layout : the bank.

    Returns
    -------
    One boolean per source.
    """
    return [bank.t - bank.seen[i] <= s.silence_s for i, s in enumerate(layout.sources)]


def _log(p: float) -> float:
    return math.log(p) if p > 0.0 else NEVER


def _with_children(bank: Bank, layout: Layout, children: list[_Child]) -> Bank:
    """The bank with the possible children appended; each parent keeps the weight it did not give away."""
    children = [child for child in children if child.log_prior > NEVER]
    if not children:
        return bank
    rows = len(bank.L)
    at = np.concatenate((np.arange(rows), [c.parent for c in children]))
    prior = np.array([c.log_prior for c in children])
    given = np.zeros(rows)
    np.add.at(given, [c.parent for c in children], np.exp(prior))
    L = np.concatenate((bank.L + np.log1p(-np.minimum(given, 0.9)), bank.L[at[rows:]] + prior))
    grown = picked(bank, at)._replace(L=normalised(L))
    x, P, noise, since = grown.x, grown.P, grown.noise, grown.since
    grade, fault, event, scale = grown.grade, grown.fault, grown.event, grown.scale
    since[rows:] = bank.t
    F = len(layout.faults)
    alike: dict[tuple[object, ...], list[int]] = {}  # rows with the same change, of several parents
    for row, child in enumerate(children, rows):
        alike.setdefault(child[2:], []).append(row)
    for born in alike.values():
        c, i = children[born[0] - rows], np.array(born)
        if c.ends:
            g = layout.fault_group(c.fault)
            states = slice(layout.starts[g], layout.starts[g] + layout.sizes[g])
            x[i, states] = 0.0
            P[i, states, :] = 0.0
            P[i, :, states] = 0.0
            a = sum(layout.groups[:g])
            noise[i, a : a + layout.groups[g]] = 0.0
            fault[i, g], event[i], scale[i] = NONE, 1 + F + c.fault, 0
        elif c.lie is not None:
            index, variance, places, density = layout.lie_prior(c.lie_of, c.lie)
            for state, sigma in layout.faults[c.lie_of].shock:
                P[i, state, state] += sigma**2
            P[i[:, None], index, index] += variance
            for state, lie, s2 in zip(c.undone, index.tolist(), variance.tolist()):
                P[i, state, state] += s2
                P[i, state, lie] -= s2
                P[i, lie, state] -= s2
            noise[i[:, None], places] = density
            fault[i, layout.fault_group(c.fault)], event[i], scale[i] = c.fault, 1 + c.fault, c.scale
        elif c.jump != NONE:
            apply_jump(x, P, i, layout.jumps[c.jump])
            event[i] = layout.jump_event(c.jump)
        else:
            parent = at[i]
            grade[i], since[i], event[i] = c.grade, bank.since[parent], bank.event[parent]
    return grown


def apply_jump(x: Floats, P: Floats, rows: Ints, jump: Jump) -> None:
    """Let states jump, in place: more uncertain by its sigmas; its angle has the moments of the unit circle.

    Parameters
    ----------
    x, P : (R, n), (R, n, n) mean and covariance.
    rows : those that jump.
    jump : what jumps.

    Returns
    -------
    None
    """
    P[rows[:, None], jump.states, jump.states] += np.square(jump.sigma)
    if jump.angle is not None:
        both = np.array(jump.angle)
        x[rows[:, None], both] = 0.0, 1.0
        P[rows[:, None], both], P[rows[:, None], :, both] = 0.0, 0.0
        P[rows[:, None], both, both] = 0.5
