"""Corrected estimate: the nominal trajectory less its error, by the estimator that leads, with its trust.

The bank's leading explanation always leads, unless `estimator.output` names another estimator for the time
without fixes. The guaranteed bound runs beside it, and is stated about the position that is sent.
"""

from __future__ import annotations

import math
from itertools import combinations
from typing import NamedTuple

import numpy as np
from msgspec import structs

from companion.config import Config
from companion.estimate import bank as banks
from companion.estimate.kalman import Gaussian
from companion.nav.geometry import displace
from companion.navigator import (
    bounded_trajectory,
    height_error,
    minimax_bound,
    parallel_filters,
    trust,
)
from companion.navigator.hypotheses import GNSS, VELOCITY
from companion.navigator.minimax_bound import Guaranteed, Linear
from companion.navigator.own_channel import OwnChannel
from companion.navigator.own_error_model import HELD
from companion.navigator.state import (
    EXCLUDED,
    FIXES,
    Settings,
    State,
    Step,
    estimate,
    held_s,
    hypotheses,
    is_contradicted,
    is_jammed,
    levelled,
    source_name,
    sources,
)
from companion.records import (
    Mode,
    ParallelEstimate,
    Rejection,
    Solution,
    Source,
    Vector2,
    Vector3,
)
from companion.units import SECOND_NS

UNCONFIRMED = 0.99  # greatest probability stated of a source that is not excluded
PROTECTION_NS = SECOND_NS  # how often the protection level is computed


class _Estimate(NamedTuple):
    """Error of the channel by one estimator (m, m/s), covariance (nn, ne, ee) and velocity variance."""

    error_n: Vector2
    velocity_error_n: Vector2
    covariance: Vector3
    velocity_variance: float


def solve(state: State, rx_ns: int, settings: Settings) -> Step:
    """Return the corrected estimate at the nominal point; nothing before the first fix."""
    nominal, bank = state.nominal, state.bank
    if nominal is None or bank is None or not state.fixed:
        return state, []
    config, known = settings.config, hypotheses(state, settings)
    point = levelled(nominal.point, state)
    t_ns = point.t_ns
    promised = bounded_trajectory.guaranteed(state, point)
    rests_on = sources(state, t_ns, settings)
    fixes, against = rests_on & FIXES, is_contradicted(state, t_ns, settings)
    leading = estimate(state, settings)
    state = structs.replace(state, leading=(bank, leading))
    candidates = _candidates(state, leading, nominal.pending_s, promised, settings)
    leads = config.leading_estimator
    if (rests_on & Source.GNSS if leads == "restrictive" else fixes) or leads not in candidates:
        leads = "kalman"
    error, velocity_error, (var_n, cov, var_e), velocity_variance = candidates[leads]
    lat, lon, alt = displace(*point.position, -error[0], -error[1], 0.0)
    if abs(lat) > math.pi / 2.0:
        why = f"estimated latitude {math.degrees(lat):.1f} deg is beyond the pole: no solution"
        return state, [Rejection(t_ns, rx_ns, "solution", why, abs(lat), math.pi / 2.0)]
    is_due = state.protection is None or t_ns - state.protection[0] >= PROTECTION_NS
    false_sources = tuple((source_name(i, state), p) for i, p in enumerate(state.false)) if is_due else ()
    if is_due:
        before = np.array(error) - nominal.pending_s * np.array(candidates["kalman"].velocity_error_n)
        radius = banks.protection_level(bank, known.layout, config.integrity.risk, before)
        state = structs.replace(state, protection=(t_ns, radius, *error))
    protection = _level_about(error, state)
    bound_n, velocity_bound_n = _about(error, velocity_error, promised)
    witness = bool(rests_on & (Source.AZIMUTH | Source.RANGE))
    suspicion = _is_suspicious(state, banks.heard_sources(bank, known.layout)[VELOCITY]) or bool(against)
    held = _trust(state.held, trust.Evidence(bool(fixes), suspicion, protection), t_ns, config)
    north, east, down = point.v_n
    height = height_error.at(state.level, nominal.point, held_s(state, t_ns))
    last = max((t for t in (state.gnss_ns, state.rsbn_ns) if t is not None), default=t_ns)
    solution = Solution(
        t_ns=t_ns,
        rx_ns=rx_ns,
        mode=_mode(bool(fixes), bound_n, protection, settings),
        estimator=leads,
        lat=lat,
        lon=lon,
        alt_msl=alt,
        v_n=(north - velocity_error[0], east - velocity_error[1], down),
        covariance=(var_n, cov, 0.0, var_e, 0.0, height.covariance[0]),
        error_n=error,
        velocity_error_n=velocity_error,
        sources=int(rests_on),
        horizon_s=max(0.0, (t_ns - last) * 1e-9),
        bound_n=bound_n,
        velocity_bound_n=velocity_bound_n,
        disagreement=_disagreement(candidates),
        inertial_age_s=max(0.0, (rx_ns - t_ns) * 1e-9),
        ahead=minimax_bound.ahead(bounded_trajectory.guarantee(state), config),
        sigma_velocity=math.hypot(math.sqrt(velocity_variance), settings.model.channel.velocity_noise),
        protection=protection + (against.apart_m if against else 0.0),
        trust=held.trust,
        gnss_false=max(_gnss_false(state) or 0.0, known.settings.believed) if against else _gnss_false(state),
        witness=witness,
        false_sources=false_sources,
        bounds=promised.bounds if promised else None,
        contradicted=against is not None and not is_jammed(state),
        restarts=state.restarts,
        parallel=_parallel(candidates, config),
    )
    return structs.replace(state, held=held), [solution]


