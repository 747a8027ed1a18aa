"""A whole flight smoothed: what the error of the inertial channel was at every moment, all fixes known.

Forward goes the navigator's own `step`, gates, jumps and all, stopped at every second and at every fix.
Backward goes the recursion of Rauch, Tung and Striebel (1965) over what it passed through, which needs
nothing of the measurements, nonlinear as they are. With Phi, Q from one stop to the next, x_{k+1|k} there
before the fix, P_{k+1|k} = Phi P_k Phi' + Q and C = P_k Phi' P_{k+1|k}^-1,

    x_{k|N} = x_k + C (x_{k+1|N} - x_{k+1|k})
    P_{k|N} = (I - C Phi) P_k (I - C Phi)' + C (P_{k+1|N} + Q) C'

The last stop is the filter's. The track is the inertial channel less its smoothed error; heights are as the
filter had them. It reads no files; memory grows as the flight.
"""

from __future__ import annotations

import bisect
from collections.abc import Iterable
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.linalg import eigh

from companion.config import Config
from companion.nav.geometry import Geodetic, displace
from companion.navigator import FOLDED, inertial
from companion.navigator.carry import Carry, Settings, initial, is_news, level, state_at
from companion.navigator.errorstate import ErrorState
from companion.navigator.inertial import Point
from companion.navigator.step import learn, step
from companion.records import Gnss, LocalPosition, RsbnFix, Stamped

Floats = npt.NDArray[np.float64]

EVERY_NS = 1_000_000_000
NEVER_NS = 2**63 - 1
REACH_NS = 2_000_000_000  # stops farther apart than this are not joined
WIDENED = 1.0 + 1e-3  # a factor below this is rounding


class Flight(NamedTuple):
    """The stops of a flight (N): times, the corrected track (rad, rad, m above mean sea level), the error
    states x (N, n) and P (N, n, n) of `navigator.errorstate`, smoothed, and as the filter had them in flight.
    """

    t_ns: npt.NDArray[np.int64]
    lat: Floats
    lon: Floats
    alt_msl: Floats
    x: Floats
    P: Floats
    x_filter: Floats
    P_filter: Floats

    @property
    def covariance(self) -> Floats:
        """Of the track, north and east (N, 2, 2), m^2."""
        return self.P[:, :2, :2]

    def at(self, t_ns: int) -> Geodetic | None:
        """The track between its stops, None where there are none near: a truth for `log.score`.

        Straight between stops, a second apart at most: off by an eighth of the acceleration, m.
        """
        k = bisect.bisect_right(self.t_ns, t_ns)
        if k == 0 or (k == len(self.t_ns) and t_ns > self.t_ns[-1]):
            return None
        k = min(k, len(self.t_ns) - 1)
        width = int(self.t_ns[k] - self.t_ns[k - 1])
        if width > REACH_NS:
            return None
        part = (t_ns - int(self.t_ns[k - 1])) / width
        a, b = (np.array([self.lat[i], self.lon[i], self.alt_msl[i]]) for i in (k - 1, k))
        turn = np.round((b[1] - a[1]) / (2.0 * np.pi)) * 2.0 * np.pi  # across the antimeridian
        return Geodetic(*(a + part * (b - [0.0, turn, 0.0] - a)).tolist())


class _Stop(NamedTuple):
    """A state of the filter, the point of the inertial channel, and how it came there from the stop before.

    `predicted` is x before the fix, if there was one; Phi is None where the chain begins anew.
    """

    ins: Point
    state: ErrorState
    predicted: Floats
    Phi: Floats | None
    Q: Floats
    fixed: bool = False
    widened: float = 1.0  # what P was multiplied by before the fix, which contradicted it


def smooth_flight(records: Iterable[Stamped], config: Config) -> Flight:
    """The smoothed flight from its records, of any kinds, sorted here by time of validity.

    ValueError if the navigator never got an estimate: no local position with its origin, or no fix.
    """
    stops = _forward(records, Settings.of(config))
    if not stops:
        raise ValueError("nothing to smooth: the records need a local position, its origin, and fixes")
    x = np.array([stop.state.x for stop in stops])
    P = np.array([stop.state.P for stop in stops])
    x_filter, P_filter = x.copy(), P.copy()
    _spread(stops, P)
    one = np.eye(x.shape[1])
    for k in range(len(stops) - 2, -1, -1):
        Phi, Q = stops[k + 1].Phi, stops[k + 1].Q
        if Phi is None:
            continue
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
    return Flight(t_ns, lat, lon, alt, x, P, x_filter, P_filter)


