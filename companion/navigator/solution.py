"""The corrected estimate: the inertial channel less its estimated error, by the estimator that leads now."""

from __future__ import annotations

import math
from itertools import combinations
from typing import NamedTuple

from companion.estimate import trust
from companion.estimate.filterbank import INERTIAL
from companion.nav.geometry import displace
from companion.navigator import error_state, height_error, integrity, minimax_bound, restrictive_filter
from companion.navigator.error_state import ErrorState
from companion.navigator.inertial_track import Point
from companion.navigator.minimax_bound import Bounded
from companion.navigator.state import FIXES, Carry, Settings, Step, level, sources, state_at
from companion.navigator.wind_error_model import WindError
from companion.records import Event, Mode, Severity, Solution, Source, Vector2, Vector3
from companion.units import Floats

AHEAD_NS = 5_000_000_000  # how often the bounds ahead are worked out


class _Estimate(NamedTuple):
    """The error of the inertial channel by one estimator: m, m/s, and m^2 of north, north-east, east; the
    variance left of the velocity on its worse axis, m^2/s^2.
    """

    error_n: Vector2
    velocity_error_n: Vector2
    covariance: Vector3
    velocity_variance: float


def solve(carry: Carry, rx_ns: int, settings: Settings) -> Step:
    """The corrected estimate at the newest inertial point; nothing before the first fix."""
    if carry.state is None or not carry.track:
        return carry, []
    config = settings.config
    ins = level(carry.track[-1], carry)
    t_ns = ins.t_ns
    state, dt = carry.state, max(0.0, (t_ns - carry.state.t_ns) * 1e-9)
    if dt > error_state.NEAR_S:
        state, dt = state_at(carry, ins, settings), 0.0
    promise, bounded = minimax_bound.bounded(carry.guarantee, t_ns, config.predictor)
    if t_ns >= carry.next_ahead_ns:
        bounds = minimax_bound.ahead(promise, t_ns, config.predictor)
        carry = carry._replace(ahead=bounds, next_ahead_ns=t_ns + AHEAD_NS)
    rests_on = sources(carry, t_ns, settings)
    fixes = rests_on & FIXES
    candidates = _candidates(carry, state, dt, bounded, ins, settings)
    watched = carry.watch and carry.watch.protection
    leads = settings.config.leading_estimator
    if leads == "minimax" and watched and bounded and math.hypot(*bounded.bound_n) > watched.level:
        leads = "kalman"  # little is left to predict from: what was learnt of an excluded source is gone
    if (rests_on & Source.GNSS if leads == "restrictive" else fixes) or leads not in candidates:
        leads = "kalman"
    error, velocity_error, (var_n, cov, var_e), velocity_variance = candidates[leads]
    north, east, down = ins.v_n
    lat, lon, alt = displace(*ins.position, -error[0], -error[1], 0.0)
    protection = None
    if carry.watch is not None and watched is not None:
        # of the monitor's full solution; another one is off by no more than its distance from that besides
        protection = watched.level + math.dist(error, integrity.error_at(carry.watch, ins, settings.unit))
    held = _trust(carry, bool(fixes), bounded, protection, t_ns, settings)
    last = max((t for t in (carry.gnss_ns, carry.rsbn_ns) if t is not None), default=t_ns)
    solution = Solution(
        t_ns,
        rx_ns,
        _mode(bool(fixes), bounded, settings),
        leads,
        lat,
        lon,
        alt,
        (north - velocity_error[0], east - velocity_error[1], down),
        (var_n, cov, 0.0, var_e, 0.0, height_error.at(carry.level, carry.track[-1]).covariance[0]),
        error,
        velocity_error,
        int(rests_on),
        max(0.0, (t_ns - last) * 1e-9),
        bounded and bounded.bound_n,
        bounded and bounded.velocity_bound_n,
        _disagreement(candidates),
        max(0.0, (rx_ns - t_ns) * 1e-9),
        carry.ahead,
        math.hypot(math.sqrt(velocity_variance), settings.unit.velocity_noise),  # gusts are no state
        protection,
        held.trust,
    )
    return carry._replace(state=state, guarantee=promise, held=held), [solution]


def _candidates(
    carry: Carry, state: ErrorState, dt: float, bounded: Bounded | None, ins: Point, settings: Settings
) -> dict[str, _Estimate]:
    """What each estimator that runs says of the channel's error; the state is `dt` seconds old."""
    unit = settings.unit
    place, motion = error_state.ahead(state, dt, ins.v_n, unit)
    variance = max(motion.covariance[0], motion.covariance[2], 0.0)
    found = {"kalman": _Estimate(place.error_n, motion.error_n, place.covariance, variance)}
    if bounded is not None:
        variances = (bounded.bound_n[0] ** 2, 0.0, bounded.bound_n[1] ** 2)
        variance = max(bounded.velocity_bound_n) ** 2
        found["minimax"] = _Estimate(bounded.error_n, bounded.velocity_error_n, variances, variance)
    if carry.restrictive is not None and isinstance(settings.unit, WindError):
        x, P = restrictive_filter.at(carry.restrictive, ins.t_ns, settings.unit)
        dx, dy, dv_n, dv_e = x.tolist()
        variance = float(max(P[2, 2], P[3, 3], 0.0))
        found["restrictive"] = _Estimate((dx, dy), (dv_n, dv_e), _triangle(P), variance)
    return found


def _triangle(P: Floats) -> Vector3:
    (var_n, cov), (_, var_e) = P[:2, :2].tolist()
    return var_n, cov, var_e


def _disagreement(candidates: dict[str, _Estimate]) -> float | None:
    """The greatest distance between two estimators; None where there is only one."""
    pairs = combinations([c.error_n for c in candidates.values()], 2)
    return max((math.dist(a, b) for a, b in pairs), default=None)


def _mode(fixes: bool, bounded: Bounded | None, settings: Settings) -> Mode:
    if fixes:
        return Mode.FIXED
    if bounded is None or math.hypot(*bounded.bound_n) > settings.config.predictor.limit_m:
        return Mode.UNTRUSTED
    return Mode.PREDICTING


def _trust(
    carry: Carry,
    fixes: bool,
    bounded: Bounded | None,
    protection: float | None,
    t_ns: int,
    settings: Settings,
) -> trust.Held:
    """How far the output can be trusted."""
    w = carry.watch
    suspicion = w is not None and (w.monitor.unresolved or bool(w.exclusions))
    inertial = integrity.excluded(w, INERTIAL)
    bound = None if bounded is None or inertial else math.hypot(*bounded.bound_n)
    evidence = trust.Evidence(fixes, suspicion, protection, bound)
    config = settings.config
    limits = trust.Limits(
        config.integrity.alert_m, config.predictor.limit_m, settle_s=config.integrity.settle_s
    )
    if carry.held is None:
        return trust.Held(trust.judge(evidence, limits), t_ns)
    return trust.turn(carry.held, t_ns, evidence, limits)


def announce(solution: Solution) -> Event:
    """The line that tells of a change to this solution's mode, or to the fixes it rests on."""
    fixes = [s.name.lower() for s in Source if s.name and s & FIXES & solution.sources]
    if solution.mode is Mode.FIXED:
        why = " and ".join(fixes) + " fixes"
    elif solution.bound_n is None:
        why = "no fixes, and too few before for a guaranteed prediction"
    else:
        why = f"no fixes; the guaranteed bound is {math.hypot(*solution.bound_n):.0f} m"
    severity = Severity.WARNING if solution.mode is Mode.UNTRUSTED else Severity.NOTICE
    return Event(solution.t_ns, solution.rx_ns, severity, f"navigation {solution.mode}: {why}")
