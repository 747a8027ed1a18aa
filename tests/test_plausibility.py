"""Physical limits of a record's numbers: what is beyond them is named with its value and its limit."""

from __future__ import annotations

import math

import msgspec
import pytest

from companion.plausibility import HIGHEST, LIMITS, implausible_field
from companion.records import BY_NAME, FilterStatus, Gnss, LocalOrigin

FIX = Gnss(10, 20, 0, 1, 3, 1.0, 0.5, 150.0, v_n=(30.0, 0.0, 0.0))


@pytest.mark.parametrize(
    ("field", "value", "limit"),
    [
        ("alt_msl", -2_147_483.647, HIGHEST),  # the least height that GPS_RAW_INT can state
        ("alt_msl", math.nan, HIGHEST),
        ("lat", 1.6, LIMITS["lat"]),
        ("lon", -3.2, LIMITS["lon"]),
        ("v_n", (0.0, 4e3, 0.0), LIMITS["v_n"]),
        ("sigma_horizontal", math.inf, 1e8),
    ],
)
def test_number_beyond_its_limit_is_named(field: str, value: object, limit: float) -> None:
    fault = implausible_field(msgspec.structs.replace(FIX, **{field: value}))
    assert fault is not None
    assert (fault.name, fault.limit) == (field, limit)
    rejection = fault.rejection(FIX)
    assert (rejection.source, rejection.limit) == ("Gnss", limit)
    assert field in rejection.reason


def test_what_is_possible_passes() -> None:
    assert implausible_field(FIX) is None
    assert implausible_field(LocalOrigin(1, 1, -math.pi / 2.0, math.pi, -400.0)) is None
    assert implausible_field(FilterStatus(1, 1, 0xFFFF_FFFF, False, 0.3)) is None  # flags are no quantity


def test_limits_are_of_fields_that_exist() -> None:
    names = {name for kind in BY_NAME.values() for name in kind.__struct_fields__}
    assert set(LIMITS) <= names
