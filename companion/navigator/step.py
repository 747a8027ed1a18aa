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

import numpy as np

from companion.estimate import bank as banks
from companion.estimate.bank.settings import DEFAULT as THRESHOLDS
from companion.estimate.fusion import Azimuth
from companion.nav.geometry import displace
from companion.navigator import (
    air_data_channel,
    corrector_measurements,
    fix_observations,
    height_error,
    inertial_track,
    measurements,
    minimax_bound,
    own_channel,
    own_error_model,
    parallel_filters,
    scatter,
    strapdown_channel,
)
from companion.navigator.channel import Nominal, moved
from companion.navigator.corrected_ins import CorrectedIns
from companion.navigator.corrector_measurements import CorrectorRows
from companion.navigator.hypotheses import AIRSPEED, GNSS, JAMMED, MOST_BEACONS
from companion.navigator.inertial_track import Point
from companion.navigator.local_origin import LIVE_WINDOW_NS, infer_origin
from companion.navigator.minimax_bound import Guarantee
from companion.navigator.own_channel import AirspeedSums, OwnChannel, Sensors
from companion.navigator.own_error_model import By
from companion.navigator.solution import solve
from companion.navigator.state import (
    EXCLUDED,
    JAMMED_NS,
    NEAR_S,
    SUSPECT,
    Beacon,
    Pending,
    Settings,
    State,
    Step,
    corrected,
    estimate,
    hypotheses,
    initial,
    source_name,
    sources,
)
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
    Output,
    Pressure,
    RangeDifference,
    Reboot,
    Rejection,
    Reset,
    RsbnFix,
    SecondIns,
    Severity,
    Source,
    Stamped,
    StarFix,
    Tuning,
    Vector2,
)
from companion.units import SECOND_NS

PATIENCE_NS = 5 * SECOND_NS  # wait for the autopilot's own origin
#: An autopilot checks its airspeed sensor against GPS only: ArduPlane dived to the ground for speed in 67 s.
FALSE_AIRSPEED = "switch the airspeed sensor off"
USE_AIRSPEED = {"ardupilot": ": ARSPD_USE 0", "px4": ": FW_USE_AIRSPD 0"}
CONFIRM_NS = SECOND_NS  # one fix in disagreement is an outlier: a source is excluded once it lasts
JUMP_SPREAD_S = 0.5  # across a longer silence a turn explains a step as well as a jump does
FAR_M, FAST_M_S = 500.0, 5.0  # the nominal trajectory is brought back from this far off
CORRECTOR_AIRSPEED_NS = 5 * SECOND_NS  # gusts last seconds: beside an INS more often tells no more
AIRSPEED_EVERY_NS = 500_000_000  # gusts are correlated: more often tells no more
FOREIGN_EVERY_NS = SECOND_NS
BLOCKED_M_S = 5.0  # slower, in flight, a pitot is blocked
GATE_SIGMA = 5.0


def step(state: State, record: Input, settings: Settings) -> Step:
    """Return the state and the outputs after one more record."""
    use = uses(settings).get(type(record))
    return (state, []) if use is None else use(state, record, settings)


# ---------------------------------------------------------------------------------------------------------
# Origin, reboot, what is only remembered
# ---------------------------------------------------------------------------------------------------------


def _origin(state: State, record: LocalOrigin, settings: Settings) -> Step:
    old = state.origin
    if old is not None and (old.lat, old.lon, old.alt_msl) == (record.lat, record.lon, record.alt_msl):
        return state, []
    text = "local origin known" if old is None else "local origin changed"
    severity = Severity.INFO if old is None else Severity.WARNING
    return state._replace(origin=record), [Event(record.t_ns, record.rx_ns, severity, text)]


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
        state = state._replace(sensors=Sensors(), gnss=None, gnss_fix=None, local=None)
        return state, [Reset(record.t_ns, record.rx_ns, "sensors", why)]
    return initial(settings)._replace(next_ns=state.next_ns), [
        Reset(record.t_ns, record.rx_ns, "navigator", why)
    ]


def _airspeed_sensor(state: State, record: AirspeedSensor, settings: Settings) -> Step:
    seen = record.t_ns if record.healthy else None
    return state._replace(sensors=state.sensors._replace(sensor_ns=seen)), []


def _gnss_integrity(state: State, record: GnssIntegrity, settings: Settings) -> Step:
    return (state._replace(jammed_ns=record.t_ns) if record.threatened else state), []


def _attitude(state: State, record: Attitude, settings: Settings) -> Step:
    s = state.sensors
    s = s._replace(strap=strapdown_channel.sense(s.strap, record), air=air_data_channel.sense(s.air, record))
    state = state._replace(sensors=s)
    if state.nominal is None or not s.leads("hold", record.t_ns):
        return state, []
    return _driven(state, record, "hold", None, settings)


