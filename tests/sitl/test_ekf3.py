"""The reduced filter of ArduPilot: against what the real one did, and its rules one by one."""

import copy
import dataclasses
import math

import numpy as np
import pytest

from companion.link import dialect
from companion.records import LocalOrigin
from companion.units import SECOND_NS
from sitl.ekf3 import GNSS_SET, OUTSIDE_SET, AirSample, Ekf3
from sitl.flight import FlightPlan, Leg, WindChange
from sitl.own_estimate import OwnEstimate, unaided_errors
from sitl.positions import position_of
from sitl.scenarios import Scenario
from sitl.world import World

LOST_S = 180.0
ORIGIN = LocalOrigin(0, 0, 1.0, 0.6, 100.0)


def straight_flight(wind, wind_then, seed=1):
    """East at 25 m/s; GNSS is lost after 180 s and the wind changes then."""
    legs = (Leg(10, 90, 0, 0), Leg(50, 90, 25, 0), Leg(120, 90, 25, 150), Leg(190, 90, 25, 150))
    winds = (WindChange(0, *wind), WindChange(LOST_S, *wind_then, 4.0))
    outage = ((LOST_S, math.inf),)
    return Scenario("straight", FlightPlan(legs, winds=winds), gnss_outages=outage, seed=seed)


@pytest.fixture(scope="module")
def wind_step() -> World:
    """The wind steps from 5 to 10 m/s and turns by 45 degrees as GNSS is lost."""
    return World(straight_flight((-5.0, 0.0), (-7.07, -7.07)))


def test_it_drifts_by_the_wind_as_the_real_one_did(wind_step: World) -> None:
    """Without aid ArduPlane 4.7-dev was 197, 410, 835 and 1266 m off after 30, 60, 120, 180 s."""
    errors = unaided_errors(wind_step)
    for after, real in ((30.0, 197.0), (60.0, 410.0), (120.0, 835.0), (180.0, 1266.0)):
        assert errors.between(LOST_S + after, LOST_S + after + 0.2)[1] == pytest.approx(real, rel=0.15)


def test_constant_wind_is_estimated_before(wind_step: World) -> None:
    """The real one was 11 m off after 180 s without wind, 103 m with 10 m/s."""
    calm = unaided_errors(World(straight_flight((0.0, 0.0), (0.0, 0.0)))).between(LOST_S, 400.0)[1]
    windy = unaided_errors(World(straight_flight((-10.0, 0.0), (-10.0, 0.0)))).between(LOST_S, 400.0)[1]
    assert max(calm, windy) < 110.0


def odometry(x, y, variance=20.0**2 / 3.0, resets=0):
    covariance = [0.0] * 21
    covariance[0] = covariance[6] = covariance[11] = variance
    return dialect.new(
        "ODOMETRY", x=x, y=y, z=0.0, pose_covariance=covariance, reset_counter=resets, frame_id=20
    )


@pytest.fixture(scope="module")
def until_the_loss(wind_step: World) -> OwnEstimate:
    """The autopilot's filter as GNSS is lost."""
    own = OwnEstimate(wind_step, (4, 7))
    own.advance(round(LOST_S * SECOND_NS))
    return own


def fed(world, until_the_loss, offset_m=(0.0, 0.0), seed=3) -> OwnEstimate:
    """Feed the true position with white noise and an offset at 10 Hz on source set 2 from the loss on."""
    own, rng = copy.deepcopy(until_the_loss, {id(world): world}), np.random.default_rng(seed)
    origin = world.origin
    start = LocalOrigin(0, 0, origin.lat, origin.lon, origin.alt)
    own.filter.select(OUTSIDE_SET)
    for k in range(round(LOST_S * 10) + 1, round(world.scenario.duration_s * 10)):
        t_ns = k * SECOND_NS // 10
        x, y = own.truth_n[k - 1] + offset_m + 20.0 * rng.standard_normal(2)
        own.receive(odometry(x, y), start, t_ns)
        own.advance(t_ns)
    return own


