"""`companion sitl bridge`: a `Bridge` on real links and the system clock, with error file and table.

    companion sitl bridge --connect tcp:127.0.0.1:5760 --companion udpout:127.0.0.1:14550 \\
        --beacon 55.75,38.57 --gnss-off-after 120 --seconds 330
"""

from __future__ import annotations

import csv
import itertools
import json
import math
import os
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, TextIO

import click

from companion.analysis import simulated_rsbn
from companion.option_types import FloatRange
from companion.plausibility import HIGHEST
from companion.storage.reader import LogError
from companion.tables import number_table, print_tables
from companion.transport.address import Address
from companion.write_errors import make_folder
from sitl.beacon import Beacon
from sitl.bridge import AUTOPILOT, COMPANION, RSBN, Bridge, BridgeMode, GnssSchedule
from sitl.comparison import AFTER_S, OutageErrors, PositionError, outage_table
from sitl.real_time import RealTimeRunner, parse_address

ORDER = AUTOPILOT, COMPANION, RSBN
COLUMNS = ("t_s", "source", "north_m", "east_m", "error_m", "sigma_m", "bound_m")
TRUTH_COLUMNS = ("true_lat_deg", "true_lon_deg", "true_alt_m")


class BridgeRunner(RealTimeRunner):
    """One run over two links, or over one without relaying. `store` receives every new error.

    Seconds count from the first message of the autopilot, until then from the start of the run.
    """

    def __init__(
        self,
        bridge: Bridge,
        addresses: Sequence[Address],
        report: Callable[[float, str], None],
        store: Callable[[Sequence[PositionError], int], None],
        seconds: float,
    ) -> None:
        super().__init__(addresses, lambda text: report(1e-9 * self._elapsed_ns(), text))
        self._bridge, self._store, self._seconds = bridge, store, seconds
        self._feed = bridge.from_autopilot, bridge.from_companion
        self._stored = 0

    def _steps(self) -> Iterator[float]:
        while not self._stopped and (left := self._seconds - 1e-9 * self._elapsed_ns()) > 0.0:
            self._bridge.poll(time.monotonic_ns())
            self._flush()
            yield min(1e-9 * (self._bridge.deadline() - time.monotonic_ns()), left)
        self._bridge.finish(time.monotonic_ns())
        self._flush()

    def _receive(self, link: int, data: bytes) -> None:
        self._feed[link](data, time.monotonic_ns())
        self.started_ns = self._bridge.connected_ns or self.started_ns

    def _flush(self) -> None:
        self._send(self._bridge.to_autopilot(), 0)
        self._send(self._bridge.to_companion(), 1)
        for line in self._bridge.take_reports():
            self._report(line)
        scored = self._bridge.comparison.errors
        if len(scored) > self._stored:
            self._store(scored[self._stored :], self.started_ns)
            self._stored = len(scored)


class ErrorFile:
    """CSV file of all errors in `folder`. Raises OSError."""

    def __init__(self, folder: Path) -> None:
        make_folder(folder)
        self.path = folder / f"{datetime.now(UTC):bridge-%Y%m%dT%H%M%SZ}.csv"
        self._file: TextIO = self.path.open("x", newline="", buffering=1)
        self._lines = csv.writer(self._file)
        self._lines.writerow((*COLUMNS, *TRUTH_COLUMNS))

    def store(self, scored: Sequence[PositionError], start_ns: int) -> None:
        """Append errors to the file; times are seconds since `start_ns`."""
        for s in scored:
            metres = (s.north, s.east, s.error, s.sigma, s.bound)
            numbers = ("" if value is None else f"{value:.2f}" for value in metres)
            place = (f"{math.degrees(angle):.7f}" for angle in (s.true.lat, s.true.lon))
            t_s = f"{(s.t_ns - start_ns) * 1e-9:.3f}"
            self._lines.writerow((t_s, s.source, *numbers, *place, f"{s.true.alt:.1f}"))

    def close(self) -> None:
        """Close the file."""
        self._file.close()


