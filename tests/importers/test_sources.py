"""Telemetry logs are read to the end despite radio damage, and converted to records."""

import math
import os
import pathlib
from collections import Counter
from itertools import pairwise

import pytest
from fastcrc import crc16
from hypothesis import example, given, settings
from hypothesis import strategies as st

from companion import records as r
from companion.importers import sources, tlog
from companion.link import dialect, frame
from companion.nav.geometry import Geodetic, geodetic_to_local
from companion.storage import flight_log
from companion.storage.reader import LogError

DATA = pathlib.Path(__file__).parents[1] / "data"
SHARED = pathlib.Path(__file__).parents[2].parent / "shared" / "data"
CUT = (DATA / "dronekit_copter_cut.tlog").read_bytes()
START_US = 1_700_000_000_000_000


def entry(index: int, body: bytes) -> bytes:
    return (START_US + 10_000 * index).to_bytes(8, "big") + body


def attitude(index: int, boot_ms: int = 0) -> bytes:
    message = dialect.new("ATTITUDE", time_boot_ms=boot_ms or 1000 + 10 * index, roll=0.1)
    return frame.encode(message, index % 256, 1, 1)


def heartbeat(autopilot: int = 3) -> bytes:
    return frame.encode(dialect.new("HEARTBEAT", type=1, autopilot=autopilot), 0, 1, 1)


CLEAN = [entry(i, attitude(i)) for i in range(20)]


def read(data: bytes) -> tuple[list[tlog.TlogEntry], tlog.Tlog]:
    log = tlog.Tlog(data)
    return list(log), log


def test_entries_have_their_own_times() -> None:
    entries, log = read(b"".join(CLEAN))
    assert [e.rx_ns for e in entries] == [(START_US + 10_000 * i) * 1000 for i in range(20)]
    assert [e.frame.sequence for e in entries] == list(range(20))
    assert (log.messages, log.corrupt, log.unknown, log.torn) == (20, 0, 0, 0)


def flipped(body: bytes, at: int) -> bytes:
    return body[:at] + bytes([body[at] ^ 0xFF]) + body[at + 1 :]


DAMAGE = {
    "a payload byte flipped": flipped(CLEAN[7], 8 + 15),
    "the length flipped": flipped(CLEAN[7], 8 + 1),
    "the magic flipped": flipped(CLEAN[7], 8),
    "bytes lost in the middle": CLEAN[7][:15] + CLEAN[7][20:],
    "junk after the entry": CLEAN[7] + b"\xfe\xfd junk \xfd",
    "an entry cut short": CLEAN[7][:11],
}


@pytest.mark.parametrize("name", DAMAGE)
def test_one_damage_loses_at_most_one_entry_and_is_counted_once(name: str) -> None:
    entries, log = read(b"".join([*CLEAN[:7], DAMAGE[name], *CLEAN[8:]]))
    assert {e.frame.sequence for e in entries} >= set(range(20)) - {7}
    assert log.corrupt == 1
    assert log.torn == 0


def test_adjacent_damaged_entries_are_counted_separately() -> None:
    damaged = [flipped(CLEAN[i], 20) for i in (7, 8)]
    _, log = read(b"".join([*CLEAN[:7], *damaged, *CLEAN[9:]]))
    assert (log.messages, log.corrupt) == (18, 2)


def test_unknown_message_is_not_counted_as_damaged() -> None:
    unknown = b"\xfd\x02\x00\x00\x00\x01\x01\xff\xff\x7fab\x12\x34"
    _, log = read(b"".join([*CLEAN[:7], entry(7, unknown), *CLEAN[8:]]))
    assert (log.messages, log.corrupt, log.unknown) == (19, 0, 1)


def test_torn_end_is_counted() -> None:
    data = b"".join(CLEAN)
    for lost in range(1, len(CLEAN[-1])):
        _, log = read(data[:-lost])
        assert (log.messages, log.corrupt) == (19, 0)
        assert log.torn == len(CLEAN[-1]) - lost


