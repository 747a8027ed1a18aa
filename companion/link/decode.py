"""Message -> records. Never raises on what a foreign sender put into a message.

Absence has many spellings on the wire: NaN, all ones, zero time, zero accuracy. Each becomes `None` where
the record allows it; where the record needs the number, the message becomes a `Rejection` that says why.
A message that carries no measurement by its own word (no airspeed sensor, a compass without an
accelerometer) becomes nothing at all.

Headings come out in [0, 2 pi). Times go through the sender's `Clock`; what is sent without a time is stamped
with its arrival, less what the link is late by.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Literal, NamedTuple, Protocol, TypeAlias

from companion.link import dialect
from companion.link.fields import (
    Message,
    Refused,
    accuracy,
    dilution,
    euler,
    known_position,
    maybe,
    maybe_vector,
    number,
    position,
    vector,
    wrapped,
)
from companion.records import (
    AirData,
    Attitude,
    FilterStatus,
    GlobalPosition,
    Gnss,
    HomePosition,
    Imu,
    LocalOrigin,
    LocalPosition,
    Pressure,
    Rejection,
    RsbnFix,
    Stamped,
    SystemTime,
    Truth,
    Wind,
)

Autopilot: TypeAlias = Literal["ardupilot", "px4", "other"]
MAKES: dict[int, Autopilot] = {3: "ardupilot", 12: "px4"}  # MAV_AUTOPILOT

UERE = 4.0
"""User range error, one sigma, m, that turns a dilution of precision into metres where a receiver gives no
accuracy of its own: 7.8 m at 95 % (GPS SPS Performance Standard, 4th edition 2008, table 3.4-1)."""
G = 9.80665
"""Standard gravity, m/s^2: MAVLink's mG are thousandths of it."""
_ZERO_CELSIUS = 273.15
FARTHEST, FASTEST, HIGHEST = 2.1e7, 3e3, 1e5
"""Beyond these no number is a measurement: half the earth's girth (m), 3 km/s, 100 km. Filters that square
them would still give numbers, but none that mean anything."""
_UNIX_AFTER_US = 10**15  # 2001; a smaller number of microseconds is no date

_RSBN_AZIMUTH, _RSBN_RANGE, _RSBN_TEST, _RSBN_MEMORY = 1, 2, 4, 8
_AIRSPEED_UNHEALTHY = 1
_HIGHRES_INERTIAL, _HIGHRES_PRESSURE, _HIGHRES_DIFFERENTIAL, _HIGHRES_TEMPERATURE = 0x3F, 0x200, 0x400, 0x1000
_EKF_GPS_GLITCHING = 32768  # of EKF_STATUS_FLAGS
_ESTIMATOR_GPS_GLITCH = 1024  # of ESTIMATOR_STATUS_FLAGS; there 1024 is EKF_UNINITIALIZED


class Clock(Protocol):
    """How a sender's times map onto the companion's one clock (`link.clock.BootClock` is one)."""

    def local(self, stamp: int, received: int, /) -> int:
        """When `stamp` was, all in nanoseconds: time since boot or since 1970, told apart by magnitude; 0 is
        "unknown" and gives `received`, less what the link is late by."""


class Sender(NamedTuple):
    """Whose messages these are: the clock they are stamped by, and the habits that differ by make.

    `sigma_azimuth` (rad) and `sigma_range` (m) stand in where an RSBN_MEASUREMENT leaves them open.
    """

    clock: Clock
    autopilot: Autopilot = "other"
    sigma_azimuth: float = math.radians(0.25)
    sigma_range: float = 200.0


_Decoder: TypeAlias = Callable[[Message, int, Sender], tuple[Stamped, ...]]
_DECODERS: dict[int, _Decoder] = {}


