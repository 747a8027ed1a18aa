"""The shell over real sockets, disks and signals: what is wrong gets one line and a code, nothing logged is
lost."""

import asyncio
import contextlib
import fcntl
import os
import signal
import socket
import subprocess
import sys
import termios
import time
from pathlib import Path

import pytest

from companion.config import load
from companion.link import dialect, frame
from companion.records import Event
from companion.runtime.service import EX_CANTCREAT, EX_UNAVAILABLE, Service
from companion.storage import flight_log
from companion.transport.links import Address, CannotListen

LOOPBACK = "127.0.0.1"
HEARTBEAT = frame.encode(dialect.new("HEARTBEAT", type=1, autopilot=3), 0, 1, 1)


def free_port() -> int:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:
        sock.bind((LOOPBACK, 0))
        return sock.getsockname()[1]


def log_in(folder: Path) -> flight_log.Writer:
    return flight_log.Writer(
        folder / "a.mcap", metadata={}, start_unix_ns=time.time_ns(), start_ns=time.monotonic_ns()
    )


async def until(condition, seconds: float = 10.0) -> None:
    for _ in range(round(seconds / 0.01)):
        if condition():
            return
        await asyncio.sleep(0.01)
    raise TimeoutError


def serve(tmp_path: Path, connect: tuple[str, ...], play) -> list[Event]:
    """Run a Service while `play(service, told)` lasts; what it told."""
    told: list[Event] = []

    async def both() -> None:
        with log_in(tmp_path) as log:
            service = Service(load(None, {"link.connect": connect}, {}), log, told.append)
            serving = asyncio.create_task(service.serve())
            try:
                await play(service, told)
            finally:
                service.stop()
                await serving

    asyncio.run(both())
    return told


def test_an_autopilot_on_udp_is_heard_answered_and_logged(tmp_path: Path) -> None:
    port = free_port()
    replies: list[bytes] = []

    async def play(service: Service, told: list[Event]) -> None:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:
            sock.setblocking(False)
            sock.connect((LOOPBACK, port))

            def heard() -> bool:
                try:
                    sock.send(HEARTBEAT)
                    replies.append(sock.recv(65536))
                except (BlockingIOError, ConnectionRefusedError):
                    pass
                return len(replies) >= 3

            await until(heard)

    told = serve(tmp_path, (f"udpin:{LOOPBACK}:{port}",), play)
    assert any("autopilot 1 heard (ardupilot)" in event.text for event in told)
    names = {
        dialect.TYPES[found.msgid].name
        for data in replies
        for found in frame.Reader().receive(data)
        if isinstance(found, frame.Frame)
    }
    assert names & {"HEARTBEAT", "TIMESYNC", "COMMAND_LONG"}
    topics = flight_log.info(tmp_path / "a.mcap").counts
    assert any(topic.endswith("/rx") for topic in topics) and any(topic.endswith("/tx") for topic in topics)


def listening() -> set[str]:
    """The local addresses of this process's sockets that anybody may speak to."""
    found = set()
    for link in Path("/proc/self/fd").iterdir():
        with contextlib.suppress(OSError):
            if not os.readlink(link).startswith("socket:"):
                continue
        with contextlib.suppress(OSError), socket.socket(fileno=os.dup(int(link.name))) as sock:
            bound = sock.family in (socket.AF_INET, socket.AF_INET6) and sock.getsockname()[1]
            accepts = sock.type == socket.SOCK_DGRAM or sock.getsockopt(
                socket.SOL_SOCKET, socket.SO_ACCEPTCONN
            )
            if bound and accepts:
                found.add(sock.getsockname()[0])
    return found


@pytest.mark.skipif(not os.path.isdir("/proc/self/fd"), reason="sockets are looked up in /proc")
@pytest.mark.parametrize(
    ("connect", "heard_at"),
    [
        ("udpin:{port}", LOOPBACK),
        ("tcpin:{port}", LOOPBACK),
        ("udpin::{port}", LOOPBACK),
        ("udpin:0.0.0.0:{port}", "0.0.0.0"),  # asked for in so many words
    ],
)
def test_nothing_listens_beyond_the_loopback_unless_configured(
    tmp_path: Path, connect: str, heard_at: str
) -> None:
    seen = set[str]()
    assert Address.parse(load(None, {}, {}).link.connect[0]).place == LOOPBACK

    async def play(service: Service, told: list[Event]) -> None:
        await until(lambda: listening() - before)
        seen.update(listening() - before)

    before = listening()
    serve(tmp_path, (connect.format(port=free_port()),), play)
    assert seen == {heard_at}


