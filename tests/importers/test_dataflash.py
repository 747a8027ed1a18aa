"""ArduPilot onboard logs are converted to records. The logs are written here byte by byte, not recorded."""

import lzma
import math
import pathlib
import struct
from collections.abc import Callable
from types import SimpleNamespace

import pytest

from companion import records as r
from companion.importers import dataflash, dataflash_messages, foreign_file, sources
from companion.storage.reader import LogError

SHARED = pathlib.Path(__file__).parents[2].parent / "shared" / "data"
CODES = {"B": "B", "I": "I", "Q": "Q", "H": "H", "b": "b", "f": "f", "d": "d", "c": "h", "L": "i"}
CODES |= {"C": "H", "e": "i", "n": "4s", "N": "16s", "Z": "64s"}
SCALES = {"c": 100, "C": 100, "e": 100, "L": 1e7}
#: Format and columns as ArduPilot 4.x writes them.
FORMATS = {
    "GPS": ("QBBIHBcLLeffffB", "TimeUS,I,Status,GMS,GWk,NSats,HDop,Lat,Lng,Alt,Spd,GCrs,VZ,Yaw,U"),
    "GPA": ("QBCCCCfBIHfH", "TimeUS,I,VDop,HAcc,VAcc,SAcc,YAcc,VV,SMS,Delta,Und,RTCMFU"),
    "IMU": ("QBffffff", "TimeUS,I,GyrX,GyrY,GyrZ,AccX,AccY,AccZ"),
    "ATT": ("Qccccff", "TimeUS,DesRoll,Roll,DesPitch,Pitch,DesYaw,Yaw"),
    "XKF1": ("QBccCfffffffccce", "TimeUS,C,Roll,Pitch,Yaw,VN,VE,VD,dPD,PN,PE,PD,GX,GY,GZ,OH"),
    "XKF2": ("QBcc", "TimeUS,C,VWN,VWE"),
    "XKF4": ("QBcIB", "TimeUS,C,SP,SS,PI"),
    "ORGN": ("QBLLe", "TimeUS,Type,Lat,Lng,Alt"),
    "POS": ("QLLfff", "TimeUS,Lat,Lng,Alt,RelHomeAlt,RelOriginAlt"),
    "BARO": ("QBfc", "TimeUS,I,Press,Temp"),
    "ARSP": ("QBffc", "TimeUS,I,Airspeed,DiffPress,Temp"),
    "SIM": ("QccCfLL", "TimeUS,Roll,Pitch,Yaw,Alt,Lat,Lng"),
    "SIM2": ("Qffffff", "TimeUS,PN,PE,PD,VN,VE,VD"),
    "MSG": ("QZ", "TimeUS,Message"),
    "EV": ("QB", "TimeUS,Id"),
    "STAT": ("QBfBB", "TimeUS,isFlying,isFlyProb,Armed,Safety"),
}
TYPES = {name: 130 + k for k, name in enumerate(FORMATS)}
GWK, GMS = 2300, 100_000_000
UNIX_S = 315964800 + GWK * 604800 + GMS / 1000 - 18  # as of leap seconds since 2017


def packed(kind: int, layout: str, values: tuple[object, ...]) -> bytes:
    raw = [
        v.encode() if isinstance(v, str) else round(v * SCALES[c]) if c in SCALES else v  # type: ignore[operator]
        for c, v in zip(layout, values, strict=True)
    ]
    return b"\xa3\x95" + bytes([kind]) + struct.pack("<" + "".join(CODES[c] for c in layout), *raw)


def definitions() -> bytes:
    fmt = [("FMT", 128, "BBnNZ", "Type,Length,Name,Format,Columns")]
    fmt += [(name, TYPES[name], layout, columns) for name, (layout, columns) in FORMATS.items()]
    out = b""
    for name, kind, layout, columns in fmt:
        size = 3 + struct.calcsize("<" + "".join(CODES[c] for c in layout))
        out += packed(128, "BBnNZ", (kind, size, name, layout, columns))
    return out


