"""`companion soak`: one companion that is never restarted, a day of flight, faults scattered by seed.

    companion soak --hours 24 --seed 1

An hour is four sorties: the autopilot is switched on, flies a quarter of an hour, and is switched off; the
companion goes on. In every sortie faults whose kinds and times are drawn by the seed last half a minute or so
and stand two minutes apart, some 14 in an hour. A line an hour says what the process holds and how often
things happen. What must not grow:

    memory     of the process (resident) and the objects that can be reached from the companion: no more than
               5 % above those at the end of the first hour
    queues     the longest container in the companion, and what waits for the log's disk: bounded
    rates      of solutions and messages in the quiet time between faults: within 1 % of the first hour's

Virtual time: a day takes some ten minutes.
"""

from __future__ import annotations

import ctypes
import gc
import json
import math
import os
import random
import resource
import tempfile
import time
import types
from collections import Counter, deque
from collections.abc import Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import NamedTuple

import click
from rich.console import Console
from rich.table import Table

from companion.analysis.replay import metadata
from companion.config import Config
from companion.records import Stamped
from companion.runtime.core import Onboard
from companion.storage.flight_log import Writer
from sitl.autopilot import UNIX_AT_START_NS, Autopilot
from sitl.beacon import Beacon
from sitl.faults import AUTOPILOT_FAULTS, LINK_FAULTS, RECORD_FAULTS, Fault
from sitl.flight import Leg, Plan, Wind
from sitl.loopback import LINK, SECOND, START_NS, join, simulated
from sitl.scenarios import Rates, Scenario

SORTIE_S, SORTIES = 900.0, 4  # of an hour
QUIET_S = 120.0  # at the start of a sortie, and after a fault, before anything is counted as quiet
FAULT_S = (20.0, 60.0)
APART_NS = 60 * SECOND  # between two sorties
MEMORY_GROWTH, RATE_DRIFT = 0.05, 0.01
LONGEST = 4096  # of a container
NAMES = (*RECORD_FAULTS, *LINK_FAULTS, *AUTOPILOT_FAULTS, "slow-consumer")
_CONTAINERS = (list, tuple, dict, set, frozenset, deque)
_OUTSIDE = (types.ModuleType, type, types.FunctionType, types.BuiltinFunctionType, types.CodeType)


class Hour(NamedTuple):
    """What was measured at the end of an hour, or over it. Rates in Hz over its quiet time."""

    hour: int
    resident_mib: float
    objects: int
    longest: int
    waiting_kib: float
    dropped: int
    solutions_hz: float
    messages_hz: float
    received_hz: float
    quiet_s: int
    rejections: int
    resets: int
    events: int
    times_real_time: float


class Held(NamedTuple):
    """What can be reached from an object: how many objects, and the length of the longest container."""

    objects: int
    longest: int


def held(root: object, but: tuple[object, ...] = ()) -> Held:
    """Walk everything that `root` holds, but for `but`; code and modules are nobody's."""
    seen, longest = {id(each) for each in but}, 0
    waiting = [root]
    while waiting:
        each = waiting.pop()
        if id(each) in seen or isinstance(each, _OUTSIDE):
            continue
        seen.add(id(each))
        if isinstance(each, _CONTAINERS):
            longest = max(longest, len(each))
        waiting += gc.get_referents(each)
    return Held(len(seen), longest)


class Tally:
    """A log that counts on its way to another, and the rates of a quiet time."""

    def __init__(self, log: Writer) -> None:
        self._log = log
        self.begin()

    def begin(self) -> None:
        """Count anew."""
        self.counts: Counter[str] = Counter()
        self._rates: Counter[str] = Counter()
        self._quiet = False
        self.quiet_s = self.waiting = 0

    def listen(self, loud: Sequence[tuple[float, float]], t: float) -> None:
        """Called at each second `t` of a flight: whether the one that begins is quiet, in none of `loud`."""
        self._quiet = not any(since <= t + 1.0 and t < until for since, until in loud)
        self.quiet_s += self._quiet
        self.waiting = max(self.waiting, self._log.waiting)

    def rate(self, name: str) -> float:
        """How many of `name` there were in a quiet second."""
        return round(self._rates[name] / max(self.quiet_s, 1), 3)

    def record(self, record: Stamped, channel: str | None = None) -> None:
        """Count and write one record."""
        name = type(record).__name__
        self.counts[name] += 1
        self._rates[name] += self._quiet
        self._log.record(record, channel)

    def frame(self, link: str, outgoing: bool, data: bytes, t_ns: int) -> None:
        """Count and write one frame."""
        self._rates["tx" if outgoing else "rx"] += self._quiet
        self._log.frame(link, outgoing, data, t_ns)


def sortie(number: int, seed: int, duration_s: float = SORTIE_S) -> Scenario:
    """A flight round and round within reach of two beacons, faults all along."""
    rng = random.Random(f"{seed} {number}")
    sides = math.ceil((duration_s - 60.0) / 240.0)
    legs = [Leg(10, 40, 0, 0), Leg(50, 40, 38, 0)]
    legs += [Leg((duration_s - 60.0) / sides, (40 + 70 * i) % 360, 38, 100) for i in range(sides)]
    return Scenario(
        f"sortie {number}",
        Plan(tuple(legs), winds=(Wind(0, 4, 5),)),
        beacons=(Beacon(1, 60.05, 31.07), Beacon(2, 60.45, 30.0)),
        rates=Rates(imu=1.0, truth=1.0),
        faults=tuple(_scattered(rng, duration_s)),
        seed=rng.randrange(1 << 31),
    )


