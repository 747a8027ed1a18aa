"""Parameter protocol server: listing, reading, setting, invalid values and persistence."""

import itertools
import math
import pathlib
import re
import struct
from collections.abc import Callable

import msgspec
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from companion.config import Config, load, parse
from companion.link import dialect
from companion.link.parameter_server import (
    DOES_NOT_EXIST,
    OUT_OF_RANGE,
    PERMISSION_DENIED,
    REAL32,
    VALUES_BURST,
    VALUES_HZ,
    ParameterChanged,
    ParameterServer,
    parameter_table,
)
from tests.frames import on_wire

SECOND = 1_000_000_000
SYSTEM, COMPONENT = 7, 191
UINT8, INT32 = 1, 6
TABLE = parameter_table()


class Station:
    """A ground station joined to a parameter server, with a simulated clock."""

    def __init__(self, config: Config | None = None, save: Callable[[str], None] | None = None) -> None:
        self.saved: list[str] = []
        self.parameters = ParameterServer(
            COMPONENT, config or Config(), base=Config(), save=save or self.saved.append
        )
        self.now = 0
        self.changes: list[ParameterChanged] = []

    def send(self, name: str, system: int = SYSTEM, component: int = COMPONENT, **values: object) -> None:
        message = dialect.new(name, target_system=system, target_component=component, **values)
        found = on_wire(message, 255, 190)
        self.changes += self.parameters.receive(dialect.decode(found), found, SYSTEM, self.now)

    def receive_all(self) -> list[dialect.Message]:
        """Return all messages until nothing more is due."""
        received = []
        while True:
            sent = self.parameters.to_send(self.now)
            received += [dialect.decode(on_wire(message, SYSTEM, COMPONENT)) for message in sent]
            if (due := self.parameters.deadline()) is None:
                return received
            assert due > self.now
            self.now = due

    def set(self, name: str, value: float, kind: int = REAL32) -> list[dialect.Message]:
        self.now += SECOND
        self.send("PARAM_SET", param_id=name, param_value=value, param_type=kind)
        return self.receive_all()


def value(config: Config, name: str) -> float:
    return float(next(parameter for parameter in TABLE if parameter.name == name).value_in(config))


def test_parameters_are_a_dozen_keys_with_readable_names() -> None:
    assert 10 <= len(TABLE) <= 16
    for parameter in TABLE:
        assert re.fullmatch(r"[A-Z][A-Z_]{3,15}", parameter.name)
        assert isinstance(parameter.value_in(Config()), parameter.kind)
    sections = [parameter.section for parameter in TABLE]
    assert len(list(itertools.groupby(sections))) == len(set(sections))  # saved as one table each


def test_access_identity_and_earlier_flights_are_not_parameters() -> None:
    """A saved disk limit that cannot be met would erase every flight at the next start."""
    station = Station()
    assert not {parameter.section for parameter in TABLE} & {"log", "link", "signing"}
    assert not {parameter.key for parameter in TABLE} & {"independent", "profile", "source"}
    (error,) = station.set("LOG_MINIMUM_FREE", 16777216.0)
    assert error.error == DOES_NOT_EXIST
    assert station.changes == [] and station.saved == []


def test_list_is_complete_and_rate_limited() -> None:
    station = Station()
    station.send("PARAM_REQUEST_LIST")
    first = station.parameters.to_send(0)
    assert len(first) == VALUES_BURST
    received = [*first, *station.receive_all()]
    assert [m.param_index for m in received] == list(range(len(TABLE)))
    assert [m.param_id for m in received] == [parameter.name for parameter in TABLE]
    assert {(m.param_type, m.param_count) for m in received} == {(REAL32, len(TABLE))}
    for message, parameter in zip(received, TABLE):
        assert message.param_value == pytest.approx(float(parameter.value_in(Config())), rel=1e-7)
    assert station.now == pytest.approx((len(TABLE) - VALUES_BURST) / VALUES_HZ * SECOND)


