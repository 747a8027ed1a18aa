"""The bank in time: carried and propagated, decided, and the nominal trajectory brought nearer.

What the samples of the channels, the fixes and the correctors have in common. All functions take a state and
return the next one.
"""

from __future__ import annotations

import math

import numpy as np
from msgspec import structs

from companion.estimate import bank as banks
from companion.nav.geometry import displace
from companion.navigator import minimax_bound, own_channel, parallel_filters
from companion.navigator.channel import moved
from companion.navigator.hypotheses import AIRSPEED, JAMMED, Situation
from companion.navigator.inertial_track import Point
from companion.navigator.solution import solve
from companion.navigator.state import (
    EXCLUDED,
    SUSPECT,
    Newborn,
    Settings,
    State,
    Step,
    estimate,
    hypotheses,
    is_jammed,
    with_sensors,
)
from companion.records import Gnss, Stamped, Vector2
from companion.units import SECOND_NS

TURN_S = 5.0  # for so long a change of velocity counts
SILENT_INS_NS = 3 * SECOND_NS // 2
CONFIRM_NS = SECOND_NS  # one fix in disagreement is an outlier: a source is excluded once it lasts
FAR_M, FAST_M_S = 500.0, 5.0  # the nominal trajectory is brought back from this far off


def carried(state: State, t_ns: int, settings: Settings) -> State:
    """With the nominal trajectory carried on to `t_ns`: by its driver, or straight on if that is silent."""
    nominal = state.nominal
    assert nominal is not None
    dt = (t_ns - nominal.t_ns) * 1e-9
    if dt <= 0.0:
        return state
    if nominal.interval is not None:
        if state.sensors.is_silent(nominal.interval.by, t_ns):
            state = propagated(state, settings)
            assert state.nominal is not None
            nominal = own_channel.restart(state.nominal, state.sensors.held, state.nominal.point.v_n[:2])
        return structs.replace(state, nominal=own_channel.carry_on(nominal, state.sensors, t_ns))
    v, a = nominal.point.v_n, nominal.a_n
    point = moved(nominal.point, (v[0] + a[0] * dt, v[1] + a[1] * dt), t_ns)
    return structs.replace(state, nominal=structs.replace(nominal, point=point))


def births_due(state: State, settings: Settings) -> bool:
    """Whether births are due and not readied."""
    if state.bank is None:
        return False
    if (ready := _readied(state)) is not None:
        return not ready.is_reduced
    known = settings.model.hypotheses(Situation())  # the intervals are those of any
    bank = state.bank
    return banks.births_due(bank, known.settings) or banks.jump_births_due(bank, known.layout, known.settings)


def with_births(state: State, record: Stamped, settings: Settings) -> Step:
    """Deferred update: ready the births that are due, for the next propagation, or reduce those readied.

    Until a measurement has judged them, children would raise the protection level.
    """
    ready = _readied(state)
    newborn = _born(state, settings) if ready is None else _reduced(ready, state, settings)
    return structs.replace(state, newborn=newborn), []


def _readied(state: State) -> Newborn | None:
    newborn = state.newborn
    return newborn if newborn is not None and newborn.parent is state.bank else None


def _born(state: State, settings: Settings) -> Newborn:
    """The bank after the births that are due, where any are; not reduced."""
    bank = state.bank
    assert bank is not None
    known = hypotheses(state, settings)
    if not banks.births_due(bank, known.settings):
        return Newborn(bank, banks.jump_births(bank, known.layout, known.settings), is_reduced=True)
    factor = {0: JAMMED, 1: JAMMED} if is_jammed(state) else None
    grown = banks.births(bank, known.layout, known.settings, factor, reduced=False)
    return Newborn(bank, grown, is_reduced=False)


def _reduced(newborn: Newborn, state: State, settings: Settings) -> Newborn:
    if newborn.is_reduced:
        return newborn
    known = hypotheses(state, settings)
    return newborn._replace(bank=banks.reduce(newborn.bank, known.layout, known.settings), is_reduced=True)


