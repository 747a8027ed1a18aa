"""What may be wrong: the layout of the navigator's bank, its priors, and beacons as they appear.

Base states are those of the channel, then the biases of each beacon, by identity: of its azimuth, of its
range, and of the time of its answers. GNSS, airspeed and each beacon have a group of lie states, so that all
of them may be false at once. Of GNSS either the position, with its velocity or alone, or the velocity alone
is false; of a beacon its azimuth, its range, each by itself, or both by its place.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from msgspec import structs

from companion.config import Config
from companion.estimate import bank as banks
from companion.estimate.bank import (
    Angle,
    Bank,
    Fault,
    Jump,
    Layout,
    Lie,
    Settings,
    Source,
    enlarge,
    start,
)
from companion.estimate.bank.settings import DEFAULT
from companion.navigator import own_error_model
from companion.navigator.channel import Channel, Nominal, Transition
from companion.navigator.corrected_ins import corrected_ins
from companion.navigator.fix_observations import LATE_S
from companion.navigator.own_channel import OwnChannel
from companion.units import Floats

POSITION = (0, 1)  # states
SOURCES = ("gnss", "airspeed", "velocity of gnss")  # then `azimuth(k)` and `range(k)` of each beacon k
GNSS, AIRSPEED, VELOCITY = range(len(SOURCES))
CONSISTENT = 0  # fault of GNSS: its velocity is false too
GNSS_GROUP, BEACON_GROUP, AIRSPEED_GROUP = 0, 1, 2
GROUPS = (2, 2, 1)  # then two of each further beacon
CHANNEL_JUMPS_H, CHANNEL_JUMP_M = 1e-3, 100.0
INS_JUMPS_H = 0.01  # its position, by a reset of the unit
#: The velocity of an INS steps (m, m/s), so rarely that a GNSS drawn off by 0.5 m/s is beyond doubt in 2.4 s.
#: Beacons that contradict are believed within two minutes: without it an INS that drifted excluded all else.
INS_DRIFTS_H, INS_DRIFT = 2e-7, (5.0, 5.0, 1.0, 1.0)
INS_DRIFTS_AGAIN_H = 1.0  # once it has stepped
#: Its position with it: a GNSS that drew the INS off unnoticed is true again.
INS_MISLED = (100.0, 100.0, 1.0, 1.0)
BEACON_PLACE = 0.03  # its position is stated wrongly: likelier than a GNSS captured before the first fix
BEACON_H = 2e-4  # a beacon steps, or is elsewhere, so often in an hour; it does not drift
ORDERS = (3, 2, 2)  # GNSS may be drawn off with an acceleration
#: The error of an airspeed is bounded: with a heading that stuck, it grew against the wind to 274 m/s.
RATE_CORRELATION_S = (banks.NO_DECAY_S, banks.NO_DECAY_S, 30.0)
APART_S = 10.0  # the estimate does not follow a jump of the channel while another explanation is likelier
SILENCE_S = 5.0  # airspeed that is not used for longer is not judged
MOST_BEACONS = 8  # followed at once: the work grows with their number
BIASES = 3  # states of a beacon
BIAS_HOUR = 0.5  # a beacon's bias walks in an hour by this share of what it may be

#: A lie that stood still from the first fix on is not pruned by its rate, and its end looks like a jump: with
#: greater priors (shares below) a jump of 300 m is not beyond doubt for minutes.
DOUBTED = 1e-5  # that GNSS was false before the first beacon
STILL = 3e-3  # m/s: a lie that stands still must not pay for a rate, or a beacon is blamed for it
#: A GNSS that is drawn off with an acceleration; beside an INS, which shows one of 0.003 m/s^2 as it begins.
ACCELERATED = Lie(3.0, 0.1, acceleration=0.01, share=0.3)
ACCELERATED_GENTLY = Lie(1.5, 0.03, acceleration=0.005, share=2.0)
ELSEWHERE = (Lie(300.0, 1e-3), Lie(3000.0, 1e-3))  # displacement of a beacon whose stated position is wrong
GNSS_FIRST = (
    Lie(60.0, 0.3),
    Lie(300.0, 0.3),
    Lie(2000.0, 0.3),
    Lie(300.0, STILL, share=0.05),
    Lie(2000.0, STILL, share=0.05),
)
#: Its lie changes so often in an hour. With 1, a GNSS that was off by 60 m from its first fix on, which a
#: beacon that answered before it cannot exclude, came near to one drawn off now: 15 m of sigma, not 5.
GNSS_CHANGES_H = 0.1
AIRSPEED_LIES = (Lie(3.0, 0.03), Lie(15.0, 0.3))  # m/s, m/s^2
VELOCITY_LIES = (Lie(0.3, 0.003), Lie(3.0, 0.03), Lie(0.3, 0.03, noise=0.01))  # m/s, m/s^2
GUST = tuple(range(own_error_model.GUST.start, own_error_model.GUST.stop))
GUST_OPEN_M_S = 3.0  # what the gust may have taken up of a step of the wind
SHOCK = ((0, 15.0), (1, 15.0), (2, 15.0), (3, 15.0))  # of a false airspeed that moves the nominal: m, m/s
#: A step of 5 m/s beside gusts of 1.2 is one: an onset that is born late explains half of it as wind.
SURPRISE = 5.0
#: The attitude, and the IMU with it, becomes worse and better again within a flight: parked, in a climb, in
#: aerobatics. With 1e-5, as for an INS, a healthy GNSS was excluded beside a wrong IMU or a wrong heading.
GRADE_CHANGES_H = 10.0
#: A compass, or the autopilot resets its heading, to any. The wind took up what was wrong with it before, and
#: in a turn the velocity goes astray before the step is born (m/s). While GNSS is received, or a pitot that
#: sticks in the dark is taken for one.
HEADING_STEPS_H, HEADING_WIND, HEADING_VELOCITY = 1.0, 7.0, 5.0
AIR_HEADING_STEPS_H = 1e-2  # by airspeed a wrong heading turns no acceleration
HEADING_FIRST = 1e-3  # from the start, by a compass set up wrongly
HEADING = Angle(own_error_model.HEADING, own_error_model.VERSINE)
FAR_VERSINE = 0.3  # from 45 deg on a heading is far off
MOST_WIDER = 2.0  # of its sigma what a silence of minutes took is undone, not what came up in hours of it
#: Attitude and IMU give a false velocity (m/s): a turn with an attitude that is off, another latency. Not in
#: straight flight, however it shakes, but where the velocity has changed by so much within seconds: a GNSS
#: that was drawn off by 2 m/s, onset and velocity alike, was taken for such a step.
VELOCITY_STEPS_H, VELOCITY_STEP, TURNED_M_S = 0.1, 10.0, 2.0
#: GNSS becomes late (s). In a turn its position and velocity are then off as those of a false GNSS.
LATENCY_STEPS_H, LATENCY_STEP = 0.1, 0.3
JAMMED = 100.0  # times likelier while the receiver itself reports jamming or spoofing


def gnss_lies(accelerated: Lie) -> tuple[Lie, ...]:
    """Offsets (m) and rates (m/s) of a false GNSS.

    Several scales, or a wide prior makes a small lie improbable.
    """
    return (
        Lie(3.0, 0.3),
        Lie(3.0, 0.3, noise=0.01),
        accelerated,
        Lie(3.0, 1.0),
        Lie(3.0, 5.0, noise=0.01),
        Lie(30.0, 5.0, noise=0.03),
        Lie(300.0, 1.0, noise=0.01),
    )


def beacon_lies(reach: float) -> tuple[Lie, ...]:
    """Scales of the lie of an azimuth or a range, of which the first is `reach`: it steps and stays."""
    return tuple(Lie(reach * scale, 1e-4 * reach * scale) for scale in (1.0, 10.0))


class Situation(NamedTuple):
    """What the hypotheses depend on.

    How many beacons there are, whether airspeed moves the nominal trajectory, whether a source of position
    other than GNSS is received, whether GNSS is, whether the velocity has changed within seconds, whether
    the aircraft flies where its nose points, and whether it flies at all.
    """

    beacons: int = 0
    by_air: bool = False
    witness: bool = True
    is_received: bool = False
    has_turned: bool = False
    along_nose: bool = True
    is_aloft: bool = True


class Hypotheses(NamedTuple):
    """The layout with so many beacons, and the settings of the bank."""

    layout: Layout
    settings: Settings
    biases: tuple[float, ...]  # one sigma of each bias state: azimuth (rad), range (m), time (s), by beacon
    judged: bool = False  # the fix is no outlier: another bank has taken it

    def azimuth(self, k: int) -> int:
        """Source of beacon k's azimuth."""
        return len(SOURCES) + 2 * k

    def range(self, k: int) -> int:
        """Source of beacon k's range."""
        return len(SOURCES) + 2 * k + 1

    def bias(self, k: int) -> int:
        """First of beacon k's bias states."""
        return self.layout.n_base - len(self.biases) + BIASES * k

    def renewed(self, bank: Bank, k: int) -> Bank:
        """The bank with the biases of beacon k unknown."""
        first, sigma = self.bias(k), self.biases[BIASES * k : BIASES * (k + 1)]
        return banks.renew(bank, range(first, first + BIASES), sigma)

    def elsewhere(self, k: int) -> int:
        """Fault that beacon k is not where it states."""
        return 6 + 4 * k


