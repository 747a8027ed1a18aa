"""Parameter client against a foreign server: MAVSDK as an autopilot, over UDP.

It needs its package and is skipped without it.
"""

import contextlib
import socket
import time
from collections.abc import Callable, Iterator

import pytest

from companion.link import dialect
from companion.link.parameter_client import Answer, ParameterClient, encoding_of, equal_real32
from companion.link.session import MessageReceived, Session
from tests.network import free_port

AUTOPILOT_VERSION, REQUEST_MESSAGE = 148, 512
HAS = {"EKF2_AGP0_ID": 0, "EKF2_EV_CTRL": -2, "CAL_BARO0_ID": 6620172, "EKF2_AGP0_NOISE": 0.9}


@pytest.fixture
def server() -> Iterator[int]:
    """Run MAVSDK as an autopilot with the parameters `HAS`; yield the port it sends to."""
    mavsdk = pytest.importorskip("mavsdk.mavsdk")
    component = pytest.importorskip("mavsdk.component_type").ComponentType.AUTOPILOT
    parameters = pytest.importorskip("mavsdk.plugins.param_server.param_server")
    port = free_port()
    sdk = mavsdk.Mavsdk(mavsdk.Configuration.create_with_component_type(component))
    try:
        mine = parameters.ParamServer(sdk.server_component())
        for name, value in HAS.items():
            (mine.provide_param_float if isinstance(value, float) else mine.provide_param_int)(name, value)
        sdk.add_any_connection(f"udpout://127.0.0.1:{port}")
        yield port
    finally:
        sdk.destroy()


class Station:
    """A session and, once the server is received, a client on one socket."""

    def __init__(self, port: int) -> None:
        self.link = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.link.bind(("127.0.0.1", port))
        self.link.settimeout(0.02)
        self.session = Session(autopilot_system=1, component=191)
        self.client: ParameterClient | None = None
        self.capabilities: int | None = None
        self.make: int | None = None
        self.answers: dict[str, Answer] = {}

    def step(self) -> None:
        peer = None
        with contextlib.suppress(TimeoutError):
            data, peer = self.link.recvfrom(65536)
            for event in self.session.receive(data, time.monotonic_ns()):
                if isinstance(event, MessageReceived):
                    self.receive(event)
        self.session.poll(time.monotonic_ns())
        if self.client is not None:
            self.answers |= {a.name: a for a in self.client.poll(time.monotonic_ns())}
            for message in self.client.to_send():
                self.session.send(message)
        if peer:
            for out in self.session.to_send():
                self.link.sendto(out, peer)

    def receive(self, event: MessageReceived) -> None:
        if event.message.get_type() == "HEARTBEAT" and event.frame.component == 1:
            if self.make is None:
                self.session.send(
                    dialect.new(
                        "COMMAND_LONG",
                        target_system=event.frame.system,
                        target_component=1,
                        command=REQUEST_MESSAGE,
                        param1=AUTOPILOT_VERSION,
                    )
                )
            self.make = event.message.autopilot
        elif event.frame.msgid == AUTOPILOT_VERSION:
            self.capabilities = event.message.capabilities
        if self.client is not None:
            self.answers |= {a.name: a for a in self.client.receive(event.message, event.frame)}

    def until(self, done: Callable[[], bool], seconds: float = 60.0) -> None:
        end = time.monotonic() + seconds
        while not done() and time.monotonic() < end:
            self.step()
        assert done()


def test_mavsdk_parameters_are_read_and_set_with_its_stated_encoding(server: int) -> None:
    station = Station(server)
    try:
        station.until(lambda: station.capabilities is not None)
        encoding = encoding_of(station.capabilities, station.make or 0)
        assert encoding == "bytewise"  # as MAVSDK states and does
        client = station.client = ParameterClient(1, 1, encoding)
        client.read([*HAS, "NOT_THERE"])
        station.until(lambda: client.is_idle)
        for name, value in HAS.items():
            assert equal_real32(station.answers[name].value, value), station.answers[name]
        assert station.answers["NOT_THERE"] == ("NOT_THERE", None, "does not exist")

        client.set("EKF2_AGP0_ID", 1)
        client.set("EKF2_AGP0_NOISE", 2.5)
        station.until(lambda: client.is_idle)
        assert station.answers["EKF2_AGP0_ID"] == ("EKF2_AGP0_ID", 1, "")
        assert station.answers["EKF2_AGP0_NOISE"] == ("EKF2_AGP0_NOISE", 2.5, "")
    finally:
        station.link.close()
