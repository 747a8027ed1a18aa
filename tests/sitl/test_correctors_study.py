"""Correctors in flight: an INS without GNSS claims less with each and keeps it; a false one does no harm."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from msgspec import structs

from sitl.correctors import Aircraft, second_positions
from sitl.correctors_study import CorrectedFlight, fly
from sitl.scenarios import SensorRates, get_scenario
from sitl.sensors import GRADES
from sitl.world import World

pytestmark = pytest.mark.flight
SLOW = SensorRates(imu=1.0, local_position=5.0, attitude=5.0, gnss=1.0, air=5.0, truth=1.0)
LOST = (200.0, 300.0)
NAMES = ("hyperbolic", "airspeed", "stars", "second_ins")


@pytest.fixture(scope="module")
def flights() -> dict[str, CorrectedFlight]:
    short = get_scenario("short", gnss_outages=((120.0, 1e9),), beacons=(), rates=SLOW)
    return {
        name: fly(
            World(dataclasses.replace(short, grade="mems", correctors=(name,) * (name != "none"))), False
        )
        for name in ("none", *NAMES)
    }


@pytest.mark.parametrize("name", NAMES)
def test_corrected_ins_claims_less_and_keeps_it(flights: dict[str, CorrectedFlight], name: str) -> None:
    alone, corrected = flights["none"], flights[name]
    assert corrected.at(corrected.sigma, *LOST) < alone.at(alone.sigma, *LOST)
    assert corrected.at(corrected.error, *LOST) < 2.0 * corrected.at(corrected.sigma, *LOST)


@pytest.mark.parametrize("fault", ["coarser", "step"])
def test_false_second_ins_takes_nobody_off_gnss(fault: str) -> None:
    """It is a MEMS unit beside one of navigation grade, or its velocity steps by 2 m/s."""
    world = World(get_scenario("short", gnss_outages=(), beacons=(), rates=SLOW, correctors=("second_ins",)))
    if fault == "coarser":
        aircraft = Aircraft(world.flight, world.inertial_error, GRADES["mems"])
        world.corrections = list(second_positions(aircraft, np.random.default_rng(9)))
    else:
        world.corrections = [
            structs.replace(r, lat=r.lat + 2.0 / 6.37e6 * max(0.0, r.t_ns * 1e-9 - 150.0))  # type: ignore[attr-defined]
            for r in world.corrections
        ]
    flight = fly(world)
    assert flight.at(flight.error, 60.0, 270.0) < 3.0
    assert (flight.error <= flight.protection).all()
