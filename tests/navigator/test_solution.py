"""What a solution claims of itself, on whole simulated flights."""

from __future__ import annotations

import dataclasses

import numpy as np

from companion.config import load
from companion.records import Solution
from sitl.campaign.flight import fly_records
from sitl.scenarios import get_scenario


def test_the_velocity_by_air_data_is_as_good_as_claimed_in_gusts() -> None:
    """A gust is no state: airspeed and heading follow it at once, the wind does not."""
    scenario = dataclasses.replace(
        get_scenario("short"), gnss_outages=(), rsbn_outages=(), beacons=(), seed=2
    )
    config = load(flags={"inertial.source": "air_data"}, environment={})
    world, told = fly_records(scenario, config)
    solutions = [out for out in told if isinstance(out, Solution) and out.t_ns > 80e9]
    truth = world.truth_at(np.array([s.t_ns * 1e-9 for s in solutions])).v_n
    claimed = np.array([s.sigma_velocity for s in solutions])
    error = np.abs(np.array([s.v_n for s in solutions]) - truth)[:, :2].max(axis=1)
    assert len(solutions) > 100
    assert np.mean(error > 3.0 * claimed) < 0.01
    assert np.median(claimed) < 2.0 * np.sqrt(np.mean(error**2))  # nor is nothing claimed
