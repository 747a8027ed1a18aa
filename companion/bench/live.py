"""Benchmark of the live path: processor and memory that a flying companion takes, and a bare receiver.

A complete `companion run` (log on, real sockets), a bare asyncio receiver with pymavlink's parser and one
that only receives run in processes of their own and get the same stream. An aircraft flies north at 40 m/s
with GNSS and a beacon. Each stream is flown for FLIGHT_S; the processor time of all threads of each process
is read from the kernel, that of the turns of the companion's event loop is measured in it.
"""

from __future__ import annotations

import asyncio
import math
import os
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from rich.table import Table

from companion.bench.latency import BEACON, HEIGHT, LOOPBACK, ORIGIN, V_NORTH, peer
from companion.config import load
from companion.link import dialect, frame
from companion.link.dialect import mavlink, rsbn
from companion.nav.geometry import local_to_geodetic, slant_range_azimuth
from companion.records import Stamped
from companion.runtime.core import CompanionCore
from companion.runtime.service import run
from companion.tables import number_table

FLIGHT_S = 20.0
SETTLE_S = 10.0  # the first fix
TICK_S = 0.01
TURNS = "turns.npy"


class Stream(NamedTuple):
    """Rates of a stock autopilot, Hz by message: those that the companion uses, and others."""

    autopilot: int
    profile: str
    used: dict[str, float]
    unused: dict[str, float]


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


class Cost(NamedTuple):
    """What a process takes: processor time of a second of flight (%), resident memory (MiB), and the turn of
    its event loop that one in a thousand exceeds (ms of processor time).
    """

    stream: str
    process: str
    processor_percent: float
    memory_mib: float | None = None
    turn_ms: float | None = None


def measure() -> list[Cost]:
    """Measure the companion beside bare receivers, and the companion where nothing waits."""
    found = []
    for name, stream in STREAMS.items():
        with tempfile.TemporaryDirectory() as logs:
            with ExitStack() as stack:
                peers = {
                    "companion": stack.enter_context(peer(set(), _companion, logs, stream.profile)),
                    "asyncio and pymavlink": stack.enter_context(peer(set(), _bare, True)),
                    "asyncio alone": stack.enter_context(peer(set(), _bare, False)),
                }
                flight = fly(stream)
                _send_until(flight, [sock for sock, _ in peers.values()], SETTLE_S)
                before = {pid: processor_s(pid) for _, pid in peers.values()}
                _send_until(flight, [sock for sock, _ in peers.values()], SETTLE_S + FLIGHT_S)
                costs = [
                    Cost(name, process, 100.0 * (processor_s(pid) - before[pid]) / FLIGHT_S, memory_mib(pid))
                    for process, (_, pid) in peers.items()
                ]
            turn_ms = 1e3 * float(np.percentile(np.load(Path(logs, TURNS)), 99.9))
            found += [costs[0]._replace(turn_ms=turn_ms), *costs[1:]]
            found.append(Cost(name, "companion in one go, no log", 100.0 * in_one_go(stream)))
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


class _NoLog:
    def record(self, record: Stamped, channel: str | None = None) -> None:
        """Write nothing."""

    def frame(self, link: str, outgoing: bool, data: bytes, t_ns: int) -> None:
        """Write nothing."""


def in_one_go(stream: Stream) -> float:
    """Return the processor seconds for a second of flight where nothing waits for the next datagram."""
    core = CompanionCore(load(None, {"output.profile": stream.profile}, {}), _NoLog())
    spent = 0.0
    for t, data in datagrams(fly(stream), SETTLE_S + FLIGHT_S):
        now = round(1e9 * (t + 1.0))
        begin = time.process_time()
        core.receive("main", data, now)
        if now >= core.deadline():
            core.poll(now)
        core.to_send("main", now)
        core.settle()
        core.bear()
        spent += (time.process_time() - begin) * (t >= SETTLE_S)
    return spent / FLIGHT_S


def datagrams(flight: Iterator[tuple[float, bytes]], end: float) -> Iterator[tuple[float, bytes]]:
    """Yield the frames of every TICK_S of the flight in one datagram, and when it is due (s), up to `end`."""
    waiting: list[bytes] = []
    tick: float | None = None
    for t, data in flight:
        tick = t if tick is None else tick
        if t >= tick + TICK_S:
            yield t, b"".join(waiting)
            waiting, tick = [], t
        waiting.append(data)
        if t >= end:
            return


