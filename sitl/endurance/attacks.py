"""`python -m sitl.endurance.attacks`: floods and forgeries against a running service, and what they cost it.

Each attack runs against a `companion run` process of its own that receives a simulated flight in real time
over a loopback link without signing. A second process attacks after a quiet time; the rows compare both
times: processor, memory, ODOMETRY, and the delay of the answers to the autopilot's TIMESYNC requests, twenty
a second. `term` sends SIGTERM during the start instead.
"""

from __future__ import annotations

import contextlib
import itertools
import select
import signal
import socket
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Collection, Iterator
from functools import lru_cache
from pathlib import Path
from typing import NamedTuple

import click
from rich.table import Table

from companion.bench.live import memory_mib, processor_s
from companion.link import dialect, frame
from companion.link.dialect import mavlink, rsbn
from companion.option_types import FloatRange
from companion.runtime.core import CompanionCore
from companion.storage.deferred_log import NoLog
from companion.tables import print_tables
from sitl.autopilot import SimulatedAutopilot
from sitl.endurance.fuzz_targets import make_frame
from sitl.endurance.parameter_sweep import CONFIGS, at_extremes, at_limits, param_set, recorded_flight
from sitl.loopback import LINK, START_NS
from sitl.scenarios import get_scenario
from sitl.world import BOOT_S

HOST = "127.0.0.1"
SETTLE_S, START_S = 8.0, 60.0
REQUEST_INTERVAL_S = 0.05
BATCH_S = 0.005


class Attack(NamedTuple):
    """Datagrams (or TCP connections, if `tcp`) per second, made from the autopilot's boot time (us)."""

    rate_hz: float
    make: Callable[[int, int], bytes]
    tcp: bool = False
    first: bool = False  # from before the autopilot's first frame


def _unknown_header(number: int, boot_us: int) -> bytes:
    return bytes((0xFD, 255, 0, 0, 0, 66, 1, number & 0xFF, 0xFF, 0x0F))


def _answer(late_us: int) -> Callable[[int, int], bytes]:
    def make(number: int, boot_us: int) -> bytes:
        message = dialect.new(
            "RSBN_MEASUREMENT",
            time_usec=boot_us - late_us,
            beacon_id=1 + number % 3,
            status=rsbn.RSBN_STATUS_AZIMUTH_VALID | rsbn.RSBN_STATUS_RANGE_VALID,
            azimuth=1.0 + 1e-4 * (number % 997),
            sigma_azimuth=2e-3,
            slant_range=60_000.0 + number % 997,
            sigma_range=100.0,
            beacon_lat=600_500_000,
            beacon_lon=310_700_000,
        )
        return frame.encode(message, number & 0xFF, 1 + number % 250, 42)

    return make


_SETTINGS = (*at_limits(), *at_extremes())


def _param_set(number: int, boot_us: int) -> bytes:
    return param_set(_SETTINGS[number * 31 % len(_SETTINGS)], number)


def _origin(number: int, boot_us: int) -> bytes:
    message = dialect.new("GPS_GLOBAL_ORIGIN", latitude=601_800_000, longitude=303_000_000, altitude=10_000)
    return frame.encode(message, number & 0xFF, 1, 1)


def _heartbeat(number: int, boot_us: int) -> bytes:
    return frame.encode(dialect.new("HEARTBEAT", type=1, autopilot=3), number & 0xFF, 7, 1)


@lru_cache
def _foreign_frames() -> tuple[bytes, ...]:
    names = ("ATTITUDE", "GPS_RAW_INT", "VFR_HUD")
    return tuple(make_frame(names[k % 3], bytes([k]) * 16, 1, k) for k in range(256))


def _foreign(number: int, boot_us: int) -> bytes:
    return _foreign_frames()[number % 256]


def _timesync(number: int, boot_us: int) -> bytes:
    return frame.encode(dialect.new("TIMESYNC", ts1=1 + number), number & 0xFF, 66, 1)


