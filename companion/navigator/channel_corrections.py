"""What follows for every estimate when the inertial channel itself is moved, or has moved nobody knows how.

Where the aircraft is does not change with it: the error of the channel does.
"""

from __future__ import annotations

import math

from companion.nav.geometry import displace
from companion.navigator import error_state, integrity, minimax_bound, restrictive_filter, wind_mixture
from companion.navigator.error_state import VELOCITY
from companion.navigator.inertial_track import Point
from companion.navigator.state import Carry, Settings
from companion.records import Vector2

FAR_M = 500.0  # a channel of our own is brought back from this far off
FAST_M_S = 5.0  # and from this velocity error, where it has one of its own


def shifted(carry: Carry, north: float, east: float, v_n: Vector2 | None = None, t_ns: int = 0) -> Carry:
    """After a jump of the channel by (north, east) m; with `v_n` (m/s) as if it had always been faster by so
    much, (north, east) being its jump at `t_ns`, which is the error state's time.
    """
    state = carry.state and error_state.shift(carry.state, north, east, v_n)
    promise = minimax_bound.shift(carry.guarantee, north, east, v_n or (0.0, 0.0), t_ns)
    bounded = carry.restrictive and restrictive_filter.shift(carry.restrictive, north, east)
    w = carry.watch and integrity.shift(carry.watch, north, east, v_n, t_ns)
    jumps = wind_mixture.each(carry.jumps, lambda s: error_state.shift(s, north, east, v_n))
    carry = carry._replace(state=state, jumps=jumps, guarantee=promise, restrictive=bounded, watch=w)
    return carry._replace(track=(), gnss_heard=None)


def blurred(carry: Carry, settings: Settings, sigma: float, sigma_v: float = 0.0) -> Carry:
    """After the channel moved unseen by nobody knows how much: what was promised of it is void."""
    state = carry.state and error_state.blur(carry.state, sigma, sigma_v)
    promise = minimax_bound.begin(settings.config)
    w = carry.watch and integrity.blur(carry.watch, sigma, sigma_v)
    jumps = wind_mixture.each(carry.jumps, lambda s: error_state.blur(s, sigma, sigma_v))
    carry = carry._replace(state=state, jumps=jumps, guarantee=promise, restrictive=None, watch=w)
    return carry._replace(track=carry.track[-1:], gnss_heard=None)


def kept_near(carry: Carry, settings: Settings, has_velocity: bool) -> Carry:
    """With the channel moved to where the estimate is once it is far off, so that its errors stay small
    against the earth, or, in the feedback scheme, with every fix: the same number comes off the channel and
    off every estimate of its error. `has_velocity`: the velocity error is the channel's own and is taken from
    it too.
    """
    if carry.state is None:
        return carry
    north, east = (-carry.state.x[:2]).tolist()
    vN, vE = (-carry.state.x[VELOCITY]).tolist() if has_velocity else (0.0, 0.0)
    t_ns = carry.state.t_ns
    fixed = t_ns in (carry.gnss_ns, carry.rsbn_ns) and any((north, east, vN, vE))
    near = math.hypot(north, east) <= FAR_M and math.hypot(vN, vE) <= FAST_M_S
    if near and not (fixed and settings.config.estimator.scheme == "feedback"):
        return carry

    def moved(p: Point) -> Point:
        dt = (p.t_ns - t_ns) * 1e-9
        position = displace(*p.position, north + vN * dt, east + vE * dt, 0.0)
        return p._replace(position=position, v_n=(p.v_n[0] + vN, p.v_n[1] + vE, p.v_n[2]))

    track = tuple(moved(p) for p in carry.track)
    velocity = (vN, vE) if has_velocity else None
    return shifted(carry, north, east, velocity, t_ns)._replace(track=track)
