"""`companion study smoothing`: how much nearer to the truth a flight is once it is smoothed, by scenario.

    companion study smoothing --seeds 4

Every scenario's records go through the navigator and `companion.analysis.smoothing`, on each inertial channel; the
filter and the smoother are compared at the same stops, up to the last fix (after it they are one). Beside the
errors stand what the covariances claim of them, and the mean squared error by covariance (1 where honest).

The seeds are pooled: where GNSS never fails, all that is left is its drift, which takes a few independent
values a flight, and a single flight may by chance be better filtered. Messages and links are left out.
"""

from __future__ import annotations

import heapq
import math
from collections.abc import Iterable, Sequence
from operator import attrgetter
from typing import NamedTuple

import click
import numpy as np
from msgspec import structs
from rich.console import Console
from rich.progress import track
from rich.table import Table

from companion.analysis.smoothing import Run, smooth_flight
from companion.config import Config
from companion.records import (
    AirData,
    Attitude,
    Gnss,
    Imu,
    LocalOrigin,
    LocalPosition,
    Pressure,
    RsbnFix,
    Stamped,
)
from sitl.campaign.flight import UNITS
from sitl.flight import Array, radii
from sitl.scenarios import SCENARIOS, Scenario, named
from sitl.world import World

SENSORS = (LocalPosition, Attitude, Gnss, AirData, Pressure, RsbnFix)
CHANNELS = {"local_position": SENSORS, "air_data": SENSORS, "strapdown": (Imu, *SENSORS)}


class Compared(NamedTuple):
    """Squares over stops, pooled as they add: horizontal errors (m^2) of filter and smoother, what their
    covariances claim (m^2), and squared errors by covariance over the two degrees of freedom.
    """

    stops: int
    filtered: float
    smoothed: float
    claimed_filtered: float
    claimed_smoothed: float
    misfit_filtered: float
    misfit_smoothed: float

    @property
    def better(self) -> bool:
        """Whether the smoothed track is the nearer one."""
        return self.smoothed < self.filtered


def records(world: World, sensors: Sequence[type[Stamped]] = SENSORS) -> Iterable[Stamped]:
    """What the companion hears of a flight, in order of arrival, but for what its wire refuses."""
    origin, scenario = world.origin, world.scenario
    height = origin.alt - scenario.geoid_height
    yield LocalOrigin(0, 0, origin.lat, origin.lon, height, scenario.autopilot)
    for record in heapq.merge(*(world.streams[kind] for kind in sensors), key=attrgetter("rx_ns")):
        if not isinstance(record, LocalPosition) or all(map(math.isfinite, record.x_n)):
            yield record


def compare(scenario: Scenario, channel: str) -> Compared:
    """One flight, filtered and smoothed, against the truth."""
    world = World(scenario)
    unit = UNITS[scenario.grade] if channel == "local_position" else Config().inertial
    config = Config(inertial=structs.replace(unit, source=channel, independent=True))
    parts = [_against_truth(run, world) for run in smooth_flight(records(world, CHANNELS[channel]), config)]
    return pooled(parts)


def pooled(parts: Sequence[Compared]) -> Compared:
    """Of runs or of flights."""
    return Compared(*(sum(column) for column in zip(*parts, strict=True)))


def _against_truth(run: Run, world: World) -> Compared:
    truth = world.truth_at(np.asarray(run.t_ns * 1e-9, dtype=np.float64))
    R_N, R_E = radii(truth.lat)
    north = (run.lat - truth.lat) * (R_N + truth.alt)
    east = (run.lon - truth.lon) * (R_E + truth.alt) * np.cos(truth.lat)
    smoothed = np.stack([north, east], axis=1)
    filtered = smoothed + run.x[:, :2] - run.x_filter[:, :2]  # both are the channel less its error
    aided = (run.x != run.x_filter).any(axis=1)
    e, P = (filtered[aided], smoothed[aided]), (run.P_filter[aided, :2, :2], run.P[aided, :2, :2])
    squares = (float(np.sum(each**2)) for each in e)
    claims = (float(np.einsum("nii->", each)) for each in P)
    return Compared(int(aided.sum()), *squares, *claims, *map(_misfit, e, P))


def _misfit(e: Array, P: Array) -> float:
    return float(np.einsum("ni,ni->", e, np.linalg.solve(P, e[:, :, None])[:, :, 0])) / 2.0


@click.command("smoothing")
@click.option("--scenario", "names", multiple=True, help="One of the loopback's; all where none is named.")
@click.option(
    "--channel", "channels", multiple=True, type=click.Choice(list(CHANNELS)), help="All unless named."
)
@click.option("--seeds", type=click.IntRange(min=1), default=1, show_default=True, help="Flights of each.")
def command(names: tuple[str, ...], channels: tuple[str, ...], seeds: int) -> None:
    """Compare the smoothed track with the filter in flight, by scenario. Exit code 1 if it is worse."""
    try:
        scenarios = [named(name) for name in names or SCENARIOS]
    except ValueError as error:
        raise click.BadParameter(str(error), param_hint="--scenario") from None
    cases = [(scenario, channel) for scenario in scenarios for channel in channels or CHANNELS]
    rows = []
    console = Console(stderr=True)
    for scenario, channel in track(cases, "smoothing", console=console, transient=True):
        parts = [compare(named(scenario.name, seed=seed), channel) for seed in range(1, seeds + 1)]
        rows.append((scenario.name, channel, sum(part.better for part in parts), pooled(parts)))
    _print(rows, seeds)
    if not all(found.better for *_, found in rows):
        raise SystemExit(1)


def _print(rows: Iterable[tuple[str, str, int, Compared]], seeds: int) -> None:
    table = Table(title=f"horizontal error, m r.m.s. (claimed), of {seeds} flights each")
    for column in ("scenario", "channel", "filtered", "smoothed", "ratio (claimed)", "misfit", "better"):
        table.add_column(column, justify="left" if column in ("scenario", "channel") else "right")
    for name, channel, better, c in rows:
        f, s, claimed_f, claimed_s = (math.sqrt(value / c.stops) for value in c[1:5])
        table.add_row(
            *(name, channel),
            *(f"{f:.2f} ({claimed_f:.2f})", f"{s:.2f} ({claimed_s:.2f})"),
            f"{s / f:.3f} ({claimed_s / claimed_f:.3f})",
            f"{c.misfit_filtered / c.stops:.2f}, {c.misfit_smoothed / c.stops:.2f}",
            f"{better} of {seeds}",
        )
    Console(width=max(110, Console().width)).print(table)