def message(name: str, *values: object) -> bytes:
    return packed(TYPES[name], FORMATS[name][0], values)


def gps(
    us: int, ms: int, lat: float = 45.0, status: int = 3, receiver: int = 0, speed: float = 10.0
) -> bytes:
    return message(
        *("GPS", us, receiver, status, ms, GWK, 10, 0.8, lat, 7.0, 300.0, speed, 90.0, -1.0, 0.0, 1)
    )


def local(us: int, north: float, lane: int = 0) -> bytes:
    return message("XKF1", us, lane, 0, 0, 0, 1.0, 2.0, 3.0, 0.0, north, 20.0, -30.0, 0, 0, 0, 0)


LOG = [
    gps(1_000_000, GMS),
    message("GPA", 1_000_000, 0, 1.2, 0.9, 1.5, 0.3, 0.0, 1, 0, 0, 0.0, 0),
    message("ORGN", 1_010_000, 0, 45.0, 7.0, 290.0),
    message("ORGN", 1_010_000, 1, 44.0, 6.0, 280.0),
    message("IMU", 1_020_000, 1, 0.1, 0.2, 0.3, 0.4, 0.5, -9.8),
    message("ATT", 1_030_000, 0, 10.0, 0, -5.0, 0.0, 350.0),
    message("XKF4", 1_040_000, 0, 0.25, 0x3F | 1 << 14, 1),
    local(1_050_000, 10.0, lane=1),
    local(1_050_000, 99.0, lane=0),
    message("XKF2", 1_050_000, 1, 3.0, -4.0),
    message("POS", 1_060_000, 45.001, 7.001, 310.0, 10.0, 20.0),
    message("ARSP", 1_070_000, 0, 21.0, 250.0, 15.0),
    message("BARO", 1_080_000, 0, 97_000.0, 20.0),
    message("SIM2", 1_090_000, 0.0, 0.0, 0.0, 11.0, 12.0, 13.0),
    message("SIM", 1_090_000, 1.0, 2.0, 90.0, 305.0, 45.0, 7.0),
    message("MSG", 1_100_000, "Throttle armed"),
    gps(1_200_000, GMS + 200, 45.00001),
]


def write(tmp_path: pathlib.Path, *parts: bytes, name: str = "flight.bin") -> pathlib.Path:
    path = tmp_path / name
    path.write_bytes(b"".join(parts))
    return path


EVERY = [
    *(r.Gnss, r.LocalOrigin, r.Imu, r.Attitude, r.LocalPosition, r.Wind, r.GlobalPosition),
    *(r.AirData, r.Pressure, r.Truth, r.Event, r.Gnss),
]


def test_every_message_is_converted(tmp_path: pathlib.Path) -> None:
    source = sources.open_source(write(tmp_path, definitions(), *LOG))
    records = list(source)
    kinds = [type(record) for record in records]
    assert kinds == EVERY
    by = {type(record): record for record in records}
    first, second = records[0], records[-1]
    assert isinstance(first, r.Gnss) and isinstance(second, r.Gnss)
    assert first.t_ns * 1e-9 == pytest.approx(UNIX_S, abs=1.0)
    assert second.t_ns - first.t_ns == 200_000_000 and not second.repeats(first)
    assert (first.lat, first.alt_msl, first.fix) == (pytest.approx(math.radians(45.0)), 300.0, 3)
    assert first.v_n == pytest.approx((0.0, 10.0, -1.0), abs=1e-6)
    assert (second.sigma_horizontal, second.sigma_vertical, second.sigma_velocity) == (0.9, 1.5, 0.3)
    assert by[r.LocalOrigin].alt_msl == 290.0  # type: ignore[attr-defined]
    assert by[r.LocalPosition].x_n == (10.0, 20.0, -30.0)  # type: ignore[attr-defined]
    assert by[r.GlobalPosition].v_n == (1.0, 2.0, 3.0)  # type: ignore[attr-defined]
    assert by[r.Attitude].heading == pytest.approx(math.radians(350.0))  # type: ignore[attr-defined]
    assert by[r.Wind].v_n == (3.0, -4.0, 0.0)  # type: ignore[attr-defined]
    assert (by[r.Pressure].static, by[r.Pressure].differential) == (97_000.0, 250.0)  # type: ignore[attr-defined]
    assert by[r.Truth].v_n == (11.0, 12.0, 13.0)  # type: ignore[attr-defined]
    assert by[r.Event].text == "Throttle armed"  # type: ignore[attr-defined]
    assert source.summary().records == len(records)


