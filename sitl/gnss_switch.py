"""GNSS of a simulated autopilot, switched by its own simulation parameter. Sans-IO.

    switch.order(on=False)                      # at once if the parameter is known, else when it is
    lines = switch.receive(message, frame)      # what the autopilot says
    lines = switch.poll(now_ns)                 # no later than switch.deadline()
    for message in switch.to_send(): ...        # after any of them

Which parameter there is depends on make and age, so all are asked for and the first that answers is it. Seen
on the wire: SIM_GPS1_ENABLE (ArduPlane 4.7) and SIM_GPS_USED (PX4 of 2026: satellites, four make a fix).
SIM_GPS_DISABLE, of older ArduPilots, is as their sources have it. ArduPilot keeps a parameter over a restart:
what was switched off is to be switched on again before the end.
"""

from __future__ import annotations

from typing import NamedTuple

from companion.link.dialect import Message
from companion.link.frame import Frame
from companion.link.parameter_client import Answer, ParameterClient, Value, encoding_of

MAV_AUTOPILOT = {"ardupilot": 3, "px4": 12}


class Knob(NamedTuple):
    """A parameter, and its values with GNSS on, if nothing else was found there, and off."""

    name: str
    on: Value
    off: Value


KNOBS: dict[str, tuple[Knob, ...]] = {
    "ardupilot": (Knob("SIM_GPS1_ENABLE", 1, 0), Knob("SIM_GPS_DISABLE", 0, 1)),
    "px4": (Knob("SIM_GPS_USED", 10, 0),),
}


class GnssSwitch:
    """That of the autopilot `system` of this make ("ardupilot" or "px4")."""

    def __init__(self, make: str, system: int) -> None:
        self._knobs = {knob.name: knob for knob in KNOBS[make]}
        self._knob: Knob | None = None
        self._ordered: bool | None = None
        self._client = ParameterClient(system, 1, encoding_of(None, MAV_AUTOPILOT[make]))
        self._client.read(self._knobs)

    @property
    def is_off(self) -> bool:
        """Whether it was ordered off last."""
        return self._ordered is False

    def order(self, on: bool) -> None:
        """Have GNSS on or off."""
        self._ordered = on
        if self._knob is not None:
            self._client.set(self._knob.name, self._knob.on if on else self._knob.off)

    def receive(self, message: Message, frame: Frame) -> list[str]:
        """Take what the autopilot says; lines to tell."""
        return [line for answer in self._client.receive(message, frame) for line in self._take(answer)]

    def poll(self, now_ns: int) -> list[str]:
        """Do what is due; lines to tell."""
        return [line for answer in self._client.poll(now_ns) for line in self._take(answer)]

    def to_send(self) -> list[Message]:
        """The messages to be sent now."""
        return self._client.to_send()

    def deadline(self) -> int | None:
        """When `poll` must be called at the latest."""
        return self._client.deadline()

    def _take(self, answer: Answer) -> list[str]:
        if self._knob is None:
            return self._find(answer)
        if answer.name != self._knob.name or self._ordered is None:
            return []
        if answer.trouble:
            return [f"{answer.name} was not set: {answer.trouble}; GNSS stays as it is"]
        return [f"GNSS switched {'on' if self._ordered else 'off'}: {answer.name} = {answer.value:g}"]

    def _find(self, answer: Answer) -> list[str]:
        knob = self._knobs.pop(answer.name)
        if answer.value is not None:
            self._knob = knob if answer.value == knob.off else knob._replace(on=answer.value)
            if self._ordered is not None:
                self.order(self._ordered)
            return []
        if self._knobs:
            return []
        return [f"the autopilot has no {answer.name} nor one like it: GNSS cannot be switched"]
