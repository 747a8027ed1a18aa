"""`companion study weights-flown`: the error of a flight when one source's stated sigma is wrong.

The records of one scenario are processed with the sigma of one source stated as 0.1 to 10 times the true
one, by the bank of hypotheses and by a single Kalman filter (one grade, nothing ever false). The INS is
an INS of its own, stated sigmas of it are those of its error model. Messages and links are not simulated.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from typing import NamedTuple

import click
from msgspec import structs

from companion.analysis.error_statistics import root_mean_square
from companion.analysis.progress import show_items
from companion.config import Config, InertialConfig, OutputConfig
from companion.navigator import Navigator
from companion.navigator.hypotheses import Model
from companion.records import Gnss, RsbnFix, Solution, Stamped
from companion.tables import number_table, print_tables
from sitl.scenarios import parse_scenario
from sitl.sensors import STATED_GRADES
from sitl.world import World

SOURCES = ("INS", "GNSS", "RSBN")
FACTORS = (0.1, 0.3, 1.0, 3.0, 10.0)
#: Stated amplitudes of an INS that are scaled together.
INS_SIGMAS = tuple(
    name
    for name, value in structs.asdict(InertialConfig()).items()
    if type(value) is float and name != "height_sigma_m"
)


class FlownError(NamedTuple):
    """Horizontal r.m.s. error (m) of one flight: in each phase of its schedule, and overall."""

    phases: tuple[float, ...]
    overall: float


def stated(config: Config, source: str, factor: float) -> Config:
    """Return the configuration with the sigmas of one source stated `factor` times as large."""
    if source == "INS":
        scaled = {name: factor * getattr(config.inertial, name) for name in INS_SIGMAS}
        return structs.replace(config, inertial=structs.replace(config.inertial, **scaled))
    if source == "GNSS":
        gnss = structs.replace(
            config.gnss,
            sigma_m=factor * config.gnss.sigma_m,
            sigma_velocity_m_s=factor * config.gnss.sigma_velocity_m_s,
        )
        return structs.replace(config, gnss=gnss)
    rsbn = structs.replace(
        config.rsbn,
        sigma_azimuth_deg=factor * config.rsbn.sigma_azimuth_deg,
        sigma_range_m=factor * config.rsbn.sigma_range_m,
        sigma_range_percent=factor * config.rsbn.sigma_range_percent,
    )
    return structs.replace(config, rsbn=rsbn)


def restated(records: Iterable[Stamped], source: str, factor: float) -> Iterable[Stamped]:
    """Yield the records with the sigmas that the source itself states scaled alike."""
    for record in records:
        if source == "GNSS" and isinstance(record, Gnss) and record.has_3d_fix:
            yield structs.replace(
                record,
                sigma_horizontal=factor * (record.sigma_horizontal or 0.0),
                sigma_velocity=factor * (record.sigma_velocity or 0.0),
            )
        elif source == "RSBN" and isinstance(record, RsbnFix):
            yield structs.replace(
                record, sigma_azimuth=factor * record.sigma_azimuth, sigma_range=factor * record.sigma_range
            )
        else:
            yield record


def navigate(records: Iterable[Stamped], config: Config, bank: bool) -> list[Solution]:
    """Return the solutions of the bank of hypotheses, or without `bank` of a single Kalman filter."""
    navigator = Navigator(config, None if bank else Model(config, plain=0))
    return [
        output for record in records for output in navigator.handle(record) if isinstance(output, Solution)
    ]


def fly(world: World, source: str, factor: float, bank: bool) -> FlownError:
    """Navigate the records of a world with one source's sigma misstated; solutions once a second."""
    scenario = world.scenario
    inertial = structs.replace(STATED_GRADES[scenario.grade], independent=True)
    config = stated(Config(inertial=inertial, output=OutputConfig(solution_hz=1.0)), source, factor)
    found = navigate(restated(world.records(), source, factor), config, bank)
    t, error = world.horizontal_errors(found)
    phases = [error[(t >= phase.start_s) & (t < phase.end_s)] for phase in scenario.phases()]
    return FlownError(
        tuple(root_mean_square(each) if len(each) else math.nan for each in phases), root_mean_square(error)
    )


@click.command("weights-flown")
@click.option("--scenario", default="default", show_default=True, help="A loopback scenario.")
@click.option("--source", "sources", multiple=True, type=click.Choice(SOURCES), help="Default: each.")
@click.option("--seed", type=click.IntRange(min=0), default=1, show_default=True, help="Seed of the flight.")
def command(scenario: str, sources: Sequence[str], seed: int) -> None:
    """Fly with the sigma of one source stated wrong.

    Flies with the bank of hypotheses and without.
    """
    flight = parse_scenario(scenario, seed)
    world = World(flight)
    title = f"{scenario}, seed {seed}: horizontal error, m r.m.s.: bank / one Kalman filter"
    phases = (phase.name for phase in flight.phases())
    table = number_table(title, "source", "stated / true sigma", *phases, "overall")
    cases = [(source, factor) for source in sources or SOURCES for factor in FACTORS]
    for source, factor in show_items(cases, "flying"):
        bank, plain = (fly(world, source, factor, on) for on in (True, False))
        cells = zip((*bank.phases, bank.overall), (*plain.phases, plain.overall), strict=True)
        end = factor == FACTORS[-1]
        table.add_row(source, f"{factor:g}", *(f"{a:.1f} / {b:.1f}" for a, b in cells), end_section=end)
    print_tables(table)
