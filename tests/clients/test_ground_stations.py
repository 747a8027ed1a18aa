"""Real ground stations: on the second link of a companion in flight, and beside an autopilot on one link.

They find the component, read and set its parameters, and show its texts and values. MAVProxy and MAVSDK are
skipped where they are not installed.
"""

import contextlib
import functools
import hashlib
import itertools
import json
import os
import pathlib
import shutil
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from typing import Any

import pytest
from pymavlink import mavutil

from companion.config import Config
from companion.link import dialect, frame
from companion.link.commands import Result
from companion.link.parameter_server import ParameterServer, parameter_table
from companion.link.session import MessageReceived, Session
from companion.link.signing import SignatureFault, Signing
from tests.network import free_port

LOOPBACK = "127.0.0.1"
SYSTEM, COMPONENT, ARDUPILOT, PX4 = 1, 191, 3, 12
PARAMETERS = {parameter.name for parameter in parameter_table()}
NAMED_VALUES = {"nav_source", "nav_sigma", "nav_bound", "nav_hpl", "nav_trust"}
FIXED, SET = "navigation fixed", "GNSS_SIGMA_M set from"  # beginnings of texts
PASSPHRASE = "chickpea"  # a station derives the key from it by SHA-256


@pytest.fixture(scope="module")
def second_link(tmp_path_factory: pytest.TempPathFactory) -> Iterator[int]:
    """The service and a simulated autopilot in flight; yield the TCP port of the service's second link."""
    folder = tmp_path_factory.mktemp("flight")
    first, second = free_port(), free_port()
    links = [f"--connect=udpin:{LOOPBACK}:{first}", f"--connect=tcpin:{LOOPBACK}:{second}"]
    commands = {
        "run": [*links, "--set=inertial.independent=true", f"--logs={folder / 'logs'}"],
        "sitl": [f"--connect=udpout:{LOOPBACK}:{first}", "--scenario=short"],
    }
    with contextlib.ExitStack() as stack:
        processes = {}
        for name, options in commands.items():
            lines = stack.enter_context((folder / name).open("w"))
            command = [sys.executable, "-m", "companion", name, *options]
            processes[name] = stack.enter_context(subprocess.Popen(command, stderr=lines))
            stack.callback(processes[name].kill)
        assert until(lambda: FIXED in (folder / "run").read_text()), (folder / "run").read_text()
        yield second
        for process in processes.values():
            process.send_signal(signal.SIGINT)
        ended = {name: process.wait(60) for name, process in processes.items()}
    assert ended == {"run": 0, "sitl": 0}, (folder / "run").read_text()


class Vehicle(threading.Thread):
    """An autopilot's heartbeat and our session with its parameters on one UDP port, until stopped."""

    def __init__(self, autopilot: int, signing: Signing | None = None) -> None:
        super().__init__(daemon=True)
        self.session = Session(autopilot_system=SYSTEM, component=COMPONENT, signing=signing)
        self.parameters = ParameterServer(COMPONENT, Config())
        self.received: list[str] = []
        self._autopilot = autopilot
        self._signing = signing
        self._ended = threading.Event()
        self.port = free_port()

    def run(self) -> None:
        heartbeat_at = 0
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as link:
            link.settimeout(0.005)
            link.connect((LOOPBACK, self.port))  # the port of the station
            while not self._ended.is_set():
                now = time.monotonic_ns()
                with contextlib.suppress(TimeoutError, ConnectionRefusedError):
                    self._process(self.session.receive(link.recv(65536), now), now)
                self.session.poll(now)
                for message in self.parameters.to_send(now):
                    self.session.send(message)
                out = self.session.to_send()
                if now >= heartbeat_at:
                    heartbeat_at = now + 1_000_000_000
                    beat = dialect.new("HEARTBEAT", type=1, autopilot=self._autopilot, mavlink_version=3)
                    sign = self._sign if self._signing else None
                    out.append(frame.encode(beat, 0, SYSTEM, 1, sign))
                for data in out:
                    with contextlib.suppress(ConnectionRefusedError):
                        link.send(data)

    def stop(self) -> None:
        self._ended.set()
        self.join()

    def _sign(self, data: bytes) -> bytes:
        assert self._signing is not None
        return self._signing.sign(data, 0, time.monotonic_ns())

    def _process(self, events: list[object], now: int) -> None:
        for event in events:
            if not isinstance(event, MessageReceived):
                continue
            self.received.append(event.message.get_type())
            self.parameters.receive(event.message, event.frame, SYSTEM, now)


