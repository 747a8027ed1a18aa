"""Ground station services: commands, parameters and their metadata, STATUSTEXT, PING, empty mission. No I/O.

`receive` takes the requests of ground stations; the messages from `to_send` go to every link with a peer.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from companion.config import Config, OutputConfig
from companion.config.profiles import RESET
from companion.link import dialect
from companion.link.commands import CommandServer, Source
from companion.link.component_metadata import FileServer, component_metadata
from companion.link.dialect import mavlink
from companion.link.parameter_server import ParameterServer
from companion.link.rate_limiter import RateLimiter
from companion.link.session import MessageReceived
from companion.link.status_text import StatusText
from companion.records import Event

NANO_PER_MICRO = 1000
#: PING answers per second, and at once.
PINGS_HZ, PINGS_BURST = 10.0, 10
#: Interval of a disabled message.
DISABLED_US = -1


def intervals_us(output: OutputConfig) -> dict[str, int]:
    """Return the interval of each message that may be requested, microseconds.

    Excluded are messages that the profile does not send, and the position reset, whose rate is fixed.
    """
    return {
        name: round(1e6 / hz) if hz > 0.0 else DISABLED_US
        for name, hz in output.rates_hz.items()
        if name != RESET and (hz > 0.0 or name == "NAVIGATION_STATUS")
    }


def _by_id(output: OutputConfig) -> dict[int, int]:
    return {dialect.type_named(name).msgid: us for name, us in intervals_us(output).items()}


class GroundStationServices:
    """Command acknowledgement, parameter server and event reports of one component."""

    def __init__(
        self,
        config: Config,
        sources: Mapping[str, Source],
        save: Callable[[str], None],
        base: Config | None = None,
    ) -> None:
        """`save` and `base`: see `ParameterServer`."""
        component = config.link.component_id
        self._component = component
        self._output = config.output
        self._ping_limiter = RateLimiter(PINGS_HZ, PINGS_BURST)
        self._commands = CommandServer(
            component,
            _by_id(config.output),
            {
                dialect.type_named(name).msgid: source
                for name, source in {**sources, "COMPONENT_METADATA": component_metadata}.items()
            },
        )
        self._files = FileServer(component)
        self._parameters = ParameterServer(component, config, base=base, save=save)
        self._status = StatusText()
        #: Period of each enabled message, ns.
        self.periods_ns = self._periods_ns()

    def _periods_ns(self) -> dict[str, int]:
        asked = self._commands.intervals_us.items()
        periods = {dialect.TYPES[msgid].name: us * NANO_PER_MICRO for msgid, us in asked if us > 0}
        if (hz := self._output.rates_hz[RESET]) > 0.0:
            periods[RESET] = round(1e9 / hz)
        return periods

    def receive(self, event: MessageReceived, system: int) -> tuple[list[Any], Config | None]:
        """Process a message; return replies for its link, and the configuration if a parameter changed it."""
        replies = self._commands.receive(event.message, event.frame, system, event.received_ns)
        replies += self._files.receive(event.message, event.frame, system, event.received_ns)
        changes = self._parameters.receive(event.message, event.frame, system, event.received_ns)
        config = changes[-1].config if changes else None
        if (reply := self._answer(event, system)) is not None:
            replies.append(reply)
        if config is not None and config.output != self._output:
            self._output = config.output
            self._commands.set_default_intervals(_by_id(config.output))
        self.periods_ns = self._periods_ns()
        return replies, config

    def _answer(self, event: MessageReceived, system: int) -> Any:
        """Return the answer to a PING, or an empty mission to a request for ours; None for others."""
        message, frame = event.message, event.frame
        target = message.target_system, message.target_component
        sender = {"target_system": frame.system, "target_component": frame.component}
        if frame.msgid == mavlink.MAVLINK_MSG_ID_PING and target == (0, 0):  # with a target it is an answer
            if self._ping_limiter.take(event.received_ns):
                return dialect.new("PING", time_usec=message.time_usec, seq=message.seq, **sender)
        elif frame.msgid == mavlink.MAVLINK_MSG_ID_MISSION_REQUEST_LIST and target == (
            system,
            self._component,
        ):
            return dialect.new("MISSION_COUNT", count=0, mission_type=message.mission_type, **sender)
        return None

    def report(self, event: Event, now_ns: int) -> None:
        """Queue an event for STATUSTEXT, subject to its rate limit."""
        self._status.add(event, now_ns)

    def to_send(self, now_ns: int) -> list[Any]:
        """Return the messages that are due, for every link."""
        return [*self._parameters.to_send(now_ns), *self._status.to_send(now_ns)]

    def deadline(self) -> int | None:
        """Return when `to_send` must be called next, None if only after new input."""
        due = [at for at in (self._parameters.deadline(), self._status.deadline()) if at is not None]
        return min(due, default=None)
