"""Trust in the position as a state with hysteresis: worse at once, better only after a while."""

from __future__ import annotations

from typing import NamedTuple

from companion.records import Trust


class Evidence(NamedTuple):
    """What is known at one instant; the protection level in m."""

    fixes: bool  # a radio fix that is believed, not older than its timeout
    suspicion: bool  # a source is suspect or excluded
    protection: float


class Limits(NamedTuple):
    """Limits of the protection level with fixes and without (m), the share of them below which a state is
    left for a better one, and for how long.
    """

    protection: float = 500.0
    coasting: float = 5000.0
    clear: float = 0.8
    settle_s: float = 10.0


class Held(NamedTuple):
    """The state, since when, and since when the evidence has been for a better one."""

    trust: Trust
    since_ns: int
    better_ns: int | None = None


def judge(evidence: Evidence, limits: Limits, share: float = 1.0) -> Trust:
    """Return the trust that the evidence of one instant justifies, the limits multiplied by `share`."""
    if evidence.fixes:
        safe = evidence.protection <= share * limits.protection
        return Trust.NORMAL if safe and not evidence.suspicion else Trust.DEGRADED
    return Trust.UNTRUSTED if evidence.protection > share * limits.coasting else Trust.PREDICTING


def turn(held: Held, t_ns: int, evidence: Evidence, limits: Limits) -> Held:
    """Return the state at `t_ns`: a worse one at once; a better one once evidence that clears the limits by
    their share has lasted `settle_s`.
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