def test_an_address_in_use_ends_it_with_a_sentence(tmp_path: Path) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as taken:
        taken.bind((LOOPBACK, 0))
        connect = f"udpin:{LOOPBACK}:{taken.getsockname()[1]}"

        async def play(service: Service, told: list[Event]) -> None:
            await asyncio.sleep(0.2)

        with pytest.raises(CannotListen, match="choose another port"):
            serve(tmp_path, (connect,), play)
    assert flight_log.info(tmp_path / "a.mcap").closed


def test_a_missing_serial_device_is_said_once_and_the_other_link_lives(tmp_path: Path) -> None:
    port = free_port()
    missing = f"serial:{tmp_path}/ttyNONE:57600"

    async def play(service: Service, told: list[Event]) -> None:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:
            sock.connect((LOOPBACK, port))

            def heard() -> bool:
                with contextlib.suppress(ConnectionRefusedError):
                    sock.send(HEARTBEAT)
                return any("heard" in event.text for event in told)

            await until(heard)
            await asyncio.sleep(1.0)  # several attempts

    told = serve(tmp_path, (missing, f"udpin:{LOOPBACK}:{port}"), play)
    assert sum("ttyNONE" in event.text for event in told) == 1
    assert any("No such file" in event.text for event in told)


# -- whole processes ----------------------------------------------------------------------------------------


ENVIRONMENT = {name: value for name, value in os.environ.items() if not name.startswith("COMPANION_")}
RUN = [sys.executable, "-m", "companion", "run"]


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_a_signal_closes_the_log_whole(tmp_path: Path, number: signal.Signals) -> None:
    port, logs, said = free_port(), tmp_path / "logs", tmp_path / "said"
    command = [*RUN, "--connect", f"udpin:{LOOPBACK}:{port}", "--logs", str(logs)]
    with (
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock,
        said.open("w") as stderr,
        subprocess.Popen(command, stderr=stderr, env=ENVIRONMENT) as process,
    ):
        sock.connect((LOOPBACK, port))
        deadline = time.monotonic() + 30.0
        while "heard" not in said.read_text() and time.monotonic() < deadline:
            with contextlib.suppress(ConnectionRefusedError):
                sock.send(HEARTBEAT)
            time.sleep(0.05)
        process.send_signal(number)
        assert process.wait(20) == 0
    assert "log: closed as" in said.read_text()
    (log,) = logs.iterdir()
    assert log.suffix == ".mcap"
    info = flight_log.info(log)
    assert info.closed and info.counts["/link/Event"] >= 2
    assert any(isinstance(e.value, Event) and "heard" in e.value.text for e in flight_log.read(log))


@pytest.mark.skipif(sys.platform != "linux", reason="a pipe's size is set and asked for as on Linux")
def test_a_reader_who_never_reads_holds_nothing_up(tmp_path: Path) -> None:
    """Events until the pipe behind stderr is full, and more: it answers, and ends when it is to."""
    port = free_port()
    command = [*RUN, "--connect", f"udpin:{LOOPBACK}:{port}", "--logs", str(tmp_path)]
    with (
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock,
        subprocess.Popen(command, stderr=subprocess.PIPE, env=ENVIRONMENT) as process,
    ):
        assert process.stderr is not None
        size = fcntl.fcntl(process.stderr, fcntl.F_SETPIPE_SZ, 4096)
        sock.connect((LOOPBACK, port))
        sock.settimeout(0.05)
        others = iter(range(2, 256))

        def is_answered() -> bool:
            with contextlib.suppress(ConnectionRefusedError, TimeoutError):
                sock.send(HEARTBEAT)
                return bool(sock.recv(65536))
            return False

        def unread() -> int:
            return int.from_bytes(fcntl.ioctl(process.stderr, termios.FIONREAD, bytes(4)), sys.byteorder)

        deadline = time.monotonic() + 30.0
        while not is_answered() and time.monotonic() < deadline:
            time.sleep(0.05)
        for system in others:  # each is told: a second autopilot
            sock.send(frame.encode(dialect.new("HEARTBEAT", type=1, autopilot=3), 0, system, 1))
        while unread() < size - 100 and time.monotonic() < deadline:
            time.sleep(0.05)
        while is_answered():  # what was answered before it was full
            pass
        sock.settimeout(5.0)
        try:
            assert all(is_answered() for _ in range(3))
            process.send_signal(signal.SIGTERM)
            assert process.wait(20) == 0
        finally:
            process.kill()
        assert b"a second autopilot, 2, is ignored" in process.stderr.read()
    (log,) = tmp_path.glob("*.mcap")
    assert flight_log.info(log).closed


