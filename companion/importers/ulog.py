"""PX4 onboard logs (ULog, `.ulg`) -> records, in order of time.

PX4 has renamed fields over the years: each is looked up under all of its names, and missing fields remain
None. Only instance 0 of each topic is read. Arrival and validity are the same instant, as the log is written
on board: UNIX time if a GPS provides it, else time since boot. Texts and dropouts of the logger become
events.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Iterator
from pathlib import Path
from typing import Any, TypeAlias

from companion.importers import ulog_messages
from companion.importers.foreign_file import (
    MAX_BACK_US,
    MAX_STEP_US,
    MAX_TEXT,
    Damage,
    finite,
    in_order,
    map_file,
    one_line,
    steady_steps,
)
from companion.importers.ulog_messages import Dropout, LoggedText, Row
from companion.link.decode import FIXED_WINGS, MULTIROTORS
from companion.link.dialect import mavlink
from companion.link.fields import euler
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
    Vehicle,
    Wind,
)
from companion.storage.reader import LogError
from companion.units import ZERO_CELSIUS

Topic: TypeAlias = Callable[[Row, int], Iterator[Stamped]]

_AIRSPEED_SENSORS = 1, 2, 3  # airspeed_source, selected_airspeed_index
_UNIX_FROM_US, _UNIX_TO_US = 10**15, 4_102_444_800_000_000  # 2001, 2100


class UlogFile:
    """An opened `.ulg`, to be iterated once. Raises LogError if it is not a ULog."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.damage = Damage()
        self._data = map_file(path)
        if self._data[: len(ulog_messages.MAGIC)] != ulog_messages.MAGIC:
            raise LogError(f"{path} is not a ULog: wrong magic bytes at its beginning")
        self._faulty: set[str] = set()  # topics without a required field
        self._start_us = self._clock_start_us()
        self._stale_us = 0  # what is older was published before the log began

    def __iter__(self) -> Iterator[Stamped]:
        """Yield records by time. Rows of a topic without a required field are not converted."""
        try:
            topics, epoch_us = self._survey()
        except ValueError as error:
            raise LogError(f"{self.path} cannot be read: {error}") from None
        return in_order(self._records(topics, epoch_us))

    def _survey(self) -> tuple[dict[str, Topic], int]:
        """Return the topics to convert, and UNIX time minus boot time (0 if no GPS provides it)."""
        seen, epoch_us, stale, rows = set[str](), 0, 0, 0
        began_us = int.from_bytes(self._data[8:16], "little") - self._start_us - MAX_BACK_US
        for found in ulog_messages.messages(self._data, TOPICS, Damage()):
            if isinstance(found, ulog_messages.TopicRow):
                seen.add(found.topic)
                utc, boot = found.row.get("time_utc_usec"), self._boot_us(found)
                stale, rows = stale + (boot is not None and 0 <= boot < began_us), rows + 1
                if type(utc) is int and boot is not None and _UNIX_FROM_US < utc < _UNIX_TO_US and boot >= 0:
                    epoch_us = epoch_us or utc - min(boot, utc)
        if 2 * stale < rows:  # or the start that the header states is damaged
            self._stale_us = began_us
        found_topics = supported_topics(seen)
        if not found_topics:
            needed = ", ".join(TOPICS)
            raise LogError(f"{self.path} is a ULog without any supported topic: it needs {needed}")
        return found_topics | _truth_topics(), epoch_us

    def _records(self, topics: dict[str, Topic], epoch_us: int) -> Iterator[Stamped]:
        found = ulog_messages.messages(self._data, topics, self.damage)
        for step in steady_steps(((self._boot_us(m), m.place, m) for m in found), self.damage):
            t_ns = (step.boot_us + step.shift_us + epoch_us) * 1000
            match step.item:
                case LoggedText(_, _, severity, text):
                    yield Event(t_ns, t_ns, severity, text[:MAX_TEXT])
                case Dropout(_, duration_ms):
                    yield Event(t_ns, t_ns, Severity.WARNING, f"logger dropout of {duration_ms} ms")
                case (_, name, row):
                    yield from self._converted(name, topics[name], row, t_ns)

    def _clock_start_us(self) -> int:
        """Return where the clock is taken to begin: 0, or near the start of a log that counts UNIX time.

        PX4's clock does so in some simulations. The first rows may be older than the log.
        """
        start = int.from_bytes(self._data[8:16], "little")
        return start - MAX_STEP_US if _UNIX_FROM_US < start < _UNIX_TO_US else 0

    def _boot_us(self, found: ulog_messages.TopicRow | LoggedText | Dropout) -> int | None:
        """Return the stamp; none of what was last published before the log began, which it begins with."""
        if isinstance(found, Dropout):
            return None
        stamp = found.boot_us if isinstance(found, LoggedText) else found.row.get("timestamp")
        boot_us = stamp - self._start_us if type(stamp) is int else -1
        return None if 0 <= boot_us < self._stale_us else boot_us

    def _converted(self, name: str, topic: Topic, row: Row, t_ns: int) -> Iterator[Stamped]:
        try:
            yield from topic(row, t_ns)
        except KeyError as error:
            if name not in self._faulty:
                self._faulty.add(name)
                self.damage.add(f"topic {name}", 0, f"no field {error}: unsupported PX4 version")
        except (TypeError, ValueError, OverflowError) as error:
            self.damage.add(f"topic {name} at {row.get('timestamp')} us", 0, one_line(error))


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
        sigma_horizontal=finite(row.get("eph")),
        sigma_vertical=finite(row.get("epv")),
        v_n=(row["vel_n_m_s"], row["vel_e_m_s"], row["vel_d_m_s"]) if row["vel_ned_valid"] else None,
        sigma_velocity=finite(row.get("s_variance_m_s")),
        satellites=int(row["satellites_used"]),
        hdop=finite(row.get("hdop")),
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
    """Convert the airspeed of a sensor, not one that PX4 computes: ground speed minus wind, or synthetic."""
    source = row.get("airspeed_source", row.get("selected_airspeed_index", _AIRSPEED_SENSORS[0]))
    if source in _AIRSPEED_SENSORS and (speed := finite(row["true_airspeed_m_s"])) is not None:
        yield AirData(t, t, speed, True, sensed=True)


