"""Beacon witness: whether the beacons themselves contradict GNSS, without any channel between. No I/O.

A source set is a matter of the aircraft's safety, so "GNSS is false" is not left to the navigator alone: its
channels are models (flown on ArduPlane: a turn in turbulence was taken for a GNSS that drifts). Here every
azimuth and range is compared with the one that the GNSS fix of the same instant predicts. The mean of the
last `WINDOW_NS` must differ from the earlier mean, of when GNSS was believed, by more than `SIGMAS` of both
means: a constant error of the beacon cancels. An answer that came before counts once, as in the navigator: a
network that sends all twice would make the mean look surer than it is. At 60 km (131 m across) 2 m/s are seen
after 45 s (at most 75 s), and a healthy GNSS is contradicted 0.03 % of the time.
"""

from __future__ import annotations

import math
from collections import deque

from companion.nav.geometry import Geodetic, displace, slant_range_azimuth, wrap_angle
from companion.navigator.fix_observations import displaced_sigma
from companion.navigator.stale_data import StaleDataDetector
from companion.records import Gnss, RsbnFix
from companion.units import SECOND_NS

WINDOW_NS = 20 * SECOND_NS
SIGMAS = 3.0
LEAST = 10  # fixes in the window
MOST = 300  # fixes that the earlier mean remembers
APART_S = 1.0  # a GNSS fix further from the beacon's time predicts nothing
MOST_TRACKS = 128  # two of each beacon
FIXES, FIXES_APART_NS = 128, SECOND_NS // 10  # kept for answers that arrive late: 13 s or more


class Residuals:
    """Residuals of one component of one beacon, in its sigmas: those of the window, and the earlier mean.

    The earlier mean starts at 0 with the weight of one fix: an unknown constant error of one sigma.
    """

    def __init__(self) -> None:
        self._window: deque[tuple[int, float, bool]] = deque()
        self._sum = 0.0  # of the window
        self._mean, self._weight = 0.0, 1.0

    def add(self, t_ns: int, residual: float, is_believed: bool) -> None:
        """Add one; those that leave the window join the earlier mean if GNSS was believed."""
        self._window.append((t_ns, residual, is_believed))
        self._sum += residual
        while t_ns - self._window[0][0] > WINDOW_NS:
            _, old, was_believed = self._window.popleft()
            self._sum -= old
            if was_believed:
                self._weight = min(self._weight + 1.0, MOST)
                self._mean += (old - self._mean) / self._weight

    @property
    def last_ns(self) -> int:
        """Time of the last one."""
        return self._window[-1][0]

    @property
    def significance(self) -> float:
        """By how many sigmas the window differs from the earlier mean, at the time of the last fix."""
        if len(self._window) < LEAST:
            return 0.0
        difference = self._sum / len(self._window) - self._mean
        return abs(difference) / math.sqrt(1.0 / len(self._window) + 1.0 / self._weight)


class BeaconWitness:
    """Comparison of all beacons with the autopilot's first receiver."""

    def __init__(self) -> None:
        self._fixes: deque[Gnss] = deque(maxlen=FIXES)
        self._stale_data = StaleDataDetector()
        self._residuals: dict[tuple[int, str], Residuals] = {}
        self._answered_ns = 0  # time of the last answer of any beacon

    def receive(self, record: Gnss | RsbnFix, is_believed: bool) -> None:
        """Process a fix; `is_believed`: the navigator believes GNSS."""
        if isinstance(record, Gnss):
            if not record.has_3d_fix:
                self._fixes.clear()
            elif not self._fixes or abs(record.t_ns - self._fixes[-1].t_ns) >= FIXES_APART_NS:
                self._fixes.append(record)
            return
        if self._stale_data.judge(record) is not None:
            return
        self._answered_ns = record.t_ns
        fix = min(self._fixes, key=lambda each: abs(record.t_ns - each.t_ns), default=None)
        if fix is None or abs(dt := (record.t_ns - fix.t_ns) * 1e-9) > APART_S:
            return
        north, east, _ = fix.v_n or (0.0, 0.0, 0.0)
        place = displace(fix.lat, fix.lon, fix.alt_msl, north * dt, east * dt, 0.0)
        predicted = slant_range_azimuth(Geodetic(record.lat, record.lon, record.alt), place)
        displaced = displaced_sigma(math.hypot(north, east))
        if record.slant_range is not None:
            off = record.slant_range - predicted.slant_range
            self._add(record, "range", off / math.hypot(record.sigma_range, displaced), is_believed)
        is_low = predicted.slant_range > 2.0 * abs(place.alt - record.alt)  # not in the cone of silence
        if record.azimuth is not None and is_low:
            off = wrap_angle(record.azimuth - predicted.azimuth)
            sigma = math.hypot(record.sigma_azimuth, displaced / max(predicted.slant_range, 1.0))
            self._add(record, "azimuth", off / sigma, is_believed)

    @property
    def contradicts(self) -> bool:
        """Whether a beacon contradicts GNSS; one that was last compared before the window does not."""
        since_ns = self._answered_ns - WINDOW_NS
        return any(r.last_ns >= since_ns and r.significance > SIGMAS for r in self._residuals.values())

    def _add(self, record: RsbnFix, component: str, residual: float, is_believed: bool) -> None:
        key = record.beacon, component
        if key not in self._residuals and not self._has_room(record.t_ns):
            return
        self._residuals.setdefault(key, Residuals()).add(record.t_ns, residual, is_believed)

    def _has_room(self, t_ns: int) -> bool:
        """Return whether one more can be compared, in the place of one that has been silent, if need be."""
        if len(self._residuals) < MOST_TRACKS:
            return True
        oldest = min(self._residuals, key=lambda key: self._residuals[key].last_ns)
        if t_ns - self._residuals[oldest].last_ns <= WINDOW_NS:
            return False
        del self._residuals[oldest]
        return True
