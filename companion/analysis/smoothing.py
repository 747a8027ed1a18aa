"""Fixed-interval smoothing of a flight: error of the nominal trajectory at every epoch, given all fixes.

A smoother needs one Gaussian path, so the flight is filtered twice by the navigator's own step. The first
pass (`analysis.first_pass`) is the flight: it decides what was false, when states jumped, and which grade of
noise and which gusts were right. The second pass runs a plain Kalman filter with that grade and those gusts:
it leaves out what was false or an outlier, takes every other fix, widens the wind where it jumped, and takes
for all other jumps a random walk of their variance. Every step of it is an epoch: at a measurement, or half a
second after the last.

The backward pass is `estimate.smoother.rts_backward`, which does not need the (nonlinear) measurements. The
last epoch equals the filter. The track is the nominal trajectory minus its smoothed error; heights are those
of the filter. Memory grows linearly with the duration of the flight. The covariance is that of the plain path
alone: it knows nothing of the chance that the first pass decided wrongly.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from msgspec import structs

from companion.analysis.first_pass import NEVER_NS, FirstPass
from companion.analysis.gusts import Gusts
from companion.config import Config, parse
from companion.estimate import bank as banks
from companion.estimate.bank import Bank
from companion.estimate.linear_system import LinearSystem
from companion.estimate.smoother import rts_backward, two_point
from companion.nav.geometry import displace, separation
from companion.navigator import INPUTS_USED, begins_again, guarded, own_error_model, tuned
from companion.navigator.air_velocity import Renewal, renewal
from companion.navigator.channel import Nominal, Transition
from companion.navigator.hypotheses import (
    BIASES,
    HEADING,
    MOST_BEACONS,
    MOST_WIDER,
    Hypotheses,
    Model,
    Situation,
)
from companion.navigator.inertial_track import Point
from companion.navigator.measurements import receiver_states
from companion.navigator.progress import driver
from companion.navigator.state import Settings, State, hypotheses, levelled
from companion.navigator.step import step
from companion.records import (
    AirData,
    Attitude,
    Gnss,
    Imu,
    Input,
    LocalPosition,
    Output,
    RangeDifference,
    Reset,
    RsbnFix,
    SecondIns,
    Stamped,
    StarFix,
    TimeStep,
    Tuning,
)
from companion.units import Floats

MEASURING = (AirData, RangeDifference, StarFix, SecondIns)  # besides fixes; AirData by itself too


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
    gusts: Gusts | None = None  # those of the flight, if it shows them; else those of the configuration
    apart_sigma: float = math.nan  # greatest distance to the solution of the two-point problem, if checked


def smooth_flight(records: Iterable[Stamped], config: Config, check: bool = False) -> list[SmoothedRun]:
    """Smooth a flight. `records` may be of any types; they are sorted by time of validity.

    With `check` every run is solved a second time as a two-point boundary problem.

    A run ends where the bank begins again or has other states: reboot of an INS, change of the error model or
    of the feed by the operator.

    Raises ValueError if the navigator never had an estimate: no nominal trajectory, or no fix.
    """
    path = _forward_pass(records, config)
    runs = [run for run in path.runs if run]
    if not runs:
        raise ValueError(
            "nothing to smooth: the records need a local position and its origin, or airspeed and attitude, "
            "and fixes"
        )
    smoothed = [_rts_smooth(epochs)._replace(gusts=path.gusts) for epochs in runs]
    if not check:
        return smoothed
    return [run._replace(apart_sigma=_apart(run, epochs)) for run, epochs in zip(smoothed, runs, strict=True)]


def join_runs(runs: Iterable[SmoothedRun]) -> tuple[npt.NDArray[np.int64], Floats, Floats, Floats]:
    """Concatenate the tracks of all runs: t_ns, lat, lon, alt_msl, each (n,)."""
    t_ns, lat, lon, alt = zip(*(run[:4] for run in runs), strict=True)
    return np.concatenate(t_ns), np.concatenate(lat), np.concatenate(lon), np.concatenate(alt)


# ---------------------------------------------------------------------------------------------------------
# Second pass: one Gaussian path
# ---------------------------------------------------------------------------------------------------------


class _PlainModel(Model):
    """One grade and no faults; keeps the transitions that were asked for."""

    def __init__(self, config: Config, grade: int, beacons: int) -> None:
        super().__init__(config, plain=grade)
        self.grade, self.beacons = grade, beacons
        self.judged = False  # the record that is taken next, by the first pass
        self.asked: list[tuple[Transition, Point]] = []

    def begin(self, t_s: float) -> Bank:
        """The bank before the first fix, with the biases of all beacons of the flight."""
        bank = super().begin(t_s)
        for k in range(self.beacons):
            bank = self.with_beacon(bank, k)
        return bank

    def hypotheses(self, now: Situation) -> Hypotheses:
        """The hypotheses of a situation; what the first pass took is no outlier."""
        return super().hypotheses(now)._replace(judged=self.judged)

    def transition(self, nominal: Nominal, beacons: int) -> Transition:
        """Phi and Q, noted."""
        found = super().transition(nominal, beacons)
        self.asked.append((found, nominal.point))
        return found

    def kept(self, Phi: Floats) -> float:
        """Factor of a heading that is far off, noted in Phi and Q."""
        kept = super().kept(Phi)
        (A, B), point = self.asked[-1]
        A, B, wider, sine = A.copy(), B.copy(), min(kept, MOST_WIDER), HEADING.sine
        A[sine] *= kept
        B[:, sine] *= wider
        B[:, :, sine] *= wider
        self.asked[-1] = Transition(A, B), point
        return kept


class _Epoch(NamedTuple):
    """Nominal point and filter state at an epoch; `predicted` is x before the measurement, if there was one.
    Phi and Q lead here from the previous epoch.
    """

    point: Point
    x: Floats
    P: Floats
    predicted: Floats
    Phi: Floats
    Q: Floats
    fixed: bool


def _forward_pass(records: Iterable[Stamped], config: Config) -> _Path:
    """Filter the records by one plain path, and return it with the epochs of each run."""
    first = FirstPass(config)
    for record in sorted((r for r in records if isinstance(r, INPUTS_USED)), key=lambda r: r.t_ns):
        first.handle(record)
    first.end()
    path, run = _Path(config, first), -1
    for folded in first.folded:
        if folded.run != run:
            run = folded.run
            path.begin(run)
        path.jump(folded.record.t_ns)
        kept = first.believed(folded)
        if kept is not None:
            path.follow(kept, judged=not folded.has_rejected_position)
    path.end()
    return path


class _Path:
    """The plain filter as it goes along, and its epochs.

    `_Phi`, `_Q`: from the last epoch to where the bank stands now.
    """

    def __init__(self, config: Config, first: FirstPass) -> None:
        self.runs: list[list[_Epoch]] = []
        self._first, self.gusts = first, first.gusts.estimate()
        self._beacons = tuple(first.beacons.values())[:MOST_BEACONS]
        self._jumps = sorted(first.jumps, key=lambda jumped: jumped.t_ns)
        config = self._with_gusts(config)
        self._model = _PlainModel(config, 0, len(self._beacons))
        self._settings = Settings(config, self._model)
        self._state = self._with_beacons(State())
        self._Phi, self._Q = np.eye(0), np.eye(0)

    def begin(self, run: int) -> None:
        """Go on with the grade of another run."""
        self._model = _PlainModel(self._settings.config, self._first.grade(run), len(self._beacons))
        self._settings = self._settings._replace(model=self._model)

    def jump(self, t_ns: int) -> None:
        """Let the states jump that did up to `t_ns`, from the first fix on."""
        while (bank := self._state.bank) is not None and self._jumps and self._jumps[0].t_ns <= t_ns:
            jump = self._jumps.pop(0).jump
            x, P = bank.x.copy(), bank.P.copy()
            banks.apply_jump(x, P, np.arange(1), jump)
            self._state = structs.replace(self._state, bank=bank._replace(x=x, P=P))
            if jump.angle is not None:  # what was known of it ends here
                self._Phi[jump.angle, :] = 0.0
            banks.apply_jump(np.zeros((1, len(self._Q))), self._Q[None], np.arange(1), jump)

    def follow(self, record: Input, judged: bool) -> None:
        """Take one more record; `judged`: the first pass took what is in it."""
        if isinstance(record, Tuning):
            self._tune(record)
            return
        before = structs.replace(self._state, next_ns=NEVER_NS, pending=None)
        self._model.asked.clear()
        self._model.judged = judged
        after, outputs = guarded(before, record, self._settings, step, record)
        self._state = after if after.bank is not None else self._with_beacons(after)
        if after.bank is None or after.nominal is None:
            self._close()
        elif before.bank is None or before.nominal is None:
            self._open()
        elif after.bank is not before.bank:
            self._account(before, record, outputs)

    def end(self) -> None:
        """Carry the filter to the end of the nominal trajectory."""
        state = self._state
        if not self.runs or not self.runs[-1] or state.bank is None or state.nominal is None:
            return
        nominal = state.nominal
        if nominal.pending_s > 0.0:
            n = len(self._Q)
            Phi, Q = self._model.transition(nominal, len(state.beacons))
            Phi, Q = Phi[:n, :n], Q[int(state.bank.grade[0]), :n, :n]
            x, P = state.bank.x[0, :n], state.bank.P[0, :n, :n]
            self._Phi, self._Q = Phi @ self._Phi, Phi @ self._Q @ Phi.T + Q
            self._append(nominal.point, Phi @ x, Phi @ P @ Phi.T + Q, Phi @ x)

    def _tune(self, record: Tuning) -> None:
        before = self._settings
        config = self._with_gusts(parse(record.toml, "parameters in the log"))
        self._settings, state = tuned(self._state, before, config)
        grade = self._model.grade
        if self._state.bank is not None and config.gnss.latency_s != before.config.gnss.latency_s:
            keep, variance = np.ones(len(self._Q)), np.zeros(len(self._Q))
            self._forget_receiver(keep, variance)
            self._Phi, self._Q = _forgotten(self._Phi, self._Q, keep, variance)
        if begins_again(before.config, config):  # the next run brings its grade
            self.end()
            self._close()
            grade = 0
        self._model = _PlainModel(self._settings.config, grade, len(self._beacons))
        self._settings = self._settings._replace(model=self._model)
        self._state = state if state.bank is not None else self._with_beacons(state)

    def _with_gusts(self, config: Config) -> Config:
        """With the gusts that the flight shows."""
        if self.gusts is None:
            return config
        gusts = {"gust_m_s": self.gusts.sigma, "gust_s": self.gusts.correlation_s}
        return structs.replace(config, air_data=structs.replace(config.air_data, **gusts))

    def _with_beacons(self, state: State) -> State:
        """With the beacons of the whole flight, as long as there is no bank."""
        return structs.replace(state, beacons=self._beacons)

    def _close(self) -> None:
        if self.runs and self.runs[-1]:
            self.runs.append([])

    def _open(self) -> None:
        """The first fix: a run begins behind it."""
        assert self._state.bank is not None
        assert self._state.nominal is not None
        n = hypotheses(self._state, self._settings).layout.n_base
        self._Phi, self._Q = np.eye(n), np.zeros((n, n))
        x, P = self._state.bank.x[0, :n], self._state.bank.P[0, :n, :n]
        first = _Epoch(levelled(self._state.nominal.point, self._state), x, P, x, self._Phi, self._Q, True)
        self.runs.append([first])

    def _account(self, before: State, record: Input, outputs: list[Output]) -> None:
        """Keep Phi and Q up to the bank's time; and an epoch wherever it was carried."""
        state, n = self._state, len(self._Q)
        assert before.bank is not None
        assert before.nominal is not None
        assert state.bank is not None
        assert state.nominal is not None
        x, P = state.bank.x[0, :n], state.bank.P[0, :n, :n]
        Phi, Q, point, predicted = np.eye(n), np.zeros((n, n)), before.nominal.point, before.bank.x[0, :n]
        if (new := self._other_airspeed(before)) is not None:
            Phi, Q, predicted = new.F, new.D, new.F @ predicted + new.c
        for (A, B), reached in self._model.asked:
            A, B = A[:n, :n], B[int(state.bank.grade[0]), :n, :n]
            Phi, Q, point, predicted = A @ Phi, A @ Q @ A.T + B, reached, A @ predicted
        measured = True
        keep, variance = self._renewed(before, n)
        if not keep.all():
            predicted, (Phi, Q) = keep * predicted, _forgotten(Phi, Q, keep, variance)
        is_widened = isinstance(record, TimeStep) or any(isinstance(output, Reset) for output in outputs)
        opened = np.zeros(n)
        if isinstance(record, Gnss | RsbnFix):
            # the fix may have moved the nominal trajectory, and its error with it
            predicted = predicted + np.pad(_moved(point, state.nominal.point), (0, n - 4))
            if is_widened:  # behind the measurement: what comes after shows nothing of the position before
                ahead = Phi @ before.bank.P[0, :n, :n] @ Phi.T + Q
                opened[:2] = (P - ahead).diagonal()[:2]
        elif not self._measures(before, record):
            measured, predicted = False, x
            if is_widened:  # perhaps, if the INS jumped
                P_before = before.bank.P[0, :n, :n]
                Q = P - Phi @ P_before @ Phi.T
        self._Phi, self._Q = Phi @ self._Phi, Phi @ self._Q @ Phi.T + Q
        if measured or self._model.asked:
            self._append(
                state.nominal.point, x, P - np.diag(opened), predicted, isinstance(record, Gnss | RsbnFix)
            )
            self._Q += np.diag(opened)

    def _measures(self, before: State, record: Input) -> bool:
        """Whether a record besides the fixes may have been a measurement: not if it changes the driver."""
        if driver(before) != driver(self._state):
            return False
        if isinstance(record, Imu | Attitude):  # of a multirotor's drag, of a steady airspeed
            return self._state.sensors.measured_ns != before.sensors.measured_ns
        own_position = isinstance(record, LocalPosition) and not self._settings.config.has_own_ins
        return own_position or isinstance(record, MEASURING)

    def _renewed(self, before: State, n: int) -> tuple[Floats, Floats]:
        """Zeros (n,) for states forgotten by a beacon that moved or took the place of another, and by another
        receiver; ones for the others; and new variances (n,).
        """
        keep, variance = np.ones(n), np.zeros(n)
        known, state = hypotheses(self._state, self._settings), self._state
        for k, (a, b) in enumerate(zip(before.beacons, state.beacons, strict=True)):
            if (a.identity, a.place) != (b.identity, b.place):
                at = slice(known.bias(k), known.bias(k + 1))
                keep[at], variance[at] = 0.0, np.square(known.biases[BIASES * k : BIASES * (k + 1)])
        last, now = before.gnss_taken, state.gnss_taken
        if last is not None and now is not None and last.receiver != now.receiver:
            self._forget_receiver(keep, variance)
        return keep, variance

    def _forget_receiver(self, keep: Floats, variance: Floats) -> None:
        channel = self._settings.model.channel
        at = receiver_states(channel)
        keep[at], variance[at] = 0.0, channel.prior()[0].diagonal()[at]

    def _other_airspeed(self, before: State) -> Renewal | None:
        """What began again because the velocity through the air is taken from something else now."""
        was, now = _interval(before), _interval(self._state)
        if was is None or now is None or was.airspeed == now.airspeed:
            return None
        return renewal(now.airspeed, before, self._settings)

    def _append(self, point: Point, x: Floats, P: Floats, predicted: Floats, fixed: bool = False) -> None:
        """Append an epoch, or merge it into the last one: a second measurement at the same instant."""
        epochs, n = self.runs[-1], len(x)
        unmoved = not self._Q.any() and (self._Phi == np.eye(n)).all()
        at_once = unmoved and point.t_ns <= epochs[-1].point.t_ns
        point = levelled(point, self._state)
        if at_once:
            last = epochs.pop()
            moved = predicted - last.x  # by feedback
            epochs.append(_Epoch(point, x, P, last.predicted + moved, last.Phi, last.Q, fixed or last.fixed))
        else:
            epochs.append(_Epoch(point, x, P, predicted, self._Phi, self._Q, fixed))
        self._Phi, self._Q = np.eye(n), np.zeros((n, n))


