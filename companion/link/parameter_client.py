"""Another component's parameters, read and set by name: the parameter protocol's client. No clock, no link.

    client.read(["VISO_TYPE", "EK3_SRC2_POSXY"])
    client.set("VISO_TYPE", 1)                      # of a parameter that was read: its type is then known
    answers = client.receive(message, frame)        # whatever the component says
    answers = client.poll(now_ns)                   # no later than client.deadline()
    for message in client.to_send(): ...            # after any of them

A request is repeated until it is answered, ATTEMPTS times, and AT_ONCE are under way at most, so that a slow
line is not flooded. What is set is read again: the echo of a PARAM_SET tells what was heard, the reading what
stands. Every request ends in one Answer.

An integer stands in the float `param_value` either as its bytes (PX4) or cast to a float (ArduPilot):
`encoding_of` tells which, by the capabilities that the autopilot states, or by its make.
"""

from __future__ import annotations

import struct
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Literal, NamedTuple

from companion.link import dialect
from companion.link.clock import SECOND
from companion.link.dialect import Message
from companion.link.frame import Frame

PARAM_VALUE, PARAM_ERROR = 22, 345
TIMEOUT = 1 * SECOND
ATTEMPTS = 4
AT_ONCE = 6
REAL32 = 9
#: MAV_PARAM_TYPE of what fits into four bytes, as it lies in them.
LAYOUTS = {1: "B3x", 2: "b3x", 3: "H2x", 4: "h2x", 5: "I", 6: "i", REAL32: "f"}
#: MAV_PROTOCOL_CAPABILITY: PARAM_ENCODE_BYTEWISE; PARAM_ENCODE_C_CAST and the older PARAM_FLOAT.
BYTEWISE, C_CAST = 16, 131072 | 2
ARDUPILOT = 3
#: MAV_PARAM_ERROR.
ERRORS = {
    1: "does not exist",
    2: "value out of range",
    3: "permission denied",
    4: "no such component",
    5: "read only",
}
SILENCE = "no answer"

Value = float | int
Encoding = Literal["cast", "bytewise"]


class Answer(NamedTuple):
    """What became of a request: the value that stands, or None and the reason `trouble`.

    After a `set` that was not taken there may be both.
    """

    name: str
    value: Value | None
    trouble: str = ""


def encoding_of(capabilities: int | None, make: int) -> Encoding:
    """How integers are encoded, by AUTOPILOT_VERSION.capabilities (None: not heard) and MAV_AUTOPILOT.

    One who states both, or neither, is judged by its make.
    """
    stated = capabilities or 0
    if bool(stated & BYTEWISE) != bool(stated & C_CAST):
        return "bytewise" if stated & BYTEWISE else "cast"
    return "cast" if make == ARDUPILOT else "bytewise"


def to_value(raw: bytes, kind: int, encoding: Encoding) -> Value:
    """The value that the four bytes of `param_value` mean. ValueError for a type that they cannot hold."""
    if encoding == "bytewise" or kind == REAL32:
        value: Value = struct.unpack("<" + _layout(kind), raw)[0]
        return value
    _layout(kind)
    number: float = struct.unpack("<f", raw)[0]
    return int(number) if number == number // 1 else number


def to_wire(value: Value, kind: int, encoding: Encoding) -> float:
    """The float that says `value`, the mirror of `to_value`. ValueError where there is none."""
    if kind != REAL32 and value != int(value):
        raise ValueError(f"{value} is no integer, as the parameter is")
    try:
        raw = struct.pack("<" + _layout(kind), value if kind == REAL32 else int(value))
    except (struct.error, OverflowError):
        raise ValueError(f"{value} does not fit the parameter's type {kind}") from None
    if encoding == "cast":
        raw = struct.pack("<f", value)
    number: float = struct.unpack("<f", raw)[0]
    if struct.pack("<f", number) != raw:  # a signalling NaN does not survive being a float
        raise ValueError(f"{value} cannot be said bytewise")
    return number


def same(one: Value | None, other: Value | None) -> bool:
    """Whether two values are one REAL32."""
    return one is not None and other is not None and struct.pack("<f", one) == struct.pack("<f", other)


