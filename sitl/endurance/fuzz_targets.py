"""Hostile bytes: every door of the companion that bytes come in by, and what must hold whatever they are.

    TARGETS[name].hear(data)        # returns, or raises what must not come out; `seeds` are good inputs

A target takes any bytes. It raises only where the companion breaks its word: an exception that is not the
one sentence of its contract, a record that no log could hold, a buffer beyond its bound, a deadline that does
not move. Checksums would keep a fuzzer out of all that lies behind them, so `frames` reads the bytes as a
script of what is to be said, and puts the right checksum to each; noise between frames is one of its words.

It knows nothing of who makes the bytes: `sitl.endurance.fuzz` with coverage as its guide, the tests at random.
"""

from __future__ import annotations

import contextlib
import math
import struct
import tempfile
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

from fastcrc import crc16

from companion import records
from companion.config import Config, ConfigError, InertialConfig, OutputConfig, load, parse, to_toml
from companion.link import dialect, frame
from companion.link.clock import BootClock
from companion.link.decode import MAKES, Sender, decode
from companion.link.session import MessageReceived, Session
from companion.link.signing import Signing
from companion.records import Mode, Solution, Stamped
from companion.runtime.core import Onboard
from companion.storage import container, flight_log
from companion.storage.reader import LogError

MILLI = 1_000_000
START_NS = 1000 * 1000 * MILLI
#: What anything here reads or answers; a script names them by their place.
SPOKEN = (
    *("HEARTBEAT", "SYSTEM_TIME", "TIMESYNC", "LOCAL_POSITION_NED", "GPS_GLOBAL_ORIGIN", "GPS_RAW_INT"),
    *("GPS2_RAW", "HOME_POSITION", "GLOBAL_POSITION_INT", "ATTITUDE", "ATTITUDE_QUATERNION", "VFR_HUD"),
    *("EKF_STATUS_REPORT", "ESTIMATOR_STATUS", "HIGHRES_IMU", "RAW_IMU", "SCALED_IMU", "AIRSPEED", "WIND"),
    *("WIND_COV", "SCALED_PRESSURE", "RSBN_MEASUREMENT", "SIM_STATE", "HIL_STATE_QUATERNION"),
    *("COMMAND_LONG", "COMMAND_INT", "COMMAND_ACK", "PARAM_REQUEST_READ", "PARAM_REQUEST_LIST", "PARAM_SET"),
)
SYSTEMS, COMPONENTS = (1, 2, 255, 0), (1, 42, 191, 190)
NOISE, SIGNED = 0x80, 0x40
_LINK = "fuzz"
_KEY = bytes(range(32))


class Target(NamedTuple):
    """A door: `hear` takes any bytes, `seeds` are some that belong there."""

    hear: Callable[[bytes], None]
    seeds: Callable[[], Sequence[bytes]]


# ---------------------------------------------------------------------------------------------------------
# Scripts: bytes <-> what is said, and when
# ---------------------------------------------------------------------------------------------------------


def frames(script: bytes) -> Iterator[tuple[int, bytes]]:
    """What `script` says: milliseconds since the last, and bytes: a frame with a right checksum, or noise.

    A word is five bytes (what, who, sequence, wait, length) and as many more as the length says. A signed
    frame's last 13 are its signature.
    """
    at = 0
    while at + 5 <= len(script):
        what, who, sequence, wait, length = script[at : at + 5]
        payload = script[at + 5 : at + 5 + length]
        at += 5 + length
        if what & NOISE:
            yield 10 * wait, payload
            continue
        name = SPOKEN[(what & 0x3F) % len(SPOKEN)]
        signature = b""
        if what & SIGNED:
            payload, signature = payload[:-13], payload[-13:].rjust(13, b"\0")
        yield 10 * wait, said(name, payload, who, sequence, signature)


def said(name: str, payload: bytes, who: int = 0, sequence: int = 0, signature: bytes = b"") -> bytes:
    """A frame with any payload; `who` picks system and component."""
    kind = dialect.type_named(name)
    system, component = SYSTEMS[who & 3], COMPONENTS[who >> 2 & 3]
    head = bytes((len(payload), len(signature) > 0, 0, sequence, system, component))
    body = head + kind.msgid.to_bytes(3, "little") + payload
    check = crc16.mcrf4xx(body + bytes((kind.crc_extra,)))
    return b"\xfd" + body + check.to_bytes(2, "little") + signature


