"""`companion study outages`: what a recorded flight would have been worth without GNSS, from every minute on.

    companion study outages flight.ulg
    companion study outages flights/*.bin --rsbn beacons.csv --lasting 60 --lasting 300

GNSS is taken from the navigator, for as long as is asked; then the flight goes on with GNSS up to the next
minute. The error is the distance from GNSS itself. Beside it stand two rules that need no filter: the
airspeed along the heading plus the mean wind of the last minute, and straight on with the last velocity.
Where no airspeed was measured the first rule takes the airspeed and the wind that fit the last two minutes.
"""

from __future__ import annotations

import copy
import json
import math
import sys
from bisect import bisect_right
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import click
import numpy as np
from rich.table import Table

from companion.analysis.beacon_options import beacon_options
from companion.analysis.error_statistics import root_mean_square
from companion.analysis.replay_inputs import input_errors_as_log_errors, with_beacons_and_outages
from companion.config import Config, load
from companion.config.options import configuration_options
from companion.nav.geometry import Geodetic, separation
from companion.navigator import INPUTS_USED, Navigator
from companion.navigator.own_channel import SENSOR_NS, Sensors, airspeed_is_sensed, with_airspeed_sensor
from companion.option_types import INPUT_PATH, FloatRange
from companion.printable import printable
from companion.records import AirData, AirspeedSensor, Attitude, Gnss, Reboot, Solution, Stamped, Vehicle
from companion.storage.reader import LogError
from companion.tables import number_table, print_tables
from companion.units import SECOND_NS, Floats

LASTING_S = (10.0, 30.0, 60.0, 120.0)
FLYING_M_S = 8.0
LEARNING_S = 90.0  # in flight with GNSS, before the first outage
WIND_S = 60.0
FIT_S, FIT_WEIGHT = 120.0, 0.3  # of a flight without airspeed; and of "no wind" beside its fixes
GAP_S = 3.0  # the recorded GNSS was lost itself: there is nothing to compare with
STEP_S = 0.1  # of the rules


class Row(NamedTuple):
    """Errors after outages of one duration: r.m.s. and greatest (m), and the share within 2 sigma an axis."""

    log: str
    lasting_s: float
    outages: int
    rms_m: float | None
    worst_m: float | None
    within: float | None
    by_wind_m: float | None  # the first rule; None: no attitude
    straight_on_m: float


def flight_of(log: Path, beacons: Path | None, seed: int, config: Config) -> tuple[list[Stamped], str]:
    """Return the inputs of a log with simulated beacons, and a note on these. Raises LogError."""
    with input_errors_as_log_errors():
        inputs, note = with_beacons_and_outages(log, beacons, (), seed, config)
        used = [r for r in inputs.records if isinstance(r, INPUTS_USED) and not isinstance(r, Reboot)]
    return used, note


