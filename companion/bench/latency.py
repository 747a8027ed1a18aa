"""Benchmark of latency: from a beacon measurement received by UDP to the corrected estimate sent.

A complete `companion run` (log on, real sockets) and an asyncio echo of the same datagram run in processes of
their own. A minimal autopilot here flies north at 40 m/s with GNSS until the navigator has a fix, then sends
beacon measurements one by one; each is timed until the resulting ODOMETRY arrives. Both peers are queried
alternately, after the same pause and with the same wait, so that the ratio of the medians is independent of
the machine's load.

The sending process has a processor of its own, like an autopilot. Otherwise the kernel would run a peer as
small as the echo on the processor that has just sent, without the wake-up of another processor that a message
from outside always needs.
"""

from __future__ import annotations

import asyncio
import math
import multiprocessing
import os
import socket
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from companion.config import load
from companion.link import dialect, frame
from companion.link.dialect import mavlink, rsbn
from companion.link.fields import deg_e7
from companion.nav.geometry import Geodetic, local_to_geodetic, slant_range_azimuth
from companion.runtime.service import run

ROUNDS = 100
WARM_UP = 20  # measurements before timing starts
PATIENCE_S = 60.0  # with a start, a first fix, an estimate
ENDED = "a process of the benchmark ended before the measurement did: its error is above"
ADVICE = "stop other programs on this computer, then run it again"
UDP_PORTS = Path("/proc/net/udp")
ROUND_S = 0.1  # local position at 10 Hz
REST_S = 0.35 * ROUND_S  # before each measurement, so that everything is idle
LOOPBACK = "127.0.0.1"
ORIGIN = Geodetic(math.radians(60.0), math.radians(30.0), 50.0)
BEACON = Geodetic(math.radians(60.05), math.radians(31.07), 80.0)
V_NORTH, HEIGHT = 40.0, 800.0
OWN_INS = {"inertial.independent": True, "output.profile": "ardupilot"}
COMPANION, ECHO = "companion: RSBN in to corrected estimate out", "bare asyncio UDP echo"


def measure() -> dict[str, list[float]]:
    """Measure by round the seconds from measurement sent to estimate received, and those of the echo."""
    with (
        tempfile.TemporaryDirectory() as logs,
        _separate_processors() as others,
        peer(others, run_companion, logs, OWN_INS) as (there, _),
        peer(others, _echo) as (back, _),
    ):
        autopilot = _Autopilot(there)
        times: dict[str, list[float]] = {COMPANION: [], ECHO: []}
        for _ in range(WARM_UP + ROUNDS):
            autopilot.fly()
            answer = autopilot.rsbn_frame()
            time.sleep(REST_S)
            times[COMPANION].append(autopilot.time_response(answer))
            time.sleep(REST_S)
            times[ECHO].append(_round_trip(back, answer))
    return {name: values[WARM_UP:] for name, values in times.items()}


def _ms(t: float) -> int:
    return 10_000 + round(t * 1e3)


def _position(t: float) -> Geodetic:
    return local_to_geodetic("ardupilot", ORIGIN, (V_NORTH * t, 0.0, -HEIGHT))


def _place(t: float) -> dict[str, Any]:
    here = _position(t)
    return {"lat": deg_e7(here.lat), "lon": deg_e7(here.lon), "alt": round(here.alt * 1e3)}


def _rsbn(t: float) -> dict[str, Any]:
    sight = slant_range_azimuth(BEACON, _position(t))
    return {
        "time_usec": 10_000_000 + round(t * 1e6),
        "beacon_lat": deg_e7(BEACON.lat), "beacon_lon": deg_e7(BEACON.lon),
        "beacon_alt": BEACON.alt, "azimuth": sight.azimuth % math.tau, "slant_range": sight.slant_range,
        "sigma_azimuth": math.radians(0.125), "sigma_range": 100.0, "beacon_id": 1,
        "status": rsbn.RSBN_STATUS_AZIMUTH_VALID | rsbn.RSBN_STATUS_RANGE_VALID,
    }  # fmt: skip


