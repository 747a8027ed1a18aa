"""Samples of the own channel: attitude, pressure, IMU, airspeed and a foreign velocity.

A sample moves the nominal trajectory if its sensor leads; else airspeed is a measurement. So is the drag in
the IMU's samples of a multirotor.
"""

from __future__ import annotations

import math

from msgspec import structs

from companion.navigator import (
    air_data_channel,
    air_velocity,
    height_error,
    measurements,
    own_channel,
    own_error_model,
    standing,
    strapdown_channel,
)
from companion.navigator.air_data_channel import CLIMB_NS
from companion.navigator.channel import Nominal
from companion.navigator.ground import (
    FLYING_M_S,
    Ground,
    ground_phase,
    is_clear,
    lifted,
    wind_shear,
)
from companion.navigator.inertial_track import Point
from companion.navigator.minimax_bound import Guarantee
from companion.navigator.own_channel import Sensors
from companion.navigator.own_error_model import HELD, By
from companion.navigator.progress import (
    carried,
    decided,
    driver,
    estimated_velocity,
    propagated,
    shifted,
    solved_if_due,
)
from companion.navigator.state import (
    NEAR_S,
    Settings,
    State,
    Step,
    gnss_climb,
    gnss_is_received,
    held_s,
    hypotheses,
    with_sensors,
)
from companion.records import (
    AirData,
    AirspeedSensor,
    Attitude,
    Imu,
    LocalPosition,
    Output,
    Pressure,
    Rejection,
    Stamped,
    Vector2,
    Vehicle,
)
from companion.units import SECOND_NS

TAKE_OFF_NS = 10 * SECOND_NS  # a multirotor is off the ground after it, at whatever height
BLOCKED_M_S = 5.0  # slower, in flight, a pitot is blocked
#: Between two samples, up to so far apart, no airspeed changes by more; one that did is not used for so long.
STEP_M_S, STEP_M_S2, STEP_GAP_S, STEP_NS = 10.0, 10.0, 1.0, 10 * SECOND_NS


def airspeed_sensor(state: State, record: AirspeedSensor, settings: Settings) -> Step:
    """Remember whether a healthy airspeed sensor is there."""
    return structs.replace(state, sensors=own_channel.with_airspeed_sensor(state.sensors, record)), []


def vehicle(state: State, record: Vehicle, settings: Settings) -> Step:
    """Remember what kind of vehicle it is, and whether it flies."""
    s = state.sensors
    multirotor = s.multirotor if record.multirotor is None else record.multirotor
    fixed_wing = s.fixed_wing if record.fixed_wing is None else record.fixed_wing
    hovering = s.hovering if record.hovering is None else record.hovering
    landed = s.landed if record.flying is None else not record.flying
    aloft_ns = s.aloft_ns
    if record.flying is not None:  # a copter hovers always, by its own statement
        aloft_ns = (aloft_ns or record.t_ns) if record.flying and (multirotor or not hovering) else None
    if aloft_ns is not None and fixed_wing and not s.fixed_wing:  # until now its rotors held it up
        aloft_ns = record.t_ns
    return with_sensors(
        state,
        multirotor=multirotor,
        fixed_wing=fixed_wing,
        hovering=hovering,
        landed=landed,
        aloft_ns=aloft_ns,
    ), []


def attitude(state: State, record: Attitude, settings: Settings) -> Step:
    """Remember an attitude."""
    s = state.sensors
    strap, air = strapdown_channel.sense(s.strap, record), air_data_channel.sense(s.air, record)
    state = with_sensors(state, strap=strap, air=air)
    if state.nominal is not None and own_channel.is_steady(state.sensors, record.t_ns):
        return _steady(state, record, settings)
    return _straight_on(state, record, settings)


