"""ArduPilot onboard logs (DataFlash, `.bin` binary or `.log` text) -> records.

    log = DataflashLog(path)
    for record in log: ...              # in the order of the file

`dataflash_messages` splits the file into messages; `MessageConverter` turns messages into records and does no
I/O, so that other formats with the same messages can use it. Arrival and validity are the same instant, as
the log is written on board: UNIX time if the log has a GPS time, else time since boot. Only the primary lane
of the filter is converted, EKF3 (XKF) before EKF2 (NKF): the core of column C, or, before ArduPilot 4.1,
messages 1 to 5 are lane 0 and 6 to 9 lane 1. Names and units are those of the @LoggerMessage comments in
ArduPilot's sources.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Iterator
from pathlib import Path

from companion.importers import dataflash_messages
from companion.importers.dataflash_messages import FoundMessage, Message
from companion.importers.foreign_file import (
    MAX_BOOT_US,
    MAX_TEXT,
    Damage,
    Step,
    finite,
    map_file,
    one_line,
    steady_steps,
)
from companion.link.decode import UERE
from companion.link.dialect import mavlink
from companion.nav.geometry import Geodetic, separation
from companion.records import (
    AirData,
    Attitude,
    Event,
    FilterStatus,
    GlobalPosition,
    Gnss,
    Imu,
    LocalOrigin,
    LocalPosition,
    Pressure,
    Reboot,
    Severity,
    Stamped,
    Truth,
    Vector3,
    Vehicle,
    Wind,
)
from companion.storage.reader import LogError
from companion.units import ZERO_CELSIUS

_EKF_ORIGIN = 0  # LogOriginType
_STATUS, _GLITCHING = 0x3FF, 1 << 14  # nav_filter_status; its first ten bits are EKF_STATUS_FLAGS
_FLYING = {18: False, 28: True}  # LogEvent: landed, not landed
_COPTER = ("ArduCopter", "APM:Copter")
_HELICOPTER = "Frame: HELI"
_PLANE = ("ArduPlane", "APM:Plane")
_QUADPLANE = "QuadPlane Frame"  # when it hovers is not logged
FLYING_M_S, LANDED_M_S = 10.0, 3.0  # of a plane whose log does not state that it flies
_WEEK_US = 604_800_000_000
_GPS_EPOCH_US = 315_964_800_000_000  # 1980-01-06, UNIX time
_LEAP_US = 18_000_000  # GPS - UTC since 2017
_MAX_WEEK = 6000  # the year 2095


class MessageConverter:
    """Converts the messages of one log to records, one by one.

    Keeps the earlier values that a record needs.
    """

    def __init__(self) -> None:
        self._lane = 0
        self._filter = "NKF1"  # until an XKF1 is seen
        self._accuracy: dict[int, tuple[float | None, float | None, float | None]] = {}
        self._v_n: Vector3 | None = None
        self._differential: float | None = None
        self._has_airspeed = False  # the log has ARSP
        self._is_plane = self._has_status = False  # the log names ArduPlane; it has STAT, which 2014 had not
        self._flying: bool | None = None  # of a plane, by STAT, or by its speed over ground
        self._true_v_n: Vector3 | None = None
        self._true: Truth | None = None
        self._first_alt: float | None = None  # m, of the first POS

    def records(self, name: str, message: Message, t_ns: int) -> Iterator[Stamped]:
        """Yield the records of a message of type `name`.

        Raises AttributeError if a required column is missing, TypeError, ValueError or OverflowError if a
        value does not fit it.
        """
        make = _TABLE.get(name)
        if make is not None:
            yield from make(self, name, message, t_ns)

    def _gps(self, name: str, m: Message, t: int) -> Iterator[Stamped]:
        """Convert a fix; its accuracy is that of the fix before, because GPA is logged after GPS."""
        receiver = getattr(m, "I", 0 if name == "GPS" else 1)
        lat, lon = math.radians(m.Lat), math.radians(m.Lng)
        fix = int(m.Status)
        if not (abs(m.Lat) <= 90.0 and abs(m.Lng) <= 180.0) or (
            fix >= mavlink.GPS_FIX_TYPE_2D_FIX and m.Lat == m.Lng == 0.0
        ):
            return
        week, ms = _gps_time(m)
        course = math.radians(m.GCrs)
        hdop = m.HDop if 0.0 < m.HDop < 99.0 else None
        horizontal, vertical, speed = self._accuracy.get(receiver, (None, None, None))
        if horizontal is None and hdop is not None:
            horizontal = hdop * UERE / math.sqrt(2.0)
        moving = (m.Spd * math.cos(course), m.Spd * math.sin(course), finite(getattr(m, "VZ", 0.0)) or 0.0)
        yield Gnss(
            t,
            t,
            receiver=receiver,
            stamp_us=int(week) * _WEEK_US + int(ms) * 1000,
            fix=fix,
            lat=lat,
            lon=lon,
            alt_msl=m.Alt,
            sigma_horizontal=horizontal,
            sigma_vertical=vertical,
            v_n=moving if fix >= mavlink.GPS_FIX_TYPE_3D_FIX else None,
            sigma_velocity=speed,
            satellites=int(m.NSats),
            hdop=hdop,
        )
        if self._is_plane and not self._has_status and fix >= mavlink.GPS_FIX_TYPE_3D_FIX:
            yield from self._flies(m.Spd > (LANDED_M_S if self._flying else FLYING_M_S), t)

    def _gps_accuracy(self, name: str, m: Message, t: int) -> Iterator[Stamped]:
        receiver = getattr(m, "I", 0 if name == "GPA" else 1)
        self._accuracy[receiver] = _positive(m.HAcc), _positive(m.VAcc), _positive(m.SAcc)
        return iter(())

    def _imu(self, name: str, m: Message, t: int) -> Iterator[Stamped]:
        source = getattr(m, "I", {"IMU": 0, "IMU2": 1, "IMU3": 2}[name])
        yield Imu(t, t, source, (m.AccX, m.AccY, m.AccZ), (m.GyrX, m.GyrY, m.GyrZ))

    def _attitude(self, name: str, m: Message, t: int) -> Iterator[Stamped]:
        heading = math.radians(m.Yaw) % math.tau
        yield Attitude(t, t, math.radians(m.Roll), math.radians(m.Pitch), heading)

    def _is_primary_lane(self, name: str, m: Message) -> bool:
        """Return whether the message is of the primary lane of the filter in use."""
        if name.startswith("X"):
            self._filter = "XKF1"
        lane = getattr(m, "C", int(name[3] > "5"))
        return name[0] == self._filter[0] and lane == self._lane

    def _local(self, name: str, m: Message, t: int) -> Iterator[Stamped]:
        if self._is_primary_lane(name, m):
            self._v_n = m.VN, m.VE, m.VD
            yield LocalPosition(t, t, (m.PN, m.PE, m.PD), self._v_n)

    def _wind(self, name: str, m: Message, t: int) -> Iterator[Stamped]:
        if self._is_primary_lane(name, m):
            yield Wind(t, t, (m.VWN, m.VWE, 0.0))

    def _status(self, name: str, m: Message, t: int) -> Iterator[Stamped]:
        if (primary := getattr(m, "PI", -1)) >= 0 and name[0] in ("X", self._filter[0]):
            self._lane = primary
        if self._is_primary_lane(name, m):
            glitch = bool(m.SS & _GLITCHING)
            flags = (m.SS & _STATUS) | (mavlink.EKF_GPS_GLITCHING if glitch else 0)
            yield FilterStatus(t, t, flags, glitch, finite(m.SP) or 0.0)

    def _origin(self, name: str, m: Message, t: int) -> Iterator[Stamped]:
        if m.Type == _EKF_ORIGIN and (m.Lat or m.Lng):
            yield LocalOrigin(t, t, math.radians(m.Lat), math.radians(m.Lng), m.Alt, "ardupilot")

    def _global(self, name: str, m: Message, t: int) -> Iterator[Stamped]:
        """Convert a position; logs before ArduCopter 3.5 name its height RelAlt, or have none."""
        if self._first_alt is None:
            self._first_alt = m.Alt
        if self._v_n is not None:
            lat, lon = math.radians(m.Lat), math.radians(m.Lng)
            above_home = getattr(m, "RelHomeAlt", getattr(m, "RelAlt", m.Alt - self._first_alt))
            yield GlobalPosition(t, t, lat, lon, m.Alt, self._v_n, above_home)

    def _airspeed(self, name: str, m: Message, t: int) -> Iterator[Stamped]:
        """Convert the primary sensor; its airspeed is no sensor's to rely on where unhealthy or not used."""
        if getattr(m, "I", 0) == getattr(m, "Pri", 0) and math.isfinite(m.Airspeed):
            self._differential = finite(getattr(m, "DiffPress", math.nan))
            self._has_airspeed = True
            yield AirData(t, t, m.Airspeed, sensed=bool(getattr(m, "H", 1) and getattr(m, "U", 1)))

    def _navigation_tuning(self, name: str, m: Message, t: int) -> Iterator[Stamped]:
        """Convert the sensor's airspeed of a plane's NTUN up to 3.x; without a sensor it is 0."""
        airspeed = finite(getattr(m, "Arspd", math.nan))
        if airspeed and not self._has_airspeed:
            yield AirData(t, t, airspeed, sensed=True)

    def _baro(self, name: str, m: Message, t: int) -> Iterator[Stamped]:
        if getattr(m, "I", 0) == 0 and m.Press > 0.0:
            yield Pressure(t, t, m.Press, self._differential, m.Temp + ZERO_CELSIUS)

    def _true_velocity(self, name: str, m: Message, t: int) -> Iterator[Stamped]:
        self._true_v_n = m.VN, m.VE, m.VD
        return iter(())

    def _truth(self, name: str, m: Message, t: int) -> Iterator[Stamped]:
        """Convert SIM; its velocity is that of SIM2, else the difference of the last two positions."""
        lat, lon = math.radians(m.Lat), math.radians(m.Lng)
        v_n = self._true_v_n
        if v_n is None:
            last = self._true
            if last is None or t <= last.t_ns:
                v_n = (0.0, 0.0, 0.0)
            else:
                moved = separation(Geodetic(lat, lon, m.Alt), Geodetic(last.lat, last.lon, last.alt))
                north, east, down = (metres / ((t - last.t_ns) * 1e-9) for metres in moved)
                v_n = north, east, down
        attitude = math.radians(m.Roll), math.radians(m.Pitch), math.radians(m.Yaw) % math.tau
        self._true = Truth(t, t, lat, lon, m.Alt, v_n, attitude)
        yield self._true

    def _text(self, name: str, m: Message, t: int) -> Iterator[Stamped]:
        text = str(m.Message)
        if text.startswith((*_COPTER, _HELICOPTER)):
            yield Vehicle(t, t, multirotor=not text.startswith(_HELICOPTER))
        elif text.startswith((*_PLANE, _QUADPLANE)):
            self._is_plane = True
            yield Vehicle(t, t, fixed_wing=not text.startswith(_QUADPLANE))
        yield Event(t, t, Severity.INFO, text[:MAX_TEXT])

    def _landed(self, name: str, m: Message, t: int) -> Iterator[Stamped]:
        if (flying := _FLYING.get(m.Id)) is not None:
            yield Vehicle(t, t, flying=flying)

    def _flight_state(self, name: str, m: Message, t: int) -> Iterator[Stamped]:
        self._has_status = True
        yield from self._flies(bool(m.isFlying), t)

    def _flies(self, flying: bool, t: int) -> Iterator[Stamped]:
        if flying != self._flying:
            self._flying = flying
            yield Vehicle(t, t, flying=flying)

    def _error(self, name: str, m: Message, t: int) -> Iterator[Stamped]:
        yield Event(t, t, Severity.WARNING, f"the autopilot logged error {m.ECode} of subsystem {m.Subsys}")


