"""Parameter check: the autopilot parameters that the output profile requires. No I/O.

ArduPilot silently drops an ODOMETRY that it is not configured for, and accepts source set 2 all the same. So
the parameters are read whenever the autopilot connects or reboots, and wrong ones are reported in one event.
Those that set 2 needs are followed when they change later. Nothing is set here; use `companion doctor` on the
ground.
"""

from __future__ import annotations

from companion.config import Config
from companion.config.profiles import TAKES_POSITION, RequiredParameter
from companion.config.required_parameters import required_parameters
from companion.link.decode import MAKES
from companion.link.dialect import Message, mavlink
from companion.link.frame import Frame
from companion.link.parameter_client import Answer, ParameterClient, encoding_of, equal_real32
from companion.records import Event, Severity


class ParameterCheck:
    """Parameter check of the autopilot."""

    def __init__(self) -> None:
        self._client: ParameterClient | None = None
        self._needed: tuple[RequiredParameter, ...] = ()
        self._answers: dict[str, Answer] = {}

    def start(self, config: Config, system: int, make: int) -> None:
        """Start reading the parameters; `make` is MAV_AUTOPILOT."""
        self._client = None  # of the make before
        self._needed, self._answers = required_parameters(config, MAKES.get(make)), {}
        if config.output.fits(MAKES.get(make, "other")) and self._needed:
            self._client = ParameterClient(system, mavlink.MAV_COMP_ID_AUTOPILOT1, encoding_of(None, make))
            self._client.read(need.name for need in self._needed)

    def receive(self, message: Message, frame: Frame) -> None:
        """Process a message from the autopilot."""
        if self._client is not None:
            self._answers |= {answer.name: answer for answer in self._client.receive(message, frame)}
        elif message.get_type() == "PARAM_VALUE":
            self._follow(message.param_id, message.param_value)

    def poll(self, now_ns: int) -> list[Event]:
        """Make the requests that are due; return an event once all parameters are read."""
        if self._client is None:
            return []
        self._answers |= {answer.name: answer for answer in self._client.poll(now_ns)}
        if not self._client.is_idle:
            return []
        self._client = None
        wrong = [
            need for need in self._needed if not equal_real32(self._answers[need.name].value, need.value)
        ]
        if not wrong:
            return []
        _, has, trouble = self._answers[wrong[0].name]
        more = f" and {len(wrong) - 1} more" if wrong[1:] else ""
        state = f"cannot be read ({trouble})" if has is None else f"is {has:g}"
        text = f"{wrong[0].name} {state}, needs {wrong[0].value:g}{more}: run companion doctor"
        return [Event(now_ns, now_ns, Severity.WARNING, text)]

    @property
    def lack(self) -> str:
        """Why source set 2 of ArduPilot has no position of ours; empty if it has, or that is not known."""
        for name, takes in TAKES_POSITION.items():
            answer = self._answers.get(name)
            if answer is not None and answer.value is not None and not takes(answer.value):
                return f"{name} is {answer.value:g}"
        return ""

    def _follow(self, name: str, value: float) -> None:
        """Note the value of a parameter that changed; one that needs a reboot gives a position after that."""
        need = next((each for each in self._needed if each.name == name), None)
        if need is None or (takes := TAKES_POSITION.get(name)) is None:
            return
        if not (need.reboot and takes(value)):
            self._answers[name] = Answer(name, value)

    def to_send(self) -> list[Message]:
        """Return the messages to be sent now."""
        return self._client.to_send() if self._client is not None else []
