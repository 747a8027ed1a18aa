"""Measurements of the bank: GNSS position and velocity, azimuth and range of a beacon, airspeed.

Each states what a record measures of the error states, for all rows at once. A measurement goes to every row,
those that hold its source to be false included: they estimate its error. It counts as used where its source
is not excluded and the leading hypothesis could take it.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from companion.estimate import bank as banks
from companion.estimate.bank import Bank, Innovation
from companion.estimate.fusion import Azimuth, Range
from companion.nav.geometry import Geodetic, separation, wrap_angle
from companion.navigator import fix_observations, own_error_model
from companion.navigator.channel import Channel
from companion.navigator.corrector_measurements import CorrectorRows
from companion.navigator.hypotheses import (
    AIRSPEED,
    AIRSPEED_GROUP,
    CONSISTENT,
    GNSS,
    GNSS_GROUP,
    VELOCITY,
    Hypotheses,
)
from companion.navigator.inertial_track import Point
from companion.navigator.ins_channel import ARM_M, TURNING_M_S
from companion.navigator.own_channel import OwnChannel
from companion.records import Gnss, Vector2
from companion.units import Floats

#: Log density of a measurement that has nothing to do with its quantity: one in ten thousand, anywhere within
#: 2 km, 0.1 rad, 5 km, 20 m/s; or as far as the leading hypothesis itself expects it.
RARE = math.log(1e-4)
OUTLIER = {
    "position": math.log(1e-4 / 2000.0**2),
    "velocity": math.log(1e-4 / 20.0**2),
    "azimuth": math.log(1e-4 / 0.1),
    "range": math.log(1e-4 / 5000.0),
}


#: Normalised squared innovation per component of an airspeed that bears onsets at once: a pitot that sticks.
#: An IMU that was turned surprises it less; with 5, as for a fix, a healthy GNSS was doubted beside one.
AIRSPEED_SURPRISE = 40.0
STANDING_M_S = 0.1  # noise of a velocity that is zero
#: Half the normalised squared innovation of a corrector's component at which it is an outlier: five sigma.
CORRECTOR_GATE = 12.5


class Taken(NamedTuple):
    """The bank after a measurement; its normalised squared innovation by the leading row, whether that row
    took it, and whether the row did that led before.
    """

    bank: Bank
    nis: float
    accepted: bool
    by_former: bool


def gnss_position(
    bank: Bank,
    known: Hypotheses,
    channel: Channel,
    apart: Vector2,
    variance: float,
    v_n: Vector2,
    shows_latency: bool,
) -> Taken:
    """Take the position of a fix: nominal minus GNSS is the error less drift and arm, plus latency times
    speed.

    `apart` is GNSS minus nominal (m), `variance` that of its white noise (m^2). The arm is along the
    course; slower than TURNING_M_S its direction is unknown. Where the velocity `v_n` is known from positions
    alone a fix does not show the latency (not `shows_latency`): its uncertainty is noise along the course.
    """
    north, east = apart
    H = np.zeros((2, known.layout.n_base))
    H[0, 0] = H[1, 1] = 1.0
    H[:, channel.drift] = -np.eye(2)
    z, R = np.array((-north, -east)), variance * np.eye(2)
    if shows_latency:
        H[:, channel.latency] = v_n
    else:
        leading, at = int(bank.L.argmax()), channel.latency
        z -= bank.x[leading, at] * np.array(v_n)
        R += bank.P[leading, at, at] * np.outer(v_n, v_n)
    if channel.arm is not None:
        speed = math.hypot(*v_n)
        if speed > TURNING_M_S:
            H[:, channel.arm] = -v_n[0] / speed, -v_n[1] / speed
        else:
            R += ARM_M**2 * np.eye(2)
    return _take(bank, known, z, H, R, GNSS, "position")


def other_receiver(bank: Bank, channel: Channel) -> Bank:
    """Forget `receiver_states`: the next fix is another receiver's."""
    states = receiver_states(channel)
    return banks.renew(bank, states, np.sqrt(channel.prior()[0].diagonal()[states]).tolist())


def receiver_states(channel: Channel) -> list[int]:
    """Drift, lasting velocity error, latency and lever arm of a receiver."""
    base = range(channel.n)
    arm = [] if channel.arm is None else [channel.arm]
    return [*base[channel.drift], *base[channel.doppler], channel.latency, *arm]


def gnss_apart(record: Gnss, nominal: Point) -> Vector2:
    """Return the position of a fix less the nominal one, north and east (m)."""
    north, east, _ = separation(Geodetic(record.lat, record.lon, record.alt_msl), nominal.position)
    return north, east


