"""Settings of a bank: how many rows, when they are born, what a decision takes."""

from __future__ import annotations

import math
from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Settings:
    """How many rows there are and how they come and go.

    Parameters
    ----------
    rows : most rows after a reduction.
    birth_s : interval of births.
    jump_s : interval of births of the jumps that are born often.
    parents : rows that bear, heaviest first; 0 lets all rows bear.
    parent_floor : log weight above which the heaviest row of each family and grade bears too.
    class_floor : log weight below which a row is no longer kept for the sake of its class.
    level_parents : rows that bear because they set the protection level.
    surprise : normalised squared innovation per component of the leading row above which births take place at
        once, before the measurement is used: the onset is then exact.
    surprise_gap_s : sooner after births a surprise must be greater, by the square of the share passed.
    age_s, age_ratio : bins of age, the first and their ratio. The first is shorter than `birth_s`: the
        newborn, which have their whole prior, displace no onset of the scheduled births before, which has no
        evidence yet.
    merge_ratio : rows merge by moments if their weights differ by less than this factor.
    merge_distance : and their means by less than this many sigma (Mahalanobis).
    dropped : share of the weight that a reduction may drop beyond what classes and quotas keep.
    switch_h : rate at which a grade changes, 1/h.
    suspect, excluded, believed : thresholds of the probability that a source is false.
    hysteresis : the leading explanation changes once another is this many times heavier.
    risk : probability that the protection level may be exceeded: rows that set it then are kept. A level of
        another risk may be read off.
    """

    rows: int = 48
    birth_s: float = 5.0
    jump_s: float = 1.0
    parents: int = 3
    parent_floor: float = -14.0
    class_floor: float = -45.0
    level_parents: int = 1
    surprise: float = 12.0
    surprise_gap_s: float = 1.0
    age_s: float = 4.5
    age_ratio: float = 2.0
    merge_ratio: float = 3.0
    merge_distance: float = 1.0
    dropped: float = 1e-3
    switch_h: float = 1e-5
    suspect: float = 0.5
    excluded: float = 0.999
    believed: float = 0.1
    hysteresis: float = 9.0
    risk: float = 1e-7


DEFAULT = Settings()

EXHAUSTIVE = Settings(rows=10**9, parents=0, level_parents=0, surprise=math.inf, switch_h=0.0)
"""Every row bears and none is dropped: the exact posterior over all onsets (for small problems)."""
