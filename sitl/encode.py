"""Record -> message: what an autopilot would send. The mirror of `companion.link.decode`.

A table by the record's kind. `boot_ns` is the time, on the records' clock, at which the simulated autopilot
was switched on; records before it cannot be told. What MAVLink rounds (milliseconds, 1e-7 degrees, cm/s)
is rounded, and what a message cannot say is left out in the message's own way. It knows nothing of rates,
links or of how a record came about.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, Literal, NamedTuple, TypeAlias

from companion.link import dialect
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
    RsbnFix,
    Stamped,
    SystemTime,
    Truth,
    Vector3,
    Wind,
)

Message: TypeAlias = Any

_MILLI_G = 9.80665e-3
_ZERO_CELSIUS = 273.15
_RSBN_AZIMUTH, _RSBN_RANGE, _RSBN_SIMULATED = 1, 2, 16
_INERTIAL_UPDATED = 0x3F


class Airframe(NamedTuple):
    """The autopilot that is played: its make decides which message carries a record."""

    autopilot: Literal["ardupilot", "px4"] = "ardupilot"
    boot_ns: int = 0

    def ms(self, t_ns: int) -> int:
        """Milliseconds since boot, as time_boot_ms has them."""
        return (t_ns - self.boot_ns) // 1_000_000

    def us(self, t_ns: int) -> int:
        """Microseconds since boot, as time_usec has them."""
        return (t_ns - self.boot_ns) // 1000


def encode(record: Stamped, airframe: Airframe) -> Message:
    """The message that carries `record`. ValueError for a kind that no autopilot sends."""
    encoder = _ENCODERS.get(type(record))
    if encoder is None:
        raise ValueError(f"no autopilot sends a {type(record).__name__}: encode what its sensors say")
    return encoder(record, airframe)


def _deg_e7(angle: float) -> int:
    return round(math.degrees(angle) * 1e7)


def _mm(metres: float) -> int:
    return round(metres * 1e3)


def _cdeg(heading: float) -> int:
    return round(math.degrees(heading % math.tau) * 100.0) % 36000


def _or_nan(value: float | None) -> float:
    return math.nan if value is None else value


def _accuracy(sigma: float | None) -> int:
    return 0 if sigma is None else max(1, _mm(sigma))


def _wrapped(heading: float) -> float:
    return math.remainder(heading, math.tau)


def _quaternion(attitude: Vector3) -> list[float]:
    """w, x, y, z of the rotation b -> n by roll, pitch, heading."""
    (sr, cr), (sp, cp), (sh, ch) = ((math.sin(0.5 * a), math.cos(0.5 * a)) for a in attitude)
    return [
        cr * cp * ch + sr * sp * sh,
        sr * cp * ch - cr * sp * sh,
        cr * sp * ch + sr * cp * sh,
        cr * cp * sh - sr * sp * ch,
    ]


def _imu(r: Imu, a: Airframe) -> Message:
    if a.autopilot == "px4":
        names = ("xacc", "yacc", "zacc", "xgyro", "ygyro", "zgyro")
        values = dict(zip(names, (*r.f_b, *r.w_b)))
        return dialect.new(
            "HIGHRES_IMU", time_usec=a.us(r.t_ns), id=r.source, fields_updated=_INERTIAL_UPDATED, **values
        )
    fields = {
        **{f"{axis}acc": round(f / _MILLI_G) for axis, f in zip("xyz", r.f_b)},
        **{f"{axis}gyro": round(w * 1e3) for axis, w in zip("xyz", r.w_b)},
    }
    if r.source == 0:
        return dialect.new("RAW_IMU", time_usec=a.us(r.t_ns), **fields)
    return dialect.new(f"SCALED_IMU{r.source + 1}", time_boot_ms=a.ms(r.t_ns), **fields)


def _attitude(r: Attitude, a: Airframe) -> Message:
    p, q, s = r.w_b or (math.nan, math.nan, math.nan)
    return dialect.new(
        "ATTITUDE",
        time_boot_ms=a.ms(r.t_ns),
        roll=r.roll,
        pitch=r.pitch,
        yaw=_wrapped(r.heading),
        rollspeed=p,
        pitchspeed=q,
        yawspeed=s,
    )


def _gnss(r: Gnss, a: Airframe) -> Message:
    vel = cog = 0xFFFF
    if r.v_n is not None:
        vel = min(round(math.hypot(r.v_n[0], r.v_n[1]) * 100.0), 0xFFFE)
        cog = _cdeg(math.atan2(r.v_n[1], r.v_n[0]))
    return dialect.new(
        "GPS_RAW_INT" if r.receiver == 0 else "GPS2_RAW",
        time_usec=r.stamp_us,
        fix_type=r.fix,
        lat=_deg_e7(r.lat),
        lon=_deg_e7(r.lon),
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


def _local_position(r: LocalPosition, a: Airframe) -> Message:
    (x, y, z), (vx, vy, vz) = r.x_n, r.v_n
    return dialect.new("LOCAL_POSITION_NED", time_boot_ms=a.ms(r.t_ns), x=x, y=y, z=z, vx=vx, vy=vy, vz=vz)


def _place(name: str) -> Callable[[LocalOrigin | HomePosition, Airframe], Message]:
    def encode_place(r: LocalOrigin | HomePosition, a: Airframe) -> Message:
        return dialect.new(
            name,
            latitude=_deg_e7(r.lat),
            longitude=_deg_e7(r.lon),
            altitude=_mm(r.alt_msl),
            time_usec=a.us(r.t_ns),
        )

    return encode_place


def _global_position(r: GlobalPosition, a: Airframe) -> Message:
    vx, vy, vz = (round(v * 100.0) for v in r.v_n)
    return dialect.new(
        "GLOBAL_POSITION_INT",
        time_boot_ms=a.ms(r.t_ns),
        lat=_deg_e7(r.lat),
        lon=_deg_e7(r.lon),
        alt=_mm(r.alt_msl),
        relative_alt=_mm(r.height_above_home),
        vx=vx,
        vy=vy,
        vz=vz,
        hdg=0xFFFF if r.heading is None else _cdeg(r.heading),
    )


def _air_data(r: AirData, a: Airframe) -> Message:
    return dialect.new(
        "VFR_HUD",
        airspeed=r.airspeed,
        groundspeed=_or_nan(r.groundspeed),
        climb=_or_nan(r.climb),
        heading=-1 if r.heading is None else round(math.degrees(r.heading)) % 360,
        alt=_or_nan(r.alt_msl),
    )


def _wind(r: Wind, a: Airframe) -> Message:
    north, east, down = r.v_n
    if a.autopilot == "px4":
        variance = 0.0 if r.sigma is None else 2.0 * r.sigma**2
        return dialect.new(
            "WIND_COV", time_usec=a.us(r.t_ns), wind_x=north, wind_y=east, wind_z=down, var_horiz=variance
        )
    direction = math.degrees(math.atan2(-east, -north))
    return dialect.new("WIND", direction=direction, speed=math.hypot(north, east, down), speed_z=down)


def _pressure(r: Pressure, a: Airframe) -> Message:
    kelvin = 288.15 if r.temperature is None else r.temperature
    return dialect.new(
        "SCALED_PRESSURE",
        time_boot_ms=a.ms(r.t_ns),
        press_abs=r.static * 0.01,
        press_diff=_or_nan(r.differential) * 0.01,
        temperature=round((kelvin - _ZERO_CELSIUS) * 100.0),
    )


def _filter_status(r: FilterStatus, a: Airframe) -> Message:
    if a.autopilot == "px4":
        return dialect.new(
            "ESTIMATOR_STATUS",
            time_usec=a.us(r.t_ns),
            flags=r.flags,
            pos_horiz_ratio=r.position_ratio,
            pos_horiz_accuracy=_or_nan(r.horizontal_accuracy),
        )
    return dialect.new("EKF_STATUS_REPORT", flags=r.flags, pos_horiz_variance=r.position_ratio)


def _system_time(r: SystemTime, a: Airframe) -> Message:
    unix_us = 0 if r.unix_ns is None else r.unix_ns // 1000
    return dialect.new("SYSTEM_TIME", time_unix_usec=unix_us, time_boot_ms=r.boot_ns // 1_000_000)


def _truth(r: Truth, a: Airframe) -> Message:
    attitude = r.attitude or (0.0, 0.0, 0.0)
    lat, lon = _deg_e7(r.lat), _deg_e7(r.lon)
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
    # ArduPilot 4.7 puts 1e-7 degrees into the float fields, too coarse to be read.
    places = {"lat": float(lat), "lon": float(lon), "lat_int": lat, "lon_int": lon, "alt": r.alt}
    angles = {"roll": roll, "pitch": pitch, "yaw": _wrapped(heading)}
    return dialect.new("SIM_STATE", vn=vn, ve=ve, vd=vd, **q, **angles, **places)


def _rsbn(r: RsbnFix, a: Airframe) -> Message:
    status = _RSBN_SIMULATED
    status |= 0 if r.azimuth is None else _RSBN_AZIMUTH
    status |= 0 if r.slant_range is None else _RSBN_RANGE
    return dialect.new(
        "RSBN_MEASUREMENT",
        time_usec=a.us(r.t_ns),
        beacon_id=r.beacon,
        beacon_lat=_deg_e7(r.lat),
        beacon_lon=_deg_e7(r.lon),
        beacon_alt=r.alt,
        azimuth=_or_nan(r.azimuth),
        slant_range=_or_nan(r.slant_range),
        sigma_azimuth=r.sigma_azimuth,
        sigma_range=r.sigma_range,
        status=status,
    )


_ENCODERS: dict[type[Stamped], Callable[[Any, Airframe], Message]] = {
    Imu: _imu,
    Attitude: _attitude,
    Gnss: _gnss,
    LocalPosition: _local_position,
    LocalOrigin: _place("GPS_GLOBAL_ORIGIN"),
    HomePosition: _place("HOME_POSITION"),
    GlobalPosition: _global_position,
    AirData: _air_data,
    Wind: _wind,
    Pressure: _pressure,
    FilterStatus: _filter_status,
    SystemTime: _system_time,
    RsbnFix: _rsbn,
    Truth: _truth,
}