#: Fields of the messages that the navigator uses, without errors, by the time of flight (s).
FIELDS: dict[str, Callable[[float], dict[str, Any]]] = {
    "HEARTBEAT": lambda t: {
        "type": mavlink.MAV_TYPE_FIXED_WING, "autopilot": mavlink.MAV_AUTOPILOT_ARDUPILOTMEGA,
        "system_status": mavlink.MAV_STATE_ACTIVE, "mavlink_version": 3,
    },
    "GPS_GLOBAL_ORIGIN": lambda t: {
        "latitude": deg_e7(ORIGIN.lat), "longitude": deg_e7(ORIGIN.lon),
        "altitude": round(ORIGIN.alt * 1e3),
    },
    "LOCAL_POSITION_NED": lambda t: {
        "time_boot_ms": _ms(t), "x": V_NORTH * t, "z": -HEIGHT, "vx": V_NORTH
    },
    # numbers that stand still would be rejected
    "ATTITUDE": lambda t: {"time_boot_ms": _ms(t), "pitch": 0.03 + 0.001 * math.sin(t)},
    "VFR_HUD": lambda t: {
        "airspeed": V_NORTH + 0.3 * math.sin(t), "groundspeed": V_NORTH, "alt": HEIGHT, "heading": 0
    },
    "RAW_IMU": lambda t: {"time_usec": _ms(t) * 1000, "zacc": -1000 + round(20.0 * math.sin(5.0 * t))},
    "HIGHRES_IMU": lambda t: {
        "time_usec": _ms(t) * 1000, "zacc": -9.81 + 0.2 * math.sin(5.0 * t), "abs_pressure": 920.0,
        "temperature": 20.0, "fields_updated": 63,
    },
    "SCALED_PRESSURE": lambda t: {"time_boot_ms": _ms(t), "press_abs": 920.0, "temperature": 2000},
    "GPS_RAW_INT": lambda t: {
        "time_usec": _ms(t) * 1000, "fix_type": mavlink.GPS_FIX_TYPE_3D_FIX, "eph": 80, "epv": 80,
        "vel": round(V_NORTH * 100), "cog": 0, "satellites_visible": 14, **_place(t),
    },
    "SYS_STATUS": lambda t: dict.fromkeys(
        (f"onboard_control_sensors_{x}" for x in ("present", "enabled", "health")),
        mavlink.MAV_SYS_STATUS_SENSOR_DIFFERENTIAL_PRESSURE,
    ),
    "RSBN_MEASUREMENT": _rsbn,
    "GLOBAL_POSITION_INT": lambda t: {"time_boot_ms": _ms(t), **_place(t)},
    "ATTITUDE_QUATERNION": lambda t: {"time_boot_ms": _ms(t), "q1": 1.0},
}  # fmt: skip


class _Autopilot:
    """A minimal autopilot: only the messages that the navigator needs."""

    def __init__(self, sock: socket.socket) -> None:
        self._sock = sock
        self._start = time.perf_counter()
        self._next = 0.0
        self._sequence = 0

    def fly(self) -> None:
        """Wait for the next tenth of a second, send the messages that are due, leave time for them."""
        self._next += ROUND_S
        time.sleep(max(0.0, self._start + self._next - time.perf_counter()))
        self._send_round()
        time.sleep(0.1 * ROUND_S)

    def rsbn_frame(self) -> bytes:
        """Return the frame of a beacon measurement without errors, valid now."""
        return self._frame("RSBN_MEASUREMENT")

    def time_response(self, answer: bytes) -> float:
        """Send a beacon measurement. Return the seconds until the corrected estimate arrives after it.

        The flight goes on meanwhile: an estimate that is not due yet (its message has a rate) leaves with the
        next local position. Raises TimeoutError if none arrives.
        """
        self._drain()
        start = now = time.perf_counter()
        self._sock.send(answer)
        while now - start < PATIENCE_S:
            if now > self._start + self._next + ROUND_S:
                self._next += ROUND_S
                self._send_round()
            try:
                data = self._sock.recv(65536)
            except (BlockingIOError, TimeoutError):
                data = b""
            now = time.perf_counter()  # take the time before parsing
            if _is_odometry(data):
                return now - start
        raise TimeoutError(f"the companion sent no corrected estimate within {PATIENCE_S:g} s: {ADVICE}")

    def _send_round(self) -> None:
        for name in ("HEARTBEAT", "GPS_GLOBAL_ORIGIN", "LOCAL_POSITION_NED", "GPS_RAW_INT"):
            self._sock.send(self._frame(name))

    def _frame(self, name: str) -> bytes:
        self._sequence = self._sequence + 1 & 0xFF
        values = FIELDS[name](time.perf_counter() - self._start)
        return frame.encode(dialect.new(name, **values), self._sequence, 1, 1)

    def _drain(self) -> None:
        self._sock.setblocking(False)
        with suppress(BlockingIOError):
            while True:
                self._sock.recv(65536)
        self._sock.settimeout(ROUND_S / 4)


