"""Links opened again for ever: when not, after which pauses, and what is said."""

import asyncio
import random
import socket
from collections.abc import Coroutine
from typing import Any

import pytest

from companion.link.address import Address
from companion.link.transport import CannotListen, back_off, connections


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
