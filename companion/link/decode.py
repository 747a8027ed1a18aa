"""Decoding of MAVLink messages to records. Never raises on the content of a message.

An absent value has several encodings on the wire: NaN, all ones, zero time, zero accuracy. Each becomes
`None` where the record allows it; where the record needs the number, the message becomes a `Rejection` with
the reason. A message that states that it carries no measurement (no airspeed sensor, a compass without an
accelerometer) gives no record.

Headings are in [0, 2 pi). Times are mapped by the sender's `Clock`; a message without a time is stamped with
its arrival, less the delay of the link.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Literal, NamedTuple, Protocol, TypeAlias

from companion.link import dialect
from companion.link.dialect import Message, mavlink, rsbn
from companion.link.fields import (
    InvalidField,
    accuracy,
    dilution,
    euler,
    known_position,
    number,
    optional_number,
    optional_vector,
    position,
    vector,
    wrap_heading,
)
from companion.plausibility import FARTHEST, FASTEST, HIGHEST
from companion.records import (
    AirData,
    AirspeedSensor,
    Attitude,
    FilterStatus,
    GlobalPosition,
    Gnss,
    GnssIntegrity,
    HomePosition,
    Imu,
    LocalOrigin,
    LocalPosition,
    Pressure,
    RangeDifference,
    Rejection,
    RsbnFix,
    SecondIns,
    Stamped,
    StarFix,
    SystemTime,
    Truth,
    Vehicle,
    Wind,
)
from companion.units import G0, ZERO_CELSIUS

Autopilot: TypeAlias = Literal["ardupilot", "px4", "other"]
#: Autopilot by MAV_AUTOPILOT.
MAKES: dict[int, Autopilot] = {
    mavlink.MAV_AUTOPILOT_ARDUPILOTMEGA: "ardupilot",
    mavlink.MAV_AUTOPILOT_PX4: "px4",
}

UERE = 4.0
"""User range error, one sigma, m: converts a dilution of precision to metres where a receiver gives no
accuracy; 7.8 m at 95 % (GPS SPS Performance Standard, 4th edition 2008, table 3.4-1)."""
#: MAV_TYPE of vehicles that rotors of fixed pitch hold up.
MULTIROTORS = frozenset(
    {
        mavlink.MAV_TYPE_QUADROTOR,
        mavlink.MAV_TYPE_HEXAROTOR,
        mavlink.MAV_TYPE_OCTOROTOR,
        mavlink.MAV_TYPE_TRICOPTER,
        mavlink.MAV_TYPE_DODECAROTOR,
        mavlink.MAV_TYPE_DECAROTOR,
        mavlink.MAV_TYPE_GENERIC_MULTIROTOR,
    }
)
#: The VTOLs with a wing; releases of pymavlink name them differently.
VTOLS = frozenset(range(19, 25))
FIXED_WINGS = frozenset({mavlink.MAV_TYPE_FIXED_WING, *VTOLS})
#: Modes of a quadplane in which its rotors hold it up. Its HEARTBEAT has the type of a fixed wing.
_BY_ROTORS = frozenset(
    {
        mavlink.PLANE_MODE_QSTABILIZE,
        mavlink.PLANE_MODE_QHOVER,
        mavlink.PLANE_MODE_QLOITER,
        mavlink.PLANE_MODE_QLAND,
        mavlink.PLANE_MODE_QRTL,
        mavlink.PLANE_MODE_QAUTOTUNE,
        mavlink.PLANE_MODE_QACRO,
        mavlink.PLANE_MODE_LOITER_ALT_QLAND,
    }
)
_FLYING = {mavlink.MAV_STATE_BOOT: False, mavlink.MAV_STATE_STANDBY: False, mavlink.MAV_STATE_ACTIVE: True}
_IN_THE_AIR = frozenset(
    {
        mavlink.MAV_LANDED_STATE_IN_AIR,
        mavlink.MAV_LANDED_STATE_TAKEOFF,
        mavlink.MAV_LANDED_STATE_LANDING,
    }
)
#: ArduPilot's DCM that never had a fix reckons from 0, 0; there is no land within 1 deg of it.
_RECKONED_FROM_0_DEG7 = 10**7
_UNIX_AFTER_US = 10**15  # 2001; fewer microseconds are not a date

INERTIAL_UPDATED = (
    mavlink.HIGHRES_IMU_UPDATED_XACC
    | mavlink.HIGHRES_IMU_UPDATED_YACC
    | mavlink.HIGHRES_IMU_UPDATED_ZACC
    | mavlink.HIGHRES_IMU_UPDATED_XGYRO
    | mavlink.HIGHRES_IMU_UPDATED_YGYRO
    | mavlink.HIGHRES_IMU_UPDATED_ZGYRO
)
_SPEED_UNKNOWN, _COURSE_UNKNOWN, _SATELLITES_UNKNOWN = 0xFFFF, 0xFFFF, 0xFF


class Clock(Protocol):
    """Mapping of a sender's times to the companion's clock (`link.clock.BootClock` is one)."""

    def local(self, stamp: int, received: int, /) -> int:
        """Map `stamp` to local time, all in nanoseconds.

        `stamp` is the time since boot or since 1970, distinguished by magnitude; 0 is "unknown" and gives
        `received`, less the delay of the link.
        """


class Sender(NamedTuple):
    """Sender of messages: its clock, its autopilot type, and default sigmas.

    `sigma_azimuth` (rad) and `sigma_range` (m) are used where an RSBN_MEASUREMENT gives none.
    """

    clock: Clock
    autopilot: Autopilot = "other"
    sigma_azimuth: float = math.radians(0.125)
    sigma_range: float = 100.0


_Decoder: TypeAlias = Callable[[Message, int, Sender], tuple[Stamped, ...]]
_DECODERS: dict[int, _Decoder] = {}


def decode(message: Message, rx_ns: int, sender: Sender) -> tuple[Stamped, ...]:
    """Decode `message`, received at `rx_ns` from `sender`; empty if it carries no record.

    Never raises on a message's content: an unusable message becomes a `Rejection` stamped `rx_ns`.
    """
    decoder = _DECODERS.get(dialect.id_of(message))
    if decoder is None:
        return ()
    try:
        return decoder(message, rx_ns, sender)
    except InvalidField as error:
        name = dialect.TYPES[dialect.id_of(message)].name
        return (Rejection(rx_ns, rx_ns, name, str(error), error.value, error.limit),)


def _of(*names: str) -> Callable[[_Decoder], _Decoder]:
    """Register a function as the decoder of the named messages."""

    def register(decoder: _Decoder) -> _Decoder:
        for name in names:
            _DECODERS[dialect.type_named(name).msgid] = decoder
        return decoder

    return register


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
    """Decode a fix; also without a position (`fix` below 2), so that its loss is seen.

    The receiver's `h_acc` is the sigma of each axis, as in both autopilots' filters. Neither message has a
    vertical velocity: the third component of `v_n` is 0.
    """
    has_position = m.fix_type >= mavlink.GPS_FIX_TYPE_2D_FIX
    lat, lon = known_position(m) if has_position else position(m.lat, m.lon)
    hdop, vdop = dilution(m.eph), dilution(m.epv)
    sigma_horizontal, sigma_vertical = accuracy(m.h_acc), accuracy(m.v_acc)
    if sigma_horizontal is None and hdop:
        sigma_horizontal = UERE * hdop / math.sqrt(2.0)  # HDOP covers both axes
    if sigma_vertical is None and vdop:
        sigma_vertical = UERE * vdop
    v_n = None
    if has_position and m.vel != _SPEED_UNKNOWN and m.cog <= 36000:
        speed, course = m.vel * 0.01, math.radians(m.cog * 0.01)
        v_n = (speed * math.cos(course), speed * math.sin(course), 0.0)
    return (
        Gnss(
            t_ns=_stamped(m, rx, sender),
            rx_ns=rx,
            receiver=0 if dialect.id_of(m) == mavlink.MAVLINK_MSG_ID_GPS_RAW_INT else 1,
            stamp_us=m.time_usec,
            fix=m.fix_type,
            lat=lat,
            lon=lon,
            alt_msl=m.alt * 1e-3,
            sigma_horizontal=sigma_horizontal,
            sigma_vertical=sigma_vertical,
            v_n=v_n,
            sigma_velocity=accuracy(m.vel_acc),
            satellites=None if m.satellites_visible == _SATELLITES_UNKNOWN else m.satellites_visible,
            hdop=hdop,
            alt=m.alt_ellipsoid * 1e-3 if 0 < abs(m.alt_ellipsoid) < HIGHEST * 1e3 else None,
        ),
    )


# ---------------------------------------------------------------------------------------------------------
# Estimates of the autopilot
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
    if max(abs(m.lat), abs(m.lon)) < _RECKONED_FROM_0_DEG7:
        raise InvalidField("no position yet (ArduPilot's DCM reckons from latitude and longitude 0)")
    v_n = vector(m, "vx vy vz", 0.01)
    heading = None if m.hdg == _COURSE_UNKNOWN else wrap_heading(math.radians(m.hdg * 0.01))
    t_ns = _booted(m, rx, sender)
    return (GlobalPosition(t_ns, rx, lat, lon, m.alt * 1e-3, v_n, m.relative_alt * 1e-3, heading),)


@_of("ATTITUDE")
def _attitude(m: Message, rx: int, sender: Sender) -> tuple[Stamped, ...]:
    roll, pitch, yaw = vector(m, "roll pitch yaw")
    w_b = optional_vector(m, "rollspeed pitchspeed yawspeed")
    return (Attitude(_booted(m, rx, sender), rx, roll, pitch, wrap_heading(yaw), w_b),)


@_of("ATTITUDE_QUATERNION")
def _attitude_quaternion(m: Message, rx: int, sender: Sender) -> tuple[Stamped, ...]:
    q = number(m, "q1"), number(m, "q2"), number(m, "q3"), number(m, "q4")
    return (
        Attitude(_booted(m, rx, sender), rx, *euler(q), optional_vector(m, "rollspeed pitchspeed yawspeed")),
    )


@_of("EKF_STATUS_REPORT")
def _ekf_status(m: Message, rx: int, sender: Sender) -> tuple[Stamped, ...]:
    """Decode ArduPilot's filter status; `pos_horiz_variance` is an innovation test ratio, not an accuracy."""
    ratio = number(m, "pos_horiz_variance")
    return (
        FilterStatus(_unstamped(rx, sender), rx, m.flags, bool(m.flags & mavlink.EKF_GPS_GLITCHING), ratio),
    )


