"""The configuration through the parameter protocol: what any station can read, set, and never break."""

import math
import pathlib
import struct
from collections.abc import Callable

import msgspec
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from companion.config import Config, schema
from companion.link import dialect, frame
from companion.link.parameter_server import (
    DOES_NOT_EXIST,
    HIDDEN,
    HIDDEN_KEYS,
    OUT_OF_RANGE,
    PERMISSION_DENIED,
    REAL32,
    VALUES_BURST,
    VALUES_HZ,
    ParameterChanged,
    Parameters,
    name_of,
    table,
)

SECOND = 1_000_000_000
SYSTEM, COMPONENT = 7, 191
UINT8, INT32 = 1, 6
TABLE = table()


class Station:
    """A ground station joined to the parameters of one component, on one clock."""

    def __init__(self, schema: Config | None = None, save: Callable[[str], None] | None = None) -> None:
        self.saved: list[str] = []
        self.parameters = Parameters(
            COMPONENT, schema or Config(), base=Config(), save=save or self.saved.append
        )
        self.now = 0
        self.changes: list[ParameterChanged] = []

    def send(self, name: str, system: int = SYSTEM, component: int = COMPONENT, **values: object) -> None:
        message = dialect.new(name, target_system=system, target_component=component, **values)
        found = frame.examine(frame.encode(message, 0, 255, 190))
        assert isinstance(found, frame.Frame)
        self.changes += self.parameters.receive(dialect.decode(found), found, SYSTEM, self.now)

    def hear(self) -> list[dialect.Message]:
        """All that is said until nothing more is due."""
        heard = []
        while True:
            for message in self.parameters.to_send(self.now):
                found = frame.examine(frame.encode(message, 0, SYSTEM, COMPONENT))
                assert isinstance(found, frame.Frame)
                heard.append(dialect.decode(found))
            if (due := self.parameters.deadline()) is None:
                return heard
            assert due > self.now
            self.now = due

    def set(self, name: str, value: float, kind: int = REAL32) -> list[dialect.Message]:
        self.now += SECOND
        self.send("PARAM_SET", param_id=name, param_value=value, param_type=kind)
        return self.hear()


def value(schema: Config, name: str) -> float:
    return float(next(parameter for parameter in TABLE if parameter.name == name).of(schema))


def test_names_are_few_characters_distinct_and_stable() -> None:
    names = [parameter.name for parameter in TABLE]
    assert len(set(names)) == len(names)
    assert all(
        1 <= len(name) <= 16 and set(name) <= set("ABCDEFGHIJKLMNOPQRSTUVWXYZ0123456789_") for name in names
    )
    pinned = {
        ("rates", "local_position_hz"): "RATE_LOC_POS_HZ",
        ("inertial", "gyro_drift_deg_h"): "INS_GYRO_DRFT_DH",
        ("inertial", "accelerometer_bias_ug"): "INS_ACC_BIAS_UG",
        ("gnss", "sigma_m"): "GNSS_SIGMA_M",
        ("gnss", "sigma_velocity_m_s"): "GNSS_SIG_VEL_M_S",
        ("rsbn", "sigma_azimuth_deg"): "RSBN_SIG_AZ_DEG",
        ("rsbn", "sigma_range_m"): "RSBN_SIG_RNG_M",
        ("predictor", "window_min"): "PRED_WINDOW_MIN",
        ("estimator", "false_rejection"): "EST_FALSE_REJ",
        ("output", "global_position_sensor_hz"): "OUT_GPSENS_HZ",
    }
    assert {key: name_of(*key) for key in pinned} == pinned


@given(key=st.from_regex(r"[a-z][a-z0-9]{0,12}(_[a-z0-9]{1,12}){0,6}", fullmatch=True))
def test_any_key_has_a_name_that_fits(key: str) -> None:
    assert 1 <= len(name_of("airdata", key)) <= 16


def test_every_number_and_switch_is_offered_and_nothing_of_who_may_speak() -> None:
    offered = {(parameter.section, parameter.key) for parameter in TABLE}
    for section in Config.__struct_fields__:
        for key, content in msgspec.structs.asdict(getattr(Config(), section)).items():
            open_to_all = section not in HIDDEN and (section, key) not in HIDDEN_KEYS
            assert ((section, key) in offered) == (open_to_all and isinstance(content, int | float))


def test_no_station_can_have_the_logs_erased() -> None:
    """A limit of the disk that is out of reach, kept, would cost every flight at the next start."""
    station = Station()
    assert not any(parameter.section == "log" for parameter in TABLE)
    (error,) = station.set(name_of("log", "minimum_free_mib"), 16777216.0)
    assert error.error == DOES_NOT_EXIST
    assert station.changes == [] and station.saved == []


