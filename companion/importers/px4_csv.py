"""PX4 topics as CSV files in a folder (`vehicle_gps_position.csv.gz`, ..., as named by ulog2csv) -> records.

Each file is one uORB topic, `timestamp` in microseconds since boot. The rows of all topics are merged by
time; arrival and validity are the same instant, as the log is written on board. Raw inertial data is not
read. Fields that a topic lacks remain None.
"""

from __future__ import annotations

import csv
import gzip
import heapq
import math
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TypeAlias

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

Row: TypeAlias = dict[str, str]


def read(folder: Path) -> Iterator[Stamped]:
    """Return the records of the topics in `folder` by time. Raises ValueError if no known topic is found."""
    found = {path.name.split(".")[0]: path for path in sorted(folder.glob("*.csv*"))}
    known = [(found[topic], make) for topic, make in _TOPICS.items() if topic in found]
    if not known:
        raise ValueError(f"{folder} has no supported topic: it needs {', '.join(_TOPICS)} as CSV")
    return heapq.merge(*(_records(path, make()) for path, make in known), key=lambda record: record.t_ns)


def _records(path: Path, topic: Callable[[Row, int], Iterator[Stamped]]) -> Iterator[Stamped]:
    with gzip.open(path, "rt", newline="") if path.suffix == ".gz" else path.open(newline="") as file:
        for number, row in enumerate(csv.DictReader(file), start=2):
            try:
                yield from topic(row, int(row["timestamp"]) * 1000)
            except (KeyError, TypeError, ValueError) as error:
                raise ValueError(f"{path.name}, line {number}: not a row of its topic: {error}") from None


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