def _forgotten(Phi: Floats, Q: Floats, keep: Floats, variance: Floats) -> tuple[Floats, Floats]:
    """Phi and Q behind which some states (zeros of `keep`) begin again with a variance."""
    return keep[:, None] * Phi, Q * np.outer(keep, keep) + np.diag(variance)


def _interval(state: State) -> own_error_model.Interval | None:
    return state.nominal.interval if state.nominal else None


def _moved(before: Point, after: Point) -> Floats:
    """How far the nominal trajectory was moved at once: north, east (m), velocity north, east (m/s)."""
    north, east, _ = separation(after.position, before.position)
    return np.array((north, east, after.v_n[0] - before.v_n[0], after.v_n[1] - before.v_n[1]))


# ---------------------------------------------------------------------------------------------------------
# Backward
# ---------------------------------------------------------------------------------------------------------


def _rts_smooth(epochs: list[_Epoch]) -> SmoothedRun:
    """Run the backward pass over one run."""
    x_filter = np.array([epoch.x for epoch in epochs])
    P_filter = np.array([epoch.P for epoch in epochs])
    later = epochs[1:]
    x, P = rts_backward(
        x_filter, P_filter, [e.predicted for e in later], [e.Phi for e in later], [e.Q for e in later]
    )
    places = [displace(*p.point.position, -e[0], -e[1], 0.0) for p, e in zip(epochs, x.tolist(), strict=True)]
    lat, lon, alt = np.array(places).T
    t_ns = np.array([epoch.point.t_ns for epoch in epochs], dtype=np.int64)
    return SmoothedRun(t_ns, lat, lon, alt, x, P, x_filter, P_filter)