def _scattered(rng: random.Random, duration_s: float) -> Iterator[Fault]:
    """As many kinds as find room, each once, in any order; a quiet time before each."""
    start = QUIET_S
    for name in rng.sample(NAMES, len(NAMES)):
        start += rng.uniform(0.0, 20.0)
        end = start + rng.uniform(*FAULT_S)
        if end > duration_s - QUIET_S:
            return
        yield Fault(name, round(start, 1), round(end, 1))
        start = end + QUIET_S + 20.0


def soak(hours: int, seed: int, folder: Path, sortie_s: float = SORTIE_S) -> Iterator[Hour]:
    """Fly, and yield a line after each hour."""
    config = simulated(Config())
    log = Writer(
        folder / "soak.mcap",
        metadata=metadata(config),
        start_unix_ns=UNIX_AT_START_NS,
        start_ns=START_NS,
        block=True,
    )
    with log:
        tally = Tally(log)
        onboard = Onboard(config, tally, (LINK,))
        start = START_NS
        for hour in range(1, hours + 1):
            tally.begin()
            begun, flown_s = time.perf_counter(), 0.0
            for number in range(SORTIES):
                scenario = sortie(SORTIES * (hour - 1) + number, seed, sortie_s)
                loud = [
                    (0.0, QUIET_S),
                    *((fault.start_s, fault.end_s + QUIET_S) for fault in scenario.faults),
                ]
                join(Autopilot(scenario, start), onboard, start, partial(tally.listen, loud))
                flown_s += scenario.duration_s
                start += round(scenario.duration_s * SECOND) + APART_NS
            yield _line(hour, onboard, tally, log, flown_s / (time.perf_counter() - begun))


def _line(hour: int, onboard: Onboard, tally: Tally, log: Writer, times_real_time: float) -> Hour:
    _give_back()  # the simulator's memory is not the companion's
    objects, longest = held(onboard, but=(tally,))
    return Hour(
        hour,
        round(_resident_mib(), 1),
        objects,
        longest,
        round(tally.waiting / 1024.0, 1),
        log.dropped,
        tally.rate("Solution"),
        tally.rate("tx"),
        tally.rate("rx"),
        tally.quiet_s,
        tally.counts["Rejection"],
        tally.counts["Reset"],
        tally.counts["Event"],
        round(times_real_time, 1),
    )


def _give_back() -> None:
    """Have free memory returned to the system where the C library can, so that what is resident is in use."""
    gc.collect()
    trim = getattr(ctypes.CDLL(None), "malloc_trim", None)
    if trim is not None:
        trim(0)


def _resident_mib() -> float:
    """Of this process now; where the system does not say, at its greatest."""
    try:
        pages = int(Path("/proc/self/statm").read_text().split()[1])
    except OSError:
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0
    return pages * os.sysconf("SC_PAGE_SIZE") / (1 << 20)


def failures(hours: list[Hour], depth: int = 1 << 25) -> list[str]:
    """What a soak did not keep, one sentence each."""
    first, found = hours[0], []
    for hour in hours:
        for name in ("resident_mib", "objects"):
            before, now = getattr(first, name), getattr(hour, name)
            if now > before * (1.0 + MEMORY_GROWTH):
                found.append(f"hour {hour.hour}: {name} grew from {before:g} to {now:g}")
        for name in ("solutions_hz", "messages_hz", "received_hz"):
            before, now = getattr(first, name), getattr(hour, name)
            if abs(now - before) > before * RATE_DRIFT:
                found.append(f"hour {hour.hour}: {name} went from {before:g} to {now:g}")
        if hour.longest > LONGEST:
            found.append(f"hour {hour.hour}: a container holds {hour.longest}")
        if hour.waiting_kib > depth / 1024 or hour.dropped:
            found.append(
                f"hour {hour.hour}: {hour.waiting_kib:g} KiB waited for the log, {hour.dropped} dropped"
            )
    return found


@click.command("soak")
@click.option("--hours", type=click.IntRange(1), default=24, show_default=True)
@click.option("--seed", type=int, default=1, show_default=True)
@click.option("--json", "as_json", is_flag=True, help="Print JSON, a line an hour.")
def command(hours: int, seed: int, as_json: bool) -> None:
    """Fly for hours with every fault scattered over each, and say what grew. Ends with 1 where any did."""
    flown: list[Hour] = []
    with tempfile.TemporaryDirectory() as folder:
        for hour in soak(hours, seed, Path(folder)):
            flown.append(hour)
            if as_json:
                click.echo(json.dumps(hour._asdict()))
            else:
                click.echo(f"hour {hour.hour} of {hours}: {hour.resident_mib:g} MiB", err=True)
    if not as_json:
        _show(flown)
    for sentence in failures(flown):
        click.echo(sentence, err=True)
    if failures(flown):
        raise SystemExit(1)


def _show(hours: list[Hour]) -> None:
    table = Table(title="memory and queues at the end of each hour, rates in its quiet time")
    for name in Hour._fields:
        table.add_column(name.replace("_", " "), justify="right")
    for hour in hours:
        table.add_row(*(f"{value:g}" if isinstance(value, float) else str(value) for value in hour))
    Console(width=max(150, Console().width)).print(table)


if __name__ == "__main__":
    command()
