"""Fuzz targets: all byte inputs of the companion, with the properties that hold for any bytes.

    TARGETS[name].check(data)       # returns, or raises if a property is violated; `seeds` are valid inputs

A target accepts any bytes. It raises only on a defect: an undocumented exception, a record that the log
cannot store, a buffer above its bound, a deadline that does not advance. Checksums would hide the code behind
them from a fuzzer, so `script_frames` reads the bytes as a script of messages and adds correct checksums; a
script entry can also be noise between frames.

The bytes come from `sitl.endurance.fuzz` (guided by coverage) or from the tests (random).
"""

from __future__ import annotations

import contextlib
import math
import tempfile
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

from fastcrc import crc16
from mcap.records import Channel, Chunk, Header, McapRecord, Message, Metadata, Schema

from companion import records
from companion.config import Config, ConfigError, InertialConfig, OutputConfig, load, parse, to_toml
from companion.link import dialect, frame
from companion.link.clock import BootClock
from companion.link.decode import MAKES, Sender, decode
from companion.link.dialect import mavlink, rsbn
from companion.link.session import MessageReceived, Session
from companion.link.signing import Signing
from companion.records import Mode, Solution, Stamped
from companion.runtime.core import CompanionCore
from companion.storage import flight_log
from companion.storage.mcap_file import MAGIC, encode_records
from companion.storage.reader import LogError
from companion.storage.recovery import recover

MILLI = 1_000_000
START_NS = 1000 * 1000 * MILLI
#: Messages that the companion reads or answers; a script refers to them by index.
MESSAGE_NAMES = (
    *("HEARTBEAT", "SYSTEM_TIME", "TIMESYNC", "LOCAL_POSITION_NED", "GPS_GLOBAL_ORIGIN", "GPS_RAW_INT"),
    *("GPS2_RAW", "HOME_POSITION", "GLOBAL_POSITION_INT", "ATTITUDE", "ATTITUDE_QUATERNION", "VFR_HUD"),
    *("EKF_STATUS_REPORT", "ESTIMATOR_STATUS", "HIGHRES_IMU", "RAW_IMU", "SCALED_IMU", "AIRSPEED", "WIND"),
    *("WIND_COV", "SCALED_PRESSURE", "RSBN_MEASUREMENT", "SIM_STATE", "HIL_STATE_QUATERNION"),
    *("COMMAND_LONG", "COMMAND_INT", "COMMAND_ACK", "PARAM_REQUEST_READ", "PARAM_REQUEST_LIST", "PARAM_SET"),
    *("STAR_FIX", "RANGE_DIFFERENCE", "SECOND_INS_POSITION"),
)
SYSTEMS, COMPONENTS = (1, 2, 255, 0), (1, 42, 191, 190)
NOISE_BIT, SIGNED_BIT = 0x80, 0x40
IN_MEMORY = "/dev/shm" if Path("/dev/shm").is_dir() else None  # folder of temporary files
_LINK = "fuzz"
_KEY = bytes(range(32))


class Target(NamedTuple):
    """Fuzz target: `check` accepts any bytes, `seeds` returns valid inputs."""

    check: Callable[[bytes], None]
    seeds: Callable[[], Sequence[bytes]]


# ---------------------------------------------------------------------------------------------------------
# Scripts: bytes <-> messages and waiting times
# ---------------------------------------------------------------------------------------------------------


def script_frames(script: bytes) -> Iterator[tuple[int, bytes]]:
    """Yield milliseconds since the last entry and bytes: a frame with correct checksum, or noise.

    A script entry is five bytes (what, who, sequence, wait, length) followed by `length` bytes. The last 13
    of a signed frame are its signature.
    """
    at = 0
    while at + 5 <= len(script):
        what, who, sequence, wait, length = script[at : at + 5]
        payload = script[at + 5 : at + 5 + length]
        at += 5 + length
        if what & NOISE_BIT:
            yield 10 * wait, payload
            continue
        name = MESSAGE_NAMES[(what & 0x3F) % len(MESSAGE_NAMES)]
        signature = b""
        if what & SIGNED_BIT:
            payload, signature = payload[:-13], payload[-13:].rjust(13, b"\0")
        yield 10 * wait, make_frame(name, payload, who, sequence, signature)


def make_frame(name: str, payload: bytes, who: int, sequence: int, signature: bytes = b"") -> bytes:
    """Build a frame with any payload; `who` selects system and component."""
    kind = dialect.type_named(name)
    system, component = SYSTEMS[who & 3], COMPONENTS[who >> 2 & 3]
    head = bytes((len(payload), len(signature) > 0, 0, sequence, system, component))
    body = head + kind.msgid.to_bytes(3, "little") + payload
    check = crc16.mcrf4xx(body + bytes((kind.crc_extra,)))
    return b"\xfd" + body + check.to_bytes(2, "little") + signature


