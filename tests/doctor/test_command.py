"""`companion doctor` over UDP with the simulated autopilot in its own process: output, questions, parameters
and exit codes. Only the observation times are shortened."""

import asyncio
import contextlib
import errno
import io
import json
import os
import socket
import struct
import subprocess
import sys
import time
from collections.abc import Iterator

import pytest
from click.testing import CliRunner, Result
from rich.console import Console

from companion.config import load
from companion.config.required_parameters import required_parameters
from companion.doctor import command, examination, rendering
from companion.doctor.command import check_machine
from companion.doctor.diagnosis import Diagnosis, Finding, Identity, ParameterFinding
from companion.link import dialect, frame, stream_rates
from companion.transport.reconnect import Address, Connection, connect
from tests.network import free_port

LOOPBACK = "127.0.0.1"
SECOND = 1_000_000_000


@pytest.fixture(autouse=True)
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(stream_rates, "WINDOW", SECOND)
    monkeypatch.setattr(examination, "OBSERVE", 2 * SECOND)
    monkeypatch.setattr(examination, "OBSERVE_LONGER", 2 * SECOND)
    monkeypatch.setattr(command, "CONNECT_TIMEOUT_S", 60.0)
    for name in list(os.environ):
        if name.startswith("COMPANION_"):
            monkeypatch.delenv(name)


@contextlib.contextmanager
def flying(*options: str) -> Iterator[str]:
    """Run a simulated autopilot; yield the address for the doctor once it sends."""
    port = free_port()
    data_sent = [sys.executable, "-m", "companion", "sitl", "--scenario", "short"]
    with subprocess.Popen(
        [*data_sent, "--connect", f"udpout:{LOOPBACK}:{port}", *options], stderr=subprocess.DEVNULL
    ) as process:
        try:
            with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as receiver:
                receiver.settimeout(60.0)
                receiver.bind((LOOPBACK, port))
                receiver.recv(1)
            yield f"udpin:{LOOPBACK}:{port}"
        finally:
            process.terminate()


def doctor(*arguments: str, answer: str = "") -> Result:
    return CliRunner().invoke(command.command, arguments, input=answer, env={"COLUMNS": "80"})


def has(result: Result) -> dict[str, float]:
    return {found["name"]: found["has"] for found in json.loads(result.stdout)["parameters"]}