@pytest.fixture
def vehicle(request: pytest.FixtureRequest) -> Iterator[Vehicle]:
    there = Vehicle(*request.param)
    there.start()
    yield there
    there.stop()


def until(true: Callable[[], bool], seconds: float = 60.0) -> bool:
    ends = time.monotonic() + seconds
    while not true() and time.monotonic() < ends:
        time.sleep(0.05)
    return true()


def while_set(done: Callable[[], bool], set_sigma: Callable[[float], object]) -> Callable[[], bool]:
    """Return `done`, which sets GNSS_SIGMA_M to 6 and 7 m in turn, every five seconds, until it is true.

    The text about it may have given way to a more severe one: texts are few.
    """
    values, due = itertools.cycle((6.0, 7.0)), [time.monotonic() + 5.0]

    def is_done() -> bool:
        if done():
            return True
        if time.monotonic() >= due[0]:
            set_sigma(next(values))
            due[0] = time.monotonic() + 5.0
        return False

    return is_done


class Received:
    """HEARTBEAT, STATUSTEXT and NAMED_VALUE_FLOAT of our component, as a client gives them."""

    def __init__(self) -> None:
        self.heartbeats = 0
        self.texts: list[str] = []
        self.values: dict[str, float | None] = {}

    def add(self, kind: str, component: int, fields: dict[str, Any]) -> None:
        assert component == COMPONENT
        if kind == "HEARTBEAT":
            self.heartbeats += 1
        elif kind == "STATUSTEXT":
            self.texts.append(fields["text"])
        elif kind == "NAMED_VALUE_FLOAT":
            self.values[fields["name"]] = fields["value"]

    def is_complete(self) -> bool:
        texts = any(text.startswith(SET) for text in self.texts)
        return self.heartbeats > 1 and texts and set(self.values) == NAMED_VALUES


def test_pymavlink(second_link: int) -> None:
    received, parameters = Received(), dict[str, float]()
    with contextlib.closing(mavutil.mavlink_connection(f"tcp:{LOOPBACK}:{second_link}")) as station:

        def receives(true: Callable[[], bool]) -> bool:
            def step() -> bool:
                kinds = ["HEARTBEAT", "STATUSTEXT", "NAMED_VALUE_FLOAT", "PARAM_VALUE"]
                while message := station.recv_match(type=kinds):
                    if message.get_type() == "PARAM_VALUE":
                        parameters[message.param_id] = message.param_value
                    received.add(message.get_type(), message.get_srcComponent(), message.to_dict())
                return true()

            return until(step)

        assert receives(lambda: received.heartbeats > 0)
        station.mav.param_request_list_send(SYSTEM, COMPONENT)
        assert receives(lambda: set(parameters) == PARAMETERS)
        assert parameters["RSBN_RANGE_M"] == Config().rsbn.sigma_range_m

        def set_sigma(value: float) -> None:
            station.mav.param_set_send(
                SYSTEM, COMPONENT, b"GNSS_SIGMA_M", value, mavutil.mavlink.MAV_PARAM_TYPE_REAL32
            )

        set_sigma(3.0)
        assert receives(lambda: parameters["GNSS_SIGMA_M"] == 3.0)
        assert receives(while_set(received.is_complete, set_sigma))


