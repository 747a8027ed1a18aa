"""When ArduPilot is told to take its position from us, and when from its GPS again: EKF source sets by
MAV_CMD_SET_EKF_SOURCE_SET. Sans-IO: solutions and acknowledgements in, messages and events out.

ArduPilot accepts a source set that has no data, and is then lost. So set 2 is asked for only while our own
position has gone out without a break for some seconds; and set 1 only when we have trusted GNSS for longer,
so that a receiver that flickers switches nothing. The command is repeated until it is acknowledged. It knows
nothing of how good a position is: what was not good enough did not go out.
"""

from __future__ import annotations

from companion.link import dialect
from companion.link.dialect import Message
from companion.records import Event

SECOND = 1_000_000_000
MAV_CMD_SET_EKF_SOURCE_SET = 42007
BY_GNSS, BY_US = 1, 2
LOST_NS = 2 * SECOND  # GNSS not used for so long is lost
GOOD_NS = 3 * SECOND  # our position has gone out for so long
RETURNED_NS = 10 * SECOND  # GNSS trusted again for so long
BREAK_NS = SECOND  # an interruption of what must last
AGAIN_NS = SECOND
TRIES = 10
ACCEPTED, TEMPORARILY_REJECTED, FAILED, IN_PROGRESS = 0, 1, 4, 5  # MAV_RESULT
WHY = {BY_GNSS: "GNSS is trusted again", BY_US: "GNSS is lost, our position leads"}


class Lasting:
    """How long something has been so without a break."""

    def __init__(self) -> None:
        self._since: int | None = None
        self._last = 0

    def note(self, so: bool, now_ns: int) -> int:
        """It is `so`, or not, at `now_ns`: how long already, ns; -1 if it is not."""
        if not so:
            self._since = None
            return -1
        if self._since is None or now_ns - self._last > BREAK_NS:
            self._since = now_ns
        self._last = now_ns
        return now_ns - self._since


class Switching:
    """The source set that is wanted, and whether the autopilot has it. At the start nobody knows."""

    def __init__(self) -> None:
        self._lost, self._sending, self._returned = Lasting(), Lasting(), Lasting()
        self._wanted: int | None = None
        self._tries = 0
        self._next_ns: int | None = None  # None: nothing is to be asked
        self._events: list[Event] = []

    def update(self, gnss: bool, sent: bool, now_ns: int) -> None:
        """Whether our navigation uses GNSS now, and whether our position went out for it."""
        lost = self._lost.note(not gnss, now_ns)
        sending = self._sending.note(sent, now_ns)
        returned = self._returned.note(gnss, now_ns)
        if lost >= LOST_NS and sending >= GOOD_NS:
            self._want(BY_US, now_ns)
        elif returned >= RETURNED_NS:
            self._want(BY_GNSS, now_ns)

    def rebooted(self) -> None:
        """The autopilot has its first set again; what is wanted is found anew."""
        self.__init__()  # type: ignore[misc]

    def acknowledged(self, command: int, result: int, now_ns: int) -> None:
        """An answer of the autopilot to one of our commands."""
        if command != MAV_CMD_SET_EKF_SOURCE_SET or self._next_ns is None or not self._tries:
            return
        if result == ACCEPTED:
            self._next_ns = None
            self._tell(5, f"EKF source set {self._wanted}: {WHY[self._wanted or BY_GNSS]}", now_ns)
        elif result not in (TEMPORARILY_REJECTED, FAILED, IN_PROGRESS):
            self._give_up(f"it answers MAV_RESULT {result}", now_ns)

    def to_send(self, system: int, now_ns: int) -> list[Message]:
        """The command, if it is due."""
        if self._next_ns is None or now_ns < self._next_ns:
            return []
        if self._tries == TRIES:
            self._give_up(f"no acceptance in {TRIES} tries", now_ns)
            return []
        self._next_ns = now_ns + AGAIN_NS
        confirmation, self._tries = self._tries, self._tries + 1
        return [
            dialect.new(
                "COMMAND_LONG",
                target_system=system,
                target_component=1,
                command=MAV_CMD_SET_EKF_SOURCE_SET,
                confirmation=confirmation,
                param1=self._wanted,
            )
        ]

    def take_events(self) -> list[Event]:
        """What is to be told since this was last asked."""
        taken, self._events = self._events, []
        return taken

    def _want(self, source_set: int, now_ns: int) -> None:
        if source_set != self._wanted:
            self._wanted, self._tries, self._next_ns = source_set, 0, now_ns

    def _give_up(self, why: str, now_ns: int) -> None:
        self._next_ns = None
        text = f"the autopilot does not take EKF source set {self._wanted} ({why}): switch it by hand"
        self._tell(3, text, now_ns)

    def _tell(self, severity: int, text: str, now_ns: int) -> None:
        self._events.append(Event(now_ns, now_ns, severity, text))
