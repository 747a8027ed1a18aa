"""COMMAND_LONG and COMMAND_INT server of one link: every command addressed to us is acknowledged. No clock.

    replies = commands.receive(message, frame, system, now_ns)   # to be sent on the link it came from

Supported commands: request a message, get and set message intervals, request our version. All others, and
messages that we do not send, get UNSUPPORTED, an invalid parameter gets DENIED, and commands above the rate
limit get TEMPORARILY_REJECTED.

A command to all components (component 0) is answered only if we support it: a ground station may take our
UNSUPPORTED, sent beside the autopilot's ACCEPTED, for the autopilot's answer. A command to another system, or
to all systems, is not answered.
"""

from __future__ import annotations

import enum
import math
import re
from collections.abc import Callable, Mapping

from companion import __version__
from companion.link import dialect
from companion.link.dialect import Message, mavlink
from companion.link.frame import Frame
from companion.link.rate_limiter import RateLimiter

#: Commands per second, and at once, before they are rejected.
RATE_HZ, BURST = 10.0, 20
#: Shortest message interval that may be requested.
MIN_INTERVAL_US = 20_000
#: Interval of a disabled message.
DISABLED = -1

#: Parameters are all REAL32, which both encodings store alike; AUTOPILOT_VERSION must name one of them.
CAPABILITIES = (
    mavlink.MAV_PROTOCOL_CAPABILITY_COMMAND_INT
    | mavlink.MAV_PROTOCOL_CAPABILITY_MAVLINK2
    | mavlink.MAV_PROTOCOL_CAPABILITY_PARAM_ENCODE_BYTEWISE
    | mavlink.MAV_PROTOCOL_CAPABILITY_FTP
)


class Result(enum.IntEnum):
    """The values of MAV_RESULT that are sent."""

    ACCEPTED = mavlink.MAV_RESULT_ACCEPTED
    TEMPORARILY_REJECTED = mavlink.MAV_RESULT_TEMPORARILY_REJECTED
    DENIED = mavlink.MAV_RESULT_DENIED
    UNSUPPORTED = mavlink.MAV_RESULT_UNSUPPORTED
    FAILED = mavlink.MAV_RESULT_FAILED


#: Makes a message on request, or None while there is nothing to send.
Source = Callable[[], Message | None]
#: Message interval in us by message id; -1 if disabled.
Intervals = Mapping[int, int]
Executed = tuple[Result, list[Message]]
Execute = Callable[[float, float, Intervals], Executed]


def autopilot_version() -> Message:
    """Return AUTOPILOT_VERSION with the version and capabilities of the companion."""
    major, minor, patch = (int(part) for part in re.findall(r"\d+", __version__)[:3])
    return dialect.new(
        "AUTOPILOT_VERSION",
        capabilities=CAPABILITIES,
        flight_sw_version=major << 24 | minor << 16 | patch << 8,
    )


