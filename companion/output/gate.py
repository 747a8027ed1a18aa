"""The gate before everything that an autopilot may steer by: what passes is trusted, finite, fresh, on the
earth, and where the last one that passed lets it be. No messages, no clock: it judges solutions by their own
times.

Trust decides before the mode does: with the first fix after a long while without one the mode is fixed, and
trust comes back only when it has lasted. What is degraded passes, with the sigma of its estimator: that a
source may lie is no noise, and a filter that is told a greater sigma ten times a second averages the lie to
the same place a little later. How far it may be off is for NAVIGATION_STATUS to say (trust, protection).

A solution that passes comes out as a `Position`, carried forward by its own velocity to the instant at which
it is sent, so that no message has to tell an age (ArduPilot cannot be told one over 0.25 s; PX4 takes the
arrival of GLOBAL_POSITION_SENSOR for its time). The encoders take nothing but a `Position`.

How far one may be from the last is reasoned, not tuned. Both are within three of their own sigmas of the
truth, and the truth moved by the mean of both velocities, up to what a manoeuvre does in between. What is
further off is wrong, or the last one was; it is withheld until time has made room for it. A jump that the
old sigma justifies and the new one does not is let through and counted, for the autopilot to begin anew by
(`reset_counter`) rather than to reject as an outlier.
"""

from __future__ import annotations

import math
from collections import Counter
from typing import NamedTuple

from companion.nav.geometry import Geodetic, apart, displace, wrap
from companion.records import Event, Mode, Solution, Trust, Vector3

SECOND = 1_000_000_000
OLDEST_S = 1.0
"""The longest that a solution is carried forward: half of CARRY_ACCELERATION times its square is 5 m."""
CARRY_ACCELERATION = 10.0  # [m/s^2] of a turn, unknown while it is carried
MANOEUVRE = 20.0  # [m/s^2] between two solutions, and 2 m for rounding and gusts
FREE_M = 2.0
FASTEST = 400.0  # [m/s]
LOWEST_M, HIGHEST_M = -500.0, 30_000.0
NEAREST_POLE = math.radians(89.0)  # the flat earths of the autopilots end before
BEST_M, WORST_M = 0.01, 1000.0  # a sigma below is nobody's here, and could be 0 on the wire
SLOWEST = 1e-3  # [m/s], of the sigma of the velocity
SIGMAS = 3.0
TELL_EVERY = 5 * SECOND


class Position(NamedTuple):
    """A position fit to be sent, valid at the instant `t_ns` of its sending.

    `covariance` is that of north, east (upper triangle, m^2) by the estimator that leads: guaranteed where
    that is the minimax one. `resets` counts the jumps that the autopilot must be told of.
    """

    t_ns: int
    lat: float
    lon: float
    alt_msl: float
    v_n: Vector3
    covariance: Vector3
    variance_down: float
    fixed: bool
    sigma_velocity: float | None = None
    resets: int = 0

    @property
    def sigma(self) -> float:
        """One sigma in the worst horizontal direction, m."""
        nn, ne, ee = self.covariance
        return math.sqrt(0.5 * (nn + ee) + math.hypot(0.5 * (nn - ee), ne))

    def at(self, t_ns: int) -> Position:
        """Carried to another instant, a little before or after, by its velocity."""
        dt = (t_ns - self.t_ns) * 1e-9
        north, east, down = self.v_n
        lat, lon, alt = displace(self.lat, self.lon, self.alt_msl, north * dt, east * dt, down * dt)
        nn, ne, ee = self.covariance
        unknown = (0.5 * CARRY_ACCELERATION * dt * dt) ** 2
        return self._replace(
            t_ns=t_ns, lat=lat, lon=lon, alt_msl=alt, covariance=(nn + unknown, ne, ee + unknown)
        )


