"""Encoder record -> MAVLink message of an autopilot. The inverse of `companion.link.decode`.

A table by the record's kind. `boot_ns` is the boot time of the simulated autopilot on the records' clock;
earlier records cannot be encoded. Values are rounded as MAVLink does (milliseconds, 1e-7 degrees, cm/s), and
missing values are sent as the message's "unknown". Rates and links belong to `sitl.autopilot`.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, Literal, NamedTuple

from companion.link import dialect
from companion.link.decode import INERTIAL_UPDATED
from companion.link.dialect import Message, mavlink, rsbn
from companion.link.fields import deg_e7
from companion.nav.geometry import wrap_angle
from companion.records import (
    AirData,
    AirspeedSensor,
    Attitude,
    FilterStatus,
    GlobalPosition,
    Gnss,
    HomePosition,
    Imu,
    LocalOrigin,
    LocalPosition,
    Pressure,
    RangeDifference,
    RsbnFix,
    SecondIns,
    Stamped,
    StarFix,
    SystemTime,
    Truth,
    Vector3,
    Wind,
)
from companion.units import G0, ZERO_CELSIUS

_MILLI_G = G0 / 1000
_ALWAYS_PRESENT = (
    mavlink.MAV_SYS_STATUS_SENSOR_3D_GYRO
    | mavlink.MAV_SYS_STATUS_SENSOR_3D_ACCEL
    | mavlink.MAV_SYS_STATUS_SENSOR_3D_MAG
    | mavlink.MAV_SYS_STATUS_SENSOR_ABSOLUTE_PRESSURE
    | mavlink.MAV_SYS_STATUS_SENSOR_GPS
)


class SimulatedSender(NamedTuple):
    """Simulated sender: make, which selects the message of a record, and boot time."""

    autopilot: Literal["ardupilot", "px4"] = "ardupilot"
    boot_ns: int = 0

    def ms(self, t_ns: int) -> int:
        """Milliseconds since boot (time_boot_ms)."""
        return (t_ns - self.boot_ns) // 1_000_000

    def us(self, t_ns: int) -> int:
        """Microseconds since boot (time_usec)."""
        return (t_ns - self.boot_ns) // 1000


def encode(record: Stamped, sender: SimulatedSender) -> Message:
    """Encode `record` as a message. Raises ValueError for a kind that no autopilot sends."""
    encoder = _ENCODERS.get(type(record))
    if encoder is None:
        raise ValueError(f"no autopilot sends a {type(record).__name__}: only sensor records can be encoded")
    return encoder(record, sender)


def _mm(metres: float) -> int:
    return round(metres * 1e3)


def _cdeg(heading: float) -> int:
    return round(math.degrees(heading % math.tau) * 100.0) % 36000


def _or_nan(value: float | None) -> float:
    return math.nan if value is None else value


def _accuracy(sigma: float | None) -> int:
    return 0 if sigma is None else max(1, _mm(sigma))


def _quaternion(attitude: Vector3) -> list[float]:
    """Quaternion w, x, y, z of the rotation b -> n by roll, pitch, heading."""
    (sr, cr), (sp, cp), (sh, ch) = ((math.sin(0.5 * a), math.cos(0.5 * a)) for a in attitude)
    return [
        cr * cp * ch + sr * sp * sh,
        sr * cp * ch - cr * sp * sh,
        cr * sp * ch + sr * cp * sh,
        cr * cp * sh - sr * sp * ch,
    ]


def _imu(r: Imu, a: SimulatedSender) -> Message:
    if a.autopilot == "px4":
        names = ("xacc", "yacc", "zacc", "xgyro", "ygyro", "zgyro")
        values = dict(zip(names, (*r.f_b, *r.w_b)))
        return dialect.new(
            "HIGHRES_IMU", time_usec=a.us(r.t_ns), id=r.source, fields_updated=INERTIAL_UPDATED, **values
        )
    fields = {
        **{f"{axis}acc": round(f / _MILLI_G) for axis, f in zip("xyz", r.f_b)},
        **{f"{axis}gyro": round(w * 1e3) for axis, w in zip("xyz", r.w_b)},
    }
    if r.source == 0:
        return dialect.new("RAW_IMU", time_usec=a.us(r.t_ns), **fields)
    return dialect.new(f"SCALED_IMU{r.source + 1}", time_boot_ms=a.ms(r.t_ns), **fields)


def _attitude(r: Attitude, a: SimulatedSender) -> Message:
    p, q, s = r.w_b or (math.nan, math.nan, math.nan)
    return dialect.new(
        "ATTITUDE",
        time_boot_ms=a.ms(r.t_ns),
        roll=r.roll,
        pitch=r.pitch,
        yaw=wrap_angle(r.heading),
        rollspeed=p,
        pitchspeed=q,
        yawspeed=s,
    )


def _gnss(r: Gnss, a: SimulatedSender) -> Message:
    vel = cog = 0xFFFF
    if r.v_n is not None:
        vel = min(round(math.hypot(r.v_n[0], r.v_n[1]) * 100.0), 0xFFFE)
        cog = _cdeg(math.atan2(r.v_n[1], r.v_n[0]))
    return dialect.new(
        "GPS_RAW_INT" if r.receiver == 0 else "GPS2_RAW",
        time_usec=r.stamp_us,
        fix_type=r.fix,
        lat=deg_e7(r.lat),
        lon=deg_e7(r.lon),
        alt=_mm(r.alt_msl),
        eph=0xFFFF if r.hdop is None else round(r.hdop * 100.0),
        epv=0xFFFF,
        vel=vel,
        cog=cog,
        satellites_visible=0xFF if r.satellites is None else r.satellites,
        alt_ellipsoid=0 if r.alt is None else _mm(r.alt),
        h_acc=_accuracy(r.sigma_horizontal),
        v_acc=_accuracy(r.sigma_vertical),
        vel_acc=_accuracy(r.sigma_velocity),
    )


def _local_position(r: LocalPosition, a: SimulatedSender) -> Message:
    (x, y, z), (vx, vy, vz) = r.x_n, r.v_n
    return dialect.new("LOCAL_POSITION_NED", time_boot_ms=a.ms(r.t_ns), x=x, y=y, z=z, vx=vx, vy=vy, vz=vz)


def _position_encoder(name: str) -> Callable[[LocalOrigin | HomePosition, SimulatedSender], Message]:
    def encode_position(r: LocalOrigin | HomePosition, a: SimulatedSender) -> Message:
        return dialect.new(
            name,
            latitude=deg_e7(r.lat),
            longitude=deg_e7(r.lon),
            altitude=_mm(r.alt_msl),
            time_usec=a.us(r.t_ns),
        )

    return encode_position


def _global_position(r: GlobalPosition, a: SimulatedSender) -> Message:
    vx, vy, vz = (round(v * 100.0) for v in r.v_n)
    return dialect.new(
        "GLOBAL_POSITION_INT",
        time_boot_ms=a.ms(r.t_ns),
        lat=deg_e7(r.lat),
        lon=deg_e7(r.lon),
        alt=_mm(r.alt_msl),
        relative_alt=_mm(r.height_above_home),
        vx=vx,
        vy=vy,
        vz=vz,
        hdg=0xFFFF if r.heading is None else _cdeg(r.heading),
    )


def _air_data(r: AirData, a: SimulatedSender) -> Message:
    return dialect.new(
        "VFR_HUD",
        airspeed=r.airspeed,
        groundspeed=_or_nan(r.groundspeed),
        climb=_or_nan(r.climb),
        heading=-1 if r.heading is None else round(math.degrees(r.heading)) % 360,
        alt=_or_nan(r.alt_msl),
    )


def _airspeed_sensor(r: AirspeedSensor, a: SimulatedSender) -> Message:
    sensors = _ALWAYS_PRESENT | (mavlink.MAV_SYS_STATUS_SENSOR_DIFFERENTIAL_PRESSURE if r.healthy else 0)
    return dialect.new(
        "SYS_STATUS",
        onboard_control_sensors_present=sensors,
        onboard_control_sensors_enabled=sensors,
        onboard_control_sensors_health=sensors,
    )


def _wind(r: Wind, a: SimulatedSender) -> Message:
    north, east, down = r.v_n
    if a.autopilot == "px4":
        variance = 0.0 if r.sigma is None else 2.0 * r.sigma**2
        return dialect.new(
            "WIND_COV", time_usec=a.us(r.t_ns), wind_x=north, wind_y=east, wind_z=down, var_horiz=variance
        )
    direction = math.degrees(math.atan2(-east, -north))
    return dialect.new("WIND", direction=direction, speed=math.hypot(north, east, down), speed_z=down)


def _pressure(r: Pressure, a: SimulatedSender) -> Message:
    kelvin = 288.15 if r.temperature is None else r.temperature
    return dialect.new(
        "SCALED_PRESSURE",
        time_boot_ms=a.ms(r.t_ns),
        press_abs=r.static * 0.01,
        press_diff=_or_nan(r.differential) * 0.01,
        temperature=round((kelvin - ZERO_CELSIUS) * 100.0),
    )


def _filter_status(r: FilterStatus, a: SimulatedSender) -> Message:
    if a.autopilot == "px4":
        return dialect.new(
            "ESTIMATOR_STATUS",
            time_usec=a.us(r.t_ns),
            flags=r.flags,
            pos_horiz_ratio=r.position_ratio,
            pos_horiz_accuracy=_or_nan(r.horizontal_accuracy),
        )
    return dialect.new("EKF_STATUS_REPORT", flags=r.flags, pos_horiz_variance=r.position_ratio)


def _system_time(r: SystemTime, a: SimulatedSender) -> Message:
    unix_us = 0 if r.unix_ns is None else r.unix_ns // 1000
    return dialect.new("SYSTEM_TIME", time_unix_usec=unix_us, time_boot_ms=r.boot_ns // 1_000_000)


def _truth(r: Truth, a: SimulatedSender) -> Message:
    attitude = r.attitude or (0.0, 0.0, 0.0)
    lat, lon = deg_e7(r.lat), deg_e7(r.lon)
    if a.autopilot == "px4":
        vx, vy, vz = (round(v * 100.0) for v in r.v_n)
        return dialect.new(
            "HIL_STATE_QUATERNION",
            time_usec=a.us(r.t_ns),
            attitude_quaternion=_quaternion(attitude),
            lat=lat,
            lon=lon,
            alt=_mm(r.alt),
            vx=vx,
            vy=vy,
            vz=vz,
        )
    roll, pitch, heading = attitude
    vn, ve, vd = r.v_n
    q = dict(zip(("q1", "q2", "q3", "q4"), _quaternion(attitude)))
    # ArduPilot 4.7 puts 1e-7 degrees into the float fields: single precision, too coarse to use
    places = {"lat": float(lat), "lon": float(lon), "lat_int": lat, "lon_int": lon, "alt": r.alt}
    angles = {"roll": roll, "pitch": pitch, "yaw": wrap_angle(heading)}
    return dialect.new("SIM_STATE", vn=vn, ve=ve, vd=vd, **q, **angles, **places)


def _rsbn(r: RsbnFix, a: SimulatedSender) -> Message:
    status = rsbn.RSBN_STATUS_SIMULATED
    status |= 0 if r.azimuth is None else rsbn.RSBN_STATUS_AZIMUTH_VALID
    status |= 0 if r.slant_range is None else rsbn.RSBN_STATUS_RANGE_VALID
    return dialect.new(
        "RSBN_MEASUREMENT",
        time_usec=a.us(r.t_ns),
        beacon_id=r.beacon,
        beacon_lat=deg_e7(r.lat),
        beacon_lon=deg_e7(r.lon),
        beacon_alt=r.alt,
        azimuth=_or_nan(r.azimuth),
        slant_range=_or_nan(r.slant_range),
        sigma_azimuth=r.sigma_azimuth,
        sigma_range=r.sigma_range,
        status=status,
    )


def _star_fix(r: StarFix, a: SimulatedSender) -> Message:
    return dialect.new(
        "STAR_FIX",
        time_usec=a.us(r.t_ns),
        star_id=r.star,
        zenith_lat=deg_e7(r.lat),
        zenith_lon=deg_e7(wrap_angle(r.lon)),
        altitude=r.altitude,
        azimuth=_or_nan(r.azimuth),
        sigma_altitude=r.sigma_altitude,
        sigma_azimuth=r.sigma_azimuth,
    )


def _range_difference(r: RangeDifference, a: SimulatedSender) -> Message:
    return dialect.new(
        "RANGE_DIFFERENCE",
        time_usec=a.us(r.t_ns),
        chain_id=r.chain,
        a_lat=deg_e7(r.lat_a),
        a_lon=deg_e7(r.lon_a),
        a_alt=r.alt_a,
        b_lat=deg_e7(r.lat_b),
        b_lon=deg_e7(r.lon_b),
        b_alt=r.alt_b,
        difference=r.difference,
        sigma=r.sigma,
    )


def _second_ins(r: SecondIns, a: SimulatedSender) -> Message:
    return dialect.new(
        "SECOND_INS_POSITION", time_usec=a.us(r.t_ns), ins_id=r.ins, lat=deg_e7(r.lat), lon=deg_e7(r.lon)
    )


_ENCODERS: dict[type[Stamped], Callable[[Any, SimulatedSender], Message]] = {
    Imu: _imu,
    Attitude: _attitude,
    Gnss: _gnss,
    LocalPosition: _local_position,
    LocalOrigin: _position_encoder("GPS_GLOBAL_ORIGIN"),
    HomePosition: _position_encoder("HOME_POSITION"),
    GlobalPosition: _global_position,
    AirData: _air_data,
    AirspeedSensor: _airspeed_sensor,
    Wind: _wind,
    Pressure: _pressure,
    FilterStatus: _filter_status,
    SystemTime: _system_time,
    RsbnFix: _rsbn,
    StarFix: _star_fix,
    RangeDifference: _range_difference,
    SecondIns: _second_ins,
    Truth: _truth,
}
