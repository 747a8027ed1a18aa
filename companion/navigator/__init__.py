"""Navigator: records in, records out; no clock and no input or output.

`Navigator` folds `step` over the records. A measurement that arrives late is applied at its own time: the
states of the last seconds are kept, the navigator goes back to the one before it and folds forward again.
With each record that arrives only a few are folded again, so that none waits long; until that has caught up
the solutions come from a second state, without the late ones. Solutions that were already returned stay; a
late measurement shows in the first one after that.
"""

from __future__ import annotations

from bisect import insort
from collections import deque
from collections.abc import Callable
from typing import Any, NamedTuple, TypeGuard

from msgspec import structs

from companion.config import Config, ConfigError, parse
from companion.estimate import bank as banks
from companion.navigator import kept_state, minimax_bound
from companion.navigator.bounded_trajectory import is_bound_due, refresh_bound, resolve_pending
from companion.navigator.changes import Changes
from companion.navigator.fixes import is_too_soon
from companion.navigator.hypotheses import Model
from companion.navigator.measurements import other_receiver
from companion.navigator.own_channel import OwnChannel
from companion.navigator.past_states import PastStates
from companion.navigator.progress import SILENT_INS_NS, births_due, with_births
from companion.navigator.receiver_choice import ReceiverChoice
from companion.navigator.solution import solve
from companion.navigator.stale_data import REPORT_EVERY, StaleDataDetector
from companion.navigator.state import Settings, State, Step, afresh
from companion.navigator.step import INPUTS_USED, uses
from companion.plausibility import ImplausibleField, implausible_field
from companion.records import (
    Event,
    Gnss,
    Input,
    Output,
    Rejection,
    Reset,
    Resumed,
    RsbnFix,
    Severity,
    Solution,
    Stamped,
    Tuning,
)
from companion.units import SECOND_NS

__all__ = ["INPUTS_USED", "Navigator"]

#: With each record that arrives at most so many are folded again, and so many fixes (2 ms each, 5 ms where
#: they contradict others): a usual delay of a beacon at once, 5 s within half a second. Fewer than two would
#: not catch up.
MOST_AGAIN, MOST_FIXES = 16, 2
#: Stamps in ms are behind those in us of the same instant by up to this: such a record is not late.
TICK_NS = 1_000_000
#: After a roll-back by t seconds for beacon answers, all of which were rejected, none that is older than
#: CHEAP_NS is used for USELESS_TIMES t: forged ones would take the time of all others.
USELESS_TIMES, CHEAP_NS = 2, 500_000_000
MOST_WAITING = 1024  # late records, for the next roll-back: what a link that is late by six seconds delivers
#: Late samples wait for those behind them, this share of their lateness: each roll-back folds all that came
#: since again, and what a link delivers after a delay of seconds is hundreds of samples. By waiting none
#: becomes older than a silence of the channel.
PATIENCE, MOST_AGE_NS = 0.25, SILENT_INS_NS - SECOND_NS // 10


class _Again(NamedTuple):
    record: Input
    is_late: bool  # its outputs were not returned before


class _RollBack:
    """Records to fold again, in order of time, and the state that solutions come from meanwhile."""

    def __init__(self, ahead: State, again: list[_Again]) -> None:
        self.ahead = ahead
        self.again = deque(again)
        self.back_ns = again[-1].record.t_ns - next(each.record.t_ns for each in again if each.is_late)
        self.used: set[bool] = set()  # whether beacon answers older than CHEAP_NS were used


def _time(again: _Again) -> int:
    return again.record.t_ns


def _is_old_answer(record: Input) -> TypeGuard[RsbnFix]:
    return isinstance(record, RsbnFix) and record.rx_ns - record.t_ns > CHEAP_NS


