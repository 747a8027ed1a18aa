"""One step of the navigator: `state, outputs = step(state, record, settings)`, the state immutable.

Online flight, replay and late measurements all go through this one function. A record either moves the
nominal trajectory (a channel's sample), is remembered (attitude, pressure, flags), or is a measurement of
the bank of hypotheses. The bank is propagated only at measurements, or after half a second without one. The
solution is the nominal trajectory less its estimated error.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

from msgspec import structs

from companion.navigator import fixes, ins_samples, own_samples
from companion.navigator.local_origin import LIVE_WINDOW_NS, infer_origin
from companion.navigator.own_channel import OwnChannel, Sensors
from companion.navigator.progress import widened
from companion.navigator.state import Settings, State, Step
from companion.records import (
    AirData,
    AirspeedSensor,
    Attitude,
    Event,
    GlobalPosition,
    Gnss,
    GnssIntegrity,
    Imu,
    Input,
    LocalOrigin,
    LocalPosition,
    Pressure,
    RangeDifference,
    Reboot,
    Reset,
    Resumed,
    RsbnFix,
    SecondIns,
    Severity,
    StarFix,
    TimeStep,
    Tuning,
    Vehicle,
)
from companion.units import SECOND_NS

PATIENCE_NS = 5 * SECOND_NS  # wait for the autopilot's own origin


def step(state: State, record: Input, settings: Settings) -> Step:
    """Return the state and the outputs after one more record."""
    use = uses(settings).get(type(record))
    return (state, []) if use is None else use(state, record, settings)


def _origin(state: State, record: LocalOrigin, settings: Settings) -> Step:
    old = state.origin
    if old is not None and (old.lat, old.lon, old.alt_msl) == (record.lat, record.lon, record.alt_msl):
        return state, []
    text = "local origin known" if old is None else "local origin changed"
    severity = Severity.INFO if old is None else Severity.WARNING
    return structs.replace(state, origin=record), [Event(record.t_ns, record.rx_ns, severity, text)]


def _global_position(state: State, record: GlobalPosition, settings: Settings) -> Step:
    """Infer the origin where the autopilot does not send it."""
    local, since = state.local, state.waiting_ns
    if state.origin is not None or local is None or since is None or record.t_ns - since < PATIENCE_NS:
        return state, []
    origin = infer_origin(local, record, "ardupilot", LIVE_WINDOW_NS)
    return (state, []) if origin is None else _origin(state, origin, settings)


def _reboot(state: State, record: Reboot, settings: Settings) -> Step:
    """Begin again with an INS, whose errors are others now; to the own channel a reboot is a silence."""
    why = f"autopilot {record.system} rebooted"
    restarted = state.nominal is not None and record.t_ns < state.nominal.t_ns - SECOND_NS  # a log's clock
    if isinstance(settings.model.channel, OwnChannel) and not restarted:
        # the scale in the bank is that of the steady airspeed it was estimated with
        sensors = Sensors(steady_m_s=state.sensors.steady_m_s)
        state = structs.replace(state, sensors=sensors, gnss_fix=None, local=None)
        return state, [Reset(record.t_ns, record.rx_ns, "sensors", why)]
    return State(next_ns=state.next_ns, restarts=state.restarts + 1), [
        Reset(record.t_ns, record.rx_ns, "navigator", why)
    ]


def _time_step(state: State, record: TimeStep, settings: Settings) -> Step:
    """Doubt the position: the time that stepped was flown, or was not."""
    if state.bank is None or state.nominal is None:
        return state, []
    sigma = math.hypot(*state.nominal.point.v_n[:2]) * abs(record.step_s)
    return widened(state, sigma), []


def _gnss_integrity(state: State, record: GnssIntegrity, settings: Settings) -> Step:
    return (structs.replace(state, jammed_ns=record.t_ns) if record.threatened else state), []


_Uses = dict[type, Callable[[State, Any, Settings], Step]]
_COMMON: _Uses = {
    LocalOrigin: _origin,
    GlobalPosition: _global_position,
    Gnss: fixes.gnss,
    GnssIntegrity: _gnss_integrity,
    RsbnFix: fixes.rsbn,
    Reboot: _reboot,
    TimeStep: _time_step,
}
_INS: _Uses = {**_COMMON, LocalPosition: ins_samples.position}
_CORRECTORS: dict[str, _Uses] = {
    "airspeed": {
        AirData: ins_samples.airspeed,
        Attitude: ins_samples.sensed,
        Pressure: ins_samples.sensed,
        AirspeedSensor: own_samples.airspeed_sensor,
    },
    "hyperbolic": {RangeDifference: ins_samples.corrector("hyperbolic")},
    "stars": {StarFix: ins_samples.corrector("star")},
    "second_ins": {SecondIns: ins_samples.corrector("second INS")},
}
_OWN: _Uses = {kind: use for kind, use in _COMMON.items() if kind not in (LocalOrigin, GlobalPosition)} | {
    Attitude: own_samples.attitude,
    Pressure: own_samples.pressure,
    AirData: own_samples.air_data,
    AirspeedSensor: own_samples.airspeed_sensor,
    Imu: own_samples.imu,
    Vehicle: own_samples.vehicle,
}
_OWN_BY_LOCAL: _Uses = {**_COMMON, **_OWN, LocalPosition: own_samples.foreign_position}
INPUTS_USED = tuple(
    {*_INS, *_OWN_BY_LOCAL, *(kind for use in _CORRECTORS.values() for kind in use), Tuning, Resumed}
)
"""Kinds of records that a navigator may use."""


def uses(settings: Settings) -> _Uses:
    """What each kind of record is good for, by the channel; a local position only where it is asked for."""
    config = settings.config
    if not isinstance(settings.model.channel, OwnChannel):
        added = [_CORRECTORS[name] for name in config.inertial.correctors]
        return {kind: use for uses in (_INS, *added) for kind, use in uses.items()}
    found = _OWN_BY_LOCAL if config.uses_local_velocity else _OWN
    return found if config.uses("imu") else {kind: use for kind, use in found.items() if kind is not Imu}
