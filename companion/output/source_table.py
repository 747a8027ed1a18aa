"""Which position the autopilot may fly by, GNSS or ours: one table of named predicates. No I/O.

A companion that takes an aircraft off a healthy GNSS does harm. So set 2 (our position) is required only
while our position goes out, and only if the receiver itself has no fix, or GNSS is false by the posterior, a
beacon contradicts it and the autopilot does not fly by its other receiver: never because innovations were
rejected. Set 1 (GNSS) is required whenever the receiver has a fix that is not held false, also when there is
no solution.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

from companion.estimate.bank.settings import DEFAULT

GNSS_SET, COMPANION_SET = 1, 2
NO_FIX_S, SILENT_S = 2.0, 3.0  # the receiver reports no fix, or nothing, for so long
STEADY_S = 3.0  # our position has gone out without a gap for so long
FIX_S = 5.0  # the receiver has had a fix for so long
STOPPED_S = 2.0  # our position has not gone out for so long
FALSE, BELIEVED = DEFAULT.excluded, DEFAULT.believed  # probability that GNSS is false, as in the navigator


class Situation(NamedTuple):
    """Facts that decide the source set; durations in s, -1 where the condition does not hold."""

    fix_s: float  # the receiver has had a fix
    no_fix_s: float  # the receiver has reported no fix
    silent_s: float  # nothing was received from a receiver that was, nor a fix of the other
    gnss_false: float | None  # probability, None without a recent solution
    witness: bool  # a beacon is received and believed, and itself contradicts GNSS
    sent_s: float  # our position has gone out
    stopped_s: float  # our position has not gone out, after it did
    by_other: bool = False  # the autopilot flies by a receiver that is not the one in use


class Predicate(NamedTuple):
    """A condition with its name and the reason that it gives."""

    name: str
    holds: Callable[[Situation], bool]
    reason: str


def is_held_false(s: Situation) -> bool:
    """Whether the GNSS that the autopilot flies by is false beyond doubt, and a beacon contradicts it."""
    return s.gnss_false is not None and s.gnss_false > FALSE and s.witness and not s.by_other


USING = ", using companion"  # left out where a set is needed but not requested
GNSS_LOST = Predicate("no fix", lambda s: s.no_fix_s >= NO_FIX_S, "GNSS is lost" + USING)
#: Set 2 needs our position and one of these.
TO_COMPANION = (
    GNSS_LOST,
    Predicate("receiver silent", lambda s: s.silent_s >= SILENT_S, "GNSS receiver silent" + USING),
    Predicate("GNSS false", is_held_false, "GNSS is false" + USING),
)
#: Set 1 needs a fix and one of these.
TO_GNSS = (
    Predicate(
        "GNSS believed",
        lambda s: s.fix_s >= FIX_S and (s.gnss_false is None or s.gnss_false < BELIEVED),
        "GNSS has a fix",
    ),
    Predicate(
        "companion stopped",
        lambda s: s.stopped_s >= STOPPED_S and not is_held_false(s),
        "no companion position",
    ),
)


def required_set(s: Situation) -> tuple[int, str] | None:
    """Return the source set that must lead and the reason; None where the present one stays."""
    if s.sent_s >= STEADY_S:
        for predicate in TO_COMPANION:
            if predicate.holds(s):
                return COMPANION_SET, predicate.reason
    if s.fix_s >= 0.0:
        for predicate in TO_GNSS:
            if predicate.holds(s):
                return GNSS_SET, predicate.reason
    return None
