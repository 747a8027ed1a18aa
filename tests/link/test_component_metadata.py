"""Metadata files over MAVLink FTP; tests/clients has MAVSDK read them."""

import json
import struct

import pytest

from companion.config import Config
from companion.link import component_metadata as ftp
from companion.link import dialect
from companion.link.component_metadata import (
    BURST_PACKETS,
    DATA,
    GENERAL,
    MAX_STATIONS,
    PARAMETERS,
    REQUESTS_BURST,
    FileServer,
    component_metadata,
    crc32,
    files,
)
from companion.link.parameter_server import parameter_table
from tests.frames import on_wire

SYSTEM, COMPONENT, SECOND = 1, 191, 1_000_000_000
LAYOUT = struct.Struct("<HBBBBBxI239s")  # https://mavlink.io/en/services/ftp.html, Payload Format
RESET_SESSIONS, WRITE_FILE, REMOVE_FILE = 2, 7, 8


class Station:
    """A client with one request after the other, a second apart."""

    def __init__(self) -> None:
        self.server, self.now, self.sequence = FileServer(COMPONENT), 0, 65_530

    def ask(self, opcode, session=0, size=0, offset=0, data=b"", component=COMPONENT, sender=255):
        self.now, self.sequence = self.now + SECOND, (self.sequence + 1) & 0xFFFF
        packed = LAYOUT.pack(self.sequence, session, opcode, size, 0, 0, offset, data)
        request = dialect.new(
            "FILE_TRANSFER_PROTOCOL", target_system=SYSTEM, target_component=component, payload=tuple(packed)
        )
        received = on_wire(request, sender, 190)
        return [
            self.read(answer, sender)
            for answer in self.server.receive(dialect.decode(received), received, SYSTEM, self.now)
        ]

    def read(self, answer, sender):
        message = dialect.decode(on_wire(answer, SYSTEM, COMPONENT))
        assert (message.target_system, message.target_component) == (sender, 190)
        sequence, session, opcode, size, of, last, at, data = LAYOUT.unpack(bytes(message.payload))
        return (sequence - self.sequence) & 0xFFFF, session, opcode, of, last, at, data[:size]

    def open(self, name, sender=255):
        ((_, session, opcode, _, _, _, data),) = self.ask(
            ftp.OPEN_READ_ONLY, size=len(name), data=name.encode(), sender=sender
        )
        return opcode, session, data


@pytest.mark.parametrize("name", [GENERAL, PARAMETERS, f"/{PARAMETERS}"])
@pytest.mark.parametrize("size", [DATA, 100])
def test_a_file_is_read_whole_in_bursts_and_one_by_one(name: str, size: int) -> None:
    station, wanted = Station(), files()[name.lstrip("/")]
    opcode, session, data = station.open(name)
    assert (opcode, int.from_bytes(data, "little")) == (ftp.ACK, len(wanted))

    got = b""
    while len(got) < len(wanted):
        answers = station.ask(ftp.BURST_READ, session, size, len(got))
        assert len(answers) <= BURST_PACKETS and [a[0] for a in answers] == list(range(1, len(answers) + 1))
        assert [a[4] for a in answers] == [0] * (len(answers) - 1) + [1]
        for _, _, opcode, of, _, at, part in answers:
            assert (opcode, of, at) == (ftp.ACK, ftp.BURST_READ, len(got))
            got += part
    assert got == wanted

    assert station.ask(ftp.READ, session, size, 3)[0][6] == wanted[3 : 3 + size]
    assert station.ask(ftp.TERMINATE, session)[0][2] == ftp.ACK
    assert station.ask(ftp.READ, session, size)[0][6] == bytes([ftp.NO_SESSION])


@pytest.mark.parametrize(
    ("request_", "error"),
    [
        ({"opcode": ftp.OPEN_READ_ONLY, "size": 6, "data": b"passwd"}, ftp.FILE_NOT_FOUND),
        ({"opcode": ftp.READ, "session": 9, "size": 10}, ftp.NO_SESSION),
        ({"opcode": ftp.READ, "size": 10, "offset": 10**6}, ftp.END_OF_FILE),
        ({"opcode": ftp.BURST_READ, "size": 0, "offset": 2**32 - 1}, ftp.END_OF_FILE),
        ({"opcode": REMOVE_FILE, "size": 12, "data": b"general.json"}, ftp.UNKNOWN_COMMAND),
        ({"opcode": WRITE_FILE, "size": 1, "data": b"x"}, ftp.UNKNOWN_COMMAND),
    ],
)
def test_other_requests_are_refused(request_: dict[str, object], error: int) -> None:
    station = Station()
    station.open(GENERAL)
    ((_, _, opcode, _, _, _, data),) = station.ask(**request_)
    assert (opcode, data) == (ftp.NAK, bytes([error]))


def test_each_station_has_its_own_open_file_and_the_number_of_stations_is_bounded() -> None:
    station = Station()
    for sender in range(1, MAX_STATIONS + 3):
        station.open((GENERAL, PARAMETERS)[sender % 2], sender)
    sizes = [
        len(station.ask(ftp.READ, size=DATA, sender=sender)[0][6]) for sender in range(1, MAX_STATIONS + 3)
    ]
    assert sizes == [1, 1, *[DATA, len(files()[GENERAL])] * (MAX_STATIONS // 2)]


def test_a_flood_is_limited_and_another_component_is_not_answered() -> None:
    station = Station()
    assert station.ask(RESET_SESSIONS, component=1) == []
    request = dialect.new(
        "FILE_TRANSFER_PROTOCOL",
        target_system=SYSTEM,
        target_component=COMPONENT,
        payload=(0, 0, 0, 2) + (0,) * 247,
    )
    received = on_wire(request, 255, 190)
    answers = [station.server.receive(request, received, SYSTEM, station.now) for _ in range(100)]
    assert sum(map(len, answers)) == REQUESTS_BURST


def test_every_parameter_has_a_meaning_and_limits_that_hold_its_default() -> None:
    described = json.loads(files()[PARAMETERS])["parameters"]
    assert [entry["name"] for entry in described] == [parameter.name for parameter in parameter_table()]
    for entry, parameter in zip(described, parameter_table(), strict=True):
        assert entry["shortDesc"] and entry["type"] == "Float"
        assert entry["min"] <= entry["default"] <= entry["max"]
        assert entry["default"] == parameter.value_in(Config())


def test_checksums_are_those_of_mavlink_ftp() -> None:
    def bit_by_bit(data: bytes) -> int:  # as PX4 and pymavlink compute it: no inversion
        crc = 0
        for byte in data:
            crc ^= byte
            for _ in range(8):
                crc = crc >> 1 ^ (0xEDB88320 if crc & 1 else 0)
        return crc

    message = component_metadata()
    assert message.file_crc == crc32(files()[GENERAL]) == bit_by_bit(files()[GENERAL])
    assert message.uri == f"mftp:///{GENERAL}"
    (kind,) = json.loads(files()[GENERAL])["metadataTypes"]
    assert kind == {"type": 1, "uri": f"mftp:///{PARAMETERS}", "fileCrc": crc32(files()[PARAMETERS])}
