"""The simulated autopilot as a process of its own meets the companion over a real link."""

import asyncio
import json
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path

import pytest

from companion.config import Config
from companion.records import Solution
from companion.runtime.core import Onboard
from companion.storage import flight_log
from companion.transport.links import Address, CannotListen
from sitl.autopilot import Autopilot
from sitl.loopback import simulated
from sitl.scenarios import named
from sitl.simulator_command import Flying, Score

LOOPBACK = "127.0.0.1"
FED = ["--set", "output.profile=ardupilot", "--set", "inertial.independent=true"]


def free_port() -> int:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:
        sock.bind((LOOPBACK, 0))
        return sock.getsockname()[1]


class Silent:
    def record(self, record, channel=None) -> None: ...
    def frame(self, link, outgoing, data, t_ns) -> None: ...


def test_the_score_is_that_of_the_loopback() -> None:
    """On a virtual clock far from the flight's own: what is scored is metres, as the navigator's is."""
    autopilot, apart = Autopilot(named("short")), 77_000_000_000_000
    onboard, score, said, now = Onboard(simulated(Config()), Silent()), Score(autopilot), [], 0
    while now < 60_000_000_000:
        for data in autopilot.poll(now):
            onboard.receive("main", data, now + apart)
        if now + apart >= onboard.deadline():
            onboard.poll(now + apart)
        for data in onboard.to_send("main", now + apart):
            autopilot.receive(data, now)
        said += score.take(now)
        now = max(now + 1, min(autopilot.deadline(), onboard.deadline() - apart))
    assert said == ["the companion's navigation is heard"]
    summary = score.summary()
    assert int(summary.split()[0]) > 100 and "positions came" in summary and "bound" in summary
    assert float(summary.split("off by ")[1].split(" m")[0]) < 6.0
    assert score.take(now + 10_000_000_000) == ["the companion is silent"]
    assert score.summary() == "no position came"


def test_an_address_in_use_ends_it() -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as taken:
        taken.bind((LOOPBACK, 0))
        address = Address.parse(f"udpin:{LOOPBACK}:{taken.getsockname()[1]}")

        async def fly() -> None:
            await Flying(named("short"), address, 1.0, lambda t, text: None).fly()

        with pytest.raises(CannotListen):
            asyncio.run(fly())


def test_two_processes_fly_and_both_end_cleanly(tmp_path: Path) -> None:
    port, logs = free_port(), tmp_path / "logs"
    python = [sys.executable, "-m", "companion"]
    said, flown = tmp_path / "said", tmp_path / "flown"
    with (
        said.open("w") as said_to,
        flown.open("w") as flown_to,
        subprocess.Popen(
            [*python, "run", "--connect", f"udpin:{LOOPBACK}:{port}", "--logs", str(logs), *FED],
            stderr=said_to,
        ) as companion,
        subprocess.Popen(
            [*python, "sitl", "--scenario", "short", "--connect", f"udpout:{LOOPBACK}:{port}"],
            stderr=flown_to,
        ) as autopilot,
    ):
        deadline = time.monotonic() + 40.0
        while "navigation is heard" not in flown.read_text() and time.monotonic() < deadline:
            time.sleep(0.1)
        time.sleep(3.0)
        autopilot.send_signal(signal.SIGINT)
        assert autopilot.wait(20) == 0
        companion.send_signal(signal.SIGINT)
        assert companion.wait(20) == 0
    assert "navigation fixed:" in said.read_text()
    assert "GNSS+RSBN until 120 s" in flown.read_text()
    assert "positions came, off by" in flown.read_text()
    (log,) = logs.iterdir()
    assert sum(isinstance(entry.value, Solution) for entry in flight_log.read(log)) > 10
    replayed = subprocess.run([*python, "replay", str(log), "--json"], capture_output=True, text=True)
    assert replayed.returncode == 0, replayed.stdout + replayed.stderr
    found = json.loads(replayed.stdout)
    assert found["different"] == 0 and found["compared"] > 10
