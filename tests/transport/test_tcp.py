"""TCP connections: both directions, reconnecting, lost peers, and replacement by a newer client."""

import asyncio
import errno
import os
import socket
from collections.abc import Coroutine
from typing import Any

import pytest

from companion.transport.address import Address
from companion.transport.connection import Connection
from companion.transport.reconnect import connect, connections
from companion.transport.tcp import PEER_TIMEOUT_S


def run(test: Coroutine[Any, Any, None]) -> None:
    async def limited() -> None:
        async with asyncio.timeout(20):
            await test

    asyncio.run(limited())


def free_port() -> int:
    with socket.socket() as sock:
        sock.bind(("127.0.0.1", 0))
        return int(sock.getsockname()[1])


def test_tcp_both_ways_and_again_after_a_loss() -> None:
    async def test() -> None:
        port = free_port()
        reports: list[str] = []
        client = connections(Address("tcp", "127.0.0.1", port), lambda: 1.0, reports.append)
        waiting = asyncio.ensure_future(anext(client))
        await asyncio.sleep(0.05)  # no listener yet
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
        assert reports[0] == f"tcp:127.0.0.1:{port}: {os.strerror(errno.ECONNREFUSED)}; trying again"

    run(test())


def option(connection: Connection, name: str) -> int:
    device = connection._device
    assert isinstance(device, socket.socket)
    return device.getsockopt(socket.IPPROTO_TCP, getattr(socket, name))


@pytest.mark.skipif(not hasattr(socket, "TCP_USER_TIMEOUT"), reason="as Linux has it")
def test_lost_peer_detection_is_enabled_on_both_ends() -> None:
    """A real loss takes ten seconds and a broken network: only the socket options are checked."""

    async def test() -> None:
        port = free_port()
        accepting = asyncio.ensure_future(connect(Address("tcpin", "127.0.0.1", port)))
        await asyncio.sleep(0)
        while not accepting.done():
            try:
                near = await connect(Address("tcp", "127.0.0.1", port))
            except ConnectionRefusedError:
                continue
            await accepting
        for end in (near, accepting.result()):
            assert option(end, "TCP_USER_TIMEOUT") == 1000 * PEER_TIMEOUT_S
            assert option(end, "TCP_KEEPIDLE") + 3 * option(end, "TCP_KEEPINTVL") <= PEER_TIMEOUT_S + 2
            assert isinstance(end._device, socket.socket)
            assert end._device.getsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE)
            end.close()

    run(test())


def test_system_buffers_little_for_a_peer_that_does_not_read() -> None:
    async def test() -> None:
        with socket.create_server(("127.0.0.1", 0)) as server:
            server.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
            near = await connect(Address("tcp", "127.0.0.1", server.getsockname()[1]))
            far, _ = server.accept()
            with far:
                for _ in range(1000):
                    near.write(bytes(256))
                    await asyncio.sleep(0)
                near.close()
                buffered = 0
                while data := far.recv(65536):
                    buffered += len(data)
        assert buffered < 50_000

    run(test())


def test_newer_client_replaces_the_older() -> None:
    async def test() -> None:
        port = free_port()
        address = Address("tcpin", "127.0.0.1", port)
        links = connections(address, lambda: 1.0, print)
        opening = asyncio.ensure_future(anext(links))
        old = connections(Address("tcp", "127.0.0.1", port), lambda: 1.0, print)
        away = await anext(old)
        link = await opening
        away.write(b"old")
        assert await link.read() == b"old"
        back = await connect(Address("tcp", "127.0.0.1", port))
        with pytest.raises(ConnectionError, match=f"{address} was replaced by a newer client"):
            await link.read()
        back.write(b"new")
        link = await anext(links)
        assert await link.read() == b"new"
        link.write(b"reply")
        assert await back.read() == b"reply"
        with pytest.raises(ConnectionError, match="closed by the other side"):
            await away.read()
        back.close()
        await links.aclose()
        await old.aclose()

    run(test())


def test_newest_of_the_waiting_clients_is_accepted() -> None:
    async def test() -> None:
        links = connections(Address("tcpin", "127.0.0.1", port := free_port()), lambda: 1.0, print)
        opening = asyncio.ensure_future(anext(links))
        first = connections(Address("tcp", "127.0.0.1", port), lambda: 1.0, print)
        (await anext(first)).close()
        with pytest.raises(ConnectionError):
            await (await opening).read()
        clients = [await connect(Address("tcp", "127.0.0.1", port)) for _ in range(3)]  # during the pause
        clients[-1].write(b"the newest")
        assert await (await anext(links)).read() == b"the newest"
        for client in clients[:-1]:
            with pytest.raises(ConnectionError):
                await client.read()
        clients[-1].close()
        await links.aclose()
        await first.aclose()

    run(test())


def test_a_served_client_yields_to_a_valid_frame_only_and_without_a_pause() -> None:
    """Connections that send nothing, or no frame, by the hundred do not disturb the client in use."""

    async def test() -> None:
        address = Address("tcpin", "127.0.0.1", port := free_port())
        links = connections(address, lambda: 1.0, print, lambda data: data.startswith(b"frame"))
        opening = asyncio.ensure_future(anext(links))
        await asyncio.sleep(0.05)
        client = await connect(Address("tcp", "127.0.0.1", port))
        link = await opening
        strangers = []
        for k in range(200):
            strangers.append(await connect(Address("tcp", "127.0.0.1", port)))
            strangers[-1].write(b"junk" if k % 2 else b"")
            client.write(b"position")
            assert await link.read() == b"position"
        assert link.is_open
        for stranger in strangers:
            stranger.close()
        newcomer = await connect(Address("tcp", "127.0.0.1", port))
        newcomer.write(b"frame 1")
        with pytest.raises(ConnectionError, match="was replaced by a newer client"):
            await link.read()
        async with asyncio.timeout(0.2):
            link = await anext(links)
        assert await link.read() == b"frame 1"
        newcomer.close()
        client.close()
        await links.aclose()

    run(test())
