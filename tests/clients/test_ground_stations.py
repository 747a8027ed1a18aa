"""Real ground stations over loopback UDP, with a vehicle of an autopilot's heartbeat and our component.

They find the component, read and set its parameters and get their commands acknowledged, with either
autopilot, with and without signatures. Each needs its package (extra `clients`) and is skipped without it.
"""

import contextlib
import hashlib
import json
import os
import pathlib
import shutil
import socket
import subprocess
import threading
import time
from collections.abc import Callable, Iterator

import pytest

from companion.config import Config
from companion.link import dialect, frame
from companion.link.commands import CommandServer, Result
from companion.link.component_metadata import FileServer, component_metadata
from companion.link.parameter_server import ParameterServer, parameter_table
from companion.link.session import MessageReceived, Session
from companion.link.signing import SignatureFault, Signing
from companion.link.status_text import StatusText
from companion.records import Event

SYSTEM, COMPONENT, ARDUPILOT, PX4 = 1, 191, 3, 12
PASSPHRASE = "chickpea"  # a station derives the key from it by SHA-256


class Vehicle(threading.Thread):
    """A vehicle with the companion on one UDP port, until stopped."""

    def __init__(self, autopilot: int, signing: Signing | None = None) -> None:
        super().__init__(daemon=True)
        self.session = Session(system=SYSTEM, component=COMPONENT, signing=signing)
        self.commands = CommandServer(COMPONENT, {331: 200_000}, {397: component_metadata})
        self.files = FileServer(COMPONENT)
        self.parameters = ParameterServer(COMPONENT, Config())
        self.status_text = StatusText()
        self.received: list[str] = []
        self.acknowledged: list[int] = []
        self._autopilot = autopilot
        self._signing = signing
        self._ended = threading.Event()
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as free:
            free.bind(("127.0.0.1", 0))
            self.port: int = free.getsockname()[1]

    def run(self) -> None:
        heartbeat_at = 0
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as link:
            link.settimeout(0.005)
            link.connect(("127.0.0.1", self.port))  # the port of the station
            while not self._ended.is_set():
                now = time.monotonic_ns()
                with contextlib.suppress(TimeoutError, ConnectionRefusedError):
                    self._process(self.session.receive(link.recv(65536), now), now)
                self.session.poll(now)
                for message in [*self.parameters.to_send(now), *self.status_text.to_send(now)]:
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
            for reply in self.commands.receive(event.message, event.frame, SYSTEM, now, {}):
                self.session.send(reply)
                if reply.get_type() == "COMMAND_ACK":
                    self.acknowledged.append(reply.command)
            for reply in self.files.receive(event.message, event.frame, SYSTEM, now):
                self.session.send(reply)
            for change in self.parameters.receive(event.message, event.frame, SYSTEM, now):
                text = f"{change.parameter.name} is {change.new}"
                self.status_text.add(Event(now, now, 5, text), now)


@pytest.fixture
def vehicle(request: pytest.FixtureRequest) -> Iterator[Vehicle]:
    there = Vehicle(*request.param) if isinstance(request.param, tuple) else Vehicle(request.param)
    there.start()
    yield there
    there.stop()


def until(true: Callable[[], bool], seconds: float = 60.0) -> bool:
    ends = time.monotonic() + seconds
    while not true() and time.monotonic() < ends:
        time.sleep(0.05)
    return true()


@pytest.mark.parametrize("vehicle", [ARDUPILOT, PX4], indirect=True)
def test_mavsdk(vehicle: Vehicle) -> None:
    mavsdk = pytest.importorskip("mavsdk.mavsdk")
    component = pytest.importorskip("mavsdk.component_type").ComponentType.GROUND_STATION
    param = pytest.importorskip("mavsdk.plugins.param.param")
    direct = pytest.importorskip("mavsdk.plugins.mavlink_direct.mavlink_direct")
    sdk = mavsdk.Mavsdk(mavsdk.Configuration.create_with_component_type(component))
    try:
        sdk.add_any_connection(f"udpin://127.0.0.1:{vehicle.port}")
        system = sdk.first_autopilot(20.0)
        assert system is not None
        assert until(lambda: COMPONENT in system.component_ids())

        parameters = param.Param(system)
        with contextlib.suppress(param.ParamError):  # 4.1 selects it, but raises UNKNOWN
            parameters.select_component(COMPONENT, param.ProtocolVersion.V1)
        listed = {p.name: p.value for p in parameters.get_all_params().float_params}
        assert set(listed) == {p.name for p in parameter_table()}
        assert parameters.get_param_float("GNSS_SIGMA_M") == Config().gnss.sigma_m
        parameters.set_param_float("GNSS_SIGMA_M", 4.0)
        assert parameters.get_param_float("GNSS_SIGMA_M") == 4.0
        assert until(lambda: vehicle.parameters.config.gnss.sigma_m == 4.0)
        with pytest.raises(param.ParamError, match="VALUE_OUT_OF_RANGE"):
            parameters.set_param_float("GNSS_SIGMA_M", -1.0)
        assert vehicle.parameters.config.gnss.sigma_m == 4.0

        received: list[dict[str, object]] = []
        station = direct.MavlinkDirect(system)
        station.subscribe_message("COMMAND_ACK", lambda m, *_: received.append(json.loads(m.fields_json)))
        for command in (512, 400):
            fields = {"target_system": SYSTEM, "target_component": COMPONENT, "command": command}
            fields |= {f"param{i}": 148 if i == 1 else 0 for i in range(1, 8)} | {"confirmation": 0}
            station.send_message(direct.MavlinkMessage("COMMAND_LONG", 0, 0, 0, 0, json.dumps(fields)))
        results = {512: Result.ACCEPTED, 400: Result.UNSUPPORTED}
        assert until(lambda: results.items() <= {m["command"]: m["result"] for m in received}.items())
    finally:
        sdk.destroy()


