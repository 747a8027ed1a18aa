"""EKF source set of ArduPilot: requested by the table of `source_table` until it is acknowledged. No I/O.

ArduPilot accepts a source set that has no data, and is then lost. The command is repeated until it is
acknowledged, as long as the table requires it.

A set that somebody else selected (the pilot's switch, a ground station) is left as it is: no set is requested
until a person selects the one that the table requires at that time, or the autopilot reboots.

ArduPilot sends GPS_RAW_INT whatever its receiver does, so a receiver that seems silent is mostly a stream
that another station has slowed down: the message is requested before the silence counts. Nor does it count
while the link loses half of the frames.
"""

from __future__ import annotations

import re
from collections import deque
from typing import NamedTuple

from companion.link.dialect import Message, command_long, mavlink
from companion.output.beacon_witness import BeaconWitness
from companion.output.flown_receiver import FlownReceiver
from companion.output.source_table import (
    BELIEVED,
    COMPANION_SET,
    GNSS_SET,
    USING,
    Situation,
    is_held_false,
    required_set,
)
from companion.records import Event, GlobalPosition, Gnss, RsbnFix, Severity, Solution
from companion.units import SECOND_NS

FRESH_S = 60.0  # a solution older than this says nothing about GNSS
MAX_GAP_NS = SECOND_NS  # a longer gap interrupts, or two periods of a slower output
RETRY_NS = SECOND_NS
MAX_TRIES = 10
AGAIN_NS = 30 * SECOND_NS  # after so many tries without an answer: the link may have been lost
ANSWER_NS = 5 * SECOND_NS  # a command is answered within this time, or never
ASKED_NS = SECOND_NS  # after this silence of the receiver, and so often, its message is requested
ASKED_UNTIL_NS = 10 * SECOND_NS
UNCONFIRMED_NS = 15 * SECOND_NS  # a set that is reported was selected by us if we requested it so recently
REPORTS = 2
"""Equal reports of the script in a row that count: one may have been made just before our command."""
_SWITCH_TEXT = re.compile(r"Using EKF Source Set ([123])")  # ArduPilot, RCx_OPTION 90
SCRIPT_REPORT = "EKFSRC"
"""NAMED_VALUE_FLOAT of the script in deploy/ardupilot: the leading set, negative if the script chose it."""
_SETS = (1, 2, 3)
#: Results after which the command is repeated.
RETRIED = (
    mavlink.MAV_RESULT_TEMPORARILY_REJECTED,
    mavlink.MAV_RESULT_FAILED,
    mavlink.MAV_RESULT_IN_PROGRESS,
)


class Selected(NamedTuple):
    """A source set that somebody else selected, or a report of the leading one.

    `by_script`: the script on the autopilot selected it, because our position had stopped. `is_report`: the
    script repeats it once a second, whoever selected it.
    """

    number: int
    by_script: bool = False
    is_report: bool = False


def selected(message: Message, from_autopilot: bool, system: int) -> Selected | None:
    """Return what `message`, not sent by us, states about the source set of autopilot `system`, else None.

    MAV_CMD_SET_EKF_SOURCE_SET of another sender to this autopilot, ArduPilot's text on a switch by RCx_OPTION
    90, and the script's report.
    """
    name = message.get_type()
    if not from_autopilot:
        if name not in ("COMMAND_LONG", "COMMAND_INT"):
            return None
        is_ours = message.target_system in (0, system) and message.target_component in (0, 1)
        is_switch = message.command == mavlink.MAV_CMD_SET_EKF_SOURCE_SET and message.param1 in _SETS
        return Selected(int(message.param1)) if is_ours and is_switch else None
    if name == "STATUSTEXT":
        found = _SWITCH_TEXT.match(message.text)
        return Selected(int(found[1])) if found else None
    if name == "NAMED_VALUE_FLOAT" and message.name == SCRIPT_REPORT and abs(message.value) in _SETS:
        return Selected(int(abs(message.value)), message.value < 0.0, is_report=True)
    return None


