"""GNSS latency relative to the local position, and GNSS glitches. Pure.

A receiver stamps a fix later than it is valid: GNSS at t agrees with the local position at t - tau. For the
pairs of one boot (one origin), tau is the delay that minimizes the median distance

    J(tau) = median_k | x_gnss(t_k) - x_local(t_k - tau) - c(tau) |,   c the median offset of the two.

The median tolerates jumps of the local position (filter resets) and GNSS glitches in up to half of the pairs.
The flight is divided into blocks, each with its own c and delay; sigma is derived from their spread. The
delay is observable in motion only: below `MIN_SPEED` none is estimated.

A glitch is a short interval in which GNSS, corrected for its delay, leaves the local position and returns,
with a motion impossible for an aircraft: a velocity change above `MAX_ACCELERATION`, or a position jump that
its own velocity does not explain. Otherwise the local position has moved; that is not reported here.
"""

from __future__ import annotations

import math
from array import array
from collections.abc import Iterable, Iterator
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from companion.nav.geometry import Geodetic, geodetic_to_local
from companion.records import Event, Gnss, LocalOrigin, LocalPosition, Reboot, Severity, Stamped
from companion.units import Floats

MAX_DELAY_S = 1.5  # search range of the delay, +-
MIN_SPEED = 3.0  # m/s
MIN_PAIRS = 40  # pairs in motion
BLOCKS = 8
MAX_DISTANCE_RATIO = 1.1
MAX_SIGMA_S = 0.1  # above it no delay is reported: the drift of the local position dominates
REACH_S = 2.0  # no interpolation between local positions farther apart
GLITCH_SIGMA_M = 2.0  # a glitch exceeds 4 of these and 6 times the usual deviation of the flight
GLITCH_MAX_S = 10.0
FASTEST_S = 0.02  # between fixes of the fastest receivers: limits the median filter's window
MAX_ACCELERATION = 50.0  # m/s^2


class GnssLocalTrack(NamedTuple):
    """GNSS and local positions of one boot, north and east of the local origin, m, and velocities, m/s.

    Fixes at `t` (n,) s with x, v (n, 2), v NaN if not reported; local positions at `t_local` (m,) s with
    x_local, v_local (m, 2). t = 0 is `zero_ns`.
    """

    zero_ns: int
    t: Floats
    x: Floats
    v: Floats
    t_local: Floats
    x_local: Floats
    v_local: Floats


class Latency(NamedTuple):
    """Delay of GNSS behind the local position (`seconds`, with sigma), from `pairs` fixes in motion.

    `before` and `after` are the median distances of the two, m, before and after correction for the delay.
    """

    seconds: float
    sigma: float
    before: float
    after: float
    pairs: int


class Glitch(NamedTuple):
    """Interval `start` to `end` (s of the track) with a GNSS error up to `distance` (m).

    `speed` is the greatest reported speed in it and shortly before (m/s; 0 if none is reported).
    """

    start: float
    end: float
    distance: float
    speed: float


class TrackCollector:
    """Collects the tracks of a log from its records, one per boot and origin."""

    def __init__(self) -> None:
        self._done: list[GnssLocalTrack] = []
        self._start_track()

    def _start_track(self) -> None:
        self._origin: LocalOrigin | None = None
        self._fixes, self._fix_t = array("d"), array("q")
        self._local, self._local_t = array("d"), array("q")
        self._last: Gnss | None = None

    def add(self, record: Stamped) -> None:
        """Add a record of any type."""
        if isinstance(record, LocalPosition):
            if not self._local_t or record.t_ns > self._local_t[-1]:
                self._local_t.append(record.t_ns)
                self._local.extend((*record.x_n[:2], *record.v_n[:2]))
        elif isinstance(record, Gnss):
            if record.has_3d_fix and record.receiver == 0 and not (self._last and record.repeats(self._last)):
                self._last = record
                v_n = record.v_n or (math.nan, math.nan, math.nan)
                self._fix_t.append(record.t_ns)
                self._fixes.extend((record.lat, record.lon, record.alt_msl, *v_n[:2]))
        elif isinstance(record, LocalOrigin):
            place = (record.lat, record.lon, record.projection)
            if self._origin and (self._origin.lat, self._origin.lon, self._origin.projection) != place:
                self._finish_track()
            self._origin = record
        elif isinstance(record, Reboot):
            self._finish_track()

    def tracks(self) -> list[GnssLocalTrack]:
        """Return all tracks with both fixes and local positions, and finish the collection."""
        self._finish_track()
        return self._done

    def _finish_track(self) -> None:
        origin, n = self._origin, len(self._fix_t)
        if origin is not None and n > 1 and len(self._local_t) > 1:
            zero = min(self._fix_t[0], self._local_t[0])
            fixes = np.array(self._fixes).reshape(n, 5)
            local = np.array(self._local).reshape(-1, 4)
            at = Geodetic(origin.lat, origin.lon, origin.alt_msl)
            x = [
                geodetic_to_local(origin.projection, at, Geodetic(*row))[:2] for row in fixes[:, :3].tolist()
            ]
            t = (np.array(self._fix_t, dtype=np.int64) - zero).astype(np.float64) * 1e-9
            t_local = (np.array(self._local_t, dtype=np.int64) - zero).astype(np.float64) * 1e-9
            self._done.append(
                GnssLocalTrack(zero, t, np.array(x), fixes[:, 3:], t_local, local[:, :2], local[:, 2:])
            )
        self._start_track()


