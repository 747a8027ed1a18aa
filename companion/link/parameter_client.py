"""Parameter protocol client: read and set another component's parameters by name. No clock, no link.

    client.read(["VISO_TYPE", "EK3_SRC2_POSXY"])
    client.set("VISO_TYPE", 1)                      # after it was read: its type is then known
    answers = client.receive(message, frame)        # every message of the component
    answers = client.poll(now_ns)                   # no later than client.deadline()
    for message in client.to_send(): ...            # after any of them

A request is sent until it is answered, ATTEMPTS times at most. At most AT_ONCE requests are pending, so that
a slow line is not flooded. A parameter is read again after it was set: the echo of a PARAM_SET contains the
received value, the reading the value in effect. Every request ends in one Answer.

An integer is stored in the float `param_value` either bytewise (PX4) or cast to a float (ArduPilot).
`encoding_of` selects the encoding by the capabilities that the autopilot states, or by its type.
"""

from __future__ import annotations

import struct
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Literal, NamedTuple

from companion.link import dialect
from companion.link.dialect import Message, mavlink
from companion.link.frame import Frame
from companion.units import SECOND_NS

TIMEOUT = 1 * SECOND_NS
ATTEMPTS = 4
AT_ONCE = 6
REAL32: int = mavlink.MAV_PARAM_TYPE_REAL32
#: Struct format, within four bytes, of each MAV_PARAM_TYPE that fits.
LAYOUTS: dict[int, str] = {
    mavlink.MAV_PARAM_TYPE_UINT8: "B3x",
    mavlink.MAV_PARAM_TYPE_INT8: "b3x",
    mavlink.MAV_PARAM_TYPE_UINT16: "H2x",
    mavlink.MAV_PARAM_TYPE_INT16: "h2x",
    mavlink.MAV_PARAM_TYPE_UINT32: "I",
    mavlink.MAV_PARAM_TYPE_INT32: "i",
    mavlink.MAV_PARAM_TYPE_REAL32: "f",
}
BYTEWISE: int = mavlink.MAV_PROTOCOL_CAPABILITY_PARAM_ENCODE_BYTEWISE
#: The present flag and its deprecated predecessor.
C_CAST: int = (
    mavlink.MAV_PROTOCOL_CAPABILITY_PARAM_ENCODE_C_CAST | mavlink.MAV_PROTOCOL_CAPABILITY_PARAM_FLOAT
)
ERRORS: dict[int, str] = {
    mavlink.MAV_PARAM_ERROR_DOES_NOT_EXIST: "does not exist",
    mavlink.MAV_PARAM_ERROR_VALUE_OUT_OF_RANGE: "value out of range",
    mavlink.MAV_PARAM_ERROR_PERMISSION_DENIED: "permission denied",
    mavlink.MAV_PARAM_ERROR_COMPONENT_NOT_FOUND: "no such component",
    mavlink.MAV_PARAM_ERROR_READ_ONLY: "read only",
}
SILENCE = "no answer"

Value = float | int
Encoding = Literal["cast", "bytewise"]


class Answer(NamedTuple):
    """Result of a request: the value in effect, or None and the reason in `trouble`.

    A `set` without effect gives both.
    """

    name: str
    value: Value | None
    trouble: str = ""


def encoding_of(capabilities: int | None, make: int) -> Encoding:
    """Return how integers are encoded.

    Parameters
    ----------
    capabilities
        AUTOPILOT_VERSION.capabilities, None if not received.
    make
        MAV_AUTOPILOT; decides if the capabilities state both encodings, or none.
    """
    stated = capabilities or 0
    if bool(stated & BYTEWISE) != bool(stated & C_CAST):
        return "bytewise" if stated & BYTEWISE else "cast"
    return "cast" if make == mavlink.MAV_AUTOPILOT_ARDUPILOTMEGA else "bytewise"


def to_value(raw: bytes, kind: int, encoding: Encoding) -> Value:
    """Decode the four bytes of `param_value`. ValueError for a type that does not fit."""
    if encoding == "bytewise" or kind == REAL32:
        value: Value = struct.unpack("<" + _layout(kind), raw)[0]
        return value
    _layout(kind)
    number: float = struct.unpack("<f", raw)[0]
    return int(number) if number == number // 1 else number


def to_wire(value: Value, kind: int, encoding: Encoding) -> float:
    """Encode `value` as `param_value`; inverse of `to_value`. ValueError if it cannot be encoded."""
    if kind != REAL32 and value != int(value):
        raise ValueError(f"{value} is not an integer, but the parameter is")
    try:
        raw = struct.pack("<" + _layout(kind), value if kind == REAL32 else int(value))
    except (struct.error, OverflowError):
        raise ValueError(f"{value} does not fit the parameter's type {kind}") from None
    if encoding == "cast":
        raw = struct.pack("<f", value)
    number: float = struct.unpack("<f", raw)[0]
    if struct.pack("<f", number) != raw:  # a signalling NaN does not survive being a float
        raise ValueError(f"{value} cannot be encoded bytewise")
    return number


