"""Recordings of the InertialNav project (github.com/priseborough/InertialNav) -> records.

Two formats: a `.mat` with the messages of an ArduPilot log as matrices with column names, converted by
`dataflash.MessageConverter`; and a `.zip` (or folder) of `IMU.txt`, `GPSraw.txt` and `GPOSonboard.txt`
without names, with the columns that the project's own replay reads (main_closed_loop_float.cpp): first the
time in milliseconds. GPOSonboard, the onboard position filter, becomes the local position, tangent at its
first point. Its attitude is not used, as it disagrees with its gyros. Times count from the start of the log.
"""

from __future__ import annotations

import heapq
import io
import math
import zipfile
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np

from companion.importers import dataflash, gnss_latency
from companion.nav.geometry import Geodetic, geodetic_to_local
from companion.records import Event, GlobalPosition, Gnss, Imu, LocalOrigin, LocalPosition, Stamped
from companion.storage.reader import LogError
from companion.units import Floats

_WIDTHS = {"IMU": 8, "GPSraw": 7, "GPOSonboard": 7}


def read_matlab(path: Path) -> Iterator[Stamped]:
    """Return the records of a `.mat` by time.

    Raises LogError if it is not a MATLAB file or has no such table.
    """
    from scipy.io import loadmat

    try:
        tables: dict[str, Any] = loadmat(path)
    except FileNotFoundError:
        raise LogError(f"{path}: no such log") from None
    except Exception as error:  # scipy raises many different exceptions
        raise LogError(f"{path} is not a MATLAB file: {error}") from None
    rows = [
        _rows(name, tables[name], [_label(cell) for cell in tables[f"{name}_label"]])
        for name in dataflash.NAMES
        if name in tables and f"{name}_label" in tables and tables[name].dtype.kind == "f"
    ]
    if not rows:
        raise LogError(f"{path} has no ArduPilot table: it needs GPS, IMU, ATT, ... each with its _label")
    messages = dataflash.MessageConverter()
    return _convert_rows(messages, heapq.merge(*rows, key=lambda row: row[0]))


def _label(cell: Any) -> str:
    inner = cell[0]
    return str(inner[0]) if inner.size else ""


def _rows(name: str, table: Floats, columns: list[str]) -> Iterator[tuple[int, str, SimpleNamespace]]:
    for values in table.tolist():
        message = SimpleNamespace(**dict(zip(columns, values, strict=False)))
        boot_us = dataflash.boot_time_us(message)
        if boot_us is not None:
            yield boot_us, name, message


def _convert_rows(messages: dataflash.MessageConverter, rows: Any) -> Iterator[Stamped]:
    for boot_us, name, message in rows:
        yield from messages.records(name, message, boot_us * 1000)


def read_tables(path: Path) -> Iterator[Stamped]:
    """Return the records of a `.zip` or folder of text tables by time, with GNSS glitches as events.

    Raises LogError if a table is missing or malformed.
    """
    columns = {name: _table(path, name, width) for name, width in _WIDTHS.items()}
    fixes, onboard = list(_fixes(columns["GPSraw"])), list(_onboard_positions(columns["GPOSonboard"]))
    glitches: list[Event] = list(
        gnss_latency.glitch_events(
            map(gnss_latency.analyze_track, gnss_latency.collect_tracks([*onboard, *fixes]))
        )
    )
    return heapq.merge(onboard, fixes, _imu(columns["IMU"]), glitches, key=lambda record: record.t_ns)


def has_tables(folder: Path) -> bool:
    """Return whether a folder contains the tables."""
    return (folder / "GPOSonboard.txt").exists()


def _table(path: Path, name: str, width: int) -> Floats:
    member = f"{name}.txt"
    try:
        if path.is_dir():
            text = (path / member).read_text(encoding="ascii")
        else:
            with zipfile.ZipFile(path) as archive:
                text = archive.read(member).decode("ascii")
        table = np.loadtxt(io.StringIO(text), ndmin=2)
    except FileNotFoundError:
        raise LogError(f"{path}: no such log") from None
    except KeyError:
        raise LogError(f"{path} has no {member}: it needs {', '.join(f'{n}.txt' for n in _WIDTHS)}") from None
    except (zipfile.BadZipFile, ValueError) as error:
        raise LogError(f"{path} is damaged in {member}: {error}") from None
    if table.shape[0] < 2 or table.shape[1] != width:
        raise LogError(
            f"{path}: {member} has {table.shape[0]} rows of {table.shape[1]} columns;"
            f" it needs at least 2 rows of {width}"
        )
    return table[np.argsort(table[:, 0], kind="stable")]


def _ns(milliseconds: float) -> int:
    return round(milliseconds * 1e3) * 1000


def _imu(table: Floats) -> Iterator[Stamped]:
    for ms, _, p, q, r, fx, fy, fz in table.tolist():
        t = _ns(ms)
        yield Imu(t, t, 0, (fx, fy, fz), (p, q, r))


def _fixes(table: Floats) -> Iterator[Stamped]:
    for ms, lat, lon, alt, north, east, down in table.tolist():
        t = _ns(ms)
        # each row is a fix, identified by its time; plus one microsecond, as stamp 0 means "no stamp"
        yield Gnss(
            t, t, 0, t // 1000 + 1, 3, math.radians(lat), math.radians(lon), alt, v_n=(north, east, down)
        )


def _onboard_positions(table: Floats) -> Iterator[Stamped]:
    origin: Geodetic | None = None
    for ms, lat, lon, alt, north, east, down in table.tolist():
        t, v_n = _ns(ms), (north, east, down)
        point = Geodetic(math.radians(lat), math.radians(lon), alt)
        if origin is None:
            origin = point
            yield LocalOrigin(t, t, *origin, "tangent")
        x, y, z = geodetic_to_local("tangent", origin, point)
        yield LocalPosition(t, t, (x, y, z), v_n)
        yield GlobalPosition(t, t, *point, v_n, alt - origin.alt)
