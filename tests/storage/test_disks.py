"""No disk holds navigation up: full, read-only or blocked for ten seconds, solutions go out on time."""

import asyncio
import dataclasses
import errno
import os
import random
import signal
import socket
import subprocess
import sys
import threading
import time
from itertools import pairwise
from pathlib import Path

import pytest

from companion.config import load
from companion.link import dialect, frame
from companion.records import Event, Solution
from companion.runtime import state_file
from companion.runtime.service import Service
from companion.storage import flight_log
from companion.storage.mcap_file import DiskFile
from companion.storage.retention import open_log
from companion.transport.links import Address, connect
from sitl.autopilot import Autopilot
from sitl.scenarios import Rates, named

LOOPBACK = "127.0.0.1"
EVERY_S = 0.2  # a solution of the companion's, and its message
#: Another program may have the processor for that long; a disk that held us up would take its whole time.
LATE_S = 0.8


def free_port() -> int:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:
        sock.bind((LOOPBACK, 0))
        return sock.getsockname()[1]


async def until(condition, seconds: float = 30.0) -> None:
    for _ in range(round(seconds / 0.05)):
        if condition():
            return
        await asyncio.sleep(0.05)
    raise TimeoutError


class Sick:
    """A disk that does what it is told, until it is told to be well."""

    def __init__(self, path: Path) -> None:
        self.disk = DiskFile(path)
        self.error: int | None = None
        self.well = threading.Event()
        self.well.set()

    def write(self, data: bytes) -> None:
        self.well.wait(30.0)
        if self.error is not None:
            raise OSError(self.error, os.strerror(self.error))
        self.disk.write(data)

    def sync(self) -> None:
        self.well.wait(30.0)
        self.disk.sync()

    def __getattr__(self, name: str):
        return getattr(self.disk, name)


async def fly(port: int, arrivals: list[float], more: list[bytes]) -> None:
    """Be the autopilot of a flight until cancelled; when each NAVIGATION_STATUS came."""
    scenario = dataclasses.replace(named("short"), rates=Rates(imu=1.0, truth=1.0))
    autopilot, begun = Autopilot(scenario), time.monotonic_ns()
    stream = await connect(Address.parse(f"udpout:{LOOPBACK}:{port}"))

    async def listen() -> None:
        while True:
            data = await stream.read()
            autopilot.receive(data, time.monotonic_ns() - begun)
            arrivals.extend(
                time.monotonic() for _, m in autopilot.outputs if m.get_type() == "NAVIGATION_STATUS"
            )
            autopilot.outputs.clear()

    listening = asyncio.create_task(listen())
    try:
        while True:
            for data in autopilot.poll(time.monotonic_ns() - begun):
                stream.write(data)
            while more:
                stream.write(more.pop())
            await asyncio.sleep(0.01)
    finally:
        listening.cancel()
        stream.close()


def longest_gap(arrivals: list[float], since: float, until: float) -> float:
    inside = [t for t in arrivals if since <= t <= until]
    return max((b - a for a, b in pairwise([since, *inside, until])), default=until - since)