def _pressure(state: State, record: Pressure, settings: Settings) -> Step:
    s = state.sensors
    s = s._replace(strap=strapdown_channel.sense(s.strap, record), air=air_data_channel.sense(s.air, record))
    return state._replace(sensors=s), []


# ---------------------------------------------------------------------------------------------------------
# Samples of the own channel
# ---------------------------------------------------------------------------------------------------------


def _imu(state: State, record: Imu, settings: Settings) -> Step:
    config = settings.config
    if record.source != config.strapdown.imu or not config.uses("imu"):
        return state, []
    s = state.sensors
    strap = strapdown_channel.receive(s.strap, record)
    s = s._replace(strap=strap)
    if strap.why or strap.C_nb is None:
        return state._replace(sensors=s), []
    a_n = strapdown_channel.level_acceleration(strap)
    mean = (0.5 * (a_n[0] + s.acceleration[0]), 0.5 * (a_n[1] + s.acceleration[1]))
    fresh = record.t_ns - s.imu_ns <= own_channel.SILENT_NS["imu"]
    s = s._replace(imu_ns=record.t_ns, acceleration=a_n)
    state = state._replace(sensors=s)
    return _driven(state, record, "imu", mean if fresh else a_n, settings)


def _air_data(state: State, record: AirData, settings: Settings) -> Step:
    s = state.sensors
    state = state._replace(sensors=s._replace(air=air_data_channel.sense(s.air, record)))
    nominal = state.nominal
    if nominal is None or not settings.config.uses("air_data"):
        return state, []
    if not own_channel.airspeed_is_sensed(s, record):
        return state, []
    V = own_channel.air_velocity(s, record, nominal.point.position.alt)
    if V is None:
        return state, []
    speed = math.hypot(*_velocity(state))
    if s.ground.flying and math.hypot(*V) < BLOCKED_M_S < 0.5 * speed:
        return state, _blocked_pitot(s, record)
    height = None if s.air.static is None else nominal.point.position.alt
    ground = own_error_model.ground_phase(s.ground, record.t_ns * 1e-9, math.hypot(*V), speed, height)
    s = state.sensors._replace(ground=ground, air_ns=record.t_ns if ground.flying else s.air_ns)
    state = state._replace(sensors=s)
    if not ground.flying:
        return _driven(state, record, "hold", None, settings) if s.leads("hold", record.t_ns) else (state, [])
    if s.leads("air", record.t_ns):
        return _driven(state, record, "air", V, settings)
    if not _by(state, "imu"):
        return state, []
    state = _carried(state, record.t_ns)
    assert state.nominal is not None
    v_n = state.nominal.point.v_n
    sums = s.sums or AirspeedSums(record.t_ns, 0, (0.0, 0.0), (0.0, 0.0))
    sums = AirspeedSums(
        sums.start_ns,
        sums.samples + 1,
        (sums.velocity[0] + v_n[0], sums.velocity[1] + v_n[1]),
        (sums.air[0] + V[0], sums.air[1] + V[1]),
    )
    if record.t_ns - sums.start_ns < AIRSPEED_EVERY_NS:
        return state._replace(sensors=s._replace(sums=sums)), []
    state = _propagated(state, settings)
    assert state.bank is not None
    n, seconds = sums.samples, (record.t_ns - sums.start_ns) * 1e-9
    taken = measurements.airspeed(
        state.bank,
        hypotheses(state, settings),
        _own(settings),
        (sums.air[0] / n, sums.air[1] / n),
        (sums.velocity[0] / n, sums.velocity[1] / n),
        seconds,
    )
    sums = AirspeedSums(record.t_ns, 0, (0.0, 0.0), (0.0, 0.0))
    sensors = state.sensors._replace(measured_ns=record.t_ns, sums=sums)
    return _decided(state._replace(bank=taken.bank, sensors=sensors), record, settings)


def _blocked_pitot(before: Sensors, record: AirData) -> list[Output]:
    """Reject an airspeed at which nothing flies, once a second: without a direction it cannot be modelled."""
    last = before.air.air
    if last is not None and last.t_ns // SECOND_NS == record.t_ns // SECOND_NS:
        return []
    why = "airspeed too low for the speed over ground: not used"
    return [Rejection(record.t_ns, record.rx_ns, "airspeed", why, record.airspeed, BLOCKED_M_S)]


