"""The navigator: records in, records out, no clock and no I/O.

`Navigator` folds `step` over what arrives. Measurements that come late are folded in at their own time: it
keeps the carries of the last seconds, goes back to the one before, and folds forward again. What was given
out stays given out; a late measurement shows in the next solution.
"""

from __future__ import annotations

from bisect import bisect_right
from collections import deque
from collections.abc import Callable
from typing import Any, NamedTuple

from msgspec import structs

from companion.config import Config, parse
from companion.navigator import error_state, integrity, minimax_bound
from companion.navigator.deferred_update import learn
from companion.navigator.solution import announce, solve
from companion.navigator.stale_data import TOLD_EVERY, Freshness
from companion.navigator.state import FIXES, Carry, Settings, Step, initial, is_news
from companion.navigator.step import step, uses
from companion.records import (
    AirData,
    Attitude,
    Event,
    GlobalPosition,
    Gnss,
    Imu,
    Input,
    LocalOrigin,
    LocalPosition,
    Mode,
    Output,
    Pressure,
    Reboot,
    Rejection,
    Reset,
    RsbnFix,
    Severity,
    Solution,
    Source,
    Tuning,
)

__all__ = ["FOLDED", "Navigator", "learnt", "stepped", "tuned"]

FOLDED = (
    LocalPosition,
    LocalOrigin,
    GlobalPosition,
    Attitude,
    AirData,
    Pressure,
    Imu,
    Gnss,
    RsbnFix,
    Reboot,
    Tuning,
)

ENDLESS = 1e8  # in SI: no metres, pascals or metres a second of ours come near it


class _Past(NamedTuple):
    t_ns: int
    record: Input
    before: Carry


class Navigator:
    """One aircraft's navigator: `handle` every record in the order of arrival."""

    def __init__(self, config: Config) -> None:
        self._settings = Settings.of(config)
        self._carry = initial(self._settings)
        self._past: deque[_Past] = deque()
        self._owed: list[Output] = []  # learnt since the last record was handled
        self._late_ns = round(1e9 * config.estimator.late_s)
        self._gnss_latency_ns = round(1e9 * config.gnss.latency_s)
        self._freshness = Freshness()
        self._rests_on = Mode.INITIALISING, Source(0)  # mode and fixes of the last solution, and its time
        self._given_ns = 0
        self._refused_ns: dict[str, int] = {}  # when what is no number was last told, by kind
        self._told: integrity.Watch | None = None
        self._chosen = False  # the inertial channel is told once, with the first record

    def handle(self, record: Input) -> list[Output]:
        """What follows from one more record."""
        if isinstance(record, Tuning):
            self._tune(parse(record.toml, "parameters"))
            return []
        if type(record) not in uses(self._settings.channel):
            return []
        if not self._chosen:
            self._chosen = True
            return [_choice(record, self._settings.config), *self.handle(record)]
        if not _is_numbers(record):
            return self._refused(record)
        if isinstance(record, Gnss) and self._gnss_latency_ns:
            record = structs.replace(record, t_ns=record.t_ns - self._gnss_latency_ns)
        stale = self._freshness.judge(record)
        if stale is not None:
            return stale
        if isinstance(record, Gnss) and not is_news(record, self._carry, self._settings):
            return []
        self.settle()
        outputs, self._owed = self._owed, []
        if self._past and record.t_ns < self._past[-1].t_ns:
            outputs += self._handle_late(record)
        else:
            self._past.append(_Past(record.t_ns, record, self._carry))
            outputs += self._stepped(record)
        if isinstance(record, RsbnFix) and self._carry.rsbn_ns == record.t_ns:  # believed: tell at once
            self._carry, solution = _guarded(self._carry, record, self._settings, _solved, record)
            outputs += solution
        return [*self._announced(outputs), *self._watched(record)]

    def settle(self) -> None:
        """Learn what the last record taught and let go of what is too old: work that nothing waits for.

        `handle` does it first if it was not done in between; what follows from it is told there all the same.
        """
        self._owed += self._learnt()[1]
        while self._past and self._past[0].t_ns < self._past[-1].t_ns - self._late_ns:
            self._past.popleft()

    def _refused(self, record: Input) -> list[Output]:
        """That it is not used, told once a second."""
        name = type(record).__name__
        if record.rx_ns - self._refused_ns.get(name, -TOLD_EVERY) < TOLD_EVERY:
            return []
        self._refused_ns[name] = record.rx_ns
        return [Rejection(record.t_ns, record.rx_ns, name, "it has what is no number")]

    def _watched(self, record: Input) -> list[Output]:
        """What became of the sources since it was last told."""
        before, self._told = self._told, self._carry.watch
        if before is self._told or self._told is None:
            return []
        return integrity.tell(before, self._told, record.rx_ns)

    def _learnt(self) -> tuple[Input | None, list[Output]]:
        """The lesson left over by the record before is learnt: whose it was, and what follows."""
        lesson = self._carry.lesson
        self._carry, outputs = learnt(self._carry, self._settings)
        return lesson and lesson.record, outputs

    def _stepped(self, record: Input) -> list[Output]:
        self._carry, outputs = stepped(self._carry, record, self._settings)
        return outputs

    def _tune(self, config: Config) -> None:
        """Go on with another configuration; late measurements are no longer folded in from before it."""
        self.settle()
        before = self._settings.channel
        self._settings, self._carry = tuned(self._carry, self._settings, config)
        self._late_ns = round(1e9 * config.estimator.late_s)
        self._gnss_latency_ns = round(1e9 * config.gnss.latency_s)
        self._chosen = self._chosen and config.channel == before
        while len(self._past) > 1:  # the last one stays, for what is too late
            self._past.popleft()

    def _handle_late(self, record: Input) -> list[Output]:
        if record.t_ns < self._past[0].t_ns:
            return self._too_late(record)
        place = bisect_right(self._past, record.t_ns, key=lambda past: past.t_ns)
        again = [record, *(past.record for past in list(self._past)[place:])]
        self._carry = self._rewound(self._past[place].before)
        while len(self._past) > place:
            self._past.pop()
        given: list[Output] = []
        for each in again:
            learner, learnt = self._learnt()
            self._past.append(_Past(each.t_ns, each, self._carry))
            outputs = self._stepped(each)
            if learner is record:  # all other lessons were told when they were learnt first
                given += learnt
            if each is record:
                given = [out for out in outputs if not isinstance(out, Solution) or out.t_ns > self._given_ns]
        self._learnt()
        return given

    def _too_late(self, record: Input) -> list[Output]:
        """That it is not used; in what a receiver without a fix says there is nothing to use."""
        if isinstance(record, Gnss) and not record.has_3d_fix:
            return []
        age, limit = (self._past[-1].t_ns - record.t_ns) * 1e-9, self._late_ns * 1e-9
        name = type(record).__name__
        if age <= limit:
            return [Rejection(record.t_ns, record.rx_ns, name, "older than all that can be gone back to")]
        return [Rejection(record.t_ns, record.rx_ns, name, "arrived too late to be folded in", age, limit)]

    def _rewound(self, before: Carry) -> Carry:
        """An earlier carry, to fold forward from: what was forecast since is not forecast again."""
        now = self._carry
        promise = before.guarantee._replace(held=now.guarantee.held)
        return before._replace(guarantee=promise, ahead=now.ahead, next_ahead_ns=now.next_ahead_ns)

    def _announced(self, outputs: list[Output]) -> list[Output]:
        """With an event wherever the mode of what is given out, or what fixes it rests on, changes."""
        announced: list[Output] = []
        for output in outputs:
            announced.append(output)
            if isinstance(output, Solution):
                self._given_ns = output.t_ns
                rests_on = output.mode, output.sources & FIXES
                if rests_on != self._rests_on:
                    self._rests_on = rests_on
                    announced.append(announce(output))
        return announced