def propagated(state: State, settings: Settings) -> State:
    """With the bank at the time of the nominal point; births that are due come first."""
    nominal = state.nominal
    assert nominal is not None
    if state.bank is None or nominal.pending_s <= 0.0:
        return state
    bank = _reduced(_readied(state) or _born(state, settings), state, settings).bank
    known = hypotheses(state, settings)
    kept, turned, i = math.exp(-nominal.pending_s / TURN_S), state.turned, nominal.interval
    change = (i.n1, i.e1) if i is not None and i.by == "imu" else (0.0, 0.0)
    turned = kept * turned[0] + change[0], kept * turned[1] + change[1]
    state = structs.replace(state, newborn=None, turned=turned)
    Phi, Q = settings.model.transition(nominal, len(state.beacons))
    bank = settings.model.on_circle(banks.propagate(bank, known.layout, nominal.pending_s, Phi, Q), Phi)
    if i is None:
        return structs.replace(state, bank=bank, nominal=structs.replace(nominal, since=nominal.point))
    if i.by_sensed_air:
        seen = bank.seen.copy()
        seen[AIRSPEED] = bank.t
        bank = bank._replace(seen=seen)
    nominal = own_channel.restart(nominal, i.by, nominal.point.v_n[:2])
    return structs.replace(state, bank=bank, nominal=nominal)


def decided(state: State, record: Stamped, settings: Settings) -> State:
    """With the decisions read off the bank."""
    assert state.bank is not None
    known = hypotheses(state, settings)
    bank = banks.decide(state.bank, known.layout, known.settings)
    false = tuple(banks.false_probability(bank, known.layout).tolist())
    n = len(false)  # more than before if a beacon joined
    before, certain = (*state.reported, *(0,) * n)[:n], (*state.certain_ns, *(0,) * n)[:n]
    reported, since = list(before), list(certain)
    for i, p in enumerate(false):
        since[i] = (certain[i] or record.t_ns) if p > known.settings.excluded else 0
        lasts = since[i] > 0 and record.t_ns - since[i] >= CONFIRM_NS
        if bank.excluded[i] and (lasts or before[i] == EXCLUDED):
            reported[i] = EXCLUDED
        elif bank.excluded[i] or p > known.settings.suspect:
            reported[i] = SUSPECT
        elif p < known.settings.believed:
            reported[i] = 0
    leading = (bank, banks.estimate(bank, known.layout))
    return structs.replace(
        state, bank=bank, leading=leading, false=false, reported=tuple(reported), certain_ns=tuple(since)
    )


def nearer(state: State, settings: Settings) -> State:
    """With the nominal trajectory moved by the estimated error where it is far off, or as the scheme says."""
    nominal = state.nominal
    assert nominal is not None
    if nominal.interval is None:
        return state  # an INS of its own cannot be corrected
    by = nominal.interval.by
    x = estimate(state, settings).x
    n, e, vn, ve = (float(c) for c in x[:4])
    share = settings.config.estimator.feedback
    if math.hypot(n, e) > FAR_M or (math.hypot(vn, ve) > FAST_M_S and by == "imu"):
        share = 1.0
    if share == 0.0:
        return state
    n, e, vn, ve = -share * n, -share * e, -share * vn, -share * ve
    if by in ("air", "foreign"):
        vn = ve = 0.0  # the velocity is the sensor's, and its error follows from other states
    state = shifted(state, n, e, (vn, ve), nominal.t_ns)
    sums = state.sensors.sums
    if sums is not None:  # the samples of airspeed so far are moved with the nominal velocity, not dropped
        mean_sum = (sums.velocity[0] + sums.samples * vn, sums.velocity[1] + sums.samples * ve)
        state = with_sensors(state, sums=sums._replace(velocity=mean_sum))
    place = displace(*nominal.point.position, n, e, 0.0)
    v = nominal.point.v_n
    velocity = (v[0] + vn, v[1] + ve)
    point = Point(nominal.t_ns, place._replace(alt=nominal.point.position.alt), (*velocity, v[2]))
    nominal = structs.replace(nominal, point=point, since=point)
    return structs.replace(state, nominal=own_channel.restart(nominal, by, velocity))


