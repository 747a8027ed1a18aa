"""Schemas of a log for other programs: records with units, MAVLink frames, events as foxglove.Log, dialect.

A record keeps radians, as it is replayed bit for bit; its fields are `lat` and `lon`, and each description
states the unit. Where a schema has `latitude` it is in degrees: `location_fix`. Altitudes are above mean sea
level in a field with `msl` in its name, else above the WGS84 ellipsoid.
"""

from __future__ import annotations

from importlib.resources import files
from typing import Any

import msgspec
from mcap.records import Attachment

from companion.records import Event, Severity, Stamped

#: Unit and meaning of fields by name, or by "Record.field" where one name has two meanings.
FIELDS = {
    "t_ns": "ns, time of validity on the companion's monotonic clock",
    "rx_ns": "ns, time of arrival on the companion's monotonic clock",
    "ahead": "bounds of the inertial error some time ahead",
    "ahead_s": "s, time ahead of the solution",
    "airspeed": "m/s",
    "alt": "m above the WGS84 ellipsoid",
    "alt_a": "m above the WGS84 ellipsoid, station a",
    "alt_b": "m above the WGS84 ellipsoid, station b",
    "alt_msl": "m above mean sea level",
    "altitude": "rad above the horizon of the INS, refraction removed",
    "attitude": "rad: roll, pitch, heading",
    "azimuth": "rad clockwise from true north, measured at the beacon",
    "bad": "count of frames with a wrong checksum or signature",
    "StarFix.azimuth": "rad clockwise from the INS's north",
    "beacon": "identity of the beacon",
    "boot_ns": "ns since the autopilot's boot",
    "bound_n": "m: north, east; guaranteed r.m.s. bound",
    "bounds": "guaranteed bounds beside that of the position that is sent",
    "chain": "identity of the pair of stations",
    "claimed_n": "m: north, east; expected r.m.s. error",
    "climb": "m/s, up",
    "connected": "whether the link is open",
    "contradicted": "whether a first GNSS contradicts the beacon at which the position began",
    "correction_n": "m: north, east; inertial position minus fix",
    "cost": "chi-square of the residuals (no unit)",
    "covariance": "m^2: north-north, north-east, north-down, east-east, east-down, down-down",
    "Fix.covariance": "m^2: north-north, north-east, east-east",
    "ParallelEstimate.covariance": "m^2: north-north, north-east, east-east",
    "Smoothed.covariance": "m^2: north-north, north-east, east-east",
    "degrees_of_freedom": "of the cost",
    "differential": "Pa",
    "difference": "m, distance to station a minus distance to station b",
    "disagreement": "m, greatest distance between the running estimators",
    "drift_n": "rad/s: north, east; guaranteed r.m.s. bound",
    "dropped": "count of frames that were not sent",
    "error_n": "m: north, east; estimated error of the inertial channel",
    "estimator": "name of the leading estimator",
    "f_b": "m/s^2, specific force: forward, right, down",
    "false_sources": "name and probability (0..1) that each source is false",
    "fix": "GPS_FIX_TYPE of MAVLink (3: 3D)",
    "flags": "ESTIMATOR_STATUS_FLAGS of MAVLink",
    "flying": "whether it is in the air, by the autopilot",
    "gap": "relative distance within which optimum_n is proved to be the least",
    "gnss_false": "probability (0..1) that GNSS is false",
    "gnss_glitch": "whether the autopilot's estimator reports a GNSS glitch",
    "groundspeed": "m/s",
    "hdop": "horizontal dilution of precision (no unit)",
    "heading": "rad clockwise from true north",
    "healthy": "whether the sensor is present, enabled and healthy",
    "height_above_home": "m",
    "horizon_s": "s since the last accepted fix",
    "horizontal_accuracy": "m",
    "inertial_age_s": "s, age of the inertial sample",
    "ins": "identity of the second INS",
    "iterations": "count",
    "jamming": "GPS_JAMMING_STATE of MAVLink",
    "lat": "rad, geodetic latitude WGS84",
    "lat_a": "rad, station a",
    "lat_b": "rad, station b",
    "limit": "limit of the value, in its unit",
    "link": "name of the link",
    "lon": "rad, longitude WGS84",
    "lon_a": "rad, station a",
    "lon_b": "rad, station b",
    "lost": "count of frames missing by their sequence numbers",
    "mode": "basis of the position",
    "multirotor": "whether rotors of fixed pitch hold the vehicle up",
    "fixed_wing": "whether it has a wing",
    "hovering": "whether a VTOL is not in the flight of an aeroplane",
    "offset_ns": "ns, the companion's clock minus the autopilot's",
    "optimum_n": "m: north, east; least bound that any estimate could have",
    "parallel": "estimates of the filters that run beside the leading estimator",
    "pitch": "rad",
    "position_ratio": "innovation test ratio of the autopilot (no unit)",
    "projection": "local projection of the autopilot",
    "protection": "m, horizontal protection level",
    "reason": "text",
    "received": "count of frames",
    "receiver": "number of the GNSS receiver",
    "restarts": "how often the position was given up",
    "roll": "rad",
    "round_trip_ns": "ns",
    "satellites": "count",
    "sensed": "whether a sensor measures the airspeed",
    "severity": "MAV_SEVERITY of MAVLink",
    "sigma": "m/s",
    "RangeDifference.sigma": "m",
    "sigma_altitude": "rad",
    "sigma_azimuth": "rad",
    "sigma_horizontal": "m, per axis",
    "sigma_range": "m",
    "sigma_velocity": "m/s, per axis",
    "sigma_vertical": "m",
    "slant_range": "m",
    "source": "name of the source",
    "Imu.source": "number of the IMU",
    "sources": "bits: 1 inertial, 2 GNSS, 4 azimuth, 8 range, 16 air data",
    "spoofing": "GPS_SPOOFING_STATE of MAVLink",
    "star": "number of the star",
    "stamp_us": "us, time of the receiver as sent",
    "state": "state of the navigator in an earlier run, as base64",
    "static": "Pa",
    "step_s": "s by which the autopilot's times map later than before",
    "system": "MAVLink system number",
    "temperature": "K",
    "text": "text",
    "tilt_n": "rad: north, east; guaranteed r.m.s. bound",
    "toml": "the whole configuration as TOML",
    "true": "whether the airspeed is true, else indicated or equivalent",
    "trust": "0 normal, 1 degraded, 2 predicting, 3 untrusted",
    "used": "whether the autopilot uses the sensor, null if not stated",
    "unix_ns": "ns since 1970-01-01 UTC",
    "v_n": "m/s: north, east, down",
    "value": "value that was judged, in its unit",
    "velocity_bound_n": "m/s: north, east; guaranteed r.m.s. bound",
    "velocity_error_n": "m/s: north, east; estimated error of the inertial channel",
    "w_b": "rad/s: forward, right, down",
    "what": "what was reset",
    "widening": "factor of the bounds by residuals beyond the stated errors, 1 if none",
    "witness": "whether a beacon confirms the solution",
    "x_n": "m from the local origin: north, east, down",
}  # fmt: skip