def _wind(row: Row, t: int) -> Iterator[Stamped]:
    north = _first_field(row, "variance_north", "covariance_north")
    variance = 0.5 * (north + _first_field(row, "variance_east", "covariance_east"))
    v_n = row["windspeed_north"], row["windspeed_east"], 0.0
    if math.isfinite(v_n[0] + v_n[1]):
        yield Wind(t, t, v_n, math.sqrt(variance) if variance > 0.0 else None)


def _pressure(row: Row, t: int) -> Iterator[Stamped]:
    celsius = finite(row.get("ambient_temperature", row.get("baro_temp_celcius")))
    kelvin = None if celsius is None else celsius + ZERO_CELSIUS
    yield Pressure(t, t, row["baro_pressure_pa"], None, kelvin)


def _status(row: Row, t: int) -> Iterator[Stamped]:
    flags = int(row["solution_status_flags"])
    glitch = bool(flags & mavlink.ESTIMATOR_GPS_GLITCH)
    ratio, accuracy = finite(row["pos_test_ratio"]) or 0.0, finite(row["pos_horiz_accuracy"])
    yield FilterStatus(t, t, flags, glitch, ratio, accuracy)


def _vehicle(row: Row, t: int) -> Iterator[Stamped]:
    kind = row["system_type"]
    yield Vehicle(t, t, kind in MULTIROTORS, fixed_wing=kind in FIXED_WINGS)


def _landed(row: Row, t: int) -> Iterator[Stamped]:
    yield Vehicle(t, t, flying=not row["landed"])


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


def _truth_topics() -> dict[str, Topic]:
    """Convert a simulator's truth: positions, each with the latest velocity of the local truth."""
    v_n: Vector3 = (0.0, 0.0, 0.0)

    def velocity(row: Row, t: int) -> Iterator[Stamped]:
        nonlocal v_n
        v_n = row["vx"], row["vy"], row["vz"]
        return iter(())

    def position(row: Row, t: int) -> Iterator[Stamped]:
        yield Truth(t, t, math.radians(row["lat"]), math.radians(row["lon"]), row["alt"], v_n)

    return {
        "vehicle_local_position_groundtruth": velocity,
        "vehicle_global_position_groundtruth": position,
    }


TOPICS: dict[str, Callable[[], Topic]] = {
    "vehicle_local_position": _local_positions,
    "vehicle_gps_position": lambda: _gnss,
    "sensor_gps": lambda: _gnss,
    "vehicle_attitude": lambda: _attitude,
    "sensor_combined": lambda: _imu,
    "airspeed_validated": lambda: _air_data,
    "airspeed": lambda: _air_data,
    "wind": lambda: _wind,
    "wind_estimate": lambda: _wind,
    "vehicle_air_data": lambda: _pressure,
    "estimator_status": lambda: _status,
    "vehicle_status": lambda: _vehicle,
    "vehicle_land_detected": lambda: _landed,
}
"""Topics that are converted, each with the maker of its conversion."""


def supported_topics(names: Collection[str]) -> dict[str, Topic]:
    """Return the conversions for those of the topics `names` that are of use, each fact from one topic."""
    doubled = {"sensor_gps"} if "vehicle_gps_position" in names else set()
    if "airspeed_validated" in names:
        doubled.add("airspeed")
    return {name: make() for name, make in TOPICS.items() if name in names and name not in doubled}