def decode(message: Message, rx_ns: int, sender: Sender) -> tuple[Stamped, ...]:
    """The records in `message`, received at `rx_ns` from `sender`; empty where it carries none.

    Never raises on a message's content: what cannot be used becomes a `Rejection` stamped `rx_ns`.
    """
    decoder = _DECODERS.get(dialect.id_of(message))
    if decoder is None:
        return ()
    try:
        return decoder(message, rx_ns, sender)
    except Refused as refused:
        name = dialect.TYPES[dialect.id_of(message)].name
        return (Rejection(rx_ns, rx_ns, name, str(refused), refused.value, refused.limit),)


def _of(*names: str) -> Callable[[_Decoder], _Decoder]:
    """Enter a function into the table under the messages' names."""

    def enter(decoder: _Decoder) -> _Decoder:
        for name in names:
            _DECODERS[dialect.type_named(name).msgid] = decoder
        return decoder

    return enter


def _booted(message: Message, rx: int, sender: Sender) -> int:
    return sender.clock.local(message.time_boot_ms * 1_000_000, rx)


def _stamped(message: Message, rx: int, sender: Sender) -> int:
    return sender.clock.local(message.time_usec * 1000, rx)


def _unstamped(rx: int, sender: Sender) -> int:
    return sender.clock.local(0, rx)


# ---------------------------------------------------------------------------------------------------------
# Satellite navigation
# ---------------------------------------------------------------------------------------------------------


@_of("GPS_RAW_INT", "GPS2_RAW")
def _gnss(m: Message, rx: int, sender: Sender) -> tuple[Stamped, ...]:
    """A fix; without one (`fix` below 2) too, so that its loss is seen.

    The receiver's `h_acc` is taken as the sigma of each axis, as both autopilots' filters do. Neither message
    has a vertical velocity: `v_n` is horizontal, its third component 0.
    """
    lat, lon = known_position(m) if m.fix_type >= 2 else position(m.lat, m.lon)
    hdop, vdop = dilution(m.eph), dilution(m.epv)
    sigma_horizontal, sigma_vertical = accuracy(m.h_acc), accuracy(m.v_acc)
    if sigma_horizontal is None and hdop:
        sigma_horizontal = UERE * hdop / math.sqrt(2.0)  # HDOP is of both axes together
    if sigma_vertical is None and vdop:
        sigma_vertical = UERE * vdop
    v_n = None
    if m.fix_type >= 2 and m.vel != 0xFFFF and m.cog <= 36000:
        speed, course = m.vel * 0.01, math.radians(m.cog * 0.01)
        v_n = (speed * math.cos(course), speed * math.sin(course), 0.0)
    return (
        Gnss(
            t_ns=_stamped(m, rx, sender),
            rx_ns=rx,
            receiver=0 if dialect.id_of(m) == 24 else 1,
            stamp_us=m.time_usec,
            fix=m.fix_type,
            lat=lat,
            lon=lon,
            alt_msl=m.alt * 1e-3,
            sigma_horizontal=sigma_horizontal,
            sigma_vertical=sigma_vertical,
            v_n=v_n,
            sigma_velocity=accuracy(m.vel_acc),
            satellites=None if m.satellites_visible == 0xFF else m.satellites_visible,
            hdop=hdop,
            alt=m.alt_ellipsoid * 1e-3 if m.alt_ellipsoid else None,
        ),
    )


# ---------------------------------------------------------------------------------------------------------
# What the autopilot estimates
# ---------------------------------------------------------------------------------------------------------


@_of("LOCAL_POSITION_NED")
def _local_position(m: Message, rx: int, sender: Sender) -> tuple[Stamped, ...]:
    x_n, v_n = vector(m, "x y z", limit=FARTHEST), vector(m, "vx vy vz", limit=FASTEST)
    return (LocalPosition(_booted(m, rx, sender), rx, x_n, v_n),)


@_of("GPS_GLOBAL_ORIGIN")
def _local_origin(m: Message, rx: int, sender: Sender) -> tuple[Stamped, ...]:
    lat, lon = known_position(m, "latitude", "longitude")
    projection = "tangent" if sender.autopilot == "other" else sender.autopilot
    t_ns = _stamped(m, rx, sender)
    return (LocalOrigin(t_ns, rx, lat, lon, m.altitude * 1e-3, projection),)


