"""Navigator: records in, records out; no clock and no input or output.

`Navigator` folds `step` over the records. A measurement that arrives late is applied at its own time: the
states of the last seconds are kept, the navigator goes back to the one before it and folds forward again.
Solutions that were already returned stay; a late measurement shows in the next one. Going back by t seconds
is done at most once in t / 10, for all records that arrived late in between: the work per second is bounded.
"""

from __future__ import annotations

from bisect import bisect_right
from collections import deque
from collections.abc import Callable
from typing import Any, NamedTuple

from msgspec import structs

from companion.config import Config, parse
from companion.estimate import bank as banks
from companion.navigator import minimax_bound
from companion.navigator.hypotheses import Model
from companion.navigator.own_channel import OwnChannel
from companion.navigator.receiver_choice import ReceiverChoice
from companion.navigator.solution import announce, is_bound_due, refresh_bound, resolve_pending, solve
from companion.navigator.stale_data import REPORT_EVERY, StaleDataDetector
from companion.navigator.state import FIXES, Settings, State, Step, initial, is_new_fix
from companion.navigator.step import INPUTS_USED, uses
from companion.plausibility import ImplausibleField, implausible_field
from companion.records import (
    Event,
    Gnss,
    Input,
    Mode,
    Output,
    Rejection,
    Reset,
    RsbnFix,
    Severity,
    Solution,
    Source,
    Tuning,
)

__all__ = ["INPUTS_USED", "Navigator"]

#: A roll-back takes 1 % of the time that it goes back: at most one in this share of it. Fewer are no help,
#: for more records wait: a flood of answers 5 s late delays TIMESYNC by 41 ms (p99) at 10, by 108 ms at 2.
ROLL_BACK_SHARE = 10
#: Stamps in ms are behind those in us of the same instant by up to this: such a record is not late.
TICK_NS = 1_000_000
#: After a roll-back by t seconds for beacon answers, all of which were rejected, none that is older than
#: CHEAP_NS is used for USELESS_TIMES t: forged ones would take the time of all others.
USELESS_TIMES, CHEAP_NS = 2, 500_000_000
#: Most late records that wait for the next roll-back, and most states kept (up to 0.2 MB each).
MOST_WAITING, MOST_KEPT = 64, 1024


class _Past(NamedTuple):
    t_ns: int
    record: Input
    before: State


