"""How often something may be done: so many times at once, then so many a second. It knows no clock."""

from __future__ import annotations

SECOND = 1_000_000_000


class Bucket:
    """Tokens, at most `burst` of them, that come again at `rate_hz`."""

    def __init__(self, rate_hz: float, burst: int) -> None:
        self._every = round(SECOND / rate_hz)
        self._burst = burst
        self._full_at: int | None = None  # the instant from which nothing is missing

    def take(self, now: int) -> bool:
        """Take a token; False if there is none."""
        if self.ready_at(now) > now:
            return False
        self._full_at = max(self._full_at or now, now) + self._every
        return True

    def ready_at(self, now: int) -> int:
        """The instant of the next token, `now` if there is one."""
        if self._full_at is None:
            return now
        return max(now, self._full_at - (self._burst - 1) * self._every)
