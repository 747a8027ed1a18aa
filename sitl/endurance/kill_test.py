"""`companion kills`: the service is killed at random moments in flight; its logs against what it was sent.

    companion kills --times 200 --seed 1

Each life is a `companion run` of its own, fed a simulated flight over UDP and ended by SIGKILL at a moment
after it has heard the autopilot, which it shows by asking for its time: navigating, or still recovering the
log of the life before. One in ten is ended at a moment after its start instead, and does not count among
`--times` unless it had heard the autopilot by then. What must hold: the log left behind can be read as it
lies, holds every frame that came up to its last one, and of what was sent no more is missing than the last
second; and a start later every log is closed, with all that could be read of it torn.

It looks at the log from outside and knows nothing of chunks.
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
from sitl.autopilot import Autopilot
from sitl.scenarios import Rates, Scenario, named
from sitl.world import World

LOOPBACK = "127.0.0.1"
AT_RISK_S = 1.0  # of what was sent, no more may be lost
SHORTEST_S, LONGEST_S = 0.1, 4.0  # of a life
STILLBORN = 0.1  # share of lives that are counted from the start of the process
STEP_S = 0.01
START_S = 60.0
TIMESYNC = dialect.type_named("TIMESYNC").msgid


class Life(NamedTuple):
    """One run up to its kill: frames sent once it listened, frames found in its log, and what is missing.

    `heard_s` is for how long it had heard the autopilot at the kill, None if it had not. `lost_s` is the age,
    at the kill, of the oldest frame that is not in the log; `holes` are frames missing before the last one
    found.
    """

    heard_s: float | None
    sent: int
    kept: int
    lost_s: float
    holes: int


def kills(times: int, seed: int, folder: Path, at_once: int = 2) -> list[Life]:
    """Live and be killed until `times` lives had heard the autopilot, `at_once` side by side, then start once
    more in each folder. Those that had not are among what is returned, with `heard_s` None.

    ValueError, one sentence, where a log cannot be read or is not whole in the end.
    """
    scenario = replace(named("short"), rates=Rates(imu=1.0, truth=1.0))
    world = World(scenario)
    shares = [times // at_once + (i < times % at_once) for i in range(at_once)]
    with ThreadPoolExecutor(at_once) as pool:
        runs = [
            pool.submit(_lives, share, random.Random(f"{seed} {i}"), folder / str(i), scenario, world)
            for i, share in enumerate(shares)
            if share
        ]
        return [life for run in runs for life in run.result()]


def _lives(times: int, rng: random.Random, folder: Path, scenario: Scenario, world: World) -> list[Life]:
    folder.mkdir(parents=True)
    readable: dict[str, int] = {}  # messages that each torn log gave, by its name
    lives = list[Life]()
    while sum(life.heard_s is not None for life in lives) < times:
        before = set(folder.iterdir())
        stillborn = rng.random() < STILLBORN
        seconds = rng.uniform(SHORTEST_S, LONGEST_S)
        heard_s, sent = _live(folder, seconds, Autopilot(scenario, 0, world), stillborn)
        if heard_s is None and not stillborn:
            raise ValueError(
                f"{folder}: a service did not hear the autopilot for {START_S:g} s after its start"
            )
        left = {path for path in folder.glob(f"*{ACTIVE}") if path not in before}
        lives.append(_compared(heard_s, sent, [data for path in left for data in _heard(path)]))
        for path in left:
            with contextlib.suppress(LogError):  # killed before its first byte
                readable[path.name.removesuffix(ACTIVE)] = flight_log.info(path).messages
    _live(folder, START_S, Autopilot(scenario, 0, world), until_recovered=True)
    for name, messages in readable.items():
        found = flight_log.info(folder / name)
        if not found.closed or found.messages < messages:
            raise ValueError(f"{found.path}: held {messages} messages torn and holds {found.messages} now")
    return lives


def _live(
    folder: Path, seconds: float, autopilot: Autopilot, stillborn: bool = False, until_recovered: bool = False
) -> tuple[float | None, list[tuple[float, bytes]]]:
    """Run the service for `seconds` after it first asks for the autopilot's time (`stillborn`: after its
    start) and kill it; for how long it had heard the autopilot, and what was sent, with its age at the kill.

    `until_recovered`: end it in good order as soon as no log is torn any more.
    """
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as chosen:
        chosen.bind((LOOPBACK, 0))
        port = chosen.getsockname()[1]
    command = [sys.executable, "-m", "companion", "run", "--connect", f"udpin:{LOOPBACK}:{port}"]
    command += ["--logs", str(folder), "--set", "log.minimum_free_mib=0", "--set", "log.maximum_files=100000"]
    sent: list[tuple[float, bytes]] = []
    heard, reader = list[float](), frame.Reader()
    torn, begun = list(folder.glob(f"*{ACTIVE}")), time.monotonic()
    with (
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock,
        subprocess.Popen(command, stderr=subprocess.DEVNULL) as process,
    ):
        sock.connect((LOOPBACK, port))
        sock.setblocking(False)
        end = begun + (seconds if stillborn or until_recovered else START_S)
        while (now := time.monotonic()) < end:
            for data in autopilot.poll(int((now - begun) * 1e9)):
                try:
                    sock.send(data)
                    sent.append((now, data))
                except ConnectionRefusedError:  # of an earlier one: nobody listened yet
                    sent.clear()
            with contextlib.suppress(BlockingIOError, ConnectionRefusedError):
                while True:
                    data = sock.recv(65536)
                    autopilot.receive(data, int((now - begun) * 1e9))
                    if not heard and any(getattr(f, "msgid", None) == TIMESYNC for f in reader.receive(data)):
                        heard.append(now)
                        end = end if stillborn or until_recovered else now + seconds
            if until_recovered and not any(path.exists() for path in torn):
                process.send_signal(signal.SIGTERM)
                process.wait(START_S)
                return None, sent
            time.sleep(STEP_S)
        killed = time.monotonic()
        process.kill()
    if until_recovered:
        raise ValueError(f"{folder}: logs are still torn {seconds:g} s after a start")
    return killed - heard[0] if heard else None, [(killed - at, data) for at, data in sent]


def _heard(path: Path) -> list[bytes]:
    """The frames in a torn log as they came; none where there is no header yet."""
    try:
        return [
            e.value
            for e in flight_log.read(path)
            if e.topic.startswith("/mavlink/") and e.topic.endswith("/rx")
        ]
    except LogError:
        return []


def _compared(heard_s: float | None, sent: list[tuple[float, bytes]], kept: list[bytes]) -> Life:
    """`sent` with ages at the kill. What was sent before the first frame that is in the log met no ear, nor,
    where there is none, did what was sent before the autopilot was heard.
    """
    datas = [data for _, data in sent]
    if not kept:
        return Life(heard_s, len(sent), 0, heard_s or 0.0, 0)
    first = datas.index(kept[0]) if kept[0] in datas else 0
    last = len(datas) - 1 - datas[::-1].index(kept[-1]) if kept[-1] in datas else len(datas) - 1
    holes = len(set(datas[first : last + 1]) - set(kept))
    missing = sent[last + 1 :]
    return Life(heard_s, len(datas) - first, len(kept), missing[0][0] if missing else 0.0, holes)


@click.command("kills")
@click.option("--times", type=click.IntRange(1), default=200, show_default=True)
@click.option("--seed", type=int, default=1, show_default=True)
@click.option("--at-once", type=click.IntRange(1), default=2, show_default=True)
def command(times: int, seed: int, at_once: int) -> None:
    """Kill a flying service at random moments and see that its log lost no more than the last second.

    Ends with 1 where it did.
    """
    with tempfile.TemporaryDirectory() as folder:
        try:
            lives = kills(times, seed, Path(folder), at_once)
        except ValueError as error:
            raise SystemExit(f"companion: {error}") from None
    flown = [life for life in lives if life.heard_s is not None]
    lost = [life.lost_s for life in flown]
    worst = max(lost, default=0.0)
    holes = sum(life.holes for life in lives)
    click.echo(
        f"{len(flown)} kills of a service that had heard the autopilot, and {len(lives) - len(flown)} of one "
        "that had not yet; "
        f"{sum(life.kept for life in lives)} frames in the logs, {holes} missing among them; "
        f"lost at the end: {statistics.median(lost):.2f} s in the median, {worst:.2f} s at most; "
        "every torn log was read as it lay and closed by a later start"
    )
    if worst > AT_RISK_S or holes:
        raise SystemExit(1)


if __name__ == "__main__":
    command()
