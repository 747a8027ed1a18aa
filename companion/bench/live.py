"""Benchmark of the live path: processor and memory that a flying companion takes, and a bare receiver.

A complete `companion run` (log on, real sockets), a bare asyncio receiver with pymavlink's parser and one
that only receives run in processes of their own and get the same stream. An aircraft flies north at 40 m/s
with GNSS and a beacon. The processor time of all threads of each process is read from the kernel, that of
the turns of the companion's event loop is measured in it.
"""

from __future__ import annotations

import asyncio
import os
import tempfile
import time
from array import array
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from rich.table import Table

from companion.bench.latency import FIELDS, peer, receive_datagrams, run_companion
from companion.config import load
from companion.link import dialect, frame
from companion.link.dialect import mavlink
from companion.runtime.core import CompanionCore
from companion.storage.deferred_log import NoLog
from companion.tables import number_table

SETTLE_S = 10.0  # the first fix
TURNS = "turns.npy"


class Stream(NamedTuple):
    """What a stock autopilot sends: rates in Hz by message, those that the companion uses and others."""

    autopilot: int
    profile: str
    used: dict[str, float]
    unused: dict[str, float]
    datagram_s: float = 0.01  # what is due within that time comes in one datagram


STREAMS = {
    "ArduPilot, 500 messages/s": Stream(
        mavlink.MAV_AUTOPILOT_ARDUPILOTMEGA,
        "ardupilot",
        {"LOCAL_POSITION_NED": 10, "ATTITUDE": 10, "VFR_HUD": 10, "RAW_IMU": 20, "SCALED_PRESSURE": 10,
         "GPS_RAW_INT": 5, "SYS_STATUS": 2, "RSBN_MEASUREMENT": 1},
        {"SERVO_OUTPUT_RAW": 100, "RC_CHANNELS": 100, "VIBRATION": 100, "AHRS2": 100,
         "NAV_CONTROLLER_OUTPUT": 31},
    ),
    "PX4, stock rates": Stream(
        mavlink.MAV_AUTOPILOT_PX4,
        "px4",
        {"LOCAL_POSITION_NED": 30, "ATTITUDE": 50, "VFR_HUD": 20, "HIGHRES_IMU": 50, "SCALED_PRESSURE": 1,
         "GPS_RAW_INT": 5, "SYS_STATUS": 5, "RSBN_MEASUREMENT": 1},
        {"ATTITUDE_QUATERNION": 50, "ODOMETRY": 30, "ACTUATOR_CONTROL_TARGET": 30, "SERVO_OUTPUT_RAW": 20,
         "ATTITUDE_TARGET": 20, "ESTIMATOR_STATUS": 5, "ALTITUDE": 10, "RC_CHANNELS": 20,
         "POSITION_TARGET_LOCAL_NED": 10, "GLOBAL_POSITION_INT": 50},
    ),
}  # fmt: skip
STREAMS["PX4, a message a datagram"] = STREAMS["PX4, stock rates"]._replace(datagram_s=0.0)


class Cost(NamedTuple):
    """What a process takes: processor time of a second of flight (%), resident memory (MiB), and the turn of
    its event loop that one in a thousand exceeds (ms of processor time).
    """

    stream: str
    process: str
    processor_percent: float
    memory_mib: float | None = None
    turn_ms: float | None = None


def measure(flight_s: float) -> list[Cost]:
    """Measure the companion beside bare receivers, and the companion where nothing waits.

    Each stream is flown for `flight_s` seconds once it has settled.
    """
    end = SETTLE_S + flight_s
    found = []
    for name, stream in STREAMS.items():
        with tempfile.TemporaryDirectory() as logs:
            with ExitStack() as stack:
                peers = {
                    "companion": stack.enter_context(peer(set(), _companion, logs, stream.profile)),
                    "asyncio and pymavlink": stack.enter_context(peer(set(), _bare, True)),
                    "asyncio alone": stack.enter_context(peer(set(), _bare, False)),
                }
                flight, socks = fly(stream), [sock for sock, _ in peers.values()]
                _send_until(SETTLE_S, flight, stream.datagram_s, socks)
                before = {pid: processor_s(pid) for _, pid in peers.values()}
                _send_until(end, flight, stream.datagram_s, socks)
                costs = [
                    Cost(name, process, 100.0 * (processor_s(pid) - before[pid]) / flight_s, memory_mib(pid))
                    for process, (_, pid) in peers.items()
                ]
            turn_ms = 1e3 * float(np.percentile(np.load(Path(logs, TURNS)), 99.9))
            found += [costs[0]._replace(turn_ms=turn_ms), *costs[1:]]
            found.append(Cost(name, "companion in one go, no log", 100.0 * in_one_go(stream, flight_s)))
    return found