def word(message: dialect.Message, wait_ms: int = 0, who: int = 0) -> bytes:
    """The word of a script that says `message`; mirror of `frames`."""
    name = dialect.TYPES[dialect.id_of(message)].name
    payload = dialect.payload(message).rstrip(b"\0")
    return bytes((SPOKEN.index(name), who, 0, wait_ms // 10, len(payload))) + payload


def _script(seconds: int = 8) -> bytes:
    """A little flight: an autopilot, its origin, inertial positions, air data, fixes of both kinds."""
    new = dialect.new
    words = [
        word(new("HEARTBEAT", type=1, autopilot=3)),
        word(new("GPS_GLOBAL_ORIGIN", latitude=600_000_000, longitude=300_000_000, altitude=10_000)),
    ]
    for i in range(2 * seconds):
        ms, x = 500 * i + 60_000, 20.0 * i
        lat = 600_000_000 + round(x / 0.0111)
        words += [
            word(new("SYSTEM_TIME", time_boot_ms=ms), 500),
            word(new("LOCAL_POSITION_NED", time_boot_ms=ms, x=x, y=3.0, z=-400.0, vx=40.0, vy=0.1)),
            word(new("ATTITUDE", time_boot_ms=ms, roll=0.01 * i, yaw=0.1)),
            word(new("SCALED_PRESSURE", time_boot_ms=ms, press_abs=960.0, temperature=1000)),
            word(new("VFR_HUD", airspeed=40.0 + 0.1 * i, heading=5, alt=400.0)),
            word(
                new(
                    "GPS_RAW_INT",
                    time_usec=1000 * ms,
                    fix_type=3,
                    lat=lat,
                    lon=300_000_500,
                    alt=410_000,
                    eph=80,
                    vel=4000,
                )
            ),
        ]
        if i % 2:
            words.append(
                word(
                    new(
                        "RSBN_MEASUREMENT",
                        time_usec=1000 * ms,
                        beacon_id=1,
                        status=3,
                        azimuth=4.615 - 1e-5 * i,
                        sigma_azimuth=2e-3,
                        sigma_range=100.0,
                        slant_range=60_000.0 - i,
                        beacon_lat=600_500_000,
                        beacon_lon=310_700_000,
                    ),
                    who=4,
                )
            )
    return b"".join(words)


def _dialogue() -> bytes:
    """What a ground station asks, and a second autopilot."""
    new, ours = dialect.new, {"target_system": 1, "target_component": 191}
    return b"".join(
        (
            word(new("HEARTBEAT", type=1, autopilot=12)),
            word(new("HEARTBEAT", type=1, autopilot=3), 20, who=1),
            word(new("TIMESYNC", ts1=5), 20),
            word(new("TIMESYNC", tc1=60_000_000_000, ts1=START_NS), 20),
            word(new("COMMAND_LONG", command=511, param1=331, param2=1e5, **ours), 20, who=14),
            word(new("COMMAND_LONG", command=512, param1=148, **ours), 20, who=14),
            word(new("COMMAND_INT", command=400, **ours), 20, who=14),
            word(new("PARAM_REQUEST_LIST", **ours), 20, who=14),
            word(new("PARAM_REQUEST_READ", param_id=b"GNSS_SIGMA_M", param_index=-1, **ours), 20, who=14),
            word(
                new("PARAM_SET", param_id=b"GNSS_SIGMA_M", param_value=3.0, param_type=9, **ours),
                1000,
                who=14,
            ),
        )
    )


# ---------------------------------------------------------------------------------------------------------
# The link
# ---------------------------------------------------------------------------------------------------------


def hear_stream(data: bytes) -> None:
    """The frame reader: every byte is accounted for once, and however the stream is cut the same is found."""
    whole = frame.Reader()
    events = whole.receive(data)
    _account(whole, events, len(data))
    step = 1 + (data[0] if data else 0)
    cut = frame.Reader()
    again: list[frame.Event] = []
    for at in range(0, len(data), step):
        again += cut.receive(data[at : at + step])
        assert cut.waiting <= frame.MOST_WAITING, f"{cut.waiting} bytes wait"
    assert again + cut.close() == events + whole.close(), f"cut into {step} bytes it reads otherwise"


def _account(reader: frame.Reader, events: Sequence[frame.Event], size: int) -> None:
    total = sum(len(e.raw) if isinstance(e, frame.Frame) else e.size for e in events)
    assert total + reader.waiting <= size < total + reader.waiting + frame.LONGEST_RUN
    for event in events:
        if isinstance(event, frame.Frame):
            dialect.decode(event)


def hear_wire(data: bytes) -> None:
    """Message -> records: each fit for the log, its time never after its arrival."""
    clock, now = BootClock(), START_NS
    clock.heard(60_000 * MILLI, now)
    reader = frame.Reader()
    for wait_ms, raw in frames(data):
        now += wait_ms * MILLI
        for found in reader.receive(raw):
            if isinstance(found, frame.Frame):
                make = MAKES.get(found.system, "other")
                for record in decode(dialect.decode(found), now, Sender(clock, make)):
                    fit(record)
                    assert record.rx_ns == now and record.t_ns <= now, record


def fit(record: Stamped) -> None:
    """That a record is one the log gives back as it was: no NaN, no number beyond JSON."""
    assert records.decode(type(record).__name__, records.encode(record)) == record, record


class Sieve:
    """A log that keeps nothing and looks at everything."""

    def record(self, record: Stamped, channel: str | None = None) -> None:
        """Look at one record."""
        fit(record)
        if isinstance(record, Solution) and record.mode is not Mode.INITIALISING:
            numbers = (record.lat, record.lon, record.alt_msl, *record.v_n, *record.covariance)
            assert all(map(math.isfinite, numbers)) and abs(record.lat) <= 1.6 and abs(record.lon) <= 3.2, (
                record
            )

    def frame(self, link: str, outgoing: bool, data: bytes, t_ns: int) -> None:
        """Look at one frame: what we send is ours to get right."""
        if outgoing:
            (found,) = frame.Reader().receive(data)
            assert isinstance(found, frame.Frame), found
            message = dialect.decode(found)
            places = [getattr(message, name, 0.0) for name in ("x", "y", "lat", "lon")]
            assert all(map(math.isfinite, places)), message


#: A position by every way there is.
ALL = OutputConfig(
    profile="custom",
    odometry_hz=10.0,
    vision_hz=10.0,
    gps_input_hz=10.0,
    global_position_sensor_hz=10.0,
    external_position_hz=1.0,
)


def hear_onboard(data: bytes) -> None:
    """The whole companion but its sockets: nothing raises, nothing is said that is no frame, time goes on.

    The first byte chooses the inertial channel. A position goes out by every way.
    """
    inertial = InertialConfig(source="air_data") if data[:1] > b"\x7f" else InertialConfig(independent=True)
    onboard = Onboard(Config(inertial=inertial, output=ALL), Sieve(), (_LINK,))
    now = START_NS
    for wait_ms, raw in frames(data[1:]):
        then = now + wait_ms * MILLI
        while onboard.deadline() <= then:
            now = max(now, onboard.deadline())
            onboard.poll(now)
            onboard.to_send(_LINK, now)
            assert onboard.deadline() > now, "what is due stays due"
        now = then
        onboard.receive(_LINK, raw, now)
        sent = onboard.to_send(_LINK, now)
        assert len(sent) <= 64, f"{len(sent)} frames for {len(raw)} bytes"
        onboard.take_events()


def hear_signed(data: bytes) -> None:
    """A signed link: nobody without the key is let in, but for what the configuration lets in."""
    session = Session(signing=Signing(_KEY, timestamp=1 << 40))
    now = START_NS
    for wait_ms, raw in frames(data):
        now += wait_ms * MILLI
        for event in session.receive(raw, now):
            if isinstance(event, MessageReceived):
                assert event.frame.msgid == 109, event  # RADIO_STATUS
        session.poll(now)
        session.to_send()


# ---------------------------------------------------------------------------------------------------------
# Files
# ---------------------------------------------------------------------------------------------------------


def hear_log(data: bytes) -> None:
    """The MCAP reader: records, or one sentence; the same of a torn log made whole again."""
    with tempfile.TemporaryDirectory(dir="/dev/shm" if Path("/dev/shm").is_dir() else None) as folder:
        path = Path(folder) / "x.mcap.active"
        path.write_bytes(data)
        for look in (_read, flight_log.info, flight_log.metadata, flight_log.recover):
            try:
                look(path)
            except LogError as error:
                assert "\n" not in str(error), error


def _read(path: Path) -> None:
    for _ in flight_log.read(path):
        pass


def small_log(content: bytes | None = None, chunked: bool = False) -> bytes:
    """A torn log of one message, `content`; its checksums are left out, so that a fuzzer gets behind them."""
    if content is None:
        content = records.encode(records.Event(5, 5, 6, "text"))
    text, record = container.text, container.record
    schema = struct.pack("<H", 1) + text("Event") + text("jsonschema") + text("{}")
    channel = struct.pack("<HH", 1, 1) + text("/out/Event") + text("json") + container.texts({})
    inner = record(container.SCHEMA, schema) + record(container.CHANNEL, channel)
    inner += record(container.MESSAGE, struct.pack("<HIQQ", 1, 0, 5, 5), content)
    head = container.MAGIC + record(container.HEADER, text(""), text("x"))
    head += record(container.METADATA, text("log"), container.texts({"a": "b"}))
    if not chunked:
        return head + inner
    sizes = struct.pack("<QQQI", 5, 5, len(inner), 0), struct.pack("<Q", len(inner))
    return head + record(container.CHUNK, sizes[0], text(""), sizes[1], inner)


def hear_config(data: bytes) -> None:
    """The configuration: one that can be written and read again, or one sentence, from whatever source."""
    text = data.decode("utf-8", "replace")
    with tempfile.TemporaryDirectory(dir="/dev/shm" if Path("/dev/shm").is_dir() else None) as folder:
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
    "stream": Target(hear_stream, lambda: [b"".join(raw for _, raw in frames(_script(1)))]),
    "wire": Target(hear_wire, lambda: [_script(1)]),
    "onboard": Target(hear_onboard, lambda: [b"\0" + _script(), b"\xff" + _script(), b"\0" + _dialogue()]),
    "signed": Target(hear_signed, lambda: [_script(1), _dialogue()]),
    "log": Target(hear_log, lambda: [small_log(), small_log(chunked=True)]),
    "config": Target(hear_config, lambda: [to_toml(Config()).encode(), b"[gnss]\nsigma_m = 3.0\n", b"2.5"]),
}