ATTACKS: dict[str, Attack] = {
    "none": Attack(1.0, lambda number, boot_us: b"\0"),
    "forged origin": Attack(10.0, _origin),
    "PARAM_SET extremes": Attack(100.0, _param_set),
    "swallowing headers": Attack(150.0, _unknown_header),
    "swallowing headers x40": Attack(6000.0, _unknown_header),
    "beacon answers, fresh": Attack(1000.0, _answer(0)),
    "beacon answers, 5 s late": Attack(1000.0, _answer(5_000_000)),
    "first HEARTBEAT": Attack(1.0, _heartbeat, first=True),
    "forged frames": Attack(10_000.0, _foreign),
    "TIMESYNC": Attack(1000.0, _timesync),
    "empty datagrams": Attack(1000.0, lambda number, boot_us: b""),
    "TCP connections": Attack(1000.0, lambda number, boot_us: b"", tcp=True),
}
VIRTUAL = [name for name, attack in ATTACKS.items() if not attack.tcp and not attack.first]


class Phase(NamedTuple):
    """Processor share, memory (MiB), ODOMETRY rate (Hz) and delays of TIMESYNC answers (ms) of a phase."""

    cpu: float
    rss_mib: float
    odometry_hz: float
    delays_ms: list[float]
    unanswered: int

    def p99_ms(self) -> float:
        """Return the 99th percentile of the delay."""
        return statistics.quantiles(self.delays_ms, n=100)[98] if len(self.delays_ms) > 1 else float("inf")


class _Station:
    """The autopilot's side in real time: flight, TIMESYNC requests and their answers, ODOMETRY."""

    def __init__(self, sock: socket.socket) -> None:
        self.sock = sock
        self.start = time.monotonic()
        self.autopilot = SimulatedAutopilot(get_scenario("short"))
        self.reader = frame.Reader()
        self.requests: dict[int, float] = {}
        self.delays: list[float] = []
        self.odometry = 0
        self._request_at = self.start
        self._sequence = itertools.count()
        self.sock.setblocking(False)

    def run(self, seconds: float) -> None:
        end = time.monotonic() + seconds
        while (now := time.monotonic()) < end:
            t_ns = round((now - self.start) * 1e9)
            for data in self.autopilot.poll(t_ns):
                self._send(data)
            if now >= self._request_at:
                self._request_at += REQUEST_INTERVAL_S
                stamp = time.monotonic_ns()
                self.requests[stamp] = now
                message = dialect.new("TIMESYNC", ts1=stamp)
                self._send(frame.encode(message, next(self._sequence) & 0xFF, 1, 1))
            due = min(self._request_at, self.start + self.autopilot.deadline() * 1e-9)
            ready, _, _ = select.select([self.sock], [], [], min(max(due - time.monotonic(), 0.0), 0.02))
            if ready:
                self._receive(t_ns)

    def _send(self, data: bytes) -> None:
        with contextlib.suppress(OSError):
            self.sock.send(data)

    def _receive(self, t_ns: int) -> None:
        with contextlib.suppress(OSError):
            while data := self.sock.recv(65536):
                arrived = time.monotonic()
                self.autopilot.receive(data, t_ns)
                for found in self.reader.receive(data):
                    if not isinstance(found, frame.Frame):
                        continue
                    self.odometry += found.msgid == mavlink.MAVLINK_MSG_ID_ODOMETRY
                    if found.msgid == mavlink.MAVLINK_MSG_ID_TIMESYNC:
                        sent = self.requests.pop(dialect.decode(found).ts1, None)
                        if sent is not None:
                            self.delays.append(1e3 * (arrived - sent))

    def measure(self, pid: int, seconds: float) -> Phase:
        """Run for `seconds` and measure the process."""
        self.requests.clear()
        self.delays, self.odometry = [], 0
        before, started = processor_s(pid), time.monotonic()
        self.run(seconds)
        elapsed = time.monotonic() - started
        late = sum(time.monotonic() - sent > 1.0 for sent in self.requests.values())
        cpu = (processor_s(pid) - before) / elapsed
        return Phase(cpu, memory_mib(pid), self.odometry / elapsed, self.delays, late)


