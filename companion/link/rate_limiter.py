"""Token-bucket rate limiter. The caller supplies the time."""

from __future__ import annotations

from companion.units import SECOND_NS


class RateLimiter:
    """Token bucket: holds at most `burst` tokens, refilled at `rate_hz`."""

    def __init__(self, rate_hz: float, burst: int) -> None:
        self._every = round(SECOND_NS / rate_hz)
        self._burst = burst
        self._full_at: int | None = None  # when the bucket is full again

    def take(self, now: int) -> bool:
        """Take a token; return False if none is left."""
        if self.ready_at(now) > now:
            return False
        self._full_at = max(self._full_at or now, now) + self._every
        return True

    def ready_at(self, now: int) -> int:
        """Return when the next token is available, `now` if one is."""
        if self._full_at is None:
            return now
        return max(now, self._full_at - (self._burst - 1) * self._every)
