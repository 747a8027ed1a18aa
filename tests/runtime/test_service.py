"""Service with real sockets, disks and signals: errors end with one line and an exit code, the log is
complete."""

import asyncio
import contextlib
import fcntl
import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from companion.config import load, to_toml
from companion.link import dialect, frame
from companion.records import Event, LinkState
from companion.runtime import service
from companion.runtime.kept_run import Flown, KeptRun
from companion.runtime.service import Service
from companion.storage import flight_log, retention
from companion.transport.reconnect import Address, CannotListen
from tests.network import free_port, until

LOOPBACK = "127.0.0.1"
HEARTBEAT = frame.encode(dialect.new("HEARTBEAT", type=1, autopilot=3), 0, 1, 1)


def log_in(folder: Path) -> flight_log.Writer:
    return flight_log.Writer(
        folder / "a.mcap", metadata={}, start_unix_ns=time.time_ns(), start_ns=time.monotonic_ns()
    )


def serve(tmp_path: Path, connect: tuple[str, ...], play) -> list[Event]:
    """Run a Service during `play(service, events)`, or until it fails; return its events."""
    events: list[Event] = []

    async def both() -> None:
        with log_in(tmp_path) as log:
            stopped = asyncio.Event()
            service = Service(load(None, {"link.connect": connect}, {}), log, events.append)
            serving = asyncio.create_task(service.serve(stopped))
            playing = asyncio.create_task(play(service, events))
            await asyncio.wait((serving, playing), return_when=asyncio.FIRST_COMPLETED)
            if serving.done():
                playing.cancel()
            stopped.set()
            await serving
            await playing

    asyncio.run(both())
    return events


def test_interrupt_while_the_log_is_created_is_a_stop(tmp_path: Path, monkeypatch) -> None:
    def create_log(*args, **options):
        signal.raise_signal(signal.SIGINT)
        return retention.create_log(*args, **options)

    monkeypatch.setattr(service, "create_log", create_log)
    flags = {"link.connect": (f"udpin:{LOOPBACK}:{free_port()}",), "log.folder": str(tmp_path)}
    events: list[Event] = []
    asyncio.run(service.run(load(None, flags, {}), events.append))
    assert events[-1].text.startswith("log: closed as ")


def test_a_link_has_the_name_of_its_whole_address(tmp_path: Path) -> None:
    """With the default host too: what is reported of silence has advice for the loopback address."""
    with log_in(tmp_path) as log:
        service = Service(load(None, {"link.connect": ("udpin:14550", "tcpin:5760")}, {}), log, print)
    assert list(service.core.links) == ["udpin:127.0.0.1:14550", "tcpin:127.0.0.1:5760"]


def test_udp_autopilot_is_answered_and_logged(tmp_path: Path) -> None:
    port = free_port()
    replies: list[bytes] = []

    def names() -> set[str]:
        return {
            dialect.TYPES[found.msgid].name
            for data in replies
            for found in frame.Reader().receive(data)
            if isinstance(found, frame.Frame)
        }

    async def play(service: Service, events: list[Event]) -> None:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:
            sock.setblocking(False)
            sock.connect((LOOPBACK, port))

            def has_replies() -> bool:
                try:
                    sock.send(HEARTBEAT)
                    replies.append(sock.recv(65536))
                except (BlockingIOError, ConnectionRefusedError):
                    pass
                return len(replies) >= 3 and bool(names() & {"HEARTBEAT", "TIMESYNC", "COMMAND_LONG"})

            await until(has_replies)

    events = serve(tmp_path, (f"udpin:{LOOPBACK}:{port}",), play)
    assert any("autopilot 1 connected (ardupilot)" in event.text for event in events)
    topics = flight_log.info(tmp_path / "a.mcap").counts
    assert any(topic.endswith("/rx") for topic in topics) and any(topic.endswith("/tx") for topic in topics)


def listening() -> set[str]:
    """Return the local addresses on which this process listens."""
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
    ("connect", "expected"),
    [
        ("udpin:{port}", LOOPBACK),
        ("tcpin:{port}", LOOPBACK),
        ("udpin::{port}", LOOPBACK),
        ("udpin:0.0.0.0:{port}", "0.0.0.0"),  # configured explicitly
    ],
)
def test_only_loopback_addresses_listen_unless_configured(
    tmp_path: Path, connect: str, expected: str
) -> None:
    seen = set[str]()
    assert Address.parse(load(None, {}, {}).link.connect[0]).place == LOOPBACK

    async def play(service: Service, events: list[Event]) -> None:
        await until(lambda: listening() - before)
        seen.update(listening() - before)

    before, address = listening(), connect.format(port=free_port())
    events = serve(tmp_path, (address,), play)
    assert seen == {expected}
    assert [e.text for e in events if "listening" in e.text] == [f"listening: {Address.parse(address)}"]