def table(costs: list[Cost]) -> Table:
    """Build the table, with the processor time over that of the receiver that parses."""
    heads = "stream", "process", "processor", "over pymavlink", "memory", "turn 99.9 %"
    shown = number_table("live: of one processor", *heads, texts=2)
    parsing = {c.stream: c.processor_percent for c in costs if c.process == "asyncio and pymavlink"}
    for c in costs:
        shown.add_row(
            *(c.stream, c.process, f"{c.processor_percent:.1f} %"),
            f"{c.processor_percent / parsing[c.stream]:.1f}",
            "" if c.memory_mib is None else f"{c.memory_mib:.0f} MiB",
            "" if c.turn_ms is None else f"{c.turn_ms:.1f} ms",
        )
    return shown


def in_one_go(stream: Stream, flight_s: float) -> float:
    """Return the processor seconds for a second of flight where nothing waits for the next datagram."""
    core = CompanionCore(load(None, {"output.profile": stream.profile}, {}), NoLog())
    spent = 0.0
    for t, data in datagrams(fly(stream), stream.datagram_s, SETTLE_S + flight_s):
        now = round(1e9 * (t + 1.0))
        begin = time.process_time()
        core.receive("main", data, now)
        if now >= core.deadline():
            core.poll(now)
        core.to_send("main", now)
        core.settle()
        core.bear()
        spent += (time.process_time() - begin) * (t >= SETTLE_S)
    return spent / flight_s


def datagrams(
    flight: Iterator[tuple[float, bytes]], length_s: float, end: float
) -> Iterator[tuple[float, bytes]]:
    """Yield the frames of every `length_s` in one datagram, and when it is due (s), up to `end`."""
    waiting: list[bytes] = []
    tick: float | None = None
    for t, data in flight:
        tick = t if tick is None else tick
        if t >= tick + length_s:
            yield t, b"".join(waiting)
            waiting, tick = [], t
        waiting.append(data)
        if t >= end:
            return


def fly(stream: Stream) -> Iterator[tuple[float, bytes]]:
    """Yield the time (s) and the frame of every message of the stream, endlessly."""
    rates = {"HEARTBEAT": 1.0, "GPS_GLOBAL_ORIGIN": 0.2, **stream.used, **stream.unused}
    due = dict.fromkeys(rates, 0.0)
    sequence = 0
    while True:
        name = min(due, key=due.__getitem__)
        t, due[name] = due[name], due[name] + 1.0 / rates[name]
        values = FIELDS[name](t) if name in FIELDS else {}
        if name == "HEARTBEAT":
            values["autopilot"] = stream.autopilot
        yield t, frame.encode(dialect.new(name, **values), sequence, 1, 1)
        sequence = sequence + 1 & 0xFF


def _send_until(
    end: float, flight: Iterator[tuple[float, bytes]], datagram_s: float, socks: list[Any]
) -> None:
    """Send the datagrams due before `end` of the flight; discard what comes back."""
    start: float | None = None
    for t, data in datagrams(flight, datagram_s, end):
        start = time.perf_counter() - t if start is None else start
        time.sleep(max(0.0, start + t - time.perf_counter()))
        for sock in socks:
            _exchange(sock, data)


def _exchange(sock: Any, data: bytes) -> None:
    sock.setblocking(False)
    try:
        if data:
            sock.send(data)
        while True:
            sock.recv(65536)
    except (BlockingIOError, ConnectionRefusedError):
        pass


def processor_s(pid: int) -> float:
    """Return the processor time of all threads of a process, s."""
    stats = Path(f"/proc/{pid}/task").glob("*/schedstat")
    return sum(int(stat.read_text().split()[0]) for stat in stats) * 1e-9


def memory_mib(pid: int) -> float:
    """Return the resident memory of a process, MiB."""
    return int(Path(f"/proc/{pid}/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") / (1 << 20)


def _companion(port: int, logs: str, profile: str) -> None:
    turns = array("d")

    class Turn(asyncio.Handle):  # the loop's own, timed
        def _run(self) -> None:
            start = time.thread_time()
            super()._run()
            turns.append(time.thread_time() - start)

    asyncio.events.Handle = asyncio.Handle = Turn  # type: ignore[misc]
    run_companion(port, logs, {"output.profile": profile})
    np.save(Path(logs, TURNS), turns)


def _bare(port: int, parses: bool) -> None:
    """Receive everything, and parse it or not; use nothing."""
    parser = mavlink.MAVLink(None)
    parser.robust_parsing = True

    class Receiver(asyncio.DatagramProtocol):
        def datagram_received(self, data: bytes, addr: Any) -> None:
            if parses:
                parser.parse_buffer(data)

    receive_datagrams(port, Receiver)