def gnss_velocity(
    bank: Bank,
    known: Hypotheses,
    channel: Channel,
    record: Gnss,
    nominal: Point,
    a_n: Vector2,
    variance: float,
) -> Taken:
    """Take the velocity of a fix; rows that hold GNSS and its velocity false measure the rate of its error.

    For rows that hold the velocity alone false, `update` adds its error. In turns an antenna ahead has a
    velocity of its own. `variance` is that of its noise (m^2/s^2).
    """
    assert record.v_n is not None
    layout = known.layout
    z = np.array((nominal.v_n[0] - record.v_n[0], nominal.v_n[1] - record.v_n[1]))
    rate = layout.starts[GNSS_GROUP] + layout.groups[GNSS_GROUP]
    v_n = nominal.v_n
    speed = math.hypot(*v_n[:2])
    turn = (v_n[0] * a_n[1] - v_n[1] * a_n[0]) / max(speed, TURNING_M_S) ** 3  # rate of the course by speed

    def seen_by(bank: Bank) -> tuple[Floats, Floats]:
        H = np.zeros((len(bank.L), 2, layout.n))
        H[:, 0, 2] = H[:, 1, 3] = 1.0
        H[:, :, channel.latency] = a_n
        H[:, :, channel.doppler] = -np.eye(2)
        if channel.arm is not None and speed > TURNING_M_S:
            H[:, :, channel.arm] = turn * v_n[1], -turn * v_n[0]
        lying = (bank.fault[:, GNSS_GROUP] == CONSISTENT).astype(np.float64)
        H[:, 0, rate] = H[:, 1, rate + 1] = lying
        return np.broadcast_to(z, (len(bank.L), 2)), H

    return _take(bank, known, seen_by, None, variance * np.eye(2), VELOCITY, "velocity")


def airspeed(
    bank: Bank, known: Hypotheses, channel: OwnChannel, V: Vector2, velocity: Vector2, manoeuvre: float
) -> Taken:
    """Take airspeed and heading as a velocity through the air; a false airspeed is wrong along the nose.

    `V` and the nominal `velocity` (m/s) are means over the same samples, `manoeuvre` the
    acceleration above that of level flight (m/s^2).
    """
    layout = known.layout
    row = channel.propagator.airspeed_row(velocity, V, manoeuvre)
    speed = math.hypot(*V)
    lie = layout.lie_states(AIRSPEED)[0]

    def seen_by(bank: Bank) -> tuple[Floats, Floats]:
        H = np.zeros((len(bank.L), 2, layout.n))
        H[:, :, : channel.n] = row.H[:, : channel.n]
        false = (bank.fault[:, AIRSPEED_GROUP] != banks.NONE).astype(np.float64)
        H[:, 0, lie], H[:, 1, lie] = -false * V[0] / speed, -false * V[1] / speed
        return np.broadcast_to(row.y, (len(bank.L), 2)), H

    known = known._replace(settings=replace(known.settings, surprise=AIRSPEED_SURPRISE))
    return _take(bank, known, seen_by, None, row.R, AIRSPEED, "velocity", has_lie=True)


def steady_airspeed(
    bank: Bank, known: Hypotheses, channel: OwnChannel, V: Vector2, velocity: Vector2, manoeuvre: float
) -> Taken:
    """Take the airspeed of a fixed wing without a sensor for steady; arguments as in `airspeed`.

    It is no source that may be false: what it wanders by is a state, and so is its scale.
    """
    return _velocity(bank, known, channel, channel.propagator.airspeed_row(velocity, V, manoeuvre))


def rotor_drag(
    bank: Bank,
    known: Hypotheses,
    channel: OwnChannel,
    V: Vector2,
    velocity: Vector2,
    variance: float,
    heading: float,
    drag_per_s: float,
) -> Taken:
    """Take the velocity through the air by a multirotor's drag. It is no source that may be false.

    A constant error along the velocity, as a pitot's, would stand for drag that is not quite linear: it was
    held false beside a healthy GNSS. `V` and `velocity` as in `own_error_model.drag_rows`; `variance` is that
    of `V` on each axis, (m/s)^2.
    """

    def seen_by(bank: Bank) -> tuple[Floats, Floats]:
        z, own = own_error_model.drag_rows(bank.x, velocity, V, heading, drag_per_s)
        H = np.zeros((len(bank.L), 2, known.layout.n_base))
        H[:, :, : channel.n] = own[:, :, : channel.n]
        return z, H

    return _take(bank, known, seen_by, None, variance * np.eye(2), None, "velocity")


def standing(bank: Bank, known: Hypotheses, velocity: Vector2) -> Taken:
    """Take a nominal `velocity` (m/s) for the error: the aircraft stands."""
    H = np.zeros((2, known.layout.n_base))
    H[0, 2] = H[1, 3] = 1.0
    return _take(bank, known, np.array(velocity), H, STANDING_M_S**2 * np.eye(2), None, "velocity")


def _velocity(bank: Bank, known: Hypotheses, channel: OwnChannel, row: own_error_model.Row) -> Taken:
    H = np.zeros((2, known.layout.n_base))
    H[:, : channel.n] = row.H[:, : channel.n]
    return _take(bank, known, row.y, H, row.R, None, "velocity")


