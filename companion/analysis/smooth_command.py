"""`companion smooth`: the track of a flight from all of its fixes, with covariance, as a table or map.

    companion smooth flight.mcap -o track.csv -o track.kml --check

The log is smoothed by `analysis.smoothing`. `--check` solves the same problem a second time as the two-point
boundary problem of Brandin (6.4.12) and reports the greatest distance of the two tracks.
"""

from __future__ import annotations

import csv
import math
from collections.abc import Iterator, Sequence
from io import StringIO
from pathlib import Path
from typing import NamedTuple

import click
import numpy as np

from companion.analysis.export import Track, write_file, write_map
from companion.analysis.output_guard import (
    reject_any_log,
    reject_other_flight,
    reject_own_input,
    reject_same_output,
)
from companion.analysis.progress import show_step
from companion.analysis.replay import create_replay_log, derived_metadata, start_times
from companion.analysis.replay_inputs import (
    choose_configuration,
    default_output,
    input_errors_as_log_errors,
    open_inputs,
)
from companion.analysis.smoothing import SmoothedRun, smooth_flight
from companion.config import ConfigError
from companion.importers import sources
from companion.nav.geometry import Geodetic, displace
from companion.option_types import INPUT_PATH
from companion.records import Smoothed
from companion.storage.reader import LogError
from companion.units import SECOND_NS, Floats

FORMATS = (".mcap", ".csv", ".kml", ".geojson", ".json")
AGREE_SIGMA = 1e-3
COLUMNS = (
    *("t_s", "log_time_s", "lat_deg", "lon_deg", "alt_msl_m"),
    *("sigma_north_m", "sigma_east_m", "cov_north_east_m2", "filter_sigma_north_m", "filter_sigma_east_m"),
)
ELLIPSE_EVERY_S = 60
ELLIPSE_95 = math.sqrt(-2.0 * math.log(0.05))  # of a normal distribution in the plane, in sigmas


class SmoothedTrack(NamedTuple):
    """All runs of a flight: `records`, and the same numbers of the filter, sigma north and east (n, 2) m."""

    records: list[Smoothed]
    filter_sigma: Floats


def collect(runs: Sequence[SmoothedRun]) -> SmoothedTrack:
    """Return the records of all runs, one for each epoch."""
    records = []
    for run in runs:
        columns = (run.t_ns, run.lat, run.lon, run.alt_msl, run.P[:, :2, :2], run.x[:, :2])
        for t_ns, lat, lon, alt, ((nn, ne), (_, ee)), (north, east) in zip(
            *(column.tolist() for column in columns), strict=True
        ):
            records.append(Smoothed(t_ns, t_ns, lat, lon, alt, (nn, ne, ee), (north, east)))
    variances = [np.einsum("ijj->ij", run.P_filter[:, :2, :2]) for run in runs]
    return SmoothedTrack(records, np.sqrt(np.concatenate(variances)))


def write_csv(path: Path, track: SmoothedTrack, first_ns: int, start_ns: int, start_unix_ns: int) -> None:
    """Write the track as a table.

    `t_s` counts from the first record of the log, at `first_ns`, as the times of a report and of correctors
    do; `log_time_s` is UNIX time if the log has it, else its recorder's clock.
    """
    file = StringIO(newline="")
    out = csv.writer(file)
    out.writerow(COLUMNS)
    for record, filtered in zip(track.records, track.filter_sigma.tolist(), strict=True):
        log_ns = record.t_ns - start_ns + start_unix_ns
        out.writerow(_row(record, filtered, record.t_ns - first_ns, log_ns))
    write_file(path, file.getvalue().encode())


def _row(record: Smoothed, filtered: list[float], since_ns: int, log_ns: int) -> list[str]:
    nn, ne, ee = record.covariance
    place = (f"{math.degrees(record.lat):.9f}", f"{math.degrees(record.lon):.9f}", f"{record.alt_msl:.2f}")
    numbers = (math.sqrt(nn), math.sqrt(ee), ne, *filtered)
    return [
        f"{since_ns * 1e-9:.3f}",
        f"{log_ns * 1e-9:.3f}",
        *place,
        *(f"{number:.6g}" for number in numbers),
    ]


