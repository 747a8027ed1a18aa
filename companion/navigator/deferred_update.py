"""What a fix teaches once its solution is out: `carry, outputs = learn(carry, lesson, settings)`.

The radio fix alone teaches the guaranteed predictor (and, of dead reckoning, the restrictive estimator);
its measurements one by one teach the integrity monitor.
What the monitor decides is carried out here: a source left out takes with it what it has taught, and is heard
again within the guaranteed bound.
"""

from __future__ import annotations

import math

import numpy as np

from companion.estimate.filterbank import INERTIAL, Measurement
from companion.estimate.fusion import Azimuth, Height, NoFix, Range, maximum_likelihood
from companion.estimate.monitor import Exclusion
from companion.nav.geometry import displace
from companion.navigator import (
    gnss_beacon_check,
    inertial_track,
    integrity,
    minimax_bound,
    restrictive_filter,
)
from companion.navigator.fix_observations import Heard
from companion.navigator.gnss_beacon_check import GNSS
from companion.navigator.inertial_track import Point
from companion.navigator.integrity import Watch
from companion.navigator.minimax_bound import Bounded
from companion.navigator.state import Carry, Lesson, Settings, Step
from companion.navigator.wind_error_model import WindError
from companion.records import Fix, Gnss, Output, Rejection, RsbnFix, Source

SILENT_NS = 1_000_000_000  # the monitor is carried on without a fix once it is this old


def learn(carry: Carry, lesson: Lesson, settings: Settings) -> Step:
    """All that is to be learnt of one fix."""
    carry, taken, out = _watched(carry, lesson, settings)
    if lesson.heard is None or not taken:
        return carry, out
    carry, told = _teach(carry, lesson.heard, lesson.ins, lesson.record, settings)
    return carry, [*out, *told]


def unheard(carry: Carry, settings: Settings) -> Carry:
    """While nothing is heard the monitor's solutions spread all the same."""
    ins = carry.track[-1]
    if carry.watch is None or ins.t_ns - carry.watch.monitor.bank.t_ns < SILENT_NS:
        return carry
    w = _arrived(carry, carry.watch, ins, settings)
    return carry._replace(watch=integrity.protected(w, settings.allotment, settings.config.integrity))


def _watched(carry: Carry, lesson: Lesson, settings: Settings) -> tuple[Carry, bool, list[Output]]:
    """The monitor hears the measurements one by one, and what it decides is carried out; whether nothing
    spoke against what was believed.
    """
    record, ins = lesson.record, lesson.ins
    w = _arrived(carry, carry.watch or integrity.begin(ins.t_ns, settings.watched), ins, settings)
    taken, out = True, list[Output]()
    w, measurements = _measured(w, lesson, settings)
    for measurement, z in measurements:
        if integrity.excluded(w, measurement.source):
            carry, w, told = _offered(carry, w, measurement, record, settings)
            out += told
            continue
        if lesson.proof:
            w = integrity.doubted(w, measurement)
        w, refusal = integrity.hear(w, measurement, settings.allotment)
        taken = taken and refusal is None
        if refusal is None and z is not None:
            compared = gnss_beacon_check.compared(
                w.sights, w.monitor, measurement.source, z, ins, settings.watched
            )
            w = w._replace(sights=compared)
    known, unclear = w.exclusions, w.monitor.unresolved
    w = integrity.decide(w, settings.watched, settings.allotment, settings.config)
    for exclusion in w.exclusions:
        if exclusion not in known:
            carry, taken = _left_out(carry, exclusion, w, settings), False
    if w.monitor.unresolved:  # what is promised rests on nothing that may be a lie
        taken = False
        if not unclear:
            carry = carry._replace(guarantee=minimax_bound.forget(carry.guarantee, integrity.sound_ns(w)))
    if integrity.excluded(w, INERTIAL):  # only the monitor lets it loose
        carry = carry._replace(state=integrity.solution(w), jumps=None)
    return carry._replace(watch=w), taken, out


def _measured(
    w: Watch, lesson: Lesson, settings: Settings
) -> tuple[Watch, list[tuple[Measurement, Azimuth | Range | None]]]:
    """What the lesson's fix says to the monitor, its sources joined, each with the sight that it is of."""
    record = lesson.record
    if isinstance(record, Gnss):
        told = integrity.of_gnss(record, lesson.ins, settings.watched, settings.config)
        return w._replace(sights=gnss_beacon_check.noted(w.sights, w.monitor.bank.t_ns, told)), [(told, None)]
    w, measurements = integrity.met(w, record.beacon), list[tuple[Measurement, Azimuth | Range | None]]()
    for z in lesson.sights:
        assert isinstance(z, Azimuth | Range)
        w, measurement = integrity.of_beacon(w, integrity.named(record.beacon, z), z, settings.config)
        if measurement is not None:
            measurements.append((measurement, z))
    return w, measurements