class Fixes:
    """The GNSS fixes of a flight: times (ns), positions (rad) and velocities (m/s) of those with one.

    A multirotor flies while the log states so (`is_multirotor`), others while they are fast.
    """

    def __init__(self, records: Sequence[Stamped]) -> None:
        vehicles = [r for r in records if isinstance(r, Vehicle)]
        stated = {r.t_ns: r.flying for r in vehicles if r.flying is not None}
        self.is_multirotor = any(r.multirotor for r in vehicles) and any(stated.values())
        self._stated = sorted(stated.items()) if self.is_multirotor else []
        fixes = {r.t_ns: r for r in records if isinstance(r, Gnss) and r.has_3d_fix}
        found = [fixes[t_ns] for t_ns in sorted(fixes)]
        self.t_ns = np.array([r.t_ns for r in found])
        self.lat, self.lon = np.array([r.lat for r in found]), np.unwrap([r.lon for r in found])
        moving = [(r.t_ns, r.v_n[0], r.v_n[1]) for r in found if r.v_n is not None]
        columns: Floats = np.array(moving, dtype=np.float64).reshape(-1, 3).T
        self.v_t_ns, self.v_n, self.v_e = columns

    def covers(self, t_ns: float, gap_s: float = GAP_S) -> bool:
        """Whether the fixes before and after are at most `gap_s` apart."""
        k = bisect_right(self.t_ns, t_ns)
        return 0 < k < len(self.t_ns) and bool(self.t_ns[k] - self.t_ns[k - 1] <= gap_s * SECOND_NS)

    def at(self, t_ns: float) -> Geodetic:
        """The position, interpolated."""
        return Geodetic(
            float(np.interp(t_ns, self.t_ns, self.lat)), float(np.interp(t_ns, self.t_ns, self.lon)), 0.0
        )

    def starts(self, every_s: float, longest_s: float) -> list[float]:
        """When outages may begin, ns: in flight, after a time to learn, with GNSS all the while."""
        fast = np.hypot(self.v_n, self.v_e) > FLYING_M_S
        flying = self.v_t_ns[[self.is_aloft(t) for t in self.v_t_ns] if self._stated else fast]
        if not len(flying):
            return []
        first, last = flying[0] + LEARNING_S * SECOND_NS, flying[-1] - longest_s * SECOND_NS
        gap = np.diff(self.t_ns) > GAP_S * SECOND_NS
        begin, end = self.t_ns[:-1][gap], self.t_ns[1:][gap]
        return [
            float(t)
            for t in np.arange(first, last, every_s * SECOND_NS)
            if not ((end > t - WIND_S * SECOND_NS) & (begin < t + longest_s * SECOND_NS)).any()
            and self.is_aloft(t)
            and self.is_aloft(t + longest_s * SECOND_NS)
        ]

    def is_aloft(self, t_ns: float) -> bool:
        """Whether it flies by the log; True where that states nothing."""
        k = bisect_right(self._stated, t_ns, key=lambda stated: stated[0])
        return not self._stated or (k > 0 and self._stated[k - 1][1])


def companion_errors(
    records: Sequence[Stamped],
    fixes: Fixes,
    config: Config,
    starts: Sequence[float],
    lasting: Sequence[float],
) -> Iterator[dict[float, tuple[float, float, float, float]]]:
    """Fly every outage; yield by duration the error of the solution (north, east, m) and its sigmas."""
    navigator, i = Navigator(config), 0
    for start in starts:
        while i < len(records) and records[i].rx_ns <= start:
            navigator.handle(records[i])
            i += 1
        alone, found = copy.deepcopy(navigator), dict[float, tuple[float, float, float, float]]()
        end = start + (max(lasting) + 1.0) * SECOND_NS
        for record in records[i:]:
            if record.rx_ns > end:
                break
            if isinstance(record, Gnss):
                continue
            for out in alone.handle(record):
                if not isinstance(out, Solution):
                    continue
                for seconds in lasting:
                    if seconds not in found and out.t_ns >= start + seconds * SECOND_NS:
                        north, east, _ = separation(Geodetic(out.lat, out.lon, 0.0), fixes.at(out.t_ns))
                        var_n, _, _, var_e, *_ = out.covariance
                        found[seconds] = (north, east, math.sqrt(var_n), math.sqrt(var_e))
        yield found


class Air:
    """The velocity through the air of a flight, north and east (m/s), by airspeed and attitude."""

    def __init__(self, records: Sequence[Stamped]) -> None:
        attitude = sorted({r.t_ns: (r.heading, r.pitch) for r in records if isinstance(r, Attitude)}.items())
        air = sorted(_sensed_airspeeds(records).items())
        self.known = len(attitude) > 1
        if self.known:
            self._t_attitude = np.array([t for t, _ in attitude])
            heading, self._pitch = np.array([each for _, each in attitude]).T
            self._heading = np.unwrap(heading)
        columns: Floats = np.array(air, dtype=np.float64).reshape(-1, 2).T
        self._t, self._speed = columns

    def is_sensed(self, t_ns: float) -> bool:
        """Whether an airspeed has been measured lately."""
        k = bisect_right(self._t, t_ns)
        return k > 0 and bool(t_ns - self._t[k - 1] <= SENSOR_NS)

    def nose(self, t_ns: Floats) -> Floats:
        """Return unit vectors, levelled, (n, 2)."""
        heading, pitch = (np.interp(t_ns, self._t_attitude, x) for x in (self._heading, self._pitch))
        level: Floats = np.stack([np.cos(heading), np.sin(heading)], axis=1) * np.cos(pitch)[:, None]
        return level

    def at(self, t_ns: Floats) -> Floats:
        """Return (n, 2)."""
        through: Floats = self.nose(t_ns) * np.interp(t_ns, self._t, self._speed)[:, None]
        return through