@dataclass(slots=True)
class _Request:
    wanted: Value | None = None  # to be set to
    reading: bool = True
    left: int = ATTEMPTS
    due: int = 0
    heard: Value | None = None


class ParameterClient:
    """Requests to one component and what became of them."""

    def __init__(self, system: int, component: int, encoding: Encoding) -> None:
        self._system, self._component, self._encoding = system, component, encoding
        self._kinds: dict[str, int] = {}
        self._waiting: dict[str, _Request] = {}
        self._asked: dict[str, _Request] = {}
        self._outbox: list[Message] = []

    @property
    def is_idle(self) -> bool:
        """Whether every request was answered."""
        return not self._waiting and not self._asked

    def read(self, names: Iterable[str]) -> None:
        """Ask for these parameters."""
        self._waiting |= {name: _Request() for name in names}

    def set(self, name: str, value: Value) -> None:
        """Ask for a change. ValueError if the parameter was not read before, or cannot hold the value."""
        if name not in self._kinds:
            raise ValueError(f"{name} has to be read before it is set: its type is not known")
        to_wire(value, self._kinds[name], self._encoding)
        self._waiting[name] = _Request(value, reading=False)

    def receive(self, message: Message, frame: Frame) -> list[Answer]:
        """Take a message; those of other components, and what nobody asked for, mean nothing."""
        if (frame.system, frame.component) != (self._system, self._component):
            return []
        if frame.msgid not in (PARAM_VALUE, PARAM_ERROR):
            return []
        name = message.param_id
        if (request := self._asked.get(name)) is None:
            return []
        if frame.msgid == PARAM_ERROR:
            del self._asked[name]
            return [Answer(name, request.heard, ERRORS.get(message.error, f"error {message.error}"))]
        try:
            value = to_value(frame.payload[:4].ljust(4, b"\0"), message.param_type, self._encoding)
        except ValueError as error:
            del self._asked[name]
            return [Answer(name, None, str(error))]
        self._kinds[name] = message.param_type
        request.heard = value
        if request.reading:
            del self._asked[name]
            return [_answer(name, request)]
        if same(value, request.wanted):  # else it was said before the change; that is asked for again
            self._asked[name] = _Request(request.wanted)
        return []

    def poll(self, now_ns: int) -> list[Answer]:
        """Ask what is due, and give up what was asked for often enough."""
        answers = []
        for name, request in list(self._asked.items()):
            if request.due <= now_ns:
                if request.left:
                    self._ask(name, request, now_ns)
                else:
                    del self._asked[name]
                    answers.append(_answer(name, request))
        while self._waiting and len(self._asked) < AT_ONCE:
            name = next(iter(self._waiting))
            self._asked[name] = self._waiting.pop(name)
            self._ask(name, self._asked[name], now_ns)
        return answers

    def to_send(self) -> list[Message]:
        """The messages to be sent now."""
        sent, self._outbox = self._outbox, []
        return sent

    def deadline(self) -> int | None:
        """When `poll` must be called at the latest; None: not before there is a request."""
        if self._waiting and len(self._asked) < AT_ONCE:
            return 0
        return min((request.due for request in self._asked.values()), default=None)

    def _ask(self, name: str, request: _Request, now: int) -> None:
        request.left -= 1
        request.due = now + TIMEOUT
        target = {"target_system": self._system, "target_component": self._component, "param_id": name}
        if request.reading or request.wanted is None:
            self._outbox.append(dialect.new("PARAM_REQUEST_READ", param_index=-1, **target))
            return
        kind = self._kinds[name]
        value = to_wire(request.wanted, kind, self._encoding)
        self._outbox.append(dialect.new("PARAM_SET", param_value=value, param_type=kind, **target))


def _answer(name: str, request: _Request) -> Answer:
    heard, wanted = request.heard, request.wanted
    if heard is None:
        return Answer(name, None, SILENCE)
    return Answer(name, heard, "" if wanted is None or same(heard, wanted) else "not taken")


def _layout(kind: int) -> str:
    try:
        return LAYOUTS[kind]
    except KeyError:
        raise ValueError(f"parameter type {kind} does not fit param_value") from None
