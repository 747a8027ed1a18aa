"""Numbers out of a message's fields, absence in all its spellings understood. Pure.

Each function returns SI units and radians, `None` where a field may be absent, and raises `Refused` where
it may not. It knows no message and no record.
"""

from __future__ import annotations

import math
from typing import Any, TypeAlias

from companion.records import Vector3

Message: TypeAlias = Any

_DOP_UNKNOWN = 99.0  # NMEA's 99.99 is "none", and no fix is made at such a geometry


class Refused(ValueError):
    """A field that makes the message unusable; becomes a Rejection."""

    def __init__(self, reason: str, value: float | None = None, limit: float | None = None) -> None:
        super().__init__(reason)
        self.value = value if value is not None and math.isfinite(value) else None
        self.limit = limit


def number(message: Message, field: str, scale: float = 1.0, limit: float = math.inf) -> float:
    """A number that must be there, times `scale`, and then no greater than `limit` by magnitude."""
    value = float(getattr(message, field))
    if not math.isfinite(value):
        raise Refused(f"{field} is {value}")
    if abs(value * scale) > limit:
        raise Refused(f"{field} {value:g} is beyond anything that flies", value * scale, limit)
    return value * scale


def maybe(message: Message, field: str, scale: float = 1.0) -> float | None:
    """A number that may be absent (NaN or infinite), times `scale`."""
    value = float(getattr(message, field))
    return value * scale if math.isfinite(value) else None


def vector(message: Message, fields: str, scale: float = 1.0, limit: float = math.inf) -> Vector3:
    """Three numbers that must be there, as `number` has them, their names in one string."""
    x, y, z = [number(message, field, scale, limit) for field in fields.split()]
    return x, y, z


def maybe_vector(message: Message, fields: str) -> Vector3 | None:
    """Three numbers, absent where one of them is."""
    x, y, z = (float(getattr(message, field)) for field in fields.split())
    return (x, y, z) if math.isfinite(x + y + z) else None


def position(lat: int, lon: int, names: tuple[str, str] = ("lat", "lon")) -> tuple[float, float]:
    """Latitude and longitude, rad, of integers in 1e-7 degrees."""
    for value, limit, name in ((lat, 90.0, names[0]), (lon, 180.0, names[1])):
        if abs(value) > limit * 1e7:
            raise Refused(f"{name} {value / 1e7:g} deg is outside +-{limit:g}", value / 1e7, limit)
    return math.radians(lat / 1e7), math.radians(lon / 1e7)


def known_position(message: Message, lat: str = "lat", lon: str = "lon") -> tuple[float, float]:
    """A position that exists: 0, 0 is how autopilots say that they have none yet."""
    values = getattr(message, lat), getattr(message, lon)
    if values == (0, 0):
        raise Refused("no position yet (latitude and longitude are 0)")
    return position(*values, names=(lat, lon))


def accuracy(value: int) -> float | None:
    """Millimetres to metres; 0 and all ones are "not given"."""
    return None if value in (0, 0xFFFFFFFF) else value * 1e-3


def dilution(value: int) -> float | None:
    """A dilution of precision sent times 100."""
    return None if value * 0.01 >= _DOP_UNKNOWN else value * 0.01


def wrapped(angle: float) -> float:
    """The same angle in [0, 2 pi)."""
    heading = angle % math.tau
    return 0.0 if heading == math.tau else heading  # a tiny negative angle rounds up to 2 pi


def euler(q: tuple[float, float, float, float]) -> Vector3:
    """Roll, pitch, heading of the rotation b -> n given as a quaternion w, x, y, z of any length."""
    norm = math.sqrt(sum(c * c for c in q))
    if not 0.5 < norm < 2.0:
        raise Refused(f"the attitude quaternion has length {norm:g}, not 1", norm, 1.0)
    w, x, y, z = (c / norm for c in q)
    roll = math.atan2(2.0 * (w * x + y * z), 1.0 - 2.0 * (x * x + y * y))
    pitch = math.asin(max(-1.0, min(1.0, 2.0 * (w * y - z * x))))
    return roll, pitch, wrapped(math.atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z)))
