"""`companion study smoothing`: error of the smoothed track against the filter, by scenario.

    companion study smoothing --seeds 4

The records of every scenario are processed by the navigator and `companion.analysis.smoothing`, on each
inertial channel. Filter and smoother are compared at the same epochs up to the last fix (after it they are
identical). The table also lists the errors claimed by the covariances, and the mean normalised squared error
(1 if the covariance is consistent).

The grade of the INS is stated; the gusts are found by the smoother itself. Fixes end the comparison, so the
records after the last one are left out.

Seeds are pooled: with uninterrupted GNSS the remaining error is its drift, which has few independent values
per flight, so a single flight may be better filtered by chance. Messages and links are not simulated.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from typing import NamedTuple

import click
import numpy as np
from msgspec import structs

from companion.analysis.progress import show_items
from companion.analysis.smoothing import SmoothedRun, smooth_flight
from companion.config import AirDataConfig, Config, InertialConfig
from companion.records import Gnss, Imu, RsbnFix, Stamped
from companion.tables import number_table, print_tables
from companion.units import Floats
from sitl.flight import fly_plan
from sitl.scenarios import SCENARIOS, Scenario, get_scenario, parse_scenario
from sitl.sensors import STATED_GRADES, AirDataModel
from sitl.world import SENSORS, World

SAME_SIGMA = 1e-6
#: An INS of its own; the companion's own channel by airspeed alone; the same by all that it gets.
CHANNELS: dict[str, tuple[type[Stamped], ...]] = {"ins": SENSORS, "air_data": SENSORS, "own": (Imu, *SENSORS)}


class SmoothingComparison(NamedTuple):
    """Sums over epochs: horizontal squared errors (m^2) of filter and smoother, the same as claimed by their
    covariances (m^2), and normalised squared errors over the two degrees of freedom.
    """

    epochs: int
    filtered: float
    smoothed: float
    claimed_filtered: float
    claimed_smoothed: float
    misfit_filtered: float
    misfit_smoothed: float

    @property
    def better(self) -> bool:
        """Whether the smoothed track is nearer to the truth."""
        return self.smoothed < self.filtered


def simulated_gusts(scenario: Scenario) -> AirDataConfig:
    """Return the air-data model with the turbulence of the simulator: Dryden's, of correlation time L / V."""
    speed = float(np.mean(fly_plan(scenario.plan).airspeed))
    air = AirDataModel()
    return AirDataConfig(gust_m_s=air.turbulence_m_s, gust_s=air.turbulence_length_m / speed)


def compare_flight(scenario: Scenario, channel: str) -> SmoothingComparison:
    """Compare filter and smoother with the truth on one flight."""
    world = World(scenario)
    if channel == "ins":
        inertial = structs.replace(STATED_GRADES[scenario.grade], independent=True)
    else:
        inertial = InertialConfig(source="air_data" if channel == "air_data" else "auto")
    fixes = (*world.streams[Gnss], *world.streams[RsbnFix])
    end_ns = max(fix.rx_ns for fix in fixes if getattr(fix, "has_3d_fix", True))
    records = (r for r in world.records(CHANNELS[channel]) if r.rx_ns <= end_ns)
    return pool([_against_truth(run, world) for run in smooth_flight(records, Config(inertial=inertial))])


def pool(parts: Sequence[SmoothingComparison]) -> SmoothingComparison:
    """Add up the sums of several runs or flights."""
    return SmoothingComparison(*(sum(column) for column in zip(*parts, strict=True)))


def _against_truth(run: SmoothedRun, world: World) -> SmoothingComparison:
    smoothed = world.errors_at(np.asarray(run.t_ns * 1e-9, dtype=np.float64), run.lat, run.lon)
    filtered = smoothed + run.x[:, :2] - run.x_filter[:, :2]  # both are channel minus estimated error
    # after the last fix both are the same up to rounding
    sigma = np.sqrt(np.einsum("nii->ni", run.P_filter[:, :2, :2]))
    aided = (np.abs((run.x - run.x_filter)[:, :2]) > SAME_SIGMA * sigma).any(axis=1)
    e, P = (filtered[aided], smoothed[aided]), (run.P_filter[aided, :2, :2], run.P[aided, :2, :2])
    squares = (float(np.sum(each**2)) for each in e)
    claims = (float(np.einsum("nii->", each)) for each in P)
    return SmoothingComparison(int(aided.sum()), *squares, *claims, *map(_normalised_error, e, P))


def _normalised_error(e: Floats, P: Floats) -> float:
    return float(np.einsum("ni,ni->", e, np.linalg.solve(P, e[:, :, None])[:, :, 0])) / 2.0


@click.command("smoothing")
@click.option("--scenario", "names", multiple=True, help="A loopback scenario; default: all.")
@click.option(
    "--channel",
    "channels",
    multiple=True,
    type=click.Choice(list(CHANNELS)),
    help="An inertial channel; default: all.",
)
@click.option(
    "--seeds", type=click.IntRange(1, 10_000), default=1, show_default=True, help="Flights per scenario."
)
def command(names: tuple[str, ...], channels: tuple[str, ...], seeds: int) -> None:
    """Compare the smoothed track with the filter by scenario. Exit code 1 if it is worse."""
    scenarios = [parse_scenario(name) for name in names or SCENARIOS]
    cases = [(scenario, channel) for scenario in scenarios for channel in channels or CHANNELS]
    rows = []
    for scenario, channel in show_items(cases, "smoothing"):
        parts = [
            compare_flight(get_scenario(scenario.name, seed=seed), channel) for seed in range(1, seeds + 1)
        ]
        rows.append((scenario.name, channel, sum(part.better for part in parts), pool(parts)))
    _print_table(rows, seeds)
    if not all(found.better for *_, found in rows):
        raise SystemExit(1)


def _print_table(rows: Iterable[tuple[str, str, int, SmoothingComparison]], seeds: int) -> None:
    heads = "scenario", "channel", "filtered", "smoothed", "ratio (claimed)", "misfit", "better"
    table = number_table(f"horizontal error, m r.m.s. (claimed), {seeds} flights each", *heads, texts=2)
    for name, channel, better, c in rows:
        f, s, claimed_f, claimed_s = (math.sqrt(value / c.epochs) for value in c[1:5])
        table.add_row(
            *(name, channel),
            *(f"{f:.2f} ({claimed_f:.2f})", f"{s:.2f} ({claimed_s:.2f})"),
            f"{s / f:.3f} ({claimed_s / claimed_f:.3f})",
            f"{c.misfit_filtered / c.epochs:.2f}, {c.misfit_smoothed / c.epochs:.2f}",
            f"{better} of {seeds}",
        )
    print_tables(table)