@_of("ESTIMATOR_STATUS")
def _estimator_status(m: Message, rx: int, sender: Sender) -> tuple[Stamped, ...]:
    """Decode PX4's filter status; its ratio is NaN while no position is tested, where ArduPilot sends 0."""
    accuracy = optional_number(m, "pos_horiz_accuracy") if sender.autopilot == "px4" else None
    ratio = optional_number(m, "pos_horiz_ratio") or 0.0
    glitch = bool(m.flags & mavlink.ESTIMATOR_GPS_GLITCH)  # this bit is EKF_UNINITIALIZED in EKF_STATUS_FLAGS
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
    if updated & mavlink.HIGHRES_IMU_UPDATED_ABS_PRESSURE:
        static = number(m, "abs_pressure", 100.0)
        differential = celsius = None
        if updated & mavlink.HIGHRES_IMU_UPDATED_DIFF_PRESSURE:
            differential = optional_number(m, "diff_pressure", 100.0)
        if updated & mavlink.HIGHRES_IMU_UPDATED_TEMPERATURE:
            celsius = optional_number(m, "temperature")
        kelvin = None if celsius is None else celsius + ZERO_CELSIUS
        records += (Pressure(t_ns, rx, static, differential, kelvin),)
    if updated & INERTIAL_UPDATED == INERTIAL_UPDATED:  # last: it moves the trajectory, to that height
        records += (Imu(t_ns, rx, m.id, vector(m, "xacc yacc zacc"), vector(m, "xgyro ygyro zgyro")),)
    return records


