"""Output pace: when each message is due. Solutions come in any number, messages leave at their rates.

A message may leave before its time, right after a beacon fix, if that raises its mean rate by no more than
EARLY_SHARE: the time gained is taken from a budget that grows by this share of the elapsed time. So neither
frequent fixes nor a flood of forged ones changes the rate that the autopilot expects. No message leaves twice
with one time: ArduPilot drops the second.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from typing import NamedTuple

EARLY_SHARE = 0.05


class _Due(NamedTuple):
    at_ns: int  # next regular time
    last_ns: int  # time of the last message
    budget_ns: float  # by which messages may leave before their time


class Pace:
    """Times of the messages by name; the periods of those in `at_least` are never shortened."""

    def __init__(self, at_least: Collection[str] = ()) -> None:
        self._at_least = at_least
        self._due: dict[str, _Due] = {}

    def due(self, periods_ns: Mapping[str, int], t_ns: int, early: Collection[str]) -> list[str]:
        """Return the messages to send at `t_ns`; those in `early` may leave before their time."""
        found = []
        for name, period in periods_ns.items():
            at, last, budget = self._due.get(name, _Due(t_ns, t_ns, 0.0))
            at = min(at, last + period)  # the period was shortened
            missing = at - t_ns
            budget = min(budget + EARLY_SHARE * max(t_ns - last, 0), period)
            if missing > 0 and not (name in early and missing <= budget and t_ns > last):
                continue
            found.append(name)
            if missing > 0:
                start, budget = t_ns, budget - missing
            else:  # on time: keep the phase, but never more than one period behind
                start = t_ns if name in self._at_least else max(at, t_ns - period)
            self._due[name] = _Due(start + period, t_ns, budget)
        return found
