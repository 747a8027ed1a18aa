"""Records: JSON preserves them bit for bit, as replay requires."""

from __future__ import annotations

import msgspec
from hypothesis import given
from hypothesis import strategies as st

from companion import records


@given(st.floats(allow_nan=False, allow_infinity=False), st.integers(0, 2**62))
def test_doubles_and_times_survive_json(value: float, t_ns: int) -> None:
    record = records.RsbnFix(t_ns, t_ns + 1, 7, value, -value, value, None, value, value, value)
    assert records.DECODERS["RsbnFix"].decode(records.encode(record)) == record


def test_every_record_type_is_registered_and_frozen() -> None:
    for name, kind in records.BY_NAME.items():
        assert kind.__struct_config__.frozen, name
        assert kind.__struct_config__.tag == name


def test_truth_is_not_an_input() -> None:
    assert records.Truth not in records.INPUTS
    assert not issubclass(records.Truth, records.INPUTS)


def test_record_of_another_type_is_rejected() -> None:
    data = records.encode(records.Event(1, 1, 6, "hello"))
    try:
        records.DECODERS["Reset"].decode(data)
    except msgspec.ValidationError:
        return
    raise AssertionError("an Event was read as a Reset")
