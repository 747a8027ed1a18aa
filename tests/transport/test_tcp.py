"""TCP connections: both directions, reconnecting, lost peers, and the clients of a listening socket."""

import asyncio
import errno
import os
import socket
from collections.abc import Callable, Hashable
from functools import partial
from typing import Any

import pytest

from companion.transport import tcp
from companion.transport.address import Address
from companion.transport.connection import Connection
from companion.transport.peers import MAX_PEERS, Rank
from companion.transport.reconnect import connect, connections
from companion.transport.tcp import PEER_TIMEOUT_S, Listener
from tests.network import free_port, until


@pytest.fixture(autouse=True)
def patient(monkeypatch: pytest.MonkeyPatch) -> None:
    """A busy machine may take seconds over the turn in which a frame is read."""
    monkeypatch.setattr(tcp, "WAIT_S", 60.0)


def judge() -> Callable[[bytes], bool]:
    seen = bytearray()

    def is_valid(data: bytes) -> bool:
        seen.extend(data)
        return seen.startswith(b"frame")

    return is_valid


async def listen() -> Listener:
    server = await connect(Address.parse("tcpin:0"), judge)
    assert isinstance(server, Listener)
    return server


async def client_of(server: Connection) -> Connection:
    return await connect(Address("tcp", "127.0.0.1", server.port))


class Received:
    """Bytes that a listener receives, by sender; the service's part: a frame makes its sender a peer."""

    def __init__(self, server: Connection) -> None:
        self.server, self.by_sender = server, dict[Hashable, bytes]()
        self.task = asyncio.ensure_future(server.deliver_to(self._on_bytes))

    def _on_bytes(self, data: bytes, sender: Hashable) -> None:
        if data:  # neither the begin nor the end of a stream
            self.by_sender[sender] = self.by_sender.get(sender, b"") + data
        rank = Rank.AUTOPILOT if b"autopilot" in data else Rank.ACCEPTED
        self.server.note(sender, rank if data else Rank.UNKNOWN)

    def has(self, *streams: bytes) -> bool:
        return set(streams) <= set(self.by_sender.values())

    async def close(self) -> None:
        self.server.close()
        await asyncio.gather(self.task, return_exceptions=True)


async def ended(client: Connection) -> None:
    """Read a client to its end."""
    with pytest.raises(ConnectionError, match="closed by the other side"):
        while True:
            await client.read()


async def test_tcp_both_ways_and_again_after_a_loss() -> None:
    port = free_port()
    reports: list[str] = []
    client = connections(Address("tcp", "127.0.0.1", port), lambda: 1.0, reports.append)
    waiting = asyncio.ensure_future(anext(client))
    await until(lambda: reports)  # no listener yet
    for turn in (b"one", b"two"):
        accepting = asyncio.ensure_future(connect(Address("tcpin", "127.0.0.1", port)))
        near, far = await asyncio.gather(waiting, accepting)
        near.write(turn)
        assert await far.read() == turn  # it has accepted: what it writes now reaches a client
        far.write(turn[::-1])
        assert await near.read() == turn[::-1]
        far.close()
        with pytest.raises(ConnectionError, match=f"tcp:127.0.0.1:{port} was closed by the other side"):
            await near.read()
        waiting = asyncio.ensure_future(anext(client))
    waiting.cancel()
    await asyncio.gather(waiting, return_exceptions=True)
    await client.aclose()
    advice = "start the program that listens there, or give another port"
    assert reports[0] == f"tcp:127.0.0.1:{port}: {os.strerror(errno.ECONNREFUSED)}; {advice}; trying again"


def option(connection: Connection, name: str) -> int:
    device = connection._device
    assert isinstance(device, socket.socket)
    return device.getsockopt(socket.IPPROTO_TCP, getattr(socket, name))