def test_flood_of_requests_is_bounded_in_memory_and_rate() -> None:
    station, received = Station(), 0
    for step in range(1000):
        station.now = step * SECOND // 100
        station.send("PARAM_REQUEST_LIST")
        station.send("PARAM_REQUEST_READ", param_index=step % 3)
        station.send("PARAM_SET", param_id="GNSS_SIGMA_M", param_value=1.0 + step, param_type=REAL32)
        received += len(station.parameters.to_send(station.now))
    assert len(station.receive_all()) <= len(TABLE)
    assert received <= VALUES_BURST + 10 * VALUES_HZ + 1
    assert len(station.changes) <= 20 + 5 * 10 + 1


def test_parameter_is_read_by_name_and_by_index() -> None:
    station = Station()
    for wish in ({"param_id": "GNSS_SIGMA_M", "param_index": -1}, {"param_index": 9}):
        station.send("PARAM_REQUEST_READ", **wish)
        (received,) = station.receive_all()
        assert received.get_type() == "PARAM_VALUE"
        assert received.param_id == TABLE[received.param_index].name
    sixteen = next(parameter.name for parameter in TABLE if len(parameter.name) == 16)
    station.send("PARAM_REQUEST_READ", param_id=sixteen, param_index=-1)
    assert station.receive_all()[0].param_id == sixteen


def test_missing_parameter_is_reported_unless_the_request_was_a_broadcast() -> None:
    station = Station()
    station.send("PARAM_REQUEST_READ", param_id="ARSPD_TYPE", param_index=-1)
    station.send("PARAM_REQUEST_READ", param_index=999)
    station.send("PARAM_SET", param_id="ARSPD_TYPE", param_value=1.0, param_type=REAL32)
    received = station.receive_all()
    assert [(m.get_type(), m.error) for m in received] == [("PARAM_ERROR", DOES_NOT_EXIST)] * 3
    assert received[0].param_id == "ARSPD_TYPE" and (
        received[0].target_system,
        received[0].target_component,
    ) == (
        255,
        190,
    )
    station.send("PARAM_SET", component=0, param_id="ARSPD_TYPE", param_value=1.0, param_type=REAL32)
    assert station.receive_all() == []


def test_requests_to_others_are_ignored_and_broadcasts_are_answered() -> None:
    station = Station()
    station.send("PARAM_REQUEST_LIST", component=1)
    station.send("PARAM_REQUEST_LIST", system=8)
    assert station.receive_all() == []
    station.send("PARAM_REQUEST_LIST", system=0, component=0)
    assert len(station.receive_all()) == len(TABLE)


def test_change_is_sent_saved_and_returned_as_a_new_configuration() -> None:
    station = Station()
    (received,) = station.set("GNSS_SIGMA_M", struct.unpack("<f", struct.pack("<f", 4.7))[0])
    assert received.param_value == pytest.approx(4.7)
    (change,) = station.changes
    assert (change.old, change.new, change.parameter.key) == (Config().gnss.sigma_m, 4.7, "sigma_m")
    assert change.config == station.parameters.config
    assert change.config.gnss.sigma_m == 4.7  # and not 4.69999980926


def test_saved_parameters_are_loaded_as_configuration(tmp_path: pathlib.Path) -> None:
    station = Station()
    station.set("GNSS_SIGMA_M", 4.0)
    station.set("GNSS_USE_VEL", 0.0)
    station.set("SWITCH_SOURCES", 0.0)
    station.set("ALERT_M", 300.0)
    path = tmp_path / "set.toml"
    path.write_text(station.saved[-1])
    assert load(path, environment={}) == station.parameters.config
    for name in ("GNSS_SIGMA_M", "GNSS_USE_VEL", "SWITCH_SOURCES", "ALERT_M"):
        station.set(name, value(Config(), name))
    assert "=" not in station.saved[-1]  # no value differs from the operator's configuration


def test_parameters_of_an_earlier_run_are_kept() -> None:
    earlier = Station()
    earlier.set("GNSS_SIGMA_M", 7.0)
    later = Station(parse(earlier.saved[-1], "kept"))
    later.set("GNSS_TIMEOUT_S", 5.0)
    kept = parse(later.saved[-1], "kept").gnss
    assert (kept.sigma_m, kept.timeout_s) == (7.0, 5.0)
    later.set("GNSS_SIGMA_M", Config().gnss.sigma_m)  # back to the operator's value
    assert "sigma_m" not in later.saved[-1]


