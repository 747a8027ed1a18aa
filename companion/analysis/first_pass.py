"""First pass of a smoother: what the bank of hypotheses decided in a flight, as known at its end.

The records go through the navigator's own step, and its decisions are noted: which sources were false and
from when on, also where only the end of it shows it, when the wind jumped, which grade of noise was right,
and which records were rejected. Airspeed and GNSS velocity show how strong the gusts were and how long they
lasted (`analysis.gusts`). It makes no solutions, on which no decision rests.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from msgspec import structs

from companion.analysis.gusts import GustSamples
from companion.config import Config
from companion.estimate import bank as banks
from companion.estimate.bank import Bank, Jump
from companion.navigator import Navigator, own_channel
from companion.navigator.hypotheses import VELOCITY, Hypotheses
from companion.navigator.state import Beacon, State, Step, hypotheses, source_name
from companion.records import Gnss, Input, Output, Rejection, Resumed, RsbnFix, Stamped, Tuning
from companion.units import SECOND_NS

NEVER_NS = 2**63 - 1
SAME_TIME_NS = 300_000_000  # in a turn the air velocity changes by less than 2 m/s
APART_NS = 5 * SECOND_NS  # hypotheses of one jump differ by less


class Jumped(NamedTuple):
    """Time and kind of a jump."""

    t_ns: int
    jump: Jump

    def is_of(self, other: Jumped) -> bool:
        """Whether both are hypotheses of one jump."""
        return self.jump.name == other.jump.name and abs(self.t_ns - other.t_ns) <= APART_NS


class _Onset(NamedTuple):
    """Since when the heaviest row that holds a fault held it, as known at `t_ns`."""

    t_ns: int
    since_ns: int


class Folded(NamedTuple):
    """A record that the navigator took up, of which run, and the sources in it that were rejected."""

    record: Input
    run: int
    rejected: frozenset[str]

    @property
    def has_rejected_position(self) -> bool:
        """Whether it is a position of a receiver that was rejected."""
        return isinstance(self.record, Gnss) and f"gnss {self.record.receiver}" in self.rejected


class FirstPass(Navigator):
    """A navigator that notes what its bank decided."""

    def __init__(self, config: Config) -> None:
        super().__init__(config)
        self._state = State(next_ns=NEVER_NS)
        self.folded: list[Folded] = []
        self.gusts = GustSamples()
        self._spans: dict[str, list[tuple[int, int]]] = {}  # when each source was false, by name
        self.jumps: list[Jumped] = []
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
        self.folded.append(Folded(record, len(self._last) - 1, rejected))
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
                self._spans.setdefault(name, []).append((first.since_ns, t_ns))

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
        found = Jumped(bank_ns - _age(bank, best), layout.jumps[j])
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
                spans = self._spans.setdefault(source_name(i, state), [])
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
            self._spans.setdefault(name, []).append((onset.since_ns, t_ns))
        self._open.clear()

    def end(self) -> None:
        """Fold what waits, and close what is still open."""
        self.finish()
        self._close(NEVER_NS)

    def believed(self, folded: Folded) -> Input | None:
        """A record without what was false, or a velocity or sight that was rejected; None if nothing is left.

        A position that was rejected is left to the plain filter: of a run of them the position is restarted.
        """
        record, rejected = folded.record, folded.rejected
        if isinstance(record, Gnss):
            if self._was_false("gnss", record.t_ns):
                return None
            false = self._was_false("velocity of gnss", record.t_ns)
            false = false or f"velocity of gnss {record.receiver}" in rejected
            return structs.replace(record, v_n=None) if false else record
        if not isinstance(record, RsbnFix):
            return record
        for part, empty in (("azimuth", {"azimuth": None}), ("range", {"slant_range": None})):
            name = f"rsbn {record.beacon} {part}"
            if name in rejected or self._was_false(name, record.t_ns):
                record = structs.replace(record, **empty)
        return None if record.azimuth is None and record.slant_range is None else record

    def _was_false(self, name: str, t_ns: int) -> bool:
        """Whether a source was false at a time, as known in the end."""
        return any(since <= t_ns < until for since, until in self._spans.get(name, ()))

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