def _solved(carry: Carry, record: Input, settings: Settings) -> Step:
    return solve(carry, record.rx_ns, settings)


def stepped(carry: Carry, record: Input, settings: Settings) -> Step:
    """One step, guarded."""
    return _guarded(carry, record, settings, step, record)


def learnt(carry: Carry, settings: Settings) -> Step:
    """The lesson left over by the record before, if there is one, is learnt, guarded."""
    lesson = carry.lesson
    if lesson is None:
        return carry, []
    return _guarded(carry._replace(lesson=None), lesson.record, settings, learn, lesson)


def tuned(carry: Carry, before: Settings, config: Config) -> tuple[Settings, Carry]:
    """The settings of another configuration, and the carry to go on with under them.

    Where it means another inertial channel, all that was learnt was of the old one's error.
    """
    settings = Settings.of(config)
    if settings.channel != before.channel:
        return settings, initial(settings)._replace(next_ns=carry.next_ns)
    return settings, carry._replace(guarantee=minimax_bound.tuned(carry.guarantee, config))


def _guarded(
    carry: Carry, record: Input, settings: Settings, follow: Callable[[Carry, Any, Settings], Step], x: Any
) -> Step:
    """What follows from x; what cannot be computed with is refused aloud and changes nothing, and a state
    gone wrong by it is begun anew.
    """
    try:
        after, outputs = follow(carry, x, settings)
    except (ArithmeticError, ValueError) as error:  # a singular matrix is a ValueError too
        why = f"it cannot be computed with: {error}"
        return carry, [Rejection(record.t_ns, record.rx_ns, type(record).__name__, why)]
    why = "its covariance was none any more"
    if after.state is not carry.state and not error_state.is_sound(after.state):
        outputs = [*outputs, Reset(record.t_ns, record.rx_ns, "error state", why)]
        after = after._replace(state=None, jumps=None)
    if after.watch is not carry.watch and not integrity.is_sound(after.watch):
        outputs = [*outputs, Reset(record.t_ns, record.rx_ns, "integrity monitor", why)]
        after = after._replace(watch=None)
    return after, outputs


def _is_numbers(record: Input) -> bool:
    """Whether all that it says are numbers, and none that nothing in flight can say."""
    for value in structs.astuple(record):
        if isinstance(value, float):
            if not abs(value) < ENDLESS:  # nor is NaN
                return False
        elif isinstance(value, tuple) and not all(abs(x) < ENDLESS for x in value):
            return False
    return True


def _choice(record: Input, config: Config) -> Event:
    """The line that tells which inertial channel is corrected, and why."""
    if config.inertial.source != "auto":
        why = "configured"
    elif config.inertial.independent:
        why = "an INS of its own"
    elif config.output.feeds_estimator:
        why = "the autopilot is fed, so its own position is not independent"
    else:
        why = "the autopilot is not fed"
    name = {
        "air_data": f"air-data dead reckoning ({why})",
        "strapdown": f"strapdown by the autopilot's attitude ({why})",
        "local_position": f"the autopilot's local position ({why}); airspeed not used: "
        "it makes a good INS worse",
    }
    return Event(record.t_ns, record.rx_ns, Severity.INFO, f"inertial channel: {name[config.channel]}")
