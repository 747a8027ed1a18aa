"""Parameters of the simulated autopilot: those for external positions, and the one that switches GNSS.

The parameter protocol follows the make: integers cast to float (ArduPilot) or sent bytewise (PX4). A request
for an unknown parameter is not answered. Except for the GNSS switch, parameters do not affect the flight.
"""

from __future__ import annotations

import struct
from typing import Any

from companion.link import dialect
from companion.link.dialect import mavlink
from companion.link.parameter_client import Encoding, Value, to_value, to_wire

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
_PX4: dict[str, Value] = {
    "EKF2_AGP0_ID": 0,
    "EKF2_AGP0_CTRL": 0,
    "EKF2_EV_CTRL": 0,
    "COM_POS_LOW_EPH": 50,
    "SIM_GPS_USED": 10,
}
SATELLITES_OF_A_FIX = 4
_COMMON = mavlink.MAV_PROTOCOL_CAPABILITY_COMMAND_INT | mavlink.MAV_PROTOCOL_CAPABILITY_MAVLINK2
#: AUTOPILOT_VERSION.capabilities by make.
CAPABILITIES = {
    "ardupilot": _COMMON | mavlink.MAV_PROTOCOL_CAPABILITY_PARAM_ENCODE_C_CAST,
    "px4": _COMMON | mavlink.MAV_PROTOCOL_CAPABILITY_PARAM_ENCODE_BYTEWISE,
}
FIRMWARE = (4, 7)  # of ArduPilot
VERSIONS = {"ardupilot": FIRMWARE[0] << 24 | FIRMWARE[1] << 16, "px4": 1 << 24 | 17 << 16}


class SimulatedParameters:
    """Parameter values of an autopilot of this make ("ardupilot" or "px4"); not prepared for our position."""

    def __init__(self, make: str) -> None:
        self.values = dict(_PX4 if make == "px4" else _ARDUPILOT)
        self._encoding: Encoding = "bytewise" if make == "px4" else "cast"
        self._kind = mavlink.MAV_PARAM_TYPE_INT32 if make == "px4" else mavlink.MAV_PARAM_TYPE_INT8

    @property
    def gnss_is_on(self) -> bool:
        """Whether the parameters let the simulated receiver have a fix."""
        used = self.values.get("SIM_GPS_USED")
        return bool(self.values["SIM_GPS1_ENABLE"]) if used is None else used >= SATELLITES_OF_A_FIX

    def read(self, message: Any) -> Any:
        """Answer a PARAM_REQUEST_READ; None for an unknown parameter."""
        names = list(self.values)
        name = names[message.param_index] if 0 <= message.param_index < len(names) else message.param_id
        return self._value(name) if name in self.values else None

    def set(self, message: Any) -> Any:
        """Set a value by PARAM_SET and return the answer; None for an unknown parameter."""
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
