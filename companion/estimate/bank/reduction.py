"""Reduction: which rows are kept, and where the weight of the others goes."""

from __future__ import annotations

import math

import numpy as np

from companion.estimate.bank.layout import NONE, Layout
from companion.estimate.bank.readout import level_rows
from companion.estimate.bank.settings import Settings
from companion.estimate.bank.state import Bank, families, normalised, picked
from companion.units import Floats


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
    rows = len(bank.L)
    if rows <= settings.rows:
        return bank._replace(P=_symmetric(bank.P))
    L, family = bank.L, families(bank)
    bins = np.floor(
        np.log(np.maximum((bank.t - bank.since) / settings.age_s, 0.1)) / math.log(settings.age_ratio) + 1.0
    ).clip(0.0)
    # ties (children of one parent) in an order that does not depend on where the rows stand
    ties = (bank.since, bank.scale, bank.event, family, np.round(-L, 9))
    order = np.lexsort(ties).tolist()
    # lies that may change their rate are a class of their own: they pay more, and must outlive what they beat
    bends = bank.noise.any(axis=1)
    if layout.accelerations[2].size:
        bends |= (bank.P[:, layout.accelerations[2], layout.accelerations[2]] > 0.0).any(axis=1)
    label = 2 * bank.event + bends
    keys = list(zip(family.tolist(), label.tolist(), bins.astype(int).tolist()))
    # lists: plain numbers are several times faster than elements of arrays
    logs, since, scales, grade = L.tolist(), bank.since.tolist(), bank.scale.tolist(), bank.grade.tolist()
    active = (bank.fault != NONE).sum(axis=1).tolist()
    faults = dict(zip(family.tolist(), bank.fault.tolist()))
    quota = {code: _quota(layout, fault) for code, fault in faults.items()}
    # rank of a row: 0 protected, 1 heaviest of its class, 2 oldest of its class, 3 and 4 others
    rank = [4] * rows
    oldest: dict[tuple[int, int, int], int] = {}
    whole = {0, keys[order[0]][0]}  # families that keep each grade and jump: nothing false, and the leading
    by_fault: set[int] = set()
    jumped: set[tuple[int, int]] = set()
    first_jump = layout.jump_event(0)
    by_scale: set[tuple[int, ...]] = set()
    graded: set[tuple[int, int]] = set()
    for i in order:
        key = keys[i]
        j = oldest.get(key)
        if j is None:
            rank[i] = 1
        if j is None or since[i] < since[j]:
            oldest[key] = i
        scale = (*key, scales[i])
        if key[2] <= 1 and scale not in by_scale:
            by_scale.add(scale)
            rank[i] = min(rank[i], 2)
        if key[0] not in by_fault and active[i] <= 1:
            by_fault.add(key[0])
            rank[i] = 0
        event = key[1] // 2
        may_jump = event >= first_jump and (
            logs[i] >= settings.class_floor or layout.jumps[event - first_jump].rate_h > 0.0
        )
        if may_jump and key[0] in whole and (key[0], event) not in jumped:
            jumped.add((key[0], event))
            rank[i] = 0
        beside = event >= first_jump and key[0] not in whole and active[i] == 1
        if rank[i] == 1 and beside and quota[key[0]] == len(layout.grades) + 1:
            rank[i] = 2
        alive = key[0] == 0 or logs[i] >= settings.class_floor
        if alive and (active[i] <= 1 or key[0] in whole) and (key[0], grade[i]) not in graded:
            graded.add((key[0], grade[i]))
            rank[i] = 0 if key[0] in whole else min(rank[i], 1)
    for i in oldest.values():
        rank[i] = min(rank[i], 2)
    log_risk = math.log(settings.risk)
    for i in range(rows):
        if rank[i] and active[i] > 1 and logs[i] < log_risk:
            rank[i] += 1
        if rank[i] and logs[i] < settings.class_floor:
            rank[i] = max(rank[i], 3)
    for i in level_rows(bank, layout, 3, settings.risk).tolist():
        rank[i] = 0
    # the rows that carry the weight, up to half of the room
    mass = np.cumsum(np.exp(L[order[: settings.rows // 2]]))
    for i, before in zip(order, (0.0, *mass.tolist())):
        if before < 1.0 - settings.dropped:
            rank[i] = 0
    # quotas: the rows of a family beyond its quota rank behind all others
    used = dict.fromkeys(quota, 0)
    for i in sorted(order, key=rank.__getitem__):
        f = keys[i][0]
        used[f] += 1
        if rank[i] and used[f] > quota[f]:
            rank[i] += 3
    kept = set(sorted(order, key=rank.__getitem__)[: settings.rows])
    return _merged(bank, sorted(kept), [i for i in order if i not in kept], keys, settings)


def _quota(layout: Layout, fault: list[int]) -> int:
    """Rows that the family of a row may hold before others come first."""
    active = [f for f in fault if f != NONE]
    if len(active) > 1:
        return 3
    if active:
        return max(layout.faults[active[0]].quota, len(layout.grades) + 1)
    return len(layout.grades) + sum(j.quota for j in layout.jumps) + 2


def _merged(
    bank: Bank, keep: list[int], dropped: list[int], keys: list[tuple[int, int, int]], settings: Settings
) -> Bank:
    """The rows `keep`; the weights of `dropped`, in this order, go where `reduce` states."""
    kept = picked(bank, keep)
    L, grade, noise = bank.L.tolist(), bank.grade.tolist(), bank.noise.tolist()
    x, P = kept.x, _symmetric(kept.P)
    place = {row: k for k, row in enumerate(keep)}
    by_key: dict[tuple[int, int, int], list[int]] = {}
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