def _sensed_airspeeds(records: Iterable[Stamped]) -> dict[int, float]:
    """Return the airspeeds (m/s) that are a sensor's, by time (ns)."""
    sensors, found = Sensors(), dict[int, float]()
    for record in records:
        if isinstance(record, AirspeedSensor):
            sensors = with_airspeed_sensor(sensors, record)
        elif isinstance(record, AirData) and airspeed_is_sensed(sensors, record):
            found[record.t_ns] = record.airspeed
    return found


def by_air(air: Air, fixes: Fixes, start: float, seconds: float) -> Floats:
    """Displacement (north, east, m) by the first rule."""
    is_sensed = air.is_sensed(start)
    last = (fixes.v_t_ns > start - (WIND_S if is_sensed else FIT_S) * SECOND_NS) & (fixes.v_t_ns <= start)
    over_ground = np.stack([fixes.v_n[last], fixes.v_e[last]], axis=1)
    t = start + np.arange(0.0, seconds, STEP_S) * SECOND_NS
    if is_sensed:
        wind, through = (over_ground - air.at(fixes.v_t_ns[last])).mean(axis=0), air.at(t)
    else:
        airspeed, wind = _fitted(over_ground, air.nose(fixes.v_t_ns[last]))
        through = airspeed * air.nose(t)
    moved: Floats = ((through + wind) * STEP_S).sum(axis=0)
    return moved


def _fitted(over_ground: Floats, nose: Floats) -> tuple[float, Floats]:
    """Return the airspeed and the wind (2,) that fit velocities over ground best, by least squares (m/s)."""
    axes = np.tile(np.eye(2), (len(nose), 1))
    rows = np.column_stack([nose.ravel(), axes])
    no_wind = FIT_WEIGHT * np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])
    found = np.linalg.lstsq(np.vstack([rows, no_wind]), np.append(over_ground.ravel(), (0.0, 0.0)))[0]
    return float(found[0]), found[1:]


def straight_on(fixes: Fixes, start: float, seconds: float) -> Floats:
    """Displacement (north, east, m) with the last velocity."""
    k = int(np.searchsorted(fixes.v_t_ns, start, side="right")) - 1
    return np.array([fixes.v_n[k], fixes.v_e[k]]) * seconds


def study(
    log: str, records: Sequence[Stamped], config: Config, every_s: float, lasting: Sequence[float]
) -> list[Row]:
    """Return a row for every duration of which an outage fits into the flight."""
    fixes, air = Fixes(records), Air(records)
    lasting = [seconds for seconds in lasting if fixes.starts(every_s, seconds)]
    if not lasting:
        return []
    starts = fixes.starts(every_s, max(lasting))
    flown = list(companion_errors(records, fixes, config, starts, lasting))
    rows = []
    for seconds in lasting:
        rules: dict[str, list[float]] = {"wind": [], "straight": []}
        for start in starts:
            moved = separation(fixes.at(start + seconds * SECOND_NS), fixes.at(start))[:2]
            rules["straight"].append(math.dist(straight_on(fixes, start, seconds), moved))
            if air.known:
                rules["wind"].append(math.dist(by_air(air, fixes, start, seconds), moved))
        errors = np.array([found[seconds] for found in flown if seconds in found]).reshape(-1, 4)
        rows.append(_row(log, seconds, len(starts), errors, rules["wind"], rules["straight"]))
    return rows


