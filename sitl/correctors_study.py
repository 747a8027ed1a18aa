"""`companion study correctors`: an INS without GNSS, corrected by airspeed, stars, lines or a second INS.

Fixes of GNSS end at 15 min. The records of each corrector go through the navigator with the errors that
its model assumes. The table has the error of the position over the time since the loss, with and without
the corrector.
"""

from __future__ import annotations

import dataclasses
import math
from typing import NamedTuple

import click
import numpy as np
from msgspec import structs

from companion.analysis.error_statistics import root_mean_square
from companion.analysis.progress import show_items
from companion.config import Config, OutputConfig
from companion.tables import number_table, print_tables
from companion.units import Floats
from sitl.correctors import RECORDS
from sitl.scenarios import get_scenario
from sitl.sensors import GRADES, STATED_GRADES
from sitl.smoothing_study import simulated_gusts
from sitl.weights_study import navigate
from sitl.world import World

NAMES = ("none", "airspeed", *RECORDS)
LOSS_S, MARKS_MIN = 900.0, (2, 5, 10, 20)


class CorrectedFlight(NamedTuple):
    """Times (n,) s, horizontal error (n,) m, claimed sigma (n,) m, protection level (n,) m."""

    t: Floats
    error: Floats
    sigma: Floats
    protection: Floats

    def at(self, values: Floats, start_s: float, end_s: float) -> float:
        """Return the r.m.s. of some values between two times."""
        inside = (self.t >= start_s) & (self.t < end_s)
        return root_mean_square(values[inside])


def fly(world: World, bank: bool = True) -> CorrectedFlight:
    """Navigate the INS of a world with the correctors of its scenario. Without `bank`, one filter."""
    scenario = world.scenario
    unit = structs.replace(STATED_GRADES[scenario.grade], independent=True, correctors=scenario.correctors)
    config = Config(inertial=unit, air_data=simulated_gusts(scenario), output=OutputConfig(solution_hz=1.0))
    found = navigate(world.records(), config, bank)
    t, error = world.horizontal_errors(found)
    sigma = np.sqrt([s.covariance[0] + s.covariance[3] for s in found])
    return CorrectedFlight(t, error, sigma, np.array([s.protection or math.inf for s in found]))


@click.command("correctors")
@click.option(
    "--grade", type=click.Choice(list(GRADES)), default="tactical", show_default=True, help="INS grade."
)
@click.option("--name", "names", multiple=True, type=click.Choice(NAMES), help="Corrector; default: each.")
@click.option("--seed", type=click.IntRange(min=0), default=1, show_default=True, help="Seed of the flight.")
def command(grade: str, names: tuple[str, ...], seed: int) -> None:
    """Fly an INS without GNSS, with each corrector.

    Correctors are airspeed, lines of position, stars and a second INS.
    """
    scenario = get_scenario("gnss-loss", seed=seed, grade=grade, beacons=())
    title = f"{grade} INS, GNSS lost at 15 min, seed {seed}: error, m r.m.s. (claimed)"
    edges = [0, *MARKS_MIN]
    after = (f"{a}-{b} min after" for a, b in zip(edges, MARKS_MIN))
    table = number_table(title, "corrector", "with GNSS", *after, "within protection")
    for name in show_items(names or NAMES, "flying"):
        used = () if name == "none" else (name,)
        flight = fly(World(dataclasses.replace(scenario, correctors=used)))
        spans = [(60.0, LOSS_S), *((LOSS_S + 60.0 * a, LOSS_S + 60.0 * b) for a, b in zip(edges, MARKS_MIN))]
        cells = (f"{flight.at(flight.error, *s):.0f} ({flight.at(flight.sigma, *s):.0f})" for s in spans)
        table.add_row(name, *cells, f"{np.mean(flight.error <= flight.protection):.1%}")
    print_tables(table)
