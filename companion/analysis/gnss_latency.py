"""How late GNSS is behind the local position, and where it jumped away from it. Pure; knows no files.

A receiver's fix is stamped later than it was true: GNSS at t shows where the local position was at t - tau.
The pairs of one boot (they share an origin) give tau as the delay at which the median distance

    J(tau) = median_k | x_gnss(t_k) - x_local(t_k - tau) - c(tau) |,   c the median offset of the two,

is least. A median because the local position jumps when its filter is reset, and GNSS when it glitches: up to
half of the pairs may be wrong. The flight is cut into blocks, each with its own c and delay; their spread is
sigma. Delay shows only in motion: slower than `SLOWEST`, there is no answer.

A glitch is a short stretch in which GNSS, its delay allowed for, leaves the local position and comes back,
and does what no aircraft does: its velocity changes by more than `HARDEST`, or its position jumps against its
own velocity. Where it does not, it was the local position that left, and that is not told here.
"""

from __future__ import annotations

import math
from array import array
from collections.abc import Iterable, Iterator
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.ndimage import median_filter
from scipy.optimize import minimize_scalar

from companion.nav.geometry import Geodetic, Projection, geodetic_to_local
from companion.records import Event, Gnss, LocalOrigin, LocalPosition, Reboot, Stamped

Floats = npt.NDArray[np.float64]

LONGEST_S = 1.5  # delays looked for, either sign
SLOWEST = 3.0  # m/s
FEWEST = 40  # pairs in motion
BLOCKS = 8
WORSE = 1.1
LOOSEST_S = 0.1  # a greater sigma tells no delay: the local position drifts faster than it is shifted
REACH_S = 2.0  # local positions farther apart than this are not interpolated between
GLITCH_SIGMA_M = 2.0  # a glitch is farther off than four of these and six of what is usual in the flight
GLITCH_LONGEST_S = 10.0
HARDEST = 50.0  # m/s^2
_WARNING = 4  # MAV_SEVERITY


class Track(NamedTuple):
    """One boot: fixes at `t` (n,) s with x, v (n, 2), local positions at `t_local` (m,) s with x_local,
    v_local (m, 2); north, east of the local origin, m, velocities m/s, NaN where none. t = 0 is `zero_ns`.
    """

    zero_ns: int
    t: Floats
    x: Floats
    v: Floats
    t_local: Floats
    x_local: Floats
    v_local: Floats


class Latency(NamedTuple):
    """GNSS is `seconds` behind the local position, sigma of it, and the median distance of the two (m)
    as logged and with the delay taken out, over `pairs` fixes in motion.
    """

    seconds: float
    sigma: float
    before: float
    after: float
    pairs: int


class Glitch(NamedTuple):
    """From `start` to `end` (s of the track) GNSS was up to `distance` (m) off, reporting up to `speed`
    (m/s; 0 where it reports none) in and shortly before it.
    """

    start: float
    end: float
    distance: float
    speed: float