class Model:
    """Channel and hypotheses of one configuration.

    `plain` is a grade: then there is that grade alone, nothing is ever false and nothing jumps. The bank is a
    Kalman filter, and a random walk of the wind stands for its jumps too.
    """

    def __init__(self, config: Config, plain: int | None = None) -> None:
        if plain is not None:
            air = config.air_data
            air = structs.replace(air, wind_change_m_s_sqrt_s=air.wind_walk_m_s_sqrt_s)
            config = structs.replace(config, air_data=air)
        self.config, self.plain = config, plain
        self.channel: Channel = corrected_ins(config) if config.has_own_ins else OwnChannel(config)
        self._known: dict[Situation, Hypotheses] = {}

    def hypotheses(self, now: Situation) -> Hypotheses:
        """The hypotheses of a situation."""
        if now not in self._known:
            found = _hypotheses(self.config, self.channel, now)
            if self.plain is not None:
                layout = replace(found.layout, faults=(), jumps=())
                found = found._replace(layout=layout, settings=replace(found.settings, switch_h=0.0))
            self._known[now] = found
        return self._known[now]

    def begin(self, t_s: float) -> Bank:
        """The bank before the first fix."""
        layout = self.hypotheses(Situation()).layout
        P = self.channel.prior()
        bank = start(layout, t_s, np.zeros(layout.n_base), P, self.channel.grades)
        if self.plain is not None:
            return only(bank, self.plain)
        first = {j: HEADING_FIRST for j, jump in enumerate(layout.jumps) if jump.angle}
        return banks.jumped_before(bank, layout, first)

    def with_beacon(self, bank: Bank, beacons: int) -> Bank:
        """The bank with one beacon more than `beacons`, its biases unknown."""
        old, new = (self.hypotheses(Situation(n)) for n in (beacons, beacons + 1))
        return enlarge(bank, old.layout, new.layout, np.square(new.biases[-BIASES:]))

    def doubted(self, bank: Bank) -> Bank:
        """The bank with a first beacon: it may show that GNSS was false from its first fix on.

        An INS could have shown that before; the own channel is no witness.
        """
        if not self.channel.wind or self.plain is not None:
            return bank
        known, still = self.hypotheses(Situation(1)), tuple(lie for lie in GNSS_FIRST if lie.rate == STILL)
        lies = {i: still for i, fault in enumerate(known.layout.faults) if fault.sources == (GNSS,)}
        return banks.false_since_first(bank, known.layout, known.settings, lies, DOUBTED, POSITION)

    def on_circle(self, bank: Bank, Phi: Floats) -> Bank:
        """The bank after Phi, sine and versine of the heading those of one angle.

        The sine of a heading that is far off is as before: its versine does not decay.
        """
        if not self.channel.wind:
            return bank
        far = np.flatnonzero(bank.x[:, HEADING.versine] > FAR_VERSINE)
        if far.size:
            kept = self.kept(Phi)
            wider, sine = min(kept, MOST_WIDER), HEADING.sine
            x, P = bank.x.copy(), bank.P.copy()
            x[far, sine] *= kept
            P[far, sine] *= wider
            P[far, :, sine] *= wider
            bank = bank._replace(x=x, P=P)
        return banks.on_circle(bank, HEADING)

    def kept(self, Phi: Floats) -> float:
        """Factor that undoes what Phi takes from the sine of a heading that is far off."""
        return float(1.0 / max(Phi[HEADING.sine, HEADING.sine], 1e-300))

    def transition(self, nominal: Nominal, beacons: int) -> Transition:
        """Phi (n, n) and Q (grades, n_base, n_base) over all states, the lies' motion left to the bank."""
        found, known = self.channel.transition(nominal), self.hypotheses(Situation(beacons))
        ours, n, dt = self.channel.n, known.layout.n_base, nominal.pending_s
        Q = np.zeros((len(found.Q), n, n))
        Q[:, :ours, :ours] = found.Q
        biases = np.arange(ours, n)
        Q[:, biases, biases] = np.square(known.biases) * (BIAS_HOUR**2 / 3600.0 * dt)
        interval = nominal.interval
        if interval is None or not interval.by_sensed_air:
            Phi = np.eye(n)
            Phi[:ours, :ours] = found.Phi
            return Transition(Phi, Q)
        # a false airspeed moves the nominal trajectory itself, along the nose
        Phi = np.eye(known.layout.n)
        Phi[:ours, :ours] = found.Phi
        lie = known.layout.lie_states(AIRSPEED)[0]
        nose = np.array(interval.V) / math.hypot(*interval.V)
        Phi[0:2, lie], Phi[2:4, lie] = nose * dt, nose
        return Transition(Phi, Q)


