"""State of the navigation in one line, as an operator reads it."""

from __future__ import annotations

import math
from typing import NamedTuple

from companion.records import Solution, Source

FIXES = (Source.GNSS, Source.AZIMUTH, Source.RANGE)


class Status(NamedTuple):
    """State at one moment: lengths in m, `sources` the fixes that the position rests on."""

    connected: bool
    mode: str
    sources: tuple[str, ...] = ()
    trust: str | None = None
    sigma: float | None = None
    protection: float | None = None
    guaranteed: float | None = None
    missing: tuple[str, ...] = ()

    @classmethod
    def of(
        cls, solution: Solution | None, connected: bool, is_stale: bool, missing: tuple[str, ...]
    ) -> Status:
        """Return the status for the last solution."""
        if solution is None or is_stale:
            return cls(connected, "no solution", missing=missing)
        sources = tuple(source.name for source in FIXES if source.name and source & solution.sources)
        trust = None if solution.trust is None else solution.trust.name.lower()
        sigma = math.sqrt(max(solution.covariance[0] + solution.covariance[3], 0.0))
        guaranteed = None if solution.bound_n is None else math.hypot(*solution.bound_n)
        lengths = sigma, solution.protection, guaranteed
        return cls(connected, str(solution.mode), sources, trust, *lengths, missing)

    def text(self) -> str:
        """Return the status in one line of less than 80 characters where nothing is missing."""
        if not self.connected and self.trust is None:
            return "waiting for an autopilot"
        parts = [" ".join((self.mode, "+".join(self.sources))).strip()]
        if self.trust not in (None, self.mode):
            parts.append(f"trust {self.trust}")
        lengths = (("sigma", self.sigma), ("protection", self.protection), ("guaranteed", self.guaranteed))
        parts += [
            f"{name} {value:.{1 if value < 10.0 else 0}f} m" for name, value in lengths if value is not None
        ]
        if not self.connected:
            parts.append("autopilot silent")
        if self.missing:
            parts.append(f"missing: {', '.join(self.missing)}")
        return ", ".join(parts)