def _steady(state: State, record: Attitude, settings: Settings) -> Step:
    """Use a steady airspeed along the nose, as driver or as measurement: a fixed wing without a sensor."""
    if not settings.config.uses("air_data"):
        return _straight_on(state, record, settings)
    state = air_velocity.taken_from("steady", state, settings)
    steady_m_s = state.sensors.steady_m_s
    if steady_m_s is None:  # there is no wind yet
        steady_m_s = max(math.hypot(*estimated_velocity(state)), FLYING_M_S)
    V = own_error_model.air_velocity(steady_m_s, record.pitch, record.heading)
    if state.sensors.leads("air", record.t_ns):
        return _driven(with_sensors(state, air_ns=record.t_ns), record, "air", V, settings)
    return (air_velocity.measured(state, record, V, settings) if driver(state) == "imu" else state), []


def pressure(state: State, record: Pressure, settings: Settings) -> Step:
    """Remember a static pressure, unless its altitude steps."""
    s = state.sensors
    if (rejection := air_data_channel.step(s.air, record, gnss_climb(state, record.t_ns))) is not None:
        state, out = _straight_on(state, record, settings)
        return state, [rejection, *out]
    air = air_data_channel.sense(s.air, record)
    held, before = held_s(state, record.t_ns), state.nominal
    state = with_sensors(state, air=air)
    fixed_ns = state.level.t_ns
    if before is not None and fixed_ns is not None and fixed_ns - s.air.static_ns > CLIMB_NS:
        # the height has been that of the fixes, and goes on from there
        nominal, level = _at_height(before, state.sensors), height_error.at(state.level, before.point, held)
        level = height_error.stepped(level, nominal.point.position.alt - before.point.position.alt)
        state = structs.replace(state, nominal=nominal, level=level)
    return _straight_on(state, record, settings)


def _straight_on(state: State, record: Stamped, settings: Settings) -> Step:
    """Without a driver the nominal trajectory goes straight on, by whatever sample is still there."""
    held = state.sensors.held
    if not state.sensors.leads(held, record.t_ns):
        return state, []
    return _driven(state, record, held, None, settings)


def imu(state: State, record: Imu, settings: Settings) -> Step:
    """Move the nominal trajectory by the specific force, in the level frame."""
    if record.source != settings.config.strapdown.imu:
        return state, []
    s = state.sensors
    strap = strapdown_channel.receive(s.strap, record)
    if strap.why:
        state, outputs = _straight_on(with_sensors(state, strap=strap), record, settings)
        if strap.is_slow and driver(state) in HELD:
            state = _rotor_drag(state, record, settings)
        return state, outputs
    now = strapdown_channel.acceleration(strap)
    fresh = record.t_ns - s.imu_ns <= own_channel.SILENT_NS["imu"]
    before = s.accelerations[-2:] if fresh else ()
    dt = (record.t_ns - s.imu_ns) * 1e-9
    state = with_sensors(
        state,
        strap=strap,
        imu_ns=record.t_ns,
        accelerations=(*before, now),
        mean_acceleration=strapdown_channel.lasting(s.mean_acceleration, now, dt),
        mean_force=strapdown_channel.lasting(s.mean_force, record.f_b, dt),
    )
    last = before[-1] if before else now
    between = (0.5 * (now[0] + last[0]), 0.5 * (now[1] + last[1]))
    state, outputs = _driven(state, record, "imu", between, settings)
    return _standing(_rotor_drag(state, record, settings), record, settings), outputs


def _standing(state: State, record: Imu, settings: Settings) -> State:
    """Use that a parked aircraft stands, while GNSS is not received."""
    s, nominal = state.sensors, state.nominal
    height = 0.0 if nominal is None else nominal.point.position.alt
    means = s.mean_acceleration, s.mean_force
    now = standing.follow(s.standing, record, s.landed, *means, height, state.gnss_taken)
    if now != s.standing:
        state = with_sensors(state, standing=now)
    if state.bank is None or nominal is None or not now.is_due(record.t_ns):
        return state
    if gnss_is_received(state, settings):
        return state
    state = propagated(state, settings)
    assert state.bank is not None
    assert state.nominal is not None
    v_n = state.nominal.point.v_n
    taken = measurements.standing(state.bank, hypotheses(state, settings), (v_n[0], v_n[1]))
    state = with_sensors(state, standing=now._replace(measured_ns=record.t_ns))
    return decided(structs.replace(state, bank=taken.bank), record, settings)


