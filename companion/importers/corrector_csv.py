"""Records of correctors from a table: star fixes, lines of position, or positions of a second INS.

The header decides which; times are seconds since the first record of the log they are replayed with.

    t_s, star, lat_deg, lon_deg, altitude_deg, azimuth_deg, sigma_altitude_arcsec, sigma_azimuth_arcsec
    t_s, chain, lat_a_deg, lon_a_deg, alt_a_m, lat_b_deg, lon_b_deg, alt_b_m, difference_m, sigma_m
    t_s, ins, lat_deg, lon_deg

For a star, lat_deg and lon_deg are those of the place where it is in the zenith: its declination, and its
hour angle from Greenwich taken east. azimuth_deg may be empty.
"""

from __future__ import annotations

import csv
import math
from collections.abc import Callable, Mapping
from pathlib import Path

from companion.records import RangeDifference, SecondIns, Stamped, StarFix
from companion.units import SECOND_NS

_DEG, _ARCSEC = math.radians(1.0), math.radians(1.0 / 3600.0)
Row = Mapping[str, float | None]


def _star(t_ns: int, r: Row) -> StarFix:
    azimuth = r["azimuth_deg"]
    return StarFix(
        t_ns,
        t_ns,
        star=int(_given(r, "star")),
        lat=_given(r, "lat_deg") * _DEG,
        lon=_given(r, "lon_deg") * _DEG,
        altitude=_given(r, "altitude_deg") * _DEG,
        azimuth=None if azimuth is None else azimuth * _DEG,
        sigma_altitude=_given(r, "sigma_altitude_arcsec") * _ARCSEC,
        sigma_azimuth=(r["sigma_azimuth_arcsec"] or 3600.0) * _ARCSEC,
    )


def _line(t_ns: int, r: Row) -> RangeDifference:
    a = (_given(r, "lat_a_deg") * _DEG, _given(r, "lon_a_deg") * _DEG, _given(r, "alt_a_m"))
    b = (_given(r, "lat_b_deg") * _DEG, _given(r, "lon_b_deg") * _DEG, _given(r, "alt_b_m"))
    return RangeDifference(
        t_ns, t_ns, int(_given(r, "chain")), *a, *b, _given(r, "difference_m"), _given(r, "sigma_m")
    )


def _second(t_ns: int, r: Row) -> SecondIns:
    place = (_given(r, "lat_deg") * _DEG, _given(r, "lon_deg") * _DEG)
    return SecondIns(t_ns, t_ns, int(_given(r, "ins")), *place)


_STAR = "star lat_deg lon_deg altitude_deg azimuth_deg sigma_altitude_arcsec sigma_azimuth_arcsec"
_LINE = "chain lat_a_deg lon_a_deg alt_a_m lat_b_deg lon_b_deg alt_b_m difference_m sigma_m"
TABLES: dict[tuple[str, ...], Callable[[int, Row], Stamped]] = {
    ("t_s", *_STAR.split()): _star,
    ("t_s", *_LINE.split()): _line,
    ("t_s", "ins", "lat_deg", "lon_deg"): _second,
}


def read_correctors(path: Path, start_ns: int) -> list[Stamped]:
    """Read the records of a table; `start_ns` is the time of t_s = 0.

    Raises ValueError, one sentence with the line, if the file is not such a table.
    """
    try:
        with path.open(newline="", encoding="utf-8") as file:
            rows = list(csv.reader(file))
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        why = getattr(error, "strerror", None) or error
        raise ValueError(f"{path}: cannot be read ({why})") from None
    header = tuple(name.strip() for name in rows[0]) if rows else ()
    build = TABLES.get(header)
    if build is None:
        known = "; ".join(",".join(names) for names in TABLES)
        raise ValueError(f"{path}: the header is {','.join(header)!r}; it must be one of: {known}")
    found = []
    for number, row in enumerate(rows[1:], start=2):
        if not row:
            continue
        try:
            values = {
                name: float(text) if text.strip() else None for name, text in zip(header, row, strict=True)
            }
            record = build(start_ns + round(_given(values, "t_s") * SECOND_NS), values)
        except ValueError as error:
            raise ValueError(f"{path}, line {number}: {error}") from None
        _check(record, f"{path}, line {number}")
        found.append(record)
    return sorted(found, key=lambda record: record.t_ns)


def _given(row: Row, name: str) -> float:
    value = row[name]
    if value is None or not math.isfinite(value):
        raise ValueError(f"{name} is missing or not finite")
    return value


def _check(record: Stamped, where: str) -> None:
    """Reject angles and sigmas that cannot be."""
    for name in ("lat", "lat_a", "lat_b", "altitude"):
        value = getattr(record, name, 0.0)
        if abs(value) > math.pi / 2.0:
            raise ValueError(f"{where}: {name} is {math.degrees(value):g} deg, beyond 90 deg")
    for name in ("sigma", "sigma_altitude", "sigma_azimuth"):
        value = getattr(record, name, 1.0)
        if not value > 0.0:
            raise ValueError(f"{where}: {name} is {value:g}; it must be positive")
