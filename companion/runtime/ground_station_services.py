"""Ground station services: commands, parameters and their metadata, STATUSTEXT, PING, empty mission. No I/O.

`receive` takes the requests of ground stations; the messages from `to_send` go to every link with a peer.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from companion.config import Config, OutputConfig
from companion.config.profiles import RESET
from companion.link import dialect
from companion.link.commands import DISABLED, CommandServer, Source
from companion.link.component_metadata import FileServer, component_metadata
from companion.link.dialect import mavlink
from companion.link.parameter_server import ParameterChanged, ParameterServer
from companion.link.rate_limiter import RateLimiter
from companion.link.session import MessageReceived
from companion.link.status_text import StatusText
from companion.records import Event

NANO_PER_MICRO = 1000
#: PING answers per second, and at once.
PINGS_HZ, PINGS_BURST = 10.0, 10
STATUS = "NAVIGATION_STATUS"
NAMED_VALUES_US = 1_000_000


def feed_periods_ns(output: OutputConfig) -> dict[str, int]:
    """Return the period of each message that the autopilot is fed, ns."""
    return {name: round(1e9 / hz) for name, hz in output.rates_hz.items() if hz > 0.0 and name != STATUS}


def _fed_us(output: OutputConfig) -> dict[int, int]:
    """Intervals of these messages by id, us; the position reset is a command and has none."""
    return {
        dialect.type_named(name).msgid: ns // NANO_PER_MICRO
        for name, ns in feed_periods_ns(output).items()
        if name != RESET
    }


def _offered_us(output: OutputConfig) -> dict[int, int]:
    """Default interval of each message that a link may ask for: the status, and copies of what is fed."""
    hz = output.rates_hz[STATUS]
    status = round(1e6 / hz) if hz > 0.0 else DISABLED
    return {**dict.fromkeys(_fed_us(output), DISABLED), dialect.type_named(STATUS).msgid: status}


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
        self._sources = {
            dialect.type_named(name).msgid: source
            for name, source in {**sources, "COMPONENT_METADATA": component_metadata}.items()
        }
        self._commands: dict[str, CommandServer] = {}  # by link
        self._files = FileServer(component)
        self._parameters = ParameterServer(component, config, base=base, save=save)
        self._status = StatusText()

    def _server(self, link: str) -> CommandServer:
        if link not in self._commands:
            offered = _offered_us(self._output)
            self._commands[link] = CommandServer(self._component, offered, self._sources)
        return self._commands[link]

    def streams_ns(self, link: str) -> dict[str, int]:
        """Return the period of each message that goes to a link besides what its autopilot is fed, ns."""
        asked = self._server(link).intervals_us.items()
        return {dialect.TYPES[msgid].name: us * NANO_PER_MICRO for msgid, us in asked if us > 0}

    def receive(
        self, event: MessageReceived, system: int, link: str, is_fed: bool
    ) -> tuple[list[Any], list[ParameterChanged]]:
        """Process a message; return replies for its link, and the parameters that it changed.

        `is_fed`: the link has the autopilot that is fed.
        """
        fixed = _fed_us(self._output) if is_fed else {}
        if self._output.status_hz > 0.0:
            fixed[mavlink.MAVLINK_MSG_ID_NAMED_VALUE_FLOAT] = NAMED_VALUES_US
        server = self._server(link)
        replies = server.receive(event.message, event.frame, system, event.received_ns, fixed)
        replies += self._files.receive(event.message, event.frame, system, event.received_ns)
        changes = self._parameters.receive(event.message, event.frame, system, event.received_ns)
        if (reply := self._answer(event, system)) is not None:
            replies.append(reply)
        if changes and (output := changes[-1].config.output) != self._output:
            self._output = output
            for server in self._commands.values():
                server.set_default_intervals(_offered_us(output))
        return replies, changes

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
