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
from companion.estimate.fusion import Height, NoFix, Observation, maximum_likelihood
from companion.estimate.kalman import Gaussian
from companion.nav.geometry import displace
from companion.navigator import (
    fix_observations,
    height_error,
    minimax_bound,
    own_channel,
    parallel_filters,
    trust,
)
from companion.navigator.channel import Nominal
from companion.navigator.hypotheses import AIRSPEED, GNSS, VELOCITY
from companion.navigator.inertial_track import Point
from companion.navigator.minimax_bound import Guarantee, Guaranteed, Linear
from companion.navigator.own_channel import OwnChannel
from companion.navigator.own_error_model import HELD
from companion.navigator.state import (
    EXCLUDED,
    FIXES,
    Pending,
    Settings,
    State,
    Step,
    estimate,
    gnss_is_believed,
    held_s,
    hypotheses,
    levelled,
    source_name,
    sources,
)
from companion.records import (
    Fix,
    Gnss,
    Input,
    Mode,
    ParallelEstimate,
    Rejection,
    RsbnFix,
    Solution,
    Source,
    Vector2,
    Vector3,
)
from companion.units import SECOND_NS

UNCONFIRMED = 0.99  # greatest probability stated of a source that is not excluded
PROTECTION_NS = SECOND_NS  # how often the protection level is computed
TOGETHER_NS = SECOND_NS  # a fix of GNSS this near joins a beacon's answer


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
    promised = guaranteed(state, point)
    rests_on = sources(state, t_ns, settings)
    fixes = rests_on & FIXES
    leading = estimate(state, settings)
    state = structs.replace(state, leading=(bank, leading))
    candidates = _candidates(state, leading, nominal.pending_s, promised, settings)
    leads = config.leading_estimator
    if (rests_on & Source.GNSS if leads == "restrictive" else fixes) or leads not in candidates:
        leads = "kalman"
    error, velocity_error, (var_n, cov, var_e), velocity_variance = candidates[leads]
    position = np.array(error) - nominal.pending_s * np.array(candidates["kalman"].velocity_error_n)
    false_sources: tuple[tuple[str, float], ...] = ()
    if state.protection is None or t_ns - state.protection[0] >= PROTECTION_NS:
        false_sources = tuple((source_name(i, state), p) for i, p in enumerate(state.false))
        radius = banks.protection_level(bank, known.layout, config.integrity.risk, position)
        state = structs.replace(state, protection=(t_ns, radius, *error))
    assert state.protection is not None
    # in between the estimate moves: by the triangle inequality the level holds about its new place
    protection = state.protection[1] + math.dist(error, state.protection[2:])
    bound_n, velocity_bound_n = _about(error, velocity_error, promised)
    witness = bool(rests_on & (Source.AZIMUTH | Source.RANGE))
    suspicion = _is_suspicious(state, banks.heard_sources(bank, known.layout)[VELOCITY])
    held = _trust(state.held, trust.Evidence(bool(fixes), suspicion, protection), t_ns, config)
    north, east, down = point.v_n
    lat, lon, alt = displace(*point.position, -error[0], -error[1], 0.0)
    if abs(lat) > math.pi / 2.0:
        why = f"estimated latitude {math.degrees(lat):.1f} deg is beyond the pole: no solution"
        return state, [Rejection(t_ns, rx_ns, "solution", why, abs(lat), math.pi / 2.0)]
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
        covariance=(
            var_n,
            cov,
            0.0,
            var_e,
            0.0,
            height_error.at(state.level, nominal.point, held_s(state, t_ns)).covariance[0],
        ),
        error_n=error,
        velocity_error_n=velocity_error,
        sources=int(rests_on),
        horizon_s=max(0.0, (t_ns - last) * 1e-9),
        bound_n=bound_n,
        velocity_bound_n=velocity_bound_n,
        disagreement=_disagreement(candidates),
        inertial_age_s=max(0.0, (rx_ns - t_ns) * 1e-9),
        ahead=minimax_bound.ahead(_guarantee(state), config),
        sigma_velocity=math.hypot(math.sqrt(velocity_variance), settings.model.channel.velocity_noise),
        protection=protection,
        trust=held.trust,
        gnss_false=_gnss_false(state),
        witness=witness,
        false_sources=false_sources,
        bounds=promised.bounds if promised else None,
        parallel=tuple(
            ParallelEstimate(name, c.error_n, c.covariance)
            for name in config.estimator.parallel
            if (c := candidates.get(name)) is not None
        ),
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