def test_examine_confirm_and_set(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(command, "_is_interactive", lambda: True)
    with flying("--disarmed") as place:
        ask = ("--connect", place, "--profile", "ardupilot", "--apply")
        no = doctor(*ask, answer="n\n")
        assert no.exit_code == 1 and "not confirmed" in no.stderr
        assert "Set VISO_TYPE = 1, EK3_SRC2_POSXY = 6" in no.stderr  # the question contains the values
        assert "VISO_TYPE" in no.stdout and "wrong" in no.stdout
        assert max(map(len, no.stdout.splitlines())) <= 80

        yes = doctor(*ask, "--json", answer="y\n")
        checks = json.loads(yes.stdout)["findings"]
        unwell = [c["what"] for c in checks if c["is_well"] is False]
        rates = [c["what"] for c in checks if c.get("needs", "").endswith("Hz")]
        assert set(unwell) <= set(rates), yes.output  # the simulator may be late on a busy computer
        assert yes.exit_code == bool(unwell)
        needs = required_parameters(load(None, {"output.profile": "ardupilot"}))
        assert has(yes) == {need.name: need.value for need in needs}
        assert json.loads(yes.stdout)["changed"] == ["VISO_TYPE", "EK3_SRC2_POSXY", "EK3_SRC2_YAW"]


def test_nothing_is_set_while_armed() -> None:
    with flying() as place:
        done = doctor("--connect", place, "--profile", "ardupilot", "--apply", "--yes", "--json")
    assert done.exit_code == 1
    assert "armed" in done.stderr and json.loads(done.stdout)["changed"] == []


# -- no autopilot --------------------------------------------------------------------------------------------


def line(result: Result) -> str:
    assert result.exit_code == os.EX_UNAVAILABLE
    (only,) = result.stderr.splitlines()
    assert only.startswith("companion: ")
    return only


def test_no_data_exits_69_with_advice(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(command, "CONNECT_TIMEOUT_S", 0.5)
    advice = line(doctor("--connect", f"udpin:{LOOPBACK}:{free_port()}"))
    assert "no data received; check that the autopilot or router sends to this address and port" in advice
    assert "firewall; a loopback address is reached from this computer only" in advice
    assert "loopback" not in line(doctor("--connect", f"udpin:0.0.0.0:{free_port()}"))


@pytest.mark.parametrize(
    ("data_sent", "expected"),
    [pytest.param(b"\x00\x80\xf8" * 30, "baud rate", id="noise"), (None, "received only 255/190")],
)
def test_noise_and_other_senders_are_described(
    monkeypatch: pytest.MonkeyPatch, data_sent: bytes | None, expected: str
) -> None:
    monkeypatch.setattr(command, "CONNECT_TIMEOUT_S", 1.0)
    data = data_sent or frame.encode(dialect.new("HEARTBEAT", type=6, autopilot=8), 0, 255, 190)

    async def connect_and_receive(address: Address) -> Connection:
        stream = await connect(address)
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
            for _ in range(20):
                sender.sendto(data, (LOOPBACK, stream.port))
        return stream

    monkeypatch.setattr(command, "connect", connect_and_receive)
    assert expected in line(doctor("--connect", f"udpin:{LOOPBACK}:0"))


def test_port_in_use_suggests_a_running_companion() -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as taken:
        taken.bind((LOOPBACK, 0))
        data_sent = line(doctor("--connect", f"udpin:{LOOPBACK}:{taken.getsockname()[1]}"))
    assert "companion run" in data_sent and data_sent.count(LOOPBACK) == 1


def test_missing_or_forbidden_device_is_one_sentence() -> None:
    assert "no such device; see `ls /dev/serial/by-id`" in line(
        doctor("--connect", "serial:/dev/ttyNONE:57600")
    )
    denied = PermissionError(errno.EACCES, os.strerror(errno.EACCES))
    text = command.describe_open_error(Address("serial", "/dev/ttyNONE", 57600), denied)
    assert "add this user to the group of the serial port (usually dialout)" in text


def test_yes_without_apply_and_an_empty_link_are_rejected() -> None:
    alone = doctor("--yes")
    assert alone.exit_code == 2 and "--yes has no effect without --apply: add --apply" in alone.stderr
    assert "'' is not a connection string" in str(doctor("--connect", "").exception)


@pytest.mark.parametrize(
    ("link", "expected"),
    [
        ("tcp:127.0.0.1:1", "Connection refused; start the program that listens there, or give another port"),
        ("serial:/tmp:57600", "not a serial line; see `ls /dev/serial/by-id`"),
        ("serial:/dev/null:57600", "not a serial line; see `ls /dev/serial/by-id`"),
        ("udpin:192.0.2.1:14550", "this computer has no address 192.0.2.1 at present"),
    ],
)
def test_a_link_that_cannot_be_opened_is_one_sentence(link: str, expected: str) -> None:
    assert line(doctor("--connect", link)) == f"companion: {link}: {expected}"


def test_tcp_listener_without_a_peer_times_out(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(command, "CONNECT_TIMEOUT_S", 0.3)
    advice = line(doctor("--connect", f"tcpin:{LOOPBACK}:0"))
    assert f"no autopilot found on tcpin:{LOOPBACK}:0 in 0 s: " in advice
    assert "no data received; check that the autopilot or router connects to this address and port" in advice


def test_host_that_does_not_answer_is_one_sentence_with_advice(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(command, "CONNECT_TIMEOUT_S", 0.1)
    monkeypatch.setattr(command, "connect", lambda address: asyncio.sleep(9.0))
    advice = line(doctor("--connect", "tcp:192.0.2.1:5760"))
    assert "tcp:192.0.2.1:5760: no answer in 0.1 s; check the address" in advice


# -- what is shown -------------------------------------------------------------------------------------------


def shown(diagnosis: Diagnosis, columns: int = 80) -> str:
    config = load(None, {"output.profile": "px4"}, {})
    text = io.StringIO()
    rendering.print_diagnosis(
        Console(file=text, width=columns), config, Address.parse("serial:/dev/ttyAMA0:921600"), diagnosis
    )
    return text.getvalue()


def diagnosis(*findings: Finding, has: float | None = 0, trouble: str = "") -> Diagnosis:
    config = load(None, {"output.profile": "px4"}, {})
    parameters = tuple(ParameterFinding(need, has, trouble) for need in required_parameters(config))
    return Diagnosis(Identity(1, "px4", "fixed wing", "1.17.0", False), parameters, findings)


def test_every_finding_has_state_numbers_and_advice() -> None:
    bad = Finding("ATTITUDE", "2.0 Hz", "10 Hz", False, "is the line fast enough")
    text = shown(diagnosis(bad, has=None, trouble="no answer"))
    assert "absent" in text and "no answer" in text and "EKF2_AGP0_CTRL" in text
    assert "wrong" in text and "2.0 Hz" in text and "ATTITUDE: is the line fast" in text
    assert "2 parameters are absent" in text
    assert max(map(len, text.splitlines())) <= 80


def test_a_parameter_of_an_autopilot_that_answers_nothing_is_not_called_absent() -> None:
    silent = Finding("answers", "none", "to our requests", False, "check the line from our TX")
    text = shown(diagnosis(silent, has=None, trouble="no answer"))
    assert "absent" not in text and "unread" in text


def test_nothing_is_cut_in_a_narrow_terminal() -> None:
    bad = diagnosis(Finding("GPS_GLOBAL_ORIGIN", "60.00000, 30.00000", "known", True))
    assert shown(bad, columns=40) == shown(bad)


def test_change_requires_confirmation(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(command, "_is_interactive", lambda: False)
    assert "--yes" in command.confirm_change(diagnosis(), yes=False)
    assert command.confirm_change(diagnosis(), yes=True) == ""
    assert "nothing to set" in command.confirm_change(diagnosis(has=None), yes=True)
    assert "nothing to set" in command.confirm_change(diagnosis(has=1), yes=True)
    armed = diagnosis()._replace(identity=Identity(1, "px4", "fixed wing", "", is_armed=True))
    assert "armed" in command.confirm_change(armed, yes=True)
    assert "--apply sets them, after confirmation" in shown(diagnosis())
    assert "--apply sets them, once it is disarmed" in shown(armed)


def test_nothing_is_set_on_whichever_of_two_vehicles_comes_first() -> None:
    two = diagnosis(Finding("autopilots", "1, 2", "one", False, "set link.system_id"))
    assert "set link.system_id" in command.confirm_change(two, yes=True)
    chosen = diagnosis(Finding("autopilots", "1, 2", "one", True))
    assert command.confirm_change(chosen, yes=True) == ""


def test_well_diagnosis_is_stated() -> None:
    assert "All is well." in shown(diagnosis(has=1))


def test_reboot_is_advised_only_for_changed_parameters() -> None:
    before, new = diagnosis(), diagnosis(has=1)
    assert "reboot the autopilot for EKF2_AGP0_ID" in rendering.change_summary(new, new.changed_from(before))
    assert "reboot" not in rendering.change_summary(new, ())


@pytest.mark.parametrize(("bits", "well"), [(32, False), (64, True)])
def test_32_bit_machine_is_not_well(bits: int, well: bool) -> None:
    assert check_machine(bits).is_well is well
    assert check_machine(struct.calcsize("P") * 8).is_well


def test_full_serial_line_is_not_well(monkeypatch: pytest.MonkeyPatch) -> None:
    for share, well in ((0.5, True), (0.95, False)):
        connection = object.__new__(command.AutopilotConnection)
        connection.bytes = round(share * 57600 / 10 * 2.0)
        connection._start = time.monotonic() - 2.0
        (finding,) = connection.check_line_use(Address.parse("serial:/dev/ttyS0:57600"))
        assert finding.is_well is well
        assert connection.check_line_use(Address.parse("udpin:127.0.0.1:14550")) == []
