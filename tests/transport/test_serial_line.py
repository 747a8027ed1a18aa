"""Serial lines over a pseudo-terminal, and devices that are not serial lines."""

import asyncio
import errno
import os
import pty
import tty
from pathlib import Path

import pytest

from companion.transport.address import Address
from companion.transport.reconnect import connect, connections
from tests.network import read_exactly, until


async def test_missing_device_is_reported_once_and_opened_when_present(tmp_path: Path) -> None:
    master, slave = pty.openpty()
    tty.setraw(master)
    device = tmp_path / "ttyFC"
    reports: list[str] = []
    links = connections(Address.parse(f"serial:{device}:921600"), lambda: 1.0, reports.append)
    waiting = asyncio.ensure_future(anext(links))
    await asyncio.sleep(0.5)  # several attempts
    assert reports == [f"serial:{device}:921600: no such device; see `ls /dev/serial/by-id`; trying again"]
    device.symlink_to(os.ttyname(slave))
    line = await waiting
    every_byte = bytes(range(256))
    os.write(master, every_byte)
    assert await read_exactly(line, 256) == every_byte
    line.write(every_byte)
    arrived = b""
    while len(arrived) < 256:  # the system may pass them on in pieces
        arrived += os.read(master, 1000)
    assert arrived == every_byte
    os.close(slave)
    os.close(master)
    with pytest.raises(ConnectionError, match="ttyFC"):
        await line.read()
    await links.aclose()


async def test_file_that_is_not_a_serial_line_is_reported(tmp_path: Path) -> None:
    (tmp_path / "file").write_bytes(b"")

    with pytest.raises(OSError, match="not a serial line"):
        await connect(Address("serial", str(tmp_path / "file"), 57600))


async def test_line_is_exclusive_until_it_is_closed() -> None:
    master, slave = pty.openpty()  # another process keeps it open
    address = Address("serial", os.ttyname(slave), 57600)
    line = await connect(address)
    reports: list[str] = []
    links = connections(address, lambda: 1.0, reports.append)
    waiting = asyncio.ensure_future(anext(links))
    await until(lambda: bool(reports))
    assert reports == [f"{address}: another program has this line open: end it; trying again"]
    os.write(master, b"all of it")
    assert await read_exactly(line, 9) == b"all of it"
    line.close()
    second = await waiting
    os.write(master, b"again")
    assert await read_exactly(second, 5) == b"again"
    await links.aclose()
    os.close(slave)
    os.close(master)


async def test_busy_device_is_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    def taken(*_: object) -> int:
        raise OSError(errno.EBUSY, os.strerror(errno.EBUSY))

    with monkeypatch.context() as patch:
        patch.setattr(os, "open", taken)
        with pytest.raises(OSError, match="another program has this line open"):
            await connect(Address("serial", "/dev/ttyFC", 57600))


async def test_forbidden_device_is_reported_with_the_group(monkeypatch: pytest.MonkeyPatch) -> None:
    def forbidden(*_: object) -> int:
        raise PermissionError(errno.EACCES, os.strerror(errno.EACCES))

    reports: list[str] = []
    with monkeypatch.context() as patch:
        patch.setattr(os, "open", forbidden)
        links = connections(Address("serial", "/dev/ttyFC", 57600), lambda: 1.0, reports.append)
        waiting = asyncio.ensure_future(anext(links))
        await until(lambda: reports)
    waiting.cancel()
    await asyncio.gather(waiting, return_exceptions=True)
    (report,) = reports
    assert "add this user to the group of the serial port (usually dialout)" in report


async def test_full_line_does_not_block() -> None:
    master, slave = pty.openpty()
    line = await connect(Address("serial", os.ttyname(slave), 57600))
    line._send_queue._now = lambda: 0.0
    for _ in range(100):
        line.write(b"before" * 100)
    line._send_queue._now = lambda: 1.0
    line.write(b"after")
    assert line.dropped > 10
    line.close()
    os.close(slave)
    os.close(master)
