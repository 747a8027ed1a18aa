"""Guaranteed bound of the position that is sent, kept by the navigator beside its bank of hypotheses.

Radio-only corrections (nominal minus fix) are averaged over short bins into a window along the transition of
the channel's error model. From it the restricted Bayes estimate is computed, linear in the fixes, whose
worst r.m.s. error over every correlation of their errors and of the unknown force is known, and at most 1.2
times the least that any estimate could promise. The bank's estimate is no linear function of the fixes, so
what is sent has the bound of the linear estimate and the distance to it (the triangle inequality); both are
of one model, and the distance is small beside the bound.

All of it runs after the solution is out, one small piece after each record: the window is extended, one
target is solved, or the last solutions are carried on and judged again. Within a second the error moves with
the velocity of the linear estimate, and the bound grows by the velocity's bound. Where the residuals of the
window contradict what is stated, all bounds are wider by their ratio, and an event reports it.

An INS has the errors of its unit (`nav.bounded_channel`). Dead reckoning by airspeed and a foreign velocity
have a velocity error that wanders and jumps. Strapdown with the autopilot's attitude has no bound: nothing
bounds the error of that attitude in a turn. The own channel reckons by airspeed alone beside it for this.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from companion.config import Config
from companion.estimate.minimax_lp import Infeasible
from companion.estimate.predictor import Anchored, Estimate, Solved, Start, Step, Window, anchor
from companion.nav.bounded_channel import BoundedDrift, BoundedIns, Motion, UnitErrors
from companion.navigator.channel import Nominal
from companion.navigator.inertial_track import Point
from companion.records import Bounds, Prediction, Vector2
from companion.units import G0, SECOND_NS, Floats

CHUNK_S = 1.0  # the transition is extended so often: a turn of 4 degrees
SILENT_S = 60.0  # after a longer silence of the channel a new window begins
STRAIGHT_S = 30.0  # steps ahead, straight on
UNLIKE = 2.0  # a fix this many times better or worse than its bin begins a new one
PIECE_NS = SECOND_NS // 10  # at most one piece of work so often
#: Estimates of a target are sought once the window has new fixes, and so often without. In between those of
#: now are carried on by those of the velocity, and judged again so often.
NOW_NS, SELDOM_NS, JUDGED_NS = 3 * SECOND_NS, 10 * SECOND_NS, SECOND_NS
HOPELESS_M = 1e6  # a bound beyond this is as good as none: the window is too short for so far ahead
POSITION, VELOCITY, TILT, DRIFT = (0, 1), (2, 3), (4, 5), (7, 8)  # states

Channel = BoundedIns | BoundedDrift


class Bin(NamedTuple):
    """Weighted sums over the fixes of one bin, rows on the state at the last node."""

    start_ns: int
    scale: float
    weight: float
    time_s: float
    rows: Floats
    value: Vector2
    sigma: Vector2


class Reach(NamedTuple):
    """Transition since the last node of the window, at the point `at`."""

    at: Point
    node_ns: int
    Phi: Floats
    B: Floats
    Q: Floats


class Task(NamedTuple):
    """Target of the predictor: one state now, or `ahead_s` later."""

    state: int
    ahead_s: float
    every_ns: int


class Answer(NamedTuple):
    """Solution of a task for `t_ns`, None where the fixes do not determine it; and the state it is of.

    It was sought at `sought_ns`, and may have been carried on to `t_ns`.
    """

    t_ns: int
    state: int
    solved: Solved | None
    sought_ns: int


class Guarantee(NamedTuple):
    """Window of one channel, what is not yet in it, and the last answers."""

    by: str = ""  # what moves the nominal trajectory
    window: Window | None = None
    reach: Reach | None = None
    bins: tuple[Bin, ...] = ()
    anchored: Anchored | None = None
    fixed_ns: int = 0  # when the window was last given fixes
    widening: float = 1.0
    answers: tuple[Answer | None, ...] = ()
    worked_ns: int = 0


class Linear(NamedTuple):
    """Error of the channel now by one linear estimate: m, m/s, their r.m.s. expected and guaranteed."""

    error_n: Vector2
    velocity_error_n: Vector2
    expected_n: Vector2
    velocity_expected_n: Vector2
    bound_n: Vector2
    velocity_bound_n: Vector2

    def about(self, apart: Vector2, velocity_apart: Vector2) -> Linear:
        """The same of another trajectory, from which this one is so far apart (m, m/s)."""
        (n, e), (vn, ve) = self.error_n, self.velocity_error_n
        return self._replace(
            error_n=(n - apart[0], e - apart[1]),
            velocity_error_n=(vn - velocity_apart[0], ve - velocity_apart[1]),
        )


class Guaranteed(NamedTuple):
    """Estimates of the channel's error now, and the bounds of all quantities of the first."""

    restricted: Linear
    minimax: Linear
    bounds: Bounds

    def about(self, apart: Vector2, velocity_apart: Vector2) -> Guaranteed:
        """The same of another trajectory, from which the one of the window is so far apart (m, m/s)."""
        restricted, minimax = (each.about(apart, velocity_apart) for each in (self.restricted, self.minimax))
        return Guaranteed(restricted, minimax, self.bounds)


