"""PX4 onboard logs are converted to records.

The logs are written here by the public format specification, not recorded.
"""

import math
import pathlib
import struct
import tracemalloc

import pytest

from companion import records as r
from companion.importers import foreign_file, sources, ulog_messages
from companion.importers.foreign_file import Damage
from companion.storage.reader import LogError

CODES = {
    "uint64_t": "Q",
    "float": "f",
    "double": "d",
    "int32_t": "i",
    "int8_t": "b",
    "uint8_t": "B",
    "bool": "?",
    "uint32_t": "I",
}
HEADER = b"\x55\x4c\x6f\x67\x01\x12\x35\x01" + struct.pack("<Q", 1_000_000)
UTC = 1_700_000_000_000_000

GPS_NEW = (
    "uint64_t timestamp;uint64_t time_utc_usec;double latitude_deg;double longitude_deg;"
    "double altitude_msl_m;double altitude_ellipsoid_m;"
    "float s_variance_m_s;float eph;float epv;float hdop;float vel_n_m_s;"
    "float vel_e_m_s;float vel_d_m_s;uint8_t fix_type;bool vel_ned_valid;uint8_t satellites_used;"
)
GPS_OLD = (
    "uint64_t timestamp;uint64_t time_utc_usec;int32_t lat;int32_t lon;int32_t alt;int32_t alt_ellipsoid;"
    "float s_variance_m_s;float eph;float epv;float hdop;float vel_n_m_s;"
    "float vel_e_m_s;float vel_d_m_s;uint8_t fix_type;bool vel_ned_valid;uint8_t satellites_used;"
)
LOCAL = (
    "uint64_t timestamp;float x;float y;float z;float vx;float vy;float vz;double ref_lat;double ref_lon;"
    "float ref_alt;bool xy_valid;bool z_valid;bool xy_global;uint8_t xy_reset_counter;"
)
TOPICS = {
    "vehicle_local_position": LOCAL,
    "vehicle_gps_position": GPS_NEW,
    "sensor_gps": GPS_OLD,
    "vehicle_attitude": "uint64_t timestamp;float[4] q;",
    "sensor_combined": "uint64_t timestamp;float[3] gyro_rad;float[3] accelerometer_m_s2;",
    "airspeed": "uint64_t timestamp;float true_airspeed_m_s;",
    "airspeed_validated": "uint64_t timestamp;float true_airspeed_m_s;int8_t airspeed_source;",
    "wind": "uint64_t timestamp;float windspeed_north;float windspeed_east;"
    "float variance_north;float variance_east;",
    "vehicle_air_data": "uint64_t timestamp;float baro_pressure_pa;float baro_temp_celcius;",
    "estimator_status": "uint64_t timestamp;float pos_test_ratio;float pos_horiz_accuracy;"
    "uint32_t solution_status_flags;",
    "vehicle_status": "uint64_t timestamp;uint8_t system_type;",
    "vehicle_land_detected": "uint64_t timestamp;bool landed;",
    "vehicle_global_position_groundtruth": "uint64_t timestamp;double lat;double lon;float alt;",
    "vehicle_local_position_groundtruth": "uint64_t timestamp;float vx;float vy;float vz;",
}
NUMBERS = {name: k for k, name in enumerate(TOPICS)}


def message(kind: str, body: bytes) -> bytes:
    return struct.pack("<HB", len(body), ord(kind)) + body


def definitions(*names: str) -> bytes:
    out = HEADER + message("B", bytes(40))
    out += b"".join(message("F", f"{name}:{TOPICS[name]}".encode()) for name in names)
    return out + b"".join(
        message("A", struct.pack("<BH", 0, NUMBERS[name]) + name.encode()) for name in names
    )


def data(name: str, *values: float | int | bool) -> bytes:
    layout = "<"
    for field in TOPICS[name].split(";")[:-1]:
        kind, _, size = field.split(" ")[0].partition("[")
        layout += CODES[kind] * int(size.rstrip("]") or 1)
    return message("D", struct.pack("<H", NUMBERS[name]) + struct.pack(layout, *values))


def local(us: int, x: float, resets: int = 0) -> bytes:
    origin = 47.0, 8.0, 488.0
    return data("vehicle_local_position", us, x, 2.0, -3.0, 4.0, 5.0, 6.0, *origin, True, True, True, resets)


def fix(us: int, lat: float) -> bytes:
    return data(
        *("vehicle_gps_position", us, UTC, lat, 8.0, 500.0, 547.0),
        *(0.4, 1.3, 1.7, 0.8, 1.0, 2.0, 3.0, 3, True, 10),
    )


def write(tmp_path: pathlib.Path, content: bytes) -> pathlib.Path:
    path = tmp_path / "flight.ulg"
    path.write_bytes(content)
    return path