_TABLE: dict[str, Callable[[MessageConverter, str, Message, int], Iterator[Stamped]]] = {
    **dict.fromkeys(("GPS", "GPS2"), MessageConverter._gps),
    **dict.fromkeys(("GPA", "GPA2"), MessageConverter._gps_accuracy),
    **dict.fromkeys(("IMU", "IMU2", "IMU3"), MessageConverter._imu),
    **dict.fromkeys(("XKF1", "NKF1", "XKF6", "NKF6"), MessageConverter._local),
    **dict.fromkeys(("XKF2", "NKF2", "XKF7", "NKF7"), MessageConverter._wind),
    **dict.fromkeys(("XKF4", "NKF4", "XKF9", "NKF9"), MessageConverter._status),
    "ATT": MessageConverter._attitude,
    "ORGN": MessageConverter._origin,
    "POS": MessageConverter._global,
    "ARSP": MessageConverter._airspeed,
    "NTUN": MessageConverter._navigation_tuning,
    "BARO": MessageConverter._baro,
    "SIM2": MessageConverter._true_velocity,
    "SIM": MessageConverter._truth,
    "MSG": MessageConverter._text,
    "ERR": MessageConverter._error,
    "EV": MessageConverter._landed,
    "STAT": MessageConverter._flight_state,
}
NAMES = tuple(_TABLE)


