"""`companion study schemes-flown`: one flight by feedforward, feedback and shares in between.

The records of one scenario go through the navigator with each `estimator.scheme`. The schemes are
informationally equivalent: they use the same fixes, have the same guaranteed bound, and the same position
up to what the linearisation of azimuth and range at another nominal trajectory changes.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import click
import numpy as np

from companion.analysis.error_statistics import root_mean_square
from companion.analysis.progress import show_items
from companion.config import Config, EstimatorConfig, InertialConfig
from companion.navigator import Navigator
from companion.records import Fix, Rejection, Solution, Source
from companion.tables import number_table, print_tables
from companion.units import Floats
from sitl.scenarios import parse_scenario
from sitl.smoothing_study import CHANNELS
from sitl.world import World

SCHEMES: tuple[Any, ...] = ("feedforward", 0.3, 0.7, "feedback")
OWN_CHANNELS = ("air_data", "own")


class SchemeFlight(NamedTuple):
    """One flight: times (n,) ns, position (n, 2) rad, guaranteed bound (n, 2) m, counts of fixes."""

    t_ns: Floats
    place: Floats
    bound: Floats
    error_rms: float
    fixes: int
    joint: int
    rejected: int


def fly(world: World, channel: str, scheme: Any) -> SchemeFlight:
    """Navigate the records of a world by one scheme."""
    inertial = InertialConfig(source="air_data" if channel == "air_data" else "auto")
    navigator = Navigator(Config(inertial=inertial, estimator=EstimatorConfig(scheme=scheme)))
    solutions: list[Solution] = []
    fixes: list[Fix] = []
    rejected = 0
    for record in world.records(CHANNELS[channel]):
        for output in navigator.handle(record):
            if isinstance(output, Solution):
                solutions.append(output)
            elif isinstance(output, Fix):
                fixes.append(output)
            rejected += isinstance(output, Rejection)
    beacon = Source.AZIMUTH | Source.RANGE
    joint = sum(bool(fix.sources & Source.GNSS and fix.sources & beacon) for fix in fixes)
    _, error = world.horizontal_errors(solutions)
    t = np.array([s.t_ns for s in solutions], dtype=np.float64)
    place = np.array([(s.lat, s.lon) for s in solutions])
    bound = np.array([s.bound_n or (np.nan, np.nan) for s in solutions])
    return SchemeFlight(t, place, bound, root_mean_square(error), len(fixes), joint, rejected)


def bound_m(flight: SchemeFlight) -> float | None:
    """Return the r.m.s. guaranteed bound, m, where it is known; None: never."""
    known = flight.bound[np.isfinite(flight.bound).all(axis=1)]
    return root_mean_square(np.hypot(*known.T)) if len(known) else None


def apart_m(a: SchemeFlight, b: SchemeFlight) -> tuple[float, float]:
    """Return the r.m.s. and the greatest distance of two flights at the times of both, m."""
    _, i, j = np.intersect1d(a.t_ns, b.t_ns, return_indices=True)
    d = a.place[i] - b.place[j]
    metres = 6.371e6 * np.hypot(d[:, 0], d[:, 1] * np.cos(a.place[i, 0]))
    return root_mean_square(metres), float(metres.max())


@click.command("schemes-flown")
@click.option("--scenario", default="short", show_default=True, help="A loopback scenario.")
@click.option("--channel", "channels", multiple=True, type=click.Choice(OWN_CHANNELS), help="Default: all.")
@click.option("--seed", type=click.IntRange(min=0), default=1, show_default=True, help="Seed of the flight.")
def command(scenario: str, channels: Sequence[str], seed: int) -> None:
    """Fly one scenario by each correction scheme.

    Compares fixes used, guaranteed bounds and positions.
    """
    world = World(parse_scenario(scenario, seed))
    table = number_table(
        f"{scenario}, seed {seed}, no INS of its own",
        *("channel", "scheme", "error, m", "fixes", "of GNSS and beacon", "rejected", "bound, m"),
        *("apart, m r.m.s.", "apart, m most"),
        texts=2,
    )
    cases = [(channel, scheme) for channel in channels or OWN_CHANNELS for scheme in SCHEMES]
    first: dict[str, SchemeFlight] = {}
    for channel, scheme in show_items(cases, "flying"):
        flight = fly(world, channel, scheme)
        apart = apart_m(flight, first.setdefault(channel, flight))
        bound = bound_m(flight)
        table.add_row(
            *(channel, str(scheme), f"{flight.error_rms:.3f}"),
            *(str(n) for n in (flight.fixes, flight.joint, flight.rejected)),
            *("-" if bound is None else f"{bound:.3f}", f"{apart[0]:.2g}", f"{apart[1]:.2g}"),
            end_section=scheme == SCHEMES[-1],
        )
    print_tables(table)