def flight() -> bytes:
    names = [name for name in TOPICS if name != "sensor_gps"]
    return definitions(*names) + b"".join(
        [
            fix(2_000_000, 47.0),
            local(2_010_000, 1.0),
            data("vehicle_attitude", 2_020_000, math.cos(0.25), 0.0, 0.0, math.sin(0.25)),
            data("sensor_combined", 2_030_000, 0.1, 0.2, 0.3, 0.0, 0.0, -9.8),
            data("airspeed", 2_040_000, 15.0),
            data("airspeed", 2_045_000, math.nan),
            data("wind", 2_050_000, 3.0, -4.0, 0.5, 0.5),
            data("vehicle_air_data", 2_060_000, 95_000.0, 20.0),
            data("estimator_status", 2_070_000, 0.2, 1.5, 0x33F),
            data("vehicle_status", 2_071_000, 2),
            data("vehicle_land_detected", 2_072_000, False),
            data("vehicle_local_position_groundtruth", 2_075_000, 7.0, 8.0, 9.0),
            data("vehicle_global_position_groundtruth", 2_080_000, 47.0, 8.0, 501.0),
            message("L", b"4" + struct.pack("<Q", 2_090_000) + b"Failsafe enabled"),
            message("O", struct.pack("<H", 120)),
            local(2_110_000, 51.0, resets=1),
            fix(2_200_000, 47.00001),
        ]
    )


def test_clock_of_a_simulation_may_count_unix_time(tmp_path: pathlib.Path) -> None:
    start = UTC - 3_000_000  # as the header states; the first fix is older
    head = HEADER[:8] + struct.pack("<Q", start)
    content = definitions("vehicle_gps_position", "vehicle_local_position")[len(head) :]
    rows = fix(start - 500_000, 47.0), local(start + 10_000, 1.0), fix(start + 200_000, 47.00001)
    records = list(sources.open_source(write(tmp_path, head + content + b"".join(rows))))
    assert [type(record) for record in records] == [r.Gnss, r.LocalOrigin, r.LocalPosition, r.Gnss]
    assert (records[0].t_ns, records[-1].t_ns - records[0].t_ns) == (UTC * 1000, 700_000_000)


def test_what_was_published_before_the_log_began_is_of_its_beginning(tmp_path: pathlib.Path) -> None:
    """PX4 logs the last row of each topic first, however old: the landed state of minutes before was lost."""
    start = 600_000_000
    head = HEADER[:8] + struct.pack("<Q", start)
    content = head + definitions("vehicle_local_position", "vehicle_land_detected")[len(head) :]
    content += local(start + 300_000, 1.0) + data("vehicle_land_detected", 200_000_000, True)
    content += message("L", b"6" + struct.pack("<Q", 100_000_000) + b"home set") + local(start + 310_000, 2.0)
    records = list(sources.open_source(write(tmp_path, content)))
    kinds = [type(record) for record in records]
    assert kinds == [r.LocalOrigin, r.LocalPosition, r.Vehicle, r.Event, r.LocalPosition]
    assert [record.t_ns for record in records[1:4]] == [(start + 300_000) * 1000] * 3


def test_a_log_whose_header_states_no_start_is_read_all_the_same(tmp_path: pathlib.Path) -> None:
    content = flight()
    expected = list(sources.open_source(write(tmp_path, content)))
    head = HEADER[:8] + struct.pack("<Q", 10**12)
    assert list(sources.open_source(write(tmp_path, head + content[len(head) :]))) == expected


def test_every_topic_is_converted(tmp_path: pathlib.Path) -> None:
    records = list(sources.open_source(write(tmp_path, flight())))
    assert [type(record) for record in records if not isinstance(record, r.Event)] == [
        *(r.Gnss, r.LocalOrigin, r.LocalPosition, r.Attitude, r.Imu, r.AirData, r.Wind, r.Pressure),
        *(r.FilterStatus, r.Vehicle, r.Vehicle, r.Truth, r.LocalPosition, r.Gnss),
    ]
    first, last = records[0], records[-1]
    assert isinstance(first, r.Gnss) and isinstance(last, r.Gnss)
    assert (first.t_ns, last.t_ns - first.t_ns) == (UTC * 1000, 200_000_000)
    assert not last.repeats(first)  # although the time of the receiver did not change
    assert (first.lat, first.alt_msl, first.alt) == (math.radians(47.0), 500.0, 547.0)
    assert first.sigma_horizontal == pytest.approx(1.3)
    by = {type(record): record for record in records}
    assert by[r.LocalPosition].v_n == (4.0, 5.0, 6.0)  # type: ignore[attr-defined]
    assert (by[r.LocalOrigin].alt_msl, by[r.LocalOrigin].projection) == (488.0, "px4")  # type: ignore[attr-defined]
    assert by[r.Attitude].heading == pytest.approx(0.5)  # type: ignore[attr-defined]
    assert by[r.Imu].f_b == pytest.approx((0.0, 0.0, -9.8))  # type: ignore[attr-defined]
    assert by[r.Wind].sigma == pytest.approx(math.sqrt(0.5))  # type: ignore[attr-defined]
    assert by[r.FilterStatus].horizontal_accuracy == 1.5  # type: ignore[attr-defined]
    vehicles = [record for record in records if isinstance(record, r.Vehicle)]
    assert [(v.multirotor, v.flying) for v in vehicles] == [(True, None), (None, True)]
    assert by[r.Truth].v_n == (7.0, 8.0, 9.0)  # type: ignore[attr-defined]
    events = {event.text: event.severity for event in records if isinstance(event, r.Event)}
    assert events["Failsafe enabled"] == 4
    assert {"logger dropout of 120 ms", "the autopilot reset its horizontal position"} < set(events)
    times = [record.t_ns for record in records]
    assert times == sorted(times)


