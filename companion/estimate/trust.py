"""Trust in the position as a state with hysteresis: worse immediately, better only after a settling time.

A pure fold over evidence. It does not know sources by name or any estimator.
"""

from __future__ import annotations

from typing import NamedTuple

from companion.records import Trust


class Evidence(NamedTuple):
    """Evidence at one instant; lengths in m, None where there is none."""

    fixes: bool  # a trusted radio fix not older than its timeout
    suspicion: bool  # a source excluded, or a separation beyond its limit that names none clearly
    protection: float | None  # horizontal protection level
    bound: float | None  # guaranteed r.m.s. bound, both axes together


class Limits(NamedTuple):
    """Alert limits (m), the share of them required for a better state, and the settling time (s)."""

    protection: float = 500.0
    bound: float = 5000.0
    clear: float = 0.8
    settle_s: float = 10.0


class Held(NamedTuple):
    """Trust state, its start, and the start of uninterrupted evidence for a better one."""

    trust: Trust
    since_ns: int
    better_ns: int | None = None


def judge(evidence: Evidence, limits: Limits, share: float = 1.0) -> Trust:
    """Judge the evidence of one instant alone, with both limits multiplied by `share`."""
    if evidence.fixes:
        safe = evidence.protection is not None and evidence.protection <= share * limits.protection
        return Trust.NORMAL if safe and not evidence.suspicion else Trust.DEGRADED
    if evidence.bound is None or evidence.bound > share * limits.bound:
        return Trust.UNTRUSTED
    return Trust.PREDICTING


def turn(held: Held, t_ns: int, evidence: Evidence, limits: Limits) -> Held:
    """Update the state to `t_ns`: a worse one immediately; a better one after `settle_s` of uninterrupted
    evidence within the limits times their share.
    """
    now = judge(evidence, limits)
    if now > held.trust:
        return Held(now, t_ns)
    cleared = judge(evidence, limits, limits.clear)
    if cleared >= held.trust:
        return held if held.better_ns is None else held._replace(better_ns=None)
    if held.better_ns is None:
        return held._replace(better_ns=t_ns)
    if (t_ns - held.better_ns) * 1e-9 < limits.settle_s:
        return held
    return Held(cleared, t_ns)
