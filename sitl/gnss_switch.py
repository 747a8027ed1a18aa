"""GNSS switch of a simulated autopilot by its simulation parameter. Sans-IO.

    switch.request(on=False)                    # at once if the parameter is known, else once it is found
    lines = switch.receive(message, frame)      # messages from the autopilot
    lines = switch.poll(now_ns)                 # no later than switch.deadline()
    for message in switch.to_send(): ...        # after any of them

The parameter depends on make and version, so all candidates are requested and the first one that is answered
is used. Observed: SIM_GPS1_ENABLE (ArduPlane 4.7) and SIM_GPS_USED (PX4 of 2026: number of satellites, four
give a fix). SIM_GPS_DISABLE (older ArduPilots) is taken from their source code. ArduPilot stores parameters:
GNSS that was switched off has to be switched on again before the end.
"""

from __future__ import annotations

from typing import NamedTuple

from companion.link.dialect import Message, mavlink
from companion.link.frame import Frame
from companion.link.parameter_client import Answer, ParameterClient, Value, encoding_of

MAV_AUTOPILOT = {"ardupilot": mavlink.MAV_AUTOPILOT_ARDUPILOTMEGA, "px4": mavlink.MAV_AUTOPILOT_PX4}


class GnssParameter(NamedTuple):
    """Parameter that switches GNSS; `on` is used where no other "on" value was read from the autopilot."""

    name: str
    on: Value
    off: Value


GNSS_PARAMETERS: dict[str, tuple[GnssParameter, ...]] = {
    "ardupilot": (GnssParameter("SIM_GPS1_ENABLE", 1, 0), GnssParameter("SIM_GPS_DISABLE", 0, 1)),
    "px4": (GnssParameter("SIM_GPS_USED", 10, 0),),
}


class GnssSwitch:
    """GNSS switch of the autopilot `system` of this make ("ardupilot" or "px4")."""

    def __init__(self, make: str, system: int) -> None:
        self._candidates = {parameter.name: parameter for parameter in GNSS_PARAMETERS[make]}
        self._parameter: GnssParameter | None = None
        self._requested: bool | None = None
        self._client = ParameterClient(
            system, mavlink.MAV_COMP_ID_AUTOPILOT1, encoding_of(None, MAV_AUTOPILOT[make])
        )
        self._client.read(self._candidates)

    @property
    def is_off(self) -> bool:
        """Whether the last request was to switch GNSS off."""
        return self._requested is False

    def request(self, on: bool) -> None:
        """Switch GNSS on or off."""
        self._requested = on
        if self._parameter is not None:
            self._client.set(self._parameter.name, self._parameter.on if on else self._parameter.off)

    def receive(self, message: Message, frame: Frame) -> list[str]:
        """Handle a message of the autopilot; return lines for the user."""
        return [line for answer in self._client.receive(message, frame) for line in self._on_answer(answer)]

    def poll(self, now_ns: int) -> list[str]:
        """Do what is due; return lines for the user."""
        return [line for answer in self._client.poll(now_ns) for line in self._on_answer(answer)]

    def to_send(self) -> list[Message]:
        """Return the messages to send now."""
        return self._client.to_send()

    def deadline(self) -> int | None:
        """Return the latest time for the next `poll`."""
        return self._client.deadline()

    def _on_answer(self, answer: Answer) -> list[str]:
        if self._parameter is None:
            return self._on_probe_answer(answer)
        if answer.name != self._parameter.name or self._requested is None:
            return []
        if answer.trouble:
            return [f"{answer.name} was not set: {answer.trouble}; GNSS is unchanged"]
        return [f"GNSS switched {'on' if self._requested else 'off'}: {answer.name} = {answer.value:g}"]

    def _on_probe_answer(self, answer: Answer) -> list[str]:
        parameter = self._candidates.pop(answer.name)
        if answer.value is not None:
            self._parameter = (
                parameter if answer.value == parameter.off else parameter._replace(on=answer.value)
            )
            if self._requested is not None:
                self.request(self._requested)
            return []
        if self._candidates:
            return []
        return [f"the autopilot has no {answer.name} or similar parameter: GNSS cannot be switched"]
