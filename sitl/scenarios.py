"""Scenarios: what is flown, with which sensors, and what fails when. Values; `sitl.world` plays them.

`named("default")` is one of the table; `named("default", seed=7)` the same flight with other noise. All
times are seconds of flight.
"""

from __future__ import annotations

import dataclasses
import difflib
import itertools
import math
from dataclasses import dataclass, field
from typing import Any, Literal, NamedTuple

from sitl.beacon import Beacon
from sitl.faults import Fault
from sitl.flight import Leg, Plan, Wind
from sitl.sensors import GRADES, AirDataModel, GnssModel

Spans = tuple[tuple[float, float], ...]


class Phase(NamedTuple):
    """A stretch of the flight during which the same sources are on."""

    name: str
    start_s: float
    end_s: float


@dataclass(frozen=True, slots=True)
class Rates:
    """How often each sensor gives a new value, Hz."""

    imu: float = 50.0
    local_position: float = 10.0
    attitude: float = 10.0
    gnss: float = 5.0
    rsbn: float = 1.0
    air: float = 10.0
    truth: float = 10.0


@dataclass(frozen=True, slots=True)
class Link:
    """The way from autopilot to companion: latency and the exponential jitter's mean (s)."""

    latency_s: float = 0.004
    jitter_s: float = 0.002


@dataclass(frozen=True, slots=True)
class Scenario:
    """One flight with all that happens in it; the seed makes every random number."""

    name: str
    plan: Plan
    grade: str = "navigation"
    beacons: tuple[Beacon, ...] = ()
    gnss_outages: Spans = ()
    rsbn_outages: Spans = ()
    gnss: GnssModel = field(default_factory=GnssModel)
    air: AirDataModel = field(default_factory=AirDataModel)
    rates: Rates = field(default_factory=Rates)
    link: Link = field(default_factory=Link)
    faults: tuple[Fault, ...] = ()
    seed: int = 1
    autopilot: Literal["ardupilot", "px4"] = "ardupilot"
    geoid_height: float = 16.0
    boot_before_s: float = 37.25

    def __post_init__(self) -> None:
        if self.grade not in GRADES:
            raise ValueError(f"grade {self.grade!r} is unknown: choose one of {', '.join(GRADES)}")
        for start, end in (*self.gnss_outages, *self.rsbn_outages):
            if not 0.0 <= start < end:
                raise ValueError(f"an outage from {start:g} to {end:g} s: let it end after its start")
        if min(dataclasses.astuple(self.rates)) <= 0.0:
            raise ValueError("a sensor's rate is not positive: give hertz greater than 0")

    @property
    def duration_s(self) -> float:
        """How long the flight lasts, s."""
        return self.plan.duration_s

    def phases(self) -> list[Phase]:
        """The stretches of the schedule, in order, by which sources are on; names as "GNSS+RSBN", "neither".

        Neither a beacon's reach nor faults are in it.
        """

        def on(spans: Spans, t: float) -> bool:
            return not any(start <= t < end for start, end in spans)

        ends = {edge for span in (*self.gnss_outages, *self.rsbn_outages) for edge in span}
        edges = sorted({0.0, self.duration_s} | {edge for edge in ends if edge < self.duration_s})
        phases: list[Phase] = []
        for start, end in itertools.pairwise(edges):
            gnss, rsbn = on(self.gnss_outages, start), bool(self.beacons) and on(self.rsbn_outages, start)
            name = {(True, True): "GNSS+RSBN", (True, False): "GNSS only", (False, True): "RSBN only"}.get(
                (gnss, rsbn), "neither"
            )
            if phases and phases[-1].name == name:
                phases[-1] = phases[-1]._replace(end_s=end)
            else:
                phases.append(Phase(name, start, end))
        return phases


# About 42 min out to 90 km and some of the way back, at 34 to 42 m/s.
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
_BACK = (Leg(540, 215, 40, 800), Leg(540, 240, 40, 600))  # to make it an hour
_SHORT = (
    Leg(10, 40, 0, 0),
    Leg(50, 40, 38, 0),
    Leg(120, 40, 38, 120),
    Leg(60, 100, 36, 120),
    Leg(60, 30, 38, 120),
)
_WINDS = (Wind(0, 4, 5), Wind(1200, 1, 8, 240.0))
#: 60 km from the start on the right hand, and further on at the left.
_EAST = Beacon(1, 60.05, 31.07)
_NORTH = Beacon(2, 60.75, 30.25)
_PLAN = Plan(_LEGS, winds=_WINDS)

DEFAULT = Scenario(
    "default",
    _PLAN,
    beacons=(_EAST,),
    gnss_outages=((1500.0, 2220.0),),
    rsbn_outages=((900.0, 1500.0), (1920.0, 2220.0)),
)
_SHORT_SCENARIO = Scenario(
    "short",
    Plan(_SHORT, winds=(Wind(0, 4, 5),)),
    beacons=(_EAST,),
    gnss_outages=((180.0, 270.0),),
    rsbn_outages=((120.0, 180.0), (225.0, 270.0)),
)


def _tabled(name: str, **changes: Any) -> Scenario:
    return dataclasses.replace(DEFAULT, name=name, **changes)


SCENARIOS: dict[str, Scenario] = {
    scenario.name: scenario
    for scenario in (
        DEFAULT,
        _SHORT_SCENARIO,
        _tabled("gnss-loss", gnss_outages=((900.0, math.inf),), rsbn_outages=((0.0, math.inf),)),
        _tabled("hour", plan=dataclasses.replace(_PLAN, legs=(*_LEGS, *_BACK))),
        _tabled("tactical", grade="tactical"),
        _tabled("mems", grade="mems"),
        _tabled("two-beacons", beacons=(_EAST, _NORTH)),
        _tabled("no-beacon", beacons=(), rsbn_outages=()),
        _tabled(
            "wind-change",
            # The wind turns by 90 degrees and grows twofold the moment GNSS is lost.
            plan=dataclasses.replace(_PLAN, winds=(Wind(0, 5, 0), Wind(900, 0, 10, 20.0))),
            gnss_outages=((900.0, 1500.0),),
            rsbn_outages=((900.0, 1500.0),),
        ),
        _tabled(
            "ten-outages",
            gnss_outages=tuple((300.0 + 210.0 * i, 360.0 + 210.0 * i) for i in range(10)),
            rsbn_outages=tuple((330.0 + 210.0 * i, 360.0 + 210.0 * i) for i in range(10)),
        ),
        _tabled("spoof", gnss_outages=(), rsbn_outages=(), faults=(Fault("gnss-spoof", 1200.0, 1800.0),)),
        _tabled(
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


def named(name: str, **changes: Any) -> Scenario:
    """The scenario of this name, with fields changed. ValueError for an unknown name, naming the nearest."""
    scenario = SCENARIOS.get(name)
    if scenario is None:
        near = difflib.get_close_matches(name, SCENARIOS, 1)
        hint = f"did you mean {near[0]}?" if near else f"choose one of {', '.join(SCENARIOS)}"
        raise ValueError(f"no scenario is called {name!r}: {hint}")
    return dataclasses.replace(scenario, **changes)
