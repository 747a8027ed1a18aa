"""Links opened again for ever: when not, after which pauses, and what is said."""

import asyncio
import errno
import os
import random
import socket
from collections.abc import Callable, Coroutine
from typing import Any

import pytest

from companion.transport import links
from companion.transport.address import Address
from companion.transport.links import CannotListen, back_off, connections


def run(test: Coroutine[Any, Any, None]) -> None:
    async def limited() -> None:
        async with asyncio.timeout(20):
            await test

    asyncio.run(limited())


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


async def until(condition: Callable[[], bool]) -> None:
    for _ in range(2000):
        if condition():
            return
        await asyncio.sleep(0.005)
    raise TimeoutError


def binding(monkeypatch: pytest.MonkeyPatch, *errors: int) -> list[Any]:
    """What `bind` was called with; it fails with these errors in turn, and passes at a 0 and after."""
    real, called, waiting = socket.socket.bind, list[Any](), list(errors)

    def bind(sock: socket.socket, where: Any) -> None:
        called.append(where)
        if waiting and (number := waiting.pop(0)):
            raise OSError(number, os.strerror(number))
        real(sock, where)

    monkeypatch.setattr(socket.socket, "bind", bind)
    monkeypatch.setattr(links, "SHORTEST_PAUSE", 0.002)
    return called


@pytest.mark.parametrize("number", [errno.EACCES, errno.EINVAL])
def test_an_address_that_never_will_be_had_ends_it(monkeypatch: pytest.MonkeyPatch, number: int) -> None:
    async def test() -> None:
        called = binding(monkeypatch, number)
        with pytest.raises(CannotListen, match=rf"{os.strerror(number)}; choose another host or port"):
            await anext(connections(Address("udpin", "127.0.0.1", 0), random.random, print))
        assert len(called) == 1

    run(test())


@pytest.mark.parametrize("kind", ["udpin", "tcpin"])
def test_an_address_that_is_not_there_yet_is_said_once_and_waited_for(
    monkeypatch: pytest.MonkeyPatch, kind: str
) -> None:
    async def test() -> None:
        said: list[str] = []
        called = binding(monkeypatch, *[errno.EADDRNOTAVAIL] * 5)
        address = Address(kind, "127.0.0.1", 0)
        links = connections(address, random.random, said.append)
        opening = asyncio.ensure_future(anext(links))
        await until(lambda: len(called) == 6)
        assert said == [f"{address}: this computer has no address 127.0.0.1 at present; trying again"]
        opening.cancel()
        await asyncio.gather(opening, return_exceptions=True)
        await links.aclose()

    run(test())


@pytest.mark.parametrize("number", [errno.EADDRINUSE, errno.EACCES, errno.EADDRNOTAVAIL])
def test_opening_again_never_ends_it(monkeypatch: pytest.MonkeyPatch, number: int) -> None:
    async def test() -> None:
        said: list[str] = []
        called = binding(monkeypatch, 0, *[number] * 5)
        links = connections(Address("udpin", "127.0.0.1", 0), random.random, said.append)
        (await anext(links)).close()
        (await anext(links)).close()
        assert len(called) == 7
        assert len(said) == 1 and said[0].endswith("; trying again")
        await links.aclose()

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
