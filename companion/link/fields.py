"""Message fields converted to SI units, with every encoding of "absent" recognised. Pure.

Each function returns SI units and radians, None where a field may be absent, and raises `InvalidField` where
it must be present. Knows no message and no record.
"""

from __future__ import annotations

import math

from companion.link.dialect import Message
from companion.records import Vector3

_DOP_UNKNOWN = 99.0  # NMEA's 99.99 means "none", and no fix is computed at such a geometry


class InvalidField(ValueError):
    """A field that makes the message unusable; becomes a Rejection."""

    def __init__(self, reason: str, value: float | None = None, limit: float | None = None) -> None:
        super().__init__(reason)
        self.value = value if value is not None and math.isfinite(value) else None
        self.limit = limit


def number(message: Message, field: str, scale: float = 1.0, limit: float = math.inf) -> float:
    """Return a mandatory field times `scale`; its magnitude must not exceed `limit`."""
    value = float(getattr(message, field))
    if not math.isfinite(value):
        raise InvalidField(f"{field} is {value}")
    if abs(value * scale) > limit:
        raise InvalidField(f"{field} {value:g} is beyond the limit {limit:g}", value * scale, limit)
    return value * scale


def optional_number(message: Message, field: str, scale: float = 1.0) -> float | None:
    """Return an optional field times `scale`; None if it is NaN or infinite."""
    value = float(getattr(message, field))
    return value * scale if math.isfinite(value) else None


def vector(message: Message, fields: str, scale: float = 1.0, limit: float = math.inf) -> Vector3:
    """Return three mandatory fields as `number` does; `fields` holds their names, separated by spaces."""
    x, y, z = [number(message, field, scale, limit) for field in fields.split()]
    return x, y, z


def optional_vector(message: Message, fields: str) -> Vector3 | None:
    """Return three optional fields; None if one of them is absent."""
    x, y, z = (float(getattr(message, field)) for field in fields.split())
    return (x, y, z) if math.isfinite(x + y + z) else None


def position(lat: int, lon: int, names: tuple[str, str] = ("lat", "lon")) -> tuple[float, float]:
    """Return latitude and longitude in radians from integers of 1e-7 degrees."""
    for value, limit, name in ((lat, 90.0, names[0]), (lon, 180.0, names[1])):
        if abs(value) > limit * 1e7:
            raise InvalidField(f"{name} {value / 1e7:g} deg is outside +-{limit:g}", value / 1e7, limit)
    return math.radians(lat / 1e7), math.radians(lon / 1e7)


def deg_e7(angle: float) -> int:
    """Return a latitude or longitude in 1e-7 degrees: the inverse of `position`."""
    return round(math.degrees(angle) * 1e7)


def known_position(message: Message, lat: str = "lat", lon: str = "lon") -> tuple[float, float]:
    """Return a mandatory position in radians; autopilots send 0, 0 while they have none."""
    values = getattr(message, lat), getattr(message, lon)
    if values == (0, 0):
        raise InvalidField("no position yet (latitude and longitude are 0)")
    return position(*values, names=(lat, lon))


def accuracy(value: int) -> float | None:
    """Convert millimetres to metres; None for 0 and all ones, which mean "not given"."""
    return None if value in (0, 0xFFFFFFFF) else value * 1e-3


def dilution(value: int) -> float | None:
    """Return a dilution of precision from its hundredfold; None if unknown."""
    return None if value * 0.01 >= _DOP_UNKNOWN else value * 0.01


def wrap_heading(angle: float) -> float:
    """Wrap an angle to [0, 2 pi)."""
    heading = angle % math.tau
    return 0.0 if heading == math.tau else heading  # a tiny negative angle rounds up to 2 pi


def euler(q: tuple[float, float, float, float]) -> Vector3:
    """Return roll, pitch and heading of the rotation b -> n from a quaternion w, x, y, z of any length."""
    norm = math.sqrt(sum(c * c for c in q))
    if not 0.5 < norm < 2.0:
        raise InvalidField(f"the attitude quaternion has length {norm:g}, not 1", norm, 1.0)
    w, x, y, z = (c / norm for c in q)
    roll = math.atan2(2.0 * (w * x + y * z), 1.0 - 2.0 * (x * x + y * y))
    pitch = math.asin(max(-1.0, min(1.0, 2.0 * (w * y - z * x))))
    return roll, pitch, wrap_heading(math.atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z)))