def test_solutions_go_out_on_time_whatever_the_disk_does(tmp_path: Path, monkeypatch) -> None:
    port, told, arrivals, more = free_port(), list[Event](), list[float](), list[bytes]()
    sick: list[Sick] = []
    gaps: dict[str, float] = {}
    log = flight_log.Writer(
        tmp_path / "a.mcap",
        metadata={},
        start_unix_ns=time.time_ns(),
        start_ns=time.monotonic_ns(),
        disk=lambda path: sick.append(Sick(path)) or sick[0],
    )
    whole = state_file.replace_text

    def slowly(path: Path, text: str) -> None:
        sick[0].well.wait(30.0)
        whole(path, text)

    monkeypatch.setattr(state_file, "replace_text", slowly)
    parameters = tmp_path / "set.toml"
    flags = {"output.status_hz": 1.0 / EVERY_S, "link.parameters_file": str(parameters)}
    wish = dialect.new(
        "PARAM_SET",
        param_id=b"GNSS_SIGMA_M",
        param_value=3.5,
        param_type=9,
        target_system=1,
        target_component=191,
    )

    async def phase(name: str, seconds: float) -> None:
        since = time.monotonic()
        await asyncio.sleep(seconds)
        gaps[name] = longest_gap(arrivals, since, time.monotonic())

    async def play() -> None:
        config = load(None, flags | {"link.connect": (f"udpin:{LOOPBACK}:{port}",)}, {})
        service = Service(config, log, told.append)
        serving, flying = (asyncio.create_task(c) for c in (service.serve(), fly(port, arrivals, more)))
        try:
            await until(lambda: len(arrivals) >= 5)
            await phase("well", 1.5)
            for name, number in (("full", errno.ENOSPC), ("read-only", errno.EROFS)):
                sick[0].error = number
                await phase(name, 2.5)
            sick[0].error = None
            sick[0].well.clear()
            more.append(frame.encode(wish, 0, 255, 190))  # a parameter is to be kept on the same disk
            await phase("blocked", 10.0)
            assert not parameters.exists()
            sick[0].well.set()
            await phase("well again", 2.5)
        finally:
            flying.cancel()
            service.stop()
            await serving

    asyncio.run(play())
    assert log.close() and log.dropped == 0
    assert all(gap < LATE_S for gap in gaps.values()), gaps
    texts = " ".join(event.text for event in told)
    assert "No space left on device; navigation goes on" in texts and "log: writing again" in texts
    assert "sigma_m = 3.5" in parameters.read_text()
    solutions = [e.value.rx_ns for e in flight_log.read(tmp_path / "a.mcap") if isinstance(e.value, Solution)]
    assert max(b - a for a, b in pairwise(solutions)) < LATE_S * 1e9  # nothing was lost meanwhile


#: The fault: the disk of the parameters never answers (or only after a while), and one is to be kept there.
KEEPING = """
import sys, threading, time
from pathlib import Path
from companion import kept, service
from companion.__main__ import main
whole, wait = kept.replace_text, {wait}
def hang(path, text):
    print("asked", flush=True)
    wait()
    whole(path, text)
kept.replace_text = hang
init = service.Service.__init__
def wishing(self, *arguments, **named):
    init(self, *arguments, **named)
    self._kept.put("kept")
service.Service.__init__ = wishing
sys.argv[0] = "companion"
main()
"""


@pytest.mark.parametrize(
    ("wait", "kept_text"), [("threading.Event().wait", None), ("lambda: time.sleep(2.0)", "kept")]
)
def test_a_disk_that_answers_late_is_waited_for_at_the_end_and_one_that_never_does_is_not(
    tmp_path: Path, wait: str, kept_text: str | None
) -> None:
    parameters, logs = tmp_path / "set.toml", tmp_path / "logs"
    command = [sys.executable, "-c", KEEPING.format(wait=wait), "run", "--logs", str(logs)]
    command += ["--connect", f"udpin:{LOOPBACK}:{free_port()}"]
    command += ["--set", f"link.parameters_file={parameters}"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True) as process:
        try:
            assert process.stdout is not None and process.stdout.readline() == "asked\n"
            process.send_signal(signal.SIGTERM)
            assert process.wait(25) == 0
        finally:
            process.kill()
    assert (parameters.read_text() if parameters.exists() else None) == kept_text
    (log,) = logs.iterdir()
    assert flight_log.info(log).closed


# -- whole processes on a disk of their own ------------------------------------------------------------------


@pytest.fixture
def small_disk(tmp_path: Path):
    """Two mebibytes that are a file system of their own, where one may be mounted."""
    place = tmp_path / "disk"
    place.mkdir()
    mounted = (
        os.geteuid() == 0
        and not subprocess.run(
            ["mount", "-t", "tmpfs", "-o", "size=2m", "tmpfs", str(place)], capture_output=True
        ).returncode
    )
    if not mounted:
        pytest.skip("no file system can be mounted here")
    yield place
    subprocess.run(["umount", "-l", str(place)], check=True)


def free(folder: Path) -> int:
    room = os.statvfs(folder)
    return room.f_bavail * room.f_frsize


