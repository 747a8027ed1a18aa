"""Benchmark of latency: the flight goes on while it waits, and what it cannot measure is one sentence."""

import os
import signal
import socket

import pytest

from companion.bench import latency
from companion.link import dialect, frame


class Clock:
    """A millisecond a reading."""

    def __init__(self) -> None:
        self.now = 0.0

    def perf_counter(self) -> float:
        self.now += 1e-3
        return self.now

    def sleep(self, seconds: float) -> None:
        self.now += seconds


class Service:
    """Socket of a service that sends an ODOMETRY with the next local position after a beacon measurement.

    As on a busy computer: the estimate of the measurement itself is not due yet.
    """

    def __init__(self, sends: bool = True) -> None:
        self.sends, self.measured, self.due = sends, False, False

    def send(self, data: bytes) -> None:
        names = {dialect.TYPES[f.msgid].name for f in frame.Reader().receive(data) if hasattr(f, "msgid")}
        self.due |= self.measured and "LOCAL_POSITION_NED" in names
        self.measured |= "RSBN_MEASUREMENT" in names

    def recv(self, size: int) -> bytes:
        if not (self.due and self.sends):
            raise BlockingIOError
        self.measured = self.due = False
        return frame.encode(dialect.new("ODOMETRY"), 0, 1, 1)

    def setblocking(self, blocks: bool) -> None: ...

    def settimeout(self, seconds: float) -> None: ...


@pytest.fixture
def clock(monkeypatch):
    clock = Clock()
    monkeypatch.setattr(latency, "time", clock)
    return clock


def test_flight_goes_on_while_an_estimate_is_awaited(clock):
    """It stood still, and so no estimate came: on a busy computer that was the end of the benchmark."""
    autopilot = latency._Autopilot(Service())
    autopilot.fly()
    assert autopilot.time_response(autopilot.rsbn_frame()) == pytest.approx(latency.ROUND_S, abs=0.02)


def test_an_estimate_that_came_before_the_measurement_is_none_of_it(clock):
    """Regression: on a busy computer that of the local position came during the pause, and was timed."""
    before: list[bytes] = []

    class Late(Service):
        def recv(self, size: int) -> bytes:
            return before.pop() if before else super().recv(size)

    autopilot = latency._Autopilot(Late())
    autopilot.fly()
    before.append(frame.encode(dialect.new("ODOMETRY"), 0, 1, 1))
    assert autopilot.time_response(autopilot.rsbn_frame()) == pytest.approx(latency.ROUND_S, abs=0.02)


def test_an_estimate_that_never_comes_is_one_sentence(clock):
    autopilot = latency._Autopilot(Service(sends=False))
    autopilot.fly()
    with pytest.raises(TimeoutError, match="no corrected estimate within 60 s: stop other programs"):
        autopilot.time_response(autopilot.rsbn_frame())


def test_an_echo_that_does_not_come_is_one_sentence():
    with (
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock,
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as silent,
    ):
        silent.bind((latency.LOOPBACK, 0))
        sock.connect(silent.getsockname())
        sock.settimeout(0.01)
        with pytest.raises(TimeoutError, match="echo did not arrive within 60 s: stop other programs"):
            latency._round_trip(sock, b"data")


def test_a_process_that_ends_at_the_start_is_one_sentence():
    with pytest.raises(ChildProcessError, match="ended before the measurement"), latency.peer(set(), abs):
        pass


def test_a_process_that_ends_in_between_is_one_sentence():
    with (
        pytest.raises(ChildProcessError, match="ended before the measurement"),
        latency.peer(set(), latency._echo) as (sock, pid),
    ):
        os.kill(pid, signal.SIGKILL)
        while True:
            sock.send(b"")
