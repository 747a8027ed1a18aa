"""`companion signing init`: the key reaches both ends, is private, is not replaced nor sent in the open."""

import os
import socket
import stat
import threading
from functools import partial
from pathlib import Path

import pytest
from click.testing import CliRunner

from companion.doctor import signing_command
from companion.link import dialect, frame
from companion.link.dialect import mavlink
from companion.link.signing import Signing, read_key
from tests.network import free_port

HOST = "127.0.0.1"


class SigningAutopilot(threading.Thread):
    """Sends HEARTBEAT ten times a second, signed once it has a key, if it `supports` that."""

    def __init__(self, port: int, armed: bool = False, supports: bool = True) -> None:
        super().__init__(daemon=True)
        self.port, self.armed, self.supports = port, armed, supports
        self.key: bytes | None = None
        self.stopped = threading.Event()

    def run(self) -> None:
        signing, reader, now = None, frame.Reader(), 0
        mode = mavlink.MAV_MODE_FLAG_SAFETY_ARMED if self.armed else 0
        beat = dialect.new("HEARTBEAT", type=1, autopilot=3, base_mode=mode)
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:
            sock.settimeout(0.1)
            while not self.stopped.is_set():
                now += 10**8
                sign = partial(signing.sign, link_id=0, now_ns=now) if signing else None
                sock.sendto(frame.encode(beat, now // 10**8 & 0xFF, 1, 1, sign), (HOST, self.port))
                try:
                    data = sock.recv(4096)
                except (TimeoutError, ConnectionRefusedError):
                    continue
                for found in reader.receive(data):
                    if isinstance(found, frame.Frame) and found.msgid == mavlink.MAVLINK_MSG_ID_SETUP_SIGNING:
                        self.key = bytes(dialect.decode(found).secret_key)
                        signing = Signing(self.key) if self.supports else None


@pytest.fixture
def port() -> int:
    return free_port()


def init(path: Path, *options: str):
    return CliRunner().invoke(signing_command.group, ["init", "--key-file", str(path), *options])


def with_autopilot(autopilot: SigningAutopilot, path: Path):
    autopilot.start()
    try:
        return init(path, "--connect", f"udpin:{HOST}:{autopilot.port}")
    finally:
        autopilot.stopped.set()
        autopilot.join()


def test_both_ends_have_the_key_and_nobody_else(tmp_path: Path, port: int) -> None:
    autopilot, path = SigningAutopilot(port), tmp_path / "key"
    done = with_autopilot(autopilot, path)
    assert done.exit_code == 0, done.output
    assert "autopilot 1 on" in done.output and f"key_file = '{path}'" in done.output
    assert stat.S_IMODE(path.stat().st_mode) == 0o600
    assert read_key(path) == autopilot.key


def test_a_clock_that_was_never_set_is_no_hindrance(
    tmp_path: Path, port: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(signing_command.time, "time_ns", lambda: 100 * 10**9)
    monkeypatch.setattr(signing_command, "ANSWER_S", 1.0)
    done = with_autopilot(SigningAutopilot(port), tmp_path / "key")
    assert done.exit_code == 0, done.output


def test_an_existing_key_is_not_replaced(tmp_path: Path) -> None:
    path = tmp_path / "key"
    assert "key (new, mode 0600)" in init(path, "--no-autopilot").output
    before = path.read_bytes()
    assert "key (exists, used again)" in init(path, "--no-autopilot").output
    assert path.read_bytes() == before


def test_an_armed_vehicle_gets_no_key(tmp_path: Path, port: int) -> None:
    autopilot = SigningAutopilot(port, armed=True)
    done = with_autopilot(autopilot, tmp_path / "key")
    assert done.exit_code == 1 and "armed" in done.output and autopilot.key is None


def test_an_autopilot_that_does_not_sign_is_reported(
    tmp_path: Path, port: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(signing_command, "ANSWER_S", 1.0)
    done = with_autopilot(SigningAutopilot(port, supports=False), tmp_path / "key")
    assert done.exit_code == 1 and "sends no frame signed with the key" in done.output


def test_the_key_is_not_sent_over_a_network(tmp_path: Path) -> None:
    done = init(tmp_path / "key", "--connect", "udpin:0.0.0.0:14550")
    assert done.exit_code == 1 and "in plain" in done.output


def test_a_key_that_cannot_be_written_is_one_sentence(tmp_path: Path) -> None:
    path = tmp_path / "absent" / "key"
    assert str(init(path, "--no-autopilot").exception) == (
        f"--key-file {path}: the key cannot be written (No such file or directory): give a file in a folder "
        "that exists and that you may write"
    )


@pytest.mark.parametrize("kind", ["folder", "pipe"])
def test_a_key_file_that_is_no_regular_file_is_one_sentence(tmp_path: Path, kind: str) -> None:
    """The advice for a folder was to run this command; a pipe kept it waiting."""
    path = tmp_path / kind
    path.mkdir() if kind == "folder" else os.mkfifo(path)
    assert str(init(path, "--no-autopilot").exception) == (
        f"--key-file {path} is not a regular file: give the name of a file"
    )


def test_an_invalid_link_writes_no_key(tmp_path: Path) -> None:
    done = init(tmp_path / "key", "--connect", "nothing")
    assert str(done.exception).startswith("link.connect: 'nothing' is not a connection string")
    assert not list(tmp_path.iterdir())


def test_a_link_without_effect_is_rejected(tmp_path: Path) -> None:
    done = init(tmp_path / "key", "--no-autopilot", "--connect", "serial:/dev/autopilot:921600")
    assert done.exit_code == 2
    assert "--connect serial:/dev/autopilot:921600 has no effect with --no-autopilot" in done.output
    assert not list(tmp_path.iterdir())


def test_a_link_that_cannot_be_opened_is_one_sentence(tmp_path: Path) -> None:
    done = init(tmp_path / "key", "--connect", f"tcp:{HOST}:1")
    assert str(done.exception) == (
        f"companion: tcp:{HOST}:1: Connection refused; start the program that listens there, or give another "
        "port"
    )