def _scaled_imu(m: Message, t_ns: int, rx: int, source: int) -> tuple[Stamped, ...]:
    f_b = vector(m, "xacc yacc zacc", 1e-3 * G0)
    if f_b == (0.0, 0.0, 0.0):
        return ()  # a compass without an accelerometer: a specific force is never exactly 0 in all axes
    return (Imu(t_ns, rx, source, f_b, vector(m, "xgyro ygyro zgyro", 1e-3)),)


@_of("RAW_IMU")
def _raw_imu(m: Message, rx: int, sender: Sender) -> tuple[Stamped, ...]:
    """Decode RAW_IMU of ArduPilot only, which sends mG and mrad/s; the standard leaves the units open."""
    if sender.autopilot != "ardupilot":
        return ()
    return _scaled_imu(m, _stamped(m, rx, sender), rx, m.id)


_IMU_NUMBERS = {
    mavlink.MAVLINK_MSG_ID_SCALED_IMU: 0,
    mavlink.MAVLINK_MSG_ID_SCALED_IMU2: 1,
    mavlink.MAVLINK_MSG_ID_SCALED_IMU3: 2,
}


@_of("SCALED_IMU", "SCALED_IMU2", "SCALED_IMU3")
def _numbered_imu(m: Message, rx: int, sender: Sender) -> tuple[Stamped, ...]:
    return _scaled_imu(m, _booted(m, rx, sender), rx, _IMU_NUMBERS[dialect.id_of(m)])


