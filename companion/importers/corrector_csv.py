"""Records of correctors from a table: star fixes, lines of position, or positions of a second INS.

The header decides which; times are seconds since the first record of the log they are replayed with.

    t_s, star, lat_deg, lon_deg, altitude_deg, azimuth_deg, sigma_altitude_arcsec, sigma_azimuth_arcsec
    t_s, chain, lat_a_deg, lon_a_deg, alt_a_m, lat_b_deg, lon_b_deg, alt_b_m, difference_m, sigma_m
    t_s, ins, lat_deg, lon_deg

For a star, lat_deg and lon_deg are those of the place where it is in the zenith: its declination, and its
hour angle from Greenwich taken east. azimuth_deg may be empty; an empty sigma_azimuth_arcsec is 3600.
"""

from __future__ import annotations

import csv
import math
from collections.abc import Callable, Mapping
from pathlib import Path

from companion.plausibility import DEFAULT, implausible_field
from companion.records import RangeDifference, SecondIns, Stamped, StarFix
from companion.units import SECOND_NS

_DEG, _ARCSEC = math.radians(1.0), math.radians(1.0 / 3600.0)
MOST_IDENTITY = 65535  # of a star, a chain or an INS, as in their messages
Row = Mapping[str, float | None]


def _star(t_ns: int, r: Row) -> StarFix:
    azimuth, sigma_azimuth = r["azimuth_deg"], r["sigma_azimuth_arcsec"]
    return StarFix(
        t_ns,
        t_ns,
        star=_identity(r, "star"),
        lat=_given(r, "lat_deg") * _DEG,
        lon=_given(r, "lon_deg") * _DEG,
        altitude=_given(r, "altitude_deg") * _DEG,
        azimuth=None if azimuth is None else azimuth * _DEG,
        sigma_altitude=_given(r, "sigma_altitude_arcsec") * _ARCSEC,
        sigma_azimuth=(3600.0 if sigma_azimuth is None else sigma_azimuth) * _ARCSEC,
    )


def _line(t_ns: int, r: Row) -> RangeDifference:
    a = (_given(r, "lat_a_deg") * _DEG, _given(r, "lon_a_deg") * _DEG, _given(r, "alt_a_m"))
    b = (_given(r, "lat_b_deg") * _DEG, _given(r, "lon_b_deg") * _DEG, _given(r, "alt_b_m"))
    return RangeDifference(
        t_ns, t_ns, _identity(r, "chain"), *a, *b, _given(r, "difference_m"), _given(r, "sigma_m")
    )


def _second(t_ns: int, r: Row) -> SecondIns:
    place = (_given(r, "lat_deg") * _DEG, _given(r, "lon_deg") * _DEG)
    return SecondIns(t_ns, t_ns, _identity(r, "ins"), *place)


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
        with path.open(newline="", encoding="utf-8-sig") as file:
            rows = list(csv.reader(file))
    except UnicodeDecodeError:
        raise ValueError(f"{path}: not a text file in UTF-8; a table of correctors is a CSV file") from None
    except (OSError, csv.Error) as error:
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
            values = _values(header, row)
            t_s = _given(values, "t_s")
            if abs(t_s) > DEFAULT:
                raise ValueError(f"t_s is {t_s:g}, beyond {DEFAULT:g} s from the start of the log")
            record = build(start_ns + round(t_s * SECOND_NS), values)
            _check(record)
        except ValueError as error:
            raise ValueError(f"{path}, line {number}: {error}") from None
        found.append(record)
    return sorted(found, key=lambda record: record.t_ns)


def _values(header: tuple[str, ...], row: list[str]) -> Row:
    if len(row) != len(header):
        raise ValueError(f"it has {len(row)} columns, and the header {len(header)}")
    values = dict[str, float | None]()
    for name, text in zip(header, row, strict=True):
        try:
            values[name] = float(text) if text.strip() else None
        except ValueError:
            raise ValueError(f"{name} is {text[:40]!r}; it must be a number") from None
    return values


def _identity(row: Row, name: str) -> int:
    value = _given(row, name)
    if value not in range(MOST_IDENTITY + 1):
        raise ValueError(f"{name} is {value:g}; it must be an integer from 0 to {MOST_IDENTITY}")
    return int(value)


def _given(row: Row, name: str) -> float:
    value = row[name]
    if value is None or not math.isfinite(value):
        raise ValueError(f"{name} is missing or not finite")
    return value


def _check(record: Stamped) -> None:
    """Reject numbers that cannot be."""
    for limit, names in ((90, ("lat", "lat_a", "lat_b", "altitude")), (180, ("lon", "lon_a", "lon_b"))):
        for name in names:
            value = math.degrees(getattr(record, name, 0.0))
            if abs(value) > limit:
                raise ValueError(f"{name} is {value:g} deg, beyond {limit} deg")
    for name in ("sigma", "sigma_altitude", "sigma_azimuth"):
        value = getattr(record, name, 1.0)
        if not value > 0.0:
            raise ValueError(f"{name} is {value:g}; it must be positive")
    if (fault := implausible_field(record)) is not None:
        raise ValueError(fault.reason)
