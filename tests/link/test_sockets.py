"""Bytes through real sockets: several peers, bursts, losses and refusals."""

import asyncio
import errno
import os
import socket
from collections.abc import Coroutine
from typing import Any

import pytest

from companion.link import stream
from companion.link.address import Address
from companion.link.stream import Stream
from companion.link.transport import connect, connections


def run(test: Coroutine[Any, Any, None]) -> None:
    async def limited() -> None:
        async with asyncio.timeout(20):
            await test

    asyncio.run(limited())


def free_port() -> int:
    with socket.socket() as sock:
        sock.bind(("127.0.0.1", 0))
        return int(sock.getsockname()[1])


async def read_exactly(stream: Stream, count: int) -> bytes:
    data = b""
    while len(data) < count:
        data += await stream.read()
    return data


def test_udp_answers_all_peers_heard_and_outlives_a_peer_that_is_not_there() -> None:
    async def test() -> None:
        early = await connect(Address("udpout", "127.0.0.1", free_port()))
        for _ in range(3):
            early.write(b"nobody hears")
            await asyncio.sleep(0.01)
        early.close()
        server = await connect(Address.parse("udpin:0"))
        server.write(b"nobody yet")
        clients = [await connect(Address("udpout", "127.0.0.1", server.port)) for _ in range(3)]
        for i, client in enumerate(clients):
            client.write(b"from %d" % i)
            assert await server.read() == b"from %d" % i
        clients.pop().close()
        for _ in range(3):
            server.write(b"to all")
        for client in clients:
            assert await read_exactly(client, 18) == b"to all" * 3
        for end in (server, *clients):
            end.close()

    run(test())


def test_a_burst_of_datagrams_comes_in_few_reads_and_in_order() -> None:
    async def test() -> None:
        server = await connect(Address.parse("udpin:0"))
        client = await connect(Address("udpout", "127.0.0.1", server.port))
        sent = [b"%05d" % i for i in range(200)]
        for data in sent:
            client.write(data)
        reads = 0
        got = b""
        while len(got) < 1000:
            got += await server.read()
            reads += 1
        assert got == b"".join(sent)
        assert reads <= 200 // stream.BURST + 2
        server.close()
        client.close()

    run(test())


def test_tcp_both_ways_and_again_after_a_loss() -> None:
    async def test() -> None:
        port = free_port()
        said: list[str] = []
        client = connections(Address("tcp", "127.0.0.1", port), lambda: 1.0, said.append)
        waiting = asyncio.ensure_future(anext(client))
        await asyncio.sleep(0.05)  # nobody listens yet
        for turn in (b"one", b"two"):
            accepting = asyncio.ensure_future(connect(Address("tcpin", "127.0.0.1", port)))
            near, far = await asyncio.gather(waiting, accepting)
            near.write(turn)
            far.write(turn[::-1])
            assert (await far.read(), await near.read()) == (turn, turn[::-1])
            far.close()
            with pytest.raises(ConnectionError, match=f"tcp:127.0.0.1:{port} was closed by the other side"):
                await near.read()
            waiting = asyncio.ensure_future(anext(client))
        waiting.cancel()
        await asyncio.gather(waiting, return_exceptions=True)
        await client.aclose()
        assert said[0] == f"tcp:127.0.0.1:{port}: {os.strerror(errno.ECONNREFUSED)}; trying again"

    run(test())
