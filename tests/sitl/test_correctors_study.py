"""Correctors in flight: an INS without GNSS claims less with each, and the claim holds."""

from __future__ import annotations

import dataclasses

import pytest

from sitl.correctors_study import CorrectedFlight, fly
from sitl.scenarios import SensorRates, get_scenario
from sitl.world import World

SLOW = SensorRates(imu=1.0, local_position=5.0, attitude=5.0, gnss=1.0, air=5.0, truth=1.0)
LOST = (200.0, 300.0)


@pytest.fixture(scope="module")
def flights() -> dict[str, CorrectedFlight]:
    short = get_scenario("short", gnss_outages=((120.0, 1e9),), beacons=(), rates=SLOW)
    world = World(dataclasses.replace(short, grade="mems"))
    return {name: fly(world, name, 1, bank=False) for name in ("none", "hyperbolic", "airspeed", "stars")}


@pytest.mark.parametrize("name", ["hyperbolic", "airspeed", "stars"])
def test_corrected_ins_claims_less_and_keeps_it(flights: dict[str, CorrectedFlight], name: str) -> None:
    alone, corrected = flights["none"], flights[name]
    assert corrected.at(corrected.sigma, *LOST) < alone.at(alone.sigma, *LOST)
    assert corrected.at(corrected.error, *LOST) < 2.0 * corrected.at(corrected.sigma, *LOST)
