"""PX4 onboard logs (ULog, `.ulg`), read with pyulog -> records, merged by time.

PX4 has renamed fields over the years: each is looked up under all of its names, and missing fields remain
None. Only instance 0 of each topic is read. Arrival and validity are the same instant, as the log is written
on board: UNIX time if a GPS provides it, else time since boot. Messages of the logger (texts, dropouts, a
damaged end) become events.
"""

from __future__ import annotations

import contextlib
import heapq
import io
import math
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, TypeAlias

from companion.link.dialect import mavlink
from companion.link.fields import euler
from companion.optional_dependencies import missing_package
from companion.records import (
    AirData,
    Attitude,
    Event,
    FilterStatus,
    Gnss,
    Imu,
    LocalOrigin,
    LocalPosition,
    Pressure,
    Severity,
    Stamped,
    Truth,
    Vector3,
    Wind,
)
from companion.storage.reader import LogError

Row: TypeAlias = dict[str, Any]
Topic: TypeAlias = Callable[[Row, int], Iterator[Stamped]]

_MAGIC = b"\x55\x4c\x6f\x67\x01\x12\x35"
_ZERO_CELSIUS = 273.15
_UNIX_AFTER_US = 10**15


def read(path: Path) -> Iterator[Stamped]:
    """Return the records of a `.ulg` by time. Raises LogError if it is not a ULog, or pyulog is missing."""
    log = _open_ulog(path)
    columns: dict[str, dict[str, list[Any]]] = {}
    for data in log.data_list:
        if data.multi_id == 0 and len(data.data.get("timestamp", ())):
            columns[data.name] = {name: values.tolist() for name, values in data.data.items()}
    if not columns:
        raise LogError(f"{path} is a ULog without any supported topic: it needs {', '.join(_TOPICS)}")
    epoch_us = _epoch_us(columns)
    if "vehicle_gps_position" in columns:
        columns.pop("sensor_gps", None)  # duplicates of vehicle_gps_position
    if "airspeed_validated" in columns:
        columns.pop("airspeed", None)
    topics = {name: make() for name, make in _TOPICS.items() if name in columns}
    if "vehicle_global_position_groundtruth" in columns:
        topics["vehicle_global_position_groundtruth"] = _truth_topic(columns)
    streams = [_records(path, name, columns[name], topic, epoch_us) for name, topic in topics.items()]
    events = sorted(_logger_events(log, epoch_us), key=lambda event: event.t_ns)
    return heapq.merge(*streams, events, key=lambda record: record.t_ns)


def _open_ulog(path: Path) -> Any:
    try:
        with path.open("rb") as file:
            head = file.read(len(_MAGIC))
    except OSError as error:
        raise LogError(f"{path} cannot be read: {error.strerror}") from None
    if not head:
        raise LogError(f"{path} is empty: nothing was recorded")
    if head != _MAGIC:
        raise LogError(f"{path} is not a ULog: wrong magic bytes at its beginning")
    try:
        from pyulog import ULog
    except ImportError:
        raise LogError(missing_package(str(path), "pyulog", "logs")) from None
    try:
        with path.open("rb") as file, contextlib.redirect_stdout(io.StringIO()):
            return ULog(file, [*_TOPICS, *_TRUTHS])
    except Exception as error:  # a damaged file raises various exceptions in pyulog
        raise LogError(f"{path} is damaged and cannot be read: {error or type(error).__name__}") from None


def _epoch_us(columns: dict[str, dict[str, list[Any]]]) -> int:
    """Return the offset from time since boot to UNIX time; 0 if no GPS provides it."""
    for name in ("vehicle_gps_position", "sensor_gps"):
        found = columns.get(name, {})
        for boot, utc in zip(found.get("timestamp", ()), found.get("time_utc_usec", ()), strict=False):
            if utc > _UNIX_AFTER_US:
                return int(utc) - int(boot)
    return 0


def _records(
    path: Path, name: str, columns: dict[str, list[Any]], topic: Topic, epoch_us: int
) -> Iterator[Stamped]:
    names = list(columns)
    for values in zip(*columns.values(), strict=True):
        row = dict(zip(names, values, strict=True))
        try:
            yield from topic(row, (row["timestamp"] + epoch_us) * 1000)
        except KeyError as error:
            raise LogError(f"{path}: topic {name} has no field {error}: unsupported PX4 version") from None


def _logger_events(log: Any, epoch_us: int) -> Iterator[Event]:
    def event(us: int, severity: int, text: str) -> Event:
        t = (us + epoch_us) * 1000
        return Event(t, t, severity, text)

    for line in log.logged_messages:
        severity = min(max(int(line.log_level) - ord("0"), 0), 7)
        yield event(line.timestamp, severity, line.message)
    for gap in log.dropouts:
        yield event(gap.timestamp, Severity.WARNING, f"logger dropout of {gap.duration} ms")
    if log.file_corruption:
        yield event(log.last_timestamp, Severity.WARNING, "the log is damaged: some data is missing")


def _finite(value: float | None) -> float | None:
    return value if value is not None and math.isfinite(value) else None


def _first_field(row: Row, *names: str) -> Any:
    """Return the field under the first of `names` that exists. Raises KeyError if none does."""
    for name in names:
        if name in row:
            return row[name]
    raise KeyError(names[0])


def _vector(row: Row, name: str) -> Vector3:
    return row[f"{name}[0]"], row[f"{name}[1]"], row[f"{name}[2]"]