def test_a_noisy_position_holds_it_as_the_real_one(wind_step: World, until_the_loss: OwnEstimate) -> None:
    """20 m white at 10 Hz held ArduPlane at 10 m r.m.s. in the same wind step, one flight.

    The first position is taken as it is, so that flights differ by it: eight pooled, within a factor of two.
    """
    flights = [fed(wind_step, until_the_loss, seed=seed).errors for seed in range(8)]
    rms = [errors.between(LOST_S, 400.0)[0] for errors in flights]
    assert 5.0 < math.hypot(*rms) / math.sqrt(8.0) < 20.0


def test_harm_shows(wind_step: World, until_the_loss: OwnEstimate) -> None:
    """A false position on source set 2 takes the aircraft's own position away."""
    rms, _ = fed(wind_step, until_the_loss, offset_m=(100.0, 0.0)).errors.between(LOST_S + 60.0, 400.0)
    assert rms == pytest.approx(100.0, abs=10.0)


def flying(seconds=60.0):
    """A filter that flies east at 25 m/s with GNSS."""
    ekf, t = Ekf3(), 0.0
    ekf.x[3] = 25.0
    while t < seconds:
        t += 0.1
        ekf.propagate(np.zeros(2), 0.1, t, 0.0, True)
        ekf.fuse_air(AirSample(25.0, math.pi / 2), t)
        ekf.fuse_gnss(np.array([0.0, 25.0 * t]), np.array([0.0, 25.0]), t)
    return ekf, t


def test_positions_of_the_other_source_set_are_ignored() -> None:
    ekf, t = flying()
    before = ekf.x.copy()
    ekf.fuse_outside(np.array([500.0, 0.0]), 1.0, 0, t)
    assert ekf.x == pytest.approx(before)
    ekf.select(OUTSIDE_SET)
    ekf.fuse_gnss(np.array([500.0, 0.0]), None, t)
    assert ekf.x == pytest.approx(before)


def test_new_set_and_reset_counter_set_the_position_and_a_far_one_is_rejected() -> None:
    ekf, t = flying()
    ekf.select(OUTSIDE_SET)
    ekf.fuse_outside(np.array([30.0, 25.0 * t]), 20.0, 0, t)
    assert ekf.x[0] == pytest.approx(30.0)
    ekf.fuse_outside(np.array([900.0, 25.0 * t]), 20.0, 0, t)
    assert ekf.x[0] == pytest.approx(30.0)
    ekf.fuse_outside(np.array([900.0, 25.0 * t]), 20.0, 1, t)
    assert ekf.x[0] == pytest.approx(900.0)
    ekf.select(GNSS_SET)
    ekf.fuse_gnss(np.array([0.0, 25.0 * t]), np.array([0.0, 25.0]), t)
    assert ekf.x[0] == pytest.approx(0.0)


def test_position_rejected_for_ten_seconds_is_taken() -> None:
    ekf, t = flying()
    taken_s = None
    for _ in range(150):
        t += 0.1
        ekf.propagate(np.zeros(2), 0.1, t, 0.0, True)
        ekf.fuse_air(AirSample(25.0, math.pi / 2), t)
        ekf.fuse_gnss(np.array([900.0, 25.0 * t]), None, t)
        if taken_s is None and ekf.x[0] > 800.0:
            taken_s = t - 60.0
    assert taken_s == pytest.approx(10.1, abs=0.2)


@pytest.mark.parametrize(("version", "sigma"), [((4, 6), 20.0), ((4, 7), 20.0)])
def test_accuracy_is_read_by_the_rule_of_the_version(version, sigma) -> None:
    variance = sigma**2 / 3.0 if version >= (4, 7) else math.sqrt(sigma**3 / 3.0)
    reported = position_of(odometry(1.0, 2.0, variance), ORIGIN, "ardupilot", version)
    assert reported is not None and reported.sigma == pytest.approx(sigma)


def test_filter_of_px4_is_not_simulated() -> None:
    scenario = straight_flight((0.0, 0.0), (0.0, 0.0))
    with pytest.raises(ValueError, match="px4 is not simulated"):
        dataclasses.replace(scenario, autopilot="px4", own_estimate=True)