def test_the_list_comes_whole_at_its_rate() -> None:
    station = Station()
    station.send("PARAM_REQUEST_LIST")
    first = station.parameters.to_send(0)
    assert len(first) == VALUES_BURST
    heard = [*first, *station.hear()]
    assert [m.param_index for m in heard] == list(range(len(TABLE)))
    assert [m.param_id for m in heard] == [parameter.name for parameter in TABLE]
    assert {(m.param_type, m.param_count) for m in heard} == {(REAL32, len(TABLE))}
    for message, parameter in zip(heard, TABLE):
        assert message.param_value == pytest.approx(float(parameter.of(Config())), rel=1e-7)
    assert station.now == pytest.approx((len(TABLE) - VALUES_BURST) / VALUES_HZ * SECOND)


def test_a_flood_of_requests_takes_no_memory_and_no_more_than_the_rate() -> None:
    station, heard = Station(), 0
    for step in range(1000):
        station.now = step * SECOND // 100
        station.send("PARAM_REQUEST_LIST")
        station.send("PARAM_REQUEST_READ", param_index=step % 3)
        station.send("PARAM_SET", param_id="GNSS_SIGMA_M", param_value=1.0 + step, param_type=REAL32)
        heard += len(station.parameters.to_send(station.now))
    assert len(station.hear()) <= len(TABLE)
    assert heard <= VALUES_BURST + 10 * VALUES_HZ + 1
    assert len(station.changes) <= 20 + 5 * 10 + 1


def test_one_is_read_by_name_and_by_number() -> None:
    station = Station()
    for wish in ({"param_id": "GNSS_SIGMA_M", "param_index": -1}, {"param_index": 19}):
        station.send("PARAM_REQUEST_READ", **wish)
        (heard,) = station.hear()
        assert heard.get_type() == "PARAM_VALUE"
        assert heard.param_id == TABLE[heard.param_index].name
    sixteen = next(parameter.name for parameter in TABLE if len(parameter.name) == 16)
    station.send("PARAM_REQUEST_READ", param_id=sixteen, param_index=-1)
    assert station.hear()[0].param_id == sixteen


def test_what_does_not_exist_is_said_so_unless_all_were_asked() -> None:
    station = Station()
    station.send("PARAM_REQUEST_READ", param_id="ARSPD_TYPE", param_index=-1)
    station.send("PARAM_REQUEST_READ", param_index=999)
    station.send("PARAM_SET", param_id="ARSPD_TYPE", param_value=1.0, param_type=REAL32)
    heard = station.hear()
    assert [(m.get_type(), m.error) for m in heard] == [("PARAM_ERROR", DOES_NOT_EXIST)] * 3
    assert heard[0].param_id == "ARSPD_TYPE" and (heard[0].target_system, heard[0].target_component) == (
        255,
        190,
    )
    station.send("PARAM_SET", component=0, param_id="ARSPD_TYPE", param_value=1.0, param_type=REAL32)
    assert station.hear() == []


def test_others_are_not_answered_and_broadcasts_are() -> None:
    station = Station()
    station.send("PARAM_REQUEST_LIST", component=1)
    station.send("PARAM_REQUEST_LIST", system=8)
    assert station.hear() == []
    station.send("PARAM_REQUEST_LIST", system=0, component=0)
    assert len(station.hear()) == len(TABLE)


def test_a_change_is_told_kept_and_given_as_a_new_configuration() -> None:
    station = Station()
    (heard,) = station.set("GNSS_SIGMA_M", struct.unpack("<f", struct.pack("<f", 4.7))[0])
    assert heard.param_value == pytest.approx(4.7)
    (change,) = station.changes
    assert (change.old, change.new, change.parameter.key) == (Config().gnss.sigma_m, 4.7, "sigma_m")
    assert change.config == station.parameters.config
    assert change.config.gnss.sigma_m == 4.7  # and not 4.69999980926


def test_what_was_set_is_read_back_by_the_loader_of_configurations(tmp_path: pathlib.Path) -> None:
    station = Station()
    station.set("GNSS_SIGMA_M", 4.0)
    station.set("GNSS_USE_VEL", 0.0)
    station.set("OUT_GPSENS_ID", 7.0)
    station.set("EST_FALSE_REJ", 1e-7)
    path = tmp_path / "set.toml"
    path.write_text(station.saved[-1])
    assert schema.load(path, environment={}) == station.parameters.config
    for name in ("GNSS_SIGMA_M", "GNSS_USE_VEL", "OUT_GPSENS_ID", "EST_FALSE_REJ"):
        station.set(name, value(Config(), name))
    assert "=" not in station.saved[-1]  # nothing departs from the operator's own any more