@_of("HOME_POSITION")
def _home_position(m: Message, rx: int, sender: Sender) -> tuple[Stamped, ...]:
    lat, lon = known_position(m, "latitude", "longitude")
    return (HomePosition(_stamped(m, rx, sender), rx, lat, lon, m.altitude * 1e-3),)


@_of("GLOBAL_POSITION_INT")
def _global_position(m: Message, rx: int, sender: Sender) -> tuple[Stamped, ...]:
    lat, lon = known_position(m)
    v_n = vector(m, "vx vy vz", 0.01)
    heading = None if m.hdg == 0xFFFF else wrapped(math.radians(m.hdg * 0.01))
    t_ns = _booted(m, rx, sender)
    return (GlobalPosition(t_ns, rx, lat, lon, m.alt * 1e-3, v_n, m.relative_alt * 1e-3, heading),)


@_of("ATTITUDE")
def _attitude(m: Message, rx: int, sender: Sender) -> tuple[Stamped, ...]:
    roll, pitch, yaw = vector(m, "roll pitch yaw")
    w_b = maybe_vector(m, "rollspeed pitchspeed yawspeed")
    return (Attitude(_booted(m, rx, sender), rx, roll, pitch, wrapped(yaw), w_b),)


@_of("ATTITUDE_QUATERNION")
def _attitude_quaternion(m: Message, rx: int, sender: Sender) -> tuple[Stamped, ...]:
    q = number(m, "q1"), number(m, "q2"), number(m, "q3"), number(m, "q4")
    return (
        Attitude(_booted(m, rx, sender), rx, *euler(q), maybe_vector(m, "rollspeed pitchspeed yawspeed")),
    )


@_of("EKF_STATUS_REPORT")
def _ekf_status(m: Message, rx: int, sender: Sender) -> tuple[Stamped, ...]:
    """ArduPilot's `pos_horiz_variance` is an innovation test ratio; it says nothing of accuracy."""
    ratio = number(m, "pos_horiz_variance")
    return (FilterStatus(_unstamped(rx, sender), rx, m.flags, bool(m.flags & _EKF_GPS_GLITCHING), ratio),)


@_of("ESTIMATOR_STATUS")
def _estimator_status(m: Message, rx: int, sender: Sender) -> tuple[Stamped, ...]:
    """PX4 sends NaN for the ratio while no position is tested: 0, as ArduPilot says then."""
    accuracy = maybe(m, "pos_horiz_accuracy") if sender.autopilot == "px4" else None
    ratio = maybe(m, "pos_horiz_ratio") or 0.0
    glitch = bool(m.flags & _ESTIMATOR_GPS_GLITCH)
    return (FilterStatus(_stamped(m, rx, sender), rx, m.flags, glitch, ratio, accuracy),)


@_of("SYSTEM_TIME")
def _system_time(m: Message, rx: int, sender: Sender) -> tuple[Stamped, ...]:
    unix_ns = m.time_unix_usec * 1000 if m.time_unix_usec > _UNIX_AFTER_US else None
    return (SystemTime(_booted(m, rx, sender), rx, m.time_boot_ms * 1_000_000, unix_ns),)


# ---------------------------------------------------------------------------------------------------------
# Inertial, air and radio sensors
# ---------------------------------------------------------------------------------------------------------


@_of("HIGHRES_IMU")
def _highres_imu(m: Message, rx: int, sender: Sender) -> tuple[Stamped, ...]:
    t_ns = _stamped(m, rx, sender)
    updated = m.fields_updated
    records: tuple[Stamped, ...] = ()
    if updated & _HIGHRES_INERTIAL == _HIGHRES_INERTIAL:
        records += (Imu(t_ns, rx, m.id, vector(m, "xacc yacc zacc"), vector(m, "xgyro ygyro zgyro")),)
    if updated & _HIGHRES_PRESSURE:
        static = number(m, "abs_pressure", 100.0)
        differential = maybe(m, "diff_pressure", 100.0) if updated & _HIGHRES_DIFFERENTIAL else None
        celsius = maybe(m, "temperature") if updated & _HIGHRES_TEMPERATURE else None
        kelvin = None if celsius is None else celsius + _ZERO_CELSIUS
        records += (Pressure(t_ns, rx, static, differential, kelvin),)
    return records