@pytest.mark.skipif(not hasattr(socket, "TCP_USER_TIMEOUT"), reason="as Linux has it")
async def test_lost_peer_detection_is_enabled_on_both_ends() -> None:
    """A real loss takes ten seconds and a broken network: only the socket options are checked."""
    server = await listen()
    near = await client_of(server)
    await until(lambda: bool(server._clients))
    for end in (near, *server._clients):
        assert option(end, "TCP_USER_TIMEOUT") == 1000 * PEER_TIMEOUT_S
        assert option(end, "TCP_KEEPIDLE") + 3 * option(end, "TCP_KEEPINTVL") <= PEER_TIMEOUT_S + 2
        assert isinstance(end._device, socket.socket)
        assert end._device.getsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE)
    near.close()
    server.close()


async def test_system_buffers_little_for_a_peer_that_does_not_read() -> None:
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


async def test_all_clients_are_served_and_streams_do_not_mix() -> None:
    """Eight clients send their bytes one by one, in turn."""
    received = Received(server := await listen())
    clients = [await client_of(server) for _ in range(MAX_PEERS)]
    sent = [b"frame of %d" % k for k in range(MAX_PEERS)]
    for at in range(len(sent[0])):
        for client, data in zip(clients, sent, strict=True):
            client.write(data[at : at + 1])
        await asyncio.sleep(0.002)
    await until(lambda: received.has(*sent))
    server.write(b"to all")
    for client in clients:
        assert await client.read() == b"to all"
    clients.pop().close()
    await until(lambda: len(server._clients) == len(clients))
    server.write(b"again")
    for client in clients:
        assert await client.read() == b"again"
        client.close()
    await received.close()


async def test_a_client_that_only_listens_is_served_and_yields_to_a_valid_frame() -> None:
    received = Received(server := await listen())
    clients = [await client_of(server) for _ in range(MAX_PEERS)]
    await until(lambda: len(server._clients) == MAX_PEERS)
    server.write(b"to all")
    for client in clients:
        assert await client.read() == b"to all"
    for client in clients[1:]:
        client.write(b"frame")
    newcomer = await client_of(server)
    newcomer.write(b"frame of the newcomer")
    await until(lambda: received.has(b"frame of the newcomer"))
    await ended(clients[0])
    server.write(b"next")
    assert [await client.read() for client in (*clients[1:], newcomer)] == [b"next"] * MAX_PEERS
    for client in (*clients, newcomer):
        client.close()
    await received.close()


async def test_newcomer_takes_the_place_of_a_silent_client_only_and_the_autopilot_any() -> None:
    received = Received(server := await listen())
    seconds = 0.0
    server._places._now = lambda: seconds
    clients = [await client_of(server) for _ in range(MAX_PEERS)]
    for client in clients:
        client.write(b"frame")
    await until(lambda: len(received.by_sender) == MAX_PEERS)
    ninth = await client_of(server)
    ninth.write(b"frame")
    await ended(ninth)
    lost = clients.pop(3)  # its network is gone: it neither sends nor closes
    seconds = tcp.YIELDS_S + 1.0
    for client in clients:
        client.write(b"frame")
    await until(lambda: list(received.by_sender.values()).count(b"frameframe") == len(clients))
    again = await client_of(server)
    again.write(b"frame again")
    await ended(lost)
    autopilot = await client_of(server)
    autopilot.write(b"frame of the autopilot")
    await until(lambda: received.has(b"frame again", b"frame of the autopilot"))
    await until(lambda: len(server._clients) == MAX_PEERS)
    server.write(b"to all")
    assert await autopilot.read() == b"to all"
    for client in (*clients, lost, ninth, again, autopilot):
        client.close()
    await received.close()


async def full_server() -> tuple[Listener, Received, list[Connection]]:
    """A listener with as many clients as may send frames."""
    received = Received(server := await listen())
    clients = [await client_of(server) for _ in range(MAX_PEERS)]
    for client in clients:
        client.write(b"frame")
    await until(lambda: len(received.by_sender) == MAX_PEERS)
    return server, received, clients