def resolve_pending(state: State, pending: Pending, settings: Settings) -> Step:
    """Deferred update: make the radio-only fix after the solution is out, for the guaranteed bound."""
    config, record, point = settings.config, pending.record, pending.point
    used = pending.used
    observations: tuple[object, ...]
    if isinstance(record, Gnss):
        observations = fix_observations.from_gnss(record, point, config.gnss)
    else:
        observations = tuple(
            z
            for z in fix_observations.from_rsbn(record, point, config.rsbn)
            if used & fix_observations.source_of(z)
        )
        by_gnss = state.gnss_fix if gnss_is_believed(state, settings) else None
        if by_gnss is not None and abs(by_gnss[0].t_ns - record.t_ns) <= TOGETHER_NS:
            # the correction nominal minus GNSS of a moment ago holds now: the error drifts by metres a minute
            fix_of_gnss, nominal = by_gnss
            observations += fix_observations.from_gnss(fix_of_gnss, nominal, config.gnss, pending.centre)
            used |= Source.GNSS
        half = state.half
        if half is not None and _is_other_half(half, record, used):
            observations += _other_half(half, pending, config)
            used |= half.used
    height = Height(0.0, config.inertial.height_sigma_m)
    try:
        fix = maximum_likelihood((*observations, height), start=np.zeros(3))  # type: ignore[arg-type]
    except NoFix:
        return structs.replace(state, half=pending), []  # an azimuth or a range alone is no fix
    east, north, up = (float(c) for c in fix.position)
    correction = (pending.centre[0] - north, pending.centre[1] - east)
    (var_e, cov), var_n = fix.covariance[0, :2].tolist(), float(fix.covariance[1, 1])
    sigma = (math.sqrt(var_n), math.sqrt(var_e))
    apart, _ = _apart(state, point._replace(position=displace(*point.position, *pending.centre, 0.0)))
    of_bounded = (correction[0] + apart[0], correction[1] + apart[1])
    g = minimax_bound.add_fix(state.guarantee, record.t_ns, of_bounded, sigma)
    lat, lon, alt = displace(*point.position, north, east, -up)
    out = Fix(
        t_ns=record.t_ns,
        rx_ns=record.rx_ns,
        lat=lat,
        lon=lon,
        alt_msl=alt,
        correction_n=correction,
        covariance=(var_n, cov, var_e),
        sources=int(used),
        cost=fix.cost,
        degrees_of_freedom=fix.degrees_of_freedom,
        iterations=fix.iterations,
    )
    state = structs.replace(state, guarantee=g, half=None)
    return _filtered(state, pending, out, used, settings), [out]


def _is_other_half(half: Pending, record: RsbnFix, used: Source) -> bool:
    """Whether `half` is the azimuth to a range, or the reverse, of the same beacon a moment ago."""
    before = half.record
    is_near = abs(before.t_ns - record.t_ns) <= TOGETHER_NS
    return is_near and isinstance(before, RsbnFix) and before.beacon == record.beacon and not half.used & used


