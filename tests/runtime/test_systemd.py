"""systemd notification of a real process: ready, watchdog only while the navigator works, stopping; and the
unit file, checked by systemd-analyze and against our command line."""

import configparser
import contextlib
import os
import shlex
import shutil
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from companion.link import dialect, frame
from companion.runtime.service import LOG_CHECK_S
from companion.runtime.systemd import FEEDS_PER_TIMEOUT, SystemdNotifier

LOOPBACK = "127.0.0.1"
TERM_S = 0.8
LIMIT_S = 60.0  # for what comes in less than a second, except on a busy machine
RUN = "import sys; from companion.__main__ import main; sys.argv[0] = 'companion'; main()"
#: What a faulty service sends its manager when the fault is there; the datagrams keep their order.
FAULT = "STATUS=the fault is there"
#: Fault: a navigator that never returns after the first GNSS fix.
HANGING = f"""
import os, time
from companion.navigator import Navigator
from companion.records import Gnss
from companion.runtime.systemd import SystemdNotifier
handle = Navigator.handle
def hang(self, record):
    if isinstance(record, Gnss):
        SystemdNotifier(os.environ)._notify("{FAULT}")
    while isinstance(record, Gnss):
        time.sleep(0.1)
    return handle(self, record)
Navigator.handle = hang
{RUN}
"""
#: Fault: periodic work stops, and is overdue, while bytes are still transferred.
IDLE = f"""
import os
from companion.runtime.core import CompanionCore
from companion.runtime.service import OVERDUE_NS
from companion.runtime.systemd import SystemdNotifier
poll, polls, sent = CompanionCore.poll, [], []
def twice(self, now):
    polls.append(now)
    if len(polls) < 3:
        poll(self, now)
    elif now - self.deadline() >= OVERDUE_NS and not sent:
        sent.append(now)
        SystemdNotifier(os.environ)._notify("{FAULT}")
CompanionCore.poll = twice
{RUN}
"""
DATA = {
    "heartbeat": dialect.new("HEARTBEAT", type=1, autopilot=3),
    "gnss": dialect.new("GPS_RAW_INT", time_usec=1, fix_type=3, lat=600000000, lon=300000000, alt=100000),
}


def read_all(sock: socket.socket) -> str:
    """Read all pending datagrams."""
    lines = []
    with contextlib.suppress(BlockingIOError):
        while True:
            lines.append(sock.recv(4096).decode())
    return "\n".join(lines)


class Running:
    """`companion run` with a simulated service manager, and an autopilot that sends `DATA` at 20 Hz."""

    def __init__(self, folder: Path, code: str = RUN, name: str = "") -> None:
        self.folder = folder
        self.manager = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self.manager.setblocking(False)
        name = name or str(folder / "notify")
        self.manager.bind("\0" + name[1:] if name.startswith("@") else name)
        self.autopilot = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.autopilot.bind((LOOPBACK, 0))
        self.autopilot.setblocking(False)
        port = self.autopilot.getsockname()[1]
        environment = {k: v for k, v in os.environ.items() if not k.startswith("COMPANION_")}
        environment |= {"NOTIFY_SOCKET": name, "WATCHDOG_USEC": str(round(1e6 * TERM_S))}
        arguments = ["run", "--connect", f"udpout:{LOOPBACK}:{port}", "--logs", str(folder / "logs")]
        self.process = subprocess.Popen(
            [sys.executable, "-c", code, *arguments], env=environment, stderr=subprocess.DEVNULL
        )
        self._peer = None
        self.received = ""

    def play(self, seconds: float, *names: str, until: str = "", times: int = 1) -> str:
        """Send `names` for some seconds or until the manager received `until`; return what it received."""
        received, end = "", time.monotonic() + seconds
        while time.monotonic() < end and not (until and received.count(until) >= times):
            with contextlib.suppress(BlockingIOError):
                self._peer = self.autopilot.recvfrom(65536)[1]
            for name in names:
                if self._peer:
                    with contextlib.suppress(ConnectionRefusedError):
                        self.autopilot.sendto(frame.encode(DATA[name], 0, 1, 1), self._peer)
            time.sleep(0.05)
            received += read_all(self.manager)
        self.received += received
        return received

    def close(self) -> None:
        self.process.kill()
        self.process.wait()
        self.manager.close()
        self.autopilot.close()


@pytest.fixture
def running(tmp_path: Path, request: pytest.FixtureRequest) -> Iterator[Running]:
    run = Running(tmp_path, **getattr(request, "param", {}))
    yield run
    run.close()


@pytest.mark.parametrize("running", [{}, {"name": f"@companion-test-{os.getpid()}"}], indirect=True)
def test_ready_watchdog_and_stopping_are_notified(running: Running) -> None:
    running.play(LIMIT_S, "heartbeat", "gnss", until="READY=1")
    assert "READY=1" in running.received
    assert any((running.folder / "logs").iterdir())
    wanted = "autopilot 1 connected"
    assert wanted in running.received + running.play(LIMIT_S, "heartbeat", "gnss", until=wanted)
    feeds = 2 * FEEDS_PER_TIMEOUT
    assert (
        running.play(LIMIT_S, "heartbeat", "gnss", until="WATCHDOG=1", times=feeds).count("WATCHDOG=1")
        >= feeds
    )
    running.process.send_signal(signal.SIGTERM)
    assert running.process.wait(60) == 0
    received = read_all(running.manager)
    assert "STOPPING=1" in received and "READY" not in received
    assert running.received.count("READY=1") == 1