def set_in_a_run(tmp_path: Path, name: str, value: float, awaited: str) -> None:
    """One run of the service, in which a station sets a parameter until `awaited` is in the file."""
    port, kept, config = free_port(), tmp_path / "set.toml", tmp_path / "companion.toml"
    config.write_text(f'[link]\nparameters_file = "{kept}"\n[gnss]\nsigma_m = 2.0\n')
    command = [*RUN, "--config", str(config), "--connect", f"udpin:{LOOPBACK}:{port}"]
    wish = dialect.new(
        "PARAM_SET",
        param_id=name.encode(),
        param_value=value,
        param_type=9,
        target_system=1,
        target_component=191,
    )
    with (
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock,
        subprocess.Popen(
            [*command, "--logs", str(tmp_path / "logs")], stderr=subprocess.DEVNULL, env=ENVIRONMENT
        ) as process,
    ):
        sock.connect((LOOPBACK, port))
        deadline = time.monotonic() + 30.0
        while not (kept.exists() and awaited in kept.read_text()) and time.monotonic() < deadline:
            with contextlib.suppress(ConnectionRefusedError):
                sock.send(HEARTBEAT)
                sock.send(frame.encode(wish, 0, 255, 190))
            time.sleep(0.05)
        process.send_signal(signal.SIGTERM)
        assert process.wait(20) == 0


def test_what_is_set_in_one_run_outlives_what_is_set_in_the_next(tmp_path: Path) -> None:
    set_in_a_run(tmp_path, "GNSS_SIGMA_M", 7.0, "sigma_m")
    set_in_a_run(tmp_path, "GNSS_TIMEOUT_S", 5.0, "timeout_s")
    kept = load(tmp_path / "set.toml", {}, {}).gnss
    assert (kept.sigma_m, kept.timeout_s) == (7.0, 5.0)


def finished(*arguments: str) -> tuple[int, str]:
    done = subprocess.run([*RUN, *arguments], capture_output=True, text=True, timeout=30, env=ENVIRONMENT)
    return done.returncode, done.stderr


def test_a_port_in_use_exits_69_with_one_line(tmp_path: Path) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as taken:
        taken.bind((LOOPBACK, 0))
        code, said = finished(
            "--connect", f"udpin:{LOOPBACK}:{taken.getsockname()[1]}", "--logs", str(tmp_path)
        )
    assert code == EX_UNAVAILABLE
    assert sum(line.startswith("companion: cannot listen") for line in said.splitlines()) == 1
    assert "Traceback" not in said
    assert not list(tmp_path.iterdir())  # a start that never flew leaves no log to take a flight's place


def test_a_key_that_is_not_there_exits_78_and_leaves_no_log(tmp_path: Path) -> None:
    code, said = finished("--set", f"signing.key_file={tmp_path / 'none'}", "--logs", str(tmp_path))
    assert code == 78 and "signing.key_file" in said
    assert not list(tmp_path.iterdir())


def test_a_log_folder_that_cannot_be_written_exits_73_with_one_line(tmp_path: Path) -> None:
    folder = tmp_path / "logs"
    if os.geteuid() == 0:  # root may write everywhere but into a file
        folder.write_text("no folder")
    else:
        folder.mkdir(mode=0o555)
    code, said = finished("--logs", str(folder))
    assert code == EX_CANTCREAT
    assert len(said.splitlines()) == 1 and str(folder) in said


def test_a_bad_link_exits_78_with_one_line(tmp_path: Path) -> None:
    code, said = finished("--connect", "udp:1.2.3.4", "--logs", str(tmp_path))
    assert code == 78
    assert len(said.splitlines()) == 1 and "link.connect" in said


def test_a_consumer_that_does_not_read_costs_the_oldest_frames_and_they_are_counted(tmp_path: Path) -> None:
    """A TCP peer that sends and never reads: the newest words wait for it, the log says how many did not; if
    it were waited for, this would not end.
    """
    port = free_port()

    async def play(service: Service, told: list[Event]) -> None:
        with socket.socket() as sock:
            sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 2048)
            await until(lambda: sock.connect_ex((LOOPBACK, port)) == 0)
            sock.setblocking(False)
            (link,) = service.onboard.links.values()

            def stuck() -> bool:
                with contextlib.suppress(BlockingIOError):
                    sock.send(HEARTBEAT)
                for _ in range(500):  # far more than any ground station is told
                    link.session.send(dialect.new("ATTITUDE"))
                service._flush()
                return link.dropped > 1000

            await until(stuck, 20.0)
            await asyncio.sleep(1.2)  # a state of the link is logged every second

    told = serve(tmp_path, (f"tcpin:{LOOPBACK}:{port}",), play)
    assert sum("does not carry what is sent" in event.text for event in told) == 1
    states = [
        e.value.dropped for e in flight_log.read(tmp_path / "a.mcap") if type(e.value).__name__ == "LinkState"
    ]
    assert states == sorted(states) and states[-1] > 1000