class Navigator:
    """One aircraft's navigator: `handle` every record in the order of arrival.

    `model` replaces the hypotheses that follow from the configuration, for studies.
    """

    def __init__(self, config: Config, model: Model | None = None) -> None:
        self._settings = Settings(config, model or Model(config))
        self._uses = uses(self._settings)
        self._state = initial(self._settings)
        self._past: deque[_Past] = deque(maxlen=MOST_KEPT)
        self._waiting: list[Input] = []  # late records, until the next roll-back
        self._rolled_back_ns: int | None = None  # arrival of the record at the last roll-back
        self._no_late_answers_ns = 0  # until when none is used: the last ones were all rejected
        self._deferred: list[Output] = []  # outputs of deferred updates, for the next `handle`
        self._late_ns = round(1e9 * config.estimator.late_s)
        self._gnss_latency_ns = round(1e9 * config.gnss.latency_s)
        self._stale_data = StaleDataDetector()
        self._receivers = ReceiverChoice(config)
        self._last_mode = Mode.INITIALISING, Source(0)  # mode and fixes of the last solution, and its time
        self._last_solution_ns = 0
        self._rejected_ns: dict[str, int] = {}  # when an implausible record was last reported, by kind
        self._channel_reported = False

    @property
    def state(self) -> State:
        """The state after the last record."""
        return self._state

    @property
    def settings(self) -> Settings:
        """The settings in force."""
        return self._settings

    def handle(self, record: Input) -> list[Output]:
        """Return the outputs of one more record."""
        if isinstance(record, Tuning):
            self._tune(parse(record.toml, "parameters"))
            return []
        if type(record) not in self._uses:
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
            return stale
        chosen: list[Output] = []
        if isinstance(record, Gnss):
            is_used, changes = self._receivers.takes(record)
            chosen += changes
            if not is_used or not is_new_fix(record, self._state):
                return chosen
        if self._past and 0 < self._past[-1].t_ns - record.t_ns <= TICK_NS:
            record = structs.replace(record, t_ns=self._past[-1].t_ns)
        self.settle()
        outputs, self._deferred = [*self._deferred, *chosen], []
        folded: list[Input] = [record]
        if self._past and record.t_ns < self._past[-1].t_ns:
            outputs += self._queue_late(record)
            folded = []
        else:
            self._past.append(_Past(record.t_ns, record, self._state))
            outputs += self._step(record)
        if self._waiting and self._may_roll_back(record.rx_ns):
            folded += self._waiting
            outputs += self._roll_back(record.rx_ns)
        if any(isinstance(one, RsbnFix) and self._state.rsbn_ns == one.t_ns for one in folded):
            # a solution at once after a beacon's fix
            self._state, solution = guarded(self._state, record, self._settings, _solve, record)
            outputs += solution
        return self._with_mode_events(outputs)

    def settle(self) -> None:
        """Do the deferred update of the last record and drop old states: no answer waits for this.

        `handle` does it first if it was not done in between; its outputs come with the next `handle`.
        """
        self._deferred += self._resolve()[1]
        while not self._waiting and self._past and self._past[0].t_ns < self._past[-1].t_ns - self._late_ns:
            self._past.popleft()

    def _reject_implausible(self, record: Input, fault: ImplausibleField) -> list[Output]:
        """Report it once a second."""
        name = type(record).__name__
        if record.rx_ns - self._rejected_ns.get(name, -REPORT_EVERY) < REPORT_EVERY:
            return []
        self._rejected_ns[name] = record.rx_ns
        return [fault.rejection(record)]

    def _resolve(self) -> tuple[Input | None, list[Output]]:
        """Do the deferred update left by the last record: whose it was, and its outputs.

        The fix is added to the window of the guaranteed bound, and one piece of that bound's work is done.
        """
        pending, outputs = self._state.pending, list[Output]()
        if pending is not None:
            state = self._state._replace(pending=None)
            self._state, outputs = guarded(state, pending.record, self._settings, resolve_pending, pending)
        if self._past and is_bound_due(self._state):
            record = self._past[-1].record
            self._state, more = guarded(self._state, record, self._settings, refresh_bound, record)
            outputs = [*outputs, *more]
        return pending.record if pending else None, outputs

    def _step(self, record: Input) -> list[Output]:
        self._state, outputs = guarded(self._state, record, self._settings, self._uses[type(record)], record)
        return outputs

    def _tune(self, config: Config) -> None:
        """Go on with another configuration; late measurements are no longer applied from before it."""
        self.settle()
        before = self._settings
        self._settings, self._state = tuned(self._state, before, config)
        self._uses = uses(self._settings)
        self._receivers = self._receivers.tuned(config)
        self._late_ns = round(1e9 * config.estimator.late_s)
        self._gnss_latency_ns = round(1e9 * config.gnss.latency_s)
        same = config.has_own_ins == before.config.has_own_ins
        self._channel_reported = self._channel_reported and same
        while len(self._past) > 1:  # the last one stays: it dates what is too late
            self._past.popleft()

    def _queue_late(self, record: Input) -> list[Output]:
        """Let a late record wait for the next roll-back, or reject it."""
        if record.t_ns < self._past[0].t_ns:
            return self._too_late(record)
        age_ns = self._past[-1].t_ns - record.t_ns
        if isinstance(record, RsbnFix) and age_ns > CHEAP_NS and record.rx_ns < self._no_late_answers_ns:
            why = "late, and the last late answers were rejected: not used"
            age, limit = age_ns * 1e-9, CHEAP_NS * 1e-9
            return [Rejection(record.t_ns, record.rx_ns, f"rsbn {record.beacon}", why, age, limit)]
        if len(self._waiting) >= MOST_WAITING:
            why = f"more than {MOST_WAITING} late records wait: not used"
            return [Rejection(record.t_ns, record.rx_ns, type(record).__name__, why)]
        self._waiting.append(record)
        return []

    def _may_roll_back(self, now_ns: int) -> bool:
        back_ns = self._past[-1].t_ns - min(record.t_ns for record in self._waiting)
        last = self._rolled_back_ns
        return last is None or not 0 <= now_ns - last < back_ns // ROLL_BACK_SHARE

    def _roll_back(self, now_ns: int) -> list[Output]:
        """Go back to the state before the oldest waiting record and fold all records since in their order."""
        self._rolled_back_ns = now_ns
        outputs: list[Output] = []
        late, self._waiting = sorted(self._waiting, key=lambda record: record.t_ns), []
        while late and late[0].t_ns < self._past[0].t_ns:  # dropped while they waited
            outputs += self._too_late(late.pop(0))
        if not late:
            return outputs
        place = bisect_right(self._past, late[0].t_ns, key=lambda past: past.t_ns)
        later = [past.record for past in list(self._past)[place:]]
        # a stable sort: of equal times the late one comes last
        again = sorted([*later, *late], key=lambda record: record.t_ns)
        if later:
            self._state = self._rewound(self._past[place].before)
        while len(self._past) > place:
            self._past.pop()
        new, back_ns, useful = set(map(id, late)), again[-1].t_ns - again[0].t_ns, False
        for each in again:
            whose, resolved = self._resolve()
            if id(whose) in new:  # the others were returned when they were resolved first
                outputs += resolved
            self._past.append(_Past(each.t_ns, each, self._state))
            found = self._step(each)
            if id(each) in new:
                useful |= not isinstance(each, RsbnFix) or self._state.rsbn_ns == each.t_ns
                last = self._last_solution_ns
                outputs += [out for out in found if not isinstance(out, Solution) or out.t_ns > last]
        self._resolve()
        if not useful:
            self._no_late_answers_ns = now_ns + USELESS_TIMES * back_ns
        return outputs

    def _too_late(self, record: Input) -> list[Output]:
        """Reject it; a receiver without a fix has nothing to use."""
        if isinstance(record, Gnss) and not record.has_3d_fix:
            return []
        age, limit = (self._past[-1].t_ns - record.t_ns) * 1e-9, self._late_ns * 1e-9
        name = type(record).__name__
        why = "late: not used" if age > limit else "older than the oldest kept state: not used"
        return [Rejection(record.t_ns, record.rx_ns, name, why, age, limit)]

    def _rewound(self, before: State) -> State:
        """An earlier state to fold forward from, keeping the latest forecast of the predictor."""
        answers = self._state.guarantee.answers
        return before._replace(guarantee=before.guarantee._replace(answers=answers))

    def _with_mode_events(self, outputs: list[Output]) -> list[Output]:
        """Add an event wherever the mode, or the fixes that the solution rests on, change."""
        found: list[Output] = []
        for output in outputs:
            found.append(output)
            if isinstance(output, Solution):
                self._last_solution_ns = output.t_ns
                mode = output.mode, output.sources & FIXES
                if mode != self._last_mode:
                    self._last_mode = mode
                    found.append(announce(output))
        return found