def _scaled_imu(m: Message, t_ns: int, rx: int, source: int) -> tuple[Stamped, ...]:
    f_b = vector(m, "xacc yacc zacc", 1e-3 * G)
    if f_b == (0.0, 0.0, 0.0):
        return ()  # a compass without an accelerometer: exactly 0 in all three is no specific force
    return (Imu(t_ns, rx, source, f_b, vector(m, "xgyro ygyro zgyro", 1e-3)),)


@_of("RAW_IMU")
def _raw_imu(m: Message, rx: int, sender: Sender) -> tuple[Stamped, ...]:
    """By the standard in units of the sensor's own; ArduPilot sends mG and mrad/s, so of it alone."""
    if sender.autopilot != "ardupilot":
        return ()
    return _scaled_imu(m, _stamped(m, rx, sender), rx, m.id)


@_of("SCALED_IMU", "SCALED_IMU2", "SCALED_IMU3")
def _numbered_imu(m: Message, rx: int, sender: Sender) -> tuple[Stamped, ...]:
    return _scaled_imu(m, _booted(m, rx, sender), rx, {26: 0, 116: 1, 129: 2}[dialect.id_of(m)])


@_of("VFR_HUD")
def _vfr_hud(m: Message, rx: int, sender: Sender) -> tuple[Stamped, ...]:
    if maybe(m, "airspeed") is None:
        return ()  # PX4's word for "no airspeed"
    airspeed = number(m, "airspeed", limit=FASTEST)
    heading = wrapped(math.radians(m.heading)) if 0 <= m.heading <= 360 else None
    return (
        AirData(
            _unstamped(rx, sender),
            rx,
            airspeed,
            groundspeed=maybe(m, "groundspeed"),
            climb=maybe(m, "climb"),
            heading=heading,
            alt_msl=maybe(m, "alt"),
        ),
    )


@_of("AIRSPEED")
def _airspeed(m: Message, rx: int, sender: Sender) -> tuple[Stamped, ...]:
    if m.flags & _AIRSPEED_UNHEALTHY:
        raise Refused("the airspeed sensor calls itself unhealthy", float(m.airspeed))
    return (AirData(_unstamped(rx, sender), rx, number(m, "airspeed", limit=FASTEST)),)


@_of("WIND")
def _wind(m: Message, rx: int, sender: Sender) -> tuple[Stamped, ...]:
    """ArduPilot's: the direction it blows from, the length of the whole vector, its down component."""
    direction, speed, down = number(m, "direction"), number(m, "speed"), number(m, "speed_z")
    horizontal = math.sqrt(max(0.0, speed * speed - down * down))
    towards = math.radians(direction) + math.pi
    return (
        Wind(
            _unstamped(rx, sender), rx, (horizontal * math.cos(towards), horizontal * math.sin(towards), down)
        ),
    )


@_of("WIND_COV")
def _wind_cov(m: Message, rx: int, sender: Sender) -> tuple[Stamped, ...]:
    """PX4 leaves `horiz_accuracy` 0 and sends in `var_horiz` the sum of both axes' variances."""
    sigma = maybe(m, "horiz_accuracy") or None
    if sigma is None and sender.autopilot == "px4" and 0.0 < m.var_horiz < math.inf:
        sigma = math.sqrt(0.5 * m.var_horiz)
    t_ns = _stamped(m, rx, sender)
    return (Wind(t_ns, rx, vector(m, "wind_x wind_y wind_z"), sigma),)