def test_mavproxy(second_link: int, tmp_path: pathlib.Path) -> None:
    with Proxy(f"tcp:{LOOPBACK}:{second_link}", tmp_path) as proxy:
        assert proxy.prints(f"Detected vehicle {SYSTEM}:{COMPONENT}")
        proxy.type("param fetch")
        assert proxy.prints(f"Received {len(PARAMETERS)} parameters")
        proxy.type("param show RSBN_RANGE_M")
        assert proxy.prints(f"RSBN_RANGE_M     {Config().rsbn.sigma_range_m:.1f}")
        proxy.type("watch NAMED_VALUE_FLOAT")
        assert all(proxy.prints(f"name : {name}, value : ") for name in NAMED_VALUES)
        proxy.type("param set GNSS_SIGMA_M 4")
        changed = while_set(
            lambda: proxy.has_printed(f"AP: {SET}"),  # our STATUSTEXT
            lambda value: proxy.type(f"param set GNSS_SIGMA_M {value:g}"),
        )
        assert until(changed)
        proxy.type("param set GNSS_SIGMA_M 4")
        proxy.type("param fetch GNSS_SIGMA_M")
        assert proxy.prints("GNSS_SIGMA_M = 4.0")
        proxy.type("long 400 1 0 0 0 0 0 0")
        assert proxy.prints("COMPONENT_ARM_DISARM: UNSUPPORTED")


@pytest.fixture
def sdk(tmp_path: pathlib.Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Any]:
    """MAVSDK as a ground station; skipped without it."""
    monkeypatch.setenv("HOME", str(tmp_path))  # it keeps files by their checksum
    mavsdk = pytest.importorskip("mavsdk.mavsdk")
    component = pytest.importorskip("mavsdk.component_type").ComponentType.GROUND_STATION
    made = mavsdk.Mavsdk(mavsdk.Configuration.create_with_component_type(component))
    yield made
    made.destroy()


def check_mavsdk_parameters(system: Any, value: float) -> Any:
    """List and read the parameters and set GNSS_SIGMA_M to `value` (m); return MAVSDK's parameters."""
    param = pytest.importorskip("mavsdk.plugins.param.param")
    assert until(lambda: COMPONENT in system.component_ids())
    parameters = param.Param(system)
    with contextlib.suppress(param.ParamError):  # 4.1 selects it, but raises UNKNOWN
        parameters.select_component(COMPONENT, param.ProtocolVersion.V1)
    assert {p.name for p in parameters.get_all_params().float_params} == PARAMETERS
    assert parameters.get_param_float("RSBN_RANGE_M") == Config().rsbn.sigma_range_m
    parameters.set_param_float("GNSS_SIGMA_M", value)
    assert parameters.get_param_float("GNSS_SIGMA_M") == value
    with pytest.raises(param.ParamError, match="VALUE_OUT_OF_RANGE"):
        parameters.set_param_float("GNSS_SIGMA_M", -1.0)
    assert parameters.get_param_float("GNSS_SIGMA_M") == value
    return parameters


def test_mavsdk(second_link: int, sdk: Any) -> None:
    direct = pytest.importorskip("mavsdk.plugins.mavlink_direct.mavlink_direct")
    metadata = pytest.importorskip("mavsdk.plugins.component_metadata.component_metadata")
    sdk.add_any_connection(f"tcpout://{LOOPBACK}:{second_link}")
    assert until(sdk.get_systems)
    (system,) = sdk.get_systems()

    station, received, results = direct.MavlinkDirect(system), Received(), dict[int, int]()

    def receive(message: Any, *_: object) -> None:
        fields = json.loads(message.fields_json)
        received.add(message.message_name, message.component_id, fields)
        if message.message_name == "COMMAND_ACK":
            results[fields["command"]] = fields["result"]

    for kind in ("HEARTBEAT", "STATUSTEXT", "NAMED_VALUE_FLOAT", "COMMAND_ACK"):
        station.subscribe_message(kind, receive)
    parameters = check_mavsdk_parameters(system, 5.0)
    set_sigma = functools.partial(parameters.set_param_float, "GNSS_SIGMA_M")
    assert until(while_set(received.is_complete, set_sigma))
    for command in (512, 400):
        fields = {"target_system": SYSTEM, "target_component": COMPONENT, "command": command}
        fields |= {f"param{i}": 148 if i == 1 else 0 for i in range(1, 8)} | {"confirmation": 0}
        station.send_message(direct.MavlinkMessage("COMMAND_LONG", 0, 0, 0, 0, json.dumps(fields)))
    expected = {512: Result.ACCEPTED, 400: Result.UNSUPPORTED}
    assert until(lambda: expected.items() <= results.items())

    reader, available = metadata.ComponentMetadata(system), list[object]()
    reader.subscribe_metadata_available(lambda update, *_: available.append(update))
    reader.request_component(COMPONENT)
    assert until(lambda: bool(available))
    found = reader.get_metadata(COMPONENT, metadata.MetadataType.PARAMETER)
    described = {entry["name"]: entry for entry in json.loads(found.json_metadata)["parameters"]}
    assert set(described) == PARAMETERS
    sigma = described["GNSS_SIGMA_M"]
    assert (sigma["units"], sigma["min"], sigma["default"]) == ("m", 0.01, Config().gnss.sigma_m)


