"""Token-bucket rate limiter. The caller supplies the time."""

from __future__ import annotations

from collections.abc import Hashable

from companion.units import SECOND_NS

#: A sender silent for this time gives its place to a new one.
FORGET_AFTER = 10 * SECOND_NS


class RateLimiter:
    """Token bucket: holds at most `burst` tokens, refilled at `rate_hz`."""

    def __init__(self, rate_hz: float, burst: int) -> None:
        self._every = round(SECOND_NS / rate_hz)
        self._burst = burst
        self._full_at: int | None = None  # when the bucket is full again

    def take(self, now: int, tokens: int = 1) -> bool:
        """Take `tokens`; return False, and take none, if fewer are left."""
        full_at = max(self._full_at or now, now)
        if full_at - now > (self._burst - tokens) * self._every:
            return False
        self._full_at = full_at + tokens * self._every
        return True

    def ready_at(self, now: int) -> int:
        """Return when the next token is available, `now` if one is."""
        if self._full_at is None:
            return now
        return max(now, self._full_at - (self._burst - 1) * self._every)


class SenderLimiter:
    """A `RateLimiter` for each of at most `most` senders; a further sender waits until one is silent."""

    def __init__(self, rate_hz: float, burst: int, most: int) -> None:
        self._rate_hz, self._burst, self._most = rate_hz, burst, most
        self._limiters: dict[Hashable, RateLimiter] = {}
        self._last: dict[Hashable, int] = {}

    def take(self, sender: Hashable, now: int) -> bool:
        """Take a token of `sender`; return False if none is left or there is no place for it."""
        limiter = self._limiters.get(sender)
        if limiter is None:
            if len(self._limiters) >= self._most:
                oldest = min(self._last, key=self._last.__getitem__)
                if now - self._last[oldest] < FORGET_AFTER:
                    return False
                del self._limiters[oldest], self._last[oldest]
            limiter = self._limiters[sender] = RateLimiter(self._rate_hz, self._burst)
        self._last[sender] = now
        return limiter.take(now)
