"""Detection of dropped frames: reports when a line begins to drop frames and when it has stopped."""

from __future__ import annotations

from companion.transport.address import Address
from companion.transport.send_queue import MAX_WAIT_S

#: Time without drops (s) after which dropping is reported as over: a line at its limit drops now and then.
QUIET_S = 10.0


class DropMonitor:
    """Drop detector of one link, updated with its total number of dropped frames."""

    def __init__(self, address: Address) -> None:
        self._name = str(address)
        faster = " or raise the baud rate" if address.kind == "serial" else ""
        self._advice = f"lower the rates{faster}"
        self._dropped = 0
        self._before: int | None = None  # dropped before the present period of drops; None outside of one
        self._last = 0.0  # time of the last drop

    @property
    def is_dropping(self) -> bool:
        """Whether frames were dropped within the last QUIET_S."""
        return self._before is not None

    def update(self, dropped: int, now: float) -> str | None:
        """Return a report if dropping began or stopped; `now` in seconds from any origin."""
        before, self._dropped = self._dropped, dropped
        if dropped > before:
            self._last = now
            if self._before is None:
                self._before = before
                return (
                    f"{self._name}: the line is too slow, frames that wait longer than {MAX_WAIT_S} s "
                    f"are dropped: {self._advice}"
                )
        elif self._before is not None and now - self._last >= QUIET_S:
            count, self._before = dropped - self._before, None
            return f"{self._name}: the line is fast enough again; {count} frames were dropped"
        return None
