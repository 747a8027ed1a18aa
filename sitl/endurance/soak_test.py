"""`companion soak`: soak test of one companion over a day of flight with random faults.

    companion soak --hours 24 --seed 1

An hour consists of four sorties: the autopilot is switched on, flies a quarter of an hour, and is switched
off; the companion is never restarted. In every sortie random faults last about half a minute and are two
minutes apart, about 14 per hour. Each hour yields one line with memory, queues and rates. Limits:

    memory     resident memory of the process: at most 5 % above the first hour; number of objects reachable
               from the companion, the least at the ends of the sorties: in the last quarter of the hours at
               most 5 % above that of the first. A roll-back in progress holds records, and the past is
               thinned out now and then, so single counts differ by a tenth; what leaks raises the least
    queues     the longest container in the companion, and the bytes that wait for the log's disk: bounded
    rates      in the quiet time between faults: of solutions and of messages received within 1 % of the first
               hour; of messages sent within 1 % beyond the 5 % that may leave early (`output.pace`), which
               depends on the phase of the beacons' answers in each sortie. The first hour has at least what
               is configured: its own fault would be the measure of all others

Virtual time: a day takes about three quarters of an hour.
"""

from __future__ import annotations

import ctypes
import gc
import json
import math
import os
import random
import tempfile
import time
import types
from collections import Counter, deque
from collections.abc import Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import NamedTuple

import click

from companion.bench.live import memory_mib
from companion.config import Config
from companion.output.pace import EARLY_SHARE
from companion.records import Stamped
from companion.runtime.core import CompanionCore
from companion.storage.flight_log import Writer
from companion.storage.run_metadata import run_metadata
from companion.tables import number_table, print_tables
from companion.units import SECOND_NS
from sitl.autopilot import UNIX_AT_START_NS, SimulatedAutopilot
from sitl.campaign.flight import NORTH_BEACON
from sitl.faults import AUTOPILOT_FAULTS, LINK_FAULTS, RECORD_FAULTS, Fault
from sitl.flight import FlightPlan, Leg
from sitl.loopback import LINK, START_NS, fly_connected, simulator_config
from sitl.scenarios import EAST_BEACON, TAKE_OFF, WIND, Scenario, SensorRates

SORTIE_S, SORTIES = 900.0, 4  # of an hour
QUIET_S = 120.0  # not counted as quiet: start of a sortie, and after a fault
FAULT_S = (20.0, 60.0)
APART_NS = 60 * SECOND_NS  # between two sorties
MEMORY_GROWTH, RATE_DRIFT = 0.05, 0.01
LONGEST = 4096  # of a container
MOST_WAITING_KIB = 32768  # for the log's disk
SOAK_FAULTS = (*RECORD_FAULTS, *LINK_FAULTS, *AUTOPILOT_FAULTS, "slow-consumer")
_CONTAINERS = (list, tuple, dict, set, frozenset, deque)
_OUTSIDE = (types.ModuleType, type, types.FunctionType, types.BuiltinFunctionType, types.CodeType)


class HourStatistics(NamedTuple):
    """Measurements at the end of an hour or over it. Rates in Hz over its quiet time."""

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


class ReachableObjects(NamedTuple):
    """Number of objects reachable from an object, and the length of the longest container."""

    objects: int
    longest: int


def count_reachable(root: object, exclude: tuple[object, ...] = ()) -> ReachableObjects:
    """Count the objects reachable from `root`, except `exclude`, code and modules."""
    seen, longest = {id(each) for each in exclude}, 0
    waiting = [root]
    while waiting:
        each = waiting.pop()
        if id(each) in seen or isinstance(each, _OUTSIDE):
            continue
        seen.add(id(each))
        if isinstance(each, _CONTAINERS):
            longest = max(longest, len(each))
        waiting += gc.get_referents(each)
    return ReachableObjects(len(seen), longest)


