"""PX4 topics as CSV files in a folder (`vehicle_gps_position.csv.gz`, ..., as named by ulog2csv) -> records.

Each file is one uORB topic, `timestamp` in microseconds since boot. The rows of all topics are merged by
time; arrival and validity are the same instant, as the log is written on board. Raw inertial data is not
read. Fields that a topic lacks remain None. A row that is not one of its topic is skipped and reported.
"""

from __future__ import annotations

import csv
import gzip
import heapq
import math
import zlib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import BinaryIO, TypeAlias, cast

from companion.importers.foreign_file import Damage, one_line, steady_steps
from companion.link.fields import euler
from companion.records import (
    AirData,
    Attitude,
    Event,
    Gnss,
    LocalOrigin,
    LocalPosition,
    Severity,
    Stamped,
    Wind,
)
from companion.storage.reader import LogError, open_regular

Row: TypeAlias = dict[str, str]

MAX_LINE = 1 << 16  # bytes
MAX_EXPANSION = 60
"""Largest ratio of uncompressed and compressed size; recorded topics reach 10."""


class CsvFolder:
    """The topics of a folder, to be iterated once."""

    def __init__(self, folder: Path) -> None:
        self.damage = Damage()
        found = {path.name.split(".")[0]: path for path in sorted(folder.glob("*.csv*"))}
        self._known = [(found[topic], make) for topic, make in _TOPICS.items() if topic in found]
        if not self._known:
            raise LogError(f"{folder} has no supported topic: it needs {', '.join(_TOPICS)} as CSV")

    def __iter__(self) -> Iterator[Stamped]:
        """Yield the records of all topics by time."""
        topics = (self._records(path, make()) for path, make in self._known)
        return heapq.merge(*topics, key=lambda record: record.t_ns)

    def _records(self, path: Path, topic: Callable[[Row, int], Iterator[Stamped]]) -> Iterator[Stamped]:
        def stamped() -> Iterator[tuple[int, int, Row]]:
            for number, row in self._rows(path):
                try:
                    yield int(row["timestamp"]), number, row
                except (KeyError, TypeError, ValueError) as error:
                    self.damage.add(f"line {number} of {path.name}", 0, one_line(error))

        for step in steady_steps(stamped(), self.damage):
            try:
                yield from topic(step.item, (step.boot_us + step.shift_us) * 1000)
            except (KeyError, TypeError, ValueError, OverflowError) as error:
                place = f"{path.name} at {step.boot_us} us"
                self.damage.add(place, 0, f"not a row of its topic: {one_line(error)}")

    def _rows(self, path: Path) -> Iterator[tuple[int, Row]]:
        """Yield line number and row. The file ends where it cannot be read."""
        try:
            with open_regular(path) as file:
                lines = _lines(file, path, self.damage)
                yield from enumerate(csv.DictReader(lines), start=2)
        except (OSError, EOFError, zlib.error, csv.Error) as error:
            self.damage.add(path.name, 0, f"the rest of the file: {one_line(error)}")


def read(folder: Path) -> CsvFolder:
    """Open the topics in `folder`. Raises LogError if no known topic is found."""
    return CsvFolder(folder)


def _lines(file: BinaryIO, path: Path, damage: Damage) -> Iterator[str]:
    """Yield the lines of a text file, or of a gzip-compressed one that does not expand without bounds."""
    packed = path.suffix == ".gz"
    limit = MAX_EXPANSION * path.stat().st_size + (1 << 20)
    source: BinaryIO = cast(BinaryIO, gzip.GzipFile(fileobj=file)) if packed else file
    total = 0
    while line := source.readline(MAX_LINE + 1):
        total += len(line)
        if packed and total > limit:
            damage.add(path.name, 0, f"it expands to more than {MAX_EXPANSION} times its size")
            return
        if len(line) > MAX_LINE:
            damage.add(path.name, 0, f"a line is longer than {MAX_LINE} bytes")
            return
        # a quote that is not closed would hold the rest of the file; numbers need none
        yield line.decode("utf-8", "replace").replace("\0", "").replace('"', "")


def _number(row: Row, name: str) -> float | None:
    value = float(row[name])
    return value if math.isfinite(value) else None


def _gnss(row: Row, t: int) -> Iterator[Stamped]:
    valid = row["vel_ned_valid"] == "1"
    velocity = float(row["vel_n_m_s"]), float(row["vel_e_m_s"]), float(row["vel_d_m_s"])
    yield Gnss(
        t,
        t,
        receiver=0,
        stamp_us=t // 1000,  # each row is a fix; time_utc_usec of the receiver may change only once a second
        fix=int(row["fix_type"]),
        lat=math.radians(int(row["lat"]) / 1e7),
        lon=math.radians(int(row["lon"]) / 1e7),
        alt_msl=int(row["alt"]) * 1e-3,
        sigma_horizontal=_number(row, "eph"),
        sigma_vertical=_number(row, "epv"),
        v_n=velocity if valid else None,
        sigma_velocity=_number(row, "s_variance_m_s"),
        satellites=int(row["satellites_used"]),
        hdop=_number(row, "hdop"),
        alt=int(row["alt_ellipsoid"]) * 1e-3,
    )


def _attitude(row: Row, t: int) -> Iterator[Stamped]:
    w, x, y, z = (float(row[f"q[{i}]"]) for i in range(4))
    rates = float(row["rollspeed"]), float(row["pitchspeed"]), float(row["yawspeed"])
    yield Attitude(t, t, *euler((w, x, y, z)), rates)


def _air_data(row: Row, t: int) -> Iterator[Stamped]:
    yield AirData(t, t, float(row["true_airspeed_m_s"]), True, sensed=True)


def _wind(row: Row, t: int) -> Iterator[Stamped]:
    variance = 0.5 * (float(row["covariance_north"]) + float(row["covariance_east"]))
    v_n = float(row["windspeed_north"]), float(row["windspeed_east"]), 0.0
    yield Wind(t, t, v_n, math.sqrt(variance) if variance > 0.0 else None)


def _local_positions() -> Callable[[Row, int], Iterator[Stamped]]:
    """Convert the inertial channel, with its origin when stated or changed, and an event at each reset."""
    last: tuple[str, ...] = ()
    resets = ""

    def topic(row: Row, t: int) -> Iterator[Stamped]:
        nonlocal last, resets
        if row["xy_valid"] != "1" or row["z_valid"] != "1":
            return
        origin = row["ref_lat"], row["ref_lon"], row["ref_alt"]
        if origin != last and row["xy_global"] == "1":
            last = origin
            lat, lon, alt_msl = map(float, origin)
            yield LocalOrigin(t, t, math.radians(lat), math.radians(lon), alt_msl, "px4")
        if resets and row["xy_reset_counter"] != resets:
            yield Event(t, t, Severity.WARNING, "the autopilot reset its horizontal position")
        resets = row["xy_reset_counter"]
        x_n = float(row["x"]), float(row["y"]), float(row["z"])
        yield LocalPosition(t, t, x_n, (float(row["vx"]), float(row["vy"]), float(row["vz"])))

    return topic


_TOPICS: dict[str, Callable[[], Callable[[Row, int], Iterator[Stamped]]]] = {
    "vehicle_local_position": _local_positions,
    "vehicle_gps_position": lambda: _gnss,
    "vehicle_attitude": lambda: _attitude,
    "airspeed": lambda: _air_data,
    "wind_estimate": lambda: _wind,
}