LOG_NAME, LOG_TOPIC = "foxglove.Log", "/log"
TIME = {
    "type": "object",
    "title": "time",
    "properties": {
        "sec": {"type": "integer", "minimum": 0},
        "nsec": {"type": "integer", "minimum": 0, "maximum": 999_999_999},
    },
}
_LEVELS = {"UNKNOWN": 0, "DEBUG": 1, "INFO": 2, "WARNING": 3, "ERROR": 4, "FATAL": 5}
LOG: dict[str, Any] = {
    "title": LOG_NAME,
    "description": "A log message",
    "type": "object",
    "properties": {
        "timestamp": TIME,
        "level": {
            "title": "foxglove.LogLevel",
            "oneOf": [{"title": name, "const": number} for name, number in _LEVELS.items()],
        },
        "message": {"type": "string"},
        "name": {"type": "string"},
        "file": {"type": "string"},
        "line": {"type": "integer", "minimum": 0},
    },
}

MAVLINK = "mavlink"  # encoding and schema of raw frames
_DIALECT = "rsbn.xml"
FRAMES = (
    "One MAVLink 1 or 2 frame a message, as transmitted, from its start byte to its checksum or signature. "
    f"Dialect: ardupilotmega and, for ids 180000 to 180099, the attachment {_DIALECT}."
).encode()


class Log(msgspec.Struct, frozen=True, gc=False):
    """An event with the field names of foxglove.Log."""

    timestamp: dict[str, int]
    level: int
    message: str
    name: str = "companion"
    file: str = ""
    line: int = 0


def to_log(event: Event, unix_ns: int) -> Log:
    """Return the event as foxglove.Log; `unix_ns` is its wall-clock time."""
    if event.severity <= Severity.CRITICAL:
        level = "FATAL"
    elif event.severity == Severity.ERROR:
        level = "ERROR"
    elif event.severity == Severity.WARNING:
        level = "WARNING"
    else:
        level = "DEBUG" if event.severity == Severity.DEBUG else "INFO"
    return Log(to_time(unix_ns), _LEVELS[level], event.text)


def to_time(unix_ns: int) -> dict[str, int]:
    """Return a time with the field names of `TIME`."""
    return dict(zip(("sec", "nsec"), divmod(max(unix_ns, 0), 1_000_000_000), strict=True))


def record_schema(kind: type[Stamped]) -> bytes:
    """Return the JSON schema of a record, an object with the unit of each field in its description."""
    definitions: dict[str, Any] = msgspec.json.schema(kind)["$defs"]
    for name, definition in definitions.items():
        for field, found in definition.get("properties", {}).items():
            if field != "type":
                found["description"] = FIELDS.get(f"{name}.{field}") or FIELDS[field]
    root = definitions.pop(kind.__name__)
    return msgspec.json.encode(root | ({"$defs": definitions} if definitions else {}))


def dialect_attachment(unix_ns: int) -> Attachment:
    """Return the definition of our messages as an attachment of a log."""
    data = files("companion.link").joinpath(_DIALECT).read_bytes()
    return Attachment(
        create_time=unix_ns, log_time=unix_ns, name=_DIALECT, media_type="application/xml", data=data
    )
