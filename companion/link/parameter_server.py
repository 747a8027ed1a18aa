"""The configuration as MAVLink parameters: listed, read and set from a ground station. No clock, no link.

    for change in parameters.receive(message, frame, system, now_ns): ...   # change.config is the new whole
    for message in parameters.to_send(now_ns): ...                          # again at parameters.deadline()

Numbers and switches are offered; texts and lists are not, nor what decides who may speak to us (sections LINK
and SIGNING) or what is kept of earlier flights (LOG). A value must pass the same checks as in the file. One
that does not is answered by the value that stands, and PARAM_ERROR. What is set is kept: `save` gets the text
of a TOML file to be laid over the operator's own, and where it fails nothing is changed.

Every parameter is a REAL32 on the wire. Ground stations disagree how an integer stands in param_value (as
PX4's bytes or as ArduPilot's cast): MAVProxy and MAVSDK go by the kind of the vehicle's autopilot,
QGroundControl by the component, and we fly under either autopilot. A REAL32 is the same in both and holds
integers up to 2^24 exactly; greater ones cannot be set.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import msgspec

from companion.config import Config
from companion.config.validate import conflicts
from companion.link import dialect
from companion.link.dialect import Message
from companion.link.frame import Frame
from companion.link.rate_limiter import Bucket

PARAM_REQUEST_READ, PARAM_REQUEST_LIST, PARAM_SET = 20, 21, 23
REAL32 = 9
#: MAV_PARAM_ERROR.
DOES_NOT_EXIST, OUT_OF_RANGE, PERMISSION_DENIED = 1, 2, 3
LONGEST_NAME = 16
EXACT = 1 << 24
#: PARAM_VALUE a second, and at once: 37 bytes each.
VALUES_HZ, VALUES_BURST = 40.0, 10
#: Changes a second, and at once; what comes faster is dropped, and a station tries again.
CHANGES_HZ, CHANGES_BURST = 5.0, 20

#: Of no ground station's concern; a limit of the logs that was set wrong would erase flights.
HIDDEN = frozenset({"link", "log", "signing"})
#: What a ground station must not claim for the aircraft.
HIDDEN_KEYS = frozenset({("inertial", "independent")})
_SECTIONS = {"RATES": "RATE", "INERTIAL": "INS", "PREDICTOR": "PRED", "ESTIMATOR": "EST", "OUTPUT": "OUT"}
#: Applied in this order to names that are too long.
_SHORT = {
    "GLOBAL_POSITION_SENSOR": "GPSENS",
    "ANGLE_RANDOM_WALK": "ARW",
    "VELOCITY_NOISE": "VRW",
    "SQRT_S": "RTS",
    "SQRT_H": "RTH",
    "DRIFT_DEG_H": "DRFT_DH",
    "ACCELEROMETER": "ACC",
    "ARCMIN": "AMIN",
    "ARCSEC": "ASEC",
    "ATTITUDE": "ATT",
    "AZIMUTH": "AZ",
    "CORRELATION": "CORR",
    "DISTURBANCE": "DIST",
    "EXTERNAL": "EXT",
    "HEADING": "HDG",
    "LOCAL": "LOC",
    "PERCENT": "PCT",
    "POSITION": "POS",
    "RANGE": "RNG",
    "REJECTION": "REJ",
    "SIGMA": "SIG",
    "VELOCITY": "VEL",
}

Value = float | int | bool


class Parameter(NamedTuple):
    """A key of the configuration that is a parameter; `kind` is float, int or bool (0 and 1 on the wire)."""

    name: str
    section: str
    key: str
    kind: type

    def of(self, config: Config) -> Any:
        """Its value in `config`."""
        return getattr(getattr(config, self.section), self.key)


class ParameterChanged(NamedTuple):
    """A parameter was set: the configuration with it, to be applied."""

    config: Config
    parameter: Parameter
    old: Value
    new: Value


def name_of(section: str, key: str) -> str:
    """The parameter's name: SECTION_KEY, shortened to 16 characters by a rule that looks at nothing else."""
    prefix = section.upper()
    name = f"{_SECTIONS.get(prefix, prefix)}_{key.upper()}"
    if len(name) > LONGEST_NAME:
        name = f"_{name}_"
        for word, short in _SHORT.items():
            name = name.replace(f"_{word}_", f"_{short}_")
        name = name.strip("_")
    words = name.split("_")
    while len("_".join(words)) > LONGEST_NAME:  # keys that _SHORT does not know: the longest words are cut
        longest = max(range(len(words)), key=lambda i: len(words[i]))
        words[longest] = words[longest][:-1]
    return "_".join(words)


def table() -> tuple[Parameter, ...]:
    """All parameters, in the order of the configuration. ValueError if two would have one name."""
    found: dict[str, Parameter] = {}
    for parameter in _keys():
        if (other := found.setdefault(parameter.name, parameter)) is not parameter:
            raise ValueError(
                f"{other.section}.{other.key} and {parameter.section}.{parameter.key} would both be the "
                f"parameter {parameter.name}: rename one, or shorten one in _SHORT"
            )
    return tuple(found.values())


def _keys() -> Iterator[Parameter]:
    for section in Config.__struct_fields__:
        if section in HIDDEN:
            continue
        for field in msgspec.structs.fields(type(getattr(Config(), section))):
            kind = type(field.default)
            if kind in (float, int, bool) and (section, field.name) not in HIDDEN_KEYS:
                yield Parameter(name_of(section, field.name), section, field.name, kind)