def only(bank: Bank, row: int) -> Bank:
    """The bank with one of its rows, which has all the weight."""
    return banks.picked(bank, [row])._replace(L=np.zeros(1))


def _beacon_group(k: int) -> int:
    """Group of the lie states of beacon k: with one for all, GNSS was blamed for the second that is wrong."""
    return BEACON_GROUP if k == 0 else len(GROUPS) + k - 1


def _hypotheses(config: Config, channel: Channel, now: Situation) -> Hypotheses:
    azimuth_bias, range_bias = math.radians(config.rsbn.bias_azimuth_deg), config.rsbn.bias_range_m
    sigma_a, sigma_r = math.radians(config.rsbn.sigma_azimuth_deg), config.rsbn.sigma_range_m
    # GNSS, or its position alone: onsets in an hour, and as probable from its first fix on. An air-data or
    # IMU channel alone is no witness against it: its own model may be what is wrong
    both, alone = (7e-4, 3e-4) if now.witness or not channel.wind else (0.0, 0.0)
    sources = [
        Source(SOURCES[GNSS], 2, GNSS_GROUP, presumed=True),
        Source(SOURCES[AIRSPEED], 1, AIRSPEED_GROUP, silence_s=SILENCE_S),
        Source(SOURCES[VELOCITY], 2, GNSS_GROUP),
    ]
    lies = gnss_lies(ACCELERATED if channel.wind else ACCELERATED_GENTLY)
    faults = [
        Fault("gnss", (GNSS,), both, lies, both, GNSS_FIRST, (), 1.0, GNSS_CHANGES_H, 20),
        Fault("gnss position", (GNSS,), alone, lies, alone, GNSS_FIRST, (), 1.0, GNSS_CHANGES_H, 10),
        Fault("airspeed", (AIRSPEED,), 1e-2, AIRSPEED_LIES, shock=SHOCK if now.by_air else (), quota=6),
        Fault("velocity of gnss", (VELOCITY,), 1e-2, VELOCITY_LIES, 5e-2, VELOCITY_LIES, quota=12),
    ]
    for k in range(now.beacons):
        a, r = len(sources), len(sources) + 1
        group = _beacon_group(k)
        sources += [Source(f"azimuth {k}", 1, group, 0), Source(f"range {k}", 1, group, 1)]
        for name, which, lies, first in (
            ("azimuth", (a,), beacon_lies(3.0 * sigma_a), 1e-3),
            ("range", (r,), beacon_lies(3.0 * sigma_r), 1e-3),
            ("elsewhere", (a, r), ELSEWHERE, BEACON_PLACE),
        ):
            ends_h = BEACON_H if name == "elsewhere" else 1.0
            fault = Fault(f"{name} {k}", which, BEACON_H, lies, first, lies, (), ends_h, BEACON_H, quota=4)
            faults.append(fault)
        parts = len(faults) - 3, len(faults) - 2
        faults.append(Fault(f"azimuth and range {k}", (a, r), 0.0, (), change_h=0.0, quota=4, of=parts))
    further = max(now.beacons - 1, 0)  # the first beacon's group is there without one
    layout = Layout(
        channel.n + BIASES * now.beacons,
        GROUPS + (2,) * further,
        tuple(sources),
        tuple(faults),
        jumps=_jumps(config, channel, now),
        grades=tuple(range(len(channel.grades))),
        orders=ORDERS + (2,) * further,
        rate_correlation_s=RATE_CORRELATION_S + (banks.NO_DECAY_S,) * further,
    )
    settings = Settings(
        surprise=SURPRISE,
        rows=config.integrity.rows,
        switch_h=GRADE_CHANGES_H if channel.wind else DEFAULT.switch_h,
    )
    return Hypotheses(layout, settings, (azimuth_bias, range_bias, LATE_S) * now.beacons)


