"""Answers to COMMAND_LONG and COMMAND_INT: every command addressed to us is acknowledged. No clock, no link.

    replies = commands.receive(message, frame, system, now_ns)   # to be sent where it came from

We serve what describes us and paces us: messages on request, their intervals, our version. Everything else is
UNSUPPORTED, a bad parameter DENIED, and what comes faster than it may TEMPORARILY_REJECTED.

A command to all components (component 0) is answered only if it is one of ours: an UNSUPPORTED of ours beside
the autopilot's ACCEPTED is what a ground station may take for the autopilot's answer. A command to another
system, or to all systems, is not answered at all.
"""

from __future__ import annotations

import enum
import math
import re
from collections.abc import Callable, Mapping

from companion import __version__
from companion.link import dialect
from companion.link.dialect import Message
from companion.link.frame import Frame
from companion.link.rate_limiter import Bucket

COMMAND_INT, COMMAND_LONG = 75, 76
AUTOPILOT_VERSION, MESSAGE_INTERVAL = 148, 244
#: Commands a second, and at once, before they are rejected.
RATE_HZ, BURST = 10.0, 20
#: Nobody gets a message faster.
SHORTEST_US = 20_000
DISABLED = -1

#: MAV_PROTOCOL_CAPABILITY: COMMAND_INT, MAVLINK2, and PARAM_ENCODE_BYTEWISE (one encoding is to be named; our
#: parameters are all REAL32, which are the same bytes in either).
CAPABILITIES = 8 | 8192 | 16


class Result(enum.IntEnum):
    """MAV_RESULT, as far as we use it."""

    ACCEPTED = 0
    TEMPORARILY_REJECTED = 1
    DENIED = 2
    UNSUPPORTED = 3
    FAILED = 4


#: Makes a message that is asked for, or None while there is nothing to tell.
Source = Callable[[], Message | None]


def autopilot_version() -> Message:
    """Who we are, in the message that MAVLink has for it."""
    major, minor, patch = (int(part) for part in re.findall(r"\d+", __version__)[:3])
    return dialect.new(
        "AUTOPILOT_VERSION",
        capabilities=CAPABILITIES,
        flight_sw_version=major << 24 | minor << 16 | patch << 8,
    )


class Commands:
    """What we can be told to do, and the message intervals that we were told."""

    def __init__(
        self, component: int, intervals_us: Mapping[int, int], sources: Mapping[int, Source]
    ) -> None:
        """`intervals_us`: default interval of every message that we stream, -1 for one that begins disabled.

        `sources`: what makes each message that may be asked for; AUTOPILOT_VERSION is added.
        """
        self._component = component
        self._defaults = dict(intervals_us)
        self._sources: dict[int, Source] = {AUTOPILOT_VERSION: autopilot_version} | dict(sources)
        self._bucket = Bucket(RATE_HZ, BURST)
        self._table: dict[int, Callable[[float, float], tuple[Result, list[Message]]]] = {
            510: self._get_message_interval,
            511: self._set_message_interval,
            512: self._request_message,
            520: self._request_autopilot_capabilities,
        }
        #: The interval of each streamed message now, us; -1: not sent.
        self.intervals_us = dict(intervals_us)

    def pace(self, intervals_us: Mapping[int, int]) -> None:
        """Other default intervals; what was asked before is forgotten."""
        self._defaults, self.intervals_us = dict(intervals_us), dict(intervals_us)

    def receive(self, message: Message, frame: Frame, system: int, now_ns: int) -> list[Message]:
        """Do what a command says and return the answers; nothing for other messages and other addressees.

        `system` is our own id.
        """
        if frame.msgid not in (COMMAND_INT, COMMAND_LONG) or message.target_system != system:
            return []
        execute = self._table.get(message.command)
        if message.target_component != self._component and (message.target_component or execute is None):
            return []
        replies: list[Message] = []
        if not self._bucket.take(now_ns):
            result = Result.TEMPORARILY_REJECTED
        elif execute is None:
            result = Result.UNSUPPORTED
        else:
            result, replies = execute(message.param1, message.param2)
        ack = dialect.new(
            "COMMAND_ACK",
            command=message.command,
            result=result,
            target_system=frame.system,
            target_component=frame.component,
        )
        return [ack, *replies]

    def _request_message(self, param1: float, param2: float) -> tuple[Result, list[Message]]:
        source = self._sources.get(_whole(param1))
        if source is None:
            return Result.DENIED, []
        message = source()
        return (Result.FAILED, []) if message is None else (Result.ACCEPTED, [message])

    def _set_message_interval(self, param1: float, param2: float) -> tuple[Result, list[Message]]:
        msgid, wanted = _whole(param1), param2
        if msgid not in self._defaults:
            return Result.DENIED, []
        if wanted == 0:
            self.intervals_us[msgid] = self._defaults[msgid]
        elif wanted == DISABLED:
            self.intervals_us[msgid] = DISABLED
        elif SHORTEST_US <= wanted < 2**31:
            self.intervals_us[msgid] = round(wanted)
        else:
            return Result.DENIED, []
        return Result.ACCEPTED, []

    def _get_message_interval(self, param1: float, param2: float) -> tuple[Result, list[Message]]:
        msgid = _whole(param1)
        if not 0 <= msgid < 1 << 16:  # MESSAGE_INTERVAL cannot name it
            return Result.DENIED, []
        # 0 tells that the message is not to be had, after MESSAGE_INTERVAL's own description
        interval = self.intervals_us.get(msgid, DISABLED if msgid in self._sources else 0)
        return Result.ACCEPTED, [dialect.new("MESSAGE_INTERVAL", message_id=msgid, interval_us=interval)]

    def _request_autopilot_capabilities(self, param1: float, param2: float) -> tuple[Result, list[Message]]:
        return self._request_message(AUTOPILOT_VERSION, 0.0) if param1 == 1 else (Result.DENIED, [])


def _whole(value: float) -> int:
    """A parameter that means an id, -1 where it can mean none."""
    return int(value) if math.isfinite(value) and value == int(value) else -1