def _row(
    log: str, seconds: float, outages: int, errors: Floats, by_wind_m: list[float], straight_on_m: list[float]
) -> Row:
    rms_m = worst_m = within = None
    if len(errors):
        distance = np.hypot(errors[:, 0], errors[:, 1])
        rms_m, worst_m = root_mean_square(distance), float(distance.max())
        within = float((np.abs(errors[:, :2]) <= 2.0 * errors[:, 2:]).mean())
    wind = root_mean_square(np.array(by_wind_m)) if by_wind_m else None
    return Row(log, seconds, outages, rms_m, worst_m, within, wind, root_mean_square(np.array(straight_on_m)))


@click.command("outages")
@click.argument("logs", type=INPUT_PATH, nargs=-1, required=True, metavar="LOG...")
@click.option(
    "--lasting",
    type=FloatRange(1.0, 3600.0),
    multiple=True,
    help="Duration of an outage [s]; may be repeated.",
)
@click.option(
    "--every",
    "every_s",
    type=FloatRange(1.0, 3600.0),
    default=60.0,
    show_default=True,
    help="Seconds between the starts of outages.",
)
@beacon_options
@configuration_options
@click.option("--json", "as_json", is_flag=True, help="Print JSON.")
def command(
    logs: tuple[Path, ...],
    lasting: tuple[float, ...],
    every_s: float,
    beacons: Path | None,
    seed: int,
    file: Path | None,
    preset: str | None,
    pairs: tuple[str, ...],
    as_json: bool,
) -> None:
    """Take GNSS from recorded flights, again and again.

    LOG is any log that `companion replay` reads. From every minute of the flight on GNSS is withheld for 10,
    30, 60 and 120 s (--lasting), and the solution is compared with GNSS. Beside it: airspeed and heading plus
    the mean wind of the last minute (without an airspeed sensor: the airspeed and wind that fit the last two
    minutes best), and straight on. Exit code 1 if a log is refused; the others are studied.
    """
    config = load(file, {}, pairs=pairs, preset=preset)
    durations = tuple(sorted(set(lasting))) or LASTING_S
    rows, notes, refused = list[Row](), list[str](), list[LogError]()
    for log in logs:
        try:
            found, note = _flown_without(log, beacons, seed, config, every_s, durations)
        except LogError as error:
            refused.append(error)
            continue
        rows += found
        notes.append(note)
    if not rows:
        raise refused[0]
    if as_json:
        click.echo(json.dumps([row._asdict() for row in rows]))
    else:
        print_tables(_table(rows, notes))
    for reason in refused:
        click.echo(f"companion: {reason}", err=True)
    if refused:
        sys.exit(1)


def _table(rows: Sequence[Row], notes: Iterable[str]) -> Table:
    heads = "log", "s", "outages", "companion", "worst", "within 2 sigma", "by airspeed and wind"
    title = "Error after an outage of GNSS, m r.m.s."
    table = number_table(title, *heads, "straight on", caption="\n".join(filter(None, dict.fromkeys(notes))))
    for row in rows:
        table.add_row(
            printable(row.log),
            f"{row.lasting_s:g}",
            f"{row.outages}",
            *("-" if x is None else f"{x:.0f}" for x in (row.rms_m, row.worst_m)),
            "-" if row.within is None else f"{100.0 * row.within:.0f} %",
            "-" if row.by_wind_m is None else f"{row.by_wind_m:.0f}",
            f"{row.straight_on_m:.0f}",
        )
    return table


def _flown_without(
    log: Path, beacons: Path | None, seed: int, config: Config, every_s: float, lasting: Sequence[float]
) -> tuple[list[Row], str]:
    """The rows of one log, and a note on its beacons. Raises LogError."""
    records, note = flight_of(log, beacons, seed, config)
    records.sort(key=lambda record: record.rx_ns)
    rows = study(log.name, records, config, every_s, lasting)
    if not rows:
        raise LogError(
            f"{log}: no {LEARNING_S + min(lasting):.0f} s of flight with GNSS (stated by the log, or "
            f"faster than {FLYING_M_S:g} m/s): choose a longer flight, or a shorter --lasting"
        )
    missing = [f"{seconds:g}" for seconds in lasting if seconds not in {row.lasting_s for row in rows}]
    if missing:
        short = f"{printable(log.name)} is too short for {', '.join(missing)} s"
        note = "\n".join(filter(None, (note, short)))
    return rows, note