def _jumps(config: Config, channel: Channel, now: Situation) -> tuple[Jump, ...]:
    """What may jump without a source being false."""
    away, moved = (CHANNEL_JUMP_M, CHANNEL_JUMP_M), (0, 1, 2, 3)
    if not channel.wind:
        return (
            Jump("channel", (0, 1), away, INS_JUMPS_H, quota=2, apart_s=APART_S),
            Jump("drift", moved, INS_DRIFT, INS_DRIFTS_H, 2, APART_S, again_h=INS_DRIFTS_AGAIN_H),
            Jump("misled", moved, INS_MISLED, INS_DRIFTS_H, quota=2, apart_s=APART_S),
        )
    jump, rate_h = config.air_data.wind_jump_m_s, config.air_data.wind_jumps_per_hour
    # a wind is noticed up to a second later: beside the IMU the gust has taken it up until then; by air data
    # the velocity over ground jumps with it
    states = (*channel.wind, *((2, 3, 0, 1) if now.by_air else GUST))
    sigmas = (jump,) * 6 if now.by_air else (jump, jump, GUST_OPEN_M_S, GUST_OPEN_M_S)
    latency_h = 0.0 if now.by_air else LATENCY_STEPS_H
    heading_h = HEADING_STEPS_H if now.is_received and (now.has_turned or now.along_nose) else 0.0
    velocity_h = VELOCITY_STEPS_H if now.is_received and now.has_turned else 0.0
    if now.by_air:
        heading_h, velocity_h = AIR_HEADING_STEPS_H, 0.0
    astray = HEADING_VELOCITY if now.has_turned else 0.0
    if not now.is_aloft:  # nothing shows the wind: jumps of minutes on the ground held half of the rows
        rate_h = 0.0
    return (
        Jump("wind", states, sigmas, rate_h, quota=24, often=True),
        Jump(
            "heading",
            (*channel.wind, 2, 3),
            (HEADING_WIND, HEADING_WIND, astray, astray),
            heading_h,
            angle=HEADING,
        ),
        Jump("velocity", (2, 3), (VELOCITY_STEP, VELOCITY_STEP), velocity_h),
        Jump("latency", (channel.latency,), (LATENCY_STEP,), latency_h),
        # whatever the model does not know: GNSS is believed again after a second or two
        Jump("channel", moved, (*away, 20.0, 20.0), CHANNEL_JUMPS_H, quota=4, apart_s=APART_S),
    )
