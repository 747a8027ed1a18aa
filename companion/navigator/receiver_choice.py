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


class _Reports:
    """Reports of one receiver by their arrival, ns: the last one, and the first of the present runs."""

    def __init__(self) -> None:
        self.last_ns: int | None = None
        self.has_fix = False
        self.since_ns = 0  # since when with a fix, or without
        self.began_ns = 0  # since when without a silence

    def note(self, record: Gnss) -> None:
        if self.is_silent(record.rx_ns):
            self.began_ns = record.rx_ns
        if self.is_silent(record.rx_ns) or record.has_3d_fix != self.has_fix:
            self.has_fix, self.since_ns = record.has_3d_fix, record.rx_ns
        self.last_ns = record.rx_ns

    def is_silent(self, now_ns: int) -> bool:
        return self.last_ns is None or now_ns - self.last_ns >= SILENT_NS


class ReceiverChoice:
    """The receiver in use, by the fixes of both in order of arrival."""

    def __init__(self, config: Config) -> None:
        self._first_ns: int | None = None  # arrival of the first report of either
        self._is_second = False
        self._settings = config.gnss.receiver, config.uses_second_receiver
        self._reports = _Reports(), _Reports()

    def tuned(self, config: Config) -> ReceiverChoice:
        """Return the choice to go on with: this one, unless another preference is configured."""
        same = self._settings == (config.gnss.receiver, config.uses_second_receiver)
        return self if same else ReceiverChoice(config)

    def takes(self, record: Gnss) -> tuple[bool, list[Event]]:
        """Return whether the receiver of `record` is in use, and an event where that changes."""
        preferred, has_second = self._settings
        is_preferred, now = record.receiver == preferred, record.rx_ns
        if not is_preferred and not has_second:
            return False, []
        if self._first_ns is None:
            self._first_ns = now
        first, second = self._reports[preferred], self._reports[1 - preferred]
        (first if is_preferred else second).note(record)
        why = None
        if self._is_second:
            why = self._reason_to_return(first, second, now)
        elif second.has_fix and not second.is_silent(now) and now - self._first_ns >= SILENT_NS:
            why = self._reason_to_leave(first, second, now)
        if why is None:
            return is_preferred != self._is_second, []
        self._is_second = not self._is_second
        name, other = RECEIVER_MESSAGES[preferred], RECEIVER_MESSAGES[1 - preferred]
        text = f"{name} {why}: {other if self._is_second else name} is used"
        return is_preferred != self._is_second, [Event(record.t_ns, now, Severity.NOTICE, text)]

    def _reason_to_return(self, first: _Reports, second: _Reports, now_ns: int) -> str | None:
        if first.is_silent(now_ns) or not first.has_fix:
            return None
        if now_ns - first.since_ns >= STEADY_NS:
            return "has a fix again"
        is_silent = second.is_silent(now_ns) and now_ns - first.began_ns >= SILENT_NS
        return "has a fix, the other none" if is_silent or not second.has_fix else None

    def _reason_to_leave(self, first: _Reports, second: _Reports, now_ns: int) -> str | None:
        if first.is_silent(now_ns):  # alone: after a silence of the link either may come first
            return "is silent" if now_ns - second.began_ns >= SILENT_NS else None
        return "has no fix" if not first.has_fix and now_ns - first.since_ns >= NO_FIX_NS else None