def _foreign_position(state: State, record: LocalPosition, settings: Settings) -> Step:
    """Use the velocity of the autopilot's estimator, as driver or as measurement, where we do not feed it."""
    s, config = state.sensors, settings.config
    state = state._replace(local=record)
    if state.origin is None and state.waiting_ns is None:
        state = state._replace(waiting_ns=record.t_ns)
    if not config.uses("local_position") or config.output.feeds_estimator:
        return state, []
    before = s.foreign
    s = s._replace(foreign=record, foreign_ns=record.t_ns)
    state = state._replace(sensors=s)
    if state.nominal is None:
        return state, []
    velocity = (record.v_n[0], record.v_n[1])
    if s.leads("foreign", record.t_ns):
        return _driven(state, record, "foreign", velocity, settings)
    if before is not None and record.t_ns // FOREIGN_EVERY_NS == before.t_ns // FOREIGN_EVERY_NS:
        return state, []
    state = _propagated(_carried(state, record.t_ns), settings)
    assert state.bank is not None
    assert state.nominal is not None
    v_n = state.nominal.point.v_n
    apart = (v_n[0] - velocity[0], v_n[1] - velocity[1])
    taken = measurements.foreign_velocity(state.bank, hypotheses(state, settings), _own(settings), apart)
    return _decided(state._replace(bank=taken.bank), record, settings)


def _driven(state: State, record: Stamped, by: By, sample: Vector2 | None, settings: Settings) -> Step:
    """Move the nominal trajectory to the time of a sample of its driver, and solve if that is due.

    `sample` is the mean acceleration (imu) or the velocity (air, foreign); None goes straight on.
    """
    nominal, s = state.nominal, state.sensors
    if nominal is None or record.t_ns <= nominal.t_ns:
        return state, []
    assert nominal.interval is not None
    if nominal.interval.by != by:
        s = s._replace(sums=None)
        state = _propagated(_carried(state, record.t_ns), settings)._replace(sensors=s)
        assert state.nominal is not None
        velocity = sample if by in ("air", "foreign") and sample else state.nominal.point.v_n[:2]
        nominal = own_channel.restart(state.nominal, by, velocity)
        if by == "imu" and sample:
            nominal = nominal._replace(a_n=sample)
    elif by == "imu" and sample:
        heading = s.heading() or 0.0
        nominal = own_channel.by_imu(nominal, sample, heading, record.t_ns)._replace(a_n=s.acceleration)
    else:
        nominal = own_channel.by_velocity(nominal, sample or (0.0, 0.0), record.t_ns)
    state = state._replace(nominal=_at_height(nominal, s, state))
    if nominal.pending_s >= NEAR_S:
        state, out = _decided(_propagated(state, settings), record, settings)
    else:
        out = []
    state, more = _solved_if_due(state, record, settings)
    return state, [*out, *more]


def _at_height(nominal: Nominal, s: Sensors, state: State) -> Nominal:
    """With the height of the pressure, and its rate as the climb."""
    if s.air.static is None:
        return nominal
    point = nominal.point
    dt = (point.t_ns - nominal.since.t_ns) * 1e-9
    alt = air_data_channel.pressure_altitude(s.air.static)
    climb = -point.v_n[2]
    if dt > 0.0:
        climb += min(dt / air_data_channel.CLIMB_S, 0.2) * ((alt - nominal.since.position.alt) / dt - climb)
    v_n = (point.v_n[0], point.v_n[1], -climb)
    return nominal._replace(point=point._replace(position=point.position._replace(alt=alt), v_n=v_n))


# ---------------------------------------------------------------------------------------------------------
# Samples of an INS
# ---------------------------------------------------------------------------------------------------------


def _ins_position(state: State, record: LocalPosition, settings: Settings) -> Step:
    """Move the nominal trajectory to the position of the INS; a step beyond its velocity is a jump."""
    state = state._replace(local=record)
    if state.origin is None:
        waiting = state.waiting_ns or record.t_ns
        return state._replace(waiting_ns=waiting), []
    new = inertial_track.point(record, state.origin)
    nominal, out = state.nominal, list[Output]()
    if nominal is None:
        state = state._replace(nominal=Nominal(new, (0.0, 0.0), new), ins=new)
        return _solved_if_due(state, record, settings)
    last = state.ins or nominal.point
    dt = (new.t_ns - last.t_ns) * 1e-9
    if dt <= 0.0 or new.t_ns < nominal.t_ns:
        return state, []
    state, out = _jump_removed(state, last, new, record, settings)
    a_n = ((new.v_n[0] - last.v_n[0]) / dt, (new.v_n[1] - last.v_n[1]) / dt)
    assert state.nominal is not None
    nominal = state.nominal._replace(point=new, a_n=a_n)
    state = state._replace(nominal=nominal, ins=new)
    if nominal.pending_s >= NEAR_S and state.bank is not None:
        state, more = _decided(_propagated(state, settings), record, settings)
        out += more
    state, more = _solved_if_due(state, record, settings)
    return state, [*out, *more]