class Parameters:
    """The configuration that stands, and what of it is still to be told."""

    def __init__(
        self,
        component: int,
        config: Config,
        *,
        base: Config | None = None,
        save: Callable[[str], None] = lambda text: None,
    ) -> None:
        """`base`: the operator's configuration without what was set here before; `config` is with it.

        `save` may raise OSError.
        """
        self.config = config
        self._component = component
        self._base = base or config
        self._save = save
        self._table = table()
        self._index = {parameter.name: index for index, parameter in enumerate(self._table)}
        self._pending: dict[int, None] = {}  # indices to be told, in this order
        self._errors: list[Message] = []
        self._values = Bucket(VALUES_HZ, VALUES_BURST)
        self._changes = Bucket(CHANGES_HZ, CHANGES_BURST)
        self._deadline: int | None = None

    def receive(self, message: Message, frame: Frame, system: int, now_ns: int) -> list[ParameterChanged]:
        """Take a message of the parameter protocol that is meant for us; others mean nothing.

        `system` is our own id.
        """
        if frame.msgid not in (PARAM_REQUEST_READ, PARAM_REQUEST_LIST, PARAM_SET):
            return []
        if message.target_system not in (0, system) or message.target_component not in (0, self._component):
            return []
        if frame.msgid == PARAM_REQUEST_LIST:
            self._pending |= dict.fromkeys(range(len(self._table)))
            return []
        if frame.msgid == PARAM_REQUEST_READ and message.param_index >= 0:
            index = message.param_index if message.param_index < len(self._table) else None
        else:
            index = self._index.get(message.param_id)
        if index is None:
            # a broadcast is for whom it concerns
            if message.target_component and self._changes.take(now_ns):
                self._refuse(message, frame, DOES_NOT_EXIST)
            return []
        if frame.msgid == PARAM_REQUEST_READ:
            self._tell_first(index)
            return []
        return self._set(index, message, frame) if self._changes.take(now_ns) else []

    def to_send(self, now_ns: int) -> list[Message]:
        """The messages to be sent now, on every link: a value is news for all stations."""
        messages, self._errors = self._errors, []
        while self._pending and self._values.take(now_ns):
            index = next(iter(self._pending))
            del self._pending[index]
            messages.append(self._value(index))
        self._deadline = self._values.ready_at(now_ns) if self._pending else None
        return messages

    def deadline(self) -> int | None:
        """When `to_send` is next worth calling without news; None: not before there are any."""
        return self._deadline

    def _set(self, index: int, message: Message, frame: Frame) -> list[ParameterChanged]:
        self._tell_first(index)
        parameter = self._table[index]
        old = parameter.of(self.config)
        if message.param_type != REAL32:
            self._refuse(message, frame, OUT_OF_RANGE)
            return []
        if _real32(message.param_value) == _real32(old):
            return []
        try:
            new = _meant(parameter, message.param_value)
            config = _with(self.config, parameter, new)
        except (ValueError, msgspec.ValidationError):
            self._refuse(message, frame, OUT_OF_RANGE)
            return []
        try:
            self._save(self._overrides(config))
        except OSError:
            self._refuse(message, frame, PERMISSION_DENIED)
            return []
        self.config = config
        return [ParameterChanged(config, parameter, old, new)]

    def _tell_first(self, index: int) -> None:
        self._pending = {index: None} | self._pending

    def _value(self, index: int) -> Message:
        parameter = self._table[index]
        return dialect.new(
            "PARAM_VALUE",
            param_id=parameter.name,
            param_value=_real32(parameter.of(self.config)),
            param_type=REAL32,
            param_count=len(self._table),
            param_index=index,
        )

    def _refuse(self, message: Message, frame: Frame, error: int) -> None:
        self._errors.append(
            dialect.new(
                "PARAM_ERROR",
                target_system=frame.system,
                target_component=frame.component,
                param_id=message.param_id.encode()[:LONGEST_NAME],
                param_index=getattr(message, "param_index", -1),
                error=error,
            )
        )

    def _overrides(self, config: Config) -> str:
        lines = ["# Set over MAVLink, and written anew at every change; laid over the configuration file."]
        section = None
        for parameter in self._table:
            value = parameter.of(config)
            if value == parameter.of(self._base):
                continue
            if parameter.section != section:
                section = parameter.section
                lines += ["", f"[{section}]"]
            lines.append(f"{parameter.key} = {msgspec.json.encode(value).decode()}")
        return "\n".join(lines) + "\n"


def _meant(parameter: Parameter, wire: float) -> Value:
    """The value that a station means by a REAL32. ValueError if it can mean none."""
    if not math.isfinite(wire):
        raise ValueError(f"{parameter.name} = {wire} is no number")
    if parameter.kind is float:
        return _shortest(wire)
    if wire != int(wire) or abs(wire) > EXACT or (parameter.kind is bool and wire not in (0.0, 1.0)):
        raise ValueError(f"{parameter.name} = {wire} is no {parameter.kind.__name__}")
    value: Value = parameter.kind(wire)
    return value


def _with(config: Config, parameter: Parameter, value: Value) -> Config:
    """`config` with one value changed, checked as a file is. ValueError if it is impossible."""
    section = getattr(config, parameter.section)
    changed = msgspec.structs.replace(section, **{parameter.key: value})
    checked = msgspec.convert(msgspec.to_builtins(changed), type(section))
    whole = msgspec.structs.replace(config, **{parameter.section: checked})
    for *_, sentence in conflicts(whole):
        raise ValueError(sentence)
    return whole


def _real32(value: float) -> float:
    try:
        rounded: float = struct.unpack("<f", struct.pack("<f", value))[0]
    except OverflowError:
        return math.inf
    return rounded


def _shortest(wire: float) -> float:
    """The decimal of fewest digits that this REAL32 stands for: 0.2, not 0.20000000298023224."""
    for digits in range(1, 9):
        if _real32(short := float(f"{wire:.{digits}g}")) == wire:
            return short
    return wire