def collect_tracks(records: Iterable[Stamped]) -> list[GnssLocalTrack]:
    """Collect the tracks in `records`."""
    collector = TrackCollector()
    for record in records:
        collector.add(record)
    return collector.tracks()


def estimate_latency(track: GnssLocalTrack) -> Latency | None:
    """Estimate the delay of GNSS behind the local position.

    Returns None if there is too little motion, if the blocks disagree, or if the delay does not reduce the
    distance between the two.
    """
    moving = _interpolatable(track) & (_speed_at(track) > MIN_SPEED)
    if int(moving.sum()) < MIN_PAIRS:
        return None
    t, x = track.t[moving], track.x[moving]
    blocks = np.array_split(np.arange(t.size), min(BLOCKS, t.size // (MIN_PAIRS // 2)))
    found = np.array([_delay(track, t[k], x[k]) for k in blocks])
    seconds = float(np.median(found))
    spread = 1.4826 * float(np.median(np.abs(found - seconds))) / math.sqrt(found.size)
    raw, shifted = (np.hypot(*_difference(track, t, x, tau).T) for tau in (0.0, seconds))
    before, after = float(np.median(raw)), float(np.median(shifted))
    reliable = spread <= MAX_SIGMA_S and after <= MAX_DISTANCE_RATIO * before
    return Latency(seconds, spread, before, after, t.size) if reliable else None


def find_glitches(track: GnssLocalTrack, latency: float = 0.0) -> list[Glitch]:
    """Find short departures of GNSS from the local position, with GNSS delayed by `latency` seconds."""
    near = _interpolatable(track)
    if int(near.sum()) < MIN_PAIRS:
        return []
    from scipy.ndimage import median_filter  # 0.2 s: not at the start of a command

    t, x, v = track.t[near], track.x[near], track.v[near]
    speed, implausible = np.nan_to_num(np.hypot(*v.T)), _implausible(t, x, v)
    difference = _difference(track, t, x, latency)
    width = 2 * int(GLITCH_MAX_S / max(float(np.median(np.diff(t))), FASTEST_S)) + 1
    usual = median_filter(difference, size=(min(width, t.size), 1), mode="nearest")
    off = np.hypot(*(difference - usual).T)
    limit = max(4.0 * GLITCH_SIGMA_M, 6.0 * 1.4826 * float(np.median(off)))
    found = []
    for k in _split_runs(t, off > limit):
        start, end = float(t[k[0]]), float(t[k[-1]])
        if k.size > 1 and end - start <= GLITCH_MAX_S and _agrees_around(t, off <= limit, start, end):
            about = (t >= start - 1.0) & (t <= end)
            if implausible[about].any():
                found.append(Glitch(start, end, float(off[k].max()), float(speed[about].max())))
    return found


class TrackAnalysis(NamedTuple):
    """Latency and glitches of a track with time origin `zero_ns`; `latency` is None if not observable."""

    zero_ns: int
    latency: Latency | None
    glitches: list[Glitch]


def analyze_track(track: GnssLocalTrack) -> TrackAnalysis:
    """Estimate the delay of a track, and find its glitches with this delay."""
    delay = estimate_latency(track)
    return TrackAnalysis(track.zero_ns, delay, find_glitches(track, delay.seconds if delay else 0.0))


def glitch_events(analyses: Iterable[TrackAnalysis]) -> Iterator[Event]:
    """Yield an event for each glitch, stamped with the time of its first fix."""
    for one in analyses:
        for glitch in one.glitches:
            at_ns = one.zero_ns + round(glitch.start * 1e9)
            yield Event(
                at_ns,
                at_ns,
                Severity.WARNING,
                f"GNSS glitch of {glitch.end - glitch.start:.1f} s: {glitch.distance:.1f} m off the local "
                f"position, up to {glitch.speed:.0f} m/s reported",
            )


def describe_analyses(analyses: Iterable[TrackAnalysis]) -> Iterator[str]:
    """Yield sentences on the delay of each boot, if known, and on its glitches."""
    for one in analyses:
        if one.latency:
            yield describe_latency(one.latency)
        for event in glitch_events([one]):
            yield f"{(event.t_ns - one.zero_ns) * 1e-9:.1f} s after the first position: {event.text}"


def describe_latency(found: Latency) -> str:
    """Describe a delay in a sentence."""
    side = "behind" if found.seconds >= 0.0 else "ahead of"
    return (
        f"GNSS is {abs(found.seconds):.2f} s (sigma {found.sigma:.2f}) {side} the local position: median"
        f" distance {found.before:.2f} m, {found.after:.2f} m after correction ({found.pairs} fixes)"
    )


def _delay(track: GnssLocalTrack, t: Floats, x: Floats) -> float:
    from scipy.optimize import minimize_scalar  # 0.2 s: not at the start of a command

    def cost(tau: float) -> float:
        difference = _difference(track, t, x, tau)
        return float(np.median(np.hypot(*(difference - np.median(difference, axis=0)).T)))

    grid = np.linspace(-MAX_DELAY_S, MAX_DELAY_S, 61)
    best = grid[int(np.argmin([cost(tau) for tau in grid]))]
    step = grid[1] - grid[0]
    fine = minimize_scalar(cost, bounds=(best - step, best + step), method="bounded", options={"xatol": 1e-3})
    return float(fine.x)


def _difference(track: GnssLocalTrack, t: Floats, x: Floats, tau: float) -> Floats:
    """x_gnss(t) - x_local(t - tau), (n, 2)."""
    local = [np.interp(t - tau, track.t_local, track.x_local[:, i]) for i in (0, 1)]
    return x - np.stack(local, axis=1)


def _interpolatable(track: GnssLocalTrack) -> npt.NDArray[np.bool_]:
    """Return which fixes are between two local positions that are close in time."""
    k = np.searchsorted(track.t_local, track.t)
    inside = (k > 0) & (k < track.t_local.size)
    k = np.clip(k, 1, track.t_local.size - 1)
    near: npt.NDArray[np.bool_] = inside & (track.t_local[k] - track.t_local[k - 1] < REACH_S)
    return near


def _speed_at(track: GnssLocalTrack) -> Floats:
    return np.interp(track.t, track.t_local, np.hypot(*track.v_local.T))


def _implausible(t: Floats, x: Floats, v: Floats) -> npt.NDArray[np.bool_]:
    """Return the fixes (n,) whose motion since the previous fix is impossible for an aircraft."""
    dt = np.maximum(np.diff(t), 1e-3)
    turned = np.hypot(*np.diff(v, axis=0).T) / dt > MAX_ACCELERATION
    jumped = np.hypot(*(np.diff(x, axis=0).T - 0.5 * (v[1:] + v[:-1]).T * dt)) > 4.0 * GLITCH_SIGMA_M
    return np.concatenate([[False], (dt < REACH_S) & (turned | jumped)])


def _split_runs(t: Floats, flagged: npt.NDArray[np.bool_]) -> Iterator[npt.NDArray[np.intp]]:
    """Split the flagged indices where they are more than a second apart."""
    k = np.flatnonzero(flagged)
    if k.size:
        yield from np.split(k, np.flatnonzero(np.diff(t[k]) > 1.0) + 1)


def _agrees_around(t: Floats, calm: npt.NDArray[np.bool_], start: float, end: float) -> bool:
    """Return whether GNSS agrees with the local position shortly before and shortly after."""
    before = calm & (t < start) & (t > start - 2.0)
    after = calm & (t > end) & (t < end + 2.0)
    return bool(before.any() and after.any())
