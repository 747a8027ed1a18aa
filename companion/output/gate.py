"""Output gate: checks every solution before it may steer the autopilot. No messages, no clock.

A solution passes if it is trusted, finite, recent, within the range of an aircraft and consistent with the
last one that was sent. Ages are computed from the times of the solution.

Trust is checked besides the mode: at the first fix after an outage the mode is already fixed, while trust
returns only after `integrity.settle_s`. A degraded solution passes with the sigma of its estimator: a faulty
source adds a bias and not noise, so a filter that receives a greater sigma ten times a second converges to
the same biased position a little later. The possible error is reported in NAVIGATION_STATUS (trust,
protection).

A solution that passes becomes a `Position`, propagated by its velocity to the time of sending, so that no
message has to carry an age (ArduPilot accepts at most 0.25 s; PX4 uses the arrival time of
GLOBAL_POSITION_SENSOR). The encoders accept only a `Position`.

The limit on a jump is derived, not tuned. Both positions are within three of their sigmas of the truth, and
between them the truth moves with the mean of both velocities, up to a manoeuvre. A greater jump means that
one of the two is wrong; the solution is withheld until the limit, which grows with time, admits it. Where
GNSS has been found false since, it was the old one, and the new one passes at once. A jump that only the old
sigma justifies passes and is counted, so that the autopilot resets (`reset_counter`) instead of rejecting it
as an outlier. An autopilot that takes `reset_counter` gets such a jump in steps of `STEP_M`, one a message,
each a reset: a reset changes the position only, while a slope would be taken for a velocity. They begin at
the autopilot's own position, as its filter lags behind ours. What is left of the jump is stated in the
covariance.

Where the navigator has given up its position since, the next solution is compared with none, counts as a
reset and goes out whole: in steps of 10 m a jump of 20 km would take minutes, in which the old one steers.
"""

from __future__ import annotations

import math
from collections import Counter
from typing import NamedTuple

from companion.estimate.bank.settings import DEFAULT
from companion.link.dialect import Message
from companion.nav.geometry import Geodetic, displace, separation, wrap_angle
from companion.records import Event, GlobalPosition, Gnss, Mode, Severity, Solution, Trust, Vector2, Vector3
from companion.units import SECOND_NS

MAX_AGE_S = 1.0
"""Longest propagation to the time of sending: at `CARRY_ACCELERATION` it adds 5 m."""
CARRY_ACCELERATION = 10.0  # [m/s^2] of a turn, unknown during propagation
MANOEUVRE = 20.0  # [m/s^2] between two solutions
JUMP_MARGIN_M = 2.0  # rounding and gusts
MAX_SPEED = 400.0  # [m/s]
MIN_ALTITUDE_M, MAX_ALTITUDE_M = -500.0, 30_000.0
MAX_LATITUDE = math.radians(89.0)  # the local projections of the autopilots are not valid beyond
MIN_SIGMA_M, MAX_SIGMA_M = (
    0.01,
    1000.0,
)  # a smaller sigma is not plausible, and could become 0 in single precision
MIN_SIGMA_VELOCITY = 1e-3  # [m/s]
SIGMAS = 3.0
STEP_M = 10.0
"""Greatest step of a position that is reset: 50 m take half a second at 10 Hz."""
LOCAL_TOLERANCE_M, LOCAL_RECENT_NS = 5.0, 10 * SECOND_NS
PROJECTION_ERROR = 0.05
"""Greatest scale error of a flat local frame, 200 km from its origin."""
REPORT_INTERVAL_NS = 5 * SECOND_NS


