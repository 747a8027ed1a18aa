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
import os
import struct
import subprocess
import sys
import warnings
import zipfile
import zlib
from collections.abc import Callable, Iterable, Iterator
from functools import partial
from io import TextIOWrapper
from itertools import chain
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np

from companion.importers import dataflash, gnss_latency
from companion.importers.foreign_file import Damage, map_file, one_line, steady_steps
from companion.nav.geometry import Geodetic, geodetic_to_local
from companion.records import GlobalPosition, Gnss, Imu, LocalOrigin, LocalPosition, Stamped
from companion.storage.reader import LogError, open_regular
from companion.units import Floats

MAX_TABLES = 1 << 25
"""Bytes of a text table, or of all tables of a `.mat`, compressed and expanded; the recordings have 2 MB."""
MAX_ROWS = 1 << 19  # of all tables; the recordings have 72,000
MAX_NUMBER = 1e10  # ms, deg, m, m/s, rad/s, m/s^2
READ_S = 60
_TABLES = str(Path(__file__).with_name("matlab_tables.py"))
_COMPRESSED = 15  # miCOMPRESSED
_BYTE_ORDERS = {b"IM": "<", b"MI": ">"}
_MAX_LINE = 1000
_ENCRYPTED = 1  # bit of the flags of a ZIP member
_WIDTHS = {"IMU": 8, "GPSraw": 7, "GPOSonboard": 7}


class Recording:
    """The records of a recording by time, to be iterated once."""

    def __init__(self, records: Callable[[Damage], Iterator[Stamped]]) -> None:
        self.damage = Damage()
        self._records = records

    def __iter__(self) -> Iterator[Stamped]:
        """Yield the records."""
        return self._records(self.damage)


def read_matlab(path: Path) -> Recording:
    """Open a `.mat`. Raises LogError if it is not a MATLAB file or has no such table."""
    try:
        _reject_bomb(path)
    except zlib.error as error:
        raise LogError(
            f"{path} is no MATLAB file, or is damaged ({one_line(error)}): copy the recording again"
        ) from None
    tables = _matlab_tables(path)
    if sum(len(tables[name]) for name in dataflash.NAMES if name in tables) > MAX_ROWS:
        raise LogError(f"{path}: its tables have more than {MAX_ROWS} rows")
    rows = [
        _rows(name, tables[name], tables[f"{name}_label"].tolist())
        for name in dataflash.NAMES
        if name in tables
    ]
    if not rows:
        raise LogError(f"{path} has no ArduPilot table: it needs GPS, IMU, ATT, ... each with its _label")
    return Recording(partial(_convert_rows, heapq.merge(*rows, key=lambda row: row[0])))


def _matlab_tables(path: Path) -> dict[str, Any]:
    """Tables and labels by name, read in a process of its own, which a damaged file may end."""
    command = [sys.executable, "-P", _TABLES, str(path), str(MAX_TABLES), *dataflash.NAMES]
    alone = os.environ | {"OPENBLAS_NUM_THREADS": "1"}  # each thread of it would take part of the memory
    try:
        found = subprocess.run(command, capture_output=True, timeout=READ_S, check=True, env=alone)
        return dict(np.load(io.BytesIO(found.stdout), allow_pickle=False))
    except subprocess.TimeoutExpired:
        why = f"it takes more than {READ_S} s to read"
    except subprocess.CalledProcessError as error:
        lines = error.stderr.decode(errors="replace").strip().splitlines()
        why = lines[-1] if error.returncode > 0 and lines else "its reader failed on it"
    except (ValueError, OSError, zipfile.BadZipFile) as error:
        why = str(error)
    why = " ".join(why.split())[:200]
    raise LogError(f"{path} is no MATLAB file, or is damaged ({why}): copy the recording again")


def _reject_bomb(path: Path) -> None:
    """Raise LogError if the tables of a MATLAB file have more than `MAX_TABLES` bytes, or expand beyond."""
    data, at, left = map_file(path, MAX_TABLES), 128, MAX_TABLES
    order = _BYTE_ORDERS.get(data[126:128])
    if order is None:
        raise LogError(f"{path} is not a MATLAB file: its header states no byte order")
    while at + 8 <= len(data):
        kind, size = struct.unpack_from(f"{order}II", data, at)
        if kind == _COMPRESSED:
            inflate = zlib.decompressobj()
            rest = data[at + 8 : at + 8 + size]
            while rest and left > 0 and not inflate.eof:
                left -= len(inflate.decompress(rest, min(left, 1 << 20)))
                rest = inflate.unconsumed_tail
        else:
            left -= size
        if left <= 0:
            raise LogError(f"{path}: its tables expand to more than {MAX_TABLES} bytes")
        at += 8 + size


def _rows(name: str, table: Floats, columns: list[str]) -> Iterator[tuple[int, str, SimpleNamespace]]:
    for values in map(np.ndarray.tolist, table):
        message = SimpleNamespace(**dict(zip(columns, values, strict=False)))
        boot_us = dataflash.boot_time_us(message)
        if boot_us is not None:
            yield boot_us, name, message


def _convert_rows(rows: Iterable[tuple[int, str, SimpleNamespace]], damage: Damage) -> Iterator[Stamped]:
    converter = dataflash.MessageConverter()
    for step in steady_steps(((us, number, (name, m)) for number, (us, name, m) in enumerate(rows)), damage):
        name, message = step.item
        try:
            yield from converter.records(name, message, step.boot_us * 1000)
        except (AttributeError, TypeError, ValueError, OverflowError) as error:
            damage.add(f"{name} at {step.boot_us} us", 0, one_line(error))


