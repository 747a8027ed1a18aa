"""Connections over real sockets: several peers, bursts, losses and refusals."""

import asyncio
import socket
import subprocess
import sys
import time
from typing import Any

import pytest

from companion.transport import connection
from companion.transport.address import Address
from companion.transport.reconnect import connect
from tests.network import free_port, read_exactly, until


async def test_udp_sends_to_all_peers_and_survives_an_absent_one() -> None:
    early = await connect(Address("udpout", "127.0.0.1", free_port()))
    for _ in range(3):
        early.write(b"no peer")
        await asyncio.sleep(0.01)
    early.close()
    server = await connect(Address.parse("udpin:0"))
    server.write(b"no peer yet")
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


async def test_burst_of_datagrams_is_read_in_order_with_few_reads(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(connection, "TURN_S", 60.0)  # a busy machine ends turns early

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
    assert reads <= 20
    server.close()
    client.close()


async def test_datagrams_that_take_long_leave_others_their_turn() -> None:
    server = await connect(Address.parse("udpin:0"))
    client = await connect(Address("udpout", "127.0.0.1", server.port))
    loop, in_turn = asyncio.get_running_loop(), [0]  # datagrams taken in each turn of the loop

    def begin_turn() -> None:
        in_turn.append(0)
        loop.call_soon(begin_turn)

    def take(data: bytes, sender: object) -> None:
        in_turn[-1] += 1
        time.sleep(connection.TURN_S)

    begin_turn()
    delivering = asyncio.ensure_future(server.deliver_to(take))
    await asyncio.sleep(0)
    for _ in range(20):
        client.write(b"datagram")
    await until(lambda: sum(in_turn) == 20)
    assert max(in_turn) == 1
    delivering.cancel()
    server.close()
    client.close()


def answering(monkeypatch: pytest.MonkeyPatch, *answers: tuple[socket.AddressFamily, str]) -> None:
    def getaddrinfo(_: str, port: int, *, type: socket.SocketKind) -> list[Any]:
        return [(family, type, 0, "", (host, port)) for family, host in answers]

    monkeypatch.setattr(socket, "getaddrinfo", getaddrinfo)


async def test_every_resolved_address_is_tried(monkeypatch: pytest.MonkeyPatch) -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        answering(monkeypatch, *((socket.AF_INET, f"127.0.0.{i}") for i in (3, 2, 1)))
        link = await connect(Address("tcp", "localhost", server.getsockname()[1]))
        link.close()


async def test_first_failure_is_raised_if_no_resolved_address_works(monkeypatch: pytest.MonkeyPatch) -> None:
    answering(monkeypatch, (socket.AF_INET, "127.0.0.1"), (socket.AF_INET, "255.255.255.255"))
    with pytest.raises(ConnectionRefusedError):
        await connect(Address("tcp", "localhost", free_port()))


def test_silent_name_server_does_not_block_process_exit() -> None:
    code = """
import asyncio, contextlib, socket, threading
from companion.transport.address import Address
from companion.transport.reconnect import connect
socket.getaddrinfo = lambda *_, **__: threading.Event().wait()
async def main():
    with contextlib.suppress(TimeoutError):
        await asyncio.wait_for(connect(Address("tcp", "station.example", 5760)), 0.01)
asyncio.run(main())
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=100)
    assert (done.returncode, done.stderr) == (0, "")