def map_tracks(track: SmoothedTrack, start_ns: int, start_unix_ns: int) -> Iterator[Track]:
    """Yield the track, one point a second, and the 95 % ellipse of each minute."""
    t = np.array([record.t_ns for record in track.records], dtype=np.int64)
    unix = t - start_ns + start_unix_ns
    lat, lon, alt = (np.array([getattr(r, key) for r in track.records]) for key in ("lat", "lon", "alt_msl"))
    C = np.array([record.covariance for record in track.records])
    thin = np.unique(t // SECOND_NS, return_index=True)[1]
    about = {
        "covariance": "m^2: north north, north east, east east",
        "covariances": np.round(C[thin], 4).tolist(),
    }
    yield Track("smoothed track", unix[thin], lat[thin], lon[thin], alt[thin], "#8250df", about)
    for k in np.unique(t // (ELLIPSE_EVERY_S * SECOND_NS), return_index=True)[1].tolist():
        yield _ellipse(int(unix[k]), Geodetic(lat[k], lon[k], alt[k]), C[k])


def _ellipse(unix_ns: int, centre: Geodetic, covariance: Floats) -> Track:
    nn, ne, ee = covariance.tolist()
    root = np.linalg.cholesky([[nn, ne], [ne, ee]])
    angle = np.linspace(0.0, math.tau, 37)
    north, east = ELLIPSE_95 * root @ [np.cos(angle), np.sin(angle)]
    points = [displace(*centre, n, e, 0.0) for n, e in zip(north.tolist(), east.tolist(), strict=True)]
    lat, lon, alt = np.array(points).T
    times = np.full(len(lat), unix_ns)
    return Track("95 % ellipse", times, lat, lon, alt, "#bf8700")


@click.command("smooth")
@click.argument("log", type=INPUT_PATH)
@click.option(
    "-o",
    "--output",
    "outputs",
    multiple=True,
    type=click.Path(path_type=Path),
    help=f"File to write, may be repeated: {', '.join(FORMATS)}. Default: NAME.smoothed.mcap.",
)
@click.option("--config", "config_file", type=INPUT_PATH, help="Use this configuration.")
@click.option(
    "--with", "changes", multiple=True, metavar="KEY=VALUE,...", help="Change these configuration keys."
)
@click.option("--check", is_flag=True, help="Solve again as a two-point boundary problem and compare.")
def command(
    log: Path, outputs: tuple[Path, ...], config_file: Path | None, changes: tuple[str, ...], check: bool
) -> None:
    """Estimate the track of LOG from all of its fixes.

    Those after each moment are used too.
    LOG may be our own MCAP or that of another recorder, as for `replay`.
    """
    paths = outputs or (default_output(log, "smoothed"),)
    for path in paths:
        if path.suffix.lower() not in FORMATS:
            raise click.UsageError(f"{path}: give a name that ends with one of {', '.join(FORMATS)}")
        reject_own_input(path, log, config_file)
        if path.suffix.lower() == ".mcap":
            reject_other_flight(path)
        else:
            reject_any_log(path)
    reject_same_output(paths)
    config = choose_configuration(log, config_file, changes)
    with input_errors_as_log_errors(), show_step(f"smooth {log}"):
        try:
            first, records = sources.read_ahead(open_inputs(log, config).records)
            runs = smooth_flight(records, config, check=check)
        except ConfigError:
            raise
        except ValueError as error:
            raise LogError(f"{log}: {error}") from None
    assert first is not None  # without a record there is nothing to smooth
    track = collect(runs)
    start_ns, start_unix_ns = start_times(log)
    for path in paths:
        if path.suffix.lower() == ".mcap":
            described = derived_metadata(config, "smooth", log)
            with create_replay_log(path, log, described) as sink:
                for record in track.records:
                    sink.record(record)
        elif path.suffix.lower() == ".csv":
            write_csv(path, track, first.rx_ns, start_ns, start_unix_ns)
        else:
            write_map(path, f"{log.name}, smoothed", list(map_tracks(track, start_ns, start_unix_ns)))
        click.echo(f"{path}: {len(track.records)} points")
    sigma = np.sqrt(np.mean([r.covariance[0] + r.covariance[2] for r in track.records]))
    filtered = np.sqrt(np.mean(np.sum(track.filter_sigma**2, axis=1)))
    click.echo(f"claimed horizontal error, r.m.s.: {sigma:.2f} m smoothed, {filtered:.2f} m filtered")
    if (gusts := runs[0].gusts) is not None:
        click.echo(f"gusts of the flight: {gusts.sigma:.2f} m/s, {gusts.correlation_s:.1f} s")
    if check:
        apart = max(run.apart_sigma for run in runs)
        click.echo(f"two-point boundary problem: {apart:.2g} sigma away at most (limit {AGREE_SIGMA:g})")
        if not apart <= AGREE_SIGMA:
            raise SystemExit(1)
