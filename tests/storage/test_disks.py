"""Failing disks: full, read-only or blocked, they never hold navigation up."""

import asyncio
import dataclasses
import errno
import os
import random
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest

from companion.config import load
from companion.link import dialect, frame
from companion.records import Event, Reset, Solution
from companion.runtime import state_file
from companion.runtime.service import Service
from companion.storage import flight_log
from companion.storage.mcap_file import DiskFile
from companion.storage.reader import LogError
from companion.storage.recovery import recover
from companion.storage.retention import create_log
from companion.transport.reconnect import Address, connect
from sitl.autopilot import SimulatedAutopilot
from sitl.scenarios import SensorRates, get_scenario
from tests.network import free_port, until

LOOPBACK = "127.0.0.1"
EVERY_S = 0.2  # interval of solutions and of their messages


class FaultyDisk:
    """A disk that blocks or fails until it is set to work again; the thread that navigates never uses it."""

    def __init__(self, path: Path) -> None:
        self.disk = DiskFile(path)
        self.error: int | None = None
        self.working = threading.Event()
        self.working.set()
        self.navigates: threading.Thread | None = None  # not before the log is open
        self.held = set[threading.Thread]()

    def wait(self) -> None:
        assert threading.current_thread() is not self.navigates
        if not self.working.is_set():
            self.held.add(threading.current_thread())
        assert self.working.wait(200.0)

    def write(self, at: int, data: bytes) -> None:
        self.wait()
        if self.error is not None:
            raise OSError(self.error, os.strerror(self.error))
        self.disk.write(at, data)

    def sync(self) -> None:
        self.wait()
        self.disk.sync()

    def __getattr__(self, name: str):
        return getattr(self.disk, name)


async def fly(port: int, arrivals: list[int], more: list[bytes]) -> None:
    """Simulate an autopilot until cancelled; append the times that NAVIGATION_STATUS states."""
    scenario = dataclasses.replace(get_scenario("short"), rates=SensorRates(imu=1.0, truth=1.0))
    autopilot, begun = SimulatedAutopilot(scenario), time.monotonic_ns()
    stream = await connect(Address.parse(f"udpout:{LOOPBACK}:{port}"))

    async def listen() -> None:
        while True:
            data = await stream.read()
            autopilot.receive(data, time.monotonic_ns() - begun)
            arrivals.extend(m.time_usec for _, m in autopilot.outputs if m.get_type() == "NAVIGATION_STATUS")
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


def statuses(log: Path) -> set[int]:
    """Return the times that NAVIGATION_STATUS states in the sent frames of a log."""
    frames = (e.value for e in flight_log.read(log) if e.topic.endswith("/tx"))
    found = (one for data in frames for one in frame.Reader().receive(data) if isinstance(one, frame.Frame))
    messages = (dialect.decode(one) for one in found if one.msgid in dialect.TYPES)
    return {message.time_usec for message in messages if message.get_type() == "NAVIGATION_STATUS"}