def test_a_copter_and_its_flight_are_known_by_texts_and_events(tmp_path: pathlib.Path) -> None:
    texts = ("ArduCopter V4.5.7 (2a3dc4b7)", "ChibiOS: 6a85082c", "Frame: QUAD/X")
    parts = [message("MSG", 1_100_000 + k, text) for k, text in enumerate(texts)]
    parts += [message("EV", 1_200_000 + k, number) for k, number in enumerate((10, 28, 25, 18, 11))]
    found = list(sources.open_source(write(tmp_path, definitions(), gps(1_000_000, GMS), *parts)))
    vehicles = [(record.multirotor, record.flying) for record in found if isinstance(record, r.Vehicle)]
    assert vehicles == [(True, None), (None, True), (None, False)]
    assert sum(isinstance(record, r.Event) for record in found) == len(texts)


def test_a_helicopter_flies_the_same_firmware(tmp_path: pathlib.Path) -> None:
    parts = [message("MSG", 1_100_000, "ArduCopter V4.5.7"), message("MSG", 1_100_001, "Frame: HELI")]
    found = list(sources.open_source(write(tmp_path, definitions(), gps(1_000_000, GMS), *parts)))
    assert [record.multirotor for record in found if isinstance(record, r.Vehicle)] == [True, False]


def test_a_plane_flies_by_its_status_and_when_a_quadplane_hovers_is_not_known(tmp_path: pathlib.Path) -> None:
    parts = [message("MSG", 1_100_000, "ArduPlane V4.7.0-dev (46ae7859)")]
    parts += [message("STAT", 1_200_000 + k, flying, 0.5, 1, 2) for k, flying in enumerate((0, 0, 1, 1, 0))]
    parts += [message("MSG", 1_300_000, "QuadPlane Frame: QUAD/X")]
    found = list(sources.open_source(write(tmp_path, definitions(), gps(1_000_000, GMS), *parts)))
    vehicles = [(record.fixed_wing, record.flying) for record in found if isinstance(record, r.Vehicle)]
    assert vehicles == [(True, None), (None, False), (None, True), (None, False), (False, None)]


@pytest.mark.parametrize("has_status", [False, True])
def test_a_plane_whose_log_has_no_status_flies_while_it_is_fast(
    tmp_path: pathlib.Path, has_status: bool
) -> None:
    speeds = [0.0, 9.0, 14.0, 5.0, 2.0, 12.0]
    parts = [message("MSG", 1_050_000, "ArduPlane V3.2.0")]
    parts += [message("STAT", 1_060_000, 0, 0.0, 1, 2)] if has_status else []
    for k, speed in enumerate(speeds):
        parts.append(gps(1_100_000 + 100_000 * k, GMS + 200 + 200 * k, speed=speed))
        parts.append(message("MSG", 1_110_000 + 100_000 * k, "ArduPlane V3.2.0"))  # again for a station
    found = list(sources.open_source(write(tmp_path, definitions(), gps(1_000_000, GMS), *parts)))
    stated = [record.flying for record in found if isinstance(record, r.Vehicle)]
    flying = [state for state in stated if state is not None]
    assert flying == [False, *([] if has_status else [True, False, True])]


