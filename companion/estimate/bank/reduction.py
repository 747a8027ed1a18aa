"""Reduction: which rows are kept, and where the weight of the others goes."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from companion.estimate.bank.layout import NONE, Layout
from companion.estimate.bank.readout import level_rows
from companion.estimate.bank.settings import Settings
from companion.estimate.bank.state import Bank, families, normalised, picked
from companion.units import Floats

PROTECTED, HEAVIEST, OLDEST, IMPROBABLE, OTHER = range(5)
"""Ranks: protected; the heaviest and the oldest of a class; below `class_floor` at best; others."""
BEYOND_QUOTA = 3  # behind all others


class _Key(NamedTuple):
    """Class of a row: its family, last event, whether the rate of its lie changes, and its bin of age."""

    family: int
    event: int
    bends: bool
    age: int


class _Rows(NamedTuple):
    """The rows as lists (plain numbers are several times faster than elements of arrays), and the quota of
    each family; `order` has the heaviest first, `active` counts faults.
    """

    order: list[int]
    keys: list[_Key]
    logs: list[float]
    since: list[float]
    scale: list[int]
    grade: list[int]
    active: list[int]
    quota: dict[int, int]


def reduce(bank: Bank, layout: Layout, settings: Settings) -> Bank:
    """Reduce the bank to `settings.rows` rows.

    Within a class (family, last event, whether the lie's rate changes, bin of age) the heaviest and the
    oldest row are kept first, in the young bins the heaviest of each scale, and of each family the heaviest
    of each grade: a family that has lost the right grade loses to one that has it. Protected are the rows
    that carry the weight, the heaviest of each fault, those that set the protection level, and, without a
    fault and in the leading family, the heaviest of each grade and of each jump; a jump that is not born any
    more only while it may still be so. A step of the heading kept beside a false GNSS only proves that; with
    one grade left beside a false range, GNSS was blamed for what a coarser INS explains. Two faults at once
    that are less probable than the risk stand behind: with an equal claim they held a third of the rows, and
    the onsets of a slow lie were lost. So do jumps beside a fault that does not lead, where the quota is the
    least: those of the wind held all of a range that stepped, no onset was left, and GNSS was blamed. A
    dropped row merges by moments with a row of its label if their weights are alike; else its weight goes to
    the heaviest of its class.

    Parameters
    ----------
    bank, layout : the bank after births.
    settings : number of rows, bins of age, limits of a merge.

    Returns
    -------
    Bank : with at most `settings.rows` rows; covariances made symmetric.
    """
    if len(bank.L) <= settings.rows:
        return bank._replace(P=_symmetric(bank.P))
    rows = _listed(bank, layout, settings)
    rank = _ranks(rows, layout, settings)
    for i in (*level_rows(bank, layout, 3, settings.risk).tolist(), *_carrying(rows, settings)):
        rank[i] = PROTECTED
    used = dict.fromkeys(rows.quota, 0)
    for i in sorted(rows.order, key=rank.__getitem__):
        family = rows.keys[i].family
        used[family] += 1
        if rank[i] and used[family] > rows.quota[family]:
            rank[i] += BEYOND_QUOTA
    best = sorted(rows.order, key=rank.__getitem__)
    keep, dropped = best[: settings.rows], set(best[settings.rows :])
    return _merged(bank, sorted(keep), [i for i in rows.order if i in dropped], rows.keys, settings)


def _listed(bank: Bank, layout: Layout, settings: Settings) -> _Rows:
    family = families(bank)
    bins = np.floor(
        np.log(np.maximum((bank.t - bank.since) / settings.age_s, 0.1)) / math.log(settings.age_ratio) + 1.0
    ).clip(0.0)
    # ties (children of one parent) in an order that does not depend on where the rows stand
    ties = (bank.since, bank.scale, bank.event, family, np.round(-bank.L, 9))
    # lies that may change their rate are a class of their own: they pay more, and must outlive what they beat
    bends = bank.noise.any(axis=1)
    if layout.accelerations[2].size:
        bends |= (bank.P[:, layout.accelerations[2], layout.accelerations[2]] > 0.0).any(axis=1)
    codes, events = family.tolist(), bank.event.tolist()
    return _Rows(
        order=np.lexsort(ties).tolist(),
        keys=list(map(_Key, codes, events, np.asarray(bends).tolist(), bins.astype(int).tolist())),
        logs=bank.L.tolist(),
        since=bank.since.tolist(),
        scale=bank.scale.tolist(),
        grade=bank.grade.tolist(),
        active=(bank.fault != NONE).sum(axis=1).tolist(),
        quota={code: _quota(layout, fault) for code, fault in dict(zip(codes, bank.fault.tolist())).items()},
    )


def _ranks(rows: _Rows, layout: Layout, settings: Settings) -> list[int]:
    """Return the rank of each row by its class, family, grade and jump; the lowest are kept."""
    order, keys, logs, active = rows.order, rows.keys, rows.logs, rows.active
    # a later entry of a dict replaces an earlier one: of each key the heaviest row remains, or the oldest
    lightest_first, family = order[::-1], [key.family for key in keys]
    youngest_first = sorted(order, key=rows.since.__getitem__)[::-1]
    rank = [OTHER] * len(keys)
    for i in {keys[i]: i for i in youngest_first}.values():
        rank[i] = OLDEST
    for i in {(keys[i], rows.scale[i]): i for i in lightest_first if keys[i].age <= 1}.values():
        rank[i] = OLDEST
    for i in {keys[i]: i for i in lightest_first}.values():
        rank[i] = HEAVIEST
    for i in {family[i]: i for i in lightest_first if active[i] <= 1}.values():
        rank[i] = PROTECTED
    whole = {0, family[order[0]]}  # families that keep each grade and jump: nothing false, and the leading
    first_jump, least = layout.jump_event(0), len(layout.grades) + 1
    jumped = [i for i in lightest_first if keys[i].event >= first_jump]
    for i in jumped:
        is_beside_a_fault = active[i] == 1 and family[i] not in whole
        if rank[i] == HEAVIEST and is_beside_a_fault and rows.quota[family[i]] == least:
            rank[i] = OLDEST
    living = {
        (family[i], keys[i].event): i
        for i in jumped
        if family[i] in whole
        and (logs[i] >= settings.class_floor or layout.jumps[keys[i].event - first_jump].rate_h > 0.0)
    }
    for i in living.values():
        rank[i] = PROTECTED
    graded = {
        (family[i], rows.grade[i]): i
        for i in lightest_first
        if (active[i] <= 1 or family[i] in whole) and (family[i] == 0 or logs[i] >= settings.class_floor)
    }
    for (code, _), i in graded.items():
        rank[i] = PROTECTED if code in whole else min(rank[i], HEAVIEST)
    log_risk = math.log(settings.risk)
    for i in order:
        if rank[i] and active[i] > 1 and logs[i] < log_risk:
            rank[i] += 1
        if rank[i] and logs[i] < settings.class_floor:
            rank[i] = max(rank[i], IMPROBABLE)
    return rank


def _carrying(rows: _Rows, settings: Settings) -> list[int]:
    """Return the rows that carry the weight, up to half of the room."""
    carrying, mass = [], 0.0
    for i in rows.order[: settings.rows // 2 + 1]:
        if mass >= 1.0 - settings.dropped:
            break
        carrying.append(i)
        mass += math.exp(rows.logs[i])
    return carrying


def _quota(layout: Layout, fault: list[int]) -> int:
    """Rows that the family of a row may hold before others come first."""
    active = [f for f in fault if f != NONE]
    if len(active) > 1:
        return 3
    if active:
        return max(layout.faults[active[0]].quota, len(layout.grades) + 1)
    return len(layout.grades) + sum(j.quota for j in layout.jumps) + 2


def _merged(bank: Bank, keep: list[int], dropped: list[int], keys: list[_Key], settings: Settings) -> Bank:
    """The rows `keep`; the weights of `dropped`, in this order, go where `reduce` states."""
    kept = picked(bank, keep)
    L, grade, noise = bank.L.tolist(), bank.grade.tolist(), bank.noise.tolist()
    x, P = kept.x, _symmetric(kept.P)
    place = {row: k for k, row in enumerate(keep)}
    by_key: dict[_Key, list[int]] = {}
    for i in keep:
        by_key.setdefault(keys[i], []).append(i)
    log_ratio = math.log(settings.merge_ratio)
    for i in dropped:
        if keys[i] not in by_key:
            continue
        near = by_key[keys[i]]
        alike = [
            j for j in near if abs(L[i] - L[j]) < log_ratio and grade[i] == grade[j] and noise[i] == noise[j]
        ]
        j = max(alike or near, key=L.__getitem__)
        k = place[j]
        if alike and _distance(bank.x[i] - x[k], P[k]) < settings.merge_distance:
            L[j], x[k], P[k] = merge_moments(L[i], bank.x[i], _symmetric(bank.P[i]), L[j], x[k], P[k])
        elif L[i] < L[j] + log_ratio:
            L[j] = float(np.logaddexp(L[i], L[j]))
    return kept._replace(L=normalised(np.array(L)[keep]), x=x, P=P)


def _symmetric(P: Floats) -> Floats:
    out: Floats = P + P.swapaxes(-1, -2)
    out *= 0.5
    return out


def _distance(d: Floats, P: Floats) -> float:
    """Largest deviation of d in units of the marginal sigmas."""
    variance = P.diagonal()
    used = variance > 0.0
    return math.sqrt(float((d[used] ** 2 / variance[used]).max())) if used.any() else 0.0


def merge_moments(
    La: float, xa: Floats, Pa: Floats, Lb: float, xb: Floats, Pb: Floats
) -> tuple[float, Floats, Floats]:
    """Merge two weighted Gaussians into one of the same weight, mean and covariance.

    Parameters
    ----------
    La, Lb : log weights.
    xa, xb : (n,) means.
    Pa, Pb : (n, n) covariances.

    Returns
    -------
    L, x, P : log weight, (n,) mean, (n, n) covariance.
    """
    L = float(np.logaddexp(La, Lb))
    a, b = math.exp(La - L), math.exp(Lb - L)
    d = xa - xb
    return L, a * xa + b * xb, a * Pa + b * Pb + (a * b) * np.outer(d, d)