def _jump_removed(state: State, last: Point, new: Point, record: LocalPosition, settings: Settings) -> Step:
    """Move the errors with a jump of the channel; across a silence what is left may be a turn or a step."""
    out = list[Output]()
    north, east, _ = inertial_track.beyond(last, new)
    length, silent = math.hypot(north, east), (new.t_ns - last.t_ns) * 1e-9
    most = inertial_track.unnoticed(silent)
    if length > most:
        state = shifted(state, north, east)
        out.append(_channel(record, f"jumped by {length:.1f} m"))
    if length > inertial_track.JUMP_M and silent > JUMP_SPREAD_S and state.bank is not None:
        sigma = min(length, most)
        bank = banks.inflate(state.bank, (0, 1), sigma)
        state = state._replace(bank=bank, guarantee=Guarantee(), parallel=None)
        out.append(_channel(record, f"no local position for {silent:.1f} s"))
    return state, out


def shifted(state: State, north: float, east: float, v_n: Vector2 = (0.0, 0.0), t_ns: int = 0) -> State:
    """Move the errors with the nominal trajectory: by (north, east) m and `v_n` (m/s), at `t_ns`."""
    bank = state.bank
    if bank is not None:
        bank = banks.shift(bank, np.array((north, east, *v_n)))
    protection = state.protection
    if protection is not None:
        protection = (*protection[:2], protection[2] + north, protection[3] + east)
    promise = minimax_bound.shift(state.guarantee, north, east, v_n)
    parallel = state.parallel and parallel_filters.shift(state.parallel, north, east)
    fix = state.gnss_fix and _fix_shifted(*state.gnss_fix, north, east, v_n, t_ns)
    pending = state.pending
    if pending is not None:  # the error that was taken off is that of the nominal trajectory as it is now
        pending = pending._replace(centre=(pending.centre[0] + north, pending.centre[1] + east))
    return state._replace(
        bank=bank,
        moved=(state.moved[0] + north, state.moved[1] + east),
        protection=protection,
        guarantee=promise,
        parallel=parallel,
        gnss_fix=fix,
        pending=pending,
    )


def _fix_shifted(
    record: Gnss, point: Point, north: float, east: float, v_n: Vector2, t_ns: int
) -> tuple[Gnss, Point]:
    """Return a GNSS fix beside the nominal trajectory as if that had always been where it is now."""
    since = (point.t_ns - t_ns) * 1e-9
    place = displace(*point.position, north + v_n[0] * since, east + v_n[1] * since, 0.0)
    return record, point._replace(position=point.position._replace(lat=place.lat, lon=place.lon))


# ---------------------------------------------------------------------------------------------------------
# Fixes
# ---------------------------------------------------------------------------------------------------------


def _begun(state: State, record: Gnss | RsbnFix, settings: Settings) -> State:
    """With a nominal trajectory and a bank, if this fix is the first to tell a place."""
    nominal = state.nominal
    if nominal is None and isinstance(settings.model.channel, OwnChannel):
        nominal = own_channel.begin(state.sensors, record)
    if nominal is None or state.bank is not None:
        return state
    if nominal.interval is not None:
        nominal = own_channel.restart(nominal, nominal.interval.by, nominal.point.v_n[:2])
    return state._replace(nominal=nominal._replace(since=nominal.point), bank=settings.model.begin(0.0))


def _gnss(state: State, record: Gnss, settings: Settings) -> Step:
    config, last = settings.config.gnss, state.gnss_taken
    state = state._replace(gnss=record)
    since = math.inf if last is None else (record.t_ns - last.t_ns) * 1e-9
    if not record.has_3d_fix or since < config.every_s:
        return state, []
    state = _begun(state, record, settings)
    if state.nominal is None or state.bank is None or _silent(state, record.t_ns):
        return state, []
    state = _propagated(_carried(state, record.t_ns), settings)
    known, channel, nominal = hypotheses(state, settings), settings.model.channel, state.nominal
    assert state.bank is not None
    assert nominal is not None
    if last is not None and last.receiver != record.receiver:
        state = state._replace(bank=measurements.other_receiver(state.bank, channel))
    assert state.bank is not None
    variance = fix_observations.white_sigma(record, config) ** 2
    apart = measurements.gnss_apart(record, nominal.point)
    still = (apart[0] + state.moved[0], apart[1] + state.moved[1])  # as if the nominal had never jumped
    state, factor, noted = _scattered(state, record, "gnss", still, variance)
    assert state.bank is not None
    v_n = _latency_velocity(state)
    taken = measurements.gnss_position(state.bank, known, channel, apart, factor * variance, v_n)
    bank, accepted = taken.bank, taken.accepted
    if config.use_velocity and record.v_n is not None:
        a_n = nominal.a_n
        bank = measurements.gnss_velocity(
            bank, known, channel, record, nominal.point, a_n, settings.config, factor
        ).bank
    state = state._replace(bank=bank, gnss_taken=record, fixed=True)
    state, out = _decided(state, record, settings)
    out = [*noted, *out]
    assert state.bank is not None
    if state.reported[GNSS] == EXCLUDED or not accepted:
        return _nearer(state, settings), [*out, _rejected(state, record, "gnss", GNSS, taken)]
    since = math.inf if state.gnss_ns is None else (record.t_ns - state.gnss_ns) * 1e-9
    part = min(since, config.correlation_s) / config.correlation_s
    level = height_error.update(state.level, record, nominal.point, part, GATE_SIGMA**2)
    pending = None
    if state.false[GNSS] < known.settings.suspect:
        pending = Pending(record, nominal.point, (0.0, 0.0), Source.GNSS)
    state = state._replace(
        gnss_ns=record.t_ns, gnss_fix=(record, nominal.point), level=level, pending=pending
    )
    return _nearer(state, settings), out