@_of("SCALED_PRESSURE")
def _scaled_pressure(m: Message, rx: int, sender: Sender) -> tuple[Stamped, ...]:
    differential = maybe(m, "press_diff", 100.0)
    kelvin = m.temperature * 0.01 + _ZERO_CELSIUS
    return (Pressure(_booted(m, rx, sender), rx, number(m, "press_abs", 100.0), differential, kelvin),)


def _sigma(message: Message, field: str, measured: float | None, configured: float) -> float:
    """A sigma as sent, or as configured where it is left open."""
    sigma = maybe(message, field)
    if sigma is None or (sigma <= 0.0 and measured is None):
        return configured
    if sigma <= 0.0:
        raise Refused(f"{field} {sigma:g} is not positive", sigma, 0.0)
    if sigma > FARTHEST:
        raise Refused(f"{field} {sigma:g} tells nothing", sigma, FARTHEST)
    return sigma


@_of("RSBN_MEASUREMENT")
def _rsbn(m: Message, rx: int, sender: Sender) -> tuple[Stamped, ...]:
    if m.status & _RSBN_TEST:
        raise Refused(f"beacon {m.beacon_id} sends a test signal")
    if m.status & _RSBN_MEMORY:
        raise Refused(f"beacon {m.beacon_id} is not heard: the receiver repeats its last answer")
    lat, lon = position(m.beacon_lat, m.beacon_lon, ("beacon_lat", "beacon_lon"))
    azimuth = maybe(m, "azimuth") if m.status & _RSBN_AZIMUTH else None
    slant_range = maybe(m, "slant_range") if m.status & _RSBN_RANGE else None
    if azimuth is None and slant_range is None:
        raise Refused(f"beacon {m.beacon_id} gives neither azimuth nor range")
    if azimuth is not None and abs(azimuth) > math.tau:
        raise Refused(f"azimuth {azimuth:g} rad is no angle in radians", azimuth, math.tau)
    if slant_range is not None and slant_range <= 0.0:
        raise Refused(f"slant range {slant_range:g} m is not positive", slant_range, 0.0)
    if slant_range is not None and slant_range > FARTHEST:
        raise Refused(f"slant range {slant_range:g} m is beyond the earth", slant_range, FARTHEST)
    return (
        RsbnFix(
            t_ns=_stamped(m, rx, sender),
            rx_ns=rx,
            beacon=m.beacon_id,
            lat=lat,
            lon=lon,
            alt=number(m, "beacon_alt", limit=HIGHEST),
            azimuth=None if azimuth is None else wrapped(azimuth),
            slant_range=slant_range,
            sigma_azimuth=_sigma(m, "sigma_azimuth", azimuth, sender.sigma_azimuth),
            sigma_range=_sigma(m, "sigma_range", slant_range, sender.sigma_range),
        ),
    )


# ---------------------------------------------------------------------------------------------------------
# What only a simulator knows
# ---------------------------------------------------------------------------------------------------------


@_of("SIM_STATE")
def _sim_state(m: Message, rx: int, sender: Sender) -> tuple[Stamped, ...]:
    """ArduPilot's. Without a time: up to one period late. Its altitude is above mean sea level; its simulated
    earth has no geoid, so it is passed on as it is. The float `lat`, `lon` (degE7 in fact) are too coarse."""
    lat, lon = known_position(m, "lat_int", "lon_int")
    roll, pitch, yaw = vector(m, "roll pitch yaw")
    v_n = vector(m, "vn ve vd")
    return (Truth(_unstamped(rx, sender), rx, lat, lon, number(m, "alt"), v_n, (roll, pitch, wrapped(yaw))),)


@_of("HIL_STATE_QUATERNION")
def _hil_state(m: Message, rx: int, sender: Sender) -> tuple[Stamped, ...]:
    """PX4's; its altitude as that of SIM_STATE."""
    lat, lon = known_position(m)
    w, x, y, z = (float(c) for c in m.attitude_quaternion)
    t_ns = _stamped(m, rx, sender)
    return (Truth(t_ns, rx, lat, lon, m.alt * 1e-3, vector(m, "vx vy vz", 0.01), euler((w, x, y, z))),)
