"""Small valid logs of every format, made here: what the file mutants and the tests start from.

    file_name, content = SAMPLES["ulg"]              # content() returns the bytes of the file

Each holds a few seconds of one flight: GNSS fixes and local positions, with an origin.
"""

from __future__ import annotations

import gzip
import io
import struct
import tempfile
import zipfile
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path

import numpy as np

from companion import records
from companion.importers.ulog_messages import MAGIC
from companion.storage import flight_log
from companion.units import SECOND_NS
from sitl.endurance import fuzz_targets

SECONDS = 6
LAT, LON, METRE = 45.0, 7.0, 1.0 / 111_320.0
_UNIX_US = 1_700_000_000_000_000
_WEEK, _WEEK_MS = 2300, 100_000_000

#: DataFlash: format, columns, struct layout, and the values at t microseconds, x metres north.
_DATAFLASH: dict[str, tuple[str, str, str, Callable[[int, float], Sequence[object]]]] = {
    "GPS": (
        "QBBIHBcLLeffff",
        "TimeUS,I,Status,GMS,GWk,NSats,HDop,Lat,Lng,Alt,Spd,GCrs,VZ,Yaw",
        "QBBIHBhiiiffff",
        lambda t, x: (
            *(t, 0, 3, _WEEK_MS + t // 1000, _WEEK, 10, 80, round((LAT + x * METRE) * 1e7)),
            *(round(LON * 1e7), 30_000, 20.0, 0.0, 0.0, 0.0),
        ),
    ),
    "ORGN": (
        "QBLLe",
        "TimeUS,Type,Lat,Lng,Alt",
        "QBiii",
        lambda t, x: (t, 0, round(LAT * 1e7), round(LON * 1e7), 29_000),
    ),
    "XKF1": (
        "QBccCfffffff",
        "TimeUS,C,Roll,Pitch,Yaw,VN,VE,VD,dPD,PN,PE,PD",
        "QBhhHfffffff",
        lambda t, x: (t, 0, 0, 0, 0, 20.0, 0.0, 0.0, 0.0, x, 0.0, -10.0),
    ),
    "ATT": ("Qccccff", "TimeUS,DR,Roll,DP,Pitch,DY,Yaw", "Qhhhhff", lambda t, x: (t, 0, 9, 0, -5, 0.0, 3.0)),
    "POS": (
        "QLLfff",
        "TimeUS,Lat,Lng,Alt,RelHomeAlt,RelOriginAlt",
        "Qiifff",
        lambda t, x: (t, round((LAT + x * METRE) * 1e7), round(LON * 1e7), 300.0, 10.0, 10.0),
    ),
    "MSG": ("QZ", "TimeUS,Message", "Q64s", lambda t, x: (t, b"Throttle armed")),
}


def _instants() -> Iterable[tuple[int, float]]:
    return ((1_000_000 + 200_000 * k, 4.0 * k) for k in range(5 * SECONDS))


def dataflash_binary() -> bytes:
    """Return a `.bin`."""
    definition = struct.Struct("<BB4s16s64s")
    out = b"\xa3\x95\x80" + definition.pack(128, 89, b"FMT", b"BBnNZ", b"Type,Length,Name,Format,Columns")
    for number, (name, (codes, columns, layout, _)) in enumerate(_DATAFLASH.items(), start=130):
        values = number, 3 + struct.calcsize("<" + layout), name.encode(), codes.encode(), columns.encode()
        out += b"\xa3\x95\x80" + definition.pack(*values)
    for t, x in _instants():
        for number, (_, _, layout, values_at) in enumerate(_DATAFLASH.values(), start=130):
            out += b"\xa3\x95" + bytes([number]) + struct.pack("<" + layout, *values_at(t, x))
    return out


def dataflash_text() -> bytes:
    """Return a `.log`."""
    lines = ["FMT, 128, 89, FMT, BBnNZ, Type,Length,Name,Format,Columns"]
    for number, (name, (codes, columns, layout, _)) in enumerate(_DATAFLASH.items(), start=130):
        size = 3 + struct.calcsize("<" + layout)
        lines.append(f"FMT, {number}, {size}, {name}, {codes}, {columns}")
    divisors = {"c": 100.0, "C": 100.0, "e": 100.0, "L": 1e7}
    for t, x in _instants():
        for name, (codes, _, _, values_at) in _DATAFLASH.items():
            cells = [
                v.decode() if isinstance(v, bytes) else str(v / divisors[c]) if c in divisors else str(v)  # type: ignore[operator]
                for c, v in zip(codes, values_at(t, x), strict=True)
            ]
            lines.append(", ".join([name, *cells]))
    return "\n".join([*lines, ""]).encode()


_ULOG: dict[str, tuple[str, str, Callable[[int, float], Sequence[float]]]] = {
    "vehicle_gps_position": (
        "uint64_t timestamp;uint64_t time_utc_usec;int32_t lat;int32_t lon;int32_t alt;int32_t alt_ellipsoid;"
        "float s_variance_m_s;float eph;float epv;float hdop;float vel_n_m_s;float vel_e_m_s;float vel_d_m_s;"
        "uint8_t fix_type;bool vel_ned_valid;uint8_t satellites_used;",
        "QQiiiifffffffB?B",
        lambda t, x: (
            *(t, _UNIX_US + t, round((LAT + x * METRE) * 1e7), round(LON * 1e7), 300_000, 347_000),
            *(0.4, 1.3, 1.7, 0.8, 20.0, 0.0, 0.0, 3, True, 10),
        ),
    ),
    "vehicle_local_position": (
        "uint64_t timestamp;float x;float y;float z;float vx;float vy;float vz;double ref_lat;double ref_lon;"
        "float ref_alt;bool xy_valid;bool z_valid;bool xy_global;uint8_t xy_reset_counter;",
        "Qffffffddf???B",
        lambda t, x: (t, x, 0.0, -10.0, 20.0, 0.0, 0.0, LAT, LON, 290.0, True, True, True, 0),
    ),
    "vehicle_attitude": (
        "uint64_t timestamp;float[4] q;uint8_t[4] _padding0;",
        "Qffff4x",
        lambda t, x: (t, 1.0, 0.0, 0.0, 0.0),
    ),
}


def ulog() -> bytes:
    """Return a `.ulg`."""

    def message(kind: str, body: bytes) -> bytes:
        return struct.pack("<HB", len(body), ord(kind)) + body

    out = MAGIC + b"\x01" + struct.pack("<Q", 1_000_000) + message("B", bytes(40))
    out += b"".join(message("F", f"{name}:{fields}".encode()) for name, (fields, _, _) in _ULOG.items())
    for number, name in enumerate(_ULOG):
        out += message("A", struct.pack("<BH", 0, number) + name.encode())
    for t, x in _instants():
        for number, (_, layout, values_at) in enumerate(_ULOG.values()):
            out += message("D", struct.pack("<H", number) + struct.pack("<" + layout, *values_at(t, x)))
    return out + message("L", b"4" + struct.pack("<Q", 7_000_000) + b"Failsafe") + message("O", b"\x78\x00")


def csv_topic() -> bytes:
    """Return `vehicle_local_position.csv`, as ulog2csv writes it."""
    fields, _, values_at = _ULOG["vehicle_local_position"]
    names = [field.split(" ")[1] for field in fields.split(";")[:-1]]
    rows = [",".join(str(int(v) if isinstance(v, bool) else v) for v in values_at(*at)) for at in _instants()]
    return "\n".join([",".join(names), *rows, ""]).encode()


def tlog() -> bytes:
    """Return a `.tlog`: the flight that the fuzz targets fly."""
    out, now_us = b"", _UNIX_US
    for wait_ms, raw in fuzz_targets.script_frames(fuzz_targets.flight_script(SECONDS)):
        now_us += 1000 * wait_ms
        out += now_us.to_bytes(8, "big") + raw
    return out


def tables() -> bytes:
    """Return a `.zip` of InertialNav's text tables."""
    k = np.arange(0.0, 60.0)
    lat, zero = LAT + 4.0 * k * METRE, np.zeros_like(k)
    track = np.column_stack([100.0 * k, lat, zero + LON, zero + 300.0, zero + 20.0, zero, zero])
    imu = np.column_stack([100.0 * k, k, zero, zero, zero, zero, zero, zero - 9.8])
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, table in (("GPOSonboard", track), ("GPSraw", track), ("IMU", imu)):
            text = io.StringIO()
            np.savetxt(text, table, fmt="%.8g")
            archive.writestr(f"{name}.txt", text.getvalue())
    return out.getvalue()


def matlab() -> bytes:
    """Return a `.mat` with the tables of an ArduPilot log."""
    from scipy.io import savemat

    k = np.arange(0.0, 30.0)
    zero = np.zeros_like(k)
    imu = np.column_stack([k, 1000.0 + 100.0 * k, zero, zero, zero, zero, zero, zero - 9.8])
    names = ["LineNo", "TimeMS", "GyrX", "GyrY", "GyrZ", "AccX", "AccY", "AccZ"]
    out = io.BytesIO()
    savemat(
        out,  # type: ignore[arg-type]
        {"IMU": imu, "IMU_label": np.array([[name] for name in names], dtype=object)},
        do_compression=True,
    )
    return out.getvalue()


def mcap() -> bytes:
    """Return our own closed log."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "x.mcap"
        with flight_log.Writer(path, metadata={"a": {"b": "c"}}, start_unix_ns=SECOND_NS, start_ns=0) as log:
            for t, x in _instants():
                lat, lon = np.radians(LAT + x * METRE).item(), np.radians(LON).item()
                ns = t * 1000
                log.record(records.Gnss(ns, ns, 0, t, 3, lat, lon, 300.0))
                log.record(records.LocalPosition(ns, ns, (x, 0.0, -10.0), (20.0, 0.0, 0.0)))
        return path.read_bytes()


#: File name and content of each format.
SAMPLES: dict[str, tuple[str, Callable[[], bytes]]] = {
    "bin": ("x.bin", dataflash_binary),
    "log": ("x.log", dataflash_text),
    "ulg": ("x.ulg", ulog),
    "tlog": ("x.tlog", tlog),
    "csv": ("vehicle_local_position.csv", csv_topic),
    "csv.gz": ("vehicle_local_position.csv.gz", lambda: gzip.compress(csv_topic(), mtime=0)),
    "zip": ("x.zip", tables),
    "mat": ("x.mat", matlab),
    "mcap": ("x.mcap", mcap),
    "mcap.active": ("x.mcap.active", fuzz_targets.small_log),
}