def _rsbn(state: State, record: RsbnFix, settings: Settings) -> Step:
    state = _begun(state, record, settings)
    name = f"rsbn {record.beacon}"
    if state.nominal is None or state.bank is None or _silent(state, record.t_ns):
        return state, [Rejection(record.t_ns, record.rx_ns, name, "no channel at its time")]
    state = _propagated(_carried(state, record.t_ns), settings)
    state, k, out = _beacon(state, record, settings)
    nominal = state.nominal
    assert nominal is not None
    assert state.bank is not None
    point, centre = corrected(nominal.point, state, settings)
    known, believed = hypotheses(state, settings), Source(0)
    height = settings.config.inertial.height_sigma_m
    for z in fix_observations.from_rsbn(record, point, settings.config.rsbn):
        if isinstance(z, Azimuth) and fix_observations.in_cone_of_silence(z, record.slant_range):
            continue
        source = known.azimuth(k) if isinstance(z, Azimuth) else known.range(k)
        label = source_name(source, state)
        metres = fix_observations.distance(z) if isinstance(z, Azimuth) else 1.0
        still = (centre[0] - state.moved[0], centre[1] - state.moved[1])  # as if it had never jumped
        residual = measurements.sight_residual(z, still)
        variance = fix_observations.sight_variance(z, height)
        state, factor, noted = _scattered(state, record, label, (residual,), variance, metres)
        assert state.bank is not None
        taken = measurements.sight(state.bank, known, z, k, factor * variance, centre)
        state, more = _decided(state._replace(bank=taken.bank), record, settings)
        out += [*noted, *more]
        assert state.bank is not None
        part = Source.AZIMUTH if isinstance(z, Azimuth) else Source.RANGE
        if state.reported[source] == EXCLUDED or not taken.accepted:
            out.append(_rejected(state, record, label, source, taken))
        elif state.false[source] < known.settings.suspect:
            believed |= part
    state = state._replace(fixed=True)
    if believed:
        pending = Pending(record, point, centre, believed)
        state = state._replace(rsbn_ns=record.t_ns, rsbn_used=believed, pending=pending)
    return _nearer(state, settings), out


# ---------------------------------------------------------------------------------------------------------
# Correctors of an INS
# ---------------------------------------------------------------------------------------------------------


def _sensed(state: State, record: Attitude | Pressure, settings: Settings) -> Step:
    """Remember attitude and pressure for the airspeed beside an INS."""
    s = state.sensors
    return state._replace(sensors=s._replace(air=air_data_channel.sense(s.air, record))), []


def _airspeed_beside_ins(state: State, record: AirData, settings: Settings) -> Step:
    s, nominal = state.sensors, state.nominal
    if nominal is None or not own_channel.airspeed_is_sensed(s, record):
        return state, []
    V = own_channel.air_velocity(s, record, nominal.point.position.alt)
    if V is None or math.hypot(*V) < own_error_model.FLYING_M_S:
        return state, []
    if record.t_ns - s.measured_ns < CORRECTOR_AIRSPEED_NS:
        return state, []
    state = state._replace(sensors=s._replace(measured_ns=record.t_ns))
    return _corrected_by(state, record, settings, "airspeed")


def _corrector(name: str) -> Callable[[State, Any, Settings], Step]:
    def use(state: State, record: Any, settings: Settings) -> Step:
        return _corrected_by(state, record, settings, name)

    return use


