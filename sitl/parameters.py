"""The simulated autopilot's parameters: the few that decide whether it takes a position from outside, and the
one by which its simulator switches GNSS.

It answers the parameter protocol as its make does, integers cast to a float (ArduPilot) or as their bytes
(PX4), and of a parameter that it does not have says nothing. They change nothing in the flight.
"""

from __future__ import annotations

import struct
from typing import Any

from companion.link import dialect
from companion.link.parameter_client import Encoding, Value, to_value, to_wire

INT8, INT32 = 2, 6
_ARDUPILOT: dict[str, Value] = {
    "VISO_TYPE": 0,
    "EK3_SRC2_POSXY": 0,
    "EK3_SRC2_VELXY": 0,
    "EK3_SRC2_POSZ": 1,
    "EK3_SRC2_VELZ": 0,
    "EK3_SRC2_YAW": 0,
    "GPS2_TYPE": 0,
    "GPS_AUTO_SWITCH": 1,
    "EK3_GPS_CHECK": 31,
    "SIM_GPS1_ENABLE": 1,
}
_PX4: dict[str, Value] = {"EKF2_AGP0_ID": 0, "EKF2_AGP0_CTRL": 0, "EKF2_EV_CTRL": 0, "SIM_GPS_USED": 10}
SATELLITES_OF_A_FIX = 4
#: AUTOPILOT_VERSION.capabilities: COMMAND_INT, MAVLINK2 and the encoding of parameters.
CAPABILITIES = {"ardupilot": 8 | 8192 | 131072, "px4": 8 | 8192 | 16}
VERSIONS = {"ardupilot": 4 << 24 | 7 << 16, "px4": 1 << 24 | 17 << 16}


class Parameters:
    """The parameters of an autopilot of this make ("ardupilot" or "px4")."""

    def __init__(self, make: str) -> None:
        self.values = dict(_PX4 if make == "px4" else _ARDUPILOT)
        self._encoding: Encoding = "bytewise" if make == "px4" else "cast"
        self._kind = INT32 if make == "px4" else INT8

    @property
    def gnss_is_on(self) -> bool:
        """Whether the simulated receiver may have a fix."""
        used = self.values.get("SIM_GPS_USED")
        return bool(self.values["SIM_GPS1_ENABLE"]) if used is None else used >= SATELLITES_OF_A_FIX

    def read(self, message: Any) -> Any:
        """The answer to a PARAM_REQUEST_READ, None where there is none."""
        names = list(self.values)
        name = names[message.param_index] if 0 <= message.param_index < len(names) else message.param_id
        return self._value(name) if name in self.values else None

    def set(self, message: Any) -> Any:
        """The answer to a PARAM_SET, None where there is none."""
        name = message.param_id
        if name not in self.values:
            return None
        self.values[name] = to_value(struct.pack("<f", message.param_value), self._kind, self._encoding)
        return self._value(name)

    def _value(self, name: str) -> Any:
        return dialect.new(
            "PARAM_VALUE",
            param_id=name,
            param_value=to_wire(self.values[name], self._kind, self._encoding),
            param_type=self._kind,
            param_count=len(self.values),
            param_index=list(self.values).index(name),
        )