def test_a_plane_does_not_land_where_a_receiver_has_no_fix(tmp_path: pathlib.Path) -> None:
    """Its speed is 0 then: of a second receiver indoors, or where GNSS is lost in flight."""
    parts = [message("MSG", 1_050_000, "ArduPlane V3.2.0"), gps(1_100_000, GMS + 200, speed=14.0)]
    parts += [
        gps(1_200_000, GMS + 400, status=1, speed=0.0),
        gps(1_250_000, 0, status=0, receiver=1, speed=0.0),
    ]
    found = list(sources.open_source(write(tmp_path, definitions(), gps(1_000_000, GMS), *parts)))
    assert [x.flying for x in found if isinstance(x, r.Vehicle) and x.flying is not None] == [True]


def test_the_airspeed_is_that_of_the_primary_sensor() -> None:
    """As since ArduPlane 3.9 (Pri); its first sensor's was taken, though blocked and no longer used."""
    converter, found = dataflash.MessageConverter(), list[r.Stamped]()
    for sensor, airspeed, healthy in ((0, 3.0, 0), (1, 21.0, 1)):
        row = SimpleNamespace(I=sensor, Airspeed=airspeed, DiffPress=250.0, U=healthy, H=healthy, Pri=1)
        found += converter.records("ARSP", row, 1_000)
    assert found == [r.AirData(1_000, 1_000, 21.0, sensed=True)]


@pytest.mark.parametrize(("used", "healthy"), [(0, 1), (1, 0)])
def test_the_airspeed_of_a_sensor_that_is_unhealthy_or_not_used_is_none_of_a_sensor(
    used: int, healthy: int
) -> None:
    """As in flight, by SYS_STATUS."""
    row = SimpleNamespace(I=0, Airspeed=21.0, DiffPress=250.0, U=used, H=healthy, Pri=0)
    (air,) = dataflash.MessageConverter().records("ARSP", row, 1_000)
    assert air == r.AirData(1_000, 1_000, 21.0, sensed=False)


def test_primary_lane_is_converted(tmp_path: pathlib.Path) -> None:
    """Lane 0 before any XKF4, then the lane that it names; its status is converted to MAVLink flags."""
    status = message("XKF4", 1_050_000, 1, 0.25, 0x3F | 1 << 14, 1)
    parts = [
        gps(1_000_000, GMS),
        local(1_040_000, 1.0),
        status,
        local(1_060_000, 2.0, 1),
        local(1_070_000, 3.0),
    ]
    records = list(sources.open_source(write(tmp_path, definitions(), *parts)))
    assert [h.x_n[0] for h in records if isinstance(h, r.LocalPosition)] == [1.0, 2.0]
    (found,) = [h for h in records if isinstance(h, r.FilterStatus)]
    assert (found.flags, found.gnss_glitch, found.position_ratio) == (0x3F | 32768, True, 0.25)


@pytest.mark.parametrize("kind", ["NKF", "XKF"])
def test_primary_lane_is_converted_by_number_where_messages_have_no_core(
    tmp_path: pathlib.Path, kind: str
) -> None:
    """Before ArduPilot 4.1 messages 1, 2, 4 are lane 0, and 6, 7, 9 lane 1."""
    lines = ["FMT, 128, 89, FMT, BBnNZ, Type,Length,Name,Format,Columns"]
    for k in (1, 6):
        lines += [f"FMT, {140 + k}, 0, {kind}{k}, Qffffff, TimeUS,VN,VE,VD,PN,PE,PD"]
        lines += [f"FMT, {141 + k}, 0, {kind}{k + 1}, Qcc, TimeUS,VWN,VWE"]
        lines += [f"FMT, {143 + k}, 0, {kind}{k + 3}, QcHb, TimeUS,SP,SS,PI"]
    for second, primary in ((1, 0), (2, 1), (3, 0)):
        us = second * 1_000_000
        for k in (1, 6):  # the number is that of the message and the second
            lines += [f"{kind}{k + 3}, {us}, {k}{second}, 831, {primary}"]
        for k in (1, 6):
            lines += [f"{kind}{k}, {us}, 1, 2, 3, {k}{second}, 0, 0", f"{kind}{k + 1}, {us}, {k}{second}, 0"]
    path = write(tmp_path, "\n".join([*lines, ""]).encode(), name="flight.log")
    records = list(sources.open_source(path))
    assert [h.x_n[0] for h in records if isinstance(h, r.LocalPosition)] == [11, 62, 13]
    assert [h.v_n[0] for h in records if isinstance(h, r.Wind)] == [11, 62, 13]
    assert [h.position_ratio for h in records if isinstance(h, r.FilterStatus)] == [11, 62, 13]