class Watch:
    """Collects the tracks of a log while its records go by, one for each boot and origin."""

    def __init__(self) -> None:
        self._done: list[Track] = []
        self._begin()

    def _begin(self) -> None:
        self._origin: LocalOrigin | None = None
        self._fixes, self._fix_t = array("d"), array("q")
        self._local, self._local_t = array("d"), array("q")
        self._last: Gnss | None = None

    def see(self, record: Stamped) -> None:
        """Take any record."""
        if isinstance(record, LocalPosition):
            if not self._local_t or record.t_ns > self._local_t[-1]:
                self._local_t.append(record.t_ns)
                self._local.extend((*record.x_n[:2], *record.v_n[:2]))
        elif isinstance(record, Gnss):
            if record.fix >= 3 and record.receiver == 0 and not (self._last and record.repeats(self._last)):
                self._last = record
                v_n = record.v_n or (math.nan, math.nan, math.nan)
                self._fix_t.append(record.t_ns)
                self._fixes.extend((record.lat, record.lon, record.alt_msl, *v_n[:2]))
        elif isinstance(record, LocalOrigin):
            place = (record.lat, record.lon, record.projection)
            if self._origin and (self._origin.lat, self._origin.lon, self._origin.projection) != place:
                self._close()
            self._origin = record
        elif isinstance(record, Reboot):
            self._close()

    def tracks(self) -> list[Track]:
        """All tracks that hold both fixes and local positions; ends the watch."""
        self._close()
        return self._done

    def _close(self) -> None:
        origin, n = self._origin, len(self._fix_t)
        if origin is not None and n > 1 and len(self._local_t) > 1:
            zero = min(self._fix_t[0], self._local_t[0])
            fixes = np.array(self._fixes).reshape(n, 5)
            local = np.array(self._local).reshape(-1, 4)
            at = Geodetic(origin.lat, origin.lon, origin.alt_msl)
            projection: Projection = origin.projection  # type: ignore[assignment]
            x = [geodetic_to_local(projection, at, Geodetic(*row))[:2] for row in fixes[:, :3].tolist()]
            t = (np.array(self._fix_t, dtype=np.int64) - zero).astype(np.float64) * 1e-9
            t_local = (np.array(self._local_t, dtype=np.int64) - zero).astype(np.float64) * 1e-9
            self._done.append(Track(zero, t, np.array(x), fixes[:, 3:], t_local, local[:, :2], local[:, 2:]))
        self._begin()


def watch(records: Iterable[Stamped]) -> list[Track]:
    """The tracks in `records`."""
    seen = Watch()
    for record in records:
        seen.see(record)
    return seen.tracks()


