"""Open connections: both directions, their end, full lines and slow readers."""

import asyncio
import socket

import pytest

from companion.transport import connection
from companion.transport.connection import Connection, socket_connection


def pair() -> tuple[Connection, Connection]:
    one, other = socket.socketpair()
    one.setblocking(False)
    other.setblocking(False)
    return socket_connection("memory", one), socket_connection("memory", other)


async def test_memory_pair_carries_both_ways_and_reports_its_end() -> None:
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


async def read_to(connection: Connection, end: bytes) -> bytes:
    data = b""
    while not data.endswith(end):
        data += await connection.read()
    return data


def stop_clock(connection: Connection) -> None:
    """Stop the clock of its send queue, so that no frame is dropped on a slow machine."""
    connection._send_queue._now = lambda: 0.0


async def test_full_line_drops_whole_frames_and_counts_them() -> None:
    one, other = pair()
    stop_clock(one)
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


async def test_frames_that_waited_too_long_are_not_sent() -> None:
    one, other = pair()
    stop_clock(one)
    while not one._send_queue:  # the system's own buffer takes what it takes
        one.write(b"before" * 100)
    one.write(b"stale")
    one._send_queue._now = lambda: 0.6
    one.write(b"fresh")
    assert one.dropped >= 1
    got = await read_to(other, b"fresh")
    assert b"stale" not in got
    assert got.removesuffix(b"fresh") == b"before" * (len(got) // 6)
    one.close()
    other.close()


async def test_inbox_of_a_slow_reader_is_bounded_and_losses_are_counted() -> None:
    one, other = pair()
    stop_clock(one)
    count = 0
    while count < 768 and not one.dropped:
        count += 1
        one.write(count.to_bytes(4, "big") * 1024)
        await asyncio.sleep(0)
        assert other._inbox_size < connection.INBOX_LIMIT + connection.READ_SIZE
    got = await read_to(other, count.to_bytes(4, "big") * 1024)
    assert len(got) == (count - one.dropped) * 4096
    one.close()
    other.close()
