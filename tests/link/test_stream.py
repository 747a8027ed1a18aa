"""Bytes through an open link: both ways, its end, full lines and slow readers."""

import asyncio
import os
from collections.abc import Coroutine
from typing import Any

import pytest

from companion.link import stream
from companion.link.sockets import pair
from companion.link.stream import Stream


def run(test: Coroutine[Any, Any, None]) -> None:
    async def limited() -> None:
        async with asyncio.timeout(20):
            await test

    asyncio.run(limited())


async def read_exactly(stream: Stream, count: int) -> bytes:
    data = b""
    while len(data) < count:
        data += await stream.read()
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


def test_a_full_line_never_waits_drops_whole_frames_the_oldest_first_and_counts_them() -> None:
    async def test() -> None:
        one, other = pair()
        frames = [i.to_bytes(4, "big") * 64 for i in range(4000)]
        for data in frames:
            one.write(data)
        assert one.dropped > 1000
        got = await read_exactly(other, 256 * (len(frames) - one.dropped))
        came = [got[i : i + 256] for i in range(0, len(got), 256)]
        assert len(came) == len(frames) - one.dropped
        assert came == sorted(set(came) & set(frames))  # whole, and in order
        assert came[-1] == frames[-1]
        one.close()
        other.close()

    run(test())


def test_a_slow_reader_holds_a_bounded_inbox_and_loses_no_more_than_is_counted() -> None:
    async def test() -> None:
        one, other = pair()
        data = os.urandom(1 << 12)
        total = 0
        while total < 3 << 20:
            one.write(data)
            total += len(data)
            await asyncio.sleep(0)
            assert other._held < stream.INBOX_LIMIT + stream.AT_ONCE
            if one.dropped:
                break
        assert len(await read_exactly(other, total - one.dropped * len(data))) == total - one.dropped * len(
            data
        )
        one.close()
        other.close()

    run(test())
