"""Fixed-interval smoothing of a flight: error of the nominal trajectory at every epoch, given all fixes.

A smoother needs one Gaussian path, so the flight is filtered twice by the navigator's own step. The first
pass is the flight: the bank of hypotheses gives which sources were false and from when on, also where only
the end of it shows it, when the wind jumped, and which grade of noise was right. Airspeed and GNSS velocity
show how strong the gusts were and how long they lasted (`analysis.gusts`). The second pass runs a plain
Kalman filter with that grade and those gusts: it leaves out what was false or an outlier, takes every other
fix, widens the wind where it jumped, and takes for all other jumps a random walk of their variance. Every
step of it is an epoch: at a measurement, or half a second after the last.

Backward pass: the recursion of Rauch, Tung and Striebel (1965), which does not need the (nonlinear)
measurements. With Phi, Q from one epoch to the next, x_{k+1|k} the prediction before the measurement,
P_{k+1|k} = Phi P_k Phi' + Q and C = P_k Phi' P_{k+1|k}^-1,

    x_{k|N} = x_k + C (x_{k+1|N} - x_{k+1|k})
    P_{k|N} = (I - C Phi) P_k (I - C Phi)' + C (P_{k+1|N} + Q) C'

The last epoch equals the filter. The track is the nominal trajectory minus its smoothed error; heights are
those of the filter. Memory grows linearly with the duration of the flight. The covariance is that of the
plain path alone: it knows nothing of the chance that the first pass decided wrongly.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from msgspec import structs

from companion.analysis.gusts import Gusts, GustSamples
from companion.config import Config, parse
from companion.estimate import bank as banks
from companion.estimate.bank import Bank, Jump
from companion.estimate.linear_system import LinearSystem
from companion.estimate.smoother import rts_backward, two_point
from companion.nav.geometry import displace, separation
from companion.navigator import (
    INPUTS_USED,
    Navigator,
    begins_again,
    guarded,
    own_channel,
    own_error_model,
    tuned,
)
from companion.navigator.air_velocity import Renewal, renewal
from companion.navigator.channel import Nominal, Transition
from companion.navigator.hypotheses import (
    BIASES,
    HEADING,
    MOST_BEACONS,
    MOST_WIDER,
    VELOCITY,
    Hypotheses,
    Model,
    Situation,
)
from companion.navigator.inertial_track import Point
from companion.navigator.measurements import receiver_states
from companion.navigator.progress import driver
from companion.navigator.state import Beacon, Settings, State, Step, hypotheses, levelled, source_name
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
    Rejection,
    Reset,
    Resumed,
    RsbnFix,
    SecondIns,
    Stamped,
    StarFix,
    TimeStep,
    Tuning,
)
from companion.units import SECOND_NS, Floats

NEVER_NS = 2**63 - 1
MEASURING = (AirData, RangeDifference, StarFix, SecondIns)  # besides fixes; AirData by itself too
SAME_TIME_NS = 300_000_000  # in a turn the air velocity changes by less than 2 m/s
APART_NS = 5 * SECOND_NS  # hypotheses of one jump differ by less


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
# First pass: what was false
# ---------------------------------------------------------------------------------------------------------


class _Jumped(NamedTuple):
    """Time and kind of a jump."""

    t_ns: int
    jump: Jump

    def is_of(self, other: _Jumped) -> bool:
        """Whether both are hypotheses of one jump."""
        return self.jump.name == other.jump.name and abs(self.t_ns - other.t_ns) <= APART_NS


class _Onset(NamedTuple):
    """Since when the heaviest row that holds a fault held it, as known at `t_ns`."""

    t_ns: int
    since_ns: int


class _Folded(NamedTuple):
    """A record that the navigator took up, at its own time, of which run, and the sources in it that were
    rejected.
    """

    t_ns: int
    record: Input
    run: int
    rejected: frozenset[str]


class _Witness(Navigator):
    """A navigator that notes what its bank decided. It makes no solutions, on which no decision rests."""

    def __init__(self, config: Config) -> None:
        super().__init__(config)
        self._state = State(next_ns=NEVER_NS)
        self.folded: list[_Folded] = []
        self.gusts = GustSamples()
        self.spans: dict[str, list[tuple[int, int]]] = {}  # when each source was false, by name
        self.jumps: list[_Jumped] = []
        self._onsets: dict[int, list[_Onset]] = {}  # of each fault, as they came up
        self.beacons: dict[int, Beacon] = {}
        self._last: list[tuple[Bank, Hypotheses] | None] = [None]  # of each run
        self._open: dict[str, _Onset] = {}  # of each source that is false now, as first known

    def handle(self, record: Stamped) -> list[Output]:
        """Return the outputs of one more record; what was flown before the log is not smoothed."""
        if isinstance(record, Resumed):
            return []
        outputs = super().handle(record)
        if isinstance(record, Tuning):
            self._note(record, [])
        return outputs

    def _fold(self, record: Input) -> list[Output]:
        outputs = super()._fold(record)
        self._note(record, outputs)
        return outputs

    def _begin_roll_back(self) -> list[Output]:
        """Drop what is folded again, behind a fix that `gnss.latency_s` makes late."""
        past = len(self._past)
        outputs = super()._begin_roll_back()
        del self.folded[len(self.folded) - (past - len(self._past)) :]
        return outputs

    def _resolved(self, state: State, record: Input) -> Step:
        return structs.replace(state, pending=None), []

    def _solved(self, state: State, record: Input) -> Step:
        return state, []

    def _note(self, record: Input, outputs: list[Output]) -> None:
        state, t_ns = self._state, record.t_ns
        if state.bank is None and self._last[-1] is not None:
            self._last.append(None)
        rejected = frozenset(o.source for o in outputs if isinstance(o, Rejection) and o.t_ns == t_ns)
        self.folded.append(_Folded(t_ns, record, len(self._last) - 1, rejected))
        if state.bank is None:
            self._close(t_ns)
            self._onsets.clear()  # another bank has other faults
            return
        known = hypotheses(state, self.settings)
        self._last[-1] = state.bank, known
        if isinstance(record, Gnss):
            self._note_gust(state, record)
        for beacon in state.beacons:
            self.beacons.setdefault(beacon.identity, beacon)
        assert state.nominal is not None
        bank_ns = state.nominal.since.t_ns
        self._note_false(state, state.bank, known, t_ns, bank_ns)
        self._note_jump(state.bank, known, bank_ns)
        self._note_end(state, state.bank, known, bank_ns)

    def _note_false(self, state: State, bank: Bank, known: Hypotheses, t_ns: int, bank_ns: int) -> None:
        for i, p in enumerate(state.false):
            name, onset = source_name(i, state), _Onset(bank_ns, bank_ns - _age_ns(bank, known, i))
            first = self._open.get(name)
            if bank.excluded[i] or p > known.settings.suspect:
                if first is None:
                    self._open[name] = onset
                elif _holds(bank, known, i) and onset.since_ns <= first.t_ns:  # later: the lie changed
                    self._open[name] = first._replace(since_ns=onset.since_ns)
            elif first is not None:
                del self._open[name]
                self.spans.setdefault(name, []).append((first.since_ns, t_ns))

    def _note_gust(self, state: State, record: Gnss) -> None:
        """Note air and ground velocity, if an airspeed that moves the aircraft is as new as the fix."""
        s, air = state.sensors, state.sensors.air.air
        if record.v_n is None or air is None or abs(record.t_ns - air.t_ns) > SAME_TIME_NS:
            return
        if state.reported and state.reported[VELOCITY]:
            return
        V = own_channel.air_velocity(s, air, state.nominal.point.position.alt) if state.nominal else None
        if V is not None and s.ground.flying and s.air_ns == air.t_ns:
            self.gusts.add(record.t_ns * 1e-9, V, record.v_n[:2])

    def _note_jump(self, bank: Bank, known: Hypotheses, bank_ns: int) -> None:
        """Note the jump that the heaviest row holds, if that is what happened to it last."""
        best, layout = int(np.argmax(bank.L)), known.layout
        j = int(bank.event[best]) - 1 - 2 * len(layout.faults)
        if j < 0:
            return
        found = _Jumped(bank_ns - _age(bank, best), layout.jumps[j])
        if not any(found.is_of(jumped) for jumped in self.jumps):
            self.jumps.append(found)

    def _note_end(self, state: State, bank: Bank, known: Hypotheses, bank_ns: int) -> None:
        """Note the fault that the heaviest row holds to be over, if that is what happened to it last.

        A lie that nothing contradicted while it lasted is known by its end.
        """
        faults, best = known.layout.faults, int(np.argmax(bank.L))
        f = int(bank.event[best]) - 1 - len(faults)
        if 0 <= f < len(faults):
            until = bank_ns - _age(bank, best)
            onsets = [onset.since_ns for onset in self._onsets.get(f, ()) if onset.t_ns < until]
            for i in faults[f].sources if onsets else ():
                spans = self.spans.setdefault(source_name(i, state), [])
                if all(abs(until - end) > APART_NS for _, end in spans):
                    spans.append((onsets[-1], until))
        for f in range(len(faults)):
            rows = np.flatnonzero(bank.event == 1 + f)
            if len(rows):
                onset = _Onset(bank_ns, bank_ns - _age(bank, rows[np.argmax(bank.L[rows])]))
                before = self._onsets.setdefault(f, [])
                if not before or abs(onset.since_ns - before[-1].since_ns) > APART_NS:
                    before.append(onset)

    def _close(self, t_ns: int) -> None:
        for name, onset in self._open.items():
            self.spans.setdefault(name, []).append((onset.since_ns, t_ns))
        self._open.clear()

    def end(self) -> None:
        """Fold what waits, and close what is still open."""
        self.finish()
        self._close(NEVER_NS)

    def was_false(self, name: str, t_ns: int) -> bool:
        """Whether a source was false at a time, as known in the end."""
        return any(since <= t_ns < until for since, until in self.spans.get(name, ()))

    def grade(self, run: int) -> int:
        """The grade that won in a run."""
        last = self._last[run]
        if last is None:
            return 0
        bank, known = last
        return int(np.argmax(banks.grade_probability(bank, known.layout)))


def _holds(bank: Bank, known: Hypotheses, source: int) -> bool:
    """Whether the last event of the heaviest row is that a source became false."""
    fault = int(bank.event[int(np.argmax(bank.L))]) - 1
    return 0 <= fault < len(known.layout.faults) and bool(known.layout.concerns[fault, source])


def _age_ns(bank: Bank, known: Hypotheses, source: int) -> int:
    """How long ago a source became false, by the heaviest row whose last event that was; else 0."""
    faults = np.flatnonzero(known.layout.concerns[:-1, source])
    rows = np.flatnonzero(np.isin(bank.event - 1, faults))
    if not len(rows):
        return 0
    return _age(bank, rows[np.argmax(bank.L[rows])])


def _age(bank: Bank, row: int) -> int:
    """How long ago the last event of a row was, ns."""
    return round((bank.t - float(bank.since[row])) * 1e9)


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
    fixed: bool = False


def _forward_pass(records: Iterable[Stamped], config: Config) -> _Path:
    """Filter the records by one plain path, and return it with the epochs of each run."""
    witness = _Witness(config)
    for record in sorted((r for r in records if isinstance(r, INPUTS_USED)), key=lambda r: r.t_ns):
        witness.handle(record)
    witness.end()
    path, run = _Path(config, witness), -1
    for folded in witness.folded:
        if folded.run != run:
            run = folded.run
            path.begin(run)
        path.jump(folded.t_ns)
        kept = _believed(folded, witness)
        if kept is not None:
            path.follow(kept, judged=_position(kept) not in folded.rejected)
    path.end()
    return path


def _believed(folded: _Folded, witness: _Witness) -> Input | None:
    """The record without what was false, or a velocity or sight that was rejected; None if nothing is left.

    A position that was rejected is left to the plain filter: of a run of them the position is restarted.
    """
    record, rejected = folded.record, folded.rejected
    if isinstance(record, Gnss):
        if witness.was_false("gnss", record.t_ns):
            return None
        false = witness.was_false("velocity of gnss", record.t_ns)
        false = false or f"velocity of {_position(record)}" in rejected
        return structs.replace(record, v_n=None) if false else record
    if not isinstance(record, RsbnFix):
        return record
    for part, empty in (("azimuth", {"azimuth": None}), ("range", {"slant_range": None})):
        name = f"rsbn {record.beacon} {part}"
        if name in rejected or witness.was_false(name, record.t_ns):
            record = structs.replace(record, **empty)
    return None if record.azimuth is None and record.slant_range is None else record


def _position(record: Input) -> str:
    """Name of the position of a receiver in a Rejection; empty for other records."""
    return f"gnss {record.receiver}" if isinstance(record, Gnss) else ""


class _Path:
    """The plain filter as it goes along, and its epochs.

    `_Phi`, `_Q`: from the last epoch to where the bank stands now.
    """

    def __init__(self, config: Config, witness: _Witness) -> None:
        self.runs: list[list[_Epoch]] = []
        self._witness, self.gusts = witness, witness.gusts.estimate()
        self._beacons = tuple(witness.beacons.values())[:MOST_BEACONS]
        self._jumps = sorted(witness.jumps, key=lambda jumped: jumped.t_ns)
        config = self._with_gusts(config)
        self._model = _PlainModel(config, 0, len(self._beacons))
        self._settings = Settings(config, self._model)
        self._state = self._with_beacons(State())
        self._Phi, self._Q = np.eye(0), np.eye(0)

    def begin(self, run: int) -> None:
        """Go on with the grade of another run."""
        self._model = _PlainModel(self._settings.config, self._witness.grade(run), len(self._beacons))
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
        grade, is_wider = self._model.grade, self._settings.model.channel.n != before.model.channel.n
        if self._state.bank is not None and config.gnss.latency_s != before.config.gnss.latency_s:
            keep, variance = np.ones(len(self._Q)), np.zeros(len(self._Q))
            self._forget_receiver(keep, variance)
            self._Phi, self._Q = _forgotten(self._Phi, self._Q, keep, variance)
        again = begins_again(before.config, config)
        if again or is_wider:
            self.end()
            self._close()
        if again:  # the next run brings its grade
            grade = 0
        self._model = _PlainModel(self._settings.config, grade, len(self._beacons))
        self._settings = self._settings._replace(model=self._model)
        self._state = state if state.bank is not None else self._with_beacons(state)
        if is_wider and state.bank is not None:
            self._open()

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
