"""Source switch: ArduPilot's EKF source set, by MAV_CMD_SET_EKF_SOURCE_SET. No I/O.

Set 1 is the autopilot's GPS, set 2 the companion's position. ArduPilot accepts a source set that has no data,
and then has no position. So set 2 is requested only after our position has been sent without interruption for
`OUTPUT_STEADY_NS`, and set 1 only after GNSS has been trusted for `GNSS_TRUSTED_NS`, so that an intermittent
receiver switches nothing. The command is repeated until it is acknowledged. The quality of a position is
checked elsewhere (`gate`).
"""

from __future__ import annotations

from companion.link import dialect
from companion.link.dialect import Message, mavlink
from companion.records import Event, Severity
from companion.units import SECOND_NS

GNSS_SET, COMPANION_SET = 1, 2
GNSS_LOST_NS = 2 * SECOND_NS  # GNSS unused for this long is lost
OUTPUT_STEADY_NS = 3 * SECOND_NS  # our position was sent for this long
GNSS_TRUSTED_NS = 10 * SECOND_NS  # GNSS was trusted again for this long
MAX_GAP_NS = SECOND_NS  # a longer gap interrupts
RETRY_NS = SECOND_NS
MAX_TRIES = 10
#: Results after which the command is repeated.
RETRIED = (
    mavlink.MAV_RESULT_TEMPORARILY_REJECTED,
    mavlink.MAV_RESULT_FAILED,
    mavlink.MAV_RESULT_IN_PROGRESS,
)
REASONS = {GNSS_SET: "GNSS is trusted again", COMPANION_SET: "GNSS is lost, using companion"}


class ConditionTimer:
    """Time for which a condition has held without interruption."""

    def __init__(self) -> None:
        self._since: int | None = None
        self._last = 0

    def update(self, holds: bool, now_ns: int) -> int:
        """Return how long the condition has held at `now_ns`, ns; -1 if it does not hold."""
        if not holds:
            self._since = None
            return -1
        if self._since is None or now_ns - self._last > MAX_GAP_NS:
            self._since = now_ns
        self._last = now_ns
        return now_ns - self._since


class SourceSwitch:
    """The required EKF source set, requested until acknowledged; unknown at the start."""

    def __init__(self) -> None:
        self._lost, self._sending, self._returned = ConditionTimer(), ConditionTimer(), ConditionTimer()
        self._wanted: int | None = None
        self._tries = 0
        self._next_ns: int | None = None  # None: nothing to request
        self._events: list[Event] = []

    def update(self, gnss: bool, sent: bool, now_ns: int) -> None:
        """Update the required set: whether the solution uses GNSS, and whether our position was sent."""
        lost = self._lost.update(not gnss, now_ns)
        sending = self._sending.update(sent, now_ns)
        returned = self._returned.update(gnss, now_ns)
        if lost >= GNSS_LOST_NS and sending >= OUTPUT_STEADY_NS:
            self._request(COMPANION_SET, now_ns)
        elif returned >= GNSS_TRUSTED_NS:
            self._request(GNSS_SET, now_ns)

    def handle_acknowledgement(self, command: int, result: int, now_ns: int) -> None:
        """Process the autopilot's COMMAND_ACK of one of our commands."""
        if command != mavlink.MAV_CMD_SET_EKF_SOURCE_SET or self._next_ns is None or not self._tries:
            return
        if result == mavlink.MAV_RESULT_ACCEPTED:
            self._next_ns = None
            self._add_event(
                Severity.NOTICE, f"EKF source set {self._wanted}: {REASONS[self._wanted or GNSS_SET]}", now_ns
            )
        elif result not in RETRIED:
            self._give_up(f"it answered MAV_RESULT {result}", now_ns)

    def to_send(self, system: int, now_ns: int) -> list[Message]:
        """Return the command if it is due."""
        if self._next_ns is None or now_ns < self._next_ns:
            return []
        if self._tries == MAX_TRIES:
            self._give_up(f"{MAX_TRIES} tries", now_ns)
            return []
        self._next_ns = now_ns + RETRY_NS
        confirmation, self._tries = self._tries, self._tries + 1
        return [
            dialect.new(
                "COMMAND_LONG",
                target_system=system,
                target_component=1,
                command=mavlink.MAV_CMD_SET_EKF_SOURCE_SET,
                confirmation=confirmation,
                param1=self._wanted,
            )
        ]

    def take_events(self) -> list[Event]:
        """Return the events since the last call."""
        taken, self._events = self._events, []
        return taken

    def _request(self, source_set: int, now_ns: int) -> None:
        if source_set != self._wanted:
            self._wanted, self._tries, self._next_ns = source_set, 0, now_ns

    def _give_up(self, why: str, now_ns: int) -> None:
        self._next_ns = None
        text = f"the autopilot did not accept EKF source set {self._wanted} ({why}): switch it by hand"
        self._add_event(Severity.ERROR, text, now_ns)

    def _add_event(self, severity: int, text: str, now_ns: int) -> None:
        self._events.append(Event(now_ns, now_ns, severity, text))