def _arrived(carry: Carry, w: Watch, ins: Point, settings: Settings) -> Watch:
    return integrity.advance(
        w, ins, inertial_track.acceleration(carry.track), settings.watched, settings.config
    )


def _offered(
    carry: Carry, w: Watch, measurement: Measurement, record: Gnss | RsbnFix, settings: Settings
) -> tuple[Carry, Watch, list[Output]]:
    """What an excluded source says: refused with its distance from what is guaranteed, or heard again."""
    carry, bounded = _guaranteed(carry, record.t_ns, settings)
    found = integrity.offer(w, measurement, bounded, settings.allotment, settings.config)
    if found.back:
        return carry, found.watch, []
    value = found.value if math.isfinite(found.value) else None
    why = "excluded; its distance from the guaranteed prediction"
    source = f"gnss {record.receiver}" if isinstance(record, Gnss) else measurement.source
    return carry, found.watch, [Rejection(record.t_ns, record.rx_ns, source, why, value, found.limit)]


def _guaranteed(carry: Carry, t_ns: int, settings: Settings) -> tuple[Carry, Bounded | None]:
    """The guaranteed prediction at `t_ns`, or at the last forecast where that is later by a moment."""
    held = carry.guarantee.held
    at_ns = t_ns if held is None else max(t_ns, held[0].t_ns)
    promise, bounded = minimax_bound.bounded(carry.guarantee, at_ns, settings.config.predictor)
    return carry._replace(guarantee=promise), bounded


def _left_out(carry: Carry, exclusion: Exclusion, w: Watch, settings: Settings) -> Carry:
    """Without what the source has taught, as far back as its exclusion goes: the error state is the monitor's
    surviving solution.

    Beside GNSS a beacon weighs nothing in a fix: of what it taught only that since GNSS was last heard goes.
    """
    promise, since = carry.guarantee, exclusion.since_ns
    carry = carry._replace(state=integrity.solution(w), jumps=None)
    if exclusion.source == INERTIAL:
        return carry._replace(guarantee=minimax_bound.begin(settings.config), restrictive=None)
    if exclusion.source == GNSS:
        carry = carry._replace(gnss_ns=None, gnss_heard=None)
    else:
        part = Source.AZIMUTH if exclusion.source.endswith("azimuth") else Source.RANGE
        left = carry.rsbn_told & ~part
        carry = carry._replace(rsbn_told=left, rsbn_ns=carry.rsbn_ns if left else None)
        since = max(since, carry.gnss_ns or 0)
    return carry._replace(guarantee=minimax_bound.forget(promise, since), restrictive=None)


def _teach(carry: Carry, heard: Heard, ins: Point, record: Gnss | RsbnFix, settings: Settings) -> Step:
    """The radio fix alone, the INS left out: it teaches the guaranteed predictor and goes to the log."""
    height = Height(0.0, settings.config.inertial.height_sigma_m)
    try:
        fix = maximum_likelihood((*heard.observations, height), start=np.zeros(3))
    except NoFix:
        return carry, []  # an azimuth or a range alone is no fix; the error state has had its use of it
    east, north, up = (float(c) for c in fix.position)
    correction = (-north, -east)
    (var_e, cov), var_n = fix.covariance[0, :2].tolist(), float(fix.covariance[1, 1])
    sigma = (math.sqrt(var_n), math.sqrt(var_e))
    g = minimax_bound.learn(
        carry.guarantee, record.t_ns, "position", correction, sigma, settings.config.predictor
    )
    lat, lon, alt = displace(*ins.position, north, east, -up)
    out = Fix(
        record.t_ns,
        record.rx_ns,
        lat,
        lon,
        alt,
        correction,
        (var_n, cov, var_e),
        int(heard.sources),
        fix.cost,
        fix.degrees_of_freedom,
        fix.iterations,
        carry.innovation,
    )
    return _restrict(carry._replace(guarantee=g), heard, ins, out, settings), [out]


def _restrict(carry: Carry, heard: Heard, ins: Point, fix: Fix, settings: Settings) -> Carry:
    """The same fix for the restrictive estimator, which is kept of dead reckoning only."""
    unit = settings.unit
    if not isinstance(unit, WindError) or carry.state is None:
        return carry
    if carry.restrictive is None:
        return carry._replace(restrictive=restrictive_filter.begin(carry.state, ins.v_n, unit))
    var_n, cov, var_e = fix.covariance
    covariance = np.array([[var_n, cov], [cov, var_e]])
    white = not heard.sources & Source.GNSS
    learnt = restrictive_filter.learn(
        carry.restrictive, fix.t_ns, np.array(fix.correction_n), covariance, white, unit
    )
    return carry._replace(restrictive=learnt)