def equal_real32(one: Value | None, other: Value | None) -> bool:
    """Return whether two values are equal as REAL32."""
    return one is not None and other is not None and struct.pack("<f", one) == struct.pack("<f", other)


@dataclass(slots=True)
class _Request:
    target: Value | None = None  # the value to set
    reading: bool = True
    left: int = ATTEMPTS
    due: int = 0
    received: Value | None = None


class ParameterClient:
    """Parameter requests to one component."""

    def __init__(self, system: int, component: int, encoding: Encoding) -> None:
        self._system, self._component, self._encoding = system, component, encoding
        self._kinds: dict[str, int] = {}
        self._waiting: dict[str, _Request] = {}
        self._pending: dict[str, _Request] = {}
        self._send_queue: list[Message] = []

    @property
    def is_idle(self) -> bool:
        """Whether no request is pending."""
        return not self._waiting and not self._pending

    def read(self, names: Iterable[str]) -> None:
        """Request these parameters."""
        self._waiting |= {name: _Request() for name in names}

    def set(self, name: str, value: Value) -> None:
        """Request a change. ValueError if the parameter was not read before, or cannot hold the value."""
        if name not in self._kinds:
            raise ValueError(f"{name} must be read before it is set: its type is not known")
        to_wire(value, self._kinds[name], self._encoding)
        self._waiting[name] = _Request(value, reading=False)

    def receive(self, message: Message, frame: Frame) -> list[Answer]:
        """Process a message; return the completed requests. Unrelated messages are ignored."""
        if (frame.system, frame.component) != (self._system, self._component):
            return []
        if frame.msgid not in (mavlink.MAVLINK_MSG_ID_PARAM_VALUE, mavlink.MAVLINK_MSG_ID_PARAM_ERROR):
            return []
        name = message.param_id
        if (request := self._pending.get(name)) is None:
            return []
        if frame.msgid == mavlink.MAVLINK_MSG_ID_PARAM_ERROR:
            del self._pending[name]
            return [Answer(name, request.received, ERRORS.get(message.error, f"error {message.error}"))]
        try:
            value = to_value(frame.payload[:4].ljust(4, b"\0"), message.param_type, self._encoding)
        except ValueError as error:
            del self._pending[name]
            return [Answer(name, None, str(error))]
        self._kinds[name] = message.param_type
        request.received = value
        if request.reading:
            del self._pending[name]
            return [_answer(name, request)]
        if equal_real32(
            value, request.target
        ):  # otherwise it was sent before the change, and the change is requested again
            self._pending[name] = _Request(request.target)
        return []

    def poll(self, now_ns: int) -> list[Answer]:
        """Send the requests that are due; return those given up after ATTEMPTS."""
        answers = []
        for name, request in list(self._pending.items()):
            if request.due <= now_ns:
                if request.left:
                    self._send_request(name, request, now_ns)
                else:
                    del self._pending[name]
                    answers.append(_answer(name, request))
        while self._waiting and len(self._pending) < AT_ONCE:
            name = next(iter(self._waiting))
            self._pending[name] = self._waiting.pop(name)
            self._send_request(name, self._pending[name], now_ns)
        return answers

    def to_send(self) -> list[Message]:
        """Return the messages to send now."""
        sent, self._send_queue = self._send_queue, []
        return sent

    def deadline(self) -> int | None:
        """Return when `poll` must be called at the latest; None if no request is pending."""
        if self._waiting and len(self._pending) < AT_ONCE:
            return 0
        return min((request.due for request in self._pending.values()), default=None)

    def _send_request(self, name: str, request: _Request, now: int) -> None:
        request.left -= 1
        request.due = now + TIMEOUT
        target = {"target_system": self._system, "target_component": self._component, "param_id": name}
        if request.reading or request.target is None:
            self._send_queue.append(dialect.new("PARAM_REQUEST_READ", param_index=-1, **target))
            return
        kind = self._kinds[name]
        value = to_wire(request.target, kind, self._encoding)
        self._send_queue.append(dialect.new("PARAM_SET", param_value=value, param_type=kind, **target))


def _answer(name: str, request: _Request) -> Answer:
    received, target = request.received, request.target
    if received is None:
        return Answer(name, None, SILENCE)
    return Answer(name, received, "" if target is None or equal_real32(received, target) else "not accepted")


def _layout(kind: int) -> str:
    try:
        return LAYOUTS[kind]
    except KeyError:
        raise ValueError(f"parameter type {kind} does not fit param_value") from None
