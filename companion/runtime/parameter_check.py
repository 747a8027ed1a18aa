"""One line at the start of a flight where the autopilot lacks what the output profile needs. Sans-IO.

ArduPilot drops an ODOMETRY that it is not set up for without a word; so the parameters are read whenever the
autopilot comes or has rebooted, and what is wrong is told once. Nothing is set here: that is for
`companion doctor`, on the ground.
"""

from __future__ import annotations

from companion.config import Config
from companion.config.profiles import Needed
from companion.config.required_parameters import needed
from companion.link.decode import MAKES
from companion.link.dialect import Message
from companion.link.frame import Frame
from companion.link.parameter_client import Answer, ParameterClient, encoding_of, same
from companion.link.session import AUTOPILOT_COMPONENT
from companion.records import Event


class Checkup:
    """That of one link's autopilot."""

    def __init__(self) -> None:
        self._client: ParameterClient | None = None
        self._needed: tuple[Needed, ...] = ()
        self._answers: dict[str, Answer] = {}

    def begin(self, config: Config, system: int, make: int) -> None:
        """Look at the autopilot (`make` is MAV_AUTOPILOT) now."""
        self._needed, self._answers = needed(config, MAKES.get(make)), {}
        if config.output.profile in ("custom", MAKES.get(make)) and self._needed:
            self._client = ParameterClient(system, AUTOPILOT_COMPONENT, encoding_of(None, make))
            self._client.read(need.name for need in self._needed)

    def receive(self, message: Message, frame: Frame) -> None:
        """A message of the autopilot's."""
        if self._client is not None:
            self._answers |= {answer.name: answer for answer in self._client.receive(message, frame)}

    def poll(self, now_ns: int) -> list[Event]:
        """Ask what is due; what is to be told once all was answered."""
        if self._client is None:
            return []
        self._answers |= {answer.name: answer for answer in self._client.poll(now_ns)}
        if not self._client.is_idle:
            return []
        self._client = None
        wrong = [need for need in self._needed if not same(self._answers[need.name].value, need.value)]
        if not wrong:
            return []
        has = self._answers[wrong[0].name].value
        more = f" and {len(wrong) - 1} more" if wrong[1:] else ""
        state = "is not told" if has is None else f"is {has:g}"
        text = f"{wrong[0].name} {state}, needs {wrong[0].value:g}{more}: see companion doctor"
        return [Event(now_ns, now_ns, 4, text)]

    def to_send(self) -> list[Message]:
        """The messages to be sent now."""
        return self._client.to_send() if self._client is not None else []