class DataflashLog:
    """An opened `.bin` or `.log` file, to be iterated once.

    Raises LogError if it is empty, not a DataFlash log, or unreadable.
    """

    def __init__(self, path: Path) -> None:
        self.damage = Damage()
        self._data = map_file(path)
        binary = dataflash_messages.is_binary(self._data[:65536])
        if binary is None:
            raise LogError(f"{path} is not a DataFlash log: no message format at its beginning")
        self._binary = binary
        self._missing: set[str] = set()  # types of message without a required column

    def __iter__(self) -> Iterator[Stamped]:
        """Yield records in the order of the file. Messages without a required column are not converted."""
        epoch_us, converter = self._epoch_us(), MessageConverter()
        messages = self._messages(NAMES, self.damage)
        stamped = ((boot_time_us(m), place, (name, m)) for place, name, m in messages)
        for step in steady_steps(stamped, self.damage):
            t_ns = (epoch_us + step.shift_us + step.boot_us) * 1000
            if step.reboot:
                converter = MessageConverter()
                yield Reboot(t_ns, t_ns, 1)
            yield from self._converted(converter, step, t_ns)

    def _messages(self, names: Collection[str], damage: Damage) -> Iterator[FoundMessage]:
        return dataflash_messages.messages(self._data, names, damage, binary=self._binary)

    def _converted(self, converter: MessageConverter, step: Step, t_ns: int) -> Iterator[Stamped]:
        name, message = step.item
        try:
            yield from converter.records(name, message, t_ns)
        except AttributeError as error:
            if name not in self._missing:
                self._missing.add(name)
                self.damage.add(f"message {name}", 0, f"no column {error.name}")
        except (TypeError, ValueError, OverflowError) as error:
            self.damage.add(f"message {name} at {step.boot_us} us", 0, one_line(error))

    def _epoch_us(self) -> int:
        """Return UNIX time minus boot time by the first GPS fix; 0 if there is none."""
        for _, _, m in self._messages(("GPS",), Damage()):
            week, ms = _gps_time(m)
            has_fix = getattr(m, "Status", 0) >= mavlink.GPS_FIX_TYPE_3D_FIX and 0 < week < _MAX_WEEK
            if has_fix and (boot_us := boot_time_us(m)) is not None and 0 <= boot_us <= MAX_BOOT_US:
                return _GPS_EPOCH_US + int(week) * _WEEK_US + int(ms) * 1000 - _LEAP_US - boot_us
        return 0


def _gps_time(m: Message) -> tuple[float, float]:
    """Return week and milliseconds of the week of a GPS message."""
    return getattr(m, "GWk", getattr(m, "Week", 0)), getattr(m, "GMS", getattr(m, "TimeMS", 0))


def boot_time_us(m: Message) -> int | None:
    """Return the time since boot (TimeUS, TimeMS or T; in an old GPS message TimeMS is the time of week).

    -1 if it is not a number, or beyond `MAX_BOOT_US`.
    """
    value, scale = getattr(m, "TimeUS", None), 1
    if value is None:
        value, scale = getattr(m, "T", None), 1000
    if value is None and not hasattr(m, "Week"):
        value = getattr(m, "TimeMS", None)
    if value is None:
        return None
    return int(value) * scale if isinstance(value, int | float) and 0 <= value <= MAX_BOOT_US else -1


def _positive(value: float) -> float | None:
    return value if 0.0 < value < 600.0 else None  # ArduPilot's "not known" is 655.35