class Position(NamedTuple):
    """A position that may be sent, valid at `t_ns`, the time of sending.

    `covariance` is of north, east (upper triangle, m^2) by the current estimator; with the minimax estimator
    it is guaranteed. `resets` counts the jumps that are reported to the autopilot (`reset_counter`).
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
    def place(self) -> Geodetic:
        """Latitude, longitude and altitude."""
        return Geodetic(self.lat, self.lon, self.alt_msl)

    @property
    def sigma(self) -> float:
        """Standard deviation in the worst horizontal direction, m."""
        nn, ne, ee = self.covariance
        return math.sqrt(0.5 * (nn + ee) + math.hypot(0.5 * (nn - ee), ne))

    def at(self, t_ns: int) -> Position:
        """Propagate to a time shortly before or after, by the velocity."""
        dt = (t_ns - self.t_ns) * 1e-9
        north, east, down = self.v_n
        lat, lon, alt = displace(*self.place, north * dt, east * dt, down * dt)
        nn, ne, ee = self.covariance
        unknown = (0.5 * CARRY_ACCELERATION * dt * dt) ** 2
        return self._replace(
            t_ns=t_ns, lat=lat, lon=lon, alt_msl=alt, covariance=(nn + unknown, ne, ee + unknown)
        )


def withholding_reason(solution: Solution) -> str | None:
    """Return why `solution`, without regard to earlier ones, must not be sent; None if it may be sent."""
    s = solution
    nn, ne, _, ee, _, dd = s.covariance
    age = (s.rx_ns - s.t_ns) * 1e-9
    if s.mode not in (Mode.FIXED, Mode.PREDICTING):
        return f"navigation is {s.mode}"
    if s.trust is Trust.UNTRUSTED:
        return "position is untrusted"
    if not all(map(math.isfinite, (s.lat, s.lon, s.alt_msl, *s.v_n, *s.covariance, s.inertial_age_s))):
        return "position is not finite"
    if not (s.t_ns > 0 and 0 < s.rx_ns < 1 << 63 and max(age, s.inertial_age_s) <= MAX_AGE_S):
        return f"position is older than {MAX_AGE_S:g} s"
    if min(age, s.inertial_age_s) < -MAX_AGE_S:
        return f"timestamp more than {MAX_AGE_S:g} s in the future"
    if not (abs(s.lat) <= MAX_LATITUDE and abs(s.lon) <= math.pi):
        return "latitude beyond 89 deg or longitude beyond 180 deg"
    if not MIN_ALTITUDE_M <= s.alt_msl <= MAX_ALTITUDE_M:
        return f"altitude outside {MIN_ALTITUDE_M:g} to {MAX_ALTITUDE_M:g} m"
    if math.hypot(*s.v_n) > MAX_SPEED:
        return f"speed above {MAX_SPEED:g} m/s"
    if not (min(nn, ee, dd) >= MIN_SIGMA_M**2 and ne * ne <= nn * ee):
        return f"covariance not positive definite, or sigma below {MIN_SIGMA_M:g} m"
    if max(nn, ee, dd) > MAX_SIGMA_M**2:
        return f"sigma above {MAX_SIGMA_M:g} m"
    if s.sigma_velocity is not None and not MIN_SIGMA_VELOCITY <= s.sigma_velocity <= MAX_SPEED:
        return f"velocity sigma outside {MIN_SIGMA_VELOCITY:g} to {MAX_SPEED:g} m/s"
    return None


class _Passed(NamedTuple):
    """What the gate remembers of the solutions that passed."""

    last: Position | None = None
    is_gnss_false: bool = False  # as the last one passed
    restarts: int = 0  # of the navigator's position
    resets: int = 0
    left_n: Vector2 = (0.0, 0.0)  # from the solution to the position that goes out, m north, east


class Gate:
    """Gate for successive solutions; stores the last one that passed, unless it was not sent.

    A jump that is counted goes out in steps of `max_step_m` at most.
    """

    def __init__(self, max_step_m: float = math.inf) -> None:
        self._max_step_m = max_step_m
        self._passed = self._before = _Passed()  # up to the last one, and up to the one before it

    def admit(self, solution: Solution, own: Geodetic | None = None) -> Position | str:
        """Return the position to be sent for `solution`, or the reason why it is withheld.

        `own` is the autopilot's own position at the time of sending, if known.
        """
        if (reason := withholding_reason(solution)) is not None:
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
        is_false = (s.gnss_false or 0.0) > DEFAULT.excluded
        last, left_n, resets = self._passed.last, self._passed.left_n, self._passed.resets
        if last is not None and s.restarts != self._passed.restarts:
            left_n, resets = (0.0, 0.0), resets + 1
        elif last is not None:
            if here.t_ns < last.t_ns:
                return "timestamp before the previous position"
            dt = (here.t_ns - last.t_ns) * 1e-9
            moved_n = _jump(last, here, dt)
            jump = math.hypot(*moved_n)
            room = JUMP_MARGIN_M + 0.5 * MANOEUVRE * dt * dt
            is_explained = is_false and not self._passed.is_gnss_false
            if jump > SIGMAS * (last.sigma + here.sigma) + room and not is_explained:
                return "jump larger than its accuracy justifies"
            if jump > SIGMAS * here.sigma + room:
                left_n = left_n[0] - moved_n[0], left_n[1] - moved_n[1]
                if own is not None:
                    left_n = _begin_at(own, here, left_n, SIGMAS * last.sigma + room)
        self._before, self._passed = self._passed, _Passed(here, is_false, s.restarts, resets, left_n)
        return self._stepped(here)

    def retract(self) -> None:
        """Forget the last solution that passed: it was not sent, so the autopilot cannot compare with it."""
        self._passed = self._before

    def _stepped(self, here: Position) -> Position:
        """Return the position that goes out for `here`: a step nearer to it, if a jump is not over."""
        left = math.hypot(*self._passed.left_n)
        if left == 0.0:
            return here._replace(resets=self._passed.resets)
        share = max(0.0, 1.0 - self._max_step_m / left)
        north, east = share * self._passed.left_n[0], share * self._passed.left_n[1]
        self._passed = self._passed._replace(resets=self._passed.resets + 1, left_n=(north, east))
        lat, lon, _ = displace(*here.place, north, east, 0.0)
        nn, ne, ee = here.covariance
        covariance = nn + north * north, ne + north * east, ee + east * east
        return here._replace(lat=lat, lon=lon, covariance=covariance, resets=self._passed.resets)


def _begin_at(own: Geodetic, here: Position, left_n: Vector2, near: float) -> Vector2:
    """Return where the steps begin: the autopilot's own position if within `near` of the last one sent, m."""
    north, east, _ = separation(own, here.place)
    is_near = math.hypot(north - left_n[0], east - left_n[1]) <= near
    return (north, east) if is_near else left_n