def test_truth_velocity_is_derived_from_positions(tmp_path: pathlib.Path) -> None:
    parts = [
        message("SIM", us, 0.0, 0.0, 0.0, 100.0, lat, 7.0)
        for us, lat in ((1_000_000, 45.0), (2_000_000, 45.0001))
    ]
    records = [
        h for h in sources.open_source(write(tmp_path, definitions(), *parts)) if isinstance(h, r.Truth)
    ]
    assert records[0].v_n == (0.0, 0.0, 0.0)
    assert records[1].v_n == pytest.approx((11.11, 0.0, 0.0), abs=0.02)


def test_reboot_is_reported_and_time_continues(tmp_path: pathlib.Path) -> None:
    parts = [*LOG, gps(900, GMS + 50_000), local(50_000, 1.0), gps(6_000_000, GMS + 56_000)]
    source = sources.open_source(write(tmp_path, definitions(), *parts))
    records = list(source)
    assert sum(isinstance(record, r.Reboot) for record in records) == source.summary().reboots == 1
    times = [record.t_ns for record in records]
    assert times == sorted(times)


def test_torn_or_damaged_log_gives_all_good_parts_and_names_the_rest(tmp_path: pathlib.Path) -> None:
    head, last = definitions(), len(LOG[-1])
    whole = head + b"".join(LOG)
    records = list(sources.open_source(write(tmp_path, whole[:-20])))
    assert [type(record) for record in records] == [*EVERY[:-1], r.Event]
    assert records[-1].text == (  # type: ignore[attr-defined]
        f"flight.bin is damaged: 1 part of {last - 20} bytes was not read:"
        f" byte {len(whole) - last}: not a message"
    )
    damaged = head + LOG[0] + b"\x00" * 40 + b"".join(LOG[1:])
    records = list(sources.open_source(write(tmp_path, damaged)))
    assert [type(record) for record in records] == [*EVERY, r.Event]
    assert f"40 bytes was not read: byte {len(head + LOG[0])}" in records[-1].text  # type: ignore[attr-defined]
    lost = head + b"".join(LOG[:4]) + LOG[4][:10] + b"".join(LOG[5:])  # bytes lost within a message
    records = list(sources.open_source(write(tmp_path, lost)))
    assert [type(record) for record in records[:-1]] == [kind for kind in EVERY if kind is not r.Imu]


@pytest.mark.parametrize("gap", [1, 8])
def test_bytes_between_all_messages_lose_none(tmp_path: pathlib.Path, gap: int) -> None:
    parts = [part + b"\n" * gap for part in LOG]
    *records, event = sources.open_source(write(tmp_path, definitions(), *parts))
    assert [type(record) for record in records] == EVERY
    assert isinstance(event, r.Event) and f"{len(LOG)} parts of {gap * len(LOG)} bytes" in event.text


def test_integer_beyond_any_float_loses_its_record_only(tmp_path: pathlib.Path) -> None:
    head = "FMT, 128, 89, FMT, BBnNZ, Type,Length,Name,Format,Columns\n"
    head += "FMT, 131, 30, IMU, QBffffff, TimeUS,I,GyrX,GyrY,GyrZ,AccX,AccY,AccZ\n"
    rows = [
        f"IMU, {10_000 * k}, {'-9' * (k == 5)}{'9' * 400 * (k == 5) or 0}, 0, 0, 0, 0, 0, -9.8\n"
        for k in range(20)
    ]
    path = write(tmp_path, (head + "".join(rows)).encode(), name="flight.log")
    records = list(sources.open_source(path))
    (rejection,) = [record for record in records if isinstance(record, r.Rejection)]
    assert (rejection.reason, rejection.value) == ("source is -inf", None)
    assert sum(isinstance(record, r.Imu) for record in records) == 19