def _gnss(row: Row, t: int) -> Iterator[Stamped]:
    new = "latitude_deg" in row
    lat, lon = (row["latitude_deg"], row["longitude_deg"]) if new else (row["lat"] / 1e7, row["lon"] / 1e7)
    alt_msl = row["altitude_msl_m"] if new else row["alt"] * 1e-3
    alt = row["altitude_ellipsoid_m"] if new else row["alt_ellipsoid"] * 1e-3
    fix = int(row["fix_type"])
    if fix >= mavlink.GPS_FIX_TYPE_2D_FIX and lat == lon == 0.0:
        return
    yield Gnss(
        t,
        t,
        receiver=0,
        stamp_us=t // 1000,  # each row is a fix; time_utc_usec of the receiver may change only once a second
        fix=fix,
        lat=math.radians(lat),
        lon=math.radians(lon),
        alt_msl=alt_msl,
        sigma_horizontal=_finite(row.get("eph")),
        sigma_vertical=_finite(row.get("epv")),
        v_n=(row["vel_n_m_s"], row["vel_e_m_s"], row["vel_d_m_s"]) if row["vel_ned_valid"] else None,
        sigma_velocity=_finite(row.get("s_variance_m_s")),
        satellites=int(row["satellites_used"]),
        hdop=_finite(row.get("hdop")),
        alt=alt,
    )


def _attitude(row: Row, t: int) -> Iterator[Stamped]:
    q = *_vector(row, "q"), row["q[3]"]
    rates = (row["rollspeed"], row["pitchspeed"], row["yawspeed"]) if "rollspeed" in row else None
    if math.isfinite(sum(q)):
        yield Attitude(t, t, *euler(q), rates)


def _imu(row: Row, t: int) -> Iterator[Stamped]:
    yield Imu(t, t, 0, _vector(row, "accelerometer_m_s2"), _vector(row, "gyro_rad"))


def _air_data(row: Row, t: int) -> Iterator[Stamped]:
    if (speed := _finite(row["true_airspeed_m_s"])) is not None:
        yield AirData(t, t, speed, True, sensed=True)


def _wind(row: Row, t: int) -> Iterator[Stamped]:
    north = _first_field(row, "variance_north", "covariance_north")
    variance = 0.5 * (north + _first_field(row, "variance_east", "covariance_east"))
    v_n = row["windspeed_north"], row["windspeed_east"], 0.0
    if math.isfinite(v_n[0] + v_n[1]):
        yield Wind(t, t, v_n, math.sqrt(variance) if variance > 0.0 else None)


def _pressure(row: Row, t: int) -> Iterator[Stamped]:
    celsius = _finite(row.get("ambient_temperature", row.get("baro_temp_celcius")))
    kelvin = None if celsius is None else celsius + _ZERO_CELSIUS
    yield Pressure(t, t, row["baro_pressure_pa"], None, kelvin)


def _status(row: Row, t: int) -> Iterator[Stamped]:
    flags = int(row["solution_status_flags"])
    glitch = bool(flags & mavlink.ESTIMATOR_GPS_GLITCH)
    ratio, accuracy = _finite(row["pos_test_ratio"]) or 0.0, _finite(row["pos_horiz_accuracy"])
    yield FilterStatus(t, t, flags, glitch, ratio, accuracy)


def _local_positions() -> Topic:
    """Convert the inertial channel, with its origin when stated or changed, and an event at each reset."""
    last: tuple[float, ...] = ()
    resets: int | None = None

    def topic(row: Row, t: int) -> Iterator[Stamped]:
        nonlocal last, resets
        if not (row["xy_valid"] and row["z_valid"]):
            return
        if row["xy_global"] and (origin := (row["ref_lat"], row["ref_lon"], row["ref_alt"])) != last:
            last = origin
            yield LocalOrigin(t, t, math.radians(origin[0]), math.radians(origin[1]), origin[2], "px4")
        counter = row.get("xy_reset_counter", 0)
        if resets is not None and counter != resets:
            yield Event(t, t, Severity.WARNING, "the autopilot reset its horizontal position")
        resets = counter
        yield LocalPosition(t, t, (row["x"], row["y"], row["z"]), (row["vx"], row["vy"], row["vz"]))

    return topic


_TRUTHS = (
    "vehicle_global_position_groundtruth",
    "vehicle_local_position_groundtruth",
)


def _truth_topic(columns: dict[str, dict[str, list[Any]]]) -> Topic:
    """Convert a simulator's truth: positions, each with the latest velocity of the local truth."""
    local = columns.get(_TRUTHS[1], {"timestamp": []})
    velocities = list(zip(*(local.get(name, ()) for name in ("timestamp", "vx", "vy", "vz")), strict=True))
    steps = iter(velocities)
    ahead = next(steps, None)
    v_n: Vector3 = (0.0, 0.0, 0.0)

    def topic(row: Row, t: int) -> Iterator[Stamped]:
        nonlocal ahead, v_n
        while ahead is not None and ahead[0] <= row["timestamp"]:
            v_n = ahead[1:]
            ahead = next(steps, None)
        yield Truth(t, t, math.radians(row["lat"]), math.radians(row["lon"]), row["alt"], v_n)

    return topic


def _stateless(topic: Topic) -> Callable[[], Topic]:
    return lambda: topic


_TOPICS: dict[str, Callable[[], Topic]] = {
    "vehicle_local_position": _local_positions,
    "vehicle_gps_position": _stateless(_gnss),
    "sensor_gps": _stateless(_gnss),
    "vehicle_attitude": _stateless(_attitude),
    "sensor_combined": _stateless(_imu),
    "airspeed_validated": _stateless(_air_data),
    "airspeed": _stateless(_air_data),
    "wind": _stateless(_wind),
    "wind_estimate": _stateless(_wind),
    "vehicle_air_data": _stateless(_pressure),
    "estimator_status": _stateless(_status),
}