def test_setting_the_value_in_effect_is_no_change() -> None:
    station = Station()
    for parameter in TABLE:
        (received,) = station.set(parameter.name, float(parameter.value_in(Config())))
        assert received.param_id == parameter.name
    assert station.changes == [] and station.saved == []


@pytest.mark.parametrize(
    ("name", "wish"),
    [
        ("GNSS_SIGMA_M", 0.0),
        ("GNSS_SIGMA_M", -1.0),
        ("GNSS_SIGMA_M", math.nan),
        ("GNSS_SIGMA_M", math.inf),
        ("GNSS_SIGMA_M", 3e38),
        ("ODOMETRY_HZ", 51.0),
        ("STATUS_HZ", -1.0),
        ("GNSS_USE_VEL", 2.0),
        ("GNSS_USE_VEL", 0.5),
    ],
)
def test_invalid_value_is_answered_with_the_value_in_effect(name: str, wish: float) -> None:
    station = Station()
    error, received = station.set(name, wish)
    assert (error.get_type(), error.error, error.param_id) == ("PARAM_ERROR", OUT_OF_RANGE, name)
    assert received.param_value == pytest.approx(value(Config(), name))
    assert station.changes == [] and station.saved == []


def test_value_that_the_next_start_would_reject_is_rejected() -> None:
    """Saved, it would be set aside by the next start."""
    config = parse("[gnss]\nevery_s = 2.0\n", "file")
    station = Station(config)
    error, received = station.set("GNSS_TIMEOUT_S", 1.0)
    assert error.error == OUT_OF_RANGE and received.param_value == value(config, "GNSS_TIMEOUT_S")
    assert station.saved == [] and station.set("GNSS_TIMEOUT_S", 2.0)[0].param_value == 2.0


def test_value_of_another_type_is_rejected() -> None:
    station = Station()
    for kind in (UINT8, INT32, 0, 255):
        error, received = station.set("GNSS_SIGMA_M", 3.0, kind)
        assert error.error == OUT_OF_RANGE and received.param_value == value(Config(), "GNSS_SIGMA_M")
    assert station.set("GNSS_SIGMA_M", 3.0)[0].param_value == 3.0


def test_value_that_cannot_be_saved_is_not_changed() -> None:
    def full(text: str) -> None:
        raise OSError(28, "no space left on device")

    station = Station(save=full)
    error, received = station.set("GNSS_SIGMA_M", 4.0)
    assert error.error == PERMISSION_DENIED and received.param_value == value(Config(), "GNSS_SIGMA_M")
    assert station.parameters.config == Config()


@settings(max_examples=300)
@given(
    name=st.sampled_from([parameter.name for parameter in TABLE])
    | st.text(max_size=16).filter(lambda t: len(t.encode()) <= 16),
    wish=st.floats(width=32)
    | st.integers(-3, 3).map(float)
    | st.integers(0, 2**32 - 1).map(lambda i: struct.unpack("<f", struct.pack("<I", i))[0]),
    kind=st.just(REAL32) | st.integers(0, 255),
)
def test_no_value_raises_and_accepted_values_are_valid_configuration(
    name: str, wish: float, kind: int
) -> None:
    station = Station()
    received = station.set(name, wish, kind)
    assert received
    for change in station.changes:
        assert msgspec.convert(msgspec.to_builtins(change.config), Config) == change.config
        assert received[-1].param_value == pytest.approx(wish, rel=1e-6)
    if not station.changes:
        assert station.parameters.config == Config()


@settings(max_examples=200)
@given(wish=st.floats(0.5, 600.0, width=32))
def test_set_value_is_read_back_exactly(wish: float) -> None:
    station = Station()
    assert station.set("GNSS_TIMEOUT_S", wish)[-1].param_value == wish
    station.send("PARAM_REQUEST_READ", param_id="GNSS_TIMEOUT_S", param_index=-1)
    assert station.receive_all()[0].param_value == wish