def _jump(last: Position, here: Position, dt: float) -> Vector2:
    """Return `here` from the last position propagated by the mean velocity, m north, east."""
    (v_n, v_e, _), (w_n, w_e, _) = last.v_n, here.v_n
    north, east, _ = separation(here.place, last.place)
    return north - 0.5 * (v_n + w_n) * dt, east - 0.5 * (v_e + w_e) * dt


class LocalFrame:
    """Check of local coordinates in the frame in which they leave.

    Between two messages x and y must change as the position does: a change of the origin that the reset
    counter does not report moves the aircraft.
    """

    def __init__(self) -> None:
        self._last: tuple[Position, Message] | None = None

    def withholding_reason(self, position: Position, message: Message) -> str | None:
        """Return why `message`, which carries `position`, must not be sent; None if it may be."""
        if not hasattr(message, "reset_counter"):
            return None  # not in local coordinates
        before, sent = self._last or (position, message)
        is_recent = position.t_ns - before.t_ns <= LOCAL_RECENT_NS
        if is_recent and sent.reset_counter == message.reset_counter:
            north, east, _ = separation(position.place, before.place)
            off = math.hypot(message.x - sent.x - north, message.y - sent.y - east)
            if not off <= LOCAL_TOLERANCE_M + PROJECTION_ERROR * math.hypot(north, east):
                return "local coordinates moved otherwise than the position"
        self._last = position, message
        return None


def place_at(record: Gnss | GlobalPosition | Solution, t_ns: int) -> Geodetic:
    """Return the position of a record at `t_ns`, by its velocity."""
    north, east, _ = record.v_n or (0.0, 0.0, 0.0)
    dt = (t_ns - record.t_ns) * 1e-9
    return displace(record.lat, record.lon, record.alt_msl, north * dt, east * dt, 0.0)


def distance(a: Geodetic, b: Geodetic) -> float:
    """Return the distance of two points on a sphere, m, whatever their altitudes; error at most 0.6 %."""
    half_lat, half_lon = 0.5 * (b.lat - a.lat), 0.5 * wrap_angle(b.lon - a.lon)
    h = math.sin(half_lat) ** 2 + math.cos(a.lat) * math.cos(b.lat) * math.sin(half_lon) ** 2
    return 2.0 * 6_371_000.0 * math.asin(min(1.0, math.sqrt(h)))


class WithholdingMonitor:
    """Counts of withheld messages by reason; reports each change once, at most every `REPORT_INTERVAL_NS`."""

    def __init__(self) -> None:
        self.counts: Counter[tuple[str, str]] = Counter()
        self._last_reported: dict[str, tuple[int, str | None]] = {}

    def update(self, what: str, reason: str | None, now_ns: int) -> Event | None:
        """Count that `what` is withheld for `reason` or sent (None); return an event on a change."""
        if reason is not None:
            self.counts[what, reason] += 1
        last = self._last_reported.get(what)
        if last is not None and (last[1] == reason or now_ns - last[0] < REPORT_INTERVAL_NS):
            return None
        self._last_reported[what] = now_ns, reason
        if reason is not None:
            return Event(now_ns, now_ns, Severity.WARNING, f"{what} withheld: {reason}")
        withheld = sum(count for (name, _), count in self.counts.items() if name == what)
        total = f", {withheld} withheld so far" if withheld else ""
        return Event(now_ns, now_ns, Severity.INFO, f"sending {what}{total}")