def test_what_an_earlier_run_was_set_to_is_kept_with_what_this_one_is() -> None:
    earlier = Station()
    earlier.set("GNSS_SIGMA_M", 7.0)
    later = Station(schema.parse(earlier.saved[-1], "kept"))
    later.set("GNSS_TIMEOUT_S", 5.0)
    kept = schema.parse(later.saved[-1], "kept").gnss
    assert (kept.sigma_m, kept.timeout_s) == (7.0, 5.0)
    later.set("GNSS_SIGMA_M", Config().gnss.sigma_m)  # back to the operator's own
    assert "sigma_m" not in later.saved[-1]


def test_to_set_what_stands_is_no_change() -> None:
    station = Station()
    for parameter in TABLE:
        (heard,) = station.set(parameter.name, float(parameter.of(Config())))
        assert heard.param_id == parameter.name
    assert station.changes == [] and station.saved == []


@pytest.mark.parametrize(
    ("name", "wish"),
    [
        ("GNSS_SIGMA_M", 0.0),
        ("GNSS_SIGMA_M", -1.0),
        ("GNSS_SIGMA_M", math.nan),
        ("GNSS_SIGMA_M", math.inf),
        ("GNSS_SIGMA_M", 3e38),
        ("EST_FALSE_REJ", 1.0),
        ("OUT_GPSENS_ID", 256.0),
        ("OUT_GPSENS_ID", 1.5),
        ("OUT_GPSENS_ID", -1.0),
        ("OUT_GPSENS_ID", 3e9),
        ("GNSS_USE_VEL", 2.0),
        ("GNSS_USE_VEL", 0.5),
    ],
)
def test_an_impossible_value_is_answered_by_the_one_that_stands(name: str, wish: float) -> None:
    station = Station()
    error, heard = station.set(name, wish)
    assert (error.get_type(), error.error, error.param_id) == ("PARAM_ERROR", OUT_OF_RANGE, name)
    assert heard.param_value == pytest.approx(value(Config(), name))
    assert station.changes == [] and station.saved == []


def test_a_value_of_another_type_is_refused_for_its_encoding_cannot_be_known() -> None:
    station = Station()
    for kind in (UINT8, INT32, 0, 255):
        error, heard = station.set("OUT_GPSENS_ID", 3.0, kind)
        assert error.error == OUT_OF_RANGE and heard.param_value == value(Config(), "OUT_GPSENS_ID")
    assert station.set("OUT_GPSENS_ID", 3.0)[0].param_value == 3.0


def test_what_cannot_be_kept_is_not_changed() -> None:
    def full(text: str) -> None:
        raise OSError(28, "no space left on device")

    station = Station(save=full)
    error, heard = station.set("GNSS_SIGMA_M", 4.0)
    assert error.error == PERMISSION_DENIED and heard.param_value == value(Config(), "GNSS_SIGMA_M")
    assert station.parameters.config == Config()


@settings(deadline=None, max_examples=300)
@given(
    name=st.sampled_from([parameter.name for parameter in TABLE])
    | st.text(max_size=16).filter(lambda t: len(t.encode()) <= 16),
    wish=st.floats(width=32)
    | st.integers(-3, 3).map(float)
    | st.integers(0, 2**32 - 1).map(lambda i: struct.unpack("<f", struct.pack("<I", i))[0]),
    kind=st.just(REAL32) | st.integers(0, 255),
)
def test_no_value_raises_and_what_is_taken_is_what_the_loader_would_take(
    name: str, wish: float, kind: int
) -> None:
    station = Station()
    heard = station.set(name, wish, kind)
    assert heard
    for change in station.changes:
        assert msgspec.convert(msgspec.to_builtins(change.config), Config) == change.config
        assert heard[-1].param_value == pytest.approx(wish, rel=1e-6)
    if not station.changes:
        assert station.parameters.config == Config()


@settings(deadline=None, max_examples=200)
@given(wish=st.floats(0.015625, 1e6, width=32))
def test_what_was_set_comes_back_bit_for_bit(wish: float) -> None:
    station = Station()
    assert station.set("GNSS_TIMEOUT_S", wish)[-1].param_value == wish
    station.send("PARAM_REQUEST_READ", param_id="GNSS_TIMEOUT_S", param_index=-1)
    assert station.hear()[0].param_value == wish