@pytest.mark.parametrize("kind", ["udpin", "tcpin"])
def test_a_port_that_the_system_chose_is_reported(tmp_path: Path, kind: str) -> None:
    async def play(service: Service, events: list[Event]) -> None:
        await until(lambda: any("listening" in event.text for event in events))

    events = serve(tmp_path, (f"{kind}:{LOOPBACK}:0",), play)
    (port,) = [e.text.rpartition(":")[2] for e in events if "listening" in e.text]
    assert int(port) > 0


def test_listening_is_reported_only_once_the_socket_is_bound(tmp_path: Path) -> None:
    async def play(service: Service, events: list[Event]) -> None:
        await until(lambda: any("at present; trying again" in event.text for event in events))

    events = serve(tmp_path, ("udpin:192.0.2.1:14550",), play)  # an address of examples, of no computer
    assert not any("listening" in event.text for event in events)


def test_address_in_use_raises_cannot_listen(tmp_path: Path) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as taken:
        taken.bind((LOOPBACK, 0))
        connect = f"udpin:{LOOPBACK}:{taken.getsockname()[1]}"

        async def play(service: Service, events: list[Event]) -> None:
            await asyncio.sleep(60.0)

        with pytest.raises(CannotListen, match="choose another port"):
            serve(tmp_path, (connect,), play)
    assert flight_log.info(tmp_path / "a.mcap").closed


def test_missing_serial_device_is_reported_once_and_the_other_link_works(tmp_path: Path) -> None:
    port = free_port()
    missing = f"serial:{tmp_path}/ttyNONE:57600"

    async def play(service: Service, events: list[Event]) -> None:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:
            sock.connect((LOOPBACK, port))

            def has_replies() -> bool:
                with contextlib.suppress(ConnectionRefusedError):
                    sock.send(HEARTBEAT)
                return any("connected" in event.text for event in events)

            await until(has_replies)
            await asyncio.sleep(1.0)  # several attempts
            assert [link.is_open for link in service.core.links.values()] == [False, True]

    events = serve(tmp_path, (missing, f"udpin:{LOOPBACK}:{port}"), play)
    assert sum("ttyNONE" in event.text for event in events) == 1
    assert any("no such device" in event.text for event in events)


# -- whole processes ----------------------------------------------------------------------------------------


ENVIRONMENT = {name: value for name, value in os.environ.items() if not name.startswith("COMPANION_")}
RUN = [sys.executable, "-m", "companion", "run"]
Companion = Callable[..., subprocess.CompletedProcess[str]]


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT, signal.SIGHUP])
def test_signal_closes_the_log(tmp_path: Path, number: signal.Signals) -> None:
    port, logs, output = free_port(), tmp_path / "logs", tmp_path / "stderr"
    command = [*RUN, "--connect", f"udpin:{LOOPBACK}:{port}", "--logs", str(logs)]
    before = signal.signal(number, signal.SIG_DFL)  # a process inherits what is ignored, as by nohup
    with (
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock,
        output.open("w") as stderr,
        subprocess.Popen(command, stderr=stderr, env=ENVIRONMENT) as process,
    ):
        signal.signal(number, before)
        sock.connect((LOOPBACK, port))
        deadline = time.monotonic() + 60.0
        while "connected" not in output.read_text() and time.monotonic() < deadline:
            with contextlib.suppress(ConnectionRefusedError):
                sock.send(HEARTBEAT)
            time.sleep(0.05)
        process.send_signal(number)
        assert process.wait(60) == 0
    assert "log: closed as" in output.read_text()
    (log,) = logs.iterdir()
    assert log.suffix == ".mcap"
    info = flight_log.info(log)
    assert info.closed and info.counts["/link/Event"] >= 2
    assert any(isinstance(e.value, Event) and "connected" in e.value.text for e in flight_log.read(log))


def test_nohup_keeps_the_service_running(tmp_path: Path) -> None:
    command = ["nohup", *RUN, "--connect", f"udpin:{LOOPBACK}:{free_port()}", "--logs", str(tmp_path)]
    with subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, env=ENVIRONMENT) as run:
        assert run.stderr is not None
        while b"listening" not in run.stderr.readline():
            assert run.poll() is None
        run.send_signal(signal.SIGHUP)
        with pytest.raises(subprocess.TimeoutExpired):
            run.wait(1.0)
        run.send_signal(signal.SIGTERM)
        assert run.wait(60) == 0