def fault(solution: Solution) -> str | None:
    """What forbids to steer by `solution`, looked at by itself; None if nothing does."""
    s = solution
    nn, ne, _, ee, _, dd = s.covariance
    age = (s.rx_ns - s.t_ns) * 1e-9
    if s.mode not in (Mode.FIXED, Mode.PREDICTING):
        return f"navigation is {s.mode}"
    if s.trust is Trust.UNTRUSTED:
        return "it is not trusted"
    if not all(map(math.isfinite, (s.lat, s.lon, s.alt_msl, *s.v_n, *s.covariance, s.inertial_age_s))):
        return "it is not finite"
    if not (s.t_ns > 0 and 0 < s.rx_ns < 1 << 63 and max(age, s.inertial_age_s) <= OLDEST_S):
        return "it is too old"
    if min(age, s.inertial_age_s) < -OLDEST_S:
        return "it is of the future"
    if not (abs(s.lat) <= NEAREST_POLE and abs(s.lon) <= math.pi):
        return "it is not on the earth, or at a pole"
    if not LOWEST_M <= s.alt_msl <= HIGHEST_M:
        return "no aircraft flies so high or low"
    if math.hypot(*s.v_n) > FASTEST:
        return "no aircraft of ours flies so fast"
    if not (min(nn, ee, dd) >= BEST_M**2 and ne * ne <= nn * ee):
        return "its covariance is none"
    if max(nn, ee, dd) > WORST_M**2:
        return "its accuracy is worse than 1 km"
    if s.sigma_velocity is not None and not SLOWEST <= s.sigma_velocity <= FASTEST:
        return "the accuracy of its velocity is none"
    return None


class Gate:
    """Lets solutions through one by one; remembers the last that passed."""

    def __init__(self) -> None:
        self._last: Position | None = None
        self._resets = 0

    def admit(self, solution: Solution) -> Position | str:
        """The position to be sent for `solution`, or why there is none."""
        if (reason := fault(solution)) is not None:
            return reason
        s = solution
        here = Position(
            s.t_ns,
            s.lat,
            s.lon,
            s.alt_msl,
            s.v_n,
            (s.covariance[0], s.covariance[1], s.covariance[3]),
            s.covariance[5],
            s.mode is Mode.FIXED,
            s.sigma_velocity,
        ).at(s.rx_ns)
        if self._last is not None:
            if here.t_ns < self._last.t_ns:
                return "its time is before the last one's"
            dt = (here.t_ns - self._last.t_ns) * 1e-9
            jump = _jump(self._last, here, dt)
            room = FREE_M + 0.5 * MANOEUVRE * dt * dt
            if jump > SIGMAS * (self._last.sigma + here.sigma) + room:
                return "it jumped further than its accuracy justifies"
            if jump > SIGMAS * here.sigma + room:
                self._resets += 1
        self._last = here._replace(resets=self._resets)
        return self._last


def _jump(last: Position, here: Position, dt: float) -> float:
    """How far `here` is horizontally from where the mean velocity leads in `dt` seconds, m."""
    (v_n, v_e, _), (w_n, w_e, _) = last.v_n, here.v_n
    place = Geodetic(last.lat, last.lon, last.alt_msl)
    north, east, _ = apart(Geodetic(here.lat, here.lon, here.alt_msl), place)
    return math.hypot(north - 0.5 * (v_n + w_n) * dt, east - 0.5 * (v_e + w_e) * dt)


def distance(a: tuple[float, float], b: tuple[float, float]) -> float:
    """Horizontal distance of two points (latitude and longitude, rad) over a sphere, m: within 0.6 %."""
    half_lat, half_lon = 0.5 * (b[0] - a[0]), 0.5 * wrap(b[1] - a[1])
    h = math.sin(half_lat) ** 2 + math.cos(a[0]) * math.cos(b[0]) * math.sin(half_lon) ** 2
    return 2.0 * 6_371_000.0 * math.asin(min(1.0, math.sqrt(h)))


class Withheld:
    """Counts what is withheld, and why; tells each change once, and none oftener than `TELL_EVERY`."""

    def __init__(self) -> None:
        self.counts: Counter[tuple[str, str]] = Counter()
        self._told: dict[str, tuple[int, str | None]] = {}

    def note(self, what: str, reason: str | None, now_ns: int) -> Event | None:
        """`what` is withheld for `reason`, or goes out (None): the event to tell, if it is news."""
        if reason is not None:
            self.counts[what, reason] += 1
        told = self._told.get(what)
        if told is not None and (told[1] == reason or now_ns - told[0] < TELL_EVERY):
            return None
        self._told[what] = now_ns, reason
        if reason is not None:
            return Event(now_ns, now_ns, 4, f"{what} withheld: {reason}")
        missing = sum(count for (name, _), count in self.counts.items() if name == what)
        after = f", {missing} withheld so far" if missing else ""
        return Event(now_ns, now_ns, 6, f"{what} goes out{after}")