@contextlib.contextmanager
def _service(folder: Path, kind: str) -> Iterator[tuple[subprocess.Popen[bytes], int]]:
    with socket.socket() as chosen:
        chosen.bind((HOST, 0))
        port = chosen.getsockname()[1]
    command = [sys.executable, "-m", "companion", "run", "--connect", f"{kind}:{HOST}:{port}"]
    command += ["--logs", str(folder), "--set", "output.profile=ardupilot", "--set", "log.minimum_free_mib=0"]
    command += ["--set", f"link.parameters_file='{folder}/parameters.toml'"]
    with (folder / "stderr").open("wb") as errors, subprocess.Popen(command, stderr=errors) as process:
        try:
            yield process, port
        finally:
            process.send_signal(signal.SIGTERM)
            process.wait(20)


def _connected(kind: str, port: int) -> socket.socket:
    end = time.monotonic() + START_S
    while time.monotonic() < end:
        sock = socket.socket(socket.AF_INET, socket.SOCK_DGRAM if kind == "udpin" else socket.SOCK_STREAM)
        try:
            sock.connect((HOST, port))
            if kind == "udpin":
                sock.send(b"\0")
                time.sleep(0.05)
                sock.send(b"\0")  # ConnectionRefusedError while nobody listens
        except ConnectionRefusedError:
            sock.close()
            time.sleep(0.05)
            continue
        return sock
    raise SystemExit("companion: the service did not listen")


def fly(name: str, seconds: float) -> tuple[Phase, Phase, float, int]:
    """Return the quiet phase, the attacked one, the attack's rate (Hz), and the service's exit code."""
    attack = ATTACKS[name]
    kind = "tcpin" if attack.tcp else "udpin"
    with tempfile.TemporaryDirectory() as folder:
        with _service(Path(folder), kind) as (process, port), _connected(kind, port) as sock:
            if attack.first:
                with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other:
                    other.sendto(attack.make(0, 0), (HOST, port))
                time.sleep(0.5)
            station = _Station(sock)
            station.run(SETTLE_S)
            quiet = station.measure(process.pid, seconds)
            attacker = [sys.executable, "-m", __spec__.name, "--inside", name, str(port), str(seconds + 1.0)]
            attacker.append(str(station.start))
            with subprocess.Popen(attacker, stdout=subprocess.PIPE) as other_process:
                assert other_process.stdout is not None
                while not select.select([other_process.stdout], [], [], 0.0)[0]:  # until it attacks
                    station.run(0.1)
                station.run(0.5)
                attacked = station.measure(process.pid, seconds)
                station.run(1.0)
                sent = other_process.stdout.read().split()
                if other_process.wait():
                    raise SystemExit(f"companion: the attacker of {name!r} failed")
        return quiet, attacked, float(sent[-1]), process.returncode


def attack_from_here(name: str, port: int, seconds: float, start: float) -> None:
    """Send the attack's datagrams, or open its connections, at its rate; print the rate that was reached."""
    attack = ATTACKS[name]
    click.echo("begins")
    began, sent, numbers = time.monotonic(), 0, itertools.count(1)
    clients: list[socket.socket] = []
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:
        while (now := time.monotonic()) < began + seconds:
            while sent < attack.rate_hz * (now - began):
                sent += 1
                if attack.tcp:
                    client = socket.socket()
                    client.setblocking(False)
                    client.connect_ex((HOST, port))
                    clients.append(client)
                    if len(clients) > 500:
                        clients.pop(0).close()
                else:
                    boot_us = round((time.monotonic() - start + BOOT_S) * 1e6)
                    with contextlib.suppress(OSError):
                        sock.sendto(attack.make(next(numbers), boot_us), (HOST, port))
            time.sleep(BATCH_S)
    click.echo(f"{sent / (time.monotonic() - began):.0f}")


class Cost(NamedTuple):
    """Processor share of a companion in virtual time, its longest call (ms), and its ODOMETRY rate (Hz)."""

    share: float
    longest_ms: float
    odometry_hz: float