def script_entry(name: str, wait_ms: int = 0, who: int = 0, **values: Any) -> bytes:
    """Encode a message with these fields as a script entry; the inverse of `script_frames`."""
    payload = dialect.payload(dialect.new(name, **values)).rstrip(b"\0")
    return bytes((MESSAGE_NAMES.index(name), who, 0, wait_ms // 10, len(payload))) + payload


def flight_script(seconds: int = 8) -> bytes:
    """Short flight: autopilot, origin, inertial positions, air data, GNSS and RSBN fixes."""
    lon, lat_0, ardupilot = 300_000_000, 600_000_000, mavlink.MAV_AUTOPILOT_ARDUPILOTMEGA
    entries = [
        script_entry("HEARTBEAT", type=mavlink.MAV_TYPE_FIXED_WING, autopilot=ardupilot),
        script_entry("GPS_GLOBAL_ORIGIN", latitude=lat_0, longitude=lon, altitude=10_000),
    ]
    for i in range(2 * seconds):
        ms, x = 500 * i + 60_000, 20.0 * i
        fix = {"lat": lat_0 + round(x / 0.0111), "lon": lon + 500, "alt": 410_000, "eph": 80, "vel": 4000}
        entries += [
            script_entry("SYSTEM_TIME", 500, time_boot_ms=ms),
            script_entry("LOCAL_POSITION_NED", time_boot_ms=ms, x=x, y=3.0, z=-400.0, vx=40.0, vy=0.1),
            script_entry("ATTITUDE", time_boot_ms=ms, roll=0.01 * i, yaw=0.1),
            script_entry("SCALED_PRESSURE", time_boot_ms=ms, press_abs=960.0, temperature=1000),
            script_entry("VFR_HUD", airspeed=40.0 + 0.1 * i, heading=5, alt=400.0),
            script_entry("GPS_RAW_INT", time_usec=1000 * ms, fix_type=mavlink.GPS_FIX_TYPE_3D_FIX, **fix),
        ]
        if i % 2:
            entries.append(
                script_entry(
                    "RSBN_MEASUREMENT",
                    who=4,
                    time_usec=1000 * ms,
                    beacon_id=1,
                    status=rsbn.RSBN_STATUS_AZIMUTH_VALID | rsbn.RSBN_STATUS_RANGE_VALID,
                    azimuth=4.615 - 1e-5 * i,
                    sigma_azimuth=2e-3,
                    sigma_range=100.0,
                    slant_range=60_000.0 - i,
                    beacon_lat=600_500_000,
                    beacon_lon=310_700_000,
                )
            )
    return b"".join(entries)


def _ground_station_script() -> bytes:
    """Requests of a ground station, and a second autopilot."""
    wing, interval_us, gnss_sigma = mavlink.MAV_TYPE_FIXED_WING, 1e5, b"GNSS_SIGMA_M"
    odometry, version = mavlink.MAVLINK_MSG_ID_ODOMETRY, mavlink.MAVLINK_MSG_ID_AUTOPILOT_VERSION
    interval, request = mavlink.MAV_CMD_SET_MESSAGE_INTERVAL, mavlink.MAV_CMD_REQUEST_MESSAGE
    asked = partial(script_entry, who=14, target_system=1, target_component=191)
    return b"".join(
        (
            script_entry("HEARTBEAT", type=wing, autopilot=mavlink.MAV_AUTOPILOT_PX4),
            script_entry("HEARTBEAT", 20, 1, type=wing, autopilot=mavlink.MAV_AUTOPILOT_ARDUPILOTMEGA),
            script_entry("TIMESYNC", 20, ts1=5),
            script_entry("TIMESYNC", 20, tc1=60_000_000_000, ts1=START_NS),
            asked("COMMAND_LONG", 20, command=interval, param1=odometry, param2=interval_us),
            asked("COMMAND_LONG", 20, command=request, param1=version),
            asked("COMMAND_INT", 20, command=mavlink.MAV_CMD_COMPONENT_ARM_DISARM),
            asked("PARAM_REQUEST_LIST", 20),
            asked("PARAM_REQUEST_READ", 20, param_id=gnss_sigma, param_index=-1),
            asked(
                "PARAM_SET",
                1000,
                param_id=gnss_sigma,
                param_value=3.0,
                param_type=mavlink.MAV_PARAM_TYPE_REAL32,
            ),
        )
    )


# ---------------------------------------------------------------------------------------------------------
# The link
# ---------------------------------------------------------------------------------------------------------


def check_stream(data: bytes) -> None:
    """Check the frame reader: every byte is counted once, and the result does not depend on chunking."""
    whole = frame.Reader()
    events = whole.receive(data)
    _check_byte_count(whole, events, len(data))
    step = 1 + (data[0] if data else 0)
    cut = frame.Reader()
    again: list[frame.Event] = []
    for at in range(0, len(data), step):
        again += cut.receive(data[at : at + step])
        assert cut.waiting <= frame.MAX_WAITING, f"{cut.waiting} bytes buffered"
    assert again + cut.close() == events + whole.close(), f"different result in chunks of {step} bytes"


def _check_byte_count(reader: frame.Reader, events: Sequence[frame.Event], size: int) -> None:
    total = sum(len(e.raw) if isinstance(e, frame.Frame) else e.size for e in events)
    assert total + reader.waiting <= size < total + reader.waiting + frame.MAX_RUN
    for event in events:
        if isinstance(event, frame.Frame):
            dialect.decode(event)


def check_wire(data: bytes) -> None:
    """Check message -> records: each can be logged, and its time is not after its arrival."""
    clock, now = BootClock(), START_NS
    clock.update(60_000 * MILLI, now)
    reader = frame.Reader()
    for wait_ms, raw in script_frames(data):
        now += wait_ms * MILLI
        for found in reader.receive(raw):
            if isinstance(found, frame.Frame):
                make = MAKES.get(found.system, "other")
                for record in decode(dialect.decode(found), now, Sender(clock, make)):
                    check_record(record)
                    assert record.rx_ns == now and record.t_ns <= now, record


def check_record(record: Stamped) -> None:
    """Check that a record survives encoding: no NaN, no number outside JSON."""
    assert records.DECODERS[type(record).__name__].decode(records.encode(record)) == record, record


#: Fields of sent messages in which NaN means unknown, with the first element of which it does: the position
#: variances are always known.
_MAY_BE_NAN: dict[str, dict[str, int]] = {
    "ODOMETRY": {
        **dict.fromkeys(("q", "vx", "vy", "vz", "rollspeed", "pitchspeed", "yawspeed"), 0),
        "pose_covariance": 15,
        "velocity_covariance": 0,
    },
    "VISION_POSITION_ESTIMATE": {"roll": 0, "pitch": 0, "yaw": 0, "covariance": 15},
    "GLOBAL_POSITION_SENSOR": {"alt_ellipsoid": 0},
    "COMMAND_INT": {"z": 0},
    "COMMAND_LONG": {"param4": 0},
    "NAMED_VALUE_FLOAT": {"value": 0},
    "NAVIGATION_STATUS": dict.fromkeys(
        (
            *("bound_north", "bound_east", "bound_horizontal", "bound_velocity", "bound_ahead"),
            *("sigma_horizontal", "disagreement", "protection"),
        ),
        0,
    ),
}


def wrong_numbers(message: dialect.Message) -> list[str]:
    """Return the fields that are infinite, or NaN where that does not mean unknown."""
    unknown, found = _MAY_BE_NAN.get(message.get_type(), {}), []
    for name in message.get_fieldnames():
        value = getattr(message, name)
        for k, number in enumerate(value if isinstance(value, list) else [value]):
            is_unknown = number != number and k >= unknown.get(name, math.inf)
            if isinstance(number, float) and not (math.isfinite(number) or is_unknown):
                found.append(f"{name}[{k}]")
    return found


class ValidatingLog:
    """Log that checks everything and stores nothing."""

    def record(self, record: Stamped, channel: str | None = None) -> None:
        """Check one record."""
        check_record(record)
        if isinstance(record, Solution) and record.mode is not Mode.INITIALISING:
            numbers = (record.lat, record.lon, record.alt_msl, *record.v_n, *record.covariance)
            assert all(map(math.isfinite, numbers)) and abs(record.lat) <= 1.6 and abs(record.lon) <= 3.2, (
                record
            )

    def frame(self, link: str, outgoing: bool, data: bytes, t_ns: int) -> None:
        """Check one sent frame."""
        if outgoing:
            (found,) = frame.Reader().receive(data)
            assert isinstance(found, frame.Frame), found
            message = dialect.decode(found)
            assert not wrong_numbers(message), (wrong_numbers(message), message)


#: Positions by all output messages.
ALL_OUTPUTS = OutputConfig(
    profile="custom",
    odometry_hz=10.0,
    vision_hz=10.0,
    gps_input_hz=10.0,
    global_position_sensor_hz=10.0,
    external_position_hz=1.0,
)


def check_onboard(data: bytes) -> None:
    """Check the companion without sockets: no exception, only valid frames sent, deadlines advance.

    The first byte selects the inertial channel. Positions are sent by all output messages.
    """
    inertial = InertialConfig(source="air_data") if data[:1] > b"\x7f" else InertialConfig(independent=True)
    core = CompanionCore(Config(inertial=inertial, output=ALL_OUTPUTS), ValidatingLog(), (_LINK,))
    now = START_NS
    for wait_ms, raw in script_frames(data[1:]):
        then = now + wait_ms * MILLI
        while core.deadline() <= then:
            now = max(now, core.deadline())
            core.poll(now)
            core.to_send(_LINK, now)
            assert core.deadline() > now, "the deadline does not advance"
        now = then
        core.receive(_LINK, raw, now)
        sent = core.to_send(_LINK, now)
        assert len(sent) <= 64, f"{len(sent)} frames for {len(raw)} bytes"
        core.take_events()


def check_signed(data: bytes) -> None:
    """Check a signed link: only RADIO_STATUS is accepted without the key."""
    session = Session(signing=Signing(_KEY, timestamp=1 << 40))
    now = START_NS
    for wait_ms, raw in script_frames(data):
        now += wait_ms * MILLI
        for event in session.receive(raw, now):
            if isinstance(event, MessageReceived):
                assert event.frame.msgid == mavlink.MAVLINK_MSG_ID_RADIO_STATUS, event
        session.poll(now)
        session.to_send()


# ---------------------------------------------------------------------------------------------------------
# Files
# ---------------------------------------------------------------------------------------------------------


def check_log(data: bytes) -> None:
    """Check the MCAP reader and recovery: records, or a LogError of one line."""
    with tempfile.TemporaryDirectory(dir=IN_MEMORY) as folder:
        path = Path(folder) / "x.mcap.active"
        path.write_bytes(data)
        with contextlib.suppress(LogError):
            read_log(path)


def read_log(path: Path) -> None:
    """Read an MCAP log in every way. LogError, of one line, if any of them fails."""
    failed: LogError | None = None
    for look in (_read_records, flight_log.info, flight_log.metadata, recover):
        try:
            look(path)
        except LogError as error:
            assert "\n" not in str(error), error
            failed = error
    if failed is not None:
        raise failed


def _read_records(path: Path) -> None:
    for _ in flight_log.read(path):
        pass


def small_log(content: bytes | None = None, chunked: bool = False) -> bytes:
    """Build a torn log of one message, `content`, without checksums, which would stop a fuzzer."""
    if content is None:
        content = records.encode(records.Event(5, 5, 6, "text"))
    inner: list[McapRecord] = [
        Schema(id=1, data=b"{}", encoding="jsonschema", name="Event"),
        Channel(id=1, topic="/out/Event", message_encoding="json", metadata={}, schema_id=1),
        Message(channel_id=1, log_time=5, data=content, publish_time=5, sequence=0),
    ]
    if chunked:
        data = encode_records(inner)
        inner = [Chunk("", data, 5, 5, uncompressed_crc=0, uncompressed_size=len(data))]
    return MAGIC + encode_records([Header("", "x"), Metadata("log", {"a": "b"}), *inner])


def check_config(data: bytes) -> None:
    """Check the configuration from any source: it can be written and read again, or ConfigError."""
    text = data.decode("utf-8", "replace")
    with tempfile.TemporaryDirectory(dir=IN_MEMORY) as folder:
        path = Path(folder) / "x.toml"
        path.write_bytes(data)
        sources: tuple[Callable[[], Config], ...] = (
            lambda: parse(text, "fuzz"),
            lambda: load(path, environment={}),
            lambda: load(None, {}, {"COMPANION_GNSS__SIGMA_M": text, "COMPANION_LINK__CONNECT": text}),
            lambda: load(None, {}, {}, [text, f"gnss.sigma_m={text}"]),
        )
        for source in sources:
            with contextlib.suppress(ConfigError):
                config = source()
                assert parse(to_toml(config), "fuzz") == config


TARGETS: dict[str, Target] = {
    "stream": Target(check_stream, lambda: [b"".join(raw for _, raw in script_frames(flight_script(1)))]),
    "wire": Target(check_wire, lambda: [flight_script(1)]),
    "onboard": Target(
        check_onboard,
        lambda: [b"\0" + flight_script(), b"\xff" + flight_script(), b"\0" + _ground_station_script()],
    ),
    "signed": Target(check_signed, lambda: [flight_script(1), _ground_station_script()]),
    "log": Target(check_log, lambda: [small_log(), small_log(chunked=True)]),
    "config": Target(check_config, lambda: [to_toml(Config()).encode(), b"[gnss]\nsigma_m = 3.0\n", b"2.5"]),
}
