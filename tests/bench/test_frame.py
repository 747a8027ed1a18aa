"""Benchmark of frame parsing: both parsers give the messages that both are timed for."""

from companion.bench.frame import MESSAGES, cases


def test_what_is_compared_gives_every_message() -> None:
    """Regression: byte by byte the companion's frames were not decoded, and pymavlink's were."""
    given = {name: call() for name, call in cases() if "decoded" in name or "parse_" in name}
    assert [len(messages) for messages in given.values()] == [MESSAGES] * 4
