"""One step of the navigator: `carry, outputs = step(carry, record, settings)`, the carry immutable.

What a fix teaches the guaranteed predictor is not needed for the solution that it causes. It is left in the
carry as a lesson, and `learn` makes up for it before the next step, when the solution is out.

Online, replay and late measurements all go through this one function. Errors are INS minus truth, so what is
given out is the inertial channel less the estimated error. Two estimators run on one stream: the Gaussian
error state (the "kalman" of the configuration: maximum-likelihood fusion with memory) and, beside it, the
minimax prediction with its guaranteed bound. While trusted fixes come the first is the output; when they
stop, the one the configuration names.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

from companion.config import Channel
from companion.estimate.fusion import Azimuth, Observation, Range
from companion.navigator import (
    air_data_channel,
    channel_corrections,
    error_state,
    fix_observations,
    height_error,
    inertial_track,
    integrity,
    measurement_update,
    strapdown_channel,
)
from companion.navigator.deferred_update import unheard
from companion.navigator.gnss_beacon_check import GNSS
from companion.navigator.inertial_track import Point
from companion.navigator.local_origin import LIVE_WINDOW_NS, infer_origin
from companion.navigator.solution import solve
from companion.navigator.state import Carry, Lesson, Settings, Step, initial, level, state_at
from companion.records import (
    AirData,
    Attitude,
    Event,
    GlobalPosition,
    Gnss,
    Imu,
    Input,
    LocalOrigin,
    LocalPosition,
    Output,
    Pressure,
    Reboot,
    Rejection,
    Reset,
    RsbnFix,
    Severity,
    Source,
    Stamped,
)

TOGETHER_NS = 1_000_000_000  # GNSS this close to a beacon's answer joins its fix
PATIENCE_NS = 5_000_000_000  # how long the autopilot is waited for to tell what a channel begins with
BRIDGED_S = 1.0  # a silence of the airspeed up to this long is nothing, and one of the position not told
UNKNOWN_M_S = 15.0  # how fast the position is lost in a longer one
UNKNOWN_M_S2 = 5.0  # and the velocity in one of the IMU,
TURNED_M_S = 30.0  # until nothing is known of it
QUIET_NS = 10_000_000_000  # what goes on being refused is told once, and again after so long without
AGAIN_NS = 60_000_000_000  # how often it is told that nothing can begin


def step(carry: Carry, record: Input, settings: Settings) -> Step:
    """The carry and the outputs after one more record; records it has no use for change nothing."""
    use = uses(settings.channel).get(type(record))
    return (carry, []) if use is None else use(carry, record, settings)


def _origin(carry: Carry, record: LocalOrigin, settings: Settings) -> Step:
    old = carry.origin
    if old is not None and (old.lat, old.lon, old.alt_msl) == (record.lat, record.lon, record.alt_msl):
        return carry, []
    text = "local origin known" if old is None else "local origin changed"
    carry = carry._replace(origin=record)
    return carry, [Event(record.t_ns, record.rx_ns, Severity.INFO if old is None else Severity.WARNING, text)]


def _reboot(carry: Carry, record: Reboot, settings: Settings) -> Step:
    """Another inertial channel: what was learnt of the old one's error says nothing of it.

    Dead reckoning and strapdown are our own: to them a reboot is a silence, and the wind is what it was.
    """
    why = f"autopilot {record.system} rebooted"
    if settings.channel != "local_position":
        strap = strapdown_channel.Strap(refused_ns=record.t_ns)  # that it is not heard goes without saying
        carry = carry._replace(reckoner=air_data_channel.Reckoner(), strap=strap, gnss=None, gnss_heard=None)
        return carry, [Reset(record.t_ns, record.rx_ns, settings.channel.replace("_", " "), why)]
    out = Reset(record.t_ns, record.rx_ns, "navigator", why)
    return initial(settings)._replace(next_ns=carry.next_ns), [out]


def _global_position(carry: Carry, record: GlobalPosition, settings: Settings) -> Step:
    """Without a stated origin, the same position said twice, locally and globally, tells where it is."""
    local, since = carry.local, carry.waiting_ns
    if carry.origin is not None or local is None or since is None or record.t_ns - since < PATIENCE_NS:
        return carry, []  # wait for the origin that was requested: the autopilot's own is more accurate
    origin = infer_origin(local, record, "ardupilot", LIVE_WINDOW_NS)
    return (carry, []) if origin is None else _origin(carry, origin, settings)


def _local_position(carry: Carry, record: LocalPosition, settings: Settings) -> Step:
    before, origin, out = carry.local, carry.origin, list[Output]()
    carry = carry._replace(local=record)
    if origin is None:
        return carry._replace(waiting_ns=carry.waiting_ns or record.t_ns), out
    if before is not None and record.t_ns <= before.t_ns:
        return carry._replace(local=before), out
    new = inertial_track.point(record, origin)
    if carry.track:
        carry, out = _stepped(carry, carry.track[-1], new, record, settings)
    carry = carry._replace(track=inertial_track.extend(carry.track, new))
    return _given(carry, record, out, settings)


def _stepped(carry: Carry, last: Point, new: Point, record: LocalPosition, settings: Settings) -> Step:
    """With what the channel did from `last` to `new` that its velocities do not explain.

    From one record to the next that is a jump or nothing. Across a silence a turn explains hundreds of
    metres: what is left may be a turn or a step, and nobody knows which.
    """
    out = list[Output]()
    north, east, _ = inertial_track.beyond(last, new)
    length, silent = math.hypot(north, east), (new.t_ns - last.t_ns) * 1e-9
    most = inertial_track.unnoticed(silent)
    if length > most:
        carry = channel_corrections.shifted(carry, north, east)
        out.append(_channel(record, f"it jumped by {length:.1f} m"))
    if length > inertial_track.JUMP_M and silent > inertial_track.REACH_S:
        carry = channel_corrections.blurred(carry, settings, min(length, most))
        if silent > BRIDGED_S:
            out.append(_channel(record, f"no local position for {silent:.1f} s"))
    return carry, out


def _sense(carry: Carry, record: Attitude | AirData | Pressure, settings: Settings) -> Step:
    return carry._replace(reckoner=air_data_channel.sense(carry.reckoner, record)), []


def _air_data(carry: Carry, record: AirData, settings: Settings) -> Step:
    """Dead reckoning goes on by one airspeed. The first fix told it where to begin."""
    if not carry.track:
        return _sense(carry, record, settings)
    out = list[Output]()
    last = carry.track[-1]
    found = air_data_channel.advance(carry.reckoner, last, record)
    if found is None:
        return carry, out
    reckoner, new = found
    silent = (new.t_ns - last.t_ns) * 1e-9
    if silent > BRIDGED_S:
        carry = channel_corrections.blurred(carry, settings, UNKNOWN_M_S * silent)
        out.append(_channel(record, f"no airspeed with attitude for {silent:.1f} s"))
    carry = carry._replace(reckoner=reckoner, track=inertial_track.extend(carry.track, new))
    return _given(channel_corrections.kept_near(carry, settings, has_velocity=False), record, out, settings)


def _strap(carry: Carry, record: Attitude | Pressure, settings: Settings) -> Step:
    return carry._replace(strap=strapdown_channel.sense(carry.strap, record)), []


def _imu(carry: Carry, record: Imu, settings: Settings) -> Step:
    """Strapdown goes on by one sample, and across a silence straight on."""
    if record.source != settings.config.strapdown.imu:
        return carry, []
    before, out = carry.strap, list[Output]()
    strap = strapdown_channel.hear(before, record)
    carry = carry._replace(strap=strap)
    if not carry.track:
        return carry, out
    if strap.why:
        if strap.refused_ns is None or record.t_ns - strap.refused_ns > QUIET_NS:
            out.append(_channel(record, f"not used: {strap.why}"))
        return carry._replace(strap=strap._replace(refused_ns=record.t_ns)), out
    last = carry.track[-1]
    silent = (record.t_ns - last.t_ns) * 1e-9
    if silent <= 0.0:
        return carry, out
    if silent > strapdown_channel.BRIDGED_S or before.imu is None:
        new = strapdown_channel.coast(strap, last)
        faster = min(UNKNOWN_M_S2 * silent, TURNED_M_S)
        carry = channel_corrections.blurred(carry, settings, faster * silent, faster)
        out.append(_channel(record, f"no IMU with attitude for {silent:.1f} s"))
    else:
        strap, new = strapdown_channel.advance(before, strap, last)
    carry = carry._replace(strap=strap, track=inertial_track.renew(carry.track, new))
    return _given(channel_corrections.kept_near(carry, settings, has_velocity=True), record, out, settings)


def _given(carry: Carry, record: Stamped, out: list[Output], settings: Settings) -> Step:
    """With a solution once one is due."""
    if record.t_ns < carry.next_ns:
        return carry, out
    carry, ins = unheard(carry, settings), carry.track[-1]
    if carry.state is not None:  # so that a beacon's answer finds it near
        carry = carry._replace(state=state_at(carry, ins, settings))
    carry, solution = solve(carry, record.rx_ns, settings)
    if solution:
        next_ns = max(carry.next_ns + round(1e9 / settings.config.output.pace_hz), ins.t_ns)
        carry = carry._replace(next_ns=next_ns)
    return carry, out + solution


def _channel(record: Stamped, why: str) -> Reset:
    return Reset(record.t_ns, record.rx_ns, "inertial channel", why)


def _begun(carry: Carry, record: Gnss | RsbnFix, settings: Settings) -> Step:
    """With the first point of a channel of our own, if this fix is the first to tell a place; where it cannot
    begin, that is told.
    """
    channel = settings.channel
    if carry.track or channel == "local_position":
        return carry, []
    if channel == "air_data":
        first, why = air_data_channel.begin(carry.reckoner, record), "no airspeed with attitude is heard"
    else:
        first, why = strapdown_channel.begin(carry.strap, record), carry.strap.why
    if first is not None:
        return carry._replace(track=(first,)), []
    since = carry.waiting_ns or record.t_ns
    if record.t_ns - since < PATIENCE_NS or (isinstance(record, Gnss) and not record.has_3d_fix):
        return carry._replace(waiting_ns=since), []
    carry = carry._replace(waiting_ns=record.t_ns + AGAIN_NS)
    return carry, [
        Event(record.t_ns, record.rx_ns, Severity.WARNING, f"inertial channel cannot begin: {why}")
    ]


def _gnss(carry: Carry, record: Gnss, settings: Settings) -> Step:
    carry, told = _begun(carry, record, settings)
    config = settings.config.gnss
    carry = carry._replace(gnss=record)
    ins = inertial_track.at(carry.track, record.t_ns)
    asked = math.inf if carry.asked_ns is None else (record.t_ns - carry.asked_ns) * 1e-9
    if not record.has_3d_fix or ins is None or asked < config.every_s:
        return carry, told
    carry = carry._replace(asked_ns=record.t_ns, lesson=Lesson(record, None, ins))
    if integrity.excluded(carry.watch, GNSS):
        return carry, []
    since = math.inf if carry.gnss_ns is None else (record.t_ns - carry.gnss_ns) * 1e-9
    white = fix_observations.from_gnss(record, ins, config, drifting=True)
    carry, out = measurement_update.position(
        carry, white, error_state.gnss_rows(settings.unit), ins, record, settings
    )
    if out:
        return carry, out
    heard = fix_observations.from_gnss(record, ins, config)
    part = min(since, config.correlation_s) / config.correlation_s
    learnt = height_error.learn(carry.level, record, ins, part, settings.gate[1])
    carry = carry._replace(gnss_ns=record.t_ns, gnss_heard=heard, level=learnt)
    if config.use_velocity and record.v_n is not None:
        carry = measurement_update.velocity(carry, record, record.v_n, ins, settings)
    return carry._replace(lesson=carry.lesson and carry.lesson._replace(heard=heard)), []


def _rsbn(carry: Carry, record: RsbnFix, settings: Settings) -> Step:
    carry, told = _begun(carry, record, settings)
    ins = inertial_track.at(carry.track, record.t_ns)
    if ins is None:
        why = "no inertial position at its time"
        return carry, [*told, Rejection(record.t_ns, record.rx_ns, f"rsbn {record.beacon}", why)]
    ins = level(ins, carry)
    said = fix_observations.from_rsbn(record, ins, settings.config.rsbn)
    carry = carry._replace(lesson=Lesson(record, None, ins, said))
    heard = _calibrated(carry, record, said, settings)
    if not heard.observations:
        return carry, []
    carry, out = measurement_update.position(
        carry, heard, error_state.beacon_rows(settings.unit), ins, record, settings
    )
    if out:
        return carry, out
    gnss, together = carry.gnss_heard, heard
    if gnss is not None and abs(record.t_ns - gnss.t_ns) <= TOGETHER_NS:
        # the correction INS minus GNSS of a moment ago is that of now: the error drifts by metres a minute
        together = fix_observations.Heard(
            record.t_ns, heard.observations + gnss.observations, heard.sources | gnss.sources
        )
    lesson = carry.lesson and carry.lesson._replace(heard=together)
    return carry._replace(rsbn_ns=record.t_ns, rsbn_told=heard.sources, lesson=lesson), []


def _calibrated(
    carry: Carry, record: RsbnFix, said: tuple[Azimuth | Range, ...], settings: Settings
) -> fix_observations.Heard:
    """What is to be believed of a beacon's answer, less its learnt biases; right above it no azimuth."""
    kept, told, state = list[Observation](), Source(0), carry.state
    for z in said:
        if isinstance(z, Azimuth) and state is not None:
            north, east = state.x[:2].tolist()
            if fix_observations.silent(z, (north, east), record.slant_range):
                continue
        name = integrity.named(record.beacon, z)
        if not integrity.excluded(carry.watch, name):
            kept.append(integrity.calibrated(carry.watch, name, z, settings.config))
            told |= Source.AZIMUTH if isinstance(z, Azimuth) else Source.RANGE
    return fix_observations.Heard(record.t_ns, tuple(kept), told)


_Uses = dict[type, Callable[[Carry, Any, Settings], Step]]
_FIXES: _Uses = {Gnss: _gnss, RsbnFix: _rsbn, Reboot: _reboot}
_OF_LOCAL_POSITION: _Uses = {
    LocalOrigin: _origin,
    GlobalPosition: _global_position,
    LocalPosition: _local_position,
    **_FIXES,
}
#: No position and no velocity of the autopilot's is among these two, so none can be fed back to it.
_OF_AIR_DATA: _Uses = {Attitude: _sense, Pressure: _sense, AirData: _air_data, **_FIXES}
_OF_STRAPDOWN: _Uses = {Attitude: _strap, Pressure: _strap, Imu: _imu, **_FIXES}
_USES = {"local_position": _OF_LOCAL_POSITION, "air_data": _OF_AIR_DATA, "strapdown": _OF_STRAPDOWN}


def uses(channel: Channel) -> _Uses:
    """What each kind of record is good for, by the inertial channel."""
    return _USES[channel]
