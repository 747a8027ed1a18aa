"""Reconnecting: retries, pauses and reports."""

import asyncio
import errno
import os
import random
import socket
from typing import Any

import pytest

from companion.transport import reconnect
from companion.transport.address import Address
from companion.transport.reconnect import CannotListen, back_off, connections
from tests.network import until


@pytest.mark.parametrize("kind", ["udpin", "tcpin"])
async def test_port_in_use_is_one_error_without_retry(kind: str) -> None:
    with socket.socket(type=socket.SOCK_DGRAM if kind == "udpin" else socket.SOCK_STREAM) as taken:
        taken.bind(("127.0.0.1", 0))
        if kind == "tcpin":
            taken.listen()
        address = Address(kind, "127.0.0.1", taken.getsockname()[1])
        with pytest.raises(CannotListen, match=f"cannot listen on {address}: .*choose another port"):
            await anext(connections(address, random.random, print))


def binding(monkeypatch: pytest.MonkeyPatch, *errors: int) -> list[Any]:
    """Make `bind` fail with these errors in turn (0: succeed); return the list of its arguments."""
    real, called, waiting = socket.socket.bind, list[Any](), list(errors)

    def bind(sock: socket.socket, where: Any) -> None:
        called.append(where)
        if waiting and (number := waiting.pop(0)):
            raise OSError(number, os.strerror(number))
        real(sock, where)

    monkeypatch.setattr(socket.socket, "bind", bind)
    monkeypatch.setattr(reconnect, "MIN_PAUSE", 0.002)
    return called


@pytest.mark.parametrize("number", [errno.EACCES, errno.EINVAL])
async def test_permanently_unusable_address_is_an_error(monkeypatch: pytest.MonkeyPatch, number: int) -> None:
    called = binding(monkeypatch, number)
    with pytest.raises(CannotListen, match=rf"{os.strerror(number)}; choose another host or port"):
        await anext(connections(Address("udpin", "127.0.0.1", 0), random.random, print))
    assert len(called) == 1


@pytest.mark.parametrize("kind", ["udpin", "tcpin"])
async def test_address_not_available_yet_is_reported_once_and_retried(
    monkeypatch: pytest.MonkeyPatch, kind: str
) -> None:
    reports: list[str] = []
    called = binding(monkeypatch, *[errno.EADDRNOTAVAIL] * 5)
    address = Address(kind, "127.0.0.1", 0)
    links = connections(address, random.random, reports.append)
    opening = asyncio.ensure_future(anext(links))
    await until(lambda: len(called) == 6)
    assert reports == [f"{address}: this computer has no address 127.0.0.1 at present; trying again"]
    opening.cancel()
    await asyncio.gather(opening, return_exceptions=True)
    await links.aclose()


@pytest.mark.parametrize("number", [errno.EADDRINUSE, errno.EACCES, errno.EADDRNOTAVAIL])
async def test_failure_to_reopen_is_always_retried(monkeypatch: pytest.MonkeyPatch, number: int) -> None:
    reports: list[str] = []
    called = binding(monkeypatch, 0, *[number] * 5)
    links = connections(Address("udpin", "127.0.0.1", 0), random.random, reports.append)
    (await anext(links)).close()
    (await anext(links)).close()
    assert len(called) == 7
    assert len(reports) == 1 and reports[0].endswith("; trying again")
    await links.aclose()


def test_pauses_double_up_to_their_limit_with_jitter_down_to_a_half() -> None:
    whole, half = back_off(lambda: 0.0), back_off(lambda: 1.0)
    longest = [next(whole) for _ in range(8)]
    assert longest == [0.25, 0.5, 1, 2, 4, 8, 10, 10]
    assert [next(half) for _ in range(8)] == [p / 2 for p in longest]


async def test_unknown_host_is_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    def unknown(*_: object, **__: object) -> None:
        raise socket.gaierror(socket.EAI_NONAME, "Name or service not known")

    monkeypatch.setattr(socket, "getaddrinfo", unknown)
    reports: list[str] = []
    waiting = asyncio.ensure_future(
        anext(connections(Address("tcp", "no.such", 1), lambda: 1.0, reports.append))
    )
    await asyncio.sleep(0.5)
    waiting.cancel()
    await asyncio.gather(waiting, return_exceptions=True)
    advice = "check the host name, or give an IP address"
    assert reports == [f"tcp:no.such:1: Name or service not known; {advice}; trying again"]
