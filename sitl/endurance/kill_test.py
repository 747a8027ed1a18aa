"""`companion kills`: kill test of the service in flight; its logs are compared with the frames sent to it.

    companion kills --times 200 --seed 1

Each run is a `companion run` process that receives a simulated flight over UDP and is killed by SIGKILL at a
random time after its first TIMESYNC request, which shows that it is connected to the autopilot; it may still
be recovering the log of the run before. One run in ten is killed at a random time after the start of the
process instead, and counts among `--times` only if it was connected by then. Requirements: the log can be
read as it is, holds every frame up to its last one, and only frames of the last second are missing; after one
more start every log is closed and holds at least the messages that were readable before.
"""

from __future__ import annotations

import contextlib
import random
import signal
import socket
import statistics
import subprocess
import sys
import tempfile
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import click

from companion.link import dialect, frame
from companion.storage import flight_log
from companion.storage.reader import ACTIVE, LogError
from sitl.autopilot import SimulatedAutopilot
from sitl.scenarios import Scenario, SensorRates, get_scenario
from sitl.world import World

LOOPBACK = "127.0.0.1"
AT_RISK_S = 1.0  # only frames of the last second may be missing
SHORTEST_S, LONGEST_S = 0.1, 4.0  # of a run
EARLY_SHARE = 0.1  # share of runs timed from the start of the process
STEP_S = 0.01
START_S = 60.0
TIMESYNC = dialect.type_named("TIMESYNC").msgid


class KilledRun(NamedTuple):
    """One run up to its kill: number of frames sent while it listened, and of frames in its log.

    `connected_s` is the time from connection to kill, None if not connected. `lost_s` is the age, at the
    kill, of the oldest frame missing at the end of the log; `holes` counts frames missing before the last
    logged one.
    """

    connected_s: float | None
    sent: int
    logged: int
    lost_s: float
    holes: int


