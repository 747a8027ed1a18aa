"""Bytes through real sockets, a pseudo-terminal and memory; ends, refusals and full lines."""

import asyncio
import errno
import os
import pty
import random
import socket
import tty
from collections.abc import Coroutine
from pathlib import Path
from typing import Any

import pytest

from companion.link import transport
from companion.link.transport import Address, CannotListen, Stream, back_off, connect, connections, pair


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


@pytest.mark.parametrize(
    ("text", "address"),
    [
        ("serial:/dev/ttyAMA0:921600", ("serial", "/dev/ttyAMA0", 921600)),
        ("serial:/dev/serial/by-id/usb-a:b:57600", ("serial", "/dev/serial/by-id/usb-a:b", 57600)),
        ("udpin:0.0.0.0:14550", ("udpin", "0.0.0.0", 14550)),
        ("udpin::14550", ("udpin", "127.0.0.1", 14550)),
        ("udpin:14550", ("udpin", "127.0.0.1", 14550)),
        ("tcpin:5760", ("tcpin", "127.0.0.1", 5760)),
        ("udpout:[::1]:14550", ("udpout", "::1", 14550)),
        ("tcp:sitl.local:5760", ("tcp", "sitl.local", 5760)),
    ],
)
def test_connection_strings(text: str, address: tuple[str, str, int]) -> None:
    assert Address.parse(text) == address
    assert Address.parse(str(Address.parse(text))) == address


@pytest.mark.parametrize(
    "text",
    ["", "udp:1.2.3.4:5", "tcp:5760", "tcp::5760", "udpout:host:", "udpin:host:x", "serial:57600", "14550"],
)
def test_a_bad_connection_string_is_quoted_with_the_forms(text: str) -> None:
    with pytest.raises(ValueError, match=r"no connection string.*udpin:HOST:PORT") as error:
        Address.parse(text)
    assert repr(text) in str(error.value)


def test_impossible_ports_and_baud_rates_are_named() -> None:
    with pytest.raises(ValueError, match="70000 is not a port"):
        Address.parse("tcp:host:70000")
    with pytest.raises(ValueError, match="57601 is not a baud rate"):
        Address.parse("serial:/dev/ttyS0:57601")


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
        for stream in (server, *clients):
            stream.close()

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
        assert reads <= 200 // transport.BURST + 2
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


@pytest.mark.parametrize("kind", ["udpin", "tcpin"])
def test_a_port_in_use_is_one_clear_sentence_and_no_retry(kind: str) -> None:
    async def test() -> None:
        with socket.socket(type=socket.SOCK_DGRAM if kind == "udpin" else socket.SOCK_STREAM) as taken:
            taken.bind(("127.0.0.1", 0))
            if kind == "tcpin":
                taken.listen()
            address = Address(kind, "127.0.0.1", taken.getsockname()[1])
            with pytest.raises(CannotListen, match=f"cannot listen on {address}: .*choose another port"):
                await anext(connections(address, random.random, print))

    run(test())


def test_a_missing_device_is_said_once_and_opened_when_it_is_there(tmp_path: Path) -> None:
    async def test() -> None:
        master, slave = pty.openpty()
        tty.setraw(master)
        device = tmp_path / "ttyFC"
        said: list[str] = []
        links = connections(Address.parse(f"serial:{device}:921600"), lambda: 1.0, said.append)
        waiting = asyncio.ensure_future(anext(links))
        await asyncio.sleep(0.5)
        assert said == [f"serial:{device}:921600: {os.strerror(errno.ENOENT)}; trying again"]
        device.symlink_to(os.ttyname(slave))
        line = await waiting
        every_byte = bytes(range(256))
        os.write(master, every_byte)
        assert await read_exactly(line, 256) == every_byte
        line.write(every_byte)
        await asyncio.sleep(0.01)
        assert os.read(master, 1000) == every_byte
        os.close(slave)
        os.close(master)
        with pytest.raises(ConnectionError, match="ttyFC"):
            await line.read()
        await links.aclose()

    run(test())


def test_a_file_that_is_no_serial_line_is_told(tmp_path: Path) -> None:
    (tmp_path / "file").write_bytes(b"")

    async def test() -> None:
        with pytest.raises(OSError, match="not a serial line"):
            await connect(Address("serial", str(tmp_path / "file"), 57600))

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
            assert other._held < transport.INBOX_LIMIT + transport.AT_ONCE
            if one.dropped:
                break
        assert len(await read_exactly(other, total - one.dropped * len(data))) == total - one.dropped * len(
            data
        )
        one.close()
        other.close()

    run(test())


def test_pauses_double_to_their_limit_and_are_jittered_down_to_a_half() -> None:
    whole, half = back_off(lambda: 0.0), back_off(lambda: 1.0)
    longest = [next(whole) for _ in range(8)]
    assert longest == [0.25, 0.5, 1, 2, 4, 8, 10, 10]
    assert [next(half) for _ in range(8)] == [p / 2 for p in longest]


def test_a_name_that_is_not_known_is_said(monkeypatch: pytest.MonkeyPatch) -> None:
    async def test() -> None:
        async def unknown(*_: object, **__: object) -> None:
            raise socket.gaierror(socket.EAI_NONAME, "Name or service not known")

        monkeypatch.setattr(asyncio.get_running_loop(), "getaddrinfo", unknown)
        said: list[str] = []
        waiting = asyncio.ensure_future(
            anext(connections(Address("tcp", "no.such", 1), lambda: 1.0, said.append))
        )
        await asyncio.sleep(0.5)
        waiting.cancel()
        await asyncio.gather(waiting, return_exceptions=True)
        assert said == ["tcp:no.such:1: Name or service not known; trying again"]

    run(test())
