"""Bytes through an open link: both ways, its end, full lines and slow readers."""

import asyncio
from collections.abc import Coroutine
from typing import Any

import pytest

from companion.transport import connection
from companion.transport.connection import Stream, pair


def run(test: Coroutine[Any, Any, None]) -> None:
    async def limited() -> None:
        async with asyncio.timeout(20):
            await test

    asyncio.run(limited())


async def read_exactly(connection: Stream, count: int) -> bytes:
    data = b""
    while len(data) < count:
        data += await connection.read()
    return data


def test_memory_carries_both_ways_and_tells_its_end() -> None:
    async def test() -> None:
        one, other = pair()
        one.write(b"ping")
        other.write(b"pong")
        assert (await one.read(), await other.read()) == (b"pong", b"ping")
        one.close()
        with pytest.raises(ConnectionError, match="memory was closed by the other side"):
            await other.read()
        with pytest.raises(ConnectionError, match="was closed"):
            await one.read()
        one.write(b"into the void")

    run(test())


async def read_to(connection: Stream, end: bytes) -> bytes:
    data = b""
    while not data.endswith(end):
        data += await connection.read()
    return data


def untimed(connection: Stream) -> None:
    """Nothing grows old in it, however long the machine lets this wait."""
    connection._outbox._now = lambda: 0.0


def test_a_full_line_never_waits_drops_whole_frames_and_counts_them() -> None:
    async def test() -> None:
        one, other = pair()
        untimed(one)
        frames = [i.to_bytes(4, "big") * 64 for i in range(4000)]
        for data in frames:
            one.write(data)
        assert one.dropped > 1000
        got = await read_to(other, frames[-1])
        came = [got[i : i + 256] for i in range(0, len(got), 256)]
        assert len(came) == len(frames) - one.dropped
        assert came == sorted(set(came) & set(frames))  # whole, and in order
        one.close()
        other.close()

    run(test())


def test_what_waited_too_long_for_a_reader_is_not_sent_to_it() -> None:
    async def test() -> None:
        one, other = pair()
        untimed(one)
        while not one._outbox:  # the system's own buffer takes what it takes
            one.write(b"before" * 100)
        one.write(b"stale")
        one._outbox._now = lambda: 0.6
        one.write(b"fresh")
        assert one.dropped >= 1
        got = await read_to(other, b"fresh")
        assert b"stale" not in got
        assert got.removesuffix(b"fresh") == b"before" * (len(got) // 6)
        one.close()
        other.close()

    run(test())


def test_a_slow_reader_holds_a_bounded_inbox_and_loses_no_more_than_is_counted() -> None:
    async def test() -> None:
        one, other = pair()
        untimed(one)
        count = 0
        while count < 768 and not one.dropped:
            count += 1
            one.write(count.to_bytes(4, "big") * 1024)
            await asyncio.sleep(0)
            assert other._held < connection.INBOX_LIMIT + connection.AT_ONCE
        got = await read_to(other, count.to_bytes(4, "big") * 1024)
        assert len(got) == (count - one.dropped) * 4096
        one.close()
        other.close()

    run(test())
