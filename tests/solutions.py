"""Solutions for tests of what becomes of them."""

from __future__ import annotations

from typing import Any

from msgspec.structs import replace

from companion.records import Mode, Solution, Source

FIXED = Solution(
    t_ns=0,
    rx_ns=0,
    mode=Mode.FIXED,
    estimator="kalman",
    lat=1.0,
    lon=0.5,
    alt_msl=800.0,
    v_n=(0.0, 0.0, 0.0),
    covariance=(100.0, 0.0, 0.0, 100.0, 0.0, 25.0),
    error_n=(0.0, 0.0),
    velocity_error_n=(0.0, 0.0),
    sources=int(Source.INERTIAL | Source.GNSS),
    horizon_s=0.0,
)


def solution_at(t_ns: int, **changes: Any) -> Solution:
    """Return `FIXED` at a time, with other values."""
    return replace(FIXED, **{"t_ns": t_ns, "rx_ns": t_ns} | changes)