class CountingLog:
    """Log that counts records and frames before it passes them on, with rates over quiet time."""

    def __init__(self, log: Writer) -> None:
        self._log = log
        self.reset()

    def reset(self) -> None:
        """Reset all counts."""
        self.counts: Counter[str] = Counter()
        self._rates: Counter[str] = Counter()
        self._quiet = False
        self.quiet_s = self.waiting = 0

    def start_second(self, disturbed: Sequence[tuple[float, float]], t: float) -> None:
        """Start second `t` of a flight: it is quiet if it overlaps none of the intervals `disturbed`."""
        self._quiet = not any(since <= t + 1.0 and t < until for since, until in disturbed)
        self.quiet_s += self._quiet
        self.waiting = max(self.waiting, self._log.waiting)

    def rate(self, name: str) -> float:
        """Return the mean count of `name` per quiet second."""
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


def make_sortie(number: int, seed: int, duration_s: float = SORTIE_S) -> Scenario:
    """Make a flight of turns within reach of two beacons, with random faults."""
    rng = random.Random(f"{seed} {number}")
    sides = math.ceil((duration_s - 60.0) / 240.0)
    turns = (Leg((duration_s - 60.0) / sides, (40 + 70 * i) % 360, 38, 100) for i in range(sides))
    return Scenario(
        f"sortie {number}",
        FlightPlan((*TAKE_OFF, *turns), winds=(WIND,)),
        beacons=(EAST_BEACON, NORTH_BEACON),
        rates=SensorRates(imu=1.0, truth=1.0),
        faults=tuple(_scatter_faults(rng, duration_s)),
        seed=rng.randrange(1 << 31),
    )


def _scatter_faults(rng: random.Random, duration_s: float) -> Iterator[Fault]:
    """Distinct faults in random order, as many as fit, with a quiet time before each."""
    start = QUIET_S
    for name in rng.sample(SOAK_FAULTS, len(SOAK_FAULTS)):
        start += rng.uniform(0.0, 20.0)
        end = start + rng.uniform(*FAULT_S)
        if end > duration_s - QUIET_S:
            return
        yield Fault(name, round(start, 1), round(end, 1))
        start = end + QUIET_S + 20.0


def run_soak(hours: int, seed: int, folder: Path, sortie_s: float = SORTIE_S) -> Iterator[HourStatistics]:
    """Fly, and yield the statistics of each hour."""
    config = simulator_config(Config())
    log = Writer(
        folder / "soak.mcap",
        metadata=run_metadata(config),
        start_unix_ns=UNIX_AT_START_NS,
        start_ns=START_NS,
        block=True,
    )
    with log:
        counter = CountingLog(log)
        core = CompanionCore(config, counter, (LINK,))
        start = START_NS
        for hour in range(1, hours + 1):
            counter.reset()
            started, flown_s, reached = time.perf_counter(), 0.0, list[ReachableObjects]()
            for number in range(SORTIES):
                scenario = make_sortie(SORTIES * (hour - 1) + number, seed, sortie_s)
                disturbed = [
                    (0.0, QUIET_S),
                    *((fault.start_s, fault.end_s + QUIET_S) for fault in scenario.faults),
                ]
                fly_connected(
                    SimulatedAutopilot(scenario, start), core, start, partial(counter.start_second, disturbed)
                )
                flown_s += scenario.duration_s
                start += round(scenario.duration_s * SECOND_NS) + APART_NS
                reached.append(count_reachable(core, exclude=(counter,)))
            yield _measure_hour(hour, reached, counter, log, flown_s / (time.perf_counter() - started))


def _measure_hour(
    hour: int,
    reached: list[ReachableObjects],
    counter: CountingLog,
    log: Writer,
    times_real_time: float,
) -> HourStatistics:
    _trim_memory()  # exclude memory freed by the simulator
    return HourStatistics(
        hour,
        resident_mib=round(memory_mib(os.getpid()), 1),
        objects=min(each.objects for each in reached),
        longest=max(each.longest for each in reached),
        waiting_kib=round(counter.waiting / 1024.0, 1),
        dropped=log.dropped,
        solutions_hz=counter.rate("Solution"),
        messages_hz=counter.rate("tx"),
        received_hz=counter.rate("rx"),
        quiet_s=counter.quiet_s,
        rejections=counter.counts["Rejection"],
        resets=counter.counts["Reset"],
        events=counter.counts["Event"],
        times_real_time=round(times_real_time, 1),
    )