@_of("VFR_HUD")
def _vfr_hud(m: Message, rx: int, sender: Sender) -> tuple[Stamped, ...]:
    if optional_number(m, "airspeed") is None:
        return ()  # PX4 sends NaN without an airspeed sensor
    airspeed = number(m, "airspeed", limit=FASTEST)
    heading = wrap_heading(math.radians(m.heading)) if 0 <= m.heading <= 360 else None
    return (
        AirData(
            _unstamped(rx, sender),
            rx,
            airspeed,
            groundspeed=optional_number(m, "groundspeed"),
            climb=optional_number(m, "climb"),
            heading=heading,
            alt_msl=optional_number(m, "alt"),
        ),
    )


@_of("AIRSPEED")
def _airspeed(m: Message, rx: int, sender: Sender) -> tuple[Stamped, ...]:
    """Sent only where there is a sensor; so is the word that it fails. Of a second one only while in use.

    The airspeed is that of the sensor in use: the first of two may be the one that fails.
    """
    in_use = bool(m.flags & mavlink.AIRSPEED_SENSOR_USING)
    if m.id > 0 and not in_use:
        return ()
    t_ns, healthy = _unstamped(rx, sender), not m.flags & mavlink.AIRSPEED_SENSOR_UNHEALTHY
    state = AirspeedSensor(t_ns, rx, healthy)
    if not healthy or not in_use:
        return (state,)
    return state, AirData(t_ns, rx, number(m, "airspeed", limit=FASTEST), sensed=True)


def has_airspeed_sensor(m: Message) -> bool:
    """Whether SYS_STATUS calls the sensor of differential pressure present, enabled and healthy."""
    bits = (
        m.onboard_control_sensors_present
        & m.onboard_control_sensors_enabled
        & m.onboard_control_sensors_health
    )
    return bool(bits & mavlink.MAV_SYS_STATUS_SENSOR_DIFFERENTIAL_PRESSURE)


@_of("SYS_STATUS")
def _sys_status(m: Message, rx: int, sender: Sender) -> tuple[Stamped, ...]:
    healthy = has_airspeed_sensor(m)
    present = m.onboard_control_sensors_present & mavlink.MAV_SYS_STATUS_SENSOR_DIFFERENTIAL_PRESSURE
    return (AirspeedSensor(_unstamped(rx, sender), rx, healthy, healthy if present else None),)


@_of("HEARTBEAT")
def _heartbeat(m: Message, rx: int, sender: Sender) -> tuple[Stamped, ...]:
    """Decode the kind of vehicle. ArduCopter and ArduPlane are active in the air only, others once armed."""
    multirotor, fixed_wing, flying = m.type in MULTIROTORS, m.type in FIXED_WINGS, None
    if sender.autopilot == "ardupilot" and (multirotor or fixed_wing):
        flying = _FLYING.get(m.system_status)
        fixed_wing = fixed_wing and m.custom_mode not in _BY_ROTORS
    return (Vehicle(_unstamped(rx, sender), rx, multirotor, flying, fixed_wing),)


