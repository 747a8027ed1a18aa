"""The trajectory that the guaranteed bound is of, and the deferred updates that keep the bound.

`minimax_bound` knows one trajectory, its corrections and their window. Here is which trajectory of the state
that is, how far the nominal one is from it, and which radio-only fixes give the corrections.
"""

from __future__ import annotations

import math

import numpy as np
from msgspec import structs

from companion.config import Config
from companion.estimate.fusion import Height, NoFix, Observation, maximum_likelihood
from companion.nav.geometry import displace
from companion.navigator import fix_observations, minimax_bound, own_channel, parallel_filters
from companion.navigator.channel import Nominal
from companion.navigator.hypotheses import AIRSPEED
from companion.navigator.inertial_track import Point
from companion.navigator.minimax_bound import Guarantee, Guaranteed
from companion.navigator.state import (
    EXCLUDED,
    Pending,
    Settings,
    State,
    Step,
    estimate,
    gnss_is_believed,
)
from companion.records import Fix, Gnss, Input, RsbnFix, Source, Vector2
from companion.units import SECOND_NS

TOGETHER_NS = SECOND_NS  # a fix of GNSS this near joins a beacon's answer


def guaranteed(state: State, nominal: Point) -> Guaranteed | None:
    """The guaranteed estimates of the nominal error now."""
    found = minimax_bound.guaranteed(guarantee(state), nominal.t_ns)
    return found and found.about(*_apart(state, nominal))


def guarantee(state: State) -> Guarantee:
    """That of the trajectory that is bounded now; none where another was until this record."""
    bounded, g = _bounded(state), state.guarantee
    return g if bounded is not None and bounded.driver == g.by else Guarantee()


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