def fly(stream: Stream) -> Iterator[tuple[float, bytes]]:
    """Yield the time (s) and the frame of every message of the stream, endlessly."""
    make: dict[str, Callable[[float], dict[str, Any]]] = {
        "HEARTBEAT": lambda t: {
            "type": mavlink.MAV_TYPE_FIXED_WING, "autopilot": stream.autopilot,
            "system_status": mavlink.MAV_STATE_ACTIVE, "mavlink_version": 3,
        },
        "GPS_GLOBAL_ORIGIN": lambda t: {
            "latitude": _degrees(ORIGIN.lat), "longitude": _degrees(ORIGIN.lon),
            "altitude": round(ORIGIN.alt * 1e3),
        },
        "LOCAL_POSITION_NED": lambda t: {
            "time_boot_ms": _ms(t), "x": V_NORTH * t, "z": -HEIGHT, "vx": V_NORTH
        },
        "ATTITUDE": lambda t: {"time_boot_ms": _ms(t), "pitch": 0.03},
        "VFR_HUD": lambda t: {"airspeed": V_NORTH, "groundspeed": V_NORTH, "alt": HEIGHT, "heading": 0},
        "RAW_IMU": lambda t: {"time_usec": _ms(t) * 1000, "zacc": -1000},
        "HIGHRES_IMU": lambda t: {
            "time_usec": _ms(t) * 1000, "zacc": -9.81, "abs_pressure": 920.0, "temperature": 20.0,
            "fields_updated": 63,
        },
        "SCALED_PRESSURE": lambda t: {"time_boot_ms": _ms(t), "press_abs": 920.0, "temperature": 2000},
        "GPS_RAW_INT": _gps,
        "SYS_STATUS": lambda t: dict.fromkeys(
            (f"onboard_control_sensors_{x}" for x in ("present", "enabled", "health")),
            mavlink.MAV_SYS_STATUS_SENSOR_DIFFERENTIAL_PRESSURE,
        ),
        "RSBN_MEASUREMENT": _rsbn,
        "GLOBAL_POSITION_INT": lambda t: {"time_boot_ms": _ms(t), **_place(t)},
        "ATTITUDE_QUATERNION": lambda t: {"time_boot_ms": _ms(t), "q1": 1.0},
    }  # fmt: skip
    rates = {"HEARTBEAT": 1.0, "GPS_GLOBAL_ORIGIN": 0.2, **stream.used, **stream.unused}
    due = dict.fromkeys(rates, 0.0)
    sequence = 0
    while True:
        name = min(due, key=due.__getitem__)
        t, due[name] = due[name], due[name] + 1.0 / rates[name]
        values = make[name](t) if name in make else {}
        yield t, frame.encode(dialect.new(name, **values), sequence, 1, 1)
        sequence = sequence + 1 & 0xFF


def _ms(t: float) -> int:
    return 10_000 + round(t * 1e3)


def _degrees(angle: float) -> int:
    return round(math.degrees(angle) * 1e7)


def _place(t: float) -> dict[str, Any]:
    here = local_to_geodetic("ardupilot", ORIGIN, (V_NORTH * t, 0.0, -HEIGHT))
    return {"lat": _degrees(here.lat), "lon": _degrees(here.lon), "alt": round(here.alt * 1e3)}


def _gps(t: float) -> dict[str, Any]:
    return {
        "time_usec": _ms(t) * 1000, "fix_type": mavlink.GPS_FIX_TYPE_3D_FIX, "eph": 80, "epv": 80,
        "vel": round(V_NORTH * 100), "cog": 0, "satellites_visible": 14, **_place(t),
    }  # fmt: skip


def _rsbn(t: float) -> dict[str, Any]:
    here = local_to_geodetic("ardupilot", ORIGIN, (V_NORTH * t, 0.0, -HEIGHT))
    sight = slant_range_azimuth(BEACON, here)
    return {
        "time_usec": _ms(t) * 1000, "beacon_lat": _degrees(BEACON.lat), "beacon_lon": _degrees(BEACON.lon),
        "beacon_alt": BEACON.alt, "azimuth": sight.azimuth % math.tau, "slant_range": sight.slant_range,
        "sigma_azimuth": math.radians(0.125), "sigma_range": 100.0, "beacon_id": 1,
        "status": rsbn.RSBN_STATUS_AZIMUTH_VALID | rsbn.RSBN_STATUS_RANGE_VALID,
    }  # fmt: skip


def _send_until(flight: Iterator[tuple[float, bytes]], socks: list[Any], end: float) -> None:
    """Send the datagrams due before `end` of the flight; discard what comes back."""
    start: float | None = None
    for t, data in datagrams(flight, end):
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
    flags = {
        "link.connect": (f"udpin:{LOOPBACK}:{port}",),
        "log.folder": logs,
        "log.minimum_free_mib": 0,
        "output.profile": profile,
    }
    turns: list[float] = []

    class Turn(asyncio.Handle):  # the loop's own, timed
        def _run(self) -> None:
            start = time.thread_time()
            super()._run()
            turns.append(time.thread_time() - start)

    asyncio.events.Handle = asyncio.Handle = Turn  # type: ignore[misc]
    asyncio.run(run(load(None, flags, {}), lambda event: None))
    np.save(Path(logs, TURNS), turns)


def _bare(port: int, parses: bool) -> None:
    """Receive everything, and parse it or not; use nothing."""
    parser = mavlink.MAVLink(None)
    parser.robust_parsing = True

    class Receiver(asyncio.DatagramProtocol):
        def datagram_received(self, data: bytes, addr: Any) -> None:
            if parses:
                parser.parse_buffer(data)

    async def serve() -> None:
        await asyncio.get_running_loop().create_datagram_endpoint(Receiver, local_addr=(LOOPBACK, port))
        await asyncio.Event().wait()

    asyncio.run(serve())
