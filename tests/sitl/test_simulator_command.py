"""Simulated autopilot and companion as two processes over a real link."""

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
from companion.runtime.core import CompanionCore
from companion.storage import flight_log
from companion.storage.deferred_log import NoLog
from companion.transport.reconnect import Address, CannotListen
from sitl.autopilot import SimulatedAutopilot
from sitl.loopback import simulator_config
from sitl.scenarios import get_scenario
from sitl.simulator_command import PositionScore, SimulatorRunner
from tests.network import free_port

LOOPBACK = "127.0.0.1"
FED = ["--set", "output.profile=ardupilot", "--set", "inertial.independent=true"]


def test_score_agrees_with_the_loopback() -> None:
    """With a clock offset between the two, scored errors stay at the navigator's level of metres."""
    autopilot, apart = SimulatedAutopilot(get_scenario("short")), 77_000_000_000_000
    onboard, score, lines, now = (
        CompanionCore(simulator_config(Config()), NoLog()),
        PositionScore(autopilot),
        [],
        0,
    )
    while now < 35_000_000_000:
        for data in autopilot.poll(now):
            onboard.receive("main", data, now + apart)
        if now + apart >= onboard.deadline():
            onboard.poll(now + apart)
        for data in onboard.to_send("main", now + apart):
            autopilot.receive(data, now)
        lines += score.update(now)
        now = max(now + 1, min(autopilot.deadline(), onboard.deadline() - apart))
    assert lines == ["receiving the companion's navigation"]
    summary = score.summary()
    assert int(summary.split()[0]) > 100 and "positions received" in summary and "bound" in summary
    assert float(summary.split("error ")[1].split(" m")[0]) < 6.0
    assert score.update(now + 10_000_000_000) == ["the companion is silent"]
    assert score.summary() == "no positions received"


def test_address_in_use_raises() -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as taken:
        taken.bind((LOOPBACK, 0))
        address = Address.parse(f"udpin:{LOOPBACK}:{taken.getsockname()[1]}")

        async def fly_scenario() -> None:
            await SimulatorRunner(get_scenario("short"), address, 1.0, lambda t, text: None).run()

        with pytest.raises(CannotListen):
            asyncio.run(fly_scenario())


def solutions_in(logs: Path) -> int:
    (log,) = logs.iterdir()
    return sum(isinstance(entry.value, Solution) for entry in flight_log.read(log))


def test_two_processes_fly_and_end_cleanly(tmp_path: Path) -> None:
    port, logs = free_port(), tmp_path / "logs"
    python = [sys.executable, "-m", "companion"]
    lines, flown = tmp_path / "companion.txt", tmp_path / "autopilot.txt"
    with (
        lines.open("w") as companion_log,
        flown.open("w") as autopilot_log,
        subprocess.Popen(
            [*python, "run", "--connect", f"udpin:{LOOPBACK}:{port}", "--logs", str(logs), *FED],
            stderr=companion_log,
        ) as companion,
        subprocess.Popen(
            [*python, "sitl", "--scenario", "short", "--connect", f"udpout:{LOOPBACK}:{port}"],
            stderr=autopilot_log,
        ) as autopilot,
    ):
        deadline = time.monotonic() + 100.0
        while time.monotonic() < deadline and not (
            "companion's navigation" in flown.read_text() and solutions_in(logs) > 20
        ):
            time.sleep(0.1)
        autopilot.send_signal(signal.SIGINT)
        assert autopilot.wait(60) == 0
        companion.send_signal(signal.SIGINT)
        assert companion.wait(60) == 0
    assert "navigation fixed:" in lines.read_text()
    assert "GNSS+RSBN until 120 s" in flown.read_text()
    assert "positions received, error" in flown.read_text()
    assert solutions_in(logs) > 20
    (log,) = logs.iterdir()
    replayed = subprocess.run([*python, "replay", str(log), "--json"], capture_output=True, text=True)
    assert replayed.returncode == 0, replayed.stdout + replayed.stderr
    found = json.loads(replayed.stdout)
    assert found["different"] == 0 and found["compared"] > 10
