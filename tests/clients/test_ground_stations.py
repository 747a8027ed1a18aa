"""Real ground stations over loopback UDP, on a vehicle of an ArduPilot heartbeat and our component: they see the
component, read and set its parameters and get their commands acknowledged, with and without signatures.

Each needs its package (the extra `clients`) and is skipped without it.
"""

import contextlib
import json
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
from companion.link.commands import Commands, Result
from companion.link.parameters import Parameters, table
from companion.link.session import MessageReceived, Session
from companion.link.signing import Signing
from companion.link.status_text import StatusText
from companion.records import Event

SYSTEM, COMPONENT, ARDUPILOT, PX4 = 1, 191, 3, 12
PASSPHRASE = "chickpea"  # a station makes the key from it by SHA-256


class Vehicle(threading.Thread):
    """What a vehicle with the companion says and answers on one UDP port, until stopped."""

    def __init__(self, autopilot: int, signing: Signing | None = None) -> None:
        super().__init__(daemon=True)
        self.session = Session(system=SYSTEM, component=COMPONENT, signing=signing)
        self.commands = Commands(COMPONENT, {331: 200_000}, {})
        self.parameters = Parameters(COMPONENT, Config())
        self.speaker = StatusText()
        self.heard: list[str] = []
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
            link.connect(("127.0.0.1", self.port))  # where the station listens
            while not self._ended.is_set():
                now = time.monotonic_ns()
                out: list[bytes] = []
                try:
                    self._hear(self.session.receive(link.recv(65536), now), now)
                except (TimeoutError, ConnectionRefusedError):
                    pass
                self.session.poll(now)
                for message in [*self.parameters.to_send(now), *self.speaker.to_send(now)]:
                    self.session.send(message)
                out = self.session.to_send()
                if now >= heartbeat_at:
                    heartbeat_at = now + 1_000_000_000
                    beat = dialect.new("HEARTBEAT", type=1, autopilot=self._autopilot, mavlink_version=3)
                    sign = self._sign if self._signing else None
                    out.append(frame.encode(beat, 0, SYSTEM, 1, sign))
                for data in out:
                    try:
                        link.send(data)
                    except ConnectionRefusedError:
                        pass

    def stop(self) -> None:
        self._ended.set()
        self.join()

    def _sign(self, data: bytes) -> bytes:
        assert self._signing is not None
        return self._signing.sign(data, 0, time.monotonic_ns())

    def _hear(self, events: list[object], now: int) -> None:
        for event in events:
            if not isinstance(event, MessageReceived):
                continue
            self.heard.append(event.message.get_type())
            for reply in self.commands.receive(event.message, event.frame, SYSTEM, now):
                self.session.send(reply)
                if reply.get_type() == "COMMAND_ACK":
                    self.acknowledged.append(reply.command)
            for change in self.parameters.receive(event.message, event.frame, SYSTEM, now):
                text = f"{change.parameter.name} is {change.new}"
                self.speaker.tell(Event(now, now, 5, text), now)


@pytest.fixture
def vehicle(request: pytest.FixtureRequest) -> Iterator[Vehicle]:
    there = Vehicle(*request.param) if isinstance(request.param, tuple) else Vehicle(request.param)
    there.start()
    yield there
    there.stop()


def until(true: Callable[[], bool], seconds: float = 20.0) -> bool:
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
        with contextlib.suppress(param.ParamError):  # 4.1 selects it, and says UNKNOWN
            parameters.select_component(COMPONENT, param.ProtocolVersion.V1)
        listed = {p.name: p.value for p in parameters.get_all_params().float_params}
        assert set(listed) == {p.name for p in table()}
        assert parameters.get_param_float("GNSS_SIGMA_M") == 2.5
        parameters.set_param_float("GNSS_SIGMA_M", 4.0)
        assert parameters.get_param_float("GNSS_SIGMA_M") == 4.0
        assert until(lambda: vehicle.parameters.config.gnss.sigma_m == 4.0)
        with pytest.raises(param.ParamError, match="VALUE_OUT_OF_RANGE"):
            parameters.set_param_float("GNSS_SIGMA_M", -1.0)
        assert vehicle.parameters.config.gnss.sigma_m == 4.0

        said: list[dict[str, object]] = []
        station = direct.MavlinkDirect(system)
        station.subscribe_message("COMMAND_ACK", lambda m, *_: said.append(json.loads(m.fields_json)))
        for command in (512, 400):
            fields = {"target_system": SYSTEM, "target_component": COMPONENT, "command": command}
            fields |= {f"param{i}": 148 if i == 1 else 0 for i in range(1, 8)} | {"confirmation": 0}
            station.send_message(direct.MavlinkMessage("COMMAND_LONG", 0, 0, 0, 0, json.dumps(fields)))
        results = {512: Result.ACCEPTED, 400: Result.UNSUPPORTED}
        assert until(lambda: results.items() <= {m["command"]: m["result"] for m in said}.items())
    finally:
        sdk.destroy()
