"""What a fix does to the error state: believed or refused by its innovation, fused by maximum likelihood.

By air data the error state is the sum of a few, one for each history of the wind (`windjumps`); the fix is
judged by the sum and absorbed by each.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from companion.navigator import error_state, fix_observations, inertial_track, minimax_bound, wind_mixture
from companion.navigator.error_state import Belief, ErrorState
from companion.navigator.inertial_track import Point
from companion.navigator.state import FIXES, Carry, Settings, Step, sources, state_at
from companion.navigator.wind_error_model import WindError
from companion.records import Gnss, Rejection, RsbnFix, Vector3
from companion.units import Floats

BOUND_GATE = 3.0  # a fix within this many guaranteed r.m.s. of the prediction is believed after an outage


def position(
    carry: Carry,
    heard: fix_observations.Heard,
    H: Floats,
    ins: Point,
    record: Gnss | RsbnFix,
    settings: Settings,
) -> Step:
    """The error state with what was heard of H x, if it can be believed; an output means it was not.

    The first fix is believed, and while predicting one within the guaranteed bound is, whatever the Gaussian
    state claims: then it is the claim that was wrong, and it is widened.
    """
    state, H, factor = *_sees(carry, ins, H, isinstance(record, RsbnFix), settings), 1.0
    after, cost, _ = _fused(state, heard, H, settings)
    limit = settings.gate[fix_observations.freedom(heard)]
    carry = carry._replace(innovation=cost if fix_observations.freedom(heard) == 2 else None)
    if not cost <= limit:  # nor is what is no number
        explained = _within_bound(carry, heard, settings) or _by_a_jump(carry, state, heard, H, settings)
        if math.isnan(cost) or (carry.state is not None and not explained):
            carry = carry._replace(state=state)
            return carry, [_rejected(record, "innovation beyond its gate (chi-square)", cost, limit)]
        factor = cost / limit
        carry = carry._replace(lesson=carry.lesson and carry.lesson._replace(proof=True))
        after, _, _ = _fused(error_state.widen(state, factor), heard, H, settings)

    def each(state: ErrorState) -> tuple[ErrorState, float]:
        after, _, likelihood = _fused(error_state.widen(state, factor), heard, H, settings)
        return after, likelihood

    return _weighed(carry, ins, after, each, settings), []


def _sees(carry: Carry, ins: Point, H: Floats, coarse: bool, settings: Settings) -> tuple[ErrorState, Floats]:
    """The error state for a fix at the time of `ins`, and how that sees it.

    A `coarse` fix a moment later changes the state where it stands: what noise comes in of meanwhile is far
    below its own, and the solution that waits for it is not of a later time either.
    """
    state = carry.state
    if coarse and state is not None and not isinstance(settings.unit, WindError):
        dt = (ins.t_ns - state.t_ns) * 1e-9
        if 0.0 <= dt <= error_state.NEAR_S:
            return state, error_state.carried(H, dt, ins.v_n, settings.unit)
    return state_at(carry, ins, settings), H


def _fused(
    state: ErrorState, heard: fix_observations.Heard, H: Floats, settings: Settings
) -> tuple[ErrorState, float, float]:
    """The state with what was heard of H x, the chi-square of that, and the logarithm of its likelihood, but
    for what is the same whatever the state was.
    """
    before = error_state.seen(state, H)
    found, cost = fix_observations.innovation(heard, before.belief, settings.config.inertial.height_sigma_m)
    gained = _area(found) / _area(before.belief)  # that of R over that of H P H' + R
    return error_state.absorb_position(state, before, found), cost, 0.5 * (math.log(gained) - cost)


def _weighed(
    carry: Carry,
    ins: Point,
    after: ErrorState,
    each: Callable[[ErrorState], tuple[ErrorState, float]],
    settings: Settings,
) -> Carry:
    """With the state `after` a measurement; by air data the sum of what it makes of `each` hypothesis."""
    unit = settings.unit
    if not isinstance(unit, WindError):
        return carry._replace(state=after)
    if carry.jumps is None:
        return carry._replace(state=after, jumps=wind_mixture.begin(after))
    jumps = wind_mixture.at(carry.jumps, ins, inertial_track.acceleration(carry.track), unit)
    jumps = wind_mixture.learn(jumps, each)
    return carry._replace(state=wind_mixture.moments(jumps), jumps=jumps)


def _area(belief: Belief) -> float:
    """Determinant of its covariance."""
    nn, ne, ee = belief.covariance
    return nn * ee - ne * ne


def _within_bound(carry: Carry, heard: fix_observations.Heard, settings: Settings) -> bool:
    """Whether a fix lies where the guaranteed prediction allows the aircraft to be; only asked while
    predicting.
    """
    if sources(carry, heard.t_ns, settings) & FIXES:
        return False
    _, promise = minimax_bound.bounded(carry.guarantee, heard.t_ns, settings.config.predictor)
    if promise is None:
        return False
    bound_n, bound_e = promise.bound_n
    height = settings.config.inertial.height_sigma_m
    wide = Belief(promise.error_n, (bound_n**2, 0.0, bound_e**2))
    return fix_observations.innovation(heard, wide, height)[1] <= BOUND_GATE**2


def _by_a_jump(
    carry: Carry, state: ErrorState, heard: fix_observations.Heard, H: Floats, settings: Settings
) -> bool:
    """Whether a wind that jumped by one sigma right after the last fix explains this one; only asked by air
    data and while predicting.
    """
    last = max((t for t in (carry.gnss_ns, carry.rsbn_ns) if t is not None), default=None)
    if not isinstance(settings.unit, WindError) or last is None:
        return False
    if sources(carry, heard.t_ns, settings) & FIXES:
        return False
    blown = settings.unit.jump * (heard.t_ns - last) * 1e-9
    _, cost, _ = _fused(error_state.blur(state, blown), heard, H, settings)
    return cost <= settings.gate[fix_observations.freedom(heard)]


def velocity(carry: Carry, record: Gnss, v_n: Vector3, ins: Point, settings: Settings) -> Carry:
    """The error state, and the guaranteed predictor if it is to, with a velocity of GNSS, if believed."""
    assert carry.state is not None
    config = settings.config.gnss
    measured = max(record.sigma_velocity or 0.0, config.sigma_velocity_m_s)
    sigma = math.hypot(measured, settings.unit.velocity_noise)
    error = (ins.v_n[0] - v_n[0], ins.v_n[1] - v_n[1])
    H = settings.unit.velocity_rows(ins.v_n)
    after, nis = error_state.absorb_velocity(carry.state, H, np.array(error), sigma)
    if not nis <= settings.gate[2]:
        return carry

    def each(state: ErrorState) -> tuple[ErrorState, float]:
        after, nis = error_state.absorb_velocity(state, H, np.array(error), sigma)
        S = H @ state.P @ H.T + sigma**2 * np.eye(2)
        return after, -0.5 * (nis + math.log(float(np.linalg.det(S))))

    g = carry.guarantee
    if settings.config.predictor.learn_velocity:
        g = minimax_bound.learn(g, record.t_ns, "velocity", error, (sigma, sigma), settings.config.predictor)
    return _weighed(carry._replace(guarantee=g), ins, after, each, settings)


def _rejected(record: Gnss | RsbnFix, reason: str, value: float, limit: float) -> Rejection:
    source = f"gnss {record.receiver}" if isinstance(record, Gnss) else f"rsbn {record.beacon}"
    return Rejection(record.t_ns, record.rx_ns, source, reason, value, limit)
