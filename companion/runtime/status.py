"""State of the navigation in one line, as an operator reads it."""

from __future__ import annotations

import math
from typing import NamedTuple

from companion.records import Solution, Source

FIXES = (Source.GNSS, Source.AZIMUTH, Source.RANGE)


class Status(NamedTuple):
    """State at one moment: lengths in m, `sources` the fixes that the position rests on, `missing` and `slow`
    the inputs that do not arrive, or not often enough."""

    connected: bool
    state: str
    mode: str | None = None
    sources: tuple[str, ...] = ()
    trust: str | None = None
    sigma: float | None = None
    protection: float | None = None
    guaranteed: float | None = None
    missing: tuple[str, ...] = ()
    slow: tuple[str, ...] = ()

    @classmethod
    def of(
        cls,
        solution: Solution | None,
        connected: bool,
        is_stale: bool,
        missing: tuple[str, ...],
        slow: tuple[str, ...] = (),
    ) -> Status:
        """Return the status for the last solution."""
        if solution is None or is_stale:
            return cls(connected, "no solution", missing=missing, slow=slow)
        sources = tuple(source.name for source in FIXES if source.name and source & solution.sources)
        trust = None if solution.trust is None else solution.trust.name.lower()
        sigma = math.sqrt(max(solution.covariance[0] + solution.covariance[3], 0.0))
        guaranteed = None if solution.bound_n is None else math.hypot(*solution.bound_n)
        lengths = sigma, solution.protection, guaranteed
        state, mode = solution.status_word, str(solution.mode)
        return cls(connected, state, mode, sources, trust, *lengths, missing, slow)

    def text(self) -> str:
        """Return the status in one line: at most 73 characters where not more than one input is missing.

        The inputs come last: where there are many, a terminal cuts them and not the lengths.
        """
        if not self.connected and self.trust is None:
            return "waiting for an autopilot"
        parts = [" ".join((self.state, self._fixes())).strip()]
        if not self.connected:
            parts.append("no autopilot")
        lengths = (("sigma", self.sigma), ("HPL", self.protection), ("bound", self.guaranteed))
        if known := [f"{name} {_metres(value)}" for name, value in lengths if value is not None]:
            parts.append(f"{' '.join(known)} m")
        if self.connected:
            parts += [f"no {name}" for name in self.missing] + [f"slow {name}" for name in self.slow]
        return ", ".join(parts)

    def _fixes(self) -> str:
        beacon = [name.lower() for name in self.sources if name != "GNSS"]
        gnss = ["GNSS"] if "GNSS" in self.sources else []
        return "+".join([*gnss, *(["beacon"] if len(beacon) > 1 else beacon)])


def _metres(value: float) -> str:
    return f"{value:.{1 if value < 9.95 else 0}f}"
