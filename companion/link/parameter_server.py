"""Parameter protocol server: a ground station lists, reads and sets the configuration. No clock, no link.

    for change in parameters.receive(message, frame, system, now_ns): ...   # change.config is the new one
    for message in parameters.to_send(now_ns): ...                          # again at parameters.deadline()

The parameters are those that an operator changes in flight, `PARAMETERS`; the rest belongs to the file, above
all who may connect and which earlier flights are kept. A value must pass the same checks as in the file.
If it does not, the answer is PARAM_ERROR and the value in effect. Set values are persistent: `save` receives
the text of a TOML file to merge over the operator's file; if it fails, nothing is changed.

Every parameter is a REAL32 on the wire. Ground stations disagree how an integer is stored in param_value
(bytewise as PX4, or cast as ArduPilot): MAVProxy and MAVSDK choose by the vehicle's autopilot, QGroundControl
by the component, and the companion runs with either autopilot. A REAL32 is the same in both encodings.
"""

from __future__ import annotations

import itertools
import math
import struct
from collections.abc import Callable
from typing import Any, NamedTuple

import msgspec

from companion.config import Config
from companion.config.validate import find_conflicts, find_mistakes
from companion.link import dialect
from companion.link.dialect import Message, mavlink
from companion.link.frame import Frame
from companion.link.rate_limiter import RateLimiter

REAL32: int = mavlink.MAV_PARAM_TYPE_REAL32
DOES_NOT_EXIST: int = mavlink.MAV_PARAM_ERROR_DOES_NOT_EXIST
OUT_OF_RANGE: int = mavlink.MAV_PARAM_ERROR_VALUE_OUT_OF_RANGE
PERMISSION_DENIED: int = mavlink.MAV_PARAM_ERROR_PERMISSION_DENIED
MAX_NAME_LENGTH = 16
#: PARAM_VALUE per second, and at once: 37 bytes each.
VALUES_HZ, VALUES_BURST = 40.0, 10
#: Changes per second, and at once; faster ones are dropped, and a station tries again.
CHANGES_HZ, CHANGES_BURST = 5.0, 20

#: What an operator changes in flight, by name: section and key. The file has everything else.
PARAMETERS = {
    "ALERT_M": ("integrity", "alert_m"),
    "BOUND_LIMIT_M": ("predictor", "limit_m"),
    "SWITCH_SOURCES": ("output", "switch_sources"),
    "STATUS_HZ": ("output", "status_hz"),
    "ODOMETRY_HZ": ("output", "odometry_hz"),
    "POS_SENSOR_HZ": ("output", "global_position_sensor_hz"),
    "GNSS_SIGMA_M": ("gnss", "sigma_m"),
    "GNSS_LATENCY_S": ("gnss", "latency_s"),
    "GNSS_TIMEOUT_S": ("gnss", "timeout_s"),
    "GNSS_USE_VEL": ("gnss", "use_velocity"),
    "RSBN_AZIMUTH_DEG": ("rsbn", "sigma_azimuth_deg"),
    "RSBN_RANGE_M": ("rsbn", "sigma_range_m"),
    "AIRSPEED_PCT": ("air_data", "airspeed_percent"),
    "HEADING_DEG": ("air_data", "heading_deg"),
}
_REQUESTS = frozenset(
    {
        mavlink.MAVLINK_MSG_ID_PARAM_REQUEST_READ,
        mavlink.MAVLINK_MSG_ID_PARAM_REQUEST_LIST,
        mavlink.MAVLINK_MSG_ID_PARAM_SET,
    }
)

Value = float | bool


class Parameter(NamedTuple):
    """A configuration key offered as a parameter; `kind` is float or bool (0 and 1 on the wire)."""

    name: str
    section: str
    key: str
    kind: type

    def value_in(self, config: Config) -> Any:
        """Return its value in `config`."""
        return getattr(getattr(config, self.section), self.key)


class ParameterChanged(NamedTuple):
    """A parameter was set: the new configuration, to be applied."""

    config: Config
    parameter: Parameter
    old: Value
    new: Value


def parameter_table() -> tuple[Parameter, ...]:
    """Return all parameters in the order of their indices."""
    default = Config()
    return tuple(
        Parameter(name, section, key, type(getattr(getattr(default, section), key)))
        for name, (section, key) in PARAMETERS.items()
    )