@pytest.mark.parametrize("data", [b"", b"junk", b"j" * 4096])
async def test_connections_without_a_frame_do_not_disturb_clients(
    data: bytes, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(tcp, "WAIT_S", 0.2)

    server, received, clients = await full_server()
    strangers = []
    for k in range(200):
        strangers.append(await client_of(server))
        strangers[-1].write(data)
        server.write(b"%03d" % k)
        for client in clients:
            assert await client.read() == b"%03d" % k
        assert len(server._clients) <= MAX_PEERS + tcp.MAX_WAITING
    for stranger in strangers:
        await ended(stranger)
    assert len(server._clients) == len(received.by_sender) == MAX_PEERS
    for client in clients:
        client.close()
    await received.close()


@pytest.mark.parametrize("number", [17, 40, 200])
async def test_idle_connections_that_hold_on_keep_no_client_with_frames_out(number: int) -> None:
    """They connect again whenever they are closed; a client joins, leaves and joins again."""

    async def hold_on(server: Listener) -> None:
        while True:
            idle = await client_of(server)
            try:
                await ended(idle)
            finally:
                idle.close()

    received = Received(server := await listen())
    idle = [asyncio.ensure_future(hold_on(server)) for _ in range(number)]
    await until(lambda: len(server._clients) >= MAX_PEERS)
    stays = await client_of(server)
    stays.write(b"frame of one that stays")
    for turn in (b"frame 1", b"frame 2", b"frame 3"):
        client = await client_of(server)
        await asyncio.sleep(0.05)  # as a line does
        client.write(turn)
        await until(partial(received.has, b"frame of one that stays", turn))
        server.write(turn)
        assert await client.read() == await stays.read() == turn
        client.close()
        assert len(server._clients) <= MAX_PEERS + tcp.MAX_WAITING
    for task in idle:
        task.cancel()
    await asyncio.gather(*idle, return_exceptions=True)
    stays.close()
    await received.close()


async def test_too_many_waiting_clients_close_the_oldest_of_the_host_with_most(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(tcp, "MAX_WAITING", 3)

    server, received, established = await full_server()
    waiting = []
    for k, host in enumerate(["127.0.0.2", "127.0.0.1", "127.0.0.1", "127.0.0.1"]):
        waiting.append(socket.create_connection(("127.0.0.1", server.port), source_address=(host, 0)))
        if k < 3:
            await until(lambda number=MAX_PEERS + k + 1: len(server._clients) == number)
    waiting[1].settimeout(30.0)
    assert await asyncio.to_thread(waiting[1].recv, 1) == b""
    waiting[0].send(b"frame of the oldest")
    await until(lambda: received.has(b"frame of the oldest"))
    for client in established:
        client.close()
    for sock in waiting:
        sock.close()
    await received.close()


async def test_client_that_does_not_read_delays_no_other() -> None:
    received = Received(server := await listen())
    reading = await client_of(server)
    stuck = socket.socket()
    stuck.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
    with stuck:
        stuck.connect(("127.0.0.1", server.port))
        stuck.send(b"frame")
        reading.write(b"frame")
        await until(lambda: len(received.by_sender) == 2)
        for k in range(2000):
            frame = k.to_bytes(4, "big") * 64
            server.write(frame)
            data = b""
            while len(data) < len(frame):
                data += await reading.read()
            assert data == frame
        dropped = server.dropped
        assert dropped > 1000
    await until(lambda: len(server._clients) == 1)
    assert server.dropped == dropped
    reading.close()
    await received.close()


async def test_listening_goes_on_after_a_failed_accept(monkeypatch: pytest.MonkeyPatch) -> None:
    """For example without a free file descriptor."""
    server = await listen()
    real, failures = socket.socket.accept, [errno.EMFILE, errno.ECONNABORTED]

    def accept(sock: socket.socket) -> tuple[socket.socket, Any]:
        if failures:
            raise OSError(failures.pop(), "no")
        return real(sock)

    monkeypatch.setattr(socket.socket, "accept", accept)
    client = await client_of(server)
    client.write(b"frame")
    assert await server.read() == b"frame"
    client.close()
    server.close()