def _corrected_by(state: State, record: Any, settings: Settings, name: str) -> Step:
    """Update by a corrector; nothing before the first fix."""
    if state.nominal is None or state.bank is None or _silent(state, record.t_ns):
        return state, []
    state = _propagated(_carried(state, record.t_ns), settings)
    assert state.nominal is not None
    assert state.bank is not None
    rows = _rows_of(state, record, settings)
    if rows is None:
        return state, [
            Rejection(record.t_ns, record.rx_ns, name, "star below the horizon or near the zenith")
        ]
    taken = measurements.corrector(state.bank, hypotheses(state, settings), rows)
    state, out = _decided(state._replace(bank=taken.bank), record, settings)
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
        state = state._replace(parallel=parallel)
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


def _scattered(
    state: State,
    record: Stamped,
    name: str,
    residual: tuple[float, ...],
    variance: float,
    metres: float = 1.0,
) -> tuple[State, float, list[Output]]:
    """With one more residual of a source; the factor of its stated variance; an event if that is news.

    `metres` is the length of the residual's unit.
    """
    assert state.nominal is not None
    interval = state.nominal.interval
    lacking = scatter.LACKING.get("ins" if interval is None else interval.by, scatter.LACKING_ELSE)
    seen = scatter.observe(
        state.scatter.get(name), record.t_ns, residual, variance, lacking / max(metres, 1.0)
    )
    seen, text = scatter.report(seen, name)
    out: list[Output] = [] if text is None else [Event(record.t_ns, record.rx_ns, Severity.NOTICE, text)]
    return state._replace(scatter={**state.scatter, name: seen}), seen.used, out


def _beacon(state: State, record: RsbnFix, settings: Settings) -> tuple[State, int, list[Output]]:
    """The number of the beacon that answered; a new one takes a new place, or the most silent one's."""
    assert state.bank is not None
    bank = state.bank
    place, t_ns = (record.lat, record.lon, record.alt), record.t_ns
    for k, beacon in enumerate(state.beacons):
        if beacon.identity == record.beacon:
            beacons = list(state.beacons)
            beacons[k] = Beacon(record.beacon, place, t_ns)
            out: list[Output] = []
            if place != beacon.place:
                known = hypotheses(state, settings)
                first = known.layout.n_base - len(known.biases) + 2 * k
                sigma = known.biases[2 * k : 2 * k + 2]
                state = state._replace(bank=banks.renew(bank, (first, first + 1), sigma))
                text = f"beacon {record.beacon} states another position"
                out = [Event(record.t_ns, record.rx_ns, Severity.NOTICE, text)]
            return state._replace(beacons=tuple(beacons)), k, out
    new = Beacon(record.beacon, place, t_ns)
    if len(state.beacons) < MOST_BEACONS:
        larger = settings.model.with_beacon(bank, len(state.beacons))
        if not state.beacons and state.gnss_taken is not None:
            larger = settings.model.doubted(larger)
        state = state._replace(bank=larger, beacons=(*state.beacons, new))
        state = state._replace(false=(*state.false, 0.0, 0.0), reported=(*state.reported, 0, 0))
        return state, len(state.beacons) - 1, []
    k = min(range(len(state.beacons)), key=lambda i: state.beacons[i].last_ns)
    known = hypotheses(state, settings)
    first = known.layout.n_base - len(known.biases) + 2 * k
    renewed = banks.renew(bank, (first, first + 1), known.biases[2 * k : 2 * k + 2])
    beacons = list(state.beacons)
    beacons[k] = new
    return state._replace(bank=renewed, beacons=tuple(beacons)), k, []


# ---------------------------------------------------------------------------------------------------------
# The bank in time
# ---------------------------------------------------------------------------------------------------------


def _silent(state: State, t_ns: int) -> bool:
    """Whether an INS has given nothing for too long to carry it on."""
    assert state.nominal is not None
    last_ns = state.ins.t_ns if state.ins else state.nominal.t_ns
    return state.nominal.interval is None and (t_ns - last_ns) * 1e-9 > 1.5


def _carried(state: State, t_ns: int) -> State:
    """With the nominal trajectory carried on to `t_ns`."""
    nominal = state.nominal
    assert nominal is not None
    dt = (t_ns - nominal.t_ns) * 1e-9
    if dt <= 0.0:
        return state
    if nominal.interval is not None:
        return state._replace(nominal=own_channel.carry_on(nominal, state.sensors, t_ns))
    v, a = nominal.point.v_n, nominal.a_n
    point = moved(nominal.point, (v[0] + a[0] * dt, v[1] + a[1] * dt), t_ns)
    return state._replace(nominal=nominal._replace(point=point))


