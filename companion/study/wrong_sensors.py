"""`companion study wrong-sensors`: a recorded flight again, attitude, IMU, airspeed or beacons made wrong.

    companion study wrong-sensors flight.bin --rsbn beacons.csv
    companion study wrong-sensors flight.tlog --rsbn beacons.csv --from 300

GNSS is left as it was recorded, so whatever is wrong, the position should stay at it. A beacon that answers
(--rsbn) is what may turn the companion against GNSS: without one, nothing excludes it on the own channel.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import click
import numpy as np
from msgspec.structs import replace

from companion.analysis.beacon_options import beacon_options
from companion.config import Config, load
from companion.config.options import configuration_options
from companion.estimate.bank.settings import DEFAULT as THRESHOLDS
from companion.nav.geometry import Geodetic, separation, wrap_angle
from companion.navigator import Navigator
from companion.option_types import INPUT_PATH, FloatRange
from companion.records import AirData, Attitude, Imu, RsbnFix, Solution, Stamped
from companion.storage.reader import LogError
from companion.study.outages import Fixes, flight_of
from companion.tables import number_table, print_tables
from companion.units import SECOND_NS

SETTLED_S = 5.0  # after the first fix
LATE_NS = 3 * SECOND_NS // 10

Change = Callable[[Any, Any, np.random.Generator], Stamped]
"""A record made wrong; the last one of its kind before, and random numbers."""


class Row(NamedTuple):
    """Greatest distance of the position from GNSS (m), and for how long GNSS was suspect and excluded (s)."""

    wrong: str
    farthest_m: float
    suspect_s: float
    excluded_s: float


def _heading(deg: float) -> Change:
    return lambda r, held, rng: replace(r, heading=wrap_angle(r.heading + math.radians(deg)))


def _force(change: Callable[[np.random.Generator], Sequence[float]]) -> Change:
    return lambda r, held, rng: replace(r, f_b=tuple(f + d for f, d in zip(r.f_b, change(rng), strict=True)))


def _range(metres: float) -> Change:
    return lambda r, held, rng: replace(
        r, slant_range=None if r.slant_range is None else r.slant_range + metres
    )


def _azimuth(deg: float) -> Change:
    turn = math.radians(deg)
    return lambda r, held, rng: replace(
        r, azimuth=None if r.azimuth is None else (r.azimuth + turn) % math.tau
    )


WRONG: dict[str, tuple[type[Stamped], Change]] = {
    "heading off by 20 deg": (Attitude, _heading(20.0)),
    "heading off by 45 deg": (Attitude, _heading(45.0)),
    "heading off by 90 deg": (Attitude, _heading(90.0)),
    "heading off by 180 deg": (Attitude, _heading(180.0)),
    "heading stuck": (Attitude, lambda r, held, rng: replace(r, heading=held.heading)),
    "attitude stuck while the gyros go on": (
        Attitude,
        lambda r, held, rng: replace(r, roll=held.roll, pitch=held.pitch, heading=held.heading),
    ),
    "IMU late by 0.3 s": (
        Imu,
        lambda r, held, rng: replace(r, t_ns=r.t_ns + LATE_NS, rx_ns=r.rx_ns + LATE_NS),
    ),
    "IMU noise of 3 m/s^2": (Imu, _force(lambda rng: (3.0 * rng.standard_normal(3)).tolist())),
    "IMU bias of 1 m/s^2 ahead": (Imu, _force(lambda rng: (1.0, 0.0, 0.0))),
    "IMU mounted with its x axis to the right": (
        Imu,
        lambda r, held, rng: replace(r, f_b=(r.f_b[1], -r.f_b[0], r.f_b[2])),
    ),
    "IMU stuck": (Imu, lambda r, held, rng: replace(r, f_b=held.f_b, w_b=held.w_b)),
    "airspeed stuck at zero": (AirData, lambda r, held, rng: replace(r, airspeed=0.0)),
    "airspeed reads 1.5 times": (AirData, lambda r, held, rng: replace(r, airspeed=1.5 * r.airspeed)),
    "ranges of beacons off by 50 m": (RsbnFix, _range(50.0)),
    "ranges of beacons off by 200 m": (RsbnFix, _range(200.0)),
    "ranges of beacons off by 1000 m": (RsbnFix, _range(1000.0)),
    "azimuths of beacons off by 1 deg": (RsbnFix, _azimuth(1.0)),
    "azimuths of beacons off by 5 deg": (RsbnFix, _azimuth(5.0)),
}


def made_wrong(
    records: Sequence[Stamped], kind: type[Stamped], change: Change, from_ns: int
) -> Iterator[Stamped]:
    """Yield the records, those of `kind` that arrive from `from_ns` on made wrong."""
    rng, held = np.random.default_rng(1), None
    for record in records:
        if type(record) is kind:
            if held is None or record.rx_ns < from_ns:
                held = record
            else:
                record = change(record, held, rng)
        yield record


def fly(wrong: str, records: Sequence[Stamped], fixes: Fixes, config: Config) -> Row:
    """Fly the records through the navigator, and compare each solution with the GNSS of its time.

    Not within a gap of the fixes, nor before the first of them after it has come.
    """
    navigator, farthest, suspect_ns, excluded_ns, last_ns = Navigator(config), 0.0, 0, 0, 0
    for record in sorted(records, key=lambda record: record.rx_ns):
        for out in navigator.handle(record):
            if not isinstance(out, Solution) or out.t_ns < fixes.t_ns[0] + SETTLED_S * SECOND_NS:
                continue
            passed = min(out.t_ns - (last_ns or out.t_ns), SECOND_NS)
            suspect_ns += passed * ((out.gnss_false or 0.0) > THRESHOLDS.suspect)
            excluded_ns += passed * ((out.gnss_false or 0.0) > THRESHOLDS.excluded)
            last_ns = out.t_ns
            if out.t_ns <= fixes.t_ns[-1] and fixes.covers(out.t_ns - LATE_NS):
                north, east, _ = separation(Geodetic(out.lat, out.lon, 0.0), fixes.at(out.t_ns))
                farthest = max(farthest, math.hypot(north, east))
        navigator.settle()
    return Row(wrong, farthest, suspect_ns / SECOND_NS, excluded_ns / SECOND_NS)


def study(records: Sequence[Stamped], config: Config, from_s: float) -> Iterator[Row]:
    """Yield a row for the flight as it was, and one for everything wrong of which it has records."""
    fixes = Fixes(records)
    yield fly("nothing", records, fixes, config)
    from_ns = records[0].rx_ns + round(from_s * SECOND_NS)
    kinds = {type(record) for record in records}
    for wrong, (kind, change) in WRONG.items():
        if kind in kinds:
            yield fly(wrong, list(made_wrong(records, kind, change, from_ns)), fixes, config)


@click.command("wrong-sensors")
@click.argument("log", type=INPUT_PATH)
@beacon_options
@click.option(
    "--from",
    "from_s",
    type=FloatRange(min=0.0),
    default=0.0,
    show_default=True,
    help="Second of the log from which on it is wrong.",
)
@configuration_options
@click.option("--json", "as_json", is_flag=True, help="Print JSON.")
def command(
    log: Path,
    beacons: Path | None,
    seed: int,
    from_s: float,
    file: Path | None,
    preset: str | None,
    pairs: tuple[str, ...],
    as_json: bool,
) -> None:
    """Make one sensor or beacon of a recorded flight wrong.

    LOG is any log that `companion replay` reads. One thing at a time is wrong; GNSS is as recorded. The table
    has the greatest distance of the position from GNSS, and for how long GNSS was suspect and excluded.
    """
    config = load(file, {}, pairs=pairs, preset=preset)
    records, note = flight_of(log, beacons, seed, config)
    if not len(Fixes(records).t_ns):
        raise LogError(f"{log}: no GNSS fix to compare with: choose a flight with GNSS")
    end_s = (records[-1].rx_ns - records[0].rx_ns) / SECOND_NS
    if from_s >= end_s:
        raise click.UsageError(f"--from {from_s:g} has no effect: the log ends at {end_s:.0f} s: give less")
    rows = list(study(records, config, from_s))
    if as_json:
        click.echo(json.dumps([row._asdict() for row in rows]))
        return
    heads = "wrong", "at most, m", "suspect, s", "excluded, s"
    table = number_table(f"Distance from GNSS, wrong from {from_s:g} s on", *heads, caption=note)
    for row in rows:
        times = (f"{s:.0f}" if s else "-" for s in (row.suspect_s, row.excluded_s))
        table.add_row(row.wrong, f"{row.farthest_m:.0f}", *times)
    print_tables(table)