def test_times_never_decrease() -> None:
    entries, _ = read(b"".join([*CLEAN[10:], *CLEAN[:10]]))
    times = [e.rx_ns for e in entries]
    assert len(times) == 20 and times == sorted(times)


DAY_US = 86_400_000_000


@pytest.mark.parametrize("set_to_us", [START_US + 9 * DAY_US, START_US - 9 * DAY_US, 5_000_000])
def test_a_recorder_whose_clock_is_set_loses_nothing(set_to_us: int) -> None:
    """As a board without a battery does: from the time it was switched off, or 1970, to that of a server."""
    moved = [(set_to_us + 10_000 * i).to_bytes(8, "big") + attitude(i) for i in range(20)]
    for first, then in ((CLEAN, moved), (moved, CLEAN)):
        entries, log = read(b"".join([*first[:7], *then[7:]]))
        assert [e.frame.sequence for e in entries] == list(range(20))
        assert (log.messages, log.corrupt) == (20, 0)
        steps = [b.rx_ns - a.rx_ns for a, b in pairwise(entries)]
        assert steps[:6] + steps[7:] == [10_000_000] * 18 and 0 <= steps[6] <= 10_000_000


@pytest.mark.parametrize("stamp_us", [START_US + 9 * DAY_US, START_US - 9 * DAY_US, 5_000_000])
def test_one_damaged_stamp_loses_one_entry(stamp_us: int) -> None:
    damaged = stamp_us.to_bytes(8, "big") + attitude(7)
    entries, log = read(b"".join([*CLEAN[:7], damaged, *CLEAN[8:]]))
    assert [e.rx_ns for e in entries] == [(START_US + 10_000 * i) * 1000 for i in range(20) if i != 7]
    assert log.corrupt == 1


@settings(max_examples=100)
@given(st.binary(max_size=60), st.integers(0, len(b"".join(CLEAN))))
@example(b"\0\xfe\xb0" + bytes(21), 287)  # states a length at whose end there is an entry, five entries later
def test_inserted_bytes_lose_at_most_one_entry(junk: bytes, at: int) -> None:
    data = b"".join(CLEAN)
    entries, log = read(data[:at] + junk + data[at:])
    assert log.messages == len(entries) >= 19


def test_recorded_flight_has_damage_counted_and_reboot_detected() -> None:
    source = sources.TlogSource(tlog.Tlog(CUT))
    records = list(source)
    summary = source.summary()
    assert summary == sources.ImportSummary(
        messages=841, corrupt=24, unknown=0, torn=13, reboots=1, records=len(records)
    )
    resets = [record for record in records if isinstance(record, r.Reset)]
    assert [record.system for record in records if isinstance(record, r.Reboot)] == [1]
    assert [reset.what for reset in resets] == ["flight"]
    assert [record.rx_ns for record in records] == sorted(record.rx_ns for record in records)
    assert all(record.t_ns <= record.rx_ns for record in records)


def test_clock_is_reset_at_a_reboot() -> None:
    """Each boot has its own time mapping: stamps in step with their arrival are valid at the arrival."""
    log = b"".join(
        [entry(0, heartbeat())]
        + [entry(i, attitude(i, 500_000 + 10 * i)) for i in range(1, 50)]
        + [entry(i, attitude(i, 10 * i)) for i in range(50, 100)]
    )
    records = list(sources.TlogSource(tlog.Tlog(log)))
    assert sum(isinstance(record, r.Reset) for record in records) == 1
    attitudes = [record for record in records if isinstance(record, r.Attitude)]
    assert len(attitudes) == 99
    first = attitudes.pop(49)  # after the reboot: a single message may be a late one
    assert first.t_ns < first.rx_ns
    assert all(record.t_ns == record.rx_ns for record in attitudes)


