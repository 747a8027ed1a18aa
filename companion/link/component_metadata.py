"""Component metadata: what each parameter means, with unit and limits, as JSON files read by MAVLink FTP.

    request COMPONENT_METADATA -> mftp:///general.json -> mftp:///parameters.json

The server is read-only. A station has one open file, in session 0: MAVSDK reads in session 0 whatever the
answer to its opening states. https://mavlink.io/en/services/component_metadata.html
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Mapping
from functools import cache
from typing import Any

import msgspec

from companion.config import Config
from companion.link import dialect
from companion.link.dialect import Message, mavlink
from companion.link.frame import Frame
from companion.link.parameter_server import parameter_table
from companion.link.rate_limiter import RateLimiter

GENERAL, PARAMETERS = "general.json", "parameters.json"
#: COMP_METADATA_TYPE_PARAMETER
TYPE_PARAMETER = 1
#: Requests per second, and at once; packets that one burst request gives, 263 bytes each.
REQUESTS_HZ, REQUESTS_BURST, BURST_PACKETS = 10.0, 10, 4
#: Stations with an open file; the one that opened first is forgotten.
MAX_STATIONS = 8

TERMINATE, RESET, OPEN_READ_ONLY, READ, BURST_READ, ACK, NAK = 1, 2, 4, 5, 15, 128, 129
NO_SESSION, END_OF_FILE, UNKNOWN_COMMAND, FILE_NOT_FOUND = 4, 6, 7, 10
#: Sequence number, session, opcode, size, request's opcode, burst complete, padding, offset; data follow.
_HEADER = struct.Struct("<HBBBBBxI")
PAYLOAD, DATA = 251, 251 - _HEADER.size


@cache
def files() -> Mapping[str, bytes]:
    """Return the files by name."""
    from companion.config.reference import keys  # not needed in flight until a station asks

    texts = {(key.section, key.name): key for key in keys()}
    parameters = []
    for parameter in parameter_table():
        key = texts[parameter.section, parameter.key]
        entry: dict[str, Any] = {
            "name": parameter.name,
            "type": "Float",
            "group": parameter.section,
            "shortDesc": key.text,
            "longDesc": f"Key {parameter.section}.{parameter.key}. When to change: {key.change}.",
            "units": key.unit,
            "default": float(parameter.value_in(Config())),
        }
        entry |= {name: value for name, value in zip(("min", "max"), key.limits) if value is not None}
        parameters.append(entry)
    data = msgspec.json.encode({"version": 1, "parameters": parameters})
    kinds = [{"type": TYPE_PARAMETER, "uri": f"mftp:///{PARAMETERS}", "fileCrc": crc32(data)}]
    return {GENERAL: msgspec.json.encode({"version": 1, "metadataTypes": kinds}), PARAMETERS: data}


def crc32(data: bytes) -> int:
    """Return the CRC of MAVLink FTP: that of zlib without its inversions."""
    return zlib.crc32(data, 0xFFFFFFFF) ^ 0xFFFFFFFF


def component_metadata() -> Message:
    """Return COMPONENT_METADATA."""
    return dialect.new("COMPONENT_METADATA", file_crc=crc32(files()[GENERAL]), uri=f"mftp:///{GENERAL}")


class FileServer:
    """MAVLink FTP server of the metadata files."""

    def __init__(self, component: int) -> None:
        """Create a server for our component id."""
        self._component = component
        self._limiter = RateLimiter(REQUESTS_HZ, REQUESTS_BURST)
        self._open: dict[tuple[int, int], bytes] = {}  # content by station

    def receive(self, message: Message, frame: Frame, system: int, now_ns: int) -> list[Message]:
        """Return the answers to a request addressed to us; `system` is our own id."""
        if frame.msgid != mavlink.MAVLINK_MSG_ID_FILE_TRANSFER_PROTOCOL:
            return []
        if (message.target_system, message.target_component) != (system, self._component):
            return []
        if not self._limiter.take(now_ns):
            return []  # a station asks again
        return [
            dialect.new(
                "FILE_TRANSFER_PROTOCOL",
                target_system=frame.system,
                target_component=frame.component,
                payload=tuple(answer.ljust(PAYLOAD, b"\0")),
            )
            for answer in self._answers(bytes(message.payload), (frame.system, frame.component))
        ]

    def _answers(self, request: bytes, station: tuple[int, int]) -> list[bytes]:
        sequence, session, opcode, size, _, _, offset = _HEADER.unpack_from(request)

        def answer(kind: int, data: bytes, at: int = 0, *, number: int = 1, last: bool = False) -> bytes:
            following = (sequence + number) & 0xFFFF
            return _HEADER.pack(following, 0, kind, len(data), opcode, last, at) + data

        if opcode in (TERMINATE, RESET):
            self._open.pop(station, None)
            return [answer(ACK, b"")]
        if opcode == OPEN_READ_ONLY:
            name = request[_HEADER.size :][:size].split(b"\0")[0].decode("ascii", "replace").lstrip("/")
            if (opened := files().get(name)) is None:
                return [answer(NAK, bytes([FILE_NOT_FOUND]))]
            self._open.pop(station, None)
            self._open[station] = opened
            if len(self._open) > MAX_STATIONS:
                del self._open[next(iter(self._open))]
            return [answer(ACK, len(opened).to_bytes(4, "little"))]
        if opcode not in (READ, BURST_READ):
            return [answer(NAK, bytes([UNKNOWN_COMMAND]))]
        content = self._open.get(station)
        if content is None or session != 0:
            return [answer(NAK, bytes([NO_SESSION]))]
        step = min(size, DATA) or DATA
        count = BURST_PACKETS if opcode == BURST_READ else 1
        starts = range(offset, min(offset + count * step, len(content)), step)
        if not starts:
            return [answer(NAK, bytes([END_OF_FILE]))]
        return [
            answer(ACK, content[at : at + step], at, number=k, last=at == starts[-1])
            for k, at in enumerate(starts, start=1)
        ]