def _propagated(state: State, settings: Settings) -> State:
    """With the bank at the time of the nominal point, and births if they are due."""
    nominal, bank = state.nominal, state.bank
    assert nominal is not None
    if bank is None or nominal.pending_s <= 0.0:
        return state
    known = hypotheses(state, settings)
    Phi, Q = settings.model.transition(nominal, len(state.beacons))
    bank = banks.propagate(bank, known.layout, nominal.pending_s, Phi, Q)
    if nominal.interval is not None and nominal.interval.by == "air":
        seen = bank.seen.copy()
        seen[AIRSPEED] = bank.t
        bank = bank._replace(seen=seen)
    if banks.births_due(bank, known.settings):
        jammed = state.jammed_ns is not None and nominal.t_ns - state.jammed_ns < JAMMED_NS
        bank = banks.births(bank, known.layout, known.settings, {0: JAMMED, 1: JAMMED} if jammed else None)
    else:
        bank = banks.jump_births(bank, known.layout, known.settings)
    if nominal.interval is None:
        return state._replace(bank=bank, nominal=nominal._replace(since=nominal.point))
    velocity = nominal.point.v_n[:2]
    nominal = own_channel.restart(nominal, nominal.interval.by, velocity)
    return state._replace(bank=bank, nominal=nominal)


def _decided(state: State, record: Stamped, settings: Settings) -> Step:
    """With the decisions read off the bank, and an event for each source that they change."""
    assert state.bank is not None
    known = hypotheses(state, settings)
    bank = banks.decide(state.bank, known.layout, known.settings)
    false = tuple(banks.false_probability(bank, known.layout).tolist())
    n = len(false)  # more than before if a beacon joined
    before, certain = (*state.reported, *(0,) * n)[:n], (*state.certain_ns, *(0,) * n)[:n]
    reported, since = list(before), list(certain)
    out: list[Output] = []
    for i, p in enumerate(false):
        since[i] = (certain[i] or record.t_ns) if bank.excluded[i] else 0
        if bank.excluded[i] and record.t_ns - since[i] >= CONFIRM_NS:
            reported[i] = EXCLUDED
        elif bank.excluded[i] or p > known.settings.suspect:
            reported[i] = SUSPECT
        elif p < known.settings.believed:
            reported[i] = 0
        if reported[i] != before[i]:
            text = {
                0: "is used again",
                SUSPECT: f"is suspect: false with probability {p:.2f}",
                EXCLUDED: f"is excluded: false with probability {p:.4f}",
            }[reported[i]]
            severity = Severity.WARNING if reported[i] else Severity.NOTICE
            out.append(Event(record.t_ns, record.rx_ns, severity, f"{source_name(i, state)} {text}"))
            by_gnss = sources(state, record.t_ns, settings) & Source.GNSS
            if i == AIRSPEED and reported[i] == EXCLUDED and not by_gnss:
                text = FALSE_AIRSPEED + USE_AIRSPEED.get(settings.config.output.profile, "")
                out.append(Event(record.t_ns, record.rx_ns, Severity.WARNING, text))
    leading = (bank, banks.estimate(bank, known.layout))
    state = state._replace(
        bank=bank, leading=leading, false=false, reported=tuple(reported), certain_ns=tuple(since)
    )
    return state, out


def _rejected(
    state: State, record: Gnss | RsbnFix, name: str, source: int, taken: measurements.Taken
) -> Rejection:
    assert state.bank is not None
    label = f"gnss {record.receiver}" if isinstance(record, Gnss) else name
    if state.reported[source] == EXCLUDED:
        why, false = "excluded: false with probability", state.false[source]
        return Rejection(record.t_ns, record.rx_ns, label, why, false, THRESHOLDS.excluded)
    return Rejection(record.t_ns, record.rx_ns, label, "outlier: normalised squared innovation", taken.nis)


def _nearer(state: State, settings: Settings) -> State:
    """With the nominal trajectory moved by the estimated error where it is far off, or as the scheme says."""
    nominal = state.nominal
    assert nominal is not None
    if nominal.interval is None:
        return state  # an INS of its own cannot be corrected
    x = estimate(state, settings).x
    n, e, vn, ve = (float(c) for c in x[:4])
    share = settings.config.estimator.feedback
    if math.hypot(n, e) > FAR_M or (math.hypot(vn, ve) > FAST_M_S and nominal.interval.by == "imu"):
        share = 1.0
    if share == 0.0:
        return state
    n, e, vn, ve = -share * n, -share * e, -share * vn, -share * ve
    if nominal.interval.by in ("air", "foreign"):
        vn = ve = 0.0  # the velocity is the sensor's, and its error follows from other states
    state = shifted(state, n, e, (vn, ve), nominal.t_ns)
    assert state.bank is not None
    latency = settings.model.channel.latency  # `_latency_velocity` changes by vn, ve, the fixes do not
    state = state._replace(bank=banks.couple(state.bank, (0, 1), latency, (-vn, -ve)))
    sums = state.sensors.sums
    if sums is not None:  # the samples of airspeed so far are moved with the nominal velocity, not dropped
        mean_sum = (sums.velocity[0] + sums.samples * vn, sums.velocity[1] + sums.samples * ve)
        state = state._replace(sensors=state.sensors._replace(sums=sums._replace(velocity=mean_sum)))
    place = displace(*nominal.point.position, n, e, 0.0)
    v = nominal.point.v_n
    velocity = (v[0] + vn, v[1] + ve)
    point = Point(nominal.t_ns, place._replace(alt=nominal.point.position.alt), (*velocity, v[2]))
    nominal = nominal._replace(point=point, since=point)
    return state._replace(nominal=own_channel.restart(nominal, _driver(nominal), velocity))


