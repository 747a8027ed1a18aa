"""Output profiles: table of the position messages, rates and parameters of each make of autopilot.

Measured on ArduPlane 4.7 (EKF3) and PX4 of 2026 (EKF2, fixed wing).

    monitor    NAVIGATION_STATUS only; nothing that an estimator could use
    ardupilot  ODOMETRY on source set 2; alternatives: VISION_POSITION_ESTIMATE, GPS_INPUT, or the command
               MAV_CMD_EXTERNAL_POSITION_ESTIMATE, which needs no parameters
    px4        GLOBAL_POSITION_SENSOR; alternatives: ODOMETRY, VISION_POSITION_ESTIMATE, the command
    custom     exactly the rates in the configuration

Message fields and frames belong to `output.encode`; reading and setting parameters to `link`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Literal, NamedTuple, TypeAlias

Name: TypeAlias = Literal["monitor", "ardupilot", "px4", "custom"]
Via: TypeAlias = Literal["odometry", "vision", "gps_input", "global_position_sensor", "external_position"]

MESSAGES: Mapping[Via, str] = {
    "odometry": "ODOMETRY",
    "vision": "VISION_POSITION_ESTIMATE",
    "gps_input": "GPS_INPUT",
    "global_position_sensor": "GLOBAL_POSITION_SENSOR",
    "external_position": "COMMAND_INT",  # MAV_CMD_EXTERNAL_POSITION_ESTIMATE
}
"""The messages that carry a position into the autopilot's estimator."""
RESET = MESSAGES["external_position"]


class RequiredParameter(NamedTuple):
    """Autopilot parameter: required value, reason, and whether it takes effect only after a reboot."""

    name: str
    value: float
    why: str
    reboot: bool = False


class FailsafeLimit(NamedTuple):
    """Limit of an autopilot's failsafe: the least value with which it flies on by our position (-1: none),
    what it does by another, whether it has it while it hovers only, and whether 0 means none too. The user
    decides on it.
    """

    name: str
    value: float
    otherwise: str
    hovering: bool = False
    zero_is_none: bool = False

    def is_met(self, has: float) -> bool:
        """Whether the autopilot's value lets it fly on."""
        if self.value < 0.0:
            return has < 0.0 or (has == 0.0 and self.zero_is_none)
        return has >= self.value


class OutputMethod(NamedTuple):
    """Message by which an autopilot accepts a position: its rate and the parameters it requires."""

    rate_hz: float
    parameters: tuple[RequiredParameter, ...] = ()


class Profile(NamedTuple):
    """Output methods of one make of autopilot, the best first, and limits of its failsafe.

    `switched` has the messages beside which its sources are switched, as it fuses them in the place of GNSS.
    """

    methods: Mapping[Via, OutputMethod]
    failsafe: tuple[FailsafeLimit, ...] = ()
    switched: frozenset[str] = frozenset()


_EXTERNAL = frozenset({MESSAGES["odometry"], MESSAGES["vision"]})
_EXTERNAL_NAVIGATION = (
    RequiredParameter("VISO_TYPE", 1, "accept external navigation positions over MAVLink", reboot=True),
    RequiredParameter("EK3_SRC2_POSXY", 6, "source set 2: horizontal position from external navigation"),
    RequiredParameter("EK3_SRC2_VELXY", 0, "source set 2: no horizontal velocity, none is sent"),
    RequiredParameter("EK3_SRC2_POSZ", 1, "source set 2: height from the barometer, as in set 1"),
    RequiredParameter("EK3_SRC2_VELZ", 0, "source set 2: no vertical velocity, none is sent"),
    RequiredParameter("EK3_SRC2_YAW", 1, "source set 2: heading from the compass, none is sent"),
)
TAKES_POSITION: Mapping[str, Callable[[float], bool]] = {
    "VISO_TYPE": lambda value: value != 0.0,
    "EK3_SRC2_POSXY": lambda value: value == 6.0,
}
"""Whether source set 2 has our position by the value of a parameter; it leads without any otherwise."""
_SECOND_RECEIVER = (
    RequiredParameter("GPS2_TYPE", 14, "the second receiver is GPS_INPUT", reboot=True),
    RequiredParameter("GPS_AUTO_SWITCH", 1, "use the better receiver, so ours when the first loses its fix"),
    RequiredParameter(
        "EK3_GPS_CHECK", 23, "do not fall back to DCM when the stated accuracy is worse than 7.5 m"
    ),
)
_EXTERNAL_VISION = (
    RequiredParameter("EKF2_EV_CTRL", 1, "fuse only the horizontal position of external vision"),
)
AGP_ID = "EKF2_AGP0_ID"
_AUXILIARY_POSITION = (
    RequiredParameter(AGP_ID, 1, "the `id` of our GLOBAL_POSITION_SENSOR", reboot=True),
    RequiredParameter("EKF2_AGP0_CTRL", 1, "fuse its horizontal position", reboot=True),
)
_PX4_FAILSAFE = (
    FailsafeLimit(
        "COM_POS_LOW_EPH",
        -1.0,
        "{} m: COM_POS_LOW_ACT (3: it returns home) once its own accuracy is worse",
        zero_is_none=True,
    ),
    FailsafeLimit(
        "COM_POS_FS_EPH", -1.0, "{} m: hovering it lands once its own accuracy is 2.5 times worse", True
    ),
    FailsafeLimit(
        "EKF2_NOAID_TOUT", 1e7, "{} us: hovering it descends when no position comes for so long", True
    ),
)

PROFILES: Mapping[Name, Profile] = {
    "monitor": Profile({}),
    "ardupilot": Profile(
        {
            "odometry": OutputMethod(10.0, _EXTERNAL_NAVIGATION),  # below about 4 Hz it cannot arm
            "vision": OutputMethod(10.0, _EXTERNAL_NAVIGATION),
            "gps_input": OutputMethod(10.0, _SECOND_RECEIVER),  # below 5 Hz it cannot arm
            "external_position": OutputMethod(1.0),
        },
        switched=_EXTERNAL,
    ),
    "px4": Profile(
        {
            "global_position_sensor": OutputMethod(2.0, _AUXILIARY_POSITION),
            "odometry": OutputMethod(10.0, _EXTERNAL_VISION),  # starts under 200 ms apart, stops at 400 ms
            "vision": OutputMethod(10.0, _EXTERNAL_VISION),
            "external_position": OutputMethod(0.5),
        },
        _PX4_FAILSAFE,
        _EXTERNAL | {MESSAGES["global_position_sensor"]},
    ),
    "custom": Profile({}),
}