def test_log_with_one_number_that_is_not_finite_is_read(tmp_path: pathlib.Path) -> None:
    parts = [*LOG[:5], message("IMU", 1_020_000, 1, 0.1, math.nan, 0.3, 0.4, 0.5, -9.8), *LOG[5:]]
    records = list(sources.open_source(write(tmp_path, definitions(), *parts)))
    (rejection,) = [record for record in records if isinstance(record, r.Rejection)]
    assert (rejection.source, rejection.reason) == ("Imu", "w_b is nan")
    assert [type(record) for record in records if record is not rejection] == EVERY


def test_damaged_lines_are_reported_without_the_types_of_python(tmp_path: pathlib.Path) -> None:
    for line, why in (
        ("FMT, 1, 2", "a FMT of 2 values (at least 4)"),
        ("FMT, 1, 2, ATT, ff, Roll, Yaw\nATT, 1", "ATT of 1 values (its FMT has 2)"),
        ("FMT, 1, 2, ATT, ff, Roll, Yaw\nGPS, 1, 2", "a line of an undefined message"),
    ):
        path = write(tmp_path, f"{line}\n".encode(), name="flight.log")
        with pytest.raises(LogError) as caught:
            list(sources.open_source(path))
        assert str(caught.value).endswith(f": {why}"), line