def _driver(nominal: Nominal) -> By:
    assert nominal.interval is not None
    return nominal.interval.by


def _by(state: State, by: By) -> bool:
    return (
        state.nominal is not None and state.nominal.interval is not None and state.nominal.interval.by == by
    )


def _own(settings: Settings) -> OwnChannel:
    assert isinstance(settings.model.channel, OwnChannel)
    return settings.model.channel


def _velocity(state: State) -> Vector2:
    """Estimated velocity over ground, north and east, m/s."""
    assert state.nominal is not None
    v_n = state.nominal.point.v_n
    if state.bank is None:
        return v_n[0], v_n[1]
    x = state.bank.x[int(state.bank.L.argmax())]
    return v_n[0] - float(x[2]), v_n[1] - float(x[3])


def _latency_velocity(state: State) -> Vector2:
    """Return the velocity that GNSS latency multiplies in a position, north and east, m/s.

    Where the nominal velocity is integrated it is that one, whose rate multiplies the latency in a velocity:
    position and velocity error are then those of the time the fix was taken. The noise of the estimated
    velocity is also in the estimated position: as a coefficient it made straight flight seem to measure the
    latency, as 0.08 s after ten minutes where it was 0.
    """
    if state.nominal is not None and (_by(state, "imu") or _by(state, "hold")):
        return state.nominal.point.v_n[:2]
    return _velocity(state)


def _solved_if_due(state: State, record: Stamped, settings: Settings) -> Step:
    if record.t_ns < state.next_ns or not state.fixed or state.nominal is None:
        return state, []
    state, solution = solve(state, record.rx_ns, settings)
    if solution:
        period = round(1e9 / settings.config.output.pace_hz)
        state = state._replace(
            next_ns=max(state.next_ns + period, state.nominal.t_ns if state.nominal else 0)
        )
    return state, solution


def _channel(record: Stamped, why: str) -> Reset:
    return Reset(record.t_ns, record.rx_ns, "inertial channel", why)


_Uses = dict[type, Callable[[State, Any, Settings], Step]]
_COMMON: _Uses = {
    LocalOrigin: _origin,
    GlobalPosition: _global_position,
    Gnss: _gnss,
    GnssIntegrity: _gnss_integrity,
    RsbnFix: _rsbn,
    Reboot: _reboot,
}
_INS: _Uses = {**_COMMON, LocalPosition: _ins_position}
_CORRECTORS: dict[str, _Uses] = {
    "airspeed": {
        AirData: _airspeed_beside_ins,
        Attitude: _sensed,
        Pressure: _sensed,
        AirspeedSensor: _airspeed_sensor,
    },
    "hyperbolic": {RangeDifference: _corrector("hyperbolic")},
    "stars": {StarFix: _corrector("star")},
    "second_ins": {SecondIns: _corrector("second INS")},
}
_OWN: _Uses = {
    **_COMMON,
    LocalPosition: _foreign_position,
    Attitude: _attitude,
    Pressure: _pressure,
    AirData: _air_data,
    AirspeedSensor: _airspeed_sensor,
    Imu: _imu,
}


_ABOUT_LOCAL = (LocalPosition, GlobalPosition, LocalOrigin)
_OWN_FED: _Uses = {kind: use for kind, use in _OWN.items() if kind not in _ABOUT_LOCAL}
INPUTS_USED = tuple({*_INS, *_OWN, *(kind for use in _CORRECTORS.values() for kind in use), Tuning})
"""Kinds of records that a navigator may use."""


def uses(settings: Settings) -> _Uses:
    """What each kind of record is good for, by the channel; a local position that we feed is ignored."""
    config = settings.config
    if not isinstance(settings.model.channel, OwnChannel):
        added = [_CORRECTORS[name] for name in config.inertial.correctors]
        return {kind: use for uses in (_INS, *added) for kind, use in uses.items()}
    fed = config.output.feeds_estimator or not config.uses("local_position")
    return _OWN_FED if fed else _OWN