def _trim_memory() -> None:
    """Return free memory to the system where the C library can: resident memory is then in use."""
    gc.collect()
    trim = getattr(ctypes.CDLL(None), "malloc_trim", None)
    if trim is not None:
        trim(0)


def find_failures(hours: list[HourStatistics]) -> list[str]:
    """Return one sentence for each limit that was exceeded."""
    first, found = hours[0], []
    quarter = max(1, len(hours) // 4)
    fewest, last = (min(hour.objects for hour in part) for part in (hours[:quarter], hours[-quarter:]))
    if last > fewest * (1.0 + MEMORY_GROWTH):
        found.append(f"hour {hours[-quarter].hour}: objects grew from {fewest} to {last}")
    configured = simulator_config(Config()).output.rates_hz.values()
    for name, least in (("solutions_hz", max(configured)), ("messages_hz", sum(configured))):
        if (rate := getattr(first, name)) < least:
            found.append(f"hour {first.hour}: {name} is {rate:g} (configured {least:g})")
    for hour in hours:
        if hour.resident_mib > first.resident_mib * (1.0 + MEMORY_GROWTH):
            found.append(
                f"hour {hour.hour}: resident_mib grew from {first.resident_mib:g} to {hour.resident_mib:g}"
            )
        for name, share in (
            ("solutions_hz", RATE_DRIFT),
            ("received_hz", RATE_DRIFT),
            ("messages_hz", RATE_DRIFT + EARLY_SHARE),
        ):
            before, now = getattr(first, name), getattr(hour, name)
            if abs(now - before) > before * share:
                found.append(f"hour {hour.hour}: {name} went from {before:g} to {now:g}")
        if hour.longest > LONGEST:
            found.append(f"hour {hour.hour}: a container has {hour.longest} elements (limit {LONGEST})")
        if hour.waiting_kib > MOST_WAITING_KIB or hour.dropped:
            found.append(
                f"hour {hour.hour}: {hour.waiting_kib:g} KiB waited for the log, {hour.dropped} dropped"
            )
    return found


@click.command("soak")
@click.option("--hours", type=click.IntRange(1), default=24, show_default=True, help="Hours of flight.")
@click.option(
    "--seed", type=click.IntRange(min=0), default=1, show_default=True, help="Seed of flights and faults."
)
@click.option("--json", "as_json", is_flag=True, help="Print JSON, one line per hour.")
def command(hours: int, seed: int, as_json: bool) -> None:
    """Fly for hours with random faults.

    Reports memory, queues and rates. Exit code 1 above a limit.
    """
    flown: list[HourStatistics] = []
    with tempfile.TemporaryDirectory() as folder:
        for hour in run_soak(hours, seed, Path(folder)):
            flown.append(hour)
            if as_json:
                click.echo(json.dumps(hour._asdict()))
            else:
                click.echo(f"hour {hour.hour} of {hours}: {hour.resident_mib:g} MiB", err=True)
    if not as_json:
        _print_table(flown)
    failures = find_failures(flown)
    for sentence in failures:
        click.echo(sentence, err=True)
    if failures:
        raise SystemExit(1)


def _print_table(hours: list[HourStatistics]) -> None:
    title = "memory and queues at the end of each hour, rates in its quiet time"
    heads = (name.replace("_", " ") for name in HourStatistics._fields)
    table = number_table(title, *heads, texts=0)
    for hour in hours:
        table.add_row(*(f"{value:g}" if isinstance(value, float) else str(value) for value in hour))
    print_tables(table)
