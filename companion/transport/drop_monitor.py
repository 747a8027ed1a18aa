"""Says that a line does not carry what is sent, once when that begins and once when it is over."""

from __future__ import annotations

from companion.transport.address import Address
from companion.transport.send_queue import LONGEST_WAIT_S

#: So long (s) nothing must be dropped before that is called over: a line at its limit drops now and then.
QUIET_S = 10.0


class Shortfall:
    """Of one link: it is handed how many frames were dropped so far, again and again."""

    def __init__(self, address: Address) -> None:
        self._name = str(address)
        faster = " or raise the baud rate" if address.kind == "serial" else ""
        self._advice = f"lower the rates{faster}"
        self._dropped = 0
        self._before: int | None = None  # dropped before this shortfall began; None while there is none
        self._last = 0.0  # when more had been dropped

    @property
    def lasts(self) -> bool:
        """Whether frames were dropped within the last QUIET_S."""
        return self._before is not None

    def look(self, dropped: int, now: float) -> str | None:
        """Return what there is to say, at `now` in seconds from any beginning."""
        before, self._dropped = self._dropped, dropped
        if dropped > before:
            self._last = now
            if self._before is None:
                self._before = before
                return (
                    f"{self._name}: the line does not carry what is sent, "
                    f"what waits longer than {LONGEST_WAIT_S} s is dropped: {self._advice}"
                )
        elif self._before is not None and now - self._last >= QUIET_S:
            count, self._before = dropped - self._before, None
            return f"{self._name}: the line carries what is sent again; {count} frames were dropped"
        return None