def test_backlog_of_a_stalled_link_keeps_the_flight_s_time() -> None:
    """490 s of boot time arrive within 47 s, after 443 s of silence: read as 490 s."""
    stamps = [(10 * i, 10_000 + 10 * i) for i in range(100)]  # reception and boot time, ms
    stamps += [(444_000 + i, 11_000 + 10 * i) for i in range(49_000)]
    log = entry(0, heartbeat()) + b"".join(
        (START_US + 1000 * rx).to_bytes(8, "big") + attitude(i, boot) for i, (rx, boot) in enumerate(stamps)
    )
    flown = [h for h in sources.TlogSource(tlog.Tlog(log)) if isinstance(h, r.Attitude)]
    assert len(flown) == 49_100
    assert (flown[-1].rx_ns - flown[0].rx_ns) * 1e-9 == pytest.approx(490.99)
    assert all(record.t_ns == record.rx_ns for record in flown)


def test_one_damaged_boot_time_moves_nothing() -> None:
    stamps = [1000 + 10 * i for i in range(60)]
    stamps[20], stamps[40] = 4_000_000_000, 1
    log = entry(0, heartbeat()) + b"".join(entry(i, attitude(i, ms)) for i, ms in enumerate(stamps))
    source = sources.TlogSource(tlog.Tlog(log))
    times = [record.rx_ns for record in source if isinstance(record, r.Attitude)]
    assert source.summary().reboots == 0
    assert times == sorted(times) and (times[-1] - times[0]) * 1e-9 == pytest.approx(0.59, abs=1e-5)


