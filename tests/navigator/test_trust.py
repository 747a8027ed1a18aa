"""The watch over the sources on whole simulated flights: INS, GNSS and one beacon 60 km away."""

from __future__ import annotations

import dataclasses
import math
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
import pytest

from companion.config import Config, InertialConfig
from companion.records import Event, Rejection, Solution, Source, Trust
from sitl.beacon import Beacon
from sitl.campaign.flight import SCENARIOS, fly_records, horizontal_errors
from sitl.faults import Fault
from sitl.flight import FlightPlan, Leg, WindChange

NS = 1_000_000_000
START, END = 300.0, 540.0
ALERT_M = 300.0


class Flown(NamedTuple):
    """Solutions with their times (s), errors and protection levels (m); all else that was told."""

    solutions: list[Solution]
    t: Any
    error: Any
    level: Any
    told: list[Any]

    def exclusions(self) -> list[tuple[float, str]]:
        return [
            (r.t_ns / NS, r.source) for r in self.told if isinstance(r, Rejection) and "excluded:" in r.reason
        ]

    def returns(self) -> list[float]:
        return [r.t_ns / NS for r in self.told if isinstance(r, Event) and "heard again" in r.text]

    def trust(self, start: float, end: float) -> set[Trust | None]:
        return {s.trust for s, t in zip(self.solutions, self.t, strict=True) if start <= t < end}

    def worst(self, start: float = 60.0, end: float = math.inf) -> float:
        return float(self.error[(self.t >= start) & (self.t < end)].max())

    def beyond(self) -> int:
        return int((self.error > self.level)[self.t >= 60.0].sum())


@lru_cache(maxsize=32)
def flown(name: str, size: float | None = None, seed: int = 1, **changes: Any) -> Flown:
    faults = (Fault(name, START, END, size),) if name else ()
    scenario = dataclasses.replace(SCENARIOS["one-beacon"], faults=faults, seed=seed, **changes)
    world, told = fly_records(scenario, Config(inertial=InertialConfig(independent=True)))
    solutions = [r for r in told if isinstance(r, Solution) and r.protection is not None]
    t = np.array([s.t_ns / NS for s in solutions])
    level = np.array([s.protection for s in solutions])
    return Flown(solutions, t, horizontal_errors(world, solutions, t), level, told)


def test_an_hour_without_a_fault_raises_no_alarm_and_trust_stays_normal() -> None:
    legs = [Leg(10, 40, 0, 0), Leg(50, 40, 38, 0), *(Leg(590, 40 + 180 * (k % 2), 38, 400) for k in range(6))]
    hour = flown("", plan=FlightPlan(tuple(legs), winds=(WindChange(0, 4, 5),)))
    assert hour.t[-1] >= 3590.0
    assert hour.exclusions() == []
    assert [r for r in hour.told if isinstance(r, Rejection)] == []
    assert hour.trust(60.0, math.inf) == {Trust.NORMAL}
    assert hour.beyond() == 0
    assert hour.level[hour.t > 60.0].max() < 500.0


@pytest.mark.parametrize("slope", [0.5, 2.0, 5.0])
def test_a_spoofer_is_excluded_at_once_and_taken_back_when_he_has_left(slope: float) -> None:
    flight = flown("gnss-spoof", slope)
    (when, source), *others = flight.exclusions()
    assert source == "gnss"
    assert others == []
    assert START < when < START + 60.0
    assert flight.worst(START, when) < 30.0
    assert flight.worst() < ALERT_M
    assert flight.beyond() == 0
    assert flight.trust(when + 1.0, END) == {Trust.DEGRADED}
    assert all(
        not s.sources & Source.GNSS for s, t in zip(flight.solutions, flight.t, strict=True) if when < t < END
    )
    (back,) = flight.returns()
    assert END + Config().integrity.settle_s <= back < END + 75.0
    assert flight.trust(back + 20.0, math.inf) == {Trust.NORMAL}
    assert flight.worst(back + 20.0) < 10.0


@pytest.mark.parametrize(
    "name, size, source",
    [
        ("gnss-jump", 50.0, "gnss"),
        ("gnss-jump", 500.0, "gnss"),
        ("beacon-bias", 300.0, "rsbn 1 range"),
        ("beacon-bias", 1000.0, "rsbn 1 range"),
        ("beacon-north", math.radians(0.3), "rsbn 1 azimuth"),
        ("beacon-north", math.radians(2.0), "rsbn 1 azimuth"),
    ],
)
def test_the_faulty_one_is_named_azimuth_and_range_apart(name: str, size: float, source: str) -> None:
    flight = flown(name, size)
    assert {found for _, found in flight.exclusions()} == {source}
    assert START < flight.exclusions()[0][0] < END
    assert flight.worst() < 30.0
    assert flight.beyond() == 0


def test_every_exclusion_is_told_with_its_numbers() -> None:
    told = flown("gnss-spoof", 0.5).told
    (record,) = [r for r in told if isinstance(r, Rejection) and r.reason.startswith("excluded:")]
    assert record.value is not None
    assert record.limit is not None
    assert record.value > record.limit
    (line,) = [r.text for r in told if isinstance(r, Event) and " excluded (" in r.text]
    assert line.startswith("gnss excluded (separation ")
    refused = [r for r in told if isinstance(r, Rejection) and r.source == "gnss 0"]
    assert len(refused) > 100
    assert {r.reason for r in refused} == {"excluded; its distance from the guaranteed prediction"}


def test_a_beacons_bias_and_north_are_learnt_while_gnss_is_trusted_and_used_afterwards() -> None:
    """A beacon 120 m long and turned by 0.15 degrees, which are 157 m here; GNSS ends after ten minutes."""
    good = SCENARIOS["one-beacon"].beacons[0]
    crooked: Beacon = dataclasses.replace(good, bias_range=120.0, north_deg=0.15)
    legs = (Leg(10, 40, 0, 0), Leg(50, 40, 38, 0), Leg(1140, 40, 38, 400))
    flight = flown("", plan=FlightPlan(legs), beacons=(crooked,), gnss_outages=((600.0, 1e9),))
    assert {found for _, found in flight.exclusions()} <= {"rsbn 1 azimuth"}
    assert flight.worst(620.0) < 60.0
    assert flight.beyond() == 0