def law(config: Config, by: str, v_n: tuple[float, ...] = (0.0, 0.0)) -> Channel | None:
    """Return the error model of what moves the nominal trajectory at `v_n`; None where it has no bound."""
    correlation_s = config.gnss.correlation_s
    if by == "ins":
        unit = config.inertial
        bias = 1e-6 * G0 * unit.accelerometer_bias_ug
        errors = UnitErrors(
            gyro=math.radians(unit.gyro_drift_deg_h) / 3600.0,
            gyro_s=3600.0 * unit.gyro_correlation_h,
            tilt_walk=math.radians(unit.angle_random_walk_deg_sqrt_h) / 60.0,
            accelerometer=bias,
            accelerometer_s=3600.0 * unit.accelerometer_correlation_h,
            velocity_walk=unit.velocity_noise_m_s_sqrt_s,
            velocity=unit.velocity_m_s,
            tilt=math.hypot(math.radians(unit.tilt_arcsec / 3600.0), bias / G0),  # levelled by them
            heading=math.radians(unit.heading_arcmin / 60.0),
            gyro_scale=1e-6 * unit.gyro_scale_ppm,
            accelerometer_scale=1e-6 * unit.accelerometer_scale_ppm,
        )
        return BoundedIns(errors, correlation_s, unit.strapped_down)
    air = config.air_data
    walk = air.wind_walk_m_s_sqrt_s
    if by == "air":
        scale, heading = 0.01 * air.airspeed_percent, math.radians(air.heading_deg)
        crab = math.radians(air.crab_deg) * math.hypot(*v_n[:2])
        return BoundedDrift(air.wind_m_s, walk, scale, heading, crab, air.crab_s, correlation_s)
    return BoundedDrift(air.wind_m_s, walk, correlation_s=correlation_s) if by == "foreign" else None


def tasks(config: Config, channel: Channel) -> tuple[Task, ...]:
    """Return all targets: position and velocity now, tilt and drift of an INS, position ahead."""
    now = [Task(state, 0.0, NOW_NS) for state in (*POSITION, *VELOCITY)]
    if isinstance(channel, BoundedIns):
        now += [Task(state, 0.0, SELDOM_NS) for state in (*TILT, *DRIFT)]
    ahead = [Task(k, 60.0 * m, SELDOM_NS) for m in config.predictor.ahead_min for k in POSITION]
    return (*now, *ahead)


# ---------------------------------------------------------------------------------------------------------
# Fixes
# ---------------------------------------------------------------------------------------------------------


def is_due(g: Guarantee, nominal: Nominal) -> bool:
    """Whether `follow` or `refresh` has anything to do: asked after every record."""
    return _is_behind(g, nominal) or _has_work(g, nominal)