def test_watchdog_is_fed_without_an_autopilot(running: Running) -> None:
    running.play(LIMIT_S, until="READY=1")
    assert running.play(LIMIT_S, until="WATCHDOG=1", times=3).count("WATCHDOG=1") >= 3


@pytest.mark.parametrize("running", [{"code": HANGING}], indirect=True)
def test_hanging_navigator_stops_the_watchdog(running: Running) -> None:
    running.play(LIMIT_S, "heartbeat", until="connected")
    assert "WATCHDOG=1" in running.play(LIMIT_S, "heartbeat", until="WATCHDOG=1")
    assert not_fed_after_fault(running)


@pytest.mark.parametrize("running", [{"code": IDLE}], indirect=True)
def test_received_bytes_alone_do_not_feed_the_watchdog(running: Running) -> None:
    running.play(LIMIT_S, "heartbeat", "gnss", until="READY=1")
    assert not_fed_after_fault(running)


def not_fed_after_fault(running: Running) -> bool:
    received = running.play(LIMIT_S, "heartbeat", "gnss", until=FAULT)
    assert FAULT in received
    received = received.partition(FAULT)[2] + running.play(2 * TERM_S, "heartbeat", "gnss")
    return "WATCHDOG=1" not in received and running.process.poll() is None


# -- the notifier alone -------------------------------------------------------------------------------------


def manager_at(path: Path, **environment: str) -> tuple[SystemdNotifier, socket.socket]:
    sock = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
    sock.bind(str(path))
    sock.setblocking(False)
    return SystemdNotifier({"NOTIFY_SOCKET": str(path), **environment}), sock


def test_watchdog_is_fed_four_times_in_its_time(tmp_path: Path) -> None:
    """However often the work is completed."""
    manager, sock = manager_at(tmp_path / "notify", WATCHDOG_USEC=str(round(1e6 * TERM_S)))
    fed = []
    for now_ms in range(0, 10_000, 10):
        manager.alive(now_ms * 10**6)
        fed += [now_ms] * read_all(sock).count("WATCHDOG=1")
    assert fed == list(range(0, 10_000, round(1e3 * TERM_S) // FEEDS_PER_TIMEOUT))
    sock.close()


def test_missing_service_manager_is_ignored(tmp_path: Path) -> None:
    for environment in ({}, {"NOTIFY_SOCKET": str(tmp_path / "gone"), "WATCHDOG_USEC": "1000"}):
        manager = SystemdNotifier(environment)
        manager.ready()
        manager.alive(0)
        manager.status("all is well")
        manager.stopping()


def test_watchdog_of_another_process_is_not_fed(tmp_path: Path) -> None:
    for pid, fed in ((os.getpid(), True), (os.getpid() + 1, False)):
        manager, sock = manager_at(tmp_path / str(pid), WATCHDOG_USEC="1000", WATCHDOG_PID=str(pid))
        manager.alive(0)
        assert ("WATCHDOG=1" in read_all(sock)) is fed
        sock.close()


def test_status_is_one_line(tmp_path: Path) -> None:
    manager, sock = manager_at(tmp_path / "notify")
    manager.status("log: two\nlines")
    assert read_all(sock) == "STATUS=log: two lines"
    sock.close()


# -- the unit -----------------------------------------------------------------------------------------------

UNIT = Path(__file__).parents[2] / "deploy" / "companion.service"


def unit() -> configparser.ConfigParser:
    read = configparser.ConfigParser(strict=False, interpolation=None, delimiters="=")
    read.optionxform = str
    read.read(UNIT)
    return read


def test_unit_matches_the_service() -> None:
    service = unit()["Service"]
    assert service["Type"] == "notify"
    # without an autopilot it wakes once a second
    assert float(service["WatchdogSec"]) > FEEDS_PER_TIMEOUT * LOG_CHECK_S
    assert str(os.EX_CONFIG) in service["RestartPreventExitStatus"].split()
    _, command, *options = shlex.split(service["ExecStart"])
    shown = subprocess.run(
        [sys.executable, "-m", "companion", command, "--help"], capture_output=True, text=True, check=True
    )
    for option in options[::2]:
        assert option in shown.stdout


@pytest.mark.skipif(shutil.which("systemd-analyze") is None, reason="there is no systemd-analyze here")
def test_systemd_accepts_the_unit(tmp_path: Path) -> None:
    copy = tmp_path / "companion.service"
    text = UNIT.read_text()
    copy.write_text(text.replace(shlex.split(unit()["Service"]["ExecStart"])[0], sys.executable))
    done = subprocess.run(["systemd-analyze", "verify", str(copy)], capture_output=True, text=True)
    ours = [line for line in done.stderr.splitlines() if "companion" in line]
    assert not ours and done.returncode == 0, done.stderr


@pytest.mark.skipif(shutil.which("systemd-analyze") is None, reason="there is no systemd-analyze here")
def test_the_unit_is_hardened() -> None:
    rate = ["systemd-analyze", "security", "--offline=true", "--threshold=15", str(UNIT)]
    done = subprocess.run(rate, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout[-300:]