@pytest.mark.skipif(sys.platform != "linux", reason="a pipe's size is set and asked for as on Linux")
def test_full_stderr_does_not_block_the_service(tmp_path: Path) -> None:
    """stderr is not read and its pipe is full from the start: the service answers, and stops on request."""
    port = free_port()
    command = [*RUN, "--connect", f"udpin:{LOOPBACK}:{port}", "--logs", str(tmp_path)]
    reading, writing = os.pipe()
    os.write(writing, bytes(fcntl.fcntl(writing, fcntl.F_SETPIPE_SZ, 4096)))
    with (
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock,
        subprocess.Popen(command, stderr=writing, env=ENVIRONMENT) as process,
    ):
        os.close(writing)
        sock.connect((LOOPBACK, port))
        sock.settimeout(0.05)

        def is_answered() -> bool:
            with contextlib.suppress(ConnectionRefusedError, TimeoutError):
                sock.send(HEARTBEAT)
                return bool(sock.recv(65536))
            return False

        try:
            deadline = time.monotonic() + 60.0
            while not is_answered() and time.monotonic() < deadline:
                time.sleep(0.05)
            for system in range(2, 20):  # reported as other autopilots
                sock.send(frame.encode(dialect.new("HEARTBEAT", type=1, autopilot=3), 0, system, 1))
            sock.settimeout(30.0)
            assert all(is_answered() for _ in range(3))
            process.send_signal(signal.SIGTERM)
            assert process.wait(60) == 0
            assert not os.read(reading, 8192).strip(b"\0")  # full to the end
        finally:
            process.kill()
            os.close(reading)
    (log,) = tmp_path.glob("*.mcap")
    assert flight_log.info(log).closed


