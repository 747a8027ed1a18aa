"""Samples of an INS of its own, and of its correctors: airspeed, lines of position, stars, a second INS."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

from msgspec import structs

from companion.navigator import (
    air_data_channel,
    corrector_measurements,
    height_error,
    inertial_track,
    measurements,
    own_channel,
    parallel_filters,
)
from companion.navigator.channel import Nominal
from companion.navigator.corrected_ins import CorrectedIns
from companion.navigator.corrector_measurements import CorrectorRows
from companion.navigator.ground import FLYING_M_S
from companion.navigator.inertial_track import Point
from companion.navigator.progress import (
    carried,
    decided,
    is_silent,
    propagated,
    shifted,
    solved_if_due,
    widened,
)
from companion.navigator.state import NEAR_S, Settings, State, Step, corrected, gnss_climb, hypotheses
from companion.records import (
    AirData,
    Attitude,
    LocalPosition,
    Output,
    Pressure,
    Rejection,
    Reset,
    SecondIns,
    Stamped,
    StarFix,
)
from companion.units import SECOND_NS

JUMP_SPREAD_S = 0.5  # across a longer silence a turn explains a step as well as a jump does
CORRECTOR_AIRSPEED_NS = 5 * SECOND_NS  # gusts last seconds: beside an INS more often adds nothing


def position(state: State, record: LocalPosition, settings: Settings) -> Step:
    """Move the nominal trajectory to the position of the INS; a step beyond its velocity is a jump."""
    state = structs.replace(state, local=record)
    if state.origin is None:
        waiting = state.waiting_ns or record.t_ns
        return structs.replace(state, waiting_ns=waiting), []
    new = inertial_track.point(record, state.origin)
    nominal, out = state.nominal, list[Output]()
    if nominal is None:
        state = structs.replace(state, nominal=Nominal(new, (0.0, 0.0), new), ins=new)
        return solved_if_due(state, record, settings)
    last = state.ins or nominal.point
    dt = (new.t_ns - last.t_ns) * 1e-9
    if dt <= 0.0 or new.t_ns < nominal.t_ns:
        return state, []
    state, out = _jump_removed(state, last, new, record)
    a_n = ((new.v_n[0] - last.v_n[0]) / dt, (new.v_n[1] - last.v_n[1]) / dt)
    assert state.nominal is not None
    nominal = structs.replace(state.nominal, point=new, a_n=a_n)
    state = structs.replace(state, nominal=nominal, ins=new)
    if nominal.pending_s >= NEAR_S and state.bank is not None:
        state = decided(propagated(state, settings), record, settings)
    state, more = solved_if_due(state, record, settings)
    return state, [*out, *more]


def _jump_removed(state: State, last: Point, new: Point, record: LocalPosition) -> Step:
    """Move the errors with a jump of the channel; across a silence what is left may be a turn or a step."""
    out = list[Output]()
    north, east, down = inertial_track.beyond(last, new)
    length, silent = math.hypot(north, east), (new.t_ns - last.t_ns) * 1e-9
    if abs(down) > height_error.greatest_change(silent):
        state = structs.replace(state, level=height_error.stepped(state.level, -down))
        out.append(_channel(record, f"height stepped by {-down:.1f} m"))
    most = inertial_track.unnoticed(silent)
    if length > most:
        state = shifted(state, north, east)
        out.append(_channel(record, f"jumped by {length:.1f} m"))
    if length > inertial_track.JUMP_M and silent > JUMP_SPREAD_S and state.bank is not None:
        state = widened(state, min(length, most))
        out.append(_channel(record, f"no local position for {silent:.1f} s"))
    return state, out


def sensed(state: State, record: Attitude | Pressure, settings: Settings) -> Step:
    """Remember attitude and pressure for the airspeed beside an INS."""
    s = state.sensors
    if isinstance(record, Pressure):
        rejection = air_data_channel.step(s.air, record, gnss_climb(state, record.t_ns))
        if rejection is not None:
            return state, [rejection]
    return structs.replace(state, sensors=structs.replace(s, air=air_data_channel.sense(s.air, record))), []


def airspeed(state: State, record: AirData, settings: Settings) -> Step:
    """Use airspeed beside an INS, every few seconds, in flight."""
    s, nominal = state.sensors, state.nominal
    if nominal is None or not own_channel.airspeed_is_sensed(s, record):
        return state, []
    V = own_channel.air_velocity(s, record, nominal.point.position.alt)
    if V is None or math.hypot(*V) < FLYING_M_S:
        return state, []
    if record.t_ns - s.measured_ns < CORRECTOR_AIRSPEED_NS:
        return state, []
    state = structs.replace(state, sensors=structs.replace(s, measured_ns=record.t_ns))
    return _corrected_by(state, record, settings, "airspeed")


def corrector(name: str) -> Callable[[State, Any, Settings], Step]:
    """Return the step of the records of one corrector."""

    def use(state: State, record: Any, settings: Settings) -> Step:
        return _corrected_by(state, record, settings, name)

    return use


def _corrected_by(state: State, record: Any, settings: Settings, name: str) -> Step:
    """Update by a corrector; nothing before the first fix."""
    if state.nominal is None or state.bank is None or is_silent(state, record.t_ns):
        return state, []
    state = propagated(carried(state, record.t_ns, settings), settings)
    assert state.nominal is not None
    assert state.bank is not None
    rows = _rows_of(state, record, settings)
    if rows is None:
        return state, [
            Rejection(record.t_ns, record.rx_ns, name, "star below the horizon or near the zenith")
        ]
    taken = measurements.corrector(state.bank, hypotheses(state, settings), rows)
    state, out = decided(structs.replace(state, bank=taken.bank), record, settings), list[Output]()
    if not taken.accepted:
        why = "outlier: normalised squared innovation"
        out.append(Rejection(record.t_ns, record.rx_ns, name, why, taken.nis))
    elif state.parallel is not None and state.nominal is not None:
        z, H, R, kind = rows
        parallel = parallel_filters.add(
            state.parallel,
            state.nominal.point,
            kind,
            z,
            H,
            R,
            white=True,
            config=settings.config,
            channel=settings.model.channel,
        )
        state = structs.replace(state, parallel=parallel)
    return state, out


def _rows_of(state: State, record: Any, settings: Settings) -> CorrectorRows | None:
    channel, nominal = settings.model.channel, state.nominal
    assert isinstance(channel, CorrectedIns)
    assert nominal is not None
    if isinstance(record, AirData):
        V = own_channel.air_velocity(state.sensors, record, nominal.point.position.alt)
        assert V is not None
        gust = settings.config.air_data.gust_m_s
        heading = math.atan2(V[1], V[0])
        return corrector_measurements.airspeed(channel, nominal.point, math.hypot(*V), heading, gust)
    if isinstance(record, SecondIns):
        return corrector_measurements.second_ins(channel, nominal.point, record)
    point, centre = corrected(nominal.point, state, settings)
    if isinstance(record, StarFix):
        return corrector_measurements.star(channel, point, centre, record)
    return corrector_measurements.range_difference(channel, point, centre, record)


def _channel(record: Stamped, why: str) -> Reset:
    return Reset(record.t_ns, record.rx_ns, "inertial channel", why)
