"""Decoder of the companion's position messages: the inverse of `companion.output.encode`.

Covers every message that carries a position to an estimator, with its stated accuracy. Times are the
sender's.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from companion.config.profiles import MESSAGES
from companion.link import dialect
from companion.link.dialect import mavlink
from companion.nav.geometry import Geodetic, local_to_geodetic
from companion.output.encode import GPS_LAG_NS
from companion.records import LocalOrigin

ROOT_OF_SUM = (4, 7)
"""First ArduPilot that reads sqrt(c0 + c6 + c11) as the position error; before, cbrt(c0^2 + c6^2 + c11^2)."""
POSITION_MESSAGES = frozenset(dialect.type_named(name).msgid for name in MESSAGES.values())


class ReportedPosition(NamedTuple):
    """Position decoded from a message.

    `sigma` is one sigma, m (None: not stated); `stamp_ns` the sender's time of sending, ns (0: not given);
    `age_ns` the age of the position at sending.
    """

    stamp_ns: int
    place: Geodetic
    sigma: float | None
    age_ns: int = 0


def position_of(
    message: Any, origin: LocalOrigin | None, make: str, version: tuple[int, int] = ROOT_OF_SUM
) -> ReportedPosition | None:
    """Decode a message of `POSITION_MESSAGES` as an autopilot of this make would; None without a position.

    A local position needs the autopilot's `origin`; its accuracy is read as by this `version` of ArduPilot.
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
        return ReportedPosition(stamp * 1000, place, _sigma(covariance, make, version))
    if name == "COMMAND_INT":
        if message.command != mavlink.MAV_CMD_EXTERNAL_POSITION_ESTIMATE:
            return None
        # the time of sending is a single-precision float: the arrival time is more accurate
        return ReportedPosition(
            0, _geodetic(message.x, message.y, 0.0), message.param3, round(message.param2 * 1e9)
        )
    if name == "GPS_INPUT":
        place = _geodetic(message.lat, message.lon, message.alt)
        return ReportedPosition(message.time_usec * 1000, place, message.horiz_accuracy, GPS_LAG_NS)
    return ReportedPosition(
        message.time_usec * 1000, _geodetic(message.lat, message.lon, message.alt), message.eph
    )


def affects_estimator(message: Any) -> bool:
    """Whether a message affects the estimator, by a position or by selecting sources."""
    if message.get_type() in ("COMMAND_INT", "COMMAND_LONG"):
        return message.command in (
            mavlink.MAV_CMD_EXTERNAL_POSITION_ESTIMATE,
            mavlink.MAV_CMD_SET_EKF_SOURCE_SET,
        )
    return dialect.id_of(message) in POSITION_MESSAGES


def _geodetic(lat: int, lon: int, alt: float) -> Geodetic:
    return Geodetic(math.radians(lat * 1e-7), math.radians(lon * 1e-7), alt)


def _sigma(covariance: list[float], make: str, version: tuple[int, int]) -> float | None:
    """Horizontal sigma, m: ArduPilot reads one for all axes, others the variances."""
    c0, c6, c11 = covariance[0], covariance[6], covariance[11]
    if not all(map(math.isfinite, (c0, c6, c11))):
        return None
    if make != "ardupilot":
        return math.sqrt(max(c0, c6, 0.0))
    return math.sqrt(c0 + c6 + c11) if version >= ROOT_OF_SUM else math.cbrt(c0 * c0 + c6 * c6 + c11 * c11)