def set_in_a_run(tmp_path: Path, name: str, value: float, awaited: str) -> None:
    """Run the service and set a parameter until `awaited` is in the parameters file."""
    port, saved, config = free_port(), tmp_path / "set.toml", tmp_path / "companion.toml"
    config.write_text(f'[link]\nparameters_file = "{saved}"\n[gnss]\nsigma_m = 2.0\n')
    command = [*RUN, "--config", str(config), "--connect", f"udpin:{LOOPBACK}:{port}"]
    request = dialect.new(
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
        deadline = time.monotonic() + 60.0
        while not (saved.exists() and awaited in saved.read_text()) and time.monotonic() < deadline:
            with contextlib.suppress(ConnectionRefusedError):
                sock.send(HEARTBEAT)
                sock.send(frame.encode(request, 0, 255, 190))
            time.sleep(0.05)
        process.send_signal(signal.SIGTERM)
        assert process.wait(60) == 0


def test_parameters_of_two_runs_are_both_saved(tmp_path: Path) -> None:
    set_in_a_run(tmp_path, "GNSS_SIGMA_M", 7.0, "sigma_m")
    set_in_a_run(tmp_path, "GNSS_TIMEOUT_S", 5.0, "timeout_s")
    saved = load(tmp_path / "set.toml", {}, {}).gnss
    assert (saved.sigma_m, saved.timeout_s) == (7.0, 5.0)


def test_port_in_use_exits_69_with_one_line(tmp_path: Path) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as taken:
        taken.bind((LOOPBACK, 0))
        command = [*RUN, "--connect", f"udpin:{LOOPBACK}:{taken.getsockname()[1]}", "--logs", str(tmp_path)]
        done = subprocess.run(command, capture_output=True, text=True, timeout=120, env=ENVIRONMENT)
    assert done.returncode == os.EX_UNAVAILABLE
    assert sum(line.startswith("companion: cannot listen") for line in done.stderr.splitlines()) == 1
    assert "Traceback" not in done.stderr and "listening:" not in done.stderr
    assert not list(tmp_path.iterdir())  # a failed start leaves no empty log


def test_starts_that_fail_for_another_reason_keep_the_parameters(
    companion: Companion, tmp_path: Path
) -> None:
    """An address in use, a log folder that cannot be used, no signing key, an invalid link: twice each."""
    values = tmp_path / "set.toml"
    values.write_text("[gnss]\nsigma_m = 7.0\n")
    (tmp_path / "no_folder").write_text("")
    keep = ("--set", f"link.parameters_file={values}")
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as taken:
        taken.bind((LOOPBACK, 0))
        in_use = ("--connect", f"udpin:{LOOPBACK}:{taken.getsockname()[1]}", "--logs", str(tmp_path / "logs"))
        for code, arguments in (
            (os.EX_UNAVAILABLE, in_use),
            (os.EX_CANTCREAT, ("--logs", str(tmp_path / "no_folder"))),
            (78, ("--set", f"signing.key_file={tmp_path / 'none'}", "--logs", str(tmp_path / "logs"))),
            (78, ("--connect", "udp:1.2.3.4")),
        ):
            for _ in range(2):
                done = companion("run", *keep, *arguments)
                assert done.returncode == code and "failed" not in done.stderr
    assert values.exists()


def test_the_flight_is_kept_for_the_next_run_until_this_one_ends(tmp_path: Path, monkeypatch) -> None:
    """And a folder that cannot be written is reported once."""
    monkeypatch.setattr(service, "KEEP_S", 0.01)
    monkeypatch.setattr(service, "KEEP_AFTER_S", 0.05)
    monkeypatch.delenv("RUNTIME_DIRECTORY", raising=False)
    folder = tmp_path / "kept"
    kept, flown, events = KeptRun(folder), Flown(1, 0, "", b"state"), list[Event]()

    async def fly() -> None:
        with log_in(tmp_path) as log:
            stopped = asyncio.Event()
            config = load(None, {"link.connect": (f"udpin:{LOOPBACK}:{free_port()}",)}, {})
            flying = Service(config, log, events.append, kept_run=kept)
            monkeypatch.setattr(flying.core, "flown", lambda now_ns: flown)
            serving = asyncio.create_task(flying.serve(stopped))
            await until(lambda: any("restart in flight" in event.text for event in events))
            folder.mkdir()
            await until(kept.path.exists)
            stopped.set()
            await serving

    asyncio.run(fly())
    assert kept.path.exists()  # as after a kill: to end it is up to `run`
    assert len([event for event in events if str(kept.path) in event.text]) == 1


def test_a_start_that_cannot_listen_leaves_the_flight_to_the_next(tmp_path: Path, monkeypatch) -> None:
    monkeypatch.delenv("RUNTIME_DIRECTORY", raising=False)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as taken:
        taken.bind((LOOPBACK, 0))
        links = (f"udpin:{LOOPBACK}:{taken.getsockname()[1]}",)
        config = load(None, {"link.connect": links, "log.folder": str(tmp_path)}, {})
        flown = Flown(1, 0, to_toml(config), b"state")
        KeptRun(tmp_path).keep(flown)
        with pytest.raises(CannotListen):
            asyncio.run(service.run(config, lambda event: None))
    assert KeptRun(tmp_path).take(config) == flown


def test_two_killed_starts_set_the_parameters_aside(tmp_path: Path) -> None:
    values = tmp_path / "set.toml"
    values.write_text("[gnss]\nsigma_m = 7.0\n")
    run = [*RUN, "--set", f"link.parameters_file={values}", "--logs", str(tmp_path / "logs")]
    run += ["--connect", f"udpin:{LOOPBACK}:{free_port()}"]
    for _ in range(2):
        with subprocess.Popen(run, stderr=subprocess.PIPE, env=ENVIRONMENT) as process:
            assert process.stderr is not None
            while b"listening" not in process.stderr.readline():
                assert process.poll() is None
            process.kill()
    with subprocess.Popen(run, stderr=subprocess.PIPE, env=ENVIRONMENT, text=True) as process:
        assert process.stderr is not None
        while "the last 2 starts with them failed" not in process.stderr.readline():
            assert process.poll() is None
        process.send_signal(signal.SIGTERM)
        assert process.wait(60) == 0
    assert values.with_name("set.toml.rejected").exists()


def test_missing_key_exits_78_and_leaves_no_log(companion: Companion, tmp_path: Path) -> None:
    done = companion("run", "--set", f"signing.key_file={tmp_path / 'none'}", "--logs", tmp_path)
    assert done.returncode == 78 and "signing.key_file" in done.stderr
    assert not list(tmp_path.iterdir())


def test_unwritable_log_folder_exits_73_with_one_line(companion: Companion, tmp_path: Path) -> None:
    folder = tmp_path / "logs"
    if os.geteuid() == 0:  # root may write to any folder, but not into a file
        folder.write_text("no folder")
    else:
        folder.mkdir(mode=0o555)
    done = companion("run", "--logs", folder)
    assert done.returncode == os.EX_CANTCREAT
    assert len(done.stderr.splitlines()) == 1 and str(folder) in done.stderr
    if folder.is_file():
        assert "it is a file; give a folder" in done.stderr


def test_invalid_link_exits_78_with_one_line(companion: Companion, tmp_path: Path) -> None:
    done = companion("run", "--connect", "udp:1.2.3.4", "--logs", tmp_path)
    assert done.returncode == 78
    assert len(done.stderr.splitlines()) == 1 and "link.connect" in done.stderr


def test_every_client_of_a_tcp_link_is_served_without_an_autopilot(tmp_path: Path) -> None:
    """Eight ground stations, whose requests arrive in interleaved halves, and one that only listens."""
    port = free_port()
    stations = [socket.socket() for _ in range(8)]
    kinds: list[set[str]] = [set() for _ in stations]

    async def play(service: Service, events: list[Event]) -> None:
        for sock in stations:
            await until(lambda sock=sock: sock.connect_ex((LOOPBACK, port)) == 0)
            sock.setblocking(False)
        (listener,) = service._connections.values()
        await until(lambda: len(listener._clients) == len(stations))
        request = dialect.new("PARAM_REQUEST_LIST", target_system=1, target_component=191)
        texts = [frame.encode(request, 0, 255 - k, 190) for k in range(len(stations) - 1)]
        for half in (slice(0, 9), slice(9, None)):
            for sock, text in zip(stations, texts, strict=False):
                sock.send(text[half])
            await asyncio.sleep(0.1)
        service.report("a text")
        readers = [frame.Reader() for _ in stations]

        def all_served() -> bool:
            for sock, reader, names in zip(stations, readers, kinds, strict=True):
                with contextlib.suppress(BlockingIOError):
                    found = reader.receive(sock.recv(65536))
                    names |= {dialect.TYPES[f.msgid].name for f in found if isinstance(f, frame.Frame)}
            return all({"HEARTBEAT", "PARAM_VALUE", "STATUSTEXT"} <= names for names in kinds)

        (link,) = service.core.links.values()
        await until(lambda: all_served() and link.received >= len(texts))
        assert link.received == len(texts) and link.bad == 0

    try:
        serve(tmp_path, (f"tcpin:{LOOPBACK}:{port}",), play)
    finally:
        for sock in stations:
            sock.close()


def test_stalled_tcp_peer_drops_the_oldest_frames_and_they_are_counted(tmp_path: Path) -> None:
    """A TCP peer sends and never reads: the newest frames are queued, the log counts the dropped ones."""
    port = free_port()

    async def play(service: Service, events: list[Event]) -> None:
        with socket.socket() as sock:
            sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 2048)
            await until(lambda: sock.connect_ex((LOOPBACK, port)) == 0)
            sock.setblocking(False)
            (link,) = service.core.links.values()

            def stuck() -> bool:
                with contextlib.suppress(BlockingIOError):
                    sock.send(HEARTBEAT)
                for _ in range(500):  # far more than any ground station receives
                    link.session.send(dialect.new("ATTITUDE"))
                service._flush()
                return link.dropped > 1000

            await until(stuck)
            # the link state is logged every second
            await until(lambda: max(dropped_by(tmp_path / "a.mcap.active"), default=0) > 1000)

    def dropped_by(log: Path) -> list[int]:
        return [e.value.dropped for e in flight_log.read(log) if isinstance(e.value, LinkState)]

    events = serve(tmp_path, (f"tcpin:{LOOPBACK}:{port}",), play)
    assert sum("the line is too slow" in event.text for event in events) == 1
    states = dropped_by(tmp_path / "a.mcap")
    assert states == sorted(states) and states[-1] > 1000


def test_births_that_stay_due_take_two_turns_and_no_more(tmp_path: Path) -> None:
    """Where they fail, and before the first record after a restart, they stay due: it span at full load."""
    turns = 0

    class Unable:
        births_due = True

        def bear(self) -> None:
            nonlocal turns
            turns += 1

        def settle(self) -> None: ...

    async def flush(service: Service) -> None:
        service._flush()
        await asyncio.sleep(0.05)

    with log_in(tmp_path) as log:
        service = Service(load(None, {"link.connect": ("udpin:14550",)}, {}), log, print)
        service.core._navigator = Unable()  # type: ignore[assignment]
        asyncio.run(flush(service))
    assert turns == 2
