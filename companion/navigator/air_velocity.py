"""Velocity through the air, of a pitot, a multirotor's drag or a steady airspeed, as a measurement.

Samples of half a second are one measurement. Where another sensor gives it, its scale starts again; where a
pitot was given up, the wind is that of half a minute before.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from msgspec import structs

from companion.estimate import bank as banks
from companion.navigator import measurements, own_error_model, strapdown_channel
from companion.navigator.ground import FLYING_M_S
from companion.navigator.own_channel import AirspeedSums, Wind
from companion.navigator.own_error_model import LEAST_M_S, Airspeed
from companion.navigator.progress import decided, driver, propagated
from companion.navigator.state import Settings, State, estimate, hypotheses, own, with_sensors
from companion.records import AirData, Attitude, Imu, Vector2
from companion.units import SECOND_NS, Floats

AIRSPEED_EVERY_NS = 500_000_000  # gusts are correlated: more often adds nothing
SAMPLE_M_S = 5.0  # of the velocity by single samples of drag: 2.4 to 8.6 m/s in six recorded copters
#: A pitot that fails is used for some seconds more, and the wind with it: that of so long ago comes after it.
WIND_EVERY_NS, WINDS_NS, WIND_CHANGED_M_S = 10 * SECOND_NS, 30 * SECOND_NS, 1.0


class Renewal(NamedTuple):
    """What begins again with another airspeed: errors x become F x + c, and D is added to their covariance.

    `steady_m_s` is the size of a steady airspeed.
    """

    F: Floats
    c: Floats
    D: Floats
    steady_m_s: float | None


def taken_from(airspeed: Airspeed, state: State, settings: Settings) -> State:
    """Take the velocity through the air from something, and start its scale again if it was another."""
    new = renewal(airspeed, state, settings)
    if new is None or state.bank is None or state.nominal is None:
        return state
    bank = banks.propagate(state.bank, hypotheses(state, settings).layout, 0.0, new.F, new.D)
    interval = state.nominal.interval and state.nominal.interval._replace(airspeed=airspeed)
    state = structs.replace(
        state, bank=banks.shift(bank, new.c), nominal=structs.replace(state.nominal, interval=interval)
    )
    return with_sensors(state, sums=None, winds=(), steady_m_s=new.steady_m_s)


def renewal(airspeed: Airspeed, state: State, settings: Settings) -> Renewal | None:
    """What begins again if the velocity through the air is taken from `airspeed`; None if it is already.

    A steady airspeed is that of velocity and wind: its scale is as wrong as they are. As an error of its own
    it held a wind of 17 m/s to be 1 +- 3 m/s, and the pitot that came back to be false.
    """
    bank, nominal, winds = state.bank, state.nominal, state.sensors.winds
    if bank is None or nominal is None or nominal.interval is None or nominal.interval.airspeed == airspeed:
        return None
    n, scale, wind = hypotheses(state, settings).layout.n_base, own_error_model.SCALE, own_error_model.WIND
    F, c, D, steady_m_s = np.eye(n), np.zeros(n), np.zeros((n, n)), None
    if nominal.interval.airspeed == "pitot" and winds:
        F[wind] = 0.0
        c[wind] = winds[0].north, winds[0].east
        D[wind, wind] = (winds[0].variance + WIND_CHANGED_M_S**2) * np.eye(2)
    F[scale] = 0.0
    if airspeed == "steady":
        x = F @ bank.x[int(bank.L.argmax()), :n] + c
        air = np.array(nominal.point.v_n[:2]) - x[own_error_model.VELOCITY] - x[wind]
        steady_m_s = max(math.hypot(*air), FLYING_M_S)
        of = np.zeros(n)
        of[own_error_model.VELOCITY] = of[wind] = air / max(math.hypot(*air), LEAST_M_S) / steady_m_s
        F[scale], c[scale] = of @ F, of @ (c - x)
        D[scale] = D[:, scale] = of @ D
        D[scale, scale] = of @ D @ of
    D[scale, scale] += own_error_model.scale_sigma(own(settings).settings, airspeed) ** 2
    return Renewal(F, c, D, steady_m_s)


def with_wind_noted(state: State, t_ns: int, settings: Settings) -> State:
    """Remember the wind beside a pitot that is used."""
    winds = state.sensors.winds
    if state.bank is None or (winds and t_ns - winds[-1].t_ns < WIND_EVERY_NS):
        return state
    x, P = estimate(state, settings)
    north, east = own_error_model.WIND.start, own_error_model.WIND.start + 1
    wind = Wind(t_ns, float(x[north]), float(x[east]), float(0.5 * (P[north, north] + P[east, east])))
    kept = (w for w in winds if t_ns - w.t_ns <= WINDS_NS)
    return with_sensors(state, winds=(*kept, wind))


def measured(state: State, record: AirData | Attitude | Imu, V: Vector2, settings: Settings) -> State:
    """Use a velocity `V` through the air (m/s) as a measurement, the mean of half a second at once."""
    assert state.nominal is not None
    s, v_n = state.sensors, state.nominal.point.v_n
    sums = (s.sums or AirspeedSums(record.t_ns)).with_one((v_n[0], v_n[1]), V)
    if record.t_ns - sums.start_ns < AIRSPEED_EVERY_NS:
        return with_sensors(state, sums=sums)
    if not isinstance(record, Imu) and not sums.is_one_way:
        return with_sensors(state, sums=AirspeedSums(record.t_ns, V))
    state = propagated(state, settings)
    assert state.bank is not None
    bank, known, n = state.bank, hypotheses(state, settings), sums.samples
    mean, velocity = (sums.air[0] / n, sums.air[1] / n), (sums.velocity[0] / n, sums.velocity[1] / n)
    by_imu = driver(state) == "imu"
    manoeuvre = strapdown_channel.manoeuvre(s.mean_acceleration) if by_imu else 0.0
    if isinstance(record, AirData):
        taken = measurements.airspeed(bank, known, own(settings), mean, velocity, manoeuvre)
    elif isinstance(record, Attitude):
        taken = measurements.steady_airspeed(bank, known, own(settings), mean, velocity, manoeuvre)
    else:
        drag, heading = settings.config.air_data.rotor_drag_per_s, s.heading() or 0.0
        variance = own_error_model.airspeed_variance(manoeuvre) + sums.scatter
        variance += 0.0 if by_imu else SAMPLE_M_S**2
        taken = measurements.rotor_drag(bank, known, own(settings), mean, velocity, variance, heading, drag)
    state = structs.replace(state, bank=taken.bank)
    state = with_sensors(state, measured_ns=record.t_ns, sums=AirspeedSums(record.t_ns, V))
    return decided(state, record, settings)