def _forward(records: Iterable[Stamped], settings: Settings) -> list[_Stop]:
    """The navigator over the records, stopped where a fix changed its state, and every second."""
    stops: list[_Stop] = []
    carry = initial(settings)
    for record in sorted((r for r in records if isinstance(r, FOLDED)), key=lambda r: r.t_ns):
        if isinstance(record, Gnss) and not is_news(record, carry, settings):
            continue
        # no solutions, which would predict at moments of their own, and no bounds ahead: the stops are ours
        carry = carry._replace(next_ns=NEVER_NS, next_ahead_ns=NEVER_NS)
        if carry.lesson is not None:
            carry, _ = learn(carry._replace(lesson=None), carry.lesson, settings)
        after = step(carry, record, settings)[0]
        stop = None
        if isinstance(record, LocalPosition):
            due = not stops or record.t_ns >= stops[-1].ins.t_ns + EVERY_NS
            if due and after.state is not None and after.track:
                stop = _arrival(after, after.track[-1], settings)
                after = after._replace(state=stop.state)
        elif (
            isinstance(record, Gnss | RsbnFix) and after.state is not None and after.state is not carry.state
        ):
            ins = inertial.at(carry.track, record.t_ns)
            assert ins is not None  # or the fix would have been of no use
            stop = _corrected(_arrival(carry, ins, settings), after.state)
        if stop is not None:
            _append(stops, stop._replace(ins=level(stop.ins, after)))
        carry = after
    if stops and carry.state is not None and carry.track:
        end = _arrival(carry, carry.track[-1], settings)
        _append(stops, end._replace(ins=level(end.ins, carry)))
    return stops


def _spread(stops: list[_Stop], P: Floats) -> None:
    """Where a fix proved that too much was claimed, let the claim have grown wrong ever since the last fix.

    P is multiplied by g, rising straight from 1 then to what the navigator multiplied it by. The noise that
    makes it so, (g_j - g_{j-1}) Phi P Phi' + g_j Q, is a covariance; no mean changes, as there was no fix.
    """
    for k, stop in enumerate(stops):
        if stop.widened == 1.0:
            continue
        first = k - 1
        while first > 0 and not stops[first].fixed:
            first -= 1
        start, span = stops[first].ins.t_ns, stop.ins.t_ns - stops[first].ins.t_ns
        before, claimed = 1.0, P[first]
        for j in range(first + 1, k + 1):
            g = 1.0 + (stop.widened - 1.0) * (stops[j].ins.t_ns - start) / span
            Phi = stops[j].Phi
            if Phi is None:
                break
            Q = (g - before) * Phi @ claimed @ Phi.T + g * stops[j].Q
            stops[j] = stops[j]._replace(Q=Q)
            before, claimed = g, P[j].copy()
            if j < k:
                P[j] *= g


def _append(stops: list[_Stop], stop: _Stop) -> None:
    """One stop more, or what a fix made of the last one."""
    if stops and stop.ins.t_ns <= stops[-1].ins.t_ns:
        last = stops.pop()
        stop = last._replace(
            ins=stop.ins,
            state=stop.state,
            fixed=last.fixed or stop.fixed,
            widened=last.widened * stop.widened,
        )
    stops.append(stop)


def _arrival(carry: Carry, ins: Point, settings: Settings) -> _Stop:
    """The state carried to `ins`; and, the prediction being linear, its Phi and Q by what it does to the unit
    matrix and to no covariance.
    """
    state = state_at(carry, ins, settings)
    if carry.state is None:
        return _Stop(ins, state, state.x, None, state.P)
    unit = ErrorState(carry.state.t_ns, np.eye(len(state.x)), np.zeros_like(state.P))
    one = state_at(carry._replace(state=unit), ins, settings)
    return _Stop(ins, state, state.x, one.x, one.P)


def _corrected(stop: _Stop, state: ErrorState) -> _Stop:
    """The stop once a fix made `state` of it, P having been widened first or not."""
    scale = np.sqrt(np.diag(stop.state.P))
    outer = np.outer(scale, scale)
    # a fix makes some combinations of the states better known and leaves the others as they were
    factor = float(eigh(state.P / outer, stop.state.P / outer, eigvals_only=True)[-1])
    return stop._replace(state=state, fixed=True, widened=factor if factor > WIDENED else 1.0)