def test_solutions_go_on_with_a_failing_or_blocked_disk(tmp_path: Path, monkeypatch) -> None:
    """The disk is blocked until fifty more have arrived: whatever waited for it would wait for ever."""
    port, events, arrivals, more = free_port(), list[Event](), list[int](), list[bytes]()
    disks: list[FaultyDisk] = []
    log = flight_log.Writer(
        tmp_path / "a.mcap",
        metadata={},
        start_unix_ns=time.time_ns(),
        start_ns=time.monotonic_ns(),
        disk=lambda path: disks.append(FaultyDisk(path)) or disks[0],
    )
    disks[0].navigates = threading.main_thread()
    whole = state_file.replace_text

    def replace_slowly(path: Path, text: str) -> None:
        disks[0].wait()
        whole(path, text)

    monkeypatch.setattr(state_file, "replace_text", replace_slowly)
    parameters = tmp_path / "set.toml"
    flags = {"output.status_hz": 1.0 / EVERY_S, "link.parameters_file": str(parameters)}
    flags["inertial.independent"] = True  # its positions alone move the channel
    wish = dialect.new(
        "PARAM_SET",
        param_id=b"GNSS_SIGMA_M",
        param_value=3.5,
        param_type=9,
        target_system=1,
        target_component=191,
    )

    async def solutions(number: int) -> None:
        wanted = len(arrivals) + number
        await until(lambda: len(arrivals) >= wanted, 150.0)

    def reported(text: str) -> bool:
        return any(text in event.text for event in events)

    async def play() -> None:
        config = load(None, flags | {"link.connect": (f"udpin:{LOOPBACK}:{port}",)}, {})
        service, stopped = Service(config, log, events.append), asyncio.Event()
        serving, flying = (
            asyncio.create_task(c) for c in (service.serve(stopped), fly(port, arrivals, more))
        )
        try:
            await solutions(12)
            for number, text in ((errno.ENOSPC, "No space left"), (errno.EROFS, "Read-only file system")):
                disks[0].error = number
                await until(lambda text=text: reported(text))
                assert reported("; navigation continues")
                await solutions(12)
                disks[0].error = None
                await until(lambda: reported("log: writing resumed"))
                events.clear()
            disks[0].working.clear()
            more.append(frame.encode(wish, 0, 255, 190))  # the parameter is stored on the same disk
            await until(lambda: len(disks[0].held) == 2)
            await solutions(50)
            assert not parameters.exists()
            disks[0].working.set()
            await until(lambda: parameters.exists() and "sigma_m = 3.5" in parameters.read_text())
            await solutions(12)
        finally:
            disks[0].working.set()
            flying.cancel()
            stopped.set()
            await serving

    asyncio.run(play())
    assert log.close() and log.dropped == 0
    assert set(arrivals) <= statuses(tmp_path / "a.mcap")  # nothing was lost
    kinds = [type(e.value) for e in flight_log.read(tmp_path / "a.mcap")]
    assert kinds.count(Solution) >= len(set(arrivals))


#: Fault: the disk of the parameters file, to which a parameter is written, responds late or never. It is late
#: by the end of the flight and a second; a busy machine may take longer, so the limit is a minute then.
KEEPING = """
import sys, threading, time
from pathlib import Path
from companion.runtime import service, state_file
from companion.__main__ import main
whole, serve, ended = state_file.replace_text, service.Service.serve, threading.Event()
def hang(path, text):
    print("writing", flush=True)
    ended.wait()
    if {dead}:
        threading.Event().wait()
    time.sleep(1.0)
    whole(path, text)
async def serve_and_tell(self, stopped):
    await serve(self, stopped)
    ended.set()
service.Service.serve = serve_and_tell
if not {dead}:
    service.STOP_TIMEOUT_S = 60.0
state_file.replace_text = hang
init = service.Service.__init__
def wishing(self, *arguments, **named):
    init(self, *arguments, **named)
    self._parameters_file.put("kept")
service.Service.__init__ = wishing
sys.argv[0] = "companion"
main()
"""


@pytest.mark.parametrize("dead", [True, False])
def test_shutdown_waits_for_a_slow_disk_but_not_for_a_dead_one(tmp_path: Path, dead: bool) -> None:
    parameters, logs = tmp_path / "set.toml", tmp_path / "logs"
    command = [sys.executable, "-c", KEEPING.format(dead=dead), "run", "--logs", str(logs)]
    command += ["--connect", f"udpin:{LOOPBACK}:{free_port()}"]
    command += ["--set", f"link.parameters_file={parameters}"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True) as process:
        try:
            assert process.stdout is not None and process.stdout.readline() == "writing\n"
            process.send_signal(signal.SIGTERM)
            assert process.wait(120) == 0
        finally:
            process.kill()
    assert (parameters.read_text() if parameters.exists() else None) == (None if dead else "kept")
    (log,) = logs.iterdir()
    assert flight_log.info(log).closed


# -- processes with a disk of their own ----------------------------------------------------------------------


@pytest.fixture
def small_disk(tmp_path: Path):
    """A file system of two mebibytes, if one can be mounted."""
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