def read_tables(path: Path) -> Recording:
    """Open a `.zip` or folder of text tables, with GNSS glitches as events.

    Raises LogError if a table is missing or malformed.
    """
    columns: dict[str, Floats] = {}
    for name, width in _WIDTHS.items():
        columns[name] = _table(path, name, width, MAX_ROWS - sum(map(len, columns.values())))
    return Recording(partial(_merged_tables, columns))


def _merged_tables(columns: dict[str, Floats], damage: Damage) -> Iterator[Stamped]:
    fixes, onboard = partial(_fixes, columns["GPSraw"]), partial(_onboard_positions, columns["GPOSonboard"])
    tracks = gnss_latency.collect_tracks(chain(onboard(), fixes()))
    glitches = list(gnss_latency.glitch_events(map(gnss_latency.analyze_track, tracks)))
    return heapq.merge(onboard(), fixes(), _imu(columns["IMU"]), glitches, key=lambda record: record.t_ns)


def has_tables(folder: Path) -> bool:
    """Return whether a folder contains the tables."""
    return (folder / "GPOSonboard.txt").exists()


def _table(path: Path, name: str, width: int, max_rows: int) -> Floats:
    member = f"{name}.txt"
    try:
        with (
            TextIOWrapper(io.BytesIO(_read_member(path, member)), encoding="ascii") as file,
            warnings.catch_warnings(action="error"),  # an empty table
        ):
            table = np.loadtxt(_short_lines(file), ndmin=2, max_rows=max_rows + 1)
    except LogError:
        raise
    except FileNotFoundError:
        raise LogError(f"{path}: no such log") from None
    except KeyError:
        raise LogError(f"{path} has no {member}: it needs {', '.join(f'{n}.txt' for n in _WIDTHS)}") from None
    except zipfile.BadZipFile:
        raise LogError(f"{path} is no ZIP archive, or is incomplete: copy the recording again") from None
    except UserWarning:
        raise LogError(f"{path}: {member} is empty: it needs at least 2 rows of {width} columns") from None
    except Exception as error:  # a damaged archive raises many different exceptions
        why = one_line(error).partition("; use `usecols`")[0]
        raise LogError(f"{path} is damaged in {member}: {why}") from None
    if len(table) > max_rows:
        raise LogError(f"{path}: its tables have more than {MAX_ROWS} rows")
    if not np.isfinite(table).all() or np.abs(table).max(initial=0.0) > MAX_NUMBER:
        raise LogError(f"{path} is damaged in {member}: a number is not finite or beyond {MAX_NUMBER:g}")
    if table.shape[0] < 2 or table.shape[1] != width:
        raise LogError(
            f"{path}: {member} has {table.shape[0]} rows of {table.shape[1]} columns;"
            f" it needs at least 2 rows of {width}"
        )
    return table[np.argsort(table[:, 0], kind="stable")]


def _short_lines(file: TextIOWrapper) -> Iterator[str]:
    """Yield the lines. Raises ValueError at one of more than `_MAX_LINE` characters."""
    while line := file.readline(_MAX_LINE + 1):
        if len(line) > _MAX_LINE:
            raise ValueError(f"a line has more than {_MAX_LINE} characters")
        yield line


def _read_member(path: Path, member: str) -> bytes:
    """Read one table. Raises LogError if it is larger than `MAX_TABLES`, or compressed with bzip2 or LZMA."""
    if path.is_dir():
        with open_regular(path / member) as file:
            content = file.read(MAX_TABLES + 1)
    else:
        with open_regular(path) as whole, zipfile.ZipFile(whole) as archive:
            found = archive.getinfo(member)
            if found.flag_bits & _ENCRYPTED:
                raise LogError(f"{path}: {member} is encrypted: pack it without a password")
            # the others are not decompressed in steps: they expand without a limit
            if found.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
                raise LogError(f"{path}: {member} is compressed by another method than Deflate")
            with archive.open(found) as packed:
                content = packed.read(MAX_TABLES + 1)
    if len(content) > MAX_TABLES:
        raise LogError(f"{path}: {member} has more than {MAX_TABLES} bytes")
    return content


def _ns(milliseconds: float) -> int:
    return round(milliseconds * 1e3) * 1000


def _imu(table: Floats) -> Iterator[Stamped]:
    for ms, _, p, q, r, fx, fy, fz in map(np.ndarray.tolist, table):
        t = _ns(ms)
        yield Imu(t, t, 0, (fx, fy, fz), (p, q, r))


def _fixes(table: Floats) -> Iterator[Stamped]:
    for ms, lat, lon, alt, north, east, down in map(np.ndarray.tolist, table):
        t = _ns(ms)
        # each row is a fix, identified by its time; plus one microsecond, as stamp 0 means "no stamp"
        yield Gnss(
            t, t, 0, t // 1000 + 1, 3, math.radians(lat), math.radians(lon), alt, v_n=(north, east, down)
        )


def _onboard_positions(table: Floats) -> Iterator[Stamped]:
    origin: Geodetic | None = None
    for ms, lat, lon, alt, north, east, down in map(np.ndarray.tolist, table):
        t, v_n = _ns(ms), (north, east, down)
        point = Geodetic(math.radians(lat), math.radians(lon), alt)
        if origin is None:
            origin = point
            yield LocalOrigin(t, t, *origin, "tangent")
        x, y, z = geodetic_to_local("tangent", origin, point)
        yield LocalPosition(t, t, (x, y, z), v_n)
        yield GlobalPosition(t, t, *point, v_n, alt - origin.alt)
