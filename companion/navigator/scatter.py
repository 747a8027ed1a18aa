"""How much noisier a source is than it states, by the scatter of its own measurements.

With r a measurement minus that of the nominal trajectory, for three successive ones at equal distances

    d = (r2 - 2 r1 + r0) / sqrt(6),  E d^2 = R + w,  w = (a dt^2)^2 / 6

R is the variance of white noise. An offset, a rate and the slow errors of the channel are not in d: neither a
spoofed GNSS nor a poor INS changes it; a is what the nominal trajectory's acceleration may lack. The mean of
d^2 / (R + w), later surprises clipped, is a factor of the variance, and is used where it is above one (of
honest noise 1.05 in the mean). A source that states too little would otherwise be explained by one lie after
another, and excluded: a healthy GNSS 1.3 times as noisy as it stated was, in aerobatics. Its first
measurements, of which no scatter is known yet, are taken as noisy.

The velocity of a receiver is far better than it states: it states 0.4 to 0.6 m/s, and over 2 to 20 s its
velocities agree with its positions to 0.10 to 0.04 m/s (UMN); 1.1 to 1.6 m/s, with a scatter of 0.15 m/s (a
copter). So its factor may be below one too, where the nominal trajectory is inertial.
"""

from __future__ import annotations

import math
from typing import NamedTuple

SILENT_S = 5.0  # after a longer silence the differences start again
UNEQUAL = 1.5  # of two distances
CLIPPED = 6.0  # times the factor that is used: a source far quieter than it states may become noisy at once
FIRST, LAST = 4, 40  # measurements that the mean remembers, at the start and later
SLOW = 1.5  # times the scatter of a velocity is its sigma: what lasts for seconds is not in its scatter
UNKNOWN, UNKNOWN_FOR = 9.0, 6  # factor before the sixth measurement, which has four differences
MOST = 100.0
NOISY, QUIET = 4.0, 1.44  # a source is noisy once the factor is above the one until it is below the other
LACKING = {"ins": 0.0, "imu": 1.0}  # m/s^2, by what moves the nominal trajectory
LACKING_ELSE = 3.0


class Scatter(NamedTuple):
    """Time and residual of the last measurement, distance (s) and residual of the one before; the factor, of
    how many differences, whether it is great, and the number of measurements up to `UNKNOWN_FOR`.
    """

    t_ns: int
    last: tuple[float, ...]
    dt: float = 0.0
    before: tuple[float, ...] | None = None
    factor: float = 1.0
    many: int = 0
    noisy: bool = False
    seen: int = 1

    @property
    def used(self) -> float:
        """Factor by which the stated variance is enlarged, at least 1."""
        return max(self.factor, UNKNOWN if self.seen < UNKNOWN_FOR else 1.0)

    @property
    def quiet(self) -> float:
        """Share of the stated sigma of a velocity that is used, once its scatter is known well."""
        return min(SLOW * math.sqrt(self.factor), 1.0) if self.many == LAST - FIRST else 1.0


def observe(s: Scatter | None, t_ns: int, r: tuple[float, ...], variance: float, a: float) -> Scatter:
    """Return the scatter with one more residual r, its stated variance, and a (unit of r / s^2)."""
    if s is None:
        return Scatter(t_ns, r)
    dt = (t_ns - s.t_ns) * 1e-9
    if dt <= 0.0:
        return s
    s = s._replace(seen=min(s.seen + 1, UNKNOWN_FOR))
    if dt >= SILENT_S:
        return s._replace(t_ns=t_ns, last=r, dt=0.0, before=None)
    if s.before is None or not 1.0 / UNEQUAL < dt / s.dt < UNEQUAL:
        return s._replace(t_ns=t_ns, last=r, dt=dt, before=s.last)
    squares = sum((r2 - 2.0 * r1 + r0) ** 2 for r0, r1, r2 in zip(s.before, s.last, r, strict=True)) / 6.0
    ratio = squares / len(r) / (variance + (a * dt * dt) ** 2 / 6.0)
    many = min(s.many + 1, LAST - FIRST)
    most = CLIPPED * s.used if s.many >= FIRST else MOST  # at the start the fixes themselves give the scale
    factor = s.factor + (min(ratio, most) - s.factor) / (FIRST + many)
    noisy = factor > (QUIET if s.noisy else NOISY)
    return s._replace(t_ns=t_ns, last=r, dt=dt, before=s.last, factor=factor, many=many, noisy=noisy)
