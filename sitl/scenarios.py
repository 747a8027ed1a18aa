"""Simulation scenarios: flight plan, sensors, outages and faults. `sitl.world` simulates them.

`get_scenario("default")` returns a scenario of the table, `get_scenario("default", seed=7)` the same flight
with other noise. All times are seconds of flight.
"""

from __future__ import annotations

import dataclasses
import difflib
import itertools
import math
from dataclasses import dataclass, field
from typing import Any, Literal, NamedTuple

import click

from sitl.beacon import Beacon
from sitl.faults import Fault
from sitl.flight import FlightPlan, Leg, WindChange
from sitl.sensors import GRADES

TimeSpans = tuple[tuple[float, float], ...]


class SchedulePhase(NamedTuple):
    """Part of the flight during which the same sources are available."""

    name: str
    start_s: float
    end_s: float


@dataclass(frozen=True, slots=True)
class SensorRates:
    """Update rate of each sensor, Hz."""

    imu: float = 50.0
    local_position: float = 10.0
    attitude: float = 10.0
    gnss: float = 5.0
    rsbn: float = 1.0
    air: float = 10.0
    truth: float = 10.0


@dataclass(frozen=True, slots=True)
class Scenario:
    """One flight: plan, sensors, outages, faults. The seed determines every random number.

    Without `airspeed_sensor` the autopilot sends its own synthetic airspeed. With `own_estimate` its local
    and global positions are those of its own filter, which takes the companion's positions (ArduPilot only);
    otherwise they come from an INS of this grade. `correctors` names what
    corrects that INS beside GNSS and beacons.
    """

    name: str
    plan: FlightPlan
    grade: str = "navigation"
    beacons: tuple[Beacon, ...] = ()
    gnss_outages: TimeSpans = ()
    rsbn_outages: TimeSpans = ()
    rates: SensorRates = field(default_factory=SensorRates)
    airspeed_sensor: bool = True
    own_estimate: bool = False
    correctors: tuple[str, ...] = ()
    faults: tuple[Fault, ...] = ()
    seed: int = 1
    autopilot: Literal["ardupilot", "px4"] = "ardupilot"

    def __post_init__(self) -> None:
        if self.grade not in GRADES:
            raise ValueError(f"unknown grade {self.grade!r}: choose one of {', '.join(GRADES)}")
        for start, end in (*self.gnss_outages, *self.rsbn_outages):
            if not 0.0 <= start < end:
                raise ValueError(
                    f"outage from {start:g} to {end:g} s: it must start at 0 or later and end after its start"
                )
        if self.own_estimate and self.autopilot != "ardupilot":
            raise ValueError(f"the filter of {self.autopilot} is not simulated: ardupilot only")
        if min(dataclasses.astuple(self.rates)) <= 0.0:
            raise ValueError("a sensor rate is not positive: give a rate above 0 Hz")

    @property
    def duration_s(self) -> float:
        """Duration of the flight, s."""
        return self.plan.duration_s

    def phases(self) -> list[SchedulePhase]:
        """Return the phases of the outage schedule in order, named "GNSS+RSBN", "GNSS only", ..., "neither".

        Beacon range and faults are not considered.
        """

        def on(spans: TimeSpans, t: float) -> bool:
            return not any(start <= t < end for start, end in spans)

        ends = {edge for span in (*self.gnss_outages, *self.rsbn_outages) for edge in span}
        edges = sorted({0.0, self.duration_s} | {edge for edge in ends if edge < self.duration_s})
        phases: list[SchedulePhase] = []
        for start, end in itertools.pairwise(edges):
            gnss, rsbn = on(self.gnss_outages, start), bool(self.beacons) and on(self.rsbn_outages, start)
            name = {(True, True): "GNSS+RSBN", (True, False): "GNSS only", (False, True): "RSBN only"}.get(
                (gnss, rsbn), "neither"
            )
            if phases and phases[-1].name == name:
                phases[-1] = phases[-1]._replace(end_s=end)
            else:
                phases.append(SchedulePhase(name, start, end))
        return phases


# about 42 min at 34 to 42 m/s: out to 90 km, then part of the way back
_LEGS = (
    Leg(20, 40, 0, 0),
    Leg(60, 40, 38, 0),
    Leg(600, 40, 38, 800),
    Leg(300, 95, 34, 800),
    Leg(400, 50, 42, 1200),
    Leg(400, 15, 40, 1200),
    Leg(380, 70, 42, 1000),
    Leg(360, 250, 36, 600),
)
_RETURN_LEGS = (Leg(540, 215, 40, 800), Leg(540, 240, 40, 600))  # extends the flight to an hour
TAKE_OFF = (Leg(10, 40, 0, 0), Leg(50, 40, 38, 0))
_SHORT_LEGS = (
    *TAKE_OFF,
    Leg(120, 40, 38, 120),
    Leg(60, 100, 36, 120),
    Leg(60, 30, 38, 120),
)
WIND = WindChange(0, 4, 5)
_WINDS = (WIND, WindChange(1200, 1, 8, 240.0))
#: East: 60 km from the start, to the right of the path. North: farther on, to the left.
EAST_BEACON = Beacon(1, 60.05, 31.07)
_NORTH_BEACON = Beacon(2, 60.75, 30.25)
_PLAN = FlightPlan(_LEGS, winds=_WINDS)