# ---------------------------------------------------------------------------------------------------------
# Check
# ---------------------------------------------------------------------------------------------------------

_RANK = 1e-9  # a measurement reduces the variance of some direction by at least this share


def _apart(run: SmoothedRun, epochs: list[_Epoch]) -> float:
    """Solve the run again as the two-point problem (6.4.12); the greatest distance to `run`, in sigmas.

    The steps of the nominal trajectory between epochs are known inputs, and taken off first: `offset`. The
    measurements of an epoch enter as what they did to the filter: K S K' = P_{k|k-1} - P_k is L L' with few
    columns, so that H = L' P_{k|k-1}^-1 with S = I is a measurement that does the same.
    """
    n = len(epochs[0].x)
    offset, offsets = np.zeros(n), [np.zeros(n)]
    H, R, z = list[Floats | None](), list[Floats | None](), list[Floats | None]()
    for before, epoch in itertools.pairwise(epochs):
        offset = epoch.Phi @ offset + epoch.predicted - epoch.Phi @ before.x
        offsets.append(offset)
        P = epoch.Phi @ before.P @ epoch.Phi.T + epoch.Q
        row = _equivalent_measurement(P, epoch.P, epoch.predicted - offset, epoch.x - offset)
        for each, value in zip((H, R, z), row, strict=True):
            each.append(value)
    later = epochs[1:]
    Phi, Q = [e.Phi for e in later], [e.Q for e in later]
    found = two_point(LinearSystem.of(Phi, [np.eye(n)] * len(later), Q, H, R, z, epochs[0].x, epochs[0].P))
    distance = np.abs(found.x + np.array(offsets) - run.x)[:, :2]
    return float((distance / np.sqrt(np.einsum("ijj->ij", found.P[:, :2, :2]))).max())


def _equivalent_measurement(
    P: Floats, P_after: Floats, x: Floats, x_after: Floats
) -> tuple[Floats | None, Floats | None, Floats | None]:
    """H, R, z with unit innovation covariance that take (x, P) to (x_after, P_after); None without one."""
    scale = np.sqrt(np.where(P.diagonal() > 0.0, P.diagonal(), 1.0))
    values, vectors = np.linalg.eigh((P - P_after) / np.outer(scale, scale))
    kept = values > _RANK
    if not kept.any():
        return None, None, None
    L = vectors[:, kept] * np.sqrt(values[kept])  # of the states in units of `scale`
    H = np.linalg.lstsq(P / np.outer(scale, scale), L, rcond=None)[0].T
    nu = np.linalg.lstsq(L, (x_after - x) / scale, rcond=None)[0]
    H = H / scale
    R = np.eye(len(H)) - H @ P @ H.T
    return H, 0.5 * (R + R.T), nu + H @ x