def shifted(state: State, north: float, east: float, v_n: Vector2 = (0.0, 0.0), t_ns: int = 0) -> State:
    """Move the errors with the nominal trajectory: by (north, east) m and `v_n` (m/s), at `t_ns`."""
    bank = state.bank
    if bank is not None:
        bank = banks.shift(bank, np.array((north, east, *v_n)))
    protection = state.protection
    if protection is not None:
        protection = (*protection[:2], protection[2] + north, protection[3] + east)
    promise = state.guarantee
    if promise.by != "air":  # that is of a trajectory of its own
        promise = minimax_bound.shift(promise, north, east, v_n)
    parallel = state.parallel and parallel_filters.shift(state.parallel, north, east)
    fix = state.gnss_fix and _fix_shifted(*state.gnss_fix, north, east, v_n, t_ns)
    mean = state.velocity_error
    if mean is not None:
        mean = mean._replace(north=mean.north + v_n[0], east=mean.east + v_n[1])
    # the error that was taken off is that of the nominal trajectory as it is now
    pending, half = (
        each and each._replace(centre=(each.centre[0] + north, each.centre[1] + east))
        for each in (state.pending, state.half)
    )
    return structs.replace(
        state,
        bank=bank,
        moved=(state.moved[0] + north, state.moved[1] + east),
        protection=protection,
        guarantee=promise,
        parallel=parallel,
        gnss_fix=fix,
        velocity_error=mean,
        pending=pending,
        half=half,
    )


def widened(state: State, sigma: float) -> State:
    """With an independent position error of one `sigma` (m) more on each axis; bound and filters restart."""
    assert state.bank is not None
    bank = banks.inflate(state.bank, (0, 1), sigma)
    return structs.replace(state, bank=bank, guarantee=minimax_bound.Guarantee(), parallel=None)


def _fix_shifted(
    record: Gnss, point: Point, north: float, east: float, v_n: Vector2, t_ns: int
) -> tuple[Gnss, Point]:
    """Return a GNSS fix beside the nominal trajectory as if that had always been where it is now."""
    since = (point.t_ns - t_ns) * 1e-9
    place = displace(*point.position, north + v_n[0] * since, east + v_n[1] * since, 0.0)
    return record, point._replace(position=point.position._replace(lat=place.lat, lon=place.lon))


def solved_if_due(state: State, record: Stamped, settings: Settings) -> Step:
    """Solve if the pace of the output has come."""
    if record.t_ns < state.next_ns or not state.fixed or state.nominal is None:
        return state, []
    state, solution = solve(state, record.rx_ns, settings)
    if solution:
        period = round(1e9 / settings.config.output.pace_hz)
        state = structs.replace(
            state, next_ns=max(state.next_ns + period, state.nominal.t_ns if state.nominal else 0)
        )
    return state, solution


def is_silent(state: State, t_ns: int) -> bool:
    """Whether an INS has given nothing for too long to carry it on."""
    assert state.nominal is not None
    last_ns = state.ins.t_ns if state.ins else state.nominal.t_ns
    return state.nominal.interval is None and t_ns - last_ns > SILENT_INS_NS


def estimated_velocity(state: State) -> Vector2:
    """Estimated velocity over ground, north and east, m/s."""
    assert state.nominal is not None
    v_n = state.nominal.point.v_n
    if state.bank is None:
        return v_n[0], v_n[1]
    x = state.bank.x[int(state.bank.L.argmax())]
    return v_n[0] - float(x[2]), v_n[1] - float(x[3])


def driver(state: State) -> str | None:
    """What moves the nominal trajectory now; None before there is one."""
    return None if state.nominal is None else state.nominal.driver