def estimate(track: Track) -> Latency | None:
    """The delay of GNSS behind the local position; None where too little moved to tell, or where the blocks
    agree on none: their spread is wide, or theirs does not bring the two closer.
    """
    moving = _near(track) & (_speed_at(track) > SLOWEST)
    if int(moving.sum()) < FEWEST:
        return None
    t, x = track.t[moving], track.x[moving]
    blocks = np.array_split(np.arange(t.size), min(BLOCKS, t.size // (FEWEST // 2)))
    found = np.array([_delay(track, t[k], x[k]) for k in blocks])
    seconds = float(np.median(found))
    spread = 1.4826 * float(np.median(np.abs(found - seconds))) / math.sqrt(found.size)
    raw, shifted = (np.hypot(*_difference(track, t, x, tau).T) for tau in (0.0, seconds))
    before, after = float(np.median(raw)), float(np.median(shifted))
    told = spread <= LOOSEST_S and after <= WORSE * before
    return Latency(seconds, spread, before, after, t.size) if told else None


def glitches(track: Track, latency: float = 0.0) -> list[Glitch]:
    """Where GNSS left the local position for a short while, GNSS being `latency` seconds behind."""
    near = _near(track)
    if int(near.sum()) < FEWEST:
        return []
    t, x, v = track.t[near], track.x[near], track.v[near]
    speed, wild = np.nan_to_num(np.hypot(*v.T)), _wild(t, x, v)
    difference = _difference(track, t, x, latency)
    width = 2 * int(GLITCH_LONGEST_S / max(float(np.median(np.diff(t))), 1e-3)) + 1
    usual = median_filter(difference, size=(min(width, t.size), 1), mode="nearest")
    off = np.hypot(*(difference - usual).T)
    limit = max(4.0 * GLITCH_SIGMA_M, 6.0 * 1.4826 * float(np.median(off)))
    found = []
    for k in _runs(t, off > limit):
        start, end = float(t[k[0]]), float(t[k[-1]])
        if k.size > 1 and end - start <= GLITCH_LONGEST_S and _returns(t, off <= limit, start, end):
            about = (t >= start - 1.0) & (t <= end)
            if wild[about].any():
                found.append(Glitch(start, end, float(off[k].max()), float(speed[about].max())))
    return found


class Seen(NamedTuple):
    """What a track told: `zero_ns` is its time 0; `latency` None where it cannot be told."""

    zero_ns: int
    latency: Latency | None
    glitches: list[Glitch]


def look(track: Track) -> Seen:
    """The delay of a track and, that allowed for, its glitches."""
    delay = estimate(track)
    return Seen(track.zero_ns, delay, glitches(track, delay.seconds if delay else 0.0))


def events(seen: Iterable[Seen]) -> Iterator[Event]:
    """A line for each glitch, at its beginning; t_ns and rx_ns are the fix's."""
    for one in seen:
        for glitch in one.glitches:
            at_ns = one.zero_ns + round(glitch.start * 1e9)
            yield Event(
                at_ns,
                at_ns,
                _WARNING,
                f"GNSS glitch of {glitch.end - glitch.start:.1f} s: {glitch.distance:.1f} m off the local "
                f"position, up to {glitch.speed:.0f} m/s reported",
            )


def sentences(seen: Iterable[Seen]) -> Iterator[str]:
    """For a person: the delay of each boot that can be told, then its glitches."""
    for one in seen:
        if one.latency:
            yield sentence(one.latency)
        for event in events([one]):
            yield f"{(event.t_ns - one.zero_ns) * 1e-9:.1f} s after the first: {event.text}"


def sentence(found: Latency) -> str:
    """A delay for a person."""
    side = "behind" if found.seconds >= 0.0 else "ahead of"
    return (
        f"GNSS is {abs(found.seconds):.2f} s (sigma {found.sigma:.2f}) {side} the local position: median"
        f" distance {found.before:.2f} m, {found.after:.2f} m without it ({found.pairs} fixes)"
    )


def _delay(track: Track, t: Floats, x: Floats) -> float:
    def cost(tau: float) -> float:
        difference = _difference(track, t, x, tau)
        return float(np.median(np.hypot(*(difference - np.median(difference, axis=0)).T)))

    grid = np.linspace(-LONGEST_S, LONGEST_S, 61)
    best = grid[int(np.argmin([cost(tau) for tau in grid]))]
    step = grid[1] - grid[0]
    fine = minimize_scalar(cost, bounds=(best - step, best + step), method="bounded", options={"xatol": 1e-3})
    return float(fine.x)


def _difference(track: Track, t: Floats, x: Floats, tau: float) -> Floats:
    """x_gnss(t) - x_local(t - tau), (n, 2)."""
    local = [np.interp(t - tau, track.t_local, track.x_local[:, i]) for i in (0, 1)]
    return x - np.stack(local, axis=1)


def _near(track: Track) -> npt.NDArray[np.bool_]:
    """Fixes between two local positions that are close in time."""
    k = np.searchsorted(track.t_local, track.t)
    inside = (k > 0) & (k < track.t_local.size)
    k = np.clip(k, 1, track.t_local.size - 1)
    near: npt.NDArray[np.bool_] = inside & (track.t_local[k] - track.t_local[k - 1] < REACH_S)
    return near


def _speed_at(track: Track) -> Floats:
    return np.interp(track.t, track.t_local, np.hypot(*track.v_local.T))


def _wild(t: Floats, x: Floats, v: Floats) -> npt.NDArray[np.bool_]:
    """Fixes (n,) at which GNSS does, since the one before, what no aircraft does."""
    dt = np.maximum(np.diff(t), 1e-3)
    turned = np.hypot(*np.diff(v, axis=0).T) / dt > HARDEST
    jumped = np.hypot(*(np.diff(x, axis=0).T - 0.5 * (v[1:] + v[:-1]).T * dt)) > 4.0 * GLITCH_SIGMA_M
    return np.concatenate([[False], (dt < REACH_S) & (turned | jumped)])


def _runs(t: Floats, flagged: npt.NDArray[np.bool_]) -> Iterator[npt.NDArray[np.intp]]:
    """The flagged indices in stretches without a second between."""
    k = np.flatnonzero(flagged)
    if k.size:
        yield from np.split(k, np.flatnonzero(np.diff(t[k]) > 1.0) + 1)


def _returns(t: Floats, calm: npt.NDArray[np.bool_], start: float, end: float) -> bool:
    """Whether GNSS agreed with the local position right before and right after."""
    before = calm & (t < start) & (t > start - 2.0)
    after = calm & (t > end) & (t < end + 2.0)
    return bool(before.any() and after.any())