def _candidates(
    state: State, leading: Gaussian, dt: float, promised: Guaranteed | None, settings: Settings
) -> dict[str, _Estimate]:
    """Error of the channel by each estimator that runs; the bank is `dt` seconds older than the nominal."""
    n, e, vn, ve = leading.x[:4].tolist()
    C = leading.P[:4, :4]
    (nn, ne, n_vn, n_ve), (_, ee, e_vn, e_ve), (_, _, vnn, vne), (*_, vee) = C.tolist()
    place = (
        nn + dt * (2.0 * n_vn + dt * vnn),
        ne + dt * (n_ve + e_vn + dt * vne),
        ee + dt * (2.0 * e_ve + dt * vee),
    )
    variance = max(vnn, vee, 0.0) + _velocity_growth(state, dt, settings)
    found = {"kalman": _Estimate((n + dt * vn, e + dt * ve), (vn, ve), place, variance)}
    if promised is not None:
        best, restricted = promised.minimax, promised.restricted
        found["minimax"] = _linear(best, best.bound_n, best.velocity_bound_n)
        found["restricted"] = _linear(restricted, restricted.expected_n, restricted.velocity_expected_n)
    if state.parallel is not None and state.nominal is not None:
        point, channel = state.nominal.point, settings.model.channel
        for name, x4, P4 in parallel_filters.at(state.parallel, point, settings.config, channel):
            dx, dy, dv_n, dv_e = x4[:4].tolist()
            (var_n, cov), (_, var_e) = P4[:2, :2].tolist()
            variance = float(max(P4[2, 2], P4[3, 3], 0.0))
            found[name] = _Estimate((dx, dy), (dv_n, dv_e), (var_n, cov, var_e), variance)
    return found


def _linear(found: Linear, sigma_n: Vector2, velocity_sigma_n: Vector2) -> _Estimate:
    variances = (sigma_n[0] ** 2, 0.0, sigma_n[1] ** 2)
    return _Estimate(found.error_n, found.velocity_error_n, variances, max(velocity_sigma_n) ** 2)


def _velocity_growth(state: State, dt: float, settings: Settings) -> float:
    """Variance (m^2/s^2) that the samples of the last `dt` seconds, since the bank, added to the velocity.

    A velocity through the air follows each gust, a foreign one its own noise; a held one grows stale.
    """
    channel, nominal = settings.model.channel, state.nominal
    if nominal is None or nominal.interval is None or dt <= 0.0 or not isinstance(channel, OwnChannel):
        return 0.0
    model = channel.settings
    if nominal.interval.by == "air":
        return -(model.gust_m_s**2) * math.expm1(-2.0 * dt / model.turbulence_s)
    if nominal.interval.by == "foreign":
        return model.foreign_noise_m_s**2
    return model.hold_m_s_sqrt_s**2 * dt if nominal.interval.by in HELD else 0.0


def _level_about(error: Vector2, state: State) -> float:
    """Protection level about `error` (m): since it was computed the estimate has moved, and by the triangle
    inequality it holds about the new place with the distance added.
    """
    assert state.protection is not None
    return state.protection[1] + math.dist(error, state.protection[2:])


def _parallel(candidates: dict[str, _Estimate], config: Config) -> tuple[ParallelEstimate, ...]:
    return tuple(
        ParallelEstimate(name, c.error_n, c.covariance)
        for name in config.estimator.parallel
        if (c := candidates.get(name)) is not None
    )


def _about(
    error: Vector2, velocity_error: Vector2, promised: Guaranteed | None
) -> tuple[Vector2 | None, Vector2 | None]:
    """Guaranteed r.m.s. bounds about what is sent: those of the linear estimate and the distance to it."""
    if promised is None:
        return None, None
    linear = promised.restricted

    def added(bound: Vector2, ours: Vector2, its: Vector2) -> Vector2:
        return bound[0] + abs(ours[0] - its[0]), bound[1] + abs(ours[1] - its[1])

    return (
        added(linear.bound_n, error, linear.error_n),
        added(linear.velocity_bound_n, velocity_error, linear.velocity_error_n),
    )


def _gnss_false(state: State) -> float | None:
    """Probability that GNSS is false; no certainty before it is confirmed."""
    if not state.false:
        return None
    return state.false[GNSS] if state.reported[GNSS] == EXCLUDED else min(state.false[GNSS], UNCONFIRMED)


def _is_suspicious(state: State, has_velocity: bool) -> bool:
    """Whether a source is suspect or excluded. A velocity of GNSS that is no longer received is not: nothing
    could clear it, and the positions go on.
    """
    return any(how and (i != VELOCITY or has_velocity) for i, how in enumerate(state.reported))


def _disagreement(candidates: dict[str, _Estimate]) -> float | None:
    """The greatest distance between two estimators; None where there is only one."""
    pairs = combinations([c.error_n for c in candidates.values()], 2)
    return max((math.dist(a, b) for a, b in pairs), default=None)


def _mode(fixes: bool, bound_n: Vector2 | None, protection: float, settings: Settings) -> Mode:
    if fixes:
        return Mode.FIXED
    limit = settings.config.predictor.limit_m
    bounded = bound_n is not None and math.hypot(*bound_n) <= limit
    return Mode.PREDICTING if bounded or protection <= limit else Mode.UNTRUSTED


def _trust(held: trust.Held | None, evidence: trust.Evidence, t_ns: int, config: Config) -> trust.Held:
    """How far the output can be trusted."""
    limits = trust.Limits(
        config.integrity.alert_m, config.predictor.limit_m, settle_s=config.integrity.settle_s
    )
    if held is None:
        return trust.Held(trust.judge(evidence, limits), t_ns)
    return trust.turn(held, t_ns, evidence, limits)