def corrector(bank: Bank, known: Hypotheses, rows: CorrectorRows) -> Taken:
    """Take what a corrector of an INS measures; it has no source that may be false, but may be an outlier."""
    H = np.zeros((len(rows.z), known.layout.n_base))
    H[:, : rows.H.shape[1]] = rows.H
    spread = float(
        np.linalg.slogdet(2.0 * math.pi * (H @ bank.P[0, : H.shape[1], : H.shape[1]] @ H.T + rows.R))[1]
    )
    outlier = -0.5 * spread - CORRECTOR_GATE * len(rows.z)
    after, seen = banks.update(bank, known.layout, rows.z, H, rows.R, None, known.settings, outlier=outlier)
    return _taken(bank, after, seen)


def sight(
    bank: Bank,
    known: Hypotheses,
    z: Azimuth | Range,
    beacon: int,
    variance: float,
    centre: Vector2,
    v_n: tuple[float, ...],
) -> Taken:
    """Take an azimuth or a range of beacon number `beacon`, linearised for each row about its own position.

    `z` is in the plane tangent at the nominal point less the error `centre` (north, east, m): a nominal
    trajectory kilometres off would otherwise cost tens of metres. For rows that hold the beacon to be
    elsewhere the lie is its displacement (north, east, m): the aircraft seen from it is displaced by as much.
    An answer that is late sees where the aircraft was: `v_n` is the nominal velocity (m/s). `variance` is
    that of its noise, the unknown height included.
    """
    layout = known.layout
    source = known.azimuth(beacon) if isinstance(z, Azimuth) else known.range(beacon)
    group = layout.sources[source].group
    place = layout.starts[group] + np.arange(2)
    own_slot = place[0 if isinstance(z, Azimuth) else 1]  # the bank fills in a one here
    first = known.bias(beacon)
    bias, late = first + (0 if isinstance(z, Azimuth) else 1), first + 2

    def linearised(bank: Bank) -> tuple[Floats, Floats]:
        elsewhere = (bank.fault[:, group] == known.elsewhere(beacon)).astype(np.float64)
        x = bank.x[:, :2] + elsewhere[:, None] * bank.x[:, place]
        at = np.zeros((len(x), 3))
        at[:, 0], at[:, 1] = centre[1] - x[:, 1], centre[0] - x[:, 0]  # east, north of the plane's origin
        predicted, east, north = fix_observations.predict_sight(z, at)
        H = np.zeros((len(x), 1, layout.n))
        H[:, 0, 0], H[:, 0, 1] = -north, -east
        H[:, 0, bias] = 1.0
        H[:, 0, late] = H[:, 0, 0] * v_n[0] + H[:, 0, 1] * v_n[1]
        H[:, 0, place] = elsewhere[:, None] * H[:, 0, :2]
        H[:, 0, own_slot] -= elsewhere
        innovation = z.value - predicted
        if isinstance(z, Azimuth):
            innovation = np.remainder(innovation + math.pi, 2.0 * math.pi) - math.pi
        lin = H[:, 0, 0] * x[:, 0] + H[:, 0, 1] * x[:, 1]
        return (innovation + lin)[:, None], H

    R = np.array(((variance,),))
    kind = "azimuth" if isinstance(z, Azimuth) else "range"
    return _take(bank, known, linearised, None, R, source, kind)


def sight_residual(z: Azimuth | Range, centre: Vector2) -> float:
    """Return an azimuth (rad) or a range (m) less that of the nominal point; `centre` as in `sight`."""
    predicted, _, _ = fix_observations.predict_sight(z, np.array(((centre[1], centre[0], 0.0),)))
    apart = z.value - float(predicted[0])
    return wrap_angle(apart) if isinstance(z, Azimuth) else apart


def _take(
    bank: Bank,
    known: Hypotheses,
    z: Floats | Callable[[Bank], tuple[Floats, Floats]],
    H: Floats | None,
    R: Floats,
    source: int | None,
    kind: str,
    has_lie: bool = False,
) -> Taken:
    """Update by a measurement whose outliers are those of its `kind`; arguments as of `banks.update`."""
    is_judged = known.judged and source not in (None, AIRSPEED)
    outlier = banks.NEVER if is_judged else OUTLIER[kind]
    after, seen = banks.update(
        bank, known.layout, z, H, R, source, known.settings, outlier=outlier, rare=RARE, has_lie=has_lie
    )
    return _taken(bank, after, seen)


def _taken(before: Bank, after: Bank, seen: Innovation) -> Taken:
    took = ~seen.refused  # of the rows before, then of their children
    by_former = bool(took[int(before.L.argmax())])
    return Taken(after, float(seen.nis[seen.leading]), bool(took[seen.leading]), by_former)