def test_old_and_new_gps_fields_agree(tmp_path: pathlib.Path) -> None:
    old = data(
        *("sensor_gps", 2_000_000, UTC, 470_000_000, 80_000_000, 500_000, 547_000),
        *(0.4, 1.3, 1.7, 0.8, 1.0, 2.0, 3.0, 3, True, 10),
    )
    (before,) = sources.open_source(write(tmp_path, definitions("sensor_gps") + old))
    (now,) = sources.open_source(write(tmp_path, definitions("vehicle_gps_position") + fix(2_000_000, 47.0)))
    assert before == now


@pytest.mark.parametrize("field", ["airspeed_source", "selected_airspeed_index"])  # since PX4 1.17, before
def test_validated_airspeed_is_used_where_a_sensor_measures_it(
    tmp_path: pathlib.Path, monkeypatch: pytest.MonkeyPatch, field: str
) -> None:
    monkeypatch.setitem(
        TOPICS, "airspeed_validated", f"uint64_t timestamp;float true_airspeed_m_s;int8_t {field};"
    )
    none, ground_minus_wind, sensors, synthetic = -1, 0, (1, 2, 3), 4
    content = definitions("airspeed", "airspeed_validated") + data("airspeed", 2_000_000, 99.0)
    for k, source in enumerate((none, ground_minus_wind, *sensors, synthetic)):
        content += data("airspeed_validated", 2_000_000 + k, 10.0 + source, source)
    records = list(sources.open_source(write(tmp_path, content)))
    found = [(h.airspeed, h.true, h.sensed) for h in records if isinstance(h, r.AirData)]
    assert found == [(11.0, True, True), (12.0, True, True), (13.0, True, True)]


def test_a_subscription_whose_number_is_the_letter_of_a_message_is_read() -> None:
    """As of topic 77, "M", in sample_px4_events.ulg of pyulog: "A", 0, "M" look like a message of 65 bytes.

    Another message began behind those, so the subscription was held to be damaged, and its rows were lost.
    """
    number, name = ord("M"), b"airspeed"
    subscription = message("A", struct.pack("<BH", 0, number) + name)
    more = 2 + 68 - len(subscription) - 17  # bytes: the first row ends where the 65 bytes would
    row = message("D", struct.pack("<HQf", number, 2_000_000, 20.0) + bytes(more))
    text = message("L", struct.pack("<BQ", ord("6"), 2_000_000) + b"airborne")
    content = definitions() + message("F", f"airspeed:{TOPICS['airspeed']}uint8_t[{more}] more;".encode())
    damage = Damage()
    found = list(ulog_messages.messages(content + subscription + row + text + row, {"airspeed"}, damage))
    assert (len(found), damage.parts) == (3, 0)


def test_torn_log_is_read_up_to_the_damage(tmp_path: pathlib.Path) -> None:
    records = list(sources.open_source(write(tmp_path, flight()[:-30])))
    assert sum(isinstance(record, r.Gnss) for record in records) == 1
    assert sum(isinstance(record, r.LocalPosition) for record in records) == 2


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b"", "is empty"),
        (b"this is something else altogether", "is not a ULog"),
        (HEADER[:12], "without any supported topic"),
        (definitions("airspeed"), "without any supported topic"),
    ],
)
def test_invalid_log_is_reported_in_one_sentence(tmp_path: pathlib.Path, content: bytes, words: str) -> None:
    with pytest.raises(LogError, match=words) as caught:
        sources.open_source(write(tmp_path, content))
    assert "\n" not in str(caught.value)