def test_a_disk_that_fills_up_is_said_and_written_to_again_when_there_is_room(small_disk, tmp_path) -> None:
    port, said = free_port(), tmp_path / "said"
    ballast = small_disk / "ballast"
    ballast.write_bytes(random.randbytes(2_050_000))
    command = [sys.executable, "-m", "companion", "run", "--connect", f"udpin:{LOOPBACK}:{port}"]
    command += ["--logs", str(small_disk / "logs"), "--set", "log.minimum_free_mib=0"]
    arrivals = list[float]()

    async def play() -> None:
        flying = asyncio.create_task(fly(port, arrivals, []))
        try:
            await until(lambda: "No space left on device; navigation goes on" in said.read_text())
            full = len(arrivals)
            await until(lambda: len(arrivals) > full + 2)  # solutions go on
            ballast.unlink()
            await until(lambda: "log: writing again" in said.read_text())
        finally:
            flying.cancel()

    with said.open("w") as stderr, subprocess.Popen(command, stderr=stderr) as process:
        asyncio.run(play())
        process.send_signal(signal.SIGTERM)
        assert process.wait(20) == 0
    (log,) = (small_disk / "logs").iterdir()
    assert flight_log.info(log).closed


def test_room_is_made_while_a_log_is_written_by_the_age_of_the_others(small_disk) -> None:
    for day in (1, 2, 3):
        (small_disk / f"2026010{day}T000000Z.mcap").write_bytes(random.randbytes(400_000))
    (small_disk / "mine.txt").write_bytes(bytes(100_000))
    log = open_log(
        small_disk, metadata={}, start_unix_ns=1_800_000_000 * 10**9, start_ns=0, min_free=300_000,
        chunk_bytes=4096, fsync_s=0.05,
    )  # fmt: skip
    for i in range(1000):
        log.record(Event(i, i, 6, random.randbytes(400).hex()))
        time.sleep(0.001)
    room = free(small_disk)
    assert log.close() and log.dropped == 0
    assert room >= 300_000 - 4096
    left = sorted(path.name for path in small_disk.iterdir())
    new = "00001-20270115T080000Z.mcap"
    assert left == [new, "20260102T000000Z.mcap", "20260103T000000Z.mcap", "mine.txt"]


def torn_log(folder: Path) -> Path:
    """A log of 1000 messages, half a mebibyte, that lacks its end."""
    with flight_log.Writer(folder / "x.mcap", metadata={}, start_unix_ns=10**18, start_ns=0) as log:
        for i in range(1000):
            log.record(Event(i, i, 6, random.randbytes(400).hex()))
    torn = folder / "20260101T000000Z.mcap.active"
    torn.write_bytes((folder / "x.mcap").read_bytes()[:-1000])
    (folder / "x.mcap").unlink()
    return torn


def test_a_log_that_lacks_its_end_is_mended_on_a_disk_with_no_room_for_a_second_one(small_disk) -> None:
    torn = torn_log(small_disk)
    (small_disk / "ballast").write_bytes(bytes(free(small_disk) - 20_000))
    size = torn.stat().st_size
    with pytest.raises(flight_log.LogError, match="cannot write the recovered log"):
        flight_log.recover(torn, reserve=20_000)
    assert torn.stat().st_size <= size  # nothing of the end was begun
    assert flight_log.recover(torn, reserve=10_000).messages == 1000
    assert {path.name for path in small_disk.iterdir()} == {"20260101T000000Z.mcap", "ballast"}
    assert flight_log.info(small_disk / "20260101T000000Z.mcap").closed
    assert free(small_disk) >= 10_000


def test_a_copy_that_finds_no_room_is_taken_back_and_the_reserve_is_left(small_disk) -> None:
    torn = torn_log(small_disk)
    content = bytearray(torn.read_bytes())
    content[len(content) // 2] ^= 0xFF  # an end alone would not mend it
    torn.write_bytes(content)
    (small_disk / "ballast").write_bytes(bytes(1_300_000))
    with pytest.raises(flight_log.LogError, match="cannot write the recovered log"):
        flight_log.recover(torn, reserve=200_000)
    assert {path.name for path in small_disk.iterdir()} == {torn.name, "ballast"}
    assert torn.read_bytes() == content
    (small_disk / "ballast").unlink()
    assert 500 < flight_log.recover(torn, reserve=200_000).messages < 1000