def virtual_cost(name: str, seconds: float = 10.0) -> Cost:
    """Fly the recorded flight in virtual time; attack after the first SETTLE_S for `seconds`."""
    attack, core = ATTACKS[name], CompanionCore(CONFIGS[1], NoLog(), (LINK,))
    sent, odometry, used, longest, reader = 0, 0, 0.0, 0.0, frame.Reader()

    def process(data: bytes, now: int, peer: str) -> None:
        nonlocal used, longest, odometry
        before = time.process_time()
        core.receive(LINK, data, now, peer)
        if core.deadline() <= now:
            core.poll(now)
        frames = core.to_send(LINK, now)
        core.take_events()
        core.settle()
        taken = time.process_time() - before
        if (now - START_NS) * 1e-9 >= SETTLE_S:
            used, longest = used + taken, max(longest, taken)
            odometry += sum(
                isinstance(found, frame.Frame) and found.msgid == mavlink.MAVLINK_MSG_ID_ODOMETRY
                for data in frames
                for found in reader.receive(data)
            )

    for now, data in recorded_flight(CONFIGS[1].inertial.independent):
        t = (now - START_NS) * 1e-9 - SETTLE_S
        if t > seconds:
            break
        process(data, now, "autopilot")
        while sent < attack.rate_hz * t:
            sent += 1
            process(attack.make(sent, round((t + SETTLE_S + BOOT_S) * 1e6)), now, "stranger")
    return Cost(used / seconds, 1e3 * longest, odometry / seconds)


def stop_during_start(times: int) -> list[int]:
    """Return the exit codes of services that get SIGTERM 0.1 to 1.5 s after their start."""
    codes = []
    for number in range(times):
        with tempfile.TemporaryDirectory() as folder:
            command = [sys.executable, "-m", "companion", "run", "--connect", f"udpin:{HOST}:0"]
            command += ["--logs", folder]
            with subprocess.Popen(command, stderr=subprocess.DEVNULL) as process:
                time.sleep(0.1 + 1.4 * number / max(times - 1, 1))
                process.send_signal(signal.SIGTERM)
                codes.append(process.wait(30))
    return codes


def _virtual_costs(only: Collection[str]) -> Table:
    table = Table("attack", "per second", "processor", "longest call", "ODOMETRY")
    flown = [name for name in VIRTUAL if not only or name in only]
    if not flown:
        raise click.UsageError(f"--only {', '.join(only)}: not flown in virtual time: leave out --virtual")
    for name in flown:
        share, longest_ms, hz = virtual_cost(name)
        row = f"{100.0 * share:.1f} %", f"{longest_ms:.1f} ms", f"{hz:.1f} Hz"
        table.add_row(name, f"{ATTACKS[name].rate_hz:g}", *row)
    return table


@click.command()
@click.option("--seconds", type=FloatRange(1.0), default=15.0, show_default=True, help="Of each phase.")
@click.option(
    "--only", type=click.Choice([*ATTACKS, "term"]), multiple=True, help="May be repeated; default: all."
)
@click.option("--virtual", is_flag=True, help="In virtual time: the processor time alone, on any machine.")
def main(seconds: float, only: tuple[str, ...], virtual: bool) -> None:
    """Attack a running service and print what it costs."""
    if virtual:
        print_tables(_virtual_costs(only))
        return
    columns = "attack", "per second", "processor", "memory", "ODOMETRY", "p99 of delay", "unanswered", "exit"
    table = Table(*columns, caption="each value: quiet, then attacked")
    for name in [name for name in ATTACKS if not only or name in only]:
        quiet, attacked, rate_hz, code = fly(name, seconds)
        table.add_row(
            name,
            f"{rate_hz:g}",
            f"{100 * quiet.cpu:.0f} / {100 * attacked.cpu:.0f} %",
            f"{quiet.rss_mib:.0f} / {attacked.rss_mib:.0f} MiB",
            f"{quiet.odometry_hz:.1f} / {attacked.odometry_hz:.1f} Hz",
            f"{quiet.p99_ms():.1f} / {attacked.p99_ms():.1f} ms",
            f"{quiet.unanswered} / {attacked.unanswered}",
            str(code),
        )
        click.echo(f"{name}: done", err=True)
    if table.rows:
        print_tables(table)
    if not only or "term" in only:
        click.echo(f"SIGTERM during the start, exit codes: {stop_during_start(10)}")


if __name__ == "__main__":
    if sys.argv[1:2] == ["--inside"]:
        attack_from_here(sys.argv[2], int(sys.argv[3]), float(sys.argv[4]), float(sys.argv[5]))
    else:
        main()
