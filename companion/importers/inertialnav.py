"""The recordings of the InertialNav project (github.com/priseborough/InertialNav) -> records.

Two kinds of tables: a `.mat` with an ArduPilot log's messages as matrices beside their column names, which go
through `dataflash.Messages`; and a `.zip` (or its folder) of `IMU.txt`, `GPSraw.txt`, `GPOSonboard.txt`
without names, whose columns are those that project's own replay reads (main_closed_loop_float.cpp): the time
first, milliseconds. GPOSonboard is the position filter on board, told as the local position, tangent at its
own first point. Its attitude is left out: it disagrees with its gyros. Times are since the log's beginning.
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
import numpy.typing as npt

from companion.analysis import gnss_latency
from companion.importers import dataflash
from companion.nav.geometry import Geodetic, geodetic_to_local
from companion.records import Event, GlobalPosition, Gnss, Imu, LocalOrigin, LocalPosition, Stamped
from companion.storage.reader import LogError

Floats = npt.NDArray[np.float64]

_WIDTHS = {"IMU": 8, "GPSraw": 7, "GPOSonboard": 7}


def read_matlab(path: Path) -> Iterator[Stamped]:
    """The records of a `.mat` by time. LogError, one sentence, if it is none or holds no such table."""
    from scipy.io import loadmat

    try:
        tables: dict[str, Any] = loadmat(path)
    except FileNotFoundError:
        raise LogError(f"{path}: no such log") from None
    except Exception as error:  # scipy names a dozen ways not to be a .mat
        raise LogError(f"{path} is no MATLAB file: {error}") from None
    rows = [
        _rows(name, tables[name], [_label(cell) for cell in tables[f"{name}_label"]])
        for name in dataflash.NAMES
        if name in tables and f"{name}_label" in tables and tables[name].dtype.kind == "f"
    ]
    if not rows:
        raise LogError(f"{path} holds no ArduPilot table: it needs GPS, IMU, ATT, ... each with its _label")
    messages = dataflash.Messages()
    return _mapped(messages, heapq.merge(*rows, key=lambda row: row[0]))


def _label(cell: Any) -> str:
    inner = cell[0]
    return str(inner[0]) if inner.size else ""


def _rows(name: str, table: Floats, columns: list[str]) -> Iterator[tuple[int, str, SimpleNamespace]]:
    for values in table.tolist():
        message = SimpleNamespace(**dict(zip(columns, values, strict=False)))
        boot_us = dataflash.boot_time_us(message)
        if boot_us is not None:
            yield boot_us, name, message


def _mapped(messages: dataflash.Messages, rows: Any) -> Iterator[Stamped]:
    for boot_us, name, message in rows:
        yield from messages.records(name, message, boot_us * 1000)


def read_tables(path: Path) -> Iterator[Stamped]:
    """The records of a `.zip` or a folder of text tables by time, GNSS glitches told as events.

    LogError, one sentence, where a table is missing or is none.
    """
    columns = {name: _table(path, name, width) for name, width in _WIDTHS.items()}
    fixes, onboard = list(_fixes(columns["GPSraw"])), list(_onboard(columns["GPOSonboard"]))
    told: list[Event] = list(
        gnss_latency.events(map(gnss_latency.look, gnss_latency.watch([*onboard, *fixes])))
    )
    return heapq.merge(onboard, fixes, _imu(columns["IMU"]), told, key=lambda record: record.t_ns)


def is_tables(folder: Path) -> bool:
    """Whether a folder holds the tables."""
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
        raise LogError(
            f"{path} holds no {member}: it needs {', '.join(f'{n}.txt' for n in _WIDTHS)}"
        ) from None
    except (zipfile.BadZipFile, ValueError) as error:
        raise LogError(f"{path} is damaged at {member}: {error}") from None
    if table.shape[0] < 2 or table.shape[1] != width:
        raise LogError(f"{path}: {member} has {table.shape[1]} columns where {width} are known, or no rows")
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
        # a row is a fix: its time tells it from the others, one microsecond later for 0 is "none sent"
        yield Gnss(
            t, t, 0, t // 1000 + 1, 3, math.radians(lat), math.radians(lon), alt, v_n=(north, east, down)
        )


def _onboard(table: Floats) -> Iterator[Stamped]:
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