def _is_behind(g: Guarantee, nominal: Nominal) -> bool:
    reach = g.reach
    if nominal.driver != g.by:
        return True
    return reach is not None and not 0.0 <= (nominal.point.t_ns - reach.at.t_ns) * 1e-9 < CHUNK_S


def _has_work(g: Guarantee, nominal: Nominal) -> bool:
    window = g.window
    if window is None or g.reach is None or not window.fixes:
        return False
    return abs(nominal.t_ns - g.worked_ns) >= PIECE_NS


def follow(g: Guarantee, nominal: Nominal, config: Config) -> Guarantee:
    """Extend the transition to the nominal point, and the window when a bin is over."""
    if not _is_behind(g, nominal):
        return g
    by, point, reach = nominal.driver, nominal.point, g.reach
    channel = law(config, by, point.v_n)
    if channel is None:
        return Guarantee(by)
    seconds = 0.0 if reach is None else (point.t_ns - reach.at.t_ns) * 1e-9
    if by != g.by or reach is None or not 0.0 <= seconds <= SILENT_S:
        window = Window.begin(point.t_ns * 1e-9, channel)
        return Guarantee(by, window, _reach(point, channel.n))
    Phi, B, Q = channel.step(Motion(point.position.lat, reach.at.v_n[:2], point.v_n[:2], seconds))
    reach = Reach(point, reach.node_ns, Phi @ reach.Phi, Phi @ reach.B + B, Phi @ reach.Q @ Phi.T + Q)
    g = g._replace(reach=reach)
    bin_ns = round(1e9 * config.predictor.bin_s)
    return _closed(g, config) if point.t_ns - reach.node_ns >= bin_ns or _returned(g, bin_ns) else g


def _reach(point: Point, n: int) -> Reach:
    return Reach(point, point.t_ns, np.eye(n), np.zeros((n, 2)), np.zeros((n, n)))


def _returned(g: Guarantee, bin_ns: int) -> bool:
    """Whether a first second of fixes after a time without waits in the bins."""
    if g.window is None or g.reach is None or not g.bins or not g.window.fixes:
        return False
    silent_s = g.bins[0].start_ns * 1e-9 - g.window.fixes[-1].t_s
    return silent_s > 2e-9 * bin_ns and g.reach.at.t_ns - g.bins[0].start_ns >= SECOND_NS


def _closed(g: Guarantee, config: Config) -> Guarantee:
    """With a node at the point reached, and the fixes of the open bins in the window."""
    assert g.reach is not None
    assert g.window is not None
    reach, C = g.reach, g.window.C[-1]
    window = g.window.extend(reach.at.t_ns * 1e-9, reach.Phi, reach.B, reach.Q)
    for full in g.bins:
        w = full.weight
        window = window.with_fix(
            full.start_ns * 1e-9 + full.time_s / w,
            full.rows @ C / w,
            np.array(full.value) / w,
            np.array(full.sigma) / w,
            60.0 * config.predictor.window_min,
        )
    g = g._replace(window=window, reach=_reach(reach.at, len(C)))
    return g._replace(bins=(), anchored=None, fixed_ns=reach.at.t_ns) if g.bins else g


def add_fix(g: Guarantee, t_ns: int, value: Vector2, sigma: Vector2) -> Guarantee:
    """Add a correction `value` of the position, north and east (m), of r.m.s. error `sigma`."""
    if g.reach is None:
        return g
    reach, scale = g.reach, sigma[0] + sigma[1]
    weight = 1.0 / scale**2
    alike = [b for b in g.bins if 1.0 / UNLIKE < scale / b.scale < UNLIKE]
    if alike:
        mine = alike[0]
    else:
        mine = Bin(t_ns, scale, 0.0, 0.0, np.zeros((2, len(reach.Phi))), (0.0, 0.0), (0.0, 0.0))
    rows = reach.Phi[:2] + (t_ns - reach.at.t_ns) * 1e-9 * reach.Phi[2:4]
    new = mine._replace(
        weight=mine.weight + weight,
        time_s=mine.time_s + weight * (t_ns - mine.start_ns) * 1e-9,
        rows=mine.rows + weight * rows,
        value=(mine.value[0] + weight * value[0], mine.value[1] + weight * value[1]),
        sigma=(mine.sigma[0] + weight * sigma[0], mine.sigma[1] + weight * sigma[1]),
    )
    return g._replace(bins=(*(b for b in g.bins if b is not mine), new))


