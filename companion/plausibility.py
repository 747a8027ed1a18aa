"""Physical limits of the numbers in a record: one table by field name, for what arrives live and from files.

A number beyond its limit, or not finite, makes the record unusable: it becomes a `Rejection` that states the
field, its value and the limit. So nothing that passes can overflow later.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple, get_type_hints

from companion.records import BY_NAME, Rejection, Stamped

FARTHEST, FASTEST, HIGHEST = 2.1e7, 3e3, 1e5
"""Limits of a measurement: half the earth's circumference (m), 3 km/s, 100 km."""
DEFAULT = 1e8  # in SI: no other quantity of a flight comes near it
_INTEGER = 2.0**62
_ROUNDED = 1e-9  # rad
#: Largest magnitude by field name; other numbers are limited to DEFAULT, integers to 62 bits.
LIMITS = {
    **dict.fromkeys(("alt", "alt_msl", "alt_a", "alt_b", "height_above_home"), HIGHEST),
    **dict.fromkeys(("v_n", "airspeed", "groundspeed", "climb"), FASTEST),
    **dict.fromkeys(("lat", "lat_a", "lat_b"), math.pi / 2.0 + _ROUNDED),
    **dict.fromkeys(("lon", "lon_a", "lon_b"), math.pi + _ROUNDED),
    "x_n": FARTHEST,
}


class ImplausibleField(NamedTuple):
    """A field that makes a record unusable, with its value and its limit."""

    name: str
    value: float
    limit: float

    @property
    def reason(self) -> str:
        """Why the record is not used."""
        if not math.isfinite(self._number):
            return f"{self.name} is {self._number}"
        return f"{self.name} {self._number:g} is beyond the limit {self.limit:g}"

    @property
    def _number(self) -> float:
        """The value; infinite if it is an integer beyond any float (a text log may have 400 digits)."""
        try:
            return float(self.value)
        except OverflowError:
            return math.inf if self.value > 0 else -math.inf

    def rejection(self, record: Stamped) -> Rejection:
        """Return the rejection of `record`."""
        value = self._number if math.isfinite(self._number) else None
        return Rejection(record.t_ns, record.rx_ns, type(record).__name__, self.reason, value, self.limit)


def _limits(kind: type[Stamped]) -> tuple[tuple[str, float], ...]:
    hints = get_type_hints(kind)
    return tuple(
        (name, LIMITS.get(name, _INTEGER if hints[name] in (int, int | None) else DEFAULT))
        for name in kind.__struct_fields__
        if hints[name] not in (str, bool)
    )


_FIELDS = {kind: _limits(kind) for kind in BY_NAME.values()}


def implausible_field(record: Stamped) -> ImplausibleField | None:
    """Return the first field that is not finite or beyond its limit, None if there is none."""
    for name, limit in _FIELDS[type(record)]:
        value: Any = getattr(record, name)
        kind = type(value)
        if kind is float or kind is int:
            if not -limit <= value <= limit:  # false for NaN too
                return ImplausibleField(name, value, limit)
        elif kind is tuple:
            for part in value:
                if (type(part) is float or type(part) is int) and not -limit <= part <= limit:
                    return ImplausibleField(name, part, limit)
    return None
