"""What others on the link may ask of us: commands, parameters, and the texts we tell. Sans-IO.

Every message heard goes through `receive`; what `to_send` gives is for every link that has a vehicle.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from companion.config import Config, OutputConfig
from companion.config.profiles import RESET
from companion.link import dialect
from companion.link.commands import Commands, Source
from companion.link.parameter_server import Parameters
from companion.link.session import MessageReceived
from companion.link.status_text import StatusText
from companion.records import Event

NANO_PER_MICRO = 1000
#: MAVLink's interval of a message that is not sent.
DISABLED_US = -1


def intervals_us(output: OutputConfig) -> dict[str, int]:
    """The interval of each message that may be asked for, microseconds: not what the profile does not send,
    nor the command that resets a position, which goes out at our pace alone.
    """
    return {
        name: round(1e6 / hz) if hz > 0.0 else DISABLED_US
        for name, hz in output.rates_hz.items()
        if name != RESET and (hz > 0.0 or name == "NAVIGATION_STATUS")
    }


def _by_id(output: OutputConfig) -> dict[int, int]:
    return {dialect.type_named(name).msgid: us for name, us in intervals_us(output).items()}


class Dialogue:
    """One component's side of it: acknowledges commands, keeps the parameters, tells its events."""

    def __init__(
        self,
        config: Config,
        sources: Mapping[str, Source],
        save: Callable[[str], None],
        base: Config | None = None,
    ) -> None:
        """`save` and `base`: see `Parameters`."""
        component = config.link.component_id
        self._output = config.output
        self._commands = Commands(
            component,
            _by_id(config.output),
            {dialect.type_named(name).msgid: source for name, source in sources.items()},
        )
        self._parameters = Parameters(component, config, base=base, save=save)
        self._status = StatusText()
        #: How often each message is to go out now; what is disabled is left out.
        self.periods_ns = self._periods_ns()

    def _periods_ns(self) -> dict[str, int]:
        asked = self._commands.intervals_us.items()
        periods = {dialect.TYPES[msgid].name: us * NANO_PER_MICRO for msgid, us in asked if us > 0}
        if (hz := self._output.rates_hz[RESET]) > 0.0:
            periods[RESET] = round(1e9 / hz)
        return periods

    def receive(self, event: MessageReceived, system: int) -> tuple[list[Any], Config | None]:
        """Replies for the link it came on, and the configuration where a parameter changed it."""
        replies = self._commands.receive(event.message, event.frame, system, event.received_ns)
        changes = self._parameters.receive(event.message, event.frame, system, event.received_ns)
        config = changes[-1].config if changes else None
        if config is not None and config.output != self._output:
            self._output = config.output
            self._commands.pace(_by_id(config.output))
        self.periods_ns = self._periods_ns()
        return replies, config

    def tell(self, event: Event, now_ns: int) -> None:
        """Have a change of state told as STATUSTEXT, as often as may be."""
        self._status.tell(event, now_ns)

    def to_send(self, now_ns: int) -> list[Any]:
        """Messages for every link."""
        return [*self._parameters.to_send(now_ns), *self._status.to_send(now_ns)]

    def deadline(self) -> int | None:
        """When `to_send` is next worth calling without news."""
        due = [at for at in (self._parameters.deadline(), self._status.deadline()) if at is not None]
        return min(due, default=None)