def _rotor_drag(state: State, record: Imu, settings: Settings) -> State:
    """Use the drag of a multirotor as a measurement of its velocity through the air."""
    nominal, s, drag = state.nominal, state.sensors, settings.config.air_data.rotor_drag_per_s
    if nominal is None or drag == 0.0 or not settings.config.uses("air_data"):
        return state
    if not own_channel.drag_is_sensed(s, record.t_ns):
        return state
    height = None if s.air.static is None else nominal.point.position.alt
    if s.aloft_ns is None:
        parked = Ground(parked_height=height)
        return with_sensors(state, ground=parked, sums=None)
    taking_off = not s.ground.flying and record.t_ns - s.aloft_ns < TAKE_OFF_NS
    if taking_off and is_clear(s.ground, height) is False:
        return state  # the ground pushes too
    state = _sheared(state, lifted(s.ground, height))
    state = air_velocity.taken_from("drag", state, settings)
    force = strapdown_channel.drag_force(s.strap)
    if force is None:
        return state
    return air_velocity.measured(state, record, (-force[0] / drag, -force[1] / drag), settings)


def air_data(state: State, record: AirData, settings: Settings) -> Step:
    """Use airspeed, as driver or as measurement; on the ground it only shows whether the aircraft flies."""
    s = state.sensors
    state = with_sensors(state, air=air_data_channel.sense(s.air, record))
    nominal = state.nominal
    if nominal is None or not settings.config.uses("air_data"):
        return state, []
    if not own_channel.airspeed_is_sensed(s, record):
        return state, []
    V = own_channel.air_velocity(s, record, nominal.point.position.alt)
    if V is None:
        return state, []
    speed = math.hypot(*estimated_velocity(state))
    if s.ground.flying and math.hypot(*V) < BLOCKED_M_S < 0.5 * speed:
        return state, _blocked_pitot(s, record)
    leads = s.leads("air", record.t_ns)
    if s.ground.flying and leads and (step := _step(s, record)) is not None:
        return state, [step]
    height = None if s.air.static is None else nominal.point.position.alt
    hovers = s.hovering and not s.landed
    ground = ground_phase(s.ground, record.t_ns * 1e-9, math.hypot(*V), speed, height, hovers)
    state = _sheared(state, ground)
    if not ground.flying:
        return _straight_on(state, record, settings)
    state = with_sensors(state, air_ns=record.t_ns, pitot_ns=record.t_ns)
    state = air_velocity.taken_from("pitot", state, settings)
    state = air_velocity.with_wind_noted(state, record.t_ns, settings)
    state = _reckoned(state, nominal.point, V, record.t_ns)
    if leads:
        return _driven(with_sensors(state, steady=record), record, "air", V, settings)
    if driver(state) != "imu":
        return state, []
    return air_velocity.measured(carried(state, record.t_ns, settings), record, V, settings), []


def _reckoned(state: State, start: Point, V: Vector2, t_ns: int) -> State:
    """With the trajectory by airspeed alone; where that begins again, so does the window of its bound.

    A sample that steps is left out, as where it moves the position.
    """
    before, guarantee = state.reckoned, state.guarantee
    if before is None or own_channel.is_old(before, t_ns):
        before = None
        guarantee = Guarantee() if guarantee.by == "air" else guarantee
    else:
        step = abs(math.hypot(*V) - math.hypot(*before.track.point.v_n[:2]))
        if step > _step_limit(t_ns - before.track.t_ns):
            return state
    after = own_channel.reckoned(before, start, V, t_ns)
    return structs.replace(state, reckoned=after, guarantee=guarantee)


def _step_limit(gap_ns: int) -> float:
    """The greatest change of an airspeed in a time, m/s."""
    return STEP_M_S + STEP_M_S2 * gap_ns * 1e-9


def _sheared(state: State, ground: Ground) -> State:
    """With another phase of the flight, and with what the wind may have changed with height in it."""
    s, nominal = state.sensors, state.nominal
    sheared = wind_shear(s.ground, ground)
    state = with_sensors(state, ground=ground)
    if sheared and nominal is not None and nominal.interval is not None:
        interval = nominal.interval._replace(shear=nominal.interval.shear + sheared)
        state = structs.replace(state, nominal=structs.replace(nominal, interval=interval))
    return state