def test_text_and_binary_logs_agree(tmp_path: pathlib.Path) -> None:
    lines = ["FMT, 128, 89, FMT, BBnNZ, Type,Length,Name,Format,Columns"]
    lines += [f"FMT, {TYPES[n]}, 50, {n}, {lay}, {col}" for n, (lay, col) in FORMATS.items()]
    lines += ["GPS, 1000000, 0, 3, 100000000, 2300, 10, 0.80, 45.0, 7.0, 300.0, 10.0, 90.0, -1.0, 0.0, 1"]
    lines += ["XKF1, 1050000, 0, 0, 0, 0, 1.0, 2.0, 3.0, 0, 10.0, 20.0, -30.0, 0, 0, 0, 0", ""]
    text = list(sources.open_source(write(tmp_path, "\n".join(lines).encode(), name="flight.log")))
    binary = list(
        sources.open_source(write(tmp_path, definitions(), gps(1_000_000, GMS), local(1_050_000, 10.0)))
    )
    assert [type(record) for record in text] == [r.Gnss, r.LocalPosition]
    assert text[1] == binary[1]


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b"", "is empty"),
        (bytes(range(200)) * 10, "is not a DataFlash log"),
        (b"FMT, nonsense\n" * 5, "nothing could be read: byte 0"),
        (packed(128, "BBnNZ", (128, 89, "FMT", "BBnNZ", "Type,Length,Name,Format,Columns")), "no supported"),
    ],
)
def test_invalid_log_is_reported_in_one_sentence(
    tmp_path: pathlib.Path, content: bytes, words: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(LogError, match=words) as caught:
        sources.open_source(write(tmp_path, content))
    assert "\n" not in str(caught.value)
    assert capsys.readouterr() == ("", "")


def test_missing_column_is_named(tmp_path: pathlib.Path) -> None:
    wrong = packed(128, "BBnNZ", (140, 15, "XKF1", "Qf", "TimeUS,VN"))
    log = wrong + b"\xa3\x95" + bytes([140]) + struct.pack("<Qf", 1_000_000, 1.0)
    with pytest.raises(LogError, match="message XKF1: no column VE"):
        sources.open_source(write(tmp_path, definitions()[:89], log))


def test_one_damaged_stamp_is_no_reboot(tmp_path: pathlib.Path) -> None:
    for us in (7, 10**12, 10**16):
        source = sources.open_source(write(tmp_path, definitions(), *LOG[:5], local(us, 1.0), *LOG[5:]))
        records = list(source)
        assert source.summary().reboots == 0
        assert [type(record) for record in records[:-1]] == EVERY
        assert isinstance(records[-1], r.Event) and "flight.bin is damaged: 1 part" in records[-1].text


def test_old_height_column_or_none_is_accepted(tmp_path: pathlib.Path) -> None:
    """POS had RelAlt before ArduCopter 3.5; before that neither."""
    found = []
    for columns in ("TimeUS,Lat,Lng,Alt,RelHomeAlt", "TimeUS,Lat,Lng,Alt,RelAlt", "TimeUS,Lat,Lng,Alt,Other"):
        layout = packed(128, "BBnNZ", (200, 27, "POS", "QLLff", columns))
        body = b"".join(
            b"\xa3\x95" + bytes([200]) + struct.pack("<Qiiff", us, 450000000, 70000000, alt, 5.0)
            for us, alt in ((1_060_000, 310.0), (1_061_000, 312.0))
        )
        records = sources.open_source(write(tmp_path, definitions(), layout, *LOG[:9], body))
        found.append([h.height_above_home for h in records if isinstance(h, r.GlobalPosition)])
    assert found == [[5.0, 5.0], [5.0, 5.0], [0.0, 2.0]]


@pytest.mark.shared
def test_recording_agrees_with_pymavlink(tmp_path: pathlib.Path) -> None:
    """Foreign judge: every column of every converted message as DFReader decodes it."""
    packed_log = SHARED / "harm" / "arduplane_dataflash_head.BIN.xz"
    if not packed_log.exists():
        pytest.skip("the recordings are not available")
    DFReader = pytest.importorskip("pymavlink.DFReader")
    path = write(tmp_path, lzma.decompress(packed_log.read_bytes())[:2_000_000])
    damage = foreign_file.Damage()
    ours = dataflash_messages.messages(path.read_bytes(), dataflash.NAMES, damage)
    judge = DFReader.DFReader_binary(str(path))
    try:
        count = 0
        while (theirs := judge.recv_match(type=list(dataflash.NAMES), strict=True)) is not None:
            found = next(ours)
            count += 1
            assert found.name == theirs.get_type()
            assert vars(found.message) == {name: getattr(theirs, name) for name in vars(found.message)}
    finally:
        judge.close()
    assert next(ours, None) is None and count > 5000
    assert damage.size < 200  # the cut end


def test_missing_log_is_reported(tmp_path: pathlib.Path) -> None:
    readers: list[Callable[[pathlib.Path], object]] = [sources.open_source, dataflash.DataflashLog]
    for read in readers:
        with pytest.raises(LogError, match=r"no such log|No such file"):
            read(tmp_path / "none.bin")


OLD = {
    "GPS": ("BIHBcLLeeEefI", "Status,TimeMS,Week,NSats,HDop,Lat,Lng,RelAlt,Alt,Spd,GCrs,VZ,T"),
    "IMU": ("Iffffff", "TimeMS,GyrX,GyrY,GyrZ,AccX,AccY,AccZ"),
    "ATT": ("cccccCC", "RollIn,Roll,PitchIn,Pitch,YawIn,Yaw,NavYaw"),
    "MSG": ("Z", "Message"),
}


def old_log(tmp_path: pathlib.Path, *lines: str) -> sources.OnboardSource:
    """A text log with the columns of ArduCopter 3.1; rows of ATT and MSG have no time."""
    head = ["FMT, 128, 89, FMT, BBnNZ, Type,Length,Name,Format,Columns"]
    head += [f"FMT, {TYPES[name]}, 50, {name}, {codes}, {columns}" for name, (codes, columns) in OLD.items()]
    path = write(tmp_path, "\n".join([*head, *lines, ""]).encode(), name="old.log")
    found = sources.open_source(path)
    assert isinstance(found, sources.OnboardSource)
    return found


def old_gps(ms: int) -> str:
    return f"GPS, 3, {GMS + ms}, {GWK}, 9, 1.0, 45.0, 7.0, 0.0, 300.0, 1.0, 90.0, 0.0, {ms}"


def old_imu(ms: int) -> str:
    return f"IMU, {ms}, 0, 0, 0, 0, 0, -9.8"


ATTITUDE = "ATT, 0, 1, 0, 2, 0, 90, 90"


def test_a_row_without_a_time_has_that_of_the_row_before(tmp_path: pathlib.Path) -> None:
    """The first rows have the time of the first one that has one: the log does not begin at boot."""
    rows = ["MSG, first", "MSG, second", old_gps(313_000), ATTITUDE, old_imu(313_200), ATTITUDE]
    records = list(old_log(tmp_path, *rows))
    kinds = [type(record) for record in records]
    assert kinds == [r.Event, r.Event, r.Gnss, r.Attitude, r.Imu, r.Attitude]
    seconds = [(record.rx_ns - records[0].rx_ns) * 1e-9 for record in records]
    assert seconds == pytest.approx([0.0, 0.0, 0.0, 0.0, 0.2, 0.2])
    assert records[0].rx_ns * 1e-9 == pytest.approx(UNIX_S + 313.0, abs=1e-3)


def test_a_row_without_a_time_neither_confirms_a_damaged_one_nor_is_lost_with_it(
    tmp_path: pathlib.Path,
) -> None:
    """The first stamp of the log is damaged, and one in the middle of it."""
    rows = ["MSG, first", old_imu(9_000_000), ATTITUDE, old_gps(1000), old_imu(1100), "MSG, second"]
    rows += [old_imu(8_000_000), "MSG, third", old_imu(1200)]
    *records, damaged = old_log(tmp_path, *rows)
    kinds = [type(record) for record in records]
    assert kinds == [r.Event, r.Attitude, r.Gnss, r.Imu, r.Event, r.Event, r.Imu]
    ms = [round((record.rx_ns - records[0].rx_ns) * 1e-6) for record in records]
    assert ms == [0, 0, 0, 100, 100, 100, 200]
    assert isinstance(damaged, r.Event) and "2 parts" in damaged.text


def test_rows_without_a_time_are_kept_up_to_a_limit(
    tmp_path: pathlib.Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(foreign_file, "MAX_UNSTAMPED", 3)
    *records, damaged = old_log(tmp_path, old_gps(1000), *[ATTITUDE] * 5, old_gps(1200))
    assert [type(record) for record in records] == [r.Gnss, *[r.Attitude] * 3]
    assert isinstance(damaged, r.Event) and "3 messages before have no time since boot" in damaged.text


def test_rows_without_a_time_do_not_move_a_reboot(tmp_path: pathlib.Path) -> None:
    rows = [old_gps(50_000), old_imu(50_100), "MSG, again", old_imu(300), ATTITUDE, old_imu(400)]
    records = list(old_log(tmp_path, *rows))
    kinds = [type(record) for record in records]
    assert kinds == [r.Gnss, r.Imu, r.Event, r.Reboot, r.Imu, r.Attitude, r.Imu]
    ms = [round((record.rx_ns - records[0].rx_ns) * 1e-6) for record in records]
    assert ms == [0, 100, 100, 100, 100, 100, 200]


def test_a_log_without_any_time_is_rejected(tmp_path: pathlib.Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As those of ArduCopter 3.0, whose GPS has a time of week only: all rows were put at one instant."""
    gps = old_gps(0).rpartition(",")[0]
    monkeypatch.setitem(OLD, "GPS", (OLD["GPS"][0][:-1], OLD["GPS"][1].rpartition(",")[0]))
    with pytest.raises(LogError) as caught:
        old_log(tmp_path, "ERR, 1, 2", *[gps, ATTITUDE] * 5)
    assert str(caught.value).endswith(
        "old.log: nothing could be read: none of its 10 messages has a time since boot"
    )