class ConditionTimer:
    """Time for which a condition has held without interruption."""

    def __init__(self) -> None:
        self._since: int | None = None
        self._last = 0

    def update(self, holds: bool, now_ns: int, gap_ns: int = MAX_GAP_NS) -> None:
        """Note whether the condition holds at `now_ns`; a gap longer than `gap_ns` interrupts it."""
        if not holds:
            self._since = None
        elif self._since is None or now_ns - self._last > gap_ns:
            self._since = now_ns
        self._last = now_ns

    def held_s(self, now_ns: int, gap_ns: int = MAX_GAP_NS) -> float:
        """Return how long it has held, s; -1 if it does not, or was not noted for longer than `gap_ns`."""
        if self._since is None or now_ns - self._last > gap_ns:
            return -1.0
        return (now_ns - self._since) * 1e-9


class SourceSwitch:
    """The required EKF source set, requested until acknowledged; unknown at the start.

    `_required` is the decision of the table, `_wanted` the set that was requested last, `_leading` the one
    that the autopilot acknowledged; both follow one that somebody else selected. `_held` is the one that a
    person selected against the table.
    """

    command = mavlink.MAV_CMD_SET_EKF_SOURCE_SET
    is_silence_judged = True
    selected = staticmethod(selected)

    def __init__(self) -> None:
        self._fix, self._no_fix, self._sent = ConditionTimer(), ConditionTimer(), ConditionTimer()
        self._receiver, self._receiver_ns = 0, 0  # its number, and when it last reported: 0 for never
        self._flown = FlownReceiver()
        self._other_fix_ns = 0  # when a receiver that is not in use last reported a fix
        self._sent_ns: int | None = None
        self._slack_ns = 0  # by which two positions of a slow output may be further apart than `MAX_GAP_NS`
        self._solution: Solution | None = None
        self._witness = BeaconWitness()
        self._required: int | None = None
        self._wanted: int | None = None
        self._leading: int | None = None
        self._held: int | None = None
        self._lack_reported = ""
        self._reported, self._reports = Selected(0), 0  # the last report of the script, how often in a row
        self._reason = ""
        self._tries = 0
        self._next_ns: int | None = None  # None: nothing to request
        self._sent_sets = deque[tuple[int, int | None]]()  # when sent, of which set
        self._unconfirmed: dict[int | None, int] = {}  # when each set was requested, if not acknowledged
        self._unanswered_ns: int | None = None  # when the last of MAX_TRIES was in vain
        self._asked_ns = 0  # when the receiver's message was last requested
        self._events: list[Event] = []

    def receive(self, record: Gnss | RsbnFix) -> None:
        """Note what the autopilot's receiver reports, or a beacon.

        A repeated GNSS fix counts: the receiver still reports.
        """
        doubt = None if self._solution is None else self._solution.gnss_false
        self._witness.receive(record, is_believed=doubt is not None and doubt < BELIEVED)
        if isinstance(record, RsbnFix):
            return
        now = record.rx_ns
        self._receiver, self._receiver_ns = record.receiver, now
        self._flown.note_used(record)
        self._fix.update(record.has_3d_fix, now, 3 * SECOND_NS)
        self._no_fix.update(not record.has_3d_fix, now, 3 * SECOND_NS)

    def note_other(self, record: Gnss) -> None:
        """Note what a receiver reports that is not in use: with its fix the autopilot has GNSS."""
        self._flown.note_other(record)
        if record.has_3d_fix:
            self._other_fix_ns = record.rx_ns

    def note_own(self, record: GlobalPosition) -> None:
        """Note the autopilot's own position."""
        self._flown.note_own(record)

    def note_output(self, solution: Solution, sent: bool, now_ns: int, period_ns: int = 0) -> None:
        """Note a solution and whether its position went out, one of those due every `period_ns`."""
        self._solution = solution
        self._slack_ns = max(0, 2 * period_ns - MAX_GAP_NS)
        self._sent.update(sent, now_ns, MAX_GAP_NS + self._slack_ns)
        if sent:
            self._sent_ns = now_ns

    def note_armed(self, is_armed: bool) -> None:
        """Ignore whether it is armed: ArduPilot stores no source set."""

    def situation(self, now_ns: int) -> Situation:
        """Return the facts at `now_ns`."""
        solution, patience = self._solution, 3 * SECOND_NS
        fresh = solution is not None and (now_ns - solution.rx_ns) * 1e-9 <= FRESH_S
        received_ns = max(self._receiver_ns, self._other_fix_ns)
        silent = (now_ns - received_ns) * 1e-9 if self._receiver_ns else -1.0
        sent_s = self._sent.held_s(now_ns, MAX_GAP_NS + self._slack_ns) - self._slack_ns * 1e-9
        stopped_ns = -SECOND_NS if self._sent_ns is None else max(0, now_ns - self._sent_ns - self._slack_ns)
        return Situation(
            fix_s=self._fix.held_s(now_ns, patience),
            no_fix_s=self._no_fix.held_s(now_ns, patience),
            silent_s=silent,
            gnss_false=solution.gnss_false if fresh and solution is not None else None,
            witness=fresh and solution is not None and solution.witness and self._witness.contradicts,
            sent_s=max(-1.0, sent_s),  # a single position of a slow output is not steady
            stopped_s=stopped_ns * 1e-9,
            by_other=self._flies_by_other(now_ns),
        )

    @property
    def is_on_companion(self) -> bool:
        """Whether our position leads: acknowledged by the autopilot, or selected by somebody else."""
        return self._leading == COMPANION_SET

    def _flies_by_other(self, now_ns: int) -> bool:
        """Whether the autopilot flies by a receiver that is not in use; on our position it flies by none."""
        if self._solution is None or self.is_on_companion or COMPANION_SET in self._unconfirmed:
            return False
        return self._flown.is_other(self._solution, now_ns)

    @property
    def has_left_gnss(self) -> bool:
        """Whether it may have taken the autopilot off GNSS, and no other has selected that."""
        is_left = self.is_on_companion and self._held is None
        return self._required is not None and (is_left or COMPANION_SET in self._unconfirmed)

    def required(self, s: Situation) -> tuple[int, str] | None:
        """Return the source set that must lead and the reason; None where the present one stays."""
        return required_set(s)

    def name(self, number: int | None) -> str:
        """Return how a source set is reported."""
        return f"EKF source set {number}"

    def parameters(self, number: int | None) -> dict[str, float | None]:
        """Return the parameters of the command that selects a source set."""
        return {"param1": number}

    def update(self, now_ns: int, lack: str = "", is_lossy: bool = False) -> None:
        """Decide by the table; call it at least once a second, with or without solutions.

        `lack`: why the autopilot cannot take our position, empty if it can. `is_lossy`: much of what it sends
        does not arrive, so that silence is the link's.
        """
        situation = self.situation(now_ns)
        if is_lossy:
            situation = situation._replace(silent_s=-1.0)
        decision = self.required(situation)
        if decision is not None and decision[0] == COMPANION_SET and lack:
            self._report_lack(lack, now_ns)
            is_to_return = self.has_left_gnss and not is_held_false(situation)
            decision = (GNSS_SET, lack) if is_to_return else None
        elif decision is not None:
            self._lack_reported = ""
        if decision is None:
            if self._next_ns is not None:  # stop requesting it; whether it was accepted is not known
                self._wanted = self._next_ns = None
            return
        is_new = decision[0] != self._required
        self._required, self._reason = decision
        if self._held is not None:
            if is_new and self._required != self._held:
                need = f"{self.name(self._required)} needed ({self._reason.removesuffix(USING)})"
                text = f"{need}, but {self.name(self._held)} selected by hand"
                self._add_event(Severity.WARNING, text, now_ns)
        elif self._required != self._wanted or self._is_again_due(now_ns):
            self._wanted = self._required
            self._tries, self._next_ns = 0, now_ns

    def handle_selected(self, by: Selected, now_ns: int) -> None:
        """Process a source set that somebody else selected, or the script's report."""
        is_ours = False  # our request, whose acknowledgement was lost
        if by.is_report:
            self._reports = self._reports + 1 if by == self._reported else 1
            self._reported = by
            is_old = self._reports < REPORTS or self._next_ns is not None
            if is_old or self._leading in (None, by.number):
                return
            is_ours = now_ns - self._unconfirmed.get(by.number, -UNCONFIRMED_NS) < UNCONFIRMED_NS
        self._wanted = self._leading = by.number
        self._next_ns = None
        if by.by_script or is_ours:
            return  # the table decides again, after the script's choice once our position goes out
        before, self._held = self._held, None if by.number == (self._required or GNSS_SET) else by.number
        if self._held == before:
            return
        what = "switches again" if self._held is None else "does not switch"
        text = f"{self.name(by.number)} selected by hand: the companion {what}"
        self._add_event(Severity.NOTICE, text, now_ns)

    def handle_acknowledgement(self, command: int, result: int, now_ns: int) -> None:
        """Process the autopilot's COMMAND_ACK of one of our commands."""
        if command != self.command or self._answered(now_ns) != self._wanted or self._next_ns is None:
            return
        if result == mavlink.MAV_RESULT_ACCEPTED:
            self._leading, self._next_ns, self._unanswered_ns = self._wanted, None, None
            self._unconfirmed.clear()
            self._reports = 0
            self._add_event(Severity.NOTICE, f"{self.name(self._wanted)}: {self._reason}", now_ns)
        elif result not in RETRIED:
            self._unanswered_ns = None
            self._give_up(f"it answered MAV_RESULT {result}", now_ns)

    def _answered(self, now_ns: int) -> int | None:
        """Return the set that an answer is about: answers come in the order of the commands and name none."""
        while self._sent_sets and now_ns - self._sent_sets[0][0] > ANSWER_NS:
            self._sent_sets.popleft()
        return self._sent_sets.popleft()[1] if self._sent_sets else None

    def to_send(self, system: int, now_ns: int) -> list[Message]:
        """Return the commands that are due."""
        asked = self._to_ask(system, now_ns)
        if self._next_ns is None or now_ns < self._next_ns:
            return asked
        if self._tries == MAX_TRIES:
            if self._unanswered_ns is None:
                self._give_up(f"{MAX_TRIES} tries, then again every {AGAIN_NS // SECOND_NS} s", now_ns)
            self._next_ns, self._unanswered_ns = None, now_ns
            return asked
        self._next_ns = now_ns + RETRY_NS
        self._sent_sets.append((now_ns, self._wanted))
        self._unconfirmed[self._wanted] = now_ns
        confirmation, self._tries = self._tries, self._tries + 1
        parameters = self.parameters(self._wanted)
        return [*asked, command_long(system, self.command, confirmation=confirmation, **parameters)]

    def _to_ask(self, system: int, now_ns: int) -> list[Message]:
        """Request the receiver's message where it has not come for a second."""
        silent_ns = now_ns - self._receiver_ns if self._receiver_ns and self.is_silence_judged else 0
        if not ASKED_NS < silent_ns <= ASKED_UNTIL_NS or now_ns - self._asked_ns < ASKED_NS:
            return []
        self._asked_ns = now_ns
        number = (mavlink.MAVLINK_MSG_ID_GPS_RAW_INT, mavlink.MAVLINK_MSG_ID_GPS2_RAW)[self._receiver > 0]
        return [command_long(system, mavlink.MAV_CMD_REQUEST_MESSAGE, param1=number)]

    def _is_again_due(self, now_ns: int) -> bool:
        """Whether a command that nobody answered is to be tried again."""
        since_ns = self._unanswered_ns
        return since_ns is not None and self._next_ns is None and now_ns - since_ns >= AGAIN_NS

    def take_events(self) -> list[Event]:
        """Return the events since the last call."""
        taken, self._events = self._events, []
        return taken

    def _report_lack(self, lack: str, now_ns: int) -> None:
        if lack != self._lack_reported:
            self._lack_reported = lack
            text = f"{self.name(COMPANION_SET)} needed, but {lack}: run companion doctor"
            self._add_event(Severity.WARNING, text, now_ns)

    def _give_up(self, why: str, now_ns: int) -> None:
        self._next_ns = None
        text = f"the autopilot did not accept {self.name(self._wanted)} ({why}): switch it by hand"
        self._add_event(Severity.ERROR, text, now_ns)

    def _add_event(self, severity: int, text: str, now_ns: int) -> None:
        self._events.append(Event(now_ns, now_ns, severity, text))
