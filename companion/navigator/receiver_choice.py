"""Which of two GNSS receivers gives the fixes: the preferred one, or the other while that one has no fix.

An autopilot with two receivers flies on by the second; without this it would be taken off a healthy GNSS.
"""

from __future__ import annotations

from companion.config import Config
from companion.records import Event, Gnss, Severity
from companion.units import SECOND_NS

NO_FIX_NS = SECOND_NS  # the preferred receiver reports no fix for so long
SILENT_NS = 12 * SECOND_NS // 5  # or nothing; the source switch waits for 3 s
STEADY_NS = 5 * SECOND_NS  # it has had a fix for so long: it is used again
RECEIVER_MESSAGES = ("GPS_RAW_INT", "GPS2_RAW")  # by number


class ReceiverChoice:
    """The receiver in use, by the fixes of both in order of arrival."""

    def __init__(self, config: Config) -> None:
        self.settings = config.gnss.receiver, config.uses_second_receiver
        self._preferred, self._has_second = self.settings
        self._is_second = False
        self._received_ns: int | None = None  # a report of the preferred one; before it, the first report
        self._fix_since_ns: int | None = None
        self._no_fix_since_ns: int | None = None

    def takes(self, record: Gnss) -> tuple[bool, list[Event]]:
        """Return whether the receiver of `record` is in use, and an event where that changes."""
        if record.receiver == self._preferred:
            self._note(record)
            is_back = self._fix_since_ns is not None and record.rx_ns - self._fix_since_ns >= STEADY_NS
            events = self._change(False, record, "has a fix again") if self._is_second and is_back else []
            return not self._is_second, events
        if not self._has_second:
            return False, []
        events = []
        now, self._received_ns = record.rx_ns, self._received_ns or record.rx_ns
        silent = now - self._received_ns >= SILENT_NS
        lost = self._no_fix_since_ns is not None and now - self._no_fix_since_ns >= NO_FIX_NS
        if not self._is_second and record.has_3d_fix and (silent or lost):
            self._fix_since_ns = None
            events = self._change(True, record, "is silent" if silent else "has no fix")
        elif self._is_second and not record.has_3d_fix and self._fix_since_ns is not None and not silent:
            events = self._change(False, record, "has a fix, the other none")
        return self._is_second, events

    def _note(self, record: Gnss) -> None:
        now, last = record.rx_ns, self._received_ns
        is_broken = last is None or now - last >= SILENT_NS
        self._received_ns = now
        if not record.has_3d_fix:
            self._fix_since_ns, self._no_fix_since_ns = None, self._no_fix_since_ns or now
        else:
            self._no_fix_since_ns = None
            self._fix_since_ns = now if is_broken or self._fix_since_ns is None else self._fix_since_ns

    def _change(self, is_second: bool, record: Gnss, why: str) -> list[Event]:
        self._is_second = is_second
        first, other = RECEIVER_MESSAGES[self._preferred], RECEIVER_MESSAGES[1 - self._preferred]
        text = f"{first} {why}: {other if is_second else first} is used"
        return [Event(record.t_ns, record.rx_ns, Severity.NOTICE, text)]