def _other_half(half: Pending, pending: Pending, config: Config) -> tuple[Observation, ...]:
    """The observations of `half` about its own nominal point, less the error that `pending` takes off."""
    assert isinstance(half.record, RsbnFix)
    north, east = half.centre[0] - pending.centre[0], half.centre[1] - pending.centre[1]
    point = half.point._replace(position=displace(*half.point.position, north, east, 0.0))
    found = fix_observations.from_rsbn(half.record, point, config.rsbn)
    return tuple(z for z in found if half.used & fix_observations.source_of(z))


def _bounded(state: State) -> Nominal | None:
    """The trajectory whose error is bounded: in the own channel that by airspeed alone.

    Nothing bounds the attitude that turns the IMU's forces, nor an airspeed that is steady or excluded; nor
    what rotors do beside the nose.
    """
    nominal, by_air = state.nominal, state.reckoned
    if nominal is None or nominal.driver not in ("imu", "air"):
        return nominal
    is_excluded = bool(state.reported) and state.reported[AIRSPEED] == EXCLUDED
    by_rotors = state.sensors.multirotor or state.sensors.hovering
    if by_air is None or is_excluded or by_rotors or own_channel.is_old(by_air, nominal.t_ns):
        return None
    return by_air.track


def _apart(state: State, nominal: Point) -> tuple[Vector2, Vector2]:
    """How far the bounded trajectory is from a point of the nominal one, north and east (m), and by velocity
    (m/s).
    """
    by_air, bounded = state.reckoned, _bounded(state)
    if by_air is None or bounded is not by_air.track:
        return (0.0, 0.0), (0.0, 0.0)
    north, east, _ = bounded.point.v_n
    away = own_channel.apart_from(by_air, nominal, (north, east))
    return away, (north - nominal.v_n[0], east - nominal.v_n[1])


def guaranteed(state: State, nominal: Point) -> Guaranteed | None:
    """The guaranteed estimates of the nominal error now."""
    found = minimax_bound.guaranteed(_guarantee(state), nominal.t_ns)
    return found and found.about(*_apart(state, nominal))


def _guarantee(state: State) -> Guarantee:
    """That of the trajectory that is bounded now; none where another was until this record."""
    bounded, g = _bounded(state), state.guarantee
    return g if bounded is not None and bounded.driver == g.by else Guarantee()


def is_bound_due(state: State) -> bool:
    """Whether `refresh_bound` has anything to do."""
    bounded = _bounded(state)
    if bounded is None:
        return bool(state.guarantee.by)
    return state.fixed and minimax_bound.is_due(state.guarantee, bounded)


def refresh_bound(state: State, record: Input, settings: Settings) -> Step:
    """Deferred update: extend the window of the guaranteed bound, and do one piece of its work."""
    bounded = _bounded(state)
    if bounded is None:
        return structs.replace(state, guarantee=Guarantee()), []
    if not state.fixed:
        return state, []
    g = minimax_bound.follow(state.guarantee, bounded, settings.config)
    g = minimax_bound.refresh(g, bounded, settings.config)
    return (state if g is state.guarantee else structs.replace(state, guarantee=g)), []


def _filtered(state: State, pending: Pending, fix: Fix, used: Source, settings: Settings) -> State:
    """The same fix for the filters that run beside the bank."""
    config, channel = settings.config, settings.model.channel
    if not parallel_filters.names(config) or state.bank is None:
        return state
    parallel, point = state.parallel, pending.point._replace(t_ns=fix.t_ns)
    if parallel is None:
        found = estimate(state, settings)
        parallel = parallel_filters.begin(config, channel, point, found.x[:4], found.P[:4, :4])
        return structs.replace(state, parallel=parallel)
    var_n, cov, var_e = fix.covariance
    by_gnss = bool(used & Source.GNSS)
    parallel = parallel_filters.add(
        parallel,
        point,
        "gnss" if by_gnss else "beacon",
        np.array(fix.correction_n),
        np.eye(2),
        np.array([[var_n, cov], [cov, var_e]]),
        white=not by_gnss,
        config=config,
        channel=channel,
    )
    return structs.replace(state, parallel=parallel)