class Navigator:
    """One aircraft's navigator: `handle` every record in the order of arrival.

    `model` replaces the hypotheses that follow from the configuration, for studies.
    """

    def __init__(self, config: Config, model: Model | None = None) -> None:
        self._settings = Settings(config, model or Model(config))
        self._uses = uses(self._settings)
        self._state = State()  # after the last of `_past`
        self._past = PastStates()
        self._newest: Input | None = None  # the last record that was not late
        self._roll_back: _RollBack | None = None
        self._waiting: list[Input] = []  # late records, until the next roll-back
        self._roll_back_ns = 0  # when that begins
        self._no_late_answers_ns = 0  # until when none is used: the last ones were all rejected
        self._deferred: list[Output] = []  # outputs of deferred updates, for the next `handle`
        self._late_ns = round(1e9 * config.estimator.late_s)
        self._gnss_latency_ns = round(1e9 * config.gnss.latency_s)
        self._stale_data = StaleDataDetector()
        self._receivers = ReceiverChoice(config)
        self._last_fix: Gnss | None = None  # the last new one, used or not
        self._last_solution_ns = 0
        self._rejected_ns: dict[str, int] = {}  # when an implausible record was last reported, by kind
        self._channel_reported = False
        self._changes = Changes()
        self._is_settled = False  # whether the last record left nothing to do

    @property
    def state(self) -> State:
        """The state after the last record; while records are folded again, without the late ones."""
        return self._state if self._roll_back is None else self._roll_back.ahead

    @property
    def settings(self) -> Settings:
        """The settings in force."""
        return self._settings

    def handle(self, record: Stamped) -> list[Output]:
        """Return the outputs of one more record; there are none of a kind that is not used."""
        if isinstance(record, Tuning):
            self._tune(record)
            return []
        if isinstance(record, Resumed):
            return self._resume(record) + self._with_events([], record)
        if not self._is_used(record):
            return []
        if not self._channel_reported:
            self._channel_reported = True
            return [_channel_event(record, self._settings), *self.handle(record)]
        if (fault := implausible_field(record)) is not None:
            return self._reject_implausible(record, fault)
        if isinstance(record, Gnss) and self._gnss_latency_ns:
            record = structs.replace(record, t_ns=record.t_ns - self._gnss_latency_ns)
        stale = self._stale_data.judge(record)
        if stale is not None:
            if stale:
                self._changes.of_stale(record)
            return stale
        self.settle()
        if isinstance(record, Gnss):
            is_used, changes = self._receivers.takes(record)
            self._deferred += changes
            if not is_used or not self._is_wanted(record):
                return []
        self._is_settled = False
        outputs, self._deferred = self._deferred, []
        late_ns = 0 if self._newest is None else self._newest.t_ns - record.t_ns
        if 0 < late_ns <= TICK_NS:
            record, late_ns = structs.replace(record, t_ns=record.t_ns + late_ns), 0
        if late_ns > 0:
            outputs += self._queue_late(record)
        outputs += self._fold_again(record)
        if late_ns <= 0:
            outputs += self._take(record)
        return self._with_events(outputs, record)

    def settle(self) -> None:
        """Do the deferred update of the last record and drop old states: no answer waits for this.

        `handle` does it first if it was not done in between; its outputs come with the next `handle`.
        """
        if self._newest is None or self._is_settled:
            return
        self._is_settled = True
        if self._roll_back is not None:
            self._roll_back.ahead, outputs = self._resolved(self._roll_back.ahead, self._newest)
        else:
            self._state, outputs = self._resolved(self._state, self._newest)
        self._deferred += outputs
        self._past.thin_out()
        if not self._waiting:
            self._past.keep_last(self._late_ns)

    @property
    def births_due(self) -> bool:
        """Whether hypotheses are to be born or reduced: the next measurement does it if `bear` does not."""
        return births_due(self.state, self._settings)

    def bear(self) -> None:
        """Do half of the births that are due: 3 ms in which no answer waits. It changes no output."""
        if self._newest is None or not self.births_due:
            return
        state, outputs = guarded(self.state, self._newest, self._settings, with_births, self._newest)
        self._deferred += outputs
        if self._roll_back is not None:
            self._roll_back.ahead = state
        else:
            self._state = state

    def finish(self) -> None:
        """Fold all late records: before other parameters, and at the end of a log."""
        self.settle()
        self._roll_back_ns = 0
        while self._newest is not None and (self._waiting or self._roll_back is not None):
            self._deferred += self._fold_again(self._newest)

    def _is_used(self, record: Stamped) -> TypeGuard[Input]:
        return type(record) in self._uses

    def _is_wanted(self, record: Gnss) -> bool:
        """Whether a fix is new, and would be used: most are late, and each costs a roll-back.

        An autopilot repeats its receiver's last one.
        """
        last = self._last_fix
        if last is not None and last.receiver == record.receiver and record.repeats(last):
            return False
        self._last_fix = record
        return record.has_3d_fix and not is_too_soon(record, self.state, self._settings)

    def _reject_implausible(self, record: Input, fault: ImplausibleField) -> list[Output]:
        """Report it once a second."""
        name = type(record).__name__
        if record.rx_ns - self._rejected_ns.get(name, -REPORT_EVERY) < REPORT_EVERY:
            return []
        self._rejected_ns[name] = record.rx_ns
        return [fault.rejection(record)]

    def _resolved(self, state: State, record: Input) -> Step:
        """Do the deferred update left by `record`, the last one of `state`.

        The fix is added to the window of the guaranteed bound, and one piece of that bound's work is done.
        """
        pending, outputs = state.pending, list[Output]()
        if pending is not None:
            state = structs.replace(state, pending=None)
            state, outputs = guarded(state, pending.record, self._settings, resolve_pending, pending)
        if is_bound_due(state):
            state, more = guarded(state, record, self._settings, refresh_bound, record)
            outputs = [*outputs, *more]
        return state, outputs

    def _take(self, record: Input) -> list[Output]:
        """Return what follows from a record that is not late."""
        self._newest, back = record, self._roll_back
        if back is None:
            outputs = self._fold(record)
            self._state, solution = self._solved_after(self._state, record)
        else:
            back.again.append(_Again(record, False))
            back.ahead, outputs = self._stepped(back.ahead, record)
            back.ahead, solution = self._solved_after(back.ahead, record)
        return outputs + solution

    def _fold(self, record: Input) -> list[Output]:
        self._past.append(record, self._state)
        self._state, outputs = self._stepped(self._state, record)
        return outputs

    def _stepped(self, state: State, record: Input) -> Step:
        return guarded(state, record, self._settings, self._uses[type(record)], record)

    def _solved_after(self, state: State, record: Input) -> Step:
        """A solution at once after a beacon's fix."""
        if not isinstance(record, RsbnFix) or state.rsbn_ns != record.t_ns:
            return state, []
        return self._solved(state, record)

    def _solved(self, state: State, record: Input) -> Step:
        return guarded(state, record, self._settings, _solve, record)

    def _tune(self, record: Tuning) -> None:
        """Go on with another configuration; late measurements are no longer applied from before it."""
        config = parse(record.toml, "parameters")
        self.finish()
        before = self._settings
        self._settings, self._state = tuned(self._state, before, config)
        self._uses = uses(self._settings)
        self._receivers = self._receivers.tuned(config)
        self._late_ns = round(1e9 * config.estimator.late_s)
        self._gnss_latency_ns = round(1e9 * config.gnss.latency_s)
        same = config.has_own_ins == before.config.has_own_ins
        self._channel_reported = self._channel_reported and same
        self._past.forget()

    def _resume(self, record: Resumed) -> list[Output]:
        """Go on with the state of the run before, or report why not."""
        try:
            before = Settings.of(parse(record.toml, "the run before"))
            state = kept_state.decode(record.state, before)
            if begins_again(before.config, self._settings.config):
                raise ValueError("it is of another inertial channel")
            assert state.nominal is not None
            age_s, limit_s = (record.t_ns - state.nominal.t_ns) * 1e-9, kept_state.MOST_AGE_S
            if not 0.0 <= age_s <= limit_s:
                raise ValueError(f"it is {age_s:.0f} s old, and the limit is {limit_s:.0f} s")
        except (ConfigError, ValueError) as error:
            text = f"the state of the run before is not used: {error}"
            return [Event(record.t_ns, record.rx_ns, Severity.NOTICE, text)]
        self.finish()
        _, self._state = tuned(state, before, self._settings.config)
        self._past.forget()
        text = f"navigation goes on after a restart, {age_s:.1f} s later"
        return [Event(record.t_ns, record.rx_ns, Severity.NOTICE, text)]

    def _queue_late(self, record: Input) -> list[Output]:
        """Let a late record join the roll-back in progress or wait for the next one, or reject it."""
        assert self._newest is not None
        if record.t_ns < max(self._past.first_ns, self._newest.t_ns - self._late_ns):
            return self._too_late(record)
        if _is_old_answer(record) and record.rx_ns < self._no_late_answers_ns:
            why = "late, and the last late answers were rejected: not used"
            age, limit = (record.rx_ns - record.t_ns) * 1e-9, CHEAP_NS * 1e-9
            return [Rejection(record.t_ns, record.rx_ns, f"rsbn {record.beacon}", why, age, limit)]
        back = self._roll_back
        if back is not None and record.t_ns >= self._past.last_ns:
            insort(back.again, _Again(record, True), key=_time)
        elif len(self._waiting) < MOST_WAITING:
            due_ns = record.rx_ns + self._patience(record, self._newest.t_ns - record.t_ns)
            self._roll_back_ns = min(self._roll_back_ns, due_ns) if self._waiting else due_ns
            self._waiting.append(record)
        else:
            why = f"more than {MOST_WAITING} late records wait: not used"
            return [Rejection(record.t_ns, record.rx_ns, type(record).__name__, why)]
        return []

    def _patience(self, record: Input, late_ns: int) -> int:
        """How long a late record may wait: a fix only if it is old and samples wait already."""
        if isinstance(record, Gnss | RsbnFix) and (late_ns < CHEAP_NS or not self._waiting):
            return 0
        wait_ns = round(PATIENCE * late_ns)
        return wait_ns if late_ns > MOST_AGE_NS else min(wait_ns, MOST_AGE_NS - late_ns)

    def _begin_roll_back(self) -> list[Output]:
        """Go back to the state before the oldest waiting record."""
        outputs: list[Output] = []
        late, self._waiting = sorted(self._waiting, key=lambda record: record.t_ns), []
        while late and late[0].t_ns < self._past.first_ns:  # dropped while they waited
            outputs += self._too_late(late.pop(0))
        if late:
            before, later = self._past.back_to(late[0].t_ns)
            again = [_Again(record, False) for record in later]
            again += [_Again(record, True) for record in late]
            # a stable sort: of equal times the late one comes last
            self._roll_back = _RollBack(self._state, sorted(again, key=_time))
            self._state = self._rewound(before)
        return outputs

    def _fold_again(self, now: Input) -> list[Output]:
        """Fold some of the records behind late ones; return the outputs of the late ones alone."""
        outputs: list[Output] = []
        if self._waiting and self._roll_back is None and now.rx_ns >= self._roll_back_ns:
            outputs = self._begin_roll_back()
        back, fixes = self._roll_back, 0
        if back is None:
            return outputs
        for _ in range(min(MOST_AGAIN, len(back.again))):
            fixes += isinstance(back.again[0].record, Gnss | RsbnFix)
            if fixes > MOST_FIXES:
                break
            record, is_late = back.again.popleft()
            found = self._fold(record)
            self._state, resolved = self._resolved(self._state, record)
            if is_late:
                if _is_old_answer(record):
                    back.used.add(self._state.rsbn_ns == record.t_ns)
                outputs += self._not_superseded(found, now.rx_ns)
                outputs += resolved
        return outputs if back.again else outputs + self._end_roll_back(back, now)

    def _not_superseded(self, found: list[Output], now_ns: int) -> list[Output]:
        """The outputs of a late record, without solutions older than the last one; others are of `now_ns`."""
        outputs = list[Output]()
        for out in found:
            if not isinstance(out, Solution):
                outputs.append(out)
            elif out.t_ns > self._last_solution_ns:
                outputs.append(structs.replace(out, rx_ns=now_ns))
        return outputs

    def _end_roll_back(self, back: _RollBack, now: Input) -> list[Output]:
        """Let solutions come from the state with the late records; the first at once if it has a new fix."""
        self._roll_back = None
        if back.used == {False}:
            self._no_late_answers_ns = now.rx_ns + USELESS_TIMES * back.back_ns
        if self._state.rsbn_ns == back.ahead.rsbn_ns:
            return []
        self._state, outputs = self._solved(self._state, now)
        return outputs

    def _too_late(self, record: Input) -> list[Output]:
        """Reject it."""
        assert self._newest is not None
        age, limit = (self._newest.t_ns - record.t_ns) * 1e-9, self._late_ns * 1e-9
        name = type(record).__name__
        why = "late: not used" if age > limit else "older than the oldest kept state: not used"
        return [Rejection(record.t_ns, record.rx_ns, name, why, age, limit)]

    def _rewound(self, before: State) -> State:
        """An earlier state to fold forward from, keeping the latest forecast of the predictor.

        Of another program of fixes it is due again.
        """
        now, then = self._state.guarantee, before.guarantee
        answers = now.answers
        if then.anchored is None or then.anchored is not now.anchored:
            answers = tuple(a and a._replace(sought_ns=min(a.sought_ns, then.fixed_ns)) for a in answers)
        return structs.replace(before, guarantee=then._replace(answers=answers))

    def _with_events(self, outputs: list[Output], record: Input) -> list[Output]:
        """Add an event for each change of the state that leads, and of the solutions' mode."""
        found = self._changes.of_state(self.state, record, self._settings)
        for output in outputs:
            found.append(output)
            if isinstance(output, Solution):
                self._last_solution_ns = output.t_ns
                found += self._changes.of_mode(output)
        return found