def test_missing_field_is_named(tmp_path: pathlib.Path) -> None:
    layout = "uint64_t timestamp;float speed;"
    content = HEADER + message("B", bytes(40)) + message("F", f"airspeed:{layout}".encode())
    content += message("A", struct.pack("<BH", 0, 0) + b"airspeed")
    content += message("D", struct.pack("<HQf", 0, 1_000_000, 12.0))
    with pytest.raises(LogError, match="topic airspeed: no field 'true_airspeed_m_s'"):
        sources.open_source(write(tmp_path, content))


def test_rows_agree_with_pyulog(tmp_path: pathlib.Path) -> None:
    """Foreign judge: every field of every row, torn or not."""
    core = pytest.importorskip("pyulog.core")
    for content in (flight(), flight()[:-30]):
        rows: dict[str, list[dict[str, object]]] = {}
        for found in ulog_messages.messages(content, TOPICS, foreign_file.Damage()):
            if isinstance(found, ulog_messages.TopicRow):
                rows.setdefault(found.topic, []).append(found.row)
        judge = core.ULog(str(write(tmp_path, content)))
        assert {data.name for data in judge.data_list} == set(rows)
        for data in judge.data_list:
            for name, values in data.data.items():
                assert [row[name] for row in rows[data.name]] == pytest.approx(values.tolist(), nan_ok=True)


def peak_and_damage(content: bytes) -> tuple[float, Damage]:
    """Memory (bytes) that reading all messages takes, and what was not read."""
    damage = Damage()
    tracemalloc.start()
    try:
        for _ in ulog_messages.messages(content, {"vehicle_attitude"}, damage):
            pass
        return tracemalloc.get_traced_memory()[1], damage
    finally:
        tracemalloc.stop()


@pytest.mark.parametrize(
    ("formats", "words"),
    [
        (("ee:", "b:ee[99999] x", "vehicle_attitude:b[99999] x"), "topic ee has no fields"),
        (("e:uint8_t[0] x", "vehicle_attitude:e[99999] x"), "topic e has no fields"),
        (("vehicle_attitude:uint8_t[99999] x;uint8_t[99999] y",), "more than 131072 fields"),
        (("b:uint8_t[999] x", "vehicle_attitude:b[999] x"), "more than 131072 fields"),
        (("vehicle_attitude:vehicle_attitude x",), "nested too deeply"),
        ((f"vehicle_attitude:uint8_t[9999] {'x' * 60_000}",), "field of 60000 letters"),
        (("vehicle_attitude:uint64_t[9999] x",), "79992 bytes"),
    ],
)
def test_definition_that_expands_is_damage(formats: tuple[str, ...], words: str) -> None:
    """Each of a thousand subscriptions of it takes its own ten bytes only."""
    content = HEADER + b"".join(message("F", text.encode()) for text in formats)
    content += message("A", struct.pack("<BH", 0, 1) + b"vehicle_attitude") * 1000
    peak, damage = peak_and_damage(content)
    assert damage.parts == 1000 and words in damage.first
    assert peak < 25e6  # of 131,072 fields, once


def test_many_subscriptions_of_a_topic_share_its_layout() -> None:
    content = HEADER + message("F", b"vehicle_attitude:uint8_t[4000] x;")
    numbers = range(2000)
    content += b"".join(message("A", struct.pack("<BH", k % 2, k) + b"vehicle_attitude") for k in numbers)
    content += message("D", struct.pack("<H", 1998) + bytes(4000)) * 2
    peak, damage = peak_and_damage(content)
    assert damage.parts == 0 and peak < 5e6


def test_damage_that_looks_like_flags_does_not_reject_the_log(tmp_path: pathlib.Path) -> None:
    """Flags are the first message: a log was rejected whole for random bytes behind its last row."""
    *whole, last = sources.open_source(write(tmp_path, flight()))
    for flags in (bytes(range(1, 41)), bytes(16) + struct.pack("<3Q", len(flight()) + 20, 0, 0)):
        content = flight() + message("B", flags) + fix(2_300_000, 47.00002)
        *records, fixed, event = sources.open_source(write(tmp_path, content))
        assert [*whole, last] == records
        assert isinstance(fixed, r.Gnss) and "1 part of 43 bytes was not read" in event.text  # type: ignore[attr-defined]


def test_data_appended_after_a_tear_is_read(tmp_path: pathlib.Path) -> None:
    """The logger states where it appended data to a log that a crash had cut."""
    plain = flight()
    cut = len(plain) - 20
    flags = bytes(8) + b"\x01" + bytes(7) + struct.pack("<3Q", cut, 0, 0)
    appended = plain[:19] + flags + plain[59:cut] + local(2_300_000, 60.0)
    *records, event = sources.open_source(write(tmp_path, appended))
    assert records[-1].x_n[0] == 60.0  # type: ignore[attr-defined]
    assert "torn before the data appended later" in event.text  # type: ignore[attr-defined]