def shift(g: Guarantee, north: float, east: float, v_n: Vector2 = (0.0, 0.0)) -> Guarantee:
    """Move all errors measured with a jump of the nominal trajectory, m.

    A jump of its velocity (m/s) begins a new window: no bound is stated of the sum of such jumps.
    """
    if g.window is None or any(v_n):
        return Guarantee()
    bins = tuple(
        b._replace(value=(b.value[0] + b.weight * north, b.value[1] + b.weight * east)) for b in g.bins
    )
    window = g.window.shift(np.array((north, east)))
    answers = tuple(_shifted(a, (north, east)) for a in g.answers)
    return g._replace(window=window, bins=bins, anchored=None, answers=answers)


def _shifted(answer: Answer | None, offset: Vector2) -> Answer | None:
    if answer is None or answer.solved is None or answer.state not in POSITION:
        return answer
    s, by = answer.solved, offset[answer.state]
    kalman, minimax, restricted = (
        e._replace(value=e.value + by) for e in (s.kalman, s.minimax, s.restricted)
    )
    return answer._replace(solved=s._replace(kalman=kalman, minimax=minimax, restricted=restricted))


def tuned(g: Guarantee) -> Guarantee:
    """Keep the window under other settings, and answer anew."""
    return g._replace(anchored=None, answers=())


# ---------------------------------------------------------------------------------------------------------
# Answers
# ---------------------------------------------------------------------------------------------------------


def refresh(g: Guarantee, nominal: Nominal, config: Config) -> Guarantee:
    """Do the piece of work that is most overdue: make the program of the window, or solve one target."""
    if not _has_work(g, nominal):
        return g
    window, t_ns = g.window, nominal.t_ns
    assert window is not None
    channel, g = law(config, g.by, nominal.point.v_n), g._replace(worked_ns=t_ns)
    if channel is None:
        return g
    if g.anchored is None:
        anchored = anchor(window, channel)
        return g._replace(anchored=anchored, widening=anchored.grouped.widening)
    todo = tasks(config, channel)
    answers = g.answers if len(g.answers) == len(todo) else (None,) * len(todo)
    late = [
        math.inf if a is None or a.sought_ns <= g.fixed_ns else (t_ns - a.sought_ns) / task.every_ns
        for task, a in zip(todo, answers, strict=True)
    ]
    k = max(range(len(todo)), key=late.__getitem__)
    if late[k] < 1.0:
        return _carried(g, t_ns)
    before = answers[k]
    start = before.solved.start if before is not None and before.solved is not None else None
    answer = Answer(t_ns, todo[k].state, _solved(g, todo[k], channel, start), t_ns)
    return g._replace(answers=(*answers[:k], answer, *answers[k + 1 :]))


def _carried(g: Guarantee, t_ns: int) -> Guarantee:
    """With the solutions for now carried on to `t_ns` if they are older than JUDGED_NS."""
    assert g.anchored is not None
    assert g.window is not None
    states = (*POSITION, *VELOCITY)
    now = [(a, a.solved) for a in g.answers[: len(states)] if a is not None and a.solved is not None]
    if len(now) < len(states) or t_ns - min(a.t_ns for a, _ in now) < JUDGED_NS:
        return g
    rates = [*(solved for _, solved in now[len(POSITION) :]), None, None]
    targets = g.anchored.targets(g.window, states, _since_node(g))
    answers = [
        a._replace(t_ns=t_ns, solved=g.anchored.carried(solved, rate, (t_ns - a.t_ns) * 1e-9, target))
        for (a, solved), rate, target in zip(now, rates, targets, strict=True)
    ]
    return g._replace(answers=(*answers, *g.answers[len(states) :]))