@_of("EXTENDED_SYS_STATE")
def _extended_sys_state(m: Message, rx: int, sender: Sender) -> tuple[Stamped, ...]:
    if m.landed_state == mavlink.MAV_LANDED_STATE_UNDEFINED:
        return ()
    hovering = None if not m.vtol_state else m.vtol_state != mavlink.MAV_VTOL_STATE_FW
    flying = m.landed_state in _IN_THE_AIR
    return (Vehicle(_unstamped(rx, sender), rx, flying=flying, hovering=hovering),)


@_of("GNSS_INTEGRITY")
def _gnss_integrity(m: Message, rx: int, sender: Sender) -> tuple[Stamped, ...]:
    return (GnssIntegrity(_unstamped(rx, sender), rx, m.id, m.jamming_state, m.spoofing_state),)


@_of("WIND")
def _wind(m: Message, rx: int, sender: Sender) -> tuple[Stamped, ...]:
    """Decode ArduPilot's wind: direction it blows from, length of the 3D vector, down component."""
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
    """Decode a wind with covariance.

    PX4 sends `horiz_accuracy` 0, and in `var_horiz` the sum of the variances of both axes.
    """
    sigma = optional_number(m, "horiz_accuracy") or None
    if sigma is None and sender.autopilot == "px4" and 0.0 < m.var_horiz < math.inf:
        sigma = math.sqrt(0.5 * m.var_horiz)
    t_ns = _stamped(m, rx, sender)
    return (Wind(t_ns, rx, vector(m, "wind_x wind_y wind_z"), sigma),)


@_of("SCALED_PRESSURE")
def _scaled_pressure(m: Message, rx: int, sender: Sender) -> tuple[Stamped, ...]:
    differential = optional_number(m, "press_diff", 100.0)
    kelvin = m.temperature * 0.01 + ZERO_CELSIUS
    return (Pressure(_booted(m, rx, sender), rx, number(m, "press_abs", 100.0), differential, kelvin),)


def _azimuth(message: Message) -> float | None:
    """Return the azimuth as sent, rad; None if it is absent."""
    azimuth = optional_number(message, "azimuth")
    if azimuth is not None and abs(azimuth) > math.tau:
        raise InvalidField(
            f"azimuth {azimuth:g} rad is not an angle in radians (limit 2 pi)", azimuth, math.tau
        )
    return azimuth


def _sigma(message: Message, field: str, measured: float | None, configured: float) -> float:
    """Return the sigma as sent, or as configured if the message gives none."""
    sigma = optional_number(message, field)
    if sigma is None or (sigma <= 0.0 and measured is None):
        return configured
    return _stated_sigma(message, field)


@_of("RSBN_MEASUREMENT")
def _rsbn(m: Message, rx: int, sender: Sender) -> tuple[Stamped, ...]:
    if m.status & rsbn.RSBN_STATUS_TEST:
        raise InvalidField(f"beacon {m.beacon_id} sends a test signal")
    if m.status & rsbn.RSBN_STATUS_MEMORY:
        raise InvalidField(f"beacon {m.beacon_id} is not received: the receiver repeats its last answer")
    lat, lon = position(m.beacon_lat, m.beacon_lon, ("beacon_lat", "beacon_lon"))
    azimuth = _azimuth(m) if m.status & rsbn.RSBN_STATUS_AZIMUTH_VALID else None
    slant_range = optional_number(m, "slant_range") if m.status & rsbn.RSBN_STATUS_RANGE_VALID else None
    if azimuth is None and slant_range is None:
        raise InvalidField(f"beacon {m.beacon_id} gives neither azimuth nor range")
    if slant_range is not None and slant_range <= 0.0:
        raise InvalidField(f"slant range {slant_range:g} m is not positive", slant_range, 0.0)
    if slant_range is not None and slant_range > FARTHEST:
        raise InvalidField(
            f"slant range {slant_range:g} m is beyond the limit {FARTHEST:g} m", slant_range, FARTHEST
        )
    if m.beacon_lat == 0 == m.beacon_lon:
        raise InvalidField(f"beacon {m.beacon_id} has no position: beacon_lat and beacon_lon are 0")
    return (
        RsbnFix(
            t_ns=_stamped(m, rx, sender),
            rx_ns=rx,
            beacon=m.beacon_id,
            lat=lat,
            lon=lon,
            alt=number(m, "beacon_alt", limit=HIGHEST),
            azimuth=None if azimuth is None else wrap_heading(azimuth),
            slant_range=slant_range,
            sigma_azimuth=_sigma(m, "sigma_azimuth", azimuth, sender.sigma_azimuth),
            sigma_range=_sigma(m, "sigma_range", slant_range, sender.sigma_range),
        ),
    )