@pytest.mark.parametrize("vehicle", [(ARDUPILOT,), (PX4,)], indirect=True)
def test_mavsdk_beside_an_autopilot(vehicle: Vehicle, sdk: Any) -> None:
    sdk.add_any_connection(f"udpin://{LOOPBACK}:{vehicle.port}")
    system = sdk.first_autopilot(60.0)
    assert system is not None
    check_mavsdk_parameters(system, 4.0)


SIGNING = Signing(hashlib.sha256(PASSPHRASE.encode()).digest())
SIGNING.set_time(time.time_ns(), time.monotonic_ns())


@pytest.mark.parametrize("vehicle", [(ARDUPILOT, SIGNING), (PX4, SIGNING)], indirect=True)
def test_mavproxy_signed_beside_an_autopilot(vehicle: Vehicle, tmp_path: pathlib.Path) -> None:
    rejected = vehicle.session.rejected
    with Proxy(f"udp:{LOOPBACK}:{vehicle.port}", tmp_path) as proxy:
        assert until(lambda: rejected[SignatureFault.UNSIGNED] > 0)
        proxy.type("signing key wrong")
        assert until(lambda: rejected[SignatureFault.FORGED] > 0)
        assert vehicle.received == []
        proxy.type(f"signing key {PASSPHRASE}")
        assert until(lambda: "HEARTBEAT" in vehicle.received)
        proxy.type("param fetch")
        assert proxy.prints(f"Received {len(parameter_table())} parameters")
        proxy.type("param set GNSS_SIGMA_M 4")
        assert until(lambda: vehicle.parameters.config.gnss.sigma_m == 4.0)
    assert not {SignatureFault.REPLAYED, SignatureFault.OLD, SignatureFault.FUTURE} & set(rejected)


class Proxy:
    """MAVProxy controlled through a pipe; skipped without it."""

    def __init__(self, link: str, folder: pathlib.Path) -> None:
        program = shutil.which("mavproxy.py")
        if program is None:
            pytest.skip("mavproxy.py is not on the path")
        self._process = subprocess.Popen(
            [
                program,
                f"--master={link}",
                f"--target-system={SYSTEM}",
                f"--target-component={COMPONENT}",
                f"--state-basedir={folder}",
                "--mav20",
                "--streamrate=-1",
                "--default-modules=param,cmdlong,signing",
            ],
            cwd=folder,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            env=os.environ | {"HOME": str(folder), "PYTHONUNBUFFERED": "1"},
        )
        self._output = ""
        self._reader = threading.Thread(target=self._read, daemon=True)

    def __enter__(self) -> "Proxy":
        self._reader.start()
        return self

    def __exit__(self, *error: object) -> None:
        self._process.kill()
        self._process.wait()
        self._reader.join()
        assert self._process.stdin is not None and self._process.stdout is not None
        self._process.stdin.close()
        self._process.stdout.close()
        if error[0] is not None:
            print(self._output)

    def type(self, line: str) -> None:
        assert self._process.stdin is not None
        self._process.stdin.write(line + "\n")
        self._process.stdin.flush()

    def has_printed(self, text: str) -> bool:
        return text in self._output

    def prints(self, text: str) -> bool:
        return until(lambda: self.has_printed(text))

    def _read(self) -> None:
        assert self._process.stdout is not None
        while received := self._process.stdout.read(1):
            self._output += received
