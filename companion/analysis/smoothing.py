"""A whole flight smoothed: what the error of the inertial channel was at every moment, all fixes known.

Forward goes the navigator's own `stepped`, gates, jumps and all, on the error model of whichever inertial
channel flew, stopped at every second and at every fix. Backward goes the recursion of Rauch, Tung and
Striebel (1965) over what it passed through, which needs nothing of the measurements, nonlinear as they are.
With Phi, Q from one stop to the next, x_{k+1|k} there before the fix, P_{k+1|k} = Phi P_k Phi' + Q and
C = P_k Phi' P_{k+1|k}^-1,

    x_{k|N} = x_k + C (x_{k+1|N} - x_{k+1|k})
    P_{k|N} = (I - C Phi) P_k (I - C Phi)' + C (P_{k+1|N} + Q) C'

The last stop is the filter's. The track is the inertial channel less its smoothed error; heights are as the
filter had them. It reads no files; memory grows as the flight.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.linalg import eigh

from companion.config import Config, parse
from companion.estimate.filterbank import INERTIAL
from companion.nav.geometry import displace
from companion.navigator import FOLDED, inertial_track, integrity, learnt, stepped, tuned
from companion.navigator.error_state import ErrorState
from companion.navigator.inertial_track import Point
from companion.navigator.state import Carry, Settings, initial, is_news, level, state_at
from companion.records import Gnss, Rejection, RsbnFix, Stamped, Tuning

Floats = npt.NDArray[np.float64]

EVERY_NS = 1_000_000_000
NEVER_NS = 2**63 - 1
WIDENED = 1.0 + 1e-3  # a factor below this is rounding


class Run(NamedTuple):
    """Stops (N) that one error model joins: times, the corrected track (rad, rad, m above mean sea level),
    and the error states x (N, n), P (N, n, n), smoothed, and as the filter had them in flight.

    Of the states the first two are the position error, north and east (m); the rest is the model's.
    """

    t_ns: npt.NDArray[np.int64]
    lat: Floats
    lon: Floats
    alt_msl: Floats
    x: Floats
    P: Floats
    x_filter: Floats
    P_filter: Floats


class _Stop(NamedTuple):
    """A state of the filter, the point of the inertial channel, and how it came there from the stop before.

    `predicted` is x before the fix, if there was one; Phi is None where a run begins.
    """

    ins: Point
    state: ErrorState
    predicted: Floats
    Phi: Floats | None
    Q: Floats
    fixed: bool = False
    widened: float = 1.0  # what P was multiplied by before the fix, which contradicted it


def smooth_flight(records: Iterable[Stamped], config: Config) -> list[Run]:
    """The smoothed runs of a flight, from its records, of any kinds, sorted here by time of validity.

    A run ends where the inertial channel is another, the autopilot having begun anew or the operator having
    chosen it, and where a source was excluded together with what it had taught.
    ValueError if the navigator never got an estimate: no inertial channel, or no fix.
    """
    runs: list[list[_Stop]] = []
    for stop in _forward(records, config):
        if stop.Phi is None:
            runs.append([])
        runs[-1].append(stop)
    if not runs:
        raise ValueError(
            "nothing to smooth: the records need a local position and its origin, or airspeed and attitude, "
            "and fixes"
        )
    return [_smoothed(stops) for stops in runs]


def joined(runs: Iterable[Run]) -> tuple[npt.NDArray[np.int64], Floats, Floats, Floats]:
    """The track over all runs: t_ns, lat, lon, alt_msl, (n,) each."""
    t_ns, lat, lon, alt = zip(*(run[:4] for run in runs), strict=True)
    return np.concatenate(t_ns), np.concatenate(lat), np.concatenate(lon), np.concatenate(alt)


def _smoothed(stops: list[_Stop]) -> Run:
    """The backward pass over one run."""
    x = np.array([stop.state.x for stop in stops])
    P = np.array([stop.state.P for stop in stops])
    x_filter, P_filter = x.copy(), P.copy()
    _spread(stops, P)
    one = np.eye(x.shape[1])
    for k in range(len(stops) - 2, -1, -1):
        Phi, Q = stops[k + 1].Phi, stops[k + 1].Q
        assert Phi is not None
        ahead = Phi @ P[k] @ Phi.T + Q
        scale = np.sqrt(np.diag(ahead))  # metres and microradians: invert the correlations
        C = np.linalg.solve(ahead / np.outer(scale, scale), (Phi @ P[k]) / scale[:, None]).T / scale
        x[k] += C @ (x[k + 1] - stops[k + 1].predicted)
        J = one - C @ Phi
        P_k = J @ P[k] @ J.T + C @ (P[k + 1] + Q) @ C.T
        P[k] = 0.5 * (P_k + P_k.T)
    places = [displace(*s.ins.position, -e[0], -e[1], 0.0) for s, e in zip(stops, x.tolist(), strict=True)]
    lat, lon, alt = np.array(places).T
    t_ns = np.array([stop.ins.t_ns for stop in stops], dtype=np.int64)
    return Run(t_ns, lat, lon, alt, x, P, x_filter, P_filter)


def _forward(records: Iterable[Stamped], config: Config) -> list[_Stop]:
    """The navigator over the records, stopped where a fix changed its state, and every second.

    `since` is what the channel itself changed since the last stop: by jumping x, by being blurred P.
    `parted`: the monitor has exchanged the state since, for one without an excluded source of fixes.
    """
    settings = Settings.of(config)
    carry, stops = initial(settings), list[_Stop]()
    since, parted = ErrorState(0, np.zeros(0), np.zeros((0, 0))), False
    for record in sorted((r for r in records if isinstance(r, FOLDED)), key=lambda r: r.t_ns):
        if isinstance(record, Gnss) and not is_news(record, carry, settings):
            continue
        # no solutions, which would predict at moments of their own, and no bounds ahead: the stops are ours
        carry = carry._replace(next_ns=NEVER_NS, next_ahead_ns=NEVER_NS)
        before = carry.state
        carry, _ = learnt(carry, settings)
        if carry.state is not before and carry.watch is not None:
            parted = parted or not integrity.excluded(carry.watch, INERTIAL)
        if stops and before is not None and carry.state is not None and carry.state is not before:
            last = stops.pop()  # a source was left out, and what it had said before that fix with it
            renewed = _corrected(last, carry.state)
            stops.append(renewed._replace(widened=last.widened * renewed.widened))
        if isinstance(record, Tuning):
            settings, carry = tuned(carry, settings, parse(record.toml, "parameters in the log"))
            continue
        if isinstance(record, Gnss | RsbnFix):
            after, stop = _fixed(carry, record, since, settings)
        else:
            after, stop = stepped(carry, record, settings)[0], None
            if after.state is not None and after.track:
                if carry.state is not None and after.state is not carry.state:
                    moved, blurred = after.state.x - carry.state.x, after.state.P - carry.state.P
                    since = since._replace(x=since.x + moved, P=since.P + blurred)
                if not stops or after.track[-1].t_ns >= stops[-1].ins.t_ns + EVERY_NS:
                    stop = _arrival(after, after.track[-1], since, settings)
                    after = after._replace(state=stop.state)
        if stop is not None:
            stop = stop._replace(ins=level(stop.ins, after), Phi=None if parted else stop.Phi)
            _append(stops, stop, since)
            parted = False
            since = ErrorState(stop.ins.t_ns, np.zeros_like(stop.state.x), np.zeros_like(stop.state.P))
        carry = after
    if stops and carry.state is not None and carry.track and carry.track[-1].t_ns > stops[-1].ins.t_ns:
        end = _arrival(carry, carry.track[-1], since, settings)
        stops.append(end._replace(ins=level(end.ins, carry)))
    return stops


def _fixed(
    carry: Carry, record: Gnss | RsbnFix, since: ErrorState, settings: Settings
) -> tuple[Carry, _Stop | None]:
    """After a fix, for which the state is carried to its time; no stop where it was not used."""
    ins = inertial_track.at(carry.track, record.t_ns)
    if ins is None or carry.state is None:
        after, _ = stepped(carry, record, settings)
        ins = inertial_track.at(after.track, record.t_ns)
        if ins is None or after.state is None:
            return after, None
        return after, _corrected(
            _arrival(carry._replace(track=after.track), ins, since, settings), after.state
        )
    stop = _arrival(carry, ins, since, settings)
    after, outputs = stepped(carry._replace(state=stop.state), record, settings)
    if after.state is not stop.state and after.state is not None:
        return after, _corrected(stop, after.state)
    if any(isinstance(output, Rejection) for output in outputs):
        return after, stop
    return after._replace(state=carry.state), None


def _spread(stops: list[_Stop], P: Floats) -> None:
    """Where a fix proved that too much was claimed, let the claim have grown wrong ever since the last fix.

    P is multiplied by g, rising straight from 1 then to what the navigator multiplied it by. The noise that
    makes it so, (g_j - g_{j-1}) Phi P Phi' + g_j Q, is a covariance; no mean changes, as there was no fix.
    """
    for k, stop in enumerate(stops):
        if k == 0 or stop.widened == 1.0:
            continue
        first = k - 1
        while first > 0 and not stops[first].fixed:
            first -= 1
        start, span = stops[first].ins.t_ns, stop.ins.t_ns - stops[first].ins.t_ns
        before, claimed = 1.0, P[first]
        for j in range(first + 1, k + 1):
            g = 1.0 + (stop.widened - 1.0) * (stops[j].ins.t_ns - start) / span
            Phi = stops[j].Phi
            assert Phi is not None
            Q = (g - before) * Phi @ claimed @ Phi.T + g * stops[j].Q
            stops[j] = stops[j]._replace(Q=Q)
            before, claimed = g, P[j].copy()
            if j < k:
                P[j] *= g


def _append(stops: list[_Stop], stop: _Stop, since: ErrorState) -> None:
    """One stop more, or what a second fix of the same instant made of the last one."""
    if stops and stop.Phi is not None and stop.ins.t_ns <= stops[-1].ins.t_ns:
        last = stops.pop()
        stop = last._replace(
            ins=stop.ins,
            state=stop.state,
            predicted=last.predicted + since.x,
            fixed=last.fixed or stop.fixed,
            widened=last.widened * stop.widened,
        )
    stops.append(stop)


def _arrival(carry: Carry, ins: Point, since: ErrorState, settings: Settings) -> _Stop:
    """The state carried to `ins`; and, the prediction being linear, its Phi and Q by what it does to the unit
    matrix and to no covariance but that which the channel lost at its beginning.
    """
    state = state_at(carry, ins, settings)
    if carry.state is None:
        return _Stop(ins, state, state.x, None, state.P)
    unit = ErrorState(carry.state.t_ns, np.eye(len(state.x)), since.P)
    one = state_at(carry._replace(state=unit), ins, settings)
    return _Stop(ins, state, state.x, one.x, one.P)


def _corrected(stop: _Stop, state: ErrorState) -> _Stop:
    """The stop once a fix made `state` of it, P having been widened first or not."""
    scale = np.sqrt(np.diag(stop.state.P))
    outer = np.outer(scale, scale)
    # a fix makes some combinations of the states better known and leaves the others as they were
    factor = float(eigh(state.P / outer, stop.state.P / outer, eigvals_only=True)[-1])
    return stop._replace(state=state, fixed=True, widened=factor if factor > WIDENED else 1.0)
