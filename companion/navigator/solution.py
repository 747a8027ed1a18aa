"""The corrected estimate: the inertial channel less its estimated error, by the estimator that leads now."""

from __future__ import annotations

import math

from companion.nav.geometry import displace
from companion.records import Event, Mode, Solution, Source, Vector2

from . import guarantee
from .carry import Carry, Settings, Step, level, sources, state_at
from .guarantee import Bounded

AHEAD_NS = 5_000_000_000  # how often the bounds ahead are worked out


def solve(carry: Carry, rx_ns: int, settings: Settings) -> Step:
    """The corrected estimate at the newest inertial point; nothing before the first fix."""
    if carry.state is None or not carry.track:
        return carry, []
    config = settings.config
    ins = level(carry.track[-1], carry)
    t_ns = ins.t_ns
    state = state_at(carry, ins, settings)
    promise, bounded = guarantee.bounded(carry.guarantee, t_ns, config.predictor)
    if t_ns >= carry.next_ahead_ns:
        bounds = guarantee.ahead(promise, t_ns, config.predictor)
        carry = carry._replace(ahead=bounds, next_ahead_ns=t_ns + AHEAD_NS)
    mode = _mode(carry, bounded, t_ns, settings)
    kalman: Vector2 = (float(state.x[0]), float(state.x[1]))
    error, velocity_error = kalman, (float(state.x[2]), float(state.x[3]))
    P = state.P[:2, :2].tolist()
    by_minimax = mode is not Mode.FIXED and bounded is not None and config.estimator.output == "minimax"
    if by_minimax and bounded is not None:
        error, velocity_error = bounded.error_n, bounded.velocity_error_n
        P = [[bounded.bound_n[0] ** 2, 0.0], [0.0, bounded.bound_n[1] ** 2]]
    lat, lon, alt = displace(*ins.position, -error[0], -error[1], 0.0)
    north, east, down = ins.v_n
    last = max((t for t in (carry.gnss_ns, carry.rsbn_ns) if t is not None), default=t_ns)
    solution = Solution(
        t_ns,
        rx_ns,
        mode,
        "minimax" if by_minimax else "kalman",
        lat,
        lon,
        alt,
        (north - velocity_error[0], east - velocity_error[1], down),
        (P[0][0], P[0][1], 0.0, P[1][1], 0.0, carry.level.variance),
        error,
        velocity_error,
        int(sources(carry, t_ns, settings)),
        max(0.0, (t_ns - last) * 1e-9),
        bounded and bounded.bound_n,
        bounded and bounded.velocity_bound_n,
        bounded and math.dist(kalman, bounded.error_n),
        max(0.0, (rx_ns - t_ns) * 1e-9),
        carry.ahead,
    )
    next_ns = max(carry.next_ns + round(1e9 / config.output.solution_hz), t_ns)
    return carry._replace(state=state, guarantee=promise, next_ns=next_ns), [solution]


def _mode(carry: Carry, bounded: Bounded | None, t_ns: int, settings: Settings) -> Mode:
    if sources(carry, t_ns, settings) & ~Source.INERTIAL:
        return Mode.FIXED
    if bounded is None or math.hypot(*bounded.bound_n) > settings.config.predictor.limit_m:
        return Mode.UNTRUSTED
    return Mode.PREDICTING


def announce(solution: Solution) -> Event:
    """The line that tells of a change to this solution's mode."""
    fixes = [s.name.lower() for s in Source if s.name and s is not Source.INERTIAL and s & solution.sources]
    if solution.mode is Mode.FIXED:
        why = " and ".join(fixes) + " fixes"
    elif solution.bound_n is None:
        why = "no fixes, and too few before for a guaranteed prediction"
    else:
        why = f"no fixes; the guaranteed bound is {math.hypot(*solution.bound_n):.0f} m"
    severity = 4 if solution.mode is Mode.UNTRUSTED else 5
    return Event(solution.t_ns, solution.rx_ns, severity, f"navigation {solution.mode}: {why}")
