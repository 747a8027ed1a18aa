"""`python -m sitl.endurance.parameter_sweep`: every parameter set to its limits and beyond, in flight.

A ground station may set any parameter to any number. Each flight sets one parameter (or several) by PARAM_SET
while the companion navigates with GNSS and a beacon, then loses GNSS. Requirements: no exception, only finite
outputs, every message sent fits its wire format, and a value outside the limits changes nothing.
"""

from __future__ import annotations

import dataclasses
import math
import random
from collections.abc import Iterable
from functools import lru_cache
from typing import NamedTuple

import click

from companion.config import AirDataConfig, Config, InertialConfig, OutputConfig
from companion.config.reference import keys
from companion.link import dialect, frame
from companion.link.dialect import mavlink
from companion.link.parameter_server import REAL32, Parameter, parameter_table
from companion.runtime.core import CompanionCore
from companion.units import SECOND_NS
from sitl.autopilot import SimulatedAutopilot
from sitl.endurance.fuzz_targets import ALL_OUTPUTS, ValidatingLog
from sitl.loopback import LINK, START_NS
from sitl.scenarios import get_scenario

FLIGHT_S, SET_AT_S, OUTAGE_S = 50.0, 15.0, 30.0
#: Beyond the limits of every parameter, or awkward to compute with.
EXTREMES = (math.nan, math.inf, -math.inf, 3.4e38, -3.4e38, 1e-40, -1e-40, 1e-30, 1e-6, 4e-4, 0.0, -1.0, 1e9)
#: Channels and outputs that are swept: an own INS, the own channel by all sensors, and by air data alone.
CONFIGS = (
    Config(inertial=InertialConfig(independent=True), output=ALL_OUTPUTS),
    Config(output=OutputConfig(profile="ardupilot")),
    Config(inertial=InertialConfig(source="air_data"), air_data=AirDataConfig(), output=ALL_OUTPUTS),
)
_LIMITS = {(key.section, key.name): key.limits for key in keys()}


class Setting(NamedTuple):
    """One PARAM_SET: the parameter's name and the value on the wire."""

    name: str
    value: float


def limits(parameter: Parameter) -> tuple[float, ...]:
    """Return the least and the greatest value that a parameter accepts by itself."""
    least, greatest = _LIMITS[parameter.section, parameter.key]
    if least is None or greatest is None:
        raise ValueError(f"{parameter.section}.{parameter.key} has no minimum or no maximum")
    return float(least), float(greatest)


def at_limits() -> list[Setting]:
    """Return every parameter at its least and at its greatest value."""
    return [Setting(p.name, value) for p in parameter_table() for value in limits(p)]


def at_extremes() -> list[Setting]:
    """Return every parameter at all extremes."""
    return [Setting(p.name, value) for p in parameter_table() for value in EXTREMES]


@lru_cache
def recorded_flight(own_ins: bool) -> tuple[tuple[int, bytes], ...]:
    """Fly once and return the autopilot's frames with their arrival times, the GNSS lost at OUTAGE_S."""
    scenario = dataclasses.replace(
        get_scenario("short"), gnss_outages=((OUTAGE_S, 10 * FLIGHT_S),), rsbn_outages=()
    )
    autopilot = SimulatedAutopilot(scenario, START_NS)
    core = CompanionCore(CONFIGS[0 if own_ins else 1], ValidatingLog(), (LINK,))
    frames, now = list[tuple[int, bytes]](), START_NS
    while now <= START_NS + round(FLIGHT_S * 1e9):
        for data in autopilot.poll(now):
            frames.append((now, data))
            core.receive(LINK, data, now)
        core.poll(now)
        for data in core.to_send(LINK, now):
            autopilot.receive(data, now)
        now = max(now + 1, min(autopilot.deadline(), core.deadline()))
    return tuple(frames)


def fly_with(config: Config, chosen: Iterable[Setting]) -> int:
    """Fly and set the parameters one after another, a second apart; return how many were changed.

    Raises ValueError if a value out of its limits changed anything, or if a message could not be sent.
    """
    core = CompanionCore(config, ValidatingLog(), (LINK,))
    allowed = {parameter.name: limits(parameter) for parameter in parameter_table()}
    pending = list(chosen)
    before, changed, due = config, 0, START_NS + round(SET_AT_S * 1e9)
    for number, (now, data) in enumerate(recorded_flight(config.inertial.independent)):
        core.receive(LINK, data, now)
        if core.deadline() <= now:
            core.poll(now)
        core.to_send(LINK, now)
        core.take_events()
        if pending and now >= due:
            setting = pending.pop(0)
            due = now + SECOND_NS
            core.receive(LINK, param_set(setting, number), now)
            if core.config != before:
                least, greatest = allowed[setting.name]
                if not least <= setting.value <= greatest:
                    raise ValueError(f"{setting} was accepted; its limits are {least:g} and {greatest:g}")
                before, changed = core.config, changed + 1
    if core.links[LINK].not_sent:
        raise ValueError(f"not sent: {dict(core.links[LINK].not_sent)}")
    return changed


def param_set(setting: Setting, sequence: int) -> bytes:
    """Return the frame of a ground station that sets one parameter."""
    message = dialect.new(
        "PARAM_SET",
        target_system=1,
        target_component=191,
        param_id=setting.name,
        param_value=setting.value,
        param_type=REAL32,
    )
    return frame.encode(message, sequence & 0xFF, 255, mavlink.MAV_COMP_ID_MISSIONPLANNER)


@click.command()
@click.option(
    "--several",
    type=click.IntRange(0),
    default=100,
    show_default=True,
    help="Number of flights with ten settings each.",
)
@click.option(
    "--seed", type=click.IntRange(min=0), default=1, show_default=True, help="Seed of these flights."
)
def main(several: int, seed: int) -> None:
    """Set every parameter to its limits and beyond in flight. Exit code 1 if a flight failed."""
    extremes, rng = at_extremes(), random.Random(seed)
    flights: list[tuple[Config, list[Setting]]] = []
    for config in CONFIGS:
        flights += [(config, [setting]) for setting in at_limits()]
        # most are out of the limits and change nothing, so many are set in one flight
        flights += [(config, extremes[at : at + 30]) for at in range(0, len(extremes), 30)]
    everything = at_limits() + extremes
    flights += [(rng.choice(CONFIGS), rng.sample(everything, 10)) for _ in range(several)]
    changed, failed = 0, list[str]()
    for number, (config, chosen) in enumerate(flights):
        try:
            changed += fly_with(config, chosen)
        except Exception as error:  # the defect that is looked for
            failed.append(f"{chosen}: {type(error).__name__}: {error}")
            click.echo(failed[-1])
        if number % 50 == 0:
            click.echo(f"{number} of {len(flights)} flights")
    click.echo(f"{len(flights)} flights, {changed} changes accepted, {len(failed)} failed")
    if failed:
        raise SystemExit(1)


if __name__ == "__main__":
    main()
