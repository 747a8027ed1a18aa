"""What goes into an autopilot's estimator, and what is kept from it. Sans-IO: solutions in, messages out.

Here the gate, the two commands with rules of their own (`resetting`, `switching`) and the encoders meet. What
the autopilot says is heard for what it is asked, and never for a position: that comes from solutions alone.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection

from companion.config import Config
from companion.config.profiles import MESSAGES, RESET
from companion.link.dialect import Message
from companion.output.encode import MAV_CMD_EXTERNAL_POSITION_ESTIMATE, Receiver, Unsent, encode
from companion.output.gate import Gate, Position, Withheld
from companion.output.position_reset import Resetting
from companion.output.source_switch import Switching
from companion.records import Event, FilterStatus, GlobalPosition, Gnss, Solution, Source, Stamped, SystemTime

CALLED = {RESET: "external position"}
ON_SOURCE_SET_2 = frozenset({MESSAGES["odometry"], MESSAGES["vision"]})


class Feed:
    """That of one link's autopilot: what it was sent last, and what it said of its GPS and its time."""

    def __init__(self, config: Config) -> None:
        self.config = config
        self.unix_ns: int | None = None
        self._gate, self._withheld = Gate(), Withheld()
        self._resetting, self._switching = Resetting(), Switching()
        self._events: list[Event] = []

    @property
    def withheld(self) -> Counter[tuple[str, str]]:
        """How often each message was withheld, by its name and the reason."""
        return self._withheld.counts

    def heard(self, record: Stamped) -> None:
        """A record of the autopilot's."""
        if isinstance(record, SystemTime):
            if record.unix_ns is not None:
                self.unix_ns = record.unix_ns - record.t_ns
        elif isinstance(record, Gnss | GlobalPosition | FilterStatus):
            self._resetting.heard(record)

    def rebooted(self) -> None:
        """The autopilot began anew."""
        self._resetting, self._switching = Resetting(), Switching()

    def acknowledged(self, command: int, result: int, now_ns: int) -> None:
        """The autopilot's answer to a command of ours."""
        self._switching.acknowledged(command, result, now_ns)
        if command == MAV_CMD_EXTERNAL_POSITION_ESTIMATE:
            self._tell(self._resetting.acknowledged(result, now_ns))

    def messages(self, solution: Solution, names: Collection[str], receiver: Receiver) -> list[Message]:
        """What it is to be sent for `solution`, of the messages `names`, and what it is to be told to do."""
        now = solution.rx_ns
        position, made = self._gate.admit(solution), dict[str, Message]()
        for name in names:
            reason = position if isinstance(position, str) else self._forbids(position, name, receiver)
            if isinstance(position, Position) and reason is None:
                try:
                    made[name] = encode(position, receiver, name)
                except Unsent as unsent:
                    reason = str(unsent)
            self._tell(self._withheld.note(CALLED.get(name, name), reason, now))
        if self.config.output.switches_sources and (by_set := ON_SOURCE_SET_2.intersection(names)):
            self._switching.update(bool(solution.sources & Source.GNSS), not by_set.isdisjoint(made), now)
            return [*made.values(), *self._switching.to_send(receiver.system, now)]
        return list(made.values())

    def take_events(self) -> list[Event]:
        """What is to be told since this was last asked."""
        taken, self._events = [*self._events, *self._switching.take_events()], []
        return taken

    def _forbids(self, position: Position, name: str, receiver: Receiver) -> str | None:
        profile = self.config.output.profile
        if profile not in ("custom", receiver.autopilot):
            return f"the autopilot heard is no {profile}: set output.profile"
        return self._resetting.forbids(position) if name == RESET else None

    def _tell(self, event: Event | None) -> None:
        if event is not None:
            self._events.append(event)
