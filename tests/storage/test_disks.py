"""Failing disks: full, read-only or blocked for ten seconds, they never delay navigation."""

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
from itertools import pairwise
from pathlib import Path

import pytest

from companion.config import load
from companion.link import dialect, frame
from companion.records import Event, Reset, Solution
from companion.runtime import state_file
from companion.runtime.service import Service
from companion.storage import flight_log
from companion.storage.mcap_file import DiskFile
from companion.storage.retention import create_log
from companion.transport.reconnect import Address, connect
from sitl.autopilot import SimulatedAutopilot
from sitl.scenarios import SensorRates, get_scenario
from tests.network import free_port, until

LOOPBACK = "127.0.0.1"
EVERY_S = 0.2  # interval of solutions and of their messages
#: Tolerance for other programs on the processor; a blocking disk would delay for much longer.
LATE_S = 0.8


class FaultyDisk:
    """A disk that blocks or fails until it is set to work again."""

    def __init__(self, path: Path) -> None:
        self.disk = DiskFile(path)
        self.error: int | None = None
        self.working = threading.Event()
        self.working.set()

    def write(self, at: int, data: bytes) -> None:
        self.working.wait(30.0)
        if self.error is not None:
            raise OSError(self.error, os.strerror(self.error))
        self.disk.write(at, data)

    def sync(self) -> None:
        self.working.wait(30.0)
        self.disk.sync()

    def __getattr__(self, name: str):
        return getattr(self.disk, name)


async def fly(port: int, arrivals: list[float], more: list[bytes]) -> None:
    """Simulate an autopilot until cancelled; append the arrival times of NAVIGATION_STATUS."""
    scenario = dataclasses.replace(get_scenario("short"), rates=SensorRates(imu=1.0, truth=1.0))
    autopilot, begun = SimulatedAutopilot(scenario), time.monotonic_ns()
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


def test_solutions_are_on_time_with_a_failing_or_blocked_disk(tmp_path: Path, monkeypatch) -> None:
    port, events, arrivals, more = free_port(), list[Event](), list[float](), list[bytes]()
    disks: list[FaultyDisk] = []
    gaps: dict[str, float] = {}
    log = flight_log.Writer(
        tmp_path / "a.mcap",
        metadata={},
        start_unix_ns=time.time_ns(),
        start_ns=time.monotonic_ns(),
        disk=lambda path: disks.append(FaultyDisk(path)) or disks[0],
    )
    whole = state_file.replace_text

    def replace_slowly(path: Path, text: str) -> None:
        disks[0].working.wait(30.0)
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

    async def phase(name: str, seconds: float) -> None:
        since = time.monotonic()
        await asyncio.sleep(seconds)
        gaps[name] = longest_gap(arrivals, since, time.monotonic())

    async def play() -> None:
        config = load(None, flags | {"link.connect": (f"udpin:{LOOPBACK}:{port}",)}, {})
        service, stopped = Service(config, log, events.append), asyncio.Event()
        serving, flying = (
            asyncio.create_task(c) for c in (service.serve(stopped), fly(port, arrivals, more))
        )
        try:
            await until(lambda: len(arrivals) >= 5)
            await phase("working", 1.5)
            for name, number in (("full", errno.ENOSPC), ("read-only", errno.EROFS)):
                disks[0].error = number
                await phase(name, 2.5)
            disks[0].error = None
            disks[0].working.clear()
            more.append(frame.encode(wish, 0, 255, 190))  # the parameter is stored on the same disk
            await phase("blocked", 10.0)
            assert not parameters.exists()
            disks[0].working.set()
            await phase("working again", 2.5)
        finally:
            flying.cancel()
            stopped.set()
            await serving

    asyncio.run(play())
    assert log.close() and log.dropped == 0
    assert all(gap < LATE_S for gap in gaps.values()), gaps
    texts = " ".join(event.text for event in events)
    assert "No space left on device; navigation continues" in texts and "log: writing resumed" in texts
    assert "sigma_m = 3.5" in parameters.read_text()
    solutions = [e.value.rx_ns for e in flight_log.read(tmp_path / "a.mcap") if isinstance(e.value, Solution)]
    assert max(b - a for a, b in pairwise(solutions)) < LATE_S * 1e9  # nothing was lost


#: Fault: the disk of the parameters file, to which a parameter is written, responds late or never.
KEEPING = """
import sys, threading, time
from pathlib import Path
from companion.runtime import service, state_file
from companion.__main__ import main
whole, wait = state_file.replace_text, {wait}
def hang(path, text):
    print("writing", flush=True)
    wait()
    whole(path, text)
state_file.replace_text = hang
init = service.Service.__init__
def wishing(self, *arguments, **named):
    init(self, *arguments, **named)
    self._parameters_file.put("kept")
service.Service.__init__ = wishing
sys.argv[0] = "companion"
main()
"""


@pytest.mark.parametrize(
    ("wait", "kept_text"), [("threading.Event().wait", None), ("lambda: time.sleep(2.0)", "kept")]
)
def test_shutdown_waits_for_a_slow_disk_but_not_for_a_dead_one(
    tmp_path: Path, wait: str, kept_text: str | None
) -> None:
    parameters, logs = tmp_path / "set.toml", tmp_path / "logs"
    command = [sys.executable, "-c", KEEPING.format(wait=wait), "run", "--logs", str(logs)]
    command += ["--connect", f"udpin:{LOOPBACK}:{free_port()}"]
    command += ["--set", f"link.parameters_file={parameters}"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True) as process:
        try:
            assert process.stdout is not None and process.stdout.readline() == "writing\n"
            process.send_signal(signal.SIGTERM)
            assert process.wait(25) == 0
        finally:
            process.kill()
    assert (parameters.read_text() if parameters.exists() else None) == kept_text
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
        assert process.wait(20) == 0
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
    with pytest.raises(flight_log.LogError, match="cannot write the recovered log"):
        flight_log.recover(torn, reserve=20_000)
    assert torn.stat().st_size <= size  # no part of the end was written
    assert flight_log.recover(torn, reserve=10_000).messages == 1000
    assert {path.name for path in small_disk.iterdir()} == {"20260101T000000Z.mcap", "ballast"}
    assert flight_log.info(small_disk / "20260101T000000Z.mcap").closed
    assert free(small_disk) >= 10_000


def test_failed_recovery_copy_is_removed_and_keeps_the_reserve(small_disk) -> None:
    torn = torn_log(small_disk)
    content = bytearray(torn.read_bytes())
    content[len(content) // 2] ^= 0xFF  # damaged: the end alone is not sufficient
    torn.write_bytes(content)
    (small_disk / "ballast").write_bytes(bytes(1_300_000))
    with pytest.raises(flight_log.LogError, match="cannot write the recovered log"):
        flight_log.recover(torn, reserve=200_000)
    assert {path.name for path in small_disk.iterdir()} == {torn.name, "ballast"}
    assert torn.read_bytes() == content
    (small_disk / "ballast").unlink()
    assert 500 < flight_log.recover(torn, reserve=200_000).messages < 1000
