"""Output profiles: by which message each make of autopilot takes a position, how often, and the parameters
that it must have for that. A table, measured on ArduPlane 4.7 (EKF3) and PX4 of 2026 (EKF2, fixed wing).

    monitor    looks: NAVIGATION_STATUS goes out, and nothing that an estimator could take in
    ardupilot  ODOMETRY on source set 2; VISION_POSITION_ESTIMATE, GPS_INPUT, or the command that needs no
               parameters in its place
    px4        GLOBAL_POSITION_SENSOR; ODOMETRY, VISION_POSITION_ESTIMATE or the command in its place
    custom     exactly the rates written in the configuration

It knows nothing of fields and frames (`wire.encode`), nor how a parameter is read or set.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Literal, NamedTuple, TypeAlias

Name: TypeAlias = Literal["monitor", "ardupilot", "px4", "custom"]
Via: TypeAlias = Literal["odometry", "vision", "gps_input", "global_position_sensor", "external_position"]

MESSAGES: Mapping[Via, str] = {
    "odometry": "ODOMETRY",
    "vision": "VISION_POSITION_ESTIMATE",
    "gps_input": "GPS_INPUT",
    "global_position_sensor": "GLOBAL_POSITION_SENSOR",
    "external_position": "COMMAND_INT",  # of MAV_CMD_EXTERNAL_POSITION_ESTIMATE
}
"""What carries a position into an autopilot's estimator; NAVIGATION_STATUS is for people."""
RESET = MESSAGES["external_position"]


class Needed(NamedTuple):
    """A parameter that the autopilot must have, its exact value, what for, and whether it counts only after
    a reboot."""

    name: str
    value: float
    why: str
    reboot: bool = False


class Way(NamedTuple):
    """One message that an autopilot takes a position by: how often it wants it, and what it needs for it."""

    rate_hz: float
    parameters: tuple[Needed, ...] = ()


class Profile(NamedTuple):
    """What goes to one make of autopilot: its ways, the best first."""

    ways: Mapping[Via, Way]


_EXTERNAL_NAVIGATION = (
    Needed("VISO_TYPE", 1, "take positions of an external navigation system from MAVLink", reboot=True),
    Needed("EK3_SRC2_POSXY", 6, "source set 2: horizontal position from external navigation"),
    Needed("EK3_SRC2_VELXY", 0, "source set 2: no horizontal velocity, we send none"),
    Needed("EK3_SRC2_POSZ", 1, "source set 2: height from the barometer, as in set 1"),
    Needed("EK3_SRC2_VELZ", 0, "source set 2: no vertical velocity, we send none"),
    Needed("EK3_SRC2_YAW", 1, "source set 2: heading from the compass, we send none"),
)
_SECOND_RECEIVER = (
    Needed("GPS2_TYPE", 14, "the second receiver is GPS_INPUT", reboot=True),
    Needed("GPS_AUTO_SWITCH", 1, "take the better receiver, so ours when the first loses its fix"),
    Needed("EK3_GPS_CHECK", 23, "do not drop to DCM for an honest accuracy worse than 7.5 m"),
)
_EXTERNAL_VISION = (Needed("EKF2_EV_CTRL", 1, "fuse the horizontal position of external vision, no more"),)
AGP_ID = "EKF2_AGP0_ID"
_AUXILIARY_POSITION = (
    Needed(AGP_ID, 1, "the `id` of our GLOBAL_POSITION_SENSOR", reboot=True),
    Needed("EKF2_AGP0_CTRL", 1, "fuse its horizontal position", reboot=True),
)

PROFILES: Mapping[Name, Profile] = {
    "monitor": Profile({}),
    "ardupilot": Profile(
        {
            "odometry": Way(10.0, _EXTERNAL_NAVIGATION),  # below about 4 Hz it cannot arm
            "vision": Way(10.0, _EXTERNAL_NAVIGATION),
            "gps_input": Way(10.0, _SECOND_RECEIVER),  # below 5 Hz it cannot arm
            "external_position": Way(1.0),
        }
    ),
    "px4": Profile(
        {
            "global_position_sensor": Way(2.0, _AUXILIARY_POSITION),
            "odometry": Way(10.0, _EXTERNAL_VISION),  # starts under 200 ms apart, stops at 400 ms
            "vision": Way(10.0, _EXTERNAL_VISION),
            "external_position": Way(0.5),
        }
    ),
    "custom": Profile({}),
}