class ParameterServer:
    """The configuration in effect, and the parameter values that remain to be sent."""

    def __init__(
        self,
        component: int,
        config: Config,
        *,
        base: Config | None = None,
        save: Callable[[str], None] = lambda text: None,
    ) -> None:
        """Create a server for our component id.

        Parameters
        ----------
        component
            Our component id.
        config
            The configuration in effect.
        base
            The operator's configuration, without the parameters set before; by default `config`.
        save
            Stores the TOML text of all set parameters; may raise OSError.
        """
        self.config = config
        self._component = component
        self._base = base or config
        self._save = save
        self._table = parameter_table()
        self._index = {parameter.name: index for index, parameter in enumerate(self._table)}
        self._pending: dict[int, None] = {}  # indices to send, in this order
        self._errors: list[Message] = []
        self._value_limiter = RateLimiter(VALUES_HZ, VALUES_BURST)
        self._change_limiter = RateLimiter(CHANGES_HZ, CHANGES_BURST)
        self._deadline: int | None = None

    def receive(self, message: Message, frame: Frame, system: int, now_ns: int) -> list[ParameterChanged]:
        """Process a parameter message addressed to us; return the changes. Other messages are ignored.

        `system` is our own id.
        """
        if frame.msgid not in _REQUESTS:
            return []
        if message.target_system not in (0, system) or message.target_component not in (0, self._component):
            return []
        if frame.msgid == mavlink.MAVLINK_MSG_ID_PARAM_REQUEST_LIST:
            self._pending |= dict.fromkeys(range(len(self._table)))
            return []
        if frame.msgid == mavlink.MAVLINK_MSG_ID_PARAM_REQUEST_READ and message.param_index >= 0:
            index = message.param_index if message.param_index < len(self._table) else None
        else:
            index = self._index.get(message.param_id)
        if index is None:
            # a broadcast of an unknown name is meant for another component
            if message.target_component and self._change_limiter.take(now_ns):
                self._send_error(message, frame, DOES_NOT_EXIST)
            return []
        if frame.msgid == mavlink.MAVLINK_MSG_ID_PARAM_REQUEST_READ:
            self._send_first(index)
            return []
        return self._set_parameter(index, message, frame) if self._change_limiter.take(now_ns) else []

    def to_send(self, now_ns: int) -> list[Message]:
        """Return the messages to send now, on every link: all stations need a changed value."""
        messages, self._errors = self._errors, []
        while self._pending and self._value_limiter.take(now_ns):
            index = next(iter(self._pending))
            del self._pending[index]
            messages.append(self._value(index))
        self._deadline = self._value_limiter.ready_at(now_ns) if self._pending else None
        return messages

    def deadline(self) -> int | None:
        """Return when `to_send` has something to send without a new message; None if nothing is pending."""
        return self._deadline

    def _set_parameter(self, index: int, message: Message, frame: Frame) -> list[ParameterChanged]:
        self._send_first(index)
        parameter = self._table[index]
        old = parameter.value_in(self.config)
        if message.param_type != REAL32:
            self._send_error(message, frame, OUT_OF_RANGE)
            return []
        if _real32(message.param_value) == _real32(old):
            return []
        try:
            new = _to_value(parameter, message.param_value)
            config = _replace_value(self.config, parameter, new)
        except (ValueError, msgspec.ValidationError):
            self._send_error(message, frame, OUT_OF_RANGE)
            return []
        try:
            self._save(self._overrides(config))
        except OSError:
            self._send_error(message, frame, PERMISSION_DENIED)
            return []
        self.config = config
        return [ParameterChanged(config, parameter, old, new)]

    def _send_first(self, index: int) -> None:
        self._pending = {index: None} | self._pending

    def _value(self, index: int) -> Message:
        parameter = self._table[index]
        return dialect.new(
            "PARAM_VALUE",
            param_id=parameter.name,
            param_value=_real32(parameter.value_in(self.config)),
            param_type=REAL32,
            param_count=len(self._table),
            param_index=index,
        )

    def _send_error(self, message: Message, frame: Frame, error: int) -> None:
        self._errors.append(
            dialect.new(
                "PARAM_ERROR",
                target_system=frame.system,
                target_component=frame.component,
                param_id=message.param_id.encode()[:MAX_NAME_LENGTH],
                param_index=getattr(message, "param_index", -1),
                error=error,
            )
        )

    def _overrides(self, config: Config) -> str:
        lines = ["# Set over MAVLink, rewritten at every change, merged over the configuration file."]
        section = None
        for parameter in self._table:
            value = parameter.value_in(config)
            if value == parameter.value_in(self._base):
                continue
            if parameter.section != section:
                section = parameter.section
                lines += ["", f"[{section}]"]
            lines.append(f"{parameter.key} = {msgspec.json.encode(value).decode()}")
        return "\n".join(lines) + "\n"


def _to_value(parameter: Parameter, wire: float) -> Value:
    """Convert a REAL32 to the parameter's type. ValueError if it is invalid."""
    if not math.isfinite(wire):
        raise ValueError(f"{parameter.name} = {wire} is not a number")
    if parameter.kind is float:
        return _shortest(wire)
    if wire not in (0.0, 1.0):
        raise ValueError(f"{parameter.name} = {wire} is neither 0 nor 1")
    return bool(wire)


def _replace_value(config: Config, parameter: Parameter, value: Value) -> Config:
    """Return `config` with one value replaced, checked like a file. ValueError if it is invalid."""
    section = getattr(config, parameter.section)
    changed = msgspec.structs.replace(section, **{parameter.key: value})
    checked = msgspec.convert(msgspec.to_builtins(changed), type(section))
    whole = msgspec.structs.replace(config, **{parameter.section: checked})
    for *_, sentence in itertools.chain(find_conflicts(whole), find_mistakes(whole)):
        raise ValueError(sentence)
    return whole


def _real32(value: float) -> float:
    try:
        rounded: float = struct.unpack("<f", struct.pack("<f", value))[0]
    except OverflowError:
        return math.inf
    return rounded


def _shortest(wire: float) -> float:
    """Return the shortest decimal that rounds to this REAL32: 0.2, not 0.20000000298023224."""
    for digits in range(1, 9):
        if _real32(short := float(f"{wire:.{digits}g}")) == wire:
            return short
    return wire