@_of("STAR_FIX")
def _star_fix(m: Message, rx: int, sender: Sender) -> tuple[Stamped, ...]:
    azimuth = _azimuth(m)
    return (
        StarFix(
            _stamped(m, rx, sender),
            rx,
            m.star_id,
            *position(m.zenith_lat, m.zenith_lon, ("zenith_lat", "zenith_lon")),
            altitude=number(m, "altitude", limit=math.pi / 2.0),
            azimuth=azimuth,
            sigma_altitude=_stated_sigma(m, "sigma_altitude"),
            sigma_azimuth=math.tau if azimuth is None else _stated_sigma(m, "sigma_azimuth"),
        ),
    )


@_of("RANGE_DIFFERENCE")
def _range_difference(m: Message, rx: int, sender: Sender) -> tuple[Stamped, ...]:
    a, b = (
        (*position(lat, lon, (f"{name}_lat", f"{name}_lon")), number(m, f"{name}_alt", limit=HIGHEST))
        for name, lat, lon in (("a", m.a_lat, m.a_lon), ("b", m.b_lat, m.b_lon))
    )
    if a[:2] == b[:2]:
        raise InvalidField("stations a and b are at one place: their distances differ by nothing")
    difference = number(m, "difference", limit=FARTHEST)
    sigma = _stated_sigma(m, "sigma")
    return (RangeDifference(_stamped(m, rx, sender), rx, m.chain_id, *a, *b, difference, sigma),)


@_of("SECOND_INS_POSITION")
def _second_ins(m: Message, rx: int, sender: Sender) -> tuple[Stamped, ...]:
    return (SecondIns(_stamped(m, rx, sender), rx, m.ins_id, *known_position(m)),)


def _stated_sigma(m: Message, field: str) -> float:
    """Return a standard deviation that must be stated."""
    sigma = number(m, field, limit=FARTHEST)
    if sigma <= 0.0:
        raise InvalidField(f"{field} {sigma:g} is not positive", sigma, 0.0)
    return sigma


# ---------------------------------------------------------------------------------------------------------
# True state, sent by simulators only
# ---------------------------------------------------------------------------------------------------------


@_of("SIM_STATE")
def _sim_state(m: Message, rx: int, sender: Sender) -> tuple[Stamped, ...]:
    """Decode the true state of ArduPilot's simulator.

    The message has no time: its stamp is up to one period late. Its altitude is above mean sea level; the
    simulated earth has no geoid, so it is used unchanged. The float fields `lat`, `lon` are too coarse.
    """
    lat, lon = known_position(m, "lat_int", "lon_int")
    roll, pitch, yaw = vector(m, "roll pitch yaw")
    v_n = vector(m, "vn ve vd")
    return (
        Truth(_unstamped(rx, sender), rx, lat, lon, number(m, "alt"), v_n, (roll, pitch, wrap_heading(yaw))),
    )


@_of("HIL_STATE_QUATERNION")
def _hil_state(m: Message, rx: int, sender: Sender) -> tuple[Stamped, ...]:
    """Decode the true state of PX4's simulator; altitude as in SIM_STATE."""
    lat, lon = known_position(m)
    w, x, y, z = (float(c) for c in m.attitude_quaternion)
    t_ns = _stamped(m, rx, sender)
    return (Truth(t_ns, rx, lat, lon, m.alt * 1e-3, vector(m, "vx vy vz", 0.01), euler((w, x, y, z))),)


#: Ids of the messages that carry records.
DECODED = frozenset(_DECODERS)