class CommandServer:
    """Executes and acknowledges the commands of one link; holds the message intervals that were set there."""

    def __init__(self, component: int, intervals_us: Intervals, sources: Mapping[int, Source]) -> None:
        """Create a server for our component id.

        Parameters
        ----------
        component
            Our component id.
        intervals_us
            Default interval of every streamed message by message id, -1 if disabled by default.
        sources
            Function that makes each message that may be requested; AUTOPILOT_VERSION is added.
        """
        self._component = component
        self._defaults = dict(intervals_us)
        self._sources: dict[int, Source] = {
            mavlink.MAVLINK_MSG_ID_AUTOPILOT_VERSION: autopilot_version,
            **sources,
        }
        self._limiter = RateLimiter(RATE_HZ, BURST)
        self._table: dict[int, Execute] = {
            mavlink.MAV_CMD_GET_MESSAGE_INTERVAL: self._get_message_interval,
            mavlink.MAV_CMD_SET_MESSAGE_INTERVAL: self._set_message_interval,
            mavlink.MAV_CMD_REQUEST_MESSAGE: self._request_message,
            mavlink.MAV_CMD_REQUEST_AUTOPILOT_CAPABILITIES: self._request_autopilot_capabilities,
        }
        #: The present interval of each streamed message, us; -1: disabled.
        self.intervals_us = dict(intervals_us)

    def set_default_intervals(self, intervals_us: Intervals) -> None:
        """Replace the default intervals and discard those that were set by command."""
        self._defaults, self.intervals_us = dict(intervals_us), dict(intervals_us)

    def receive(
        self, message: Message, frame: Frame, system: int, now_ns: int, fixed_us: Intervals
    ) -> list[Message]:
        """Execute a command and return the replies; empty for other messages and other addressees.

        `system` is our own id, `fixed_us` the intervals on this link that no command may change: what the
        autopilot is fed is set by parameters only.
        """
        if frame.msgid not in _COMMANDS or message.target_system != system:
            return []
        execute = self._table.get(message.command)
        if message.target_component != self._component and (message.target_component or execute is None):
            return []
        replies: list[Message] = []
        if not self._limiter.take(now_ns):
            result = Result.TEMPORARILY_REJECTED
        elif execute is None:
            result = Result.UNSUPPORTED
        else:
            result, replies = execute(message.param1, message.param2, fixed_us)
        ack = dialect.new(
            "COMMAND_ACK",
            command=message.command,
            result=result,
            target_system=frame.system,
            target_component=frame.component,
        )
        return [ack, *replies]

    def _request_message(self, param1: float, param2: float, fixed_us: Intervals) -> Executed:
        msgid = _to_message_id(param1)
        if (source := self._sources.get(msgid)) is None:
            return Result.UNSUPPORTED if msgid >= 0 else Result.DENIED, []
        message = source()
        return (Result.FAILED, []) if message is None else (Result.ACCEPTED, [message])

    def _set_message_interval(self, param1: float, param2: float, fixed_us: Intervals) -> Executed:
        msgid, interval = _to_message_id(param1), param2
        if msgid in fixed_us:
            return Result.DENIED, []
        if msgid not in self._defaults:
            return Result.UNSUPPORTED if msgid >= 0 else Result.DENIED, []
        if interval == 0:
            self.intervals_us[msgid] = self._defaults[msgid]
        elif interval == DISABLED:
            self.intervals_us[msgid] = DISABLED
        elif MIN_INTERVAL_US <= interval < 2**31:
            self.intervals_us[msgid] = round(interval)
        else:
            return Result.DENIED, []
        return Result.ACCEPTED, []

    def _get_message_interval(self, param1: float, param2: float, fixed_us: Intervals) -> Executed:
        msgid = _to_message_id(param1)
        if not 0 <= msgid < 1 << 16:  # the range of MESSAGE_INTERVAL.message_id
            return Result.DENIED, []
        # 0: message not available, by the description of MESSAGE_INTERVAL
        known = {**self.intervals_us, **fixed_us}
        interval = known.get(msgid, DISABLED if msgid in self._sources else 0)
        return Result.ACCEPTED, [dialect.new("MESSAGE_INTERVAL", message_id=msgid, interval_us=interval)]

    def _request_autopilot_capabilities(self, param1: float, param2: float, fixed_us: Intervals) -> Executed:
        if param1 != 1:
            return Result.DENIED, []
        return self._request_message(mavlink.MAVLINK_MSG_ID_AUTOPILOT_VERSION, 0.0, fixed_us)


_COMMANDS = frozenset({mavlink.MAVLINK_MSG_ID_COMMAND_INT, mavlink.MAVLINK_MSG_ID_COMMAND_LONG})


def _to_message_id(value: float) -> int:
    """Return the message id in a command parameter, -1 if it is not an integer."""
    return int(value) if math.isfinite(value) and value == int(value) else -1