@pytest.mark.parametrize("vehicle", [ARDUPILOT], indirect=True)
def test_mavsdk_reads_what_the_parameters_mean(
    vehicle: Vehicle, tmp_path: pathlib.Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("HOME", str(tmp_path))  # MAVSDK keeps files by their checksum
    mavsdk = pytest.importorskip("mavsdk.mavsdk")
    component = pytest.importorskip("mavsdk.component_type").ComponentType.GROUND_STATION
    metadata = pytest.importorskip("mavsdk.plugins.component_metadata.component_metadata")
    sdk = mavsdk.Mavsdk(mavsdk.Configuration.create_with_component_type(component))
    try:
        sdk.add_any_connection(f"udpin://127.0.0.1:{vehicle.port}")
        system = sdk.first_autopilot(20.0)
        assert system is not None
        assert until(lambda: COMPONENT in system.component_ids())
        reader = metadata.ComponentMetadata(system)
        received: list[object] = []
        reader.subscribe_metadata_available(lambda update, *_: received.append(update))
        reader.request_component(COMPONENT)
        assert until(lambda: bool(received))
        found = reader.get_metadata(COMPONENT, metadata.MetadataType.PARAMETER)
        described = {entry["name"]: entry for entry in json.loads(found.json_metadata)["parameters"]}
        assert set(described) == {parameter.name for parameter in parameter_table()}
        sigma = described["GNSS_SIGMA_M"]
        assert (sigma["units"], sigma["min"], sigma["default"]) == ("m", 0.01, Config().gnss.sigma_m)
    finally:
        sdk.destroy()


@pytest.mark.parametrize("vehicle", [ARDUPILOT, PX4], indirect=True)
def test_mavproxy(vehicle: Vehicle, tmp_path: pathlib.Path) -> None:
    program = shutil.which("mavproxy.py")
    if program is None:
        pytest.skip("mavproxy.py is not on the path")
    with Proxy(program, vehicle, tmp_path) as proxy:
        assert until(lambda: "HEARTBEAT" in vehicle.received)
        proxy.type("param fetch")
        assert proxy.prints(f"Received {len(parameter_table())} parameters")
        proxy.type("param show GNSS_SIGMA_M")
        assert proxy.prints(f"GNSS_SIGMA_M     {Config().gnss.sigma_m:.1f}")
        proxy.type("param set GNSS_SIGMA_M 4")
        assert until(lambda: vehicle.parameters.config.gnss.sigma_m == 4.0)
        assert proxy.prints("GNSS_SIGMA_M is 4.0")  # our STATUSTEXT
        proxy.type("param set SWITCH_SOURCES 0")
        assert until(lambda: not vehicle.parameters.config.output.switch_sources)
        proxy.type("long 512 148 0 0 0 0 0 0")
        assert until(lambda: 512 in vehicle.acknowledged)
        proxy.type("long 400 1 0 0 0 0 0 0")
        assert proxy.prints("COMPONENT_ARM_DISARM: UNSUPPORTED")


SIGNING = Signing(hashlib.sha256(PASSPHRASE.encode()).digest())
SIGNING.set_time(time.time_ns(), time.monotonic_ns())


@pytest.mark.parametrize("vehicle", [(ARDUPILOT, SIGNING)], indirect=True)
def test_mavproxy_signed(vehicle: Vehicle, tmp_path: pathlib.Path) -> None:
    program = shutil.which("mavproxy.py")
    if program is None:
        pytest.skip("mavproxy.py is not on the path")
    rejected = vehicle.session.rejected
    with Proxy(program, vehicle, tmp_path) as proxy:
        assert until(lambda: rejected[SignatureFault.UNSIGNED] > 0)
        proxy.type("signing key wrong")
        assert until(lambda: rejected[SignatureFault.FORGED] > 0)
        assert vehicle.received == []
        proxy.type(f"signing key {PASSPHRASE}")
        assert until(lambda: "HEARTBEAT" in vehicle.received)
        proxy.type("param fetch")
        assert proxy.prints(f"Received {len(parameter_table())} parameters")
        proxy.type("param set GNSS_SIGMA_M 4")
        assert proxy.prints("GNSS_SIGMA_M is 4.0")
    assert vehicle.parameters.config.gnss.sigma_m == 4.0
    assert not {SignatureFault.REPLAYED, SignatureFault.OLD, SignatureFault.FUTURE} & set(rejected)


class Proxy:
    """MAVProxy controlled through a pipe."""

    def __init__(self, program: str, vehicle: Vehicle, folder: pathlib.Path) -> None:
        self._process = subprocess.Popen(
            [
                program,
                f"--master=udp:127.0.0.1:{vehicle.port}",
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

    def prints(self, text: str) -> bool:
        return until(lambda: text in self._output)

    def _read(self) -> None:
        assert self._process.stdout is not None
        while received := self._process.stdout.read(1):
            self._output += received