def _solve(state: State, record: Input, settings: Settings) -> Step:
    return solve(state, record.rx_ns, settings)


def tuned(state: State, before: Settings, config: Config) -> tuple[Settings, State]:
    """Return the settings of another configuration, and the state to go on with.

    What a ground station sets keeps the estimate: without fixes there would be no other.
    """
    settings, old = Settings.of(config), before.config
    if begins_again(old, config):
        return settings, afresh(state)
    state = structs.replace(
        state,
        guarantee=minimax_bound.tuned(state.guarantee),
        parallel=state.parallel if config.estimator == old.estimator else None,
    )
    if config.gnss.latency_s != old.gnss.latency_s and state.bank is not None:
        state = structs.replace(state, bank=other_receiver(state.bank, settings.model.channel))
    return settings, state


def begins_again(old: Config, new: Config) -> bool:
    """Return whether the states of the bank mean something else: those of another inertial channel."""
    return (old.inertial, old.strapdown, old.has_own_ins) != (new.inertial, new.strapdown, new.has_own_ins)


def guarded(
    state: State, record: Input, settings: Settings, follow: Callable[[State, Any, Settings], Step], x: Any
) -> Step:
    """Return what follows from x; a numerical error rejects the record, a broken bank is reset."""
    try:
        after, outputs = follow(state, x, settings)
    except (ArithmeticError, ValueError) as error:  # a singular matrix is a ValueError too
        why = f"cannot be computed with: {error}"
        return state, [Rejection(record.t_ns, record.rx_ns, type(record).__name__, why)]
    if after.bank is not None and after.bank is not state.bank and not banks.is_sound(after.bank):
        why = "covariance not positive definite: error state reset"
        outputs = [*outputs, Reset(record.t_ns, record.rx_ns, "bank", why)]
        after = afresh(after)
    return after, outputs


def _channel_event(record: Input, settings: Settings) -> Event:
    """Report which inertial channel is corrected: before its first sample, so what it may use."""
    if isinstance(settings.model.channel, OwnChannel):
        config = settings.config
        allowed: list[str] = [name for name in ("imu", "air_data") if config.uses(name)]
        allowed += ["velocity of the autopilot's local position"] * config.uses_local_velocity
        text = f"inertial channel: own, by what arrives of {', '.join(a.replace('_', ' ') for a in allowed)}"
        if "imu" in allowed:
            text += "; guaranteed bound by airspeed" if "air_data" in allowed else "; no guaranteed bound"
    else:
        text = "inertial channel: local position of an INS of its own"
    return Event(record.t_ns, record.rx_ns, Severity.INFO, text)