def _is_odometry(data: bytes) -> bool:
    return any(
        isinstance(found, frame.Frame) and dialect.TYPES[found.msgid].name == "ODOMETRY"
        for found in frame.Reader().receive(data)
    )


def _round_trip(sock: socket.socket, data: bytes) -> float:
    start = time.perf_counter()
    sock.send(data)
    try:
        sock.recv(65536)
    except TimeoutError:
        raise TimeoutError(f"the echo did not arrive within {PATIENCE_S:g} s: {ADVICE}") from None
    return time.perf_counter() - start


@contextmanager
def _separate_processors() -> Iterator[set[int]]:
    """Pin this process to one processor and yield the others, for its peers.

    With a single processor all processes share it.
    """
    every = os.sched_getaffinity(0)
    mine = {min(every)}
    os.sched_setaffinity(0, mine)
    try:
        yield every - mine or every
    finally:
        os.sched_setaffinity(0, every)


@contextmanager
def peer(processors: set[int], serve: Any, *arguments: Any) -> Iterator[tuple[socket.socket, int]]:
    """Run `serve(port, *arguments)` in a process on `processors` (any if empty); yield a socket and its pid.

    It listens by then. The process is terminated by SIGTERM. Raises ChildProcessError if it ends before.
    """
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
            probe.bind((LOOPBACK, 0))
            port = probe.getsockname()[1]
        process = multiprocessing.get_context("spawn").Process(target=serve, args=(port, *arguments))
        process.start()
        if processors:
            os.sched_setaffinity(process.pid or 0, processors)
        try:
            sock.connect((LOOPBACK, port))
            sock.settimeout(PATIENCE_S)
            _wait_until_bound(port, process)
            yield sock, process.pid or 0
        except ConnectionRefusedError:
            raise ChildProcessError(ENDED) from None
        finally:
            process.terminate()
            process.join(PATIENCE_S)


def _wait_until_bound(port: int, process: multiprocessing.process.BaseProcess) -> None:
    """Wait until the process has the UDP port; imports take seconds on a busy computer."""
    start = time.perf_counter()
    while not any(line.split()[1].endswith(f":{port:04X}") for line in UDP_PORTS.read_text().splitlines()):
        if not process.is_alive():
            raise ChildProcessError(ENDED)
        if time.perf_counter() - start > PATIENCE_S:
            raise TimeoutError(f"nothing listens on UDP port {port} after {PATIENCE_S:g} s: {ADVICE}")
        time.sleep(0.02)


def run_companion(port: int, logs: str, flags: dict[str, Any]) -> None:
    """Run the service on a UDP port until SIGTERM."""
    flags = {
        "link.connect": (f"udpin:{LOOPBACK}:{port}",),
        "log.folder": logs,
        "log.minimum_free_mib": 0,
        **flags,
    }
    asyncio.run(run(load(None, flags, {}), lambda event: None))


def receive_datagrams(port: int, protocol: type[asyncio.DatagramProtocol]) -> None:
    """Serve a UDP port by `protocol` until terminated."""

    async def serve() -> None:
        await asyncio.get_running_loop().create_datagram_endpoint(protocol, local_addr=(LOOPBACK, port))
        await asyncio.Event().wait()

    asyncio.run(serve())


def _echo(port: int) -> None:
    class Echo(asyncio.DatagramProtocol):
        def connection_made(self, transport: Any) -> None:
            self._transport = transport

        def datagram_received(self, data: bytes, addr: Any) -> None:
            self._transport.sendto(data, addr)

    receive_datagrams(port, Echo)