def outage_tables(bridge: Bridge, end_ns: int) -> list[tuple[str, list[OutageErrors]]]:
    """Return title and table of each GNSS outage, or of the whole flight if there was none."""
    start_ns = bridge.connected_ns or end_ns

    def rows(from_ns: int, to_ns: int) -> list[OutageErrors]:
        found = outage_table(bridge.comparison.errors, from_ns, to_ns)
        return sorted(found, key=lambda row: ORDER.index(row.source))

    if not bridge.outages:
        return [("GNSS available throughout", rows(start_ns, end_ns))]
    tables = []
    for loss in bridge.outages:
        back_ns = loss.regained_ns or end_ns
        title = f"GNSS lost at {(loss.lost_ns - start_ns) * 1e-9:.0f} s"
        title += f" for {(back_ns - loss.lost_ns) * 1e-9:.0f} s"
        tables.append((title, rows(loss.lost_ns, back_ns)))
    return tables


def _print(tables: list[tuple[str, list[OutageErrors]]]) -> None:
    def metres(value: float | None) -> str:
        return "" if value is None else f"{value:.0f}"

    for title, rows in tables:
        heads = "", *(f"{s} s" for s in AFTER_S), "r.m.s.", "max", "in 3 sigma"
        out = number_table(f"{title}: horizontal error, m", *heads)
        for row in rows:
            within = "" if row.within is None else f"{row.within:.0%}"
            errors = (*row.at.values(), row.rms, row.largest)
            out.add_row(row.source, *map(metres, errors), within)
        print_tables(out)


def _parse_beacons(positions: tuple[str, ...], file: Path | None) -> tuple[Beacon, ...]:
    """Return the beacons of both options. One without a number that fits the message gets a free one."""
    # a VOR or DME alone is not enough
    listed = [b for b in simulated_rsbn.read_beacons(file) if b.azimuth and b.ranging] if file else []
    taken = {beacon.number for beacon in listed}
    free = (number for number in itertools.count(1) if number not in taken)
    beacons = []
    for text in positions:
        try:
            lat, lon, *alt = map(float, text.split(","))
            if len(alt) > 1 or not all(map(math.isfinite, (lat, lon, *alt))):
                raise ValueError
        except ValueError:
            raise click.BadParameter(
                f"invalid beacon {text!r}: write it as LAT,LON or LAT,LON,ALT in degrees and metres",
                param_hint="--beacon",
            ) from None
        if abs(lat) > 90.0 or abs(lon) > 180.0:
            what, limit = (f"latitude {lat:g}", 90) if abs(lat) > 90.0 else (f"longitude {lon:g}", 180)
            raise click.BadParameter(
                f"invalid beacon {text!r}: {what}: give -{limit} to {limit} deg", param_hint="--beacon"
            )
        height = alt[0] if alt else 0.0
        if abs(height) > HIGHEST:
            raise click.BadParameter(
                f"invalid beacon {text!r}: height {height:g}: give -{HIGHEST:.0f} to {HIGHEST:.0f} m",
                param_hint="--beacon",
            )
        beacons.append(Beacon(next(free), lat, lon, height, ground_alt=simulated_rsbn.GROUND))
    for b in listed:
        number = b.number if b.number <= simulated_rsbn.MAX_NUMBER else next(free)
        lat, lon = math.degrees(b.lat), math.degrees(b.lon)
        beacons.append(Beacon(number, lat, lon, b.alt, simulated_rsbn.GROUND, b.range_limit))
    return tuple(beacons)


