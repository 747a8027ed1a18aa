"""Token buckets: a rate per sender, and a bounded number of senders."""

from companion.link.rate_limiter import FORGET_AFTER, SenderLimiter
from companion.units import SECOND_NS


def test_each_sender_has_its_own_rate() -> None:
    limiter = SenderLimiter(10.0, 5, 4)
    flood = sum(limiter.take("flood", k * SECOND_NS // 1000) for k in range(10_000))
    assert 100 <= flood <= 106
    limiter = SenderLimiter(10.0, 5, 4)
    for k in range(10_000):
        limiter.take("flood", k * SECOND_NS // 1000)
        if k % 1000 == 0:
            assert limiter.take("beacon", k * SECOND_NS // 1000)


def test_an_established_sender_keeps_its_place() -> None:
    limiter = SenderLimiter(10.0, 5, 4)
    assert limiter.take("beacon", 0)
    for k in range(30_000):
        now = k * SECOND_NS // 1000
        limiter.take(f"forged {k}", now)
        if k % 1000 == 0:
            assert limiter.take("beacon", now)
    assert len(limiter._limiters) <= 4
    assert limiter.take("new", 30 * SECOND_NS + FORGET_AFTER)
