"""OutputComparison of replayed outputs with those of the flight: bit for bit, or within a tolerance.

The last bits of a result depend on the processor, the BLAS kernel and the versions of numpy and scipy (see
`storage.run_metadata`). On the platform of the flight outputs are compared bit for bit. Elsewhere positions
must agree to 1 mm and other numbers to 1e-6, relative above 1 and absolute below. Guaranteed bounds are the
result of a program that stops within a relative tolerance, so they agree to that.
"""

from __future__ import annotations

import math
import re
from itertools import zip_longest
from typing import Any

from companion.estimate.predictor import RESTRICTED_TOLERANCE
from companion.nav.geometry import Geodetic, separation
from companion.records import Solution, Stamped

POSITION_M = 1e-3
RELATIVE = 1e-6
BOUNDS = frozenset({"bound_n", "velocity_bound_n", "bounds", "ahead", "disagreement"})
TOLERANCE = f"{1e3 * POSITION_M:g} mm, {RELATIVE:g} relative, bounds {RESTRICTED_TOLERANCE:g}"
SHOWN = 300  # characters of the first difference
ANGLES = frozenset({"lat", "lon"})  # compared as a distance
NUMBER = re.compile(r"\d+(\.\d+)?")


class OutputComparison:
    """Pairs of outputs compared so far: exactly, or with the tolerance of this module."""

    def __init__(self, exact: bool) -> None:
        self.exact = exact
        self.compared = self.different = 0
        self.first: str | None = None
        self.apart_m = 0.0

    def add(self, flown: list[Stamped], now: list[Stamped]) -> None:
        """Compare the outputs of one input, in order, and empty both lists."""
        for then, again in zip_longest(flown, now):
            self.compared += 1
            apart = _distance(then, again)
            self.apart_m = max(self.apart_m, apart)
            if then != again and (self.exact or apart > POSITION_M or not _close_records(then, again)):
                self.different += 1
                self.first = self.first or _describe(then, again)
        flown.clear()
        now.clear()


def _distance(a: Stamped | None, b: Stamped | None) -> float:
    if not isinstance(a, Solution) or not isinstance(b, Solution):
        return 0.0
    north, east, _ = separation(Geodetic(a.lat, a.lon, 0.0), Geodetic(b.lat, b.lon, 0.0))
    return math.hypot(north, east)


def _close_records(a: Any, b: Any, relative: float = RELATIVE) -> bool:
    if type(a) is not type(b):
        return False
    return all(
        _close(getattr(a, name), getattr(b, name), RESTRICTED_TOLERANCE if name in BOUNDS else relative)
        for name in a.__struct_fields__
        if name not in ANGLES
    )


def _close(a: Any, b: Any, relative: float) -> bool:
    if isinstance(a, float) and isinstance(b, float):
        return abs(a - b) <= relative * max(1.0, abs(a))
    if isinstance(a, tuple) and isinstance(b, tuple):
        return len(a) == len(b) and all(_close(x, y, relative) for x, y in zip(a, b, strict=True))
    if hasattr(a, "__struct_fields__"):
        return _close_records(a, b, relative)
    if isinstance(a, str) and isinstance(b, str):
        return NUMBER.sub("", a) == NUMBER.sub("", b)
    return bool(a == b)


def _describe(then: Any, again: Any) -> str:
    """Describe how two outputs differ: by the fields that differ, if both are of one kind."""
    if type(then) is not type(again):
        return f"in flight {_shortened(str(then), SHOWN // 2)}, now {_shortened(str(again), SHOWN // 2)}"
    pairs = ((name, getattr(then, name), getattr(again, name)) for name in then.__struct_fields__)
    apart = "; ".join(f"{name} in flight {a!r}, now {b!r}" for name, a, b in pairs if a != b)
    return _shortened(f"{type(then).__name__}, t_ns {then.t_ns}: {apart}")


def _shortened(text: str, most: int = SHOWN) -> str:
    return text if len(text) <= most else f"{text[:most]} ..."