def _solve(state: State, record: Input, settings: Settings) -> Step:
    return solve(state, record.rx_ns, settings)


def tuned(state: State, before: Settings, config: Config) -> tuple[Settings, State]:
    """Return the settings of another configuration, and the state to go on with.

    The bank is begun again where the error model changed: its states mean something else.
    """
    settings = Settings.of(config)
    same = all(
        getattr(config, section) == getattr(before.config, section)
        for section in ("inertial", "air_data", "strapdown", "gnss", "rsbn", "integrity")
    )
    if same:
        settings = settings._replace(model=before.model)
        same_filters = config.estimator == before.config.estimator
        return settings, state._replace(
            guarantee=minimax_bound.tuned(state.guarantee), parallel=state.parallel if same_filters else None
        )
    return settings, initial(settings)._replace(
        next_ns=state.next_ns, origin=state.origin, sensors=state.sensors, level=state.level
    )


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
        after = after._replace(
            bank=None,
            nominal=None,
            beacons=(),
            false=(),
            reported=(),
            certain_ns=(),
            parallel=None,
            fixed=False,
        )
    return after, outputs


def _channel_event(record: Input, settings: Settings) -> Event:
    """Report which inertial channel is corrected."""
    if isinstance(settings.model.channel, OwnChannel):
        config = settings.config
        allowed = [name for name in ("imu", "air_data", "local_position") if config.uses(name)]
        if config.output.feeds_estimator and "local_position" in allowed:
            allowed.remove("local_position")
        text = f"inertial channel: own, by {', '.join(a.replace('_', ' ') for a in allowed)}"
        if "imu" in allowed:
            text += "; no guaranteed bound by imu"
    else:
        text = "inertial channel: local position of an INS of its own"
    return Event(record.t_ns, record.rx_ns, Severity.INFO, text)
