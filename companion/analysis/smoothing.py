"""Fixed-interval smoothing of a flight: error of the inertial channel at every epoch, given all fixes.

Forward pass: the navigator's own step, gates and jump corrections included, with the error model of the
inertial channel in use; epochs at every second and at every fix. Backward pass: the recursion of Rauch, Tung
and Striebel (1965), which does not need the (nonlinear) measurements. With Phi, Q from one epoch to the next,
x_{k+1|k} the prediction before the fix, P_{k+1|k} = Phi P_k Phi' + Q and C = P_k Phi' P_{k+1|k}^-1,

    x_{k|N} = x_k + C (x_{k+1|N} - x_{k+1|k})
    P_{k|N} = (I - C Phi) P_k (I - C Phi)' + C (P_{k+1|N} + Q) C'

The last epoch equals the filter. The track is the inertial channel minus its smoothed error; heights are
those of the filter. Memory grows linearly with the duration of the flight.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.linalg import eigh

from companion.config import Config, parse
from companion.estimate.filterbank import INERTIAL
from companion.estimate.smoother import rts_backward
from companion.nav.geometry import displace
from companion.navigator import FOLDED, inertial_track, integrity, learnt, stepped, tuned
from companion.navigator.error_state import ErrorState
from companion.navigator.inertial_track import Point
from companion.navigator.state import Carry, Settings, initial, is_news, level, state_at
from companion.records import Gnss, Rejection, RsbnFix, Stamped, Tuning
from companion.units import Floats

EVERY_NS = 1_000_000_000
NEVER_NS = 2**63 - 1
MIN_INFLATION = 1.0 + 1e-3  # smaller factors are rounding


class SmoothedRun(NamedTuple):
    """N epochs of one error model: times, corrected track (rad, rad, m above mean sea level), error states
    x (N, n), P (N, n, n) smoothed, and the same of the forward filter.

    The first two states are the position error, north and east (m); the others depend on the model.
    """

    t_ns: npt.NDArray[np.int64]
    lat: Floats
    lon: Floats
    alt_msl: Floats
    x: Floats
    P: Floats
    x_filter: Floats
    P_filter: Floats


class _Epoch(NamedTuple):
    """Inertial position and filter state at an epoch, with the transition from the previous epoch.

    `predicted` is x before the fix, if there was one; Phi is None at the start of a run.
    """

    ins: Point
    state: ErrorState
    predicted: Floats
    Phi: Floats | None
    Q: Floats
    fixed: bool = False
    inflation: float = 1.0  # factor on P before a fix that contradicted the covariance


def smooth_flight(records: Iterable[Stamped], config: Config) -> list[SmoothedRun]:
    """Smooth a flight. `records` may be of any types; they are sorted by time of validity.

    A run ends where the inertial channel changes (reboot of the autopilot, change by the operator), and where
    a source is excluded together with its earlier contribution.

    Raises ValueError if the navigator never had an estimate: no inertial channel, or no fix.
    """
    runs: list[list[_Epoch]] = []
    for epoch in _forward_pass(records, config):
        if epoch.Phi is None:
            runs.append([])
        runs[-1].append(epoch)
    if not runs:
        raise ValueError(
            "nothing to smooth: the records need a local position and its origin, or airspeed and attitude, "
            "and fixes"
        )
    return [_rts_smooth(epochs) for epochs in runs]


def join_runs(runs: Iterable[SmoothedRun]) -> tuple[npt.NDArray[np.int64], Floats, Floats, Floats]:
    """Concatenate the tracks of all runs: t_ns, lat, lon, alt_msl, each (n,)."""
    t_ns, lat, lon, alt = zip(*(run[:4] for run in runs), strict=True)
    return np.concatenate(t_ns), np.concatenate(lat), np.concatenate(lon), np.concatenate(alt)


def _rts_smooth(epochs: list[_Epoch]) -> SmoothedRun:
    """Run the backward pass over one run."""
    x = np.array([epoch.state.x for epoch in epochs])
    P = np.array([epoch.state.P for epoch in epochs])
    x_filter, P_filter = x, P.copy()
    _spread_inflation(epochs, P)
    later = epochs[1:]
    Phi = [epoch.Phi for epoch in later if epoch.Phi is not None]  # only the first epoch has none
    x, P = rts_backward(x, P, [e.predicted for e in later], Phi, [e.Q for e in later])
    places = [displace(*s.ins.position, -e[0], -e[1], 0.0) for s, e in zip(epochs, x.tolist(), strict=True)]
    lat, lon, alt = np.array(places).T
    t_ns = np.array([epoch.ins.t_ns for epoch in epochs], dtype=np.int64)
    return SmoothedRun(t_ns, lat, lon, alt, x, P, x_filter, P_filter)


def _forward_pass(records: Iterable[Stamped], config: Config) -> list[_Epoch]:
    """Run the navigator over the records; an epoch at every fix that changes the state, and every second.

    `since` is the change made by the channel itself since the last epoch: x by jumps, P by inflation.
    `restarted`: since then the state was replaced by one without the contribution of an excluded source.
    """
    settings = Settings.of(config)
    carry, epochs = initial(settings), list[_Epoch]()
    since, restarted = ErrorState(0, np.zeros(0), np.zeros((0, 0))), False
    for record in sorted((r for r in records if isinstance(r, FOLDED)), key=lambda r: r.t_ns):
        if isinstance(record, Gnss) and not is_news(record, carry, settings):
            continue
        # no solutions and no bounds ahead: solutions would propagate to times of their own
        carry = carry._replace(next_ns=NEVER_NS, next_ahead_ns=NEVER_NS)
        before = carry.state
        carry, _ = learnt(carry, settings)
        if carry.state is not before and carry.watch is not None:
            restarted = restarted or not integrity.excluded(carry.watch, INERTIAL)
        if epochs and before is not None and carry.state is not None and carry.state is not before:
            last = epochs.pop()  # a source was excluded, together with its contribution before that fix
            renewed = _with_update(last, carry.state)
            epochs.append(renewed._replace(inflation=last.inflation * renewed.inflation))
        if isinstance(record, Tuning):
            settings, carry = tuned(carry, settings, parse(record.toml, "parameters in the log"))
            continue
        if isinstance(record, Gnss | RsbnFix):
            after, epoch = _update_with_fix(carry, record, since, settings)
        else:
            after, epoch = stepped(carry, record, settings)[0], None
            if after.state is not None and after.track:
                if carry.state is not None and after.state is not carry.state:
                    jump, inflated = after.state.x - carry.state.x, after.state.P - carry.state.P
                    since = since._replace(x=since.x + jump, P=since.P + inflated)
                if not epochs or after.track[-1].t_ns >= epochs[-1].ins.t_ns + EVERY_NS:
                    epoch = _propagate_to(after, after.track[-1], since, settings)
                    after = after._replace(state=epoch.state)
        if epoch is not None:
            epoch = epoch._replace(ins=level(epoch.ins, after), Phi=None if restarted else epoch.Phi)
            _append_epoch(epochs, epoch, since)
            restarted = False
            since = ErrorState(epoch.ins.t_ns, np.zeros_like(epoch.state.x), np.zeros_like(epoch.state.P))
        carry = after
    if epochs and carry.state is not None and carry.track and carry.track[-1].t_ns > epochs[-1].ins.t_ns:
        end = _propagate_to(carry, carry.track[-1], since, settings)
        epochs.append(end._replace(ins=level(end.ins, carry)))
    return epochs


def _update_with_fix(
    carry: Carry, record: Gnss | RsbnFix, since: ErrorState, settings: Settings
) -> tuple[Carry, _Epoch | None]:
    """Propagate to the fix and update with it; no epoch if the fix is not used."""
    ins = inertial_track.at(carry.track, record.t_ns)
    if ins is None or carry.state is None:
        after, _ = stepped(carry, record, settings)
        ins = inertial_track.at(after.track, record.t_ns)
        if ins is None or after.state is None:
            return after, None
        return after, _with_update(
            _propagate_to(carry._replace(track=after.track), ins, since, settings), after.state
        )
    epoch = _propagate_to(carry, ins, since, settings)
    after, outputs = stepped(carry._replace(state=epoch.state), record, settings)
    if after.state is not epoch.state and after.state is not None:
        return after, _with_update(epoch, after.state)
    if any(isinstance(output, Rejection) for output in outputs):
        return after, epoch
    return after._replace(state=carry.state), None


def _spread_inflation(epochs: list[_Epoch], P: Floats) -> None:
    """Where a fix contradicted the covariance, spread its inflation over the time since the previous fix.

    P is multiplied by g, which rises linearly from 1 at the previous fix to the navigator's factor. The
    equivalent process noise, (g_j - g_{j-1}) Phi P Phi' + g_j Q, is a covariance; the means do not change.
    """
    for k, epoch in enumerate(epochs):
        if k == 0 or epoch.inflation == 1.0:
            continue
        first = k - 1
        while first > 0 and not epochs[first].fixed:
            first -= 1
        start, span = epochs[first].ins.t_ns, epoch.ins.t_ns - epochs[first].ins.t_ns
        before, claimed = 1.0, P[first]
        for j in range(first + 1, k + 1):
            g = 1.0 + (epoch.inflation - 1.0) * (epochs[j].ins.t_ns - start) / span
            Phi = epochs[j].Phi
            assert Phi is not None
            Q = (g - before) * Phi @ claimed @ Phi.T + g * epochs[j].Q
            epochs[j] = epochs[j]._replace(Q=Q)
            before, claimed = g, P[j].copy()
            if j < k:
                P[j] *= g


def _append_epoch(epochs: list[_Epoch], epoch: _Epoch, since: ErrorState) -> None:
    """Append an epoch, or merge it into the last one if it is a second fix at the same instant."""
    if epochs and epoch.Phi is not None and epoch.ins.t_ns <= epochs[-1].ins.t_ns:
        last = epochs.pop()
        epoch = last._replace(
            ins=epoch.ins,
            state=epoch.state,
            predicted=last.predicted + since.x,
            fixed=last.fixed or epoch.fixed,
            inflation=last.inflation * epoch.inflation,
        )
    epochs.append(epoch)


def _propagate_to(carry: Carry, ins: Point, since: ErrorState, settings: Settings) -> _Epoch:
    """The state carried to `ins`; and, the prediction being linear, its Phi and Q by what it does to the unit
    matrix and to no covariance but that which the channel lost at its beginning.
    """
    state = state_at(carry, ins, settings)
    if carry.state is None:
        return _Epoch(ins, state, state.x, None, state.P)
    unit = ErrorState(carry.state.t_ns, np.eye(len(state.x)), since.P)
    one = state_at(carry._replace(state=unit), ins, settings)
    return _Epoch(ins, state, state.x, one.x, one.P)


def _with_update(epoch: _Epoch, state: ErrorState) -> _Epoch:
    """Return the epoch with the state after a fix; find the inflation of P before it, if any."""
    scale = np.sqrt(np.diag(epoch.state.P))
    outer = np.outer(scale, scale)
    # a fix never increases the variance of a state combination: a factor above 1 is inflation
    factor = float(eigh(state.P / outer, epoch.state.P / outer, eigvals_only=True)[-1])
    return epoch._replace(state=state, fixed=True, inflation=factor if factor > MIN_INFLATION else 1.0)