def test_full_disk_is_reported_and_writing_resumes(small_disk, tmp_path) -> None:
    port, log_text = free_port(), tmp_path / "log_text"
    ballast = small_disk / "ballast"
    ballast.write_bytes(random.randbytes(2_050_000))
    command = [sys.executable, "-m", "companion", "run", "--connect", f"udpin:{LOOPBACK}:{port}"]
    command += ["--logs", str(small_disk / "logs"), "--set", "log.minimum_free_mib=0"]
    arrivals = list[float]()

    async def play() -> None:
        flying = asyncio.create_task(fly(port, arrivals, []))
        try:
            await until(lambda: "No space left on device; navigation continues" in log_text.read_text())
            full = len(arrivals)
            await until(lambda: len(arrivals) > full + 2)  # solutions continue
            ballast.unlink()
            await until(lambda: "log: writing resumed" in log_text.read_text())
        finally:
            flying.cancel()

    with log_text.open("w") as stderr, subprocess.Popen(command, stderr=stderr) as process:
        asyncio.run(play())
        process.send_signal(signal.SIGTERM)
        assert process.wait(60) == 0
    (log,) = (small_disk / "logs").iterdir()
    assert flight_log.info(log).closed


def test_oldest_logs_are_deleted_while_a_log_is_written(small_disk) -> None:
    for day in (1, 2, 3):
        (small_disk / f"2026010{day}T000000Z.mcap").write_bytes(random.randbytes(400_000))
    (small_disk / "mine.txt").write_bytes(bytes(100_000))
    log = create_log(
        small_disk, metadata={}, start_unix_ns=1_800_000_000 * 10**9, start_ns=0, min_free=300_000,
        chunk_bytes=4096, fsync_s=0.05,
    )  # fmt: skip
    for i in range(1000):
        log.record(Reset(i, i, "test", random.randbytes(400).hex()))
        time.sleep(0.001)
    room = free(small_disk)
    assert log.close() and log.dropped == 0
    assert room >= 300_000 - 4096
    left = sorted(path.name for path in small_disk.iterdir())
    new = "00001-20270115T080000Z.mcap"
    assert left == [new, "20260102T000000Z.mcap", "20260103T000000Z.mcap", "mine.txt"]


def torn_log(folder: Path) -> Path:
    """Return a log of 1000 messages, half a mebibyte, without its end."""
    with flight_log.Writer(folder / "x.mcap", metadata={}, start_unix_ns=10**18, start_ns=0) as log:
        for i in range(1000):
            log.record(Reset(i, i, "test", random.randbytes(400).hex()))
    torn = folder / "20260101T000000Z.mcap.active"
    torn.write_bytes((folder / "x.mcap").read_bytes()[:-1000])
    (folder / "x.mcap").unlink()
    return torn


def test_missing_end_is_recovered_without_space_for_a_copy(small_disk) -> None:
    torn = torn_log(small_disk)
    (small_disk / "ballast").write_bytes(bytes(free(small_disk) - 20_000))
    size = torn.stat().st_size
    with pytest.raises(LogError, match="cannot write the recovered log"):
        recover(torn, reserve=20_000)
    assert torn.stat().st_size <= size  # no part of the end was written
    assert recover(torn, reserve=10_000).messages == 1000
    assert {path.name for path in small_disk.iterdir()} == {"20260101T000000Z.mcap", "ballast"}
    assert flight_log.info(small_disk / "20260101T000000Z.mcap").closed
    assert free(small_disk) >= 10_000


def test_failed_recovery_copy_is_removed_and_keeps_the_reserve(small_disk) -> None:
    torn = torn_log(small_disk)
    content = bytearray(torn.read_bytes())
    content[len(content) // 2] ^= 0xFF  # damaged: the end alone is not sufficient
    torn.write_bytes(content)
    (small_disk / "ballast").write_bytes(bytes(1_300_000))
    with pytest.raises(LogError, match="cannot write the recovered log"):
        recover(torn, reserve=200_000)
    assert {path.name for path in small_disk.iterdir()} == {torn.name, "ballast"}
    assert torn.read_bytes() == content
    (small_disk / "ballast").unlink()
    assert 500 < recover(torn, reserve=200_000).messages < 1000