def _step(s: Sensors, record: AirData) -> Rejection | None:
    """Reject an airspeed that would move the position, if no aircraft reaches it since the sample before.

    It is compared with the last one used, and used again after some seconds, as after a silence.
    """
    last, before = s.steady, s.air.air
    if last is None or before is None or record.true != last.true:
        return None
    gap_s = (record.t_ns - before.t_ns) * 1e-9
    step, limit = abs(record.airspeed - last.airspeed), _step_limit(record.t_ns - before.t_ns)
    if step <= limit or gap_s > STEP_GAP_S or record.t_ns - last.t_ns > STEP_NS:
        return None
    return Rejection(record.t_ns, record.rx_ns, "airspeed", "it steps: not used", step, limit)


def _blocked_pitot(before: Sensors, record: AirData) -> list[Output]:
    """Reject an airspeed at which nothing flies, once a second: without a direction it cannot be modelled."""
    last = before.air.air
    if last is not None and last.t_ns // SECOND_NS == record.t_ns // SECOND_NS:
        return []
    why = "airspeed too low for the speed over ground: not used"
    return [Rejection(record.t_ns, record.rx_ns, "airspeed", why, record.airspeed, BLOCKED_M_S)]


def foreign_position(state: State, record: LocalPosition, settings: Settings) -> Step:
    """Go by the velocity of the autopilot's estimator."""
    state = structs.replace(with_sensors(state, foreign_ns=record.t_ns), local=record)
    if state.origin is None and state.waiting_ns is None:
        state = structs.replace(state, waiting_ns=record.t_ns)
    return _driven(state, record, "foreign", (record.v_n[0], record.v_n[1]), settings)


def _driven(state: State, record: Stamped, by: By, sample: Vector2 | None, settings: Settings) -> Step:
    """Move the nominal trajectory to the time of a sample of its driver, and solve if that is due.

    `sample` is the mean acceleration (imu) or the velocity (air, foreign); None goes straight on.
    """
    nominal, s = state.nominal, state.sensors
    if nominal is None or record.t_ns <= nominal.t_ns:
        return state, []
    assert nominal.interval is not None
    if nominal.interval.by != by:
        s = structs.replace(s, sums=None)
        state = structs.replace(propagated(carried(state, record.t_ns, settings), settings), sensors=s)
        assert state.nominal is not None
        velocity = sample if by in ("air", "foreign") and sample else state.nominal.point.v_n[:2]
        state = _velocity_stepped(state, velocity)
        assert state.nominal is not None
        nominal = own_channel.restart(state.nominal, by, velocity)
        if by == "imu" and sample:
            nominal = structs.replace(nominal, a_n=sample)
    elif by == "imu" and sample:
        nominal = structs.replace(
            own_channel.by_imu(nominal, sample, s, record.t_ns), a_n=s.accelerations[-1][:2]
        )
    else:
        nominal = own_channel.by_velocity(nominal, sample or (0.0, 0.0), record.t_ns)
    state = structs.replace(state, nominal=_at_height(nominal, s))
    if nominal.pending_s >= NEAR_S:
        state = decided(propagated(state, settings), record, settings)
    return solved_if_due(state, record, settings)


def _velocity_stepped(state: State, velocity: Vector2) -> State:
    """With the errors of another nominal `velocity` (m/s) from now on: the aircraft's is the same."""
    assert state.nominal is not None
    north, east, _ = state.nominal.point.v_n
    step = (velocity[0] - north, velocity[1] - east)
    return structs.replace(shifted(state, 0.0, 0.0, step), gnss_fix=state.gnss_fix)


def _at_height(nominal: Nominal, s: Sensors) -> Nominal:
    """With the height of the pressure, and its rate as the climb."""
    if s.air.static is None:
        return nominal
    point = nominal.point
    alt = air_data_channel.pressure_altitude(s.air.static)
    v_n = (point.v_n[0], point.v_n[1], -s.air.climb_at(point.t_ns))
    return structs.replace(nominal, point=point._replace(position=point.position._replace(alt=alt), v_n=v_n))