def _since_node(g: Guarantee) -> list[Step]:
    """The step from the last node to the point reached."""
    assert g.reach is not None
    seconds = (g.reach.at.t_ns - g.reach.node_ns) * 1e-9
    return [Step(seconds, g.reach.Phi, g.reach.B)] if seconds > 0.0 else []


def _solved(g: Guarantee, task: Task, channel: Channel, start: Start | None) -> Solved | None:
    assert g.anchored is not None
    assert g.reach is not None
    assert g.window is not None
    steps = _since_node(g)
    count = math.ceil(task.ahead_s / STRAIGHT_S)
    if count:
        point, dt = g.reach.at, task.ahead_s / count
        Phi, B, _ = channel.step(Motion(point.position.lat, point.v_n[:2], point.v_n[:2], dt))
        steps += [Step(dt, Phi, B)] * count
    try:
        return g.anchored.solve(g.anchored.targets(g.window, (task.state,), steps)[0], start)
    except Infeasible:
        return None


def guaranteed(g: Guarantee, t_ns: int) -> Guaranteed | None:
    """Return the estimates of the channel's error at `t_ns` with their bounds; None where there are none."""
    found = [None if a is None or a.solved is None else (a.t_ns, a.solved) for a in g.answers]
    now = [one for one in found[:4] if one is not None]
    if len(now) < 4 or max(s.restricted.bound for _, s in now[:2]) * g.widening > HOPELESS_M:
        return None
    restricted = _linear([(at, s.restricted) for at, s in now], t_ns, g.widening)
    minimax = _linear([(at, s.minimax) for at, s in now], t_ns, g.widening)
    later: list[Vector2 | None] = [None, None]
    if g.by == "ins":
        for k, first in enumerate((4, 6)):
            pair = [one for one in found[first : first + 2] if one is not None]
            if len(pair) == 2:
                north, east = (g.widening * s.restricted.bound for _, s in pair)
                later[k] = (north, east)
    bounds = Bounds(
        optimum_n=minimax.bound_n,
        gap=max(s.gap for _, s in now[:2]),
        widening=g.widening,
        tilt_n=later[0],
        drift_n=later[1],
    )
    return Guaranteed(restricted, minimax, bounds)


def _linear(found: list[tuple[int, Estimate]], t_ns: int, widening: float) -> Linear:
    """Carry position and velocity (north, east of each) on to `t_ns`."""
    axes = []
    for (at, position), (_, velocity) in zip(found[:2], found[2:], strict=True):
        dt = (t_ns - at) * 1e-9
        grown = widening * (position.bound + abs(dt) * velocity.bound)
        axes.append(
            (
                position.value + dt * velocity.value,
                velocity.value,
                position.expected + abs(dt) * velocity.expected,
                velocity.expected,
                grown,
                widening * velocity.bound,
            )
        )
    return Linear(*zip(*axes, strict=True))


def ahead(g: Guarantee, config: Config) -> tuple[Prediction, ...]:
    """Return the predictions for the minutes ahead that are asked for, as far as they are known."""
    minutes = config.predictor.ahead_min
    found = g.answers[len(g.answers) - 2 * len(minutes) :]
    predictions = []
    for m, north, east in zip(minutes, found[::2], found[1::2], strict=False):
        solved = [a.solved for a in (north, east) if a is not None and a.solved is not None]
        if len(solved) < 2:
            continue
        n, e = solved
        wide = g.widening
        if max(n.restricted.bound, e.restricted.bound) * wide < HOPELESS_M:
            predictions.append(
                Prediction(
                    60.0 * m,
                    (wide * n.restricted.bound, wide * e.restricted.bound),
                    (n.restricted.expected, e.restricted.expected),
                    (wide * n.minimax.bound, wide * e.minimax.bound),
                )
            )
    return tuple(predictions)