@click.command("bridge")
@click.option("--connect", default="tcp:127.0.0.1:5760", show_default=True, help="Link to the autopilot.")
@click.option("--companion", help="Link to the companion; without it all share the first link (a router).")
@click.option(
    "--beacon", "positions", multiple=True, metavar="LAT,LON[,ALT]", help="Simulate an RSBN beacon there."
)
@click.option(
    "--beacons", "file", type=click.Path(path_type=Path), help="Simulate the beacons of a CSV file."
)
@click.option(
    "--gnss-off-after",
    type=FloatRange(0.0),
    metavar="S",
    help="Switch the simulated GNSS off after S seconds.",
)
@click.option(
    "--gnss-on-after", type=FloatRange(0.0), metavar="S", help="Switch it on again after S seconds."
)
@click.option("--seconds", type=FloatRange(1.0), default=math.inf, help="Duration of the run.")
@click.option("--unaided", is_flag=True, help="Do not relay the companion's positions to the autopilot.")
@click.option("--beacons-only", is_flag=True, help="Send the companion only the beacons' answers.")
@click.option(
    "--seed", type=click.IntRange(min=0), default=1, show_default=True, help="Seed of the beacons' noise."
)
@click.option("--log", "folder", type=click.Path(path_type=Path), help="Folder for the errors, as CSV.")
@click.option("--json", "as_json", is_flag=True, help="Print JSON.")
def command(
    connect: str,
    companion: str | None,
    positions: tuple[str, ...],
    file: Path | None,
    gnss_off_after: float | None,
    gnss_on_after: float | None,
    seconds: float,
    unaided: bool,
    beacons_only: bool,
    seed: int,
    folder: Path | None,
    as_json: bool,
) -> None:
    """Connect to a running ArduPilot or PX4 SITL.

    Relays between autopilot and companion, and gives truth, beacons and GNSS loss. Seconds count from the
    first message of the autopilot. Ends at SIGINT or SIGTERM with a table of position errors; GNSS is
    switched on again. Exit codes: 1 the beacons cannot be read, 69 cannot listen on an address or no
    autopilot found, 73 the folder cannot be written.
    """
    autopilot = parse_address(connect)
    other = parse_address(companion, "--companion") if companion else None
    if gnss_on_after is not None and (gnss_off_after is None or gnss_on_after <= gnss_off_after):
        raise click.BadParameter("give --gnss-off-after, and a later time here", param_hint="--gnss-on-after")
    for option, after_s in (("--gnss-off-after", gnss_off_after), ("--gnss-on-after", gnss_on_after)):
        if after_s is not None and after_s >= seconds:
            raise click.UsageError(
                f"{option} {after_s:g} has no effect: the run ends after --seconds {seconds:g}: give a"
                " smaller number, or a longer run"
            )
    if other is None and (beacons_only or unaided):
        raise click.UsageError("--beacons-only and --unaided need a link to the companion: give --companion")
    mode = BridgeMode.SAME if other is None else BridgeMode.BESIDE if beacons_only else BridgeMode.RELAY
    try:
        beacons = _parse_beacons(positions, file)
    except LogError as error:
        click.echo(f"companion: {error}", err=True)
        sys.exit(1)
    bridge = Bridge(beacons, GnssSchedule(gnss_off_after, gnss_on_after), mode, unaided, seed)
    try:
        record = ErrorFile(folder) if folder else None
    except OSError as error:
        click.echo(f"companion: {folder} cannot be written: {error.strerror}", err=True)
        sys.exit(os.EX_CANTCREAT)
    runner = BridgeRunner(
        bridge,
        (autopilot, other) if other else (autopilot,),
        lambda t, text: click.echo(f"{t:8.1f} s  {text}", err=True),
        record.store if record else lambda scored, start_ns: None,
        seconds,
    )
    try:
        runner.run_command()
    finally:
        if record is not None:
            record.close()
    end_ns = time.monotonic_ns()
    if bridge.connected_ns is None:
        seconds = (end_ns - runner.started_ns) * 1e-9
        click.echo(f"companion: no autopilot on {connect} in {seconds:.0f} s", err=True)
        sys.exit(os.EX_UNAVAILABLE)
    tables = outage_tables(bridge, end_ns)
    if as_json:
        click.echo(json.dumps(_json(tables, record)))
        return
    _print(tables)
    if record is not None:
        click.echo(f"errors: {record.path}")


def _json(tables: list[tuple[str, list[OutageErrors]]], record: ErrorFile | None) -> dict[str, Any]:
    losses = [{"title": title, "rows": [row._asdict() for row in rows]} for title, rows in tables]
    return {"tables": losses, "errors": str(record.path) if record else None}
