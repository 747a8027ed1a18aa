"""The position that a companion's message means: `wire.encode` and `profiles` read backwards.

By every message that carries a position into an estimator, with the accuracy that it states. It knows no
link, and no time but the sender's.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from companion.config.profiles import MESSAGES
from companion.link import dialect
from companion.nav.geometry import Geodetic, local_to_geodetic
from companion.output.encode import GPS_LAG_NS, MAV_CMD_EXTERNAL_POSITION_ESTIMATE
from companion.records import LocalOrigin

CARRIERS = frozenset(dialect.type_named(name).msgid for name in MESSAGES.values())
SET_SOURCE = 42007  # MAV_CMD_SET_EKF_SOURCE_SET


class Said(NamedTuple):
    """A place, one sigma of it (m, None where none is stated), the sender's time of sending (ns, 0: not told)
    and how much older the place is.
    """

    stamp_ns: int
    place: Geodetic
    sigma: float | None
    age_ns: int = 0


def position_of(message: Any, origin: LocalOrigin | None, make: str) -> Said | None:
    """What a message of `CARRIERS` says to an autopilot of this make, None where it says no position.

    Local metres mean nothing before the autopilot's `origin` is known.
    """
    name = message.get_type()
    if name in ("ODOMETRY", "VISION_POSITION_ESTIMATE"):
        if origin is None:
            return None
        start = Geodetic(origin.lat, origin.lon, origin.alt_msl)
        x_n = np.array([message.x, message.y, message.z])
        if not np.isfinite(x_n).all():
            return None
        place = local_to_geodetic("px4" if make == "px4" else "ardupilot", start, x_n)
        odometry = name == "ODOMETRY"
        covariance = message.pose_covariance if odometry else message.covariance
        stamp = message.time_usec if odometry else message.usec
        return Said(stamp * 1000, place, _sigma(covariance, make))
    if name == "COMMAND_INT":
        if message.command != MAV_CMD_EXTERNAL_POSITION_ESTIMATE:
            return None
        # its time of sending is of single precision: its arrival tells more
        return Said(0, _geodetic(message.x, message.y, 0.0), message.param3, round(message.param2 * 1e9))
    if name == "GPS_INPUT":
        place = _geodetic(message.lat, message.lon, message.alt)
        return Said(message.time_usec * 1000, place, message.horiz_accuracy, GPS_LAG_NS)
    return Said(message.time_usec * 1000, _geodetic(message.lat, message.lon, message.alt), message.eph)


def feeds(message: Any) -> bool:
    """Whether a message would have an effect on an estimator, by its position or by its sources."""
    if message.get_type() in ("COMMAND_INT", "COMMAND_LONG"):
        return message.command in (MAV_CMD_EXTERNAL_POSITION_ESTIMATE, SET_SOURCE)
    return dialect.id_of(message) in CARRIERS


def _geodetic(lat: int, lon: int, alt: float) -> Geodetic:
    return Geodetic(math.radians(lat * 1e-7), math.radians(lon * 1e-7), alt)


def _sigma(covariance: list[float], make: str) -> float | None:
    """ArduPilot reads A = cbrt(c0^2 + c6^2 + c11^2) for all axes; others the variances."""
    c0, c6, c11 = covariance[0], covariance[6], covariance[11]
    if not all(map(math.isfinite, (c0, c6, c11))):
        return None
    if make == "ardupilot":
        return math.cbrt(c0 * c0 + c6 * c6 + c11 * c11)
    return math.sqrt(max(c0, c6, 0.0))