def test_messages_of_one_boot_time_keep_their_order() -> None:
    """A burst is stamped with one millisecond: equal times would hide all but its first sample."""
    log = entry(0, heartbeat()) + b"".join(
        entry(5 * i, attitude(i, 1000 + 50 * (i // 5))) for i in range(100)
    )
    times = [h.rx_ns for h in sources.TlogSource(tlog.Tlog(log)) if isinstance(h, r.Attitude)]
    assert all(0 < after - before <= 50_000_000 for before, after in pairwise(times))
    assert (times[-1] - times[0]) * 1e-9 == pytest.approx(0.95, abs=0.01)


@pytest.mark.parametrize("system", [None, 2])
def test_a_log_of_two_vehicles_gives_one_flight(system: int | None) -> None:
    """A station that stays on records one aircraft after the other: the second was taken for the first."""

    def flown(vehicle: int, start_us: int, boot_ms: int) -> bytes:
        messages = [dialect.new("HEARTBEAT", type=1, autopilot=3)]
        messages += [
            dialect.new("ATTITUDE", time_boot_ms=boot_ms + 100 * k, roll=vehicle) for k in range(200)
        ]
        return b"".join(
            (start_us + 100_000 * k).to_bytes(8, "big") + frame.encode(one, k % 256, vehicle, 1)
            for k, one in enumerate(messages)
        )

    log = flown(1, START_US, 500_000) + flown(2, START_US + 300_000_000, 60_000)
    records = list(sources.TlogSource(tlog.Tlog(log), system))
    attitudes = [record for record in records if isinstance(record, r.Attitude)]
    assert [record.roll for record in attitudes] == [system or 1] * 200
    ignored = [record.text for record in records if isinstance(record, r.Event) and "ignored" in record.text]
    other, used = (1, 2) if system else (2, 1)
    assert ignored == [f"autopilot {other} ignored: autopilot {used} is in use; link.system_id selects one"]


def test_text_of_the_autopilot_is_an_event() -> None:
    def text(part: bytes, number: int = 0, sequence: int = 0) -> bytes:
        message = dialect.new("STATUSTEXT", severity=4, text=part, id=number, chunk_seq=sequence)
        return frame.encode(message, 0, 1, 1)

    bodies = [heartbeat(), text(b"EKF3 lane switch 1"), text(b"x" * 50, 9), text(b"y" * 3, 9, 1)]
    log = b"".join(entry(i, body) for i, body in enumerate(bodies))
    events = [record for record in sources.TlogSource(tlog.Tlog(log)) if isinstance(record, r.Event)]
    assert [(e.severity, e.text) for e in events[1:]] == [(4, "EKF3 lane switch 1"), (4, "x" * 50 + "yyy")]


def test_messages_of_a_beacon_receiver_are_accepted() -> None:
    message = dialect.new(
        "RSBN_MEASUREMENT",
        beacon_lat=600_000_000,
        beacon_lon=310_000_000,
        slant_range=5e4,
        sigma_range=100.0,
        beacon_id=7,
        status=2,
    )
    log = entry(0, heartbeat()) + entry(1, frame.encode(message, 0, 1, 42))
    fixes = [record for record in sources.TlogSource(tlog.Tlog(log)) if isinstance(record, r.RsbnFix)]
    assert [fix.beacon for fix in fixes] == [7]


def test_messages_are_found_in_a_log_as_they_are_read() -> None:
    read_once = {found.frame.msgid for found in tlog.Tlog(CUT)}
    assert len(read_once) > 10
    assert {msgid for msgid in dialect.TYPES if tlog.Tlog(CUT).contains(msgid)} == read_once


def test_only_entries_of_a_log_count_as_its_messages() -> None:
    """A frame of MAVLink 1 or 2 counts; one without a time of its own, or with a wrong checksum, does not."""
    origin = dialect.new("GPS_GLOBAL_ORIGIN", latitude=1, longitude=2, altitude=3)
    v2, msgid = frame.encode(origin, 0, 1, 1), dialect.id_of(origin)
    payload = dialect.payload(origin)[: dialect.TYPES[msgid].base_size]
    head = bytes((len(payload), 0, 1, 1, msgid)) + payload
    v1 = b"\xfe" + head + crc16.mcrf4xx(head + bytes((dialect.TYPES[msgid].crc_extra,))).to_bytes(2, "little")
    for body, counts in (
        (entry(7, v1), True),
        (entry(7, v2), True),
        (v2, False),
        (entry(7, v2[:-1] + b"?"), False),
    ):
        log = tlog.Tlog(b"".join([*CLEAN[:7], body, *CLEAN[8:]]))
        assert log.contains(msgid) == counts == (msgid in {found.frame.msgid for found in log})


def test_unstated_origin_is_inferred() -> None:
    """The local position relative to the inferred origin is the global position."""
    lat, lon, x, y, z = -353_623_294, 1_491_657_228, 1200.0, -800.0, -50.0
    local = dialect.new("LOCAL_POSITION_NED", time_boot_ms=5000, x=x, y=y, z=z)
    known = dialect.new("GLOBAL_POSITION_INT", time_boot_ms=5000, lat=lat, lon=lon, alt=600_000)
    status = dialect.new("EKF_STATUS_REPORT", flags=831)
    bodies = [heartbeat()] + [frame.encode(m, 1, 1, 1) for m in (local, known, status, local, known)]
    log = b"".join(entry(i, body) for i, body in enumerate(bodies))
    origins = [o for o in sources.TlogSource(tlog.Tlog(log)) if isinstance(o, r.LocalOrigin)]
    assert len(origins) == 1
    origin = Geodetic(origins[0].lat, origins[0].lon, origins[0].alt_msl)
    point = Geodetic(math.radians(lat / 1e7), math.radians(lon / 1e7), 600.0)
    assert geodetic_to_local("ardupilot", origin, point) == pytest.approx([x, y, z], abs=1e-6)


def test_invalid_tlog_is_reported_in_one_sentence(tmp_path: pathlib.Path) -> None:
    empty, foreign, other = tmp_path / "empty.tlog", tmp_path / "foreign.tlog", tmp_path / "x.pdf"
    empty.touch()
    other.touch()
    foreign.write_bytes(bytes(range(256)) * 8)
    for path, words in (
        (empty, "is empty"),
        (foreign, "is not a tlog"),
        (other, r"unknown file type; give \.tlog"),
    ):
        with pytest.raises(LogError, match=words):
            sources.open_source(path)


@pytest.mark.parametrize(
    ("name", "start", "suffix"),
    [
        ("x.bin", b"\x89MCAP0\r\n", ".mcap"),
        ("x.tlog", b"ULog\x01\x125", ".ulg"),
        ("x.zip", b"\xa3\x95\x80\x80", ".bin"),
    ],
)
def test_another_format_than_that_of_its_ending_is_named(
    name: str, start: bytes, suffix: str, tmp_path: pathlib.Path
) -> None:
    path = tmp_path / name
    path.write_bytes(start + bytes(100))
    with pytest.raises(LogError, match=rf"{name} is a \{suffix} log by its content: give it that ending"):
        sources.open_source(path)


def test_log_without_the_autopilot_states_so(tmp_path: pathlib.Path) -> None:
    path = tmp_path / "flight.tlog"
    path.write_bytes(b"".join(CLEAN))
    with pytest.raises(LogError, match="nothing could be read: it has no HEARTBEAT of an autopilot"):
        sources.open_source(path)


def test_a_log_of_another_autopilot_than_the_configured_one_names_those_it_has() -> None:
    """The report stated that the log had nothing for an inertial channel."""
    path = DATA / "dronekit_copter_cut.tlog"
    with pytest.raises(LogError, match=f"{path.name}: it has no autopilot 9; it has 1: set link.system_id"):
        list(sources.open_source(path, 9))


@pytest.mark.parametrize("name", ["nofile", "nofile.pdf", "nofile.tlog", "nofile.bin"])
def test_missing_log_of_any_type_is_reported(name: str, tmp_path: pathlib.Path) -> None:
    with pytest.raises(LogError, match=f"{name}: no such log"):
        sources.open_source(tmp_path / name)


REAL = {
    "dronekit_copter/flight.tlog": (75_477, 1_314, 0, 19, 1),
    "autopilot_sitl/plane_gps_loss.tlog": (49_121, 0, 0, 0, 0),
    "autopilot_sitl/plane_gps_input_aid.tlog": (52_175, 0, 0, 0, 0),
    "autopilot_sitl/plane_wind_change.tlog": (88_209, 0, 0, 0, 0),
    "autopilot_sitl/px4_global_position_sensor.tlog": (88_993, 0, 370, 0, 0),
}


@pytest.mark.shared
@pytest.mark.parametrize("name", REAL)
def test_recordings_are_read_to_the_end(name: str) -> None:
    path = SHARED / name
    if not path.exists():
        pytest.skip("the recordings are not available")
    source = sources.TlogSource(tlog.read(path))
    kinds = Counter(type(record) for record in source)
    assert source.summary()[:5] == REAL[name]
    assert kinds[r.LocalPosition] > 1000 and kinds[r.Gnss] > 1000 and kinds[r.LocalOrigin] >= 1
    assert kinds[r.Truth] > 3000 or "dronekit" in name
    assert source.log.torn == REAL[name][3]


def test_csv_topics_are_merged_by_time(tmp_path: pathlib.Path) -> None:
    local = "timestamp,ref_lat,ref_lon,ref_alt,x,y,z,vx,vy,vz,xy_valid,z_valid,xy_global,xy_reset_counter"
    rows = ["1000,45.0,-93.0,275.9,1,2,-3,4,5,6,1,1,1,1", "3000,45.0,-93.0,275.9,99,2,-3,4,5,6,1,1,1,2"]
    (tmp_path / "vehicle_local_position.csv").write_text("\n".join([local, *rows]))
    wind = "timestamp,windspeed_north,windspeed_east,covariance_north,covariance_east"
    (tmp_path / "wind_estimate.csv").write_text(f"{wind}\n2000,3,-4,0.5,0.5")
    records = list(sources.open_source(tmp_path))
    assert [type(record) for record in records] == [
        r.LocalOrigin,
        r.LocalPosition,
        r.Wind,
        r.Event,
        r.LocalPosition,
    ]
    assert records[1] == r.LocalPosition(1_000_000, 1_000_000, (1.0, 2.0, -3.0), (4.0, 5.0, 6.0))
    (tmp_path / "wind_estimate.csv").write_text(f"{wind}\n2000,north,-4,0.5,0.5")
    *good, event = sources.open_source(tmp_path)
    assert [type(record) for record in good] == [r.LocalOrigin, r.LocalPosition, r.Event, r.LocalPosition]
    assert isinstance(event, r.Event) and "wind_estimate.csv at 2000 us: not a row of its topic" in event.text


def test_csv_topics_of_any_px4_version_are_read(tmp_path: pathlib.Path) -> None:
    """PX4 1.11 took the rates from the attitude, 1.12 renamed the wind, 1.14 the position of GNSS."""
    tables = {
        "vehicle_attitude": "timestamp,q[0],q[1],q[2],q[3]\n1000,1,0,0,0\n2000,1,0,0,0",
        "sensor_gps": "timestamp,latitude_deg,longitude_deg,altitude_msl_m,altitude_ellipsoid_m,fix_type,"
        "vel_ned_valid,vel_n_m_s,vel_e_m_s,vel_d_m_s,eph,satellites_used\n3000,45.0,-90.0,100,80,3,1,4,5,6,nan,9",
        "airspeed": "timestamp,true_airspeed_m_s\n4000,77",
        "airspeed_validated": "timestamp,true_airspeed_m_s\n5000,12.5\n6000,nan",
        "wind": "timestamp,windspeed_north,windspeed_east,variance_north,variance_east\n7000,3,-4,0.5,0.5",
        "sensor_combined": "timestamp,"
        + ",".join(f"{name}[{i}]" for name in ("gyro_rad", "accelerometer_m_s2") for i in range(3))
        + "\n8000,1,2,3,4,5,6",
        "vehicle_air_data": "timestamp,baro_pressure_pa,baro_temp_celcius\n9000,90000,20",
    }
    for name, table in tables.items():
        (tmp_path / f"{name}.csv").write_text(table)
    level, _, fix, air, wind, imu, pressure = sources.open_source(tmp_path)
    assert level == r.Attitude(1_000_000, 1_000_000, 0.0, 0.0, 0.0)
    assert isinstance(fix, r.Gnss) and fix.sigma_horizontal is None and fix.v_n == (4.0, 5.0, 6.0)
    assert (fix.lat, fix.lon) == (math.radians(45.0), math.radians(-90.0))
    assert (fix.alt_msl, fix.alt, fix.satellites) == (100.0, 80.0, 9)
    assert air == r.AirData(5_000_000, 5_000_000, 12.5, True, sensed=True)
    assert wind == r.Wind(7_000_000, 7_000_000, (3.0, -4.0, 0.0), math.sqrt(0.5))
    assert imu == r.Imu(8_000_000, 8_000_000, 0, (4.0, 5.0, 6.0), (1.0, 2.0, 3.0))
    assert pressure == r.Pressure(9_000_000, 9_000_000, 90_000.0, None, pytest.approx(293.15))


def test_csv_topics_as_ulog2csv_names_them_are_read(tmp_path: pathlib.Path) -> None:
    """It writes LOG_TOPIC_INSTANCE.csv; wind of airspeed_wind is of another filter."""
    attitude = "timestamp,q[0],q[1],q[2],q[3]\n1000,1,0,0,0"
    wind = "timestamp,windspeed_north,windspeed_east,variance_north,variance_east\n2000,3,-4,0.5,0.5"
    tables = {"vehicle_attitude_0": attitude, "wind_0": wind, "wind_1": wind, "airspeed_wind_0": wind}
    for name, table in tables.items():
        (tmp_path / f"log_1_wind_{name}.csv").write_text(table)
    kinds = [r.Attitude, r.Wind]
    assert [type(record) for record in sources.open_source(tmp_path)] == kinds
    (tmp_path / "log_1_wind_wind_0.csv").unlink()
    assert [type(record) for record in sources.open_source(tmp_path)] == kinds[:1]
    (tmp_path / "log_2_vehicle_attitude_0.csv").write_text(attitude)
    with pytest.raises(LogError, match="give a log, or a folder of the topics of one log"):
        sources.open_source(tmp_path)


def test_csv_topic_without_a_column_is_reported_once(tmp_path: pathlib.Path) -> None:
    (tmp_path / "vehicle_attitude.csv").write_text("timestamp,q[0]\n" + "1000,1\n" * 50)
    (tmp_path / "airspeed.csv").write_text("timestamp,true_airspeed_m_s\n2000,15")
    air, event = sources.open_source(tmp_path)
    assert isinstance(air, r.AirData) and isinstance(event, r.Event)
    assert "1 part of 0 bytes was not read: vehicle_attitude.csv: no column 'q[1]'" in event.text


@pytest.mark.parametrize("quote", ['"', '""', '"x', ',"'])
def test_quote_in_a_topic_loses_at_most_its_line(quote: str, tmp_path: pathlib.Path) -> None:
    rows = [f"{10_000 * k},{quote if k == 5 else ''}1.0,0,0,0,0,0,0" for k in range(20)]
    header = "timestamp,q[0],q[1],q[2],q[3],rollspeed,pitchspeed,yawspeed"
    (tmp_path / "vehicle_attitude.csv").write_text("\n".join([header, *rows]))
    found = [record for record in sources.open_source(tmp_path) if isinstance(record, r.Attitude)]
    assert len(found) >= 19


@pytest.mark.parametrize("name", ["x.ulg", "x.ulog", "x.bin", "x.tlog", "x.mat", "x.zip", "x.mcap"])
def test_pipe_is_rejected_without_waiting_for_its_writer(name: str, tmp_path: pathlib.Path) -> None:
    os.mkfifo(tmp_path / name)
    with pytest.raises(LogError, match=f"{name}.*not a regular file"):
        if name == "x.mcap":
            flight_log.info(tmp_path / name)
        sources.open_source(tmp_path / name)


def test_pipe_among_topics_or_tables_is_rejected(tmp_path: pathlib.Path) -> None:
    os.mkfifo(tmp_path / "vehicle_attitude.csv")
    with pytest.raises(LogError, match="not a regular file"):
        sources.open_source(tmp_path)
    os.mkfifo(tmp_path / "IMU.txt")
    (tmp_path / "GPOSonboard.txt").touch()
    with pytest.raises(LogError, match=r"damaged in IMU\.txt: .*not a regular file"):
        sources.open_source(tmp_path)


def test_empty_folder_is_reported(tmp_path: pathlib.Path) -> None:
    with pytest.raises(LogError, match=r"no topic of PX4 as CSV, such as \w+\.csv: give a log"):
        sources.open_source(tmp_path)


@pytest.mark.shared
def test_recorded_csv_topics_are_read() -> None:
    folder = SHARED / "umn_fixed_wing"
    if not folder.exists():
        pytest.skip("the recordings are not available")
    records = list(sources.open_source(folder))
    kinds = Counter(type(record) for record in records)
    times = [record.t_ns for record in records]
    assert times == sorted(times)
    assert kinds[r.Gnss] > 2000 and kinds[r.LocalPosition] > 4000 and kinds[r.Attitude] > 40_000
    assert (kinds[r.LocalOrigin], kinds[r.Event]) == (1, 2)