DEFAULT = Scenario(
    "default",
    _PLAN,
    beacons=(EAST_BEACON,),
    gnss_outages=((1500.0, 2220.0),),
    rsbn_outages=((900.0, 1500.0), (1920.0, 2220.0)),
)
_SHORT_FLIGHT = Scenario(
    "short",
    FlightPlan(_SHORT_LEGS, winds=(WIND,)),
    beacons=(EAST_BEACON,),
    gnss_outages=((180.0, 270.0),),
    rsbn_outages=((120.0, 180.0), (225.0, 270.0)),
)


def _default_with(name: str, **changes: Any) -> Scenario:
    return dataclasses.replace(DEFAULT, name=name, **changes)


def _corrected_by(name: str, corrector: str) -> Scenario:
    """A tactical INS with one corrector; GNSS is lost after 10 of 23 min."""
    plan = dataclasses.replace(_PLAN, legs=_LEGS[:5])
    lost = {"gnss_outages": ((600.0, math.inf),), "beacons": (), "rsbn_outages": ()}
    return _default_with(name, plan=plan, grade="tactical", correctors=(corrector,), **lost)


SCENARIOS: dict[str, Scenario] = {
    scenario.name: scenario
    for scenario in (
        DEFAULT,
        _SHORT_FLIGHT,
        _default_with("gnss-loss", gnss_outages=((900.0, math.inf),), rsbn_outages=((0.0, math.inf),)),
        _default_with("hour", plan=dataclasses.replace(_PLAN, legs=(*_LEGS, *_RETURN_LEGS))),
        _default_with("tactical", grade="tactical"),
        _default_with("mems", grade="mems"),
        _default_with("two-beacons", beacons=(EAST_BEACON, _NORTH_BEACON)),
        _default_with("no-beacon", beacons=(), rsbn_outages=()),
        _default_with(
            "wind-change",
            # the wind turns by 90 degrees and doubles when GNSS is lost
            plan=dataclasses.replace(_PLAN, winds=(WindChange(0, 5, 0), WindChange(900, 0, 10, 20.0))),
            gnss_outages=((900.0, 1500.0),),
            rsbn_outages=((900.0, 1500.0),),
        ),
        _default_with(
            "ten-outages",
            gnss_outages=tuple((300.0 + 210.0 * i, 360.0 + 210.0 * i) for i in range(10)),
            rsbn_outages=tuple((330.0 + 210.0 * i, 360.0 + 210.0 * i) for i in range(10)),
        ),
        _default_with(
            "spoof", gnss_outages=(), rsbn_outages=(), faults=(Fault("gnss-spoof", 1200.0, 1800.0),)
        ),
        _corrected_by("airspeed-ins", "airspeed"),
        _corrected_by("hyperbolic", "hyperbolic"),
        _corrected_by("stars", "stars"),
        _corrected_by("second-ins", "second_ins"),
        _default_with(
            "hostile",
            faults=(
                Fault("bit-errors", 300.0, 360.0),
                Fault("garbage", 400.0, 460.0),
                Fault("second-autopilot", 500.0, 560.0),
                Fault("ins-nan", 600.0, 605.0),
                Fault("reordering", 650.0, 700.0),
            ),
        ),
    )
}


def get_scenario(name: str, **changes: Any) -> Scenario:
    """Return the scenario of this name, with `changes` to its fields.

    Raises ValueError for an unknown name; the message names the nearest one.
    """
    scenario = SCENARIOS.get(name)
    if scenario is None:
        near = difflib.get_close_matches(name, SCENARIOS, 1)
        hint = f"did you mean {near[0]}?" if near else f"choose one of {', '.join(SCENARIOS)}"
        raise ValueError(f"unknown scenario {name!r}: {hint}")
    return dataclasses.replace(scenario, **changes)


def parse_scenario(name: str, seed: int | None = None) -> Scenario:
    """Return the scenario given with `--scenario`, with another seed if there is one. Raises BadParameter."""
    try:
        return get_scenario(name, **({} if seed is None else {"seed": seed}))
    except ValueError as error:
        raise click.BadParameter(str(error), param_hint="--scenario") from None