def run_kills(times: int, seed: int, folder: Path, at_once: int = 2) -> list[KilledRun]:
    """Run and kill the service until `times` runs were connected, `at_once` in parallel; recover all logs.

    Runs that were not connected are returned too, with `connected_s` None. Raises ValueError if a log cannot
    be read or is not recovered completely.
    """
    scenario = replace(get_scenario("short"), rates=SensorRates(imu=1.0, truth=1.0))
    world = World(scenario)
    shares = [times // at_once + (i < times % at_once) for i in range(at_once)]
    with ThreadPoolExecutor(at_once) as pool:
        futures = [
            pool.submit(
                _kill_repeatedly, share, random.Random(f"{seed} {i}"), folder / str(i), scenario, world
            )
            for i, share in enumerate(shares)
            if share
        ]
        return [run for future in futures for run in future.result()]


def _kill_repeatedly(
    times: int, rng: random.Random, folder: Path, scenario: Scenario, world: World
) -> list[KilledRun]:
    folder.mkdir(parents=True)
    readable: dict[str, int] = {}  # number of readable messages of each torn log, by name
    runs = list[KilledRun]()
    while sum(run.connected_s is not None for run in runs) < times:
        before = set(folder.iterdir())
        early = rng.random() < EARLY_SHARE
        seconds = rng.uniform(SHORTEST_S, LONGEST_S)
        connected_s, sent = _run_and_kill(folder, seconds, SimulatedAutopilot(scenario, 0, world), early)
        if connected_s is None and not early:
            raise ValueError(
                f"{folder}: a service did not connect to the autopilot within {START_S:g} s after its start"
            )
        torn = {path for path in folder.glob(f"*{ACTIVE}") if path not in before}
        runs.append(
            _compare_with_log(connected_s, sent, [data for path in torn for data in _received_frames(path)])
        )
        for path in torn:
            with contextlib.suppress(LogError):  # killed before its first byte
                readable[path.name.removesuffix(ACTIVE)] = flight_log.info(path).messages
    _run_and_kill(folder, START_S, SimulatedAutopilot(scenario, 0, world), until_recovered=True)
    for name, messages in readable.items():
        found = flight_log.info(folder / name)
        if not found.closed or found.messages < messages:
            raise ValueError(f"{found.path}: {messages} messages before recovery, {found.messages} after it")
    return runs


def _run_and_kill(
    folder: Path,
    seconds: float,
    autopilot: SimulatedAutopilot,
    early: bool = False,
    until_recovered: bool = False,
) -> tuple[float | None, list[tuple[float, bytes]]]:
    """Kill the service `seconds` after its first TIMESYNC request (`early`: after its start).

    Returns the time from connection to kill (None if not connected) and the frames sent, with their age at
    the kill. `until_recovered`: terminate it by SIGTERM when no torn log is left.
    """
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as chosen:
        chosen.bind((LOOPBACK, 0))
        port = chosen.getsockname()[1]
    command = [sys.executable, "-m", "companion", "run", "--connect", f"udpin:{LOOPBACK}:{port}"]
    command += ["--logs", str(folder), "--set", "log.minimum_free_mib=0", "--set", "log.maximum_files=100000"]
    sent: list[tuple[float, bytes]] = []
    connected, reader = list[float](), frame.Reader()
    torn, started = list(folder.glob(f"*{ACTIVE}")), time.monotonic()
    with (
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock,
        subprocess.Popen(command, stderr=subprocess.DEVNULL) as process,
    ):
        sock.connect((LOOPBACK, port))
        sock.setblocking(False)
        end = started + (seconds if early or until_recovered else START_S)
        while (now := time.monotonic()) < end:
            for data in autopilot.poll(int((now - started) * 1e9)):
                try:
                    sock.send(data)
                    sent.append((now, data))
                except ConnectionRefusedError:  # report of an earlier datagram: no listener yet
                    sent.clear()
            with contextlib.suppress(BlockingIOError, ConnectionRefusedError):
                while True:
                    data = sock.recv(65536)
                    autopilot.receive(data, int((now - started) * 1e9))
                    if not connected and any(
                        getattr(f, "msgid", None) == TIMESYNC for f in reader.receive(data)
                    ):
                        connected.append(now)
                        end = end if early or until_recovered else now + seconds
            if until_recovered and not any(path.exists() for path in torn):
                process.send_signal(signal.SIGTERM)
                process.wait(START_S)
                return None, sent
            time.sleep(STEP_S)
        killed = time.monotonic()
        process.kill()
    if until_recovered:
        raise ValueError(f"{folder}: torn logs remain {seconds:g} s after a start")
    return killed - connected[0] if connected else None, [(killed - at, data) for at, data in sent]


def _received_frames(path: Path) -> list[bytes]:
    """Received frames in a torn log, in order; empty if the log has no header yet."""
    try:
        return [
            e.value
            for e in flight_log.read(path)
            if e.topic.startswith("/mavlink/") and e.topic.endswith("/rx")
        ]
    except LogError:
        return []


def _compare_with_log(
    connected_s: float | None, sent: list[tuple[float, bytes]], logged: list[bytes]
) -> KilledRun:
    """Compare the log with `sent` (age at the kill, frame).

    Frames sent before the first logged one, or before the connection if none is logged, are not counted as
    lost: the service was not listening yet.
    """
    datas = [data for _, data in sent]
    if not logged:
        return KilledRun(connected_s, len(sent), 0, connected_s or 0.0, 0)
    first = datas.index(logged[0]) if logged[0] in datas else 0
    last = len(datas) - 1 - datas[::-1].index(logged[-1]) if logged[-1] in datas else len(datas) - 1
    holes = len(set(datas[first : last + 1]) - set(logged))
    missing = sent[last + 1 :]
    return KilledRun(connected_s, len(datas) - first, len(logged), missing[0][0] if missing else 0.0, holes)


@click.command("kills")
@click.option("--times", type=click.IntRange(1), default=200, show_default=True, help="Number of kills.")
@click.option("--seed", type=click.IntRange(min=0), default=1, show_default=True, help="Seed of the times.")
@click.option(
    "--at-once", type=click.IntRange(1), default=2, show_default=True, help="Services that run at once."
)
def command(times: int, seed: int, at_once: int) -> None:
    """Kill the service in flight at random times; check its log.

    Exit code 1 if a log lost more than the last second.
    """
    with tempfile.TemporaryDirectory() as folder:
        try:
            runs = run_kills(times, seed, Path(folder), at_once)
        except ValueError as error:
            raise SystemExit(f"companion: {error}") from None
    flown = [run for run in runs if run.connected_s is not None]
    lost = [run.lost_s for run in flown]
    worst = max(lost, default=0.0)
    holes = sum(run.holes for run in runs)
    click.echo(
        f"{len(flown)} kills of a connected service, {len(runs) - len(flown)} before the connection; "
        f"{sum(run.logged for run in runs)} frames in the logs, {holes} missing between them; "
        f"lost at the end: median {statistics.median(lost):.2f} s, maximum {worst:.2f} s; "
        "every torn log was readable and was closed by a later start"
    )
    if worst > AT_RISK_S or holes:
        raise SystemExit(1)
