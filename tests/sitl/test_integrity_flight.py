"""Integrity of flights: a fault of GNSS, beacon or INS does no harm; air data, one beacon by default."""

from __future__ import annotations

import dataclasses
import functools
import math

import pytest

from companion.config import Config, InertialConfig
from companion.navigator import Navigator
from companion.records import Solution
from companion.units import SECOND_NS
from sitl import loopback
from sitl.campaign import flight
from sitl.campaign.flight import SCENARIOS, FlightOrder, FlightResult, fly_order
from sitl.faults import Fault
from sitl.world import World

pytestmark = pytest.mark.flight
HARMLESS_M = 300.0


def flown(fault: str, seed: int = 1) -> FlightResult:
    result = fly_order(FlightOrder("air-data", fault, seed))
    assert result.raised is None
    assert (result.alarms, result.wrong) == (0, 0)
    assert result.misleading_s == 0.0
    return result


def flown_within_its_level(scenario: str, fault: str, seed: int = 1) -> FlightResult:
    result = fly_order(FlightOrder(scenario, fault, seed))
    assert result.raised is None
    assert (result.misleading_s, result.beyond_s) == (0.0, 0.0)
    return result


@pytest.mark.parametrize(
    ("fault", "seed"), [pytest.param("gnss-spoof-2", 1, marks=pytest.mark.long), ("gnss-spoof-5", 1)]
)
def test_spoofed_gnss_is_excluded_and_readmitted(fault: str, seed: int) -> None:
    result = flown(fault, seed)
    assert result.excluded_s is not None
    assert result.largest_m < HARMLESS_M
    assert result.beyond_s == 0.0
    assert result.last_m < 10.0  # by GNSS again


@pytest.mark.long
def test_slow_spoofing_beside_one_beacon_stays_within_the_protection_level() -> None:
    """0.5 m/s for 4 min cannot be separated from wind with certainty: no worse than GNSS alone."""
    result = flown("gnss-spoof-0.5")
    assert result.largest_m < 0.5 * 240.0 + 5.0  # the lie, and three sigma of an honest fix
    assert result.beyond_s == 0.0
    assert result.last_m < 10.0


@pytest.mark.long
def test_an_onset_without_evidence_is_within_the_protection_level() -> None:
    """0.5 m/s beside a stock autopilot and one beacon: at a risk of 1e-7 beyond it for up to 30 s."""
    flown_within_its_level("stock", "gnss-spoof-0.5", 5)


@pytest.mark.long
@pytest.mark.parametrize("scenario", ["mems", "air-data", "stock"])
def test_gnss_that_is_false_from_the_first_fix_stays_within_the_protection_level(scenario: str) -> None:
    """By 450 m, until 540 s: a beacon at a wrong place looks the same and is likelier; both are possible."""
    result = flown_within_its_level(scenario, "gnss-first-450")
    assert result.last_m < 10.0  # by the honest GNSS again


@pytest.mark.long
@pytest.mark.parametrize("fault", ["beacon-bias-300", "beacon-multipath"])
def test_faulty_beacon_does_not_exclude_gnss(fault: str) -> None:
    result = flown(fault, 3)
    assert result.detected_s is not None and result.detected_s < 15.0
    assert result.largest_m < 10.0


@pytest.mark.long
def test_air_data_alone_do_not_exclude_gnss_and_beacon() -> None:
    assert flown("airspeed-icing").largest_m < HARMLESS_M


def test_guaranteed_bound_does_not_use_suspected_sources() -> None:
    """All fixes stop before the spoofed GNSS is excluded: the bound still holds."""
    fault = flight.FAULT_CASES["gnss-spoof-5"].fault
    assert fault is not None
    spoofed = dataclasses.replace(
        SCENARIOS["air-data"],
        seed=1,
        faults=(fault,),
        gnss_outages=((338.0, 420.0),),
        rsbn_outages=((338.0, 420.0),),
    )
    config = loopback.simulator_config(Config(inertial=InertialConfig(source="air_data")))
    world, outputs = flight.fly_records(spoofed, config)
    result = flight.score_flight(FlightOrder("air-data", "gnss-spoof-5", 1), world, outputs)
    assert result.rms_error is not None and result.rms_bound is not None
    assert result.rms_error <= result.rms_bound
    assert result.misleading_s == 0.0


def test_a_beacon_that_answered_before_gnss_does_not_make_the_sigma_of_a_spoofed_flight_greater() -> None:
    """It cannot exclude that GNSS was off by 60 m from its first fix on: 15 m of sigma, and PX4 lagged."""
    spoof = Fault("gnss-spoof", 100.0, 540.0, 2.0)
    spoofed = dataclasses.replace(SCENARIOS["stock"], seed=1, faults=(spoof,), gnss_outages=((0.0, 15.0),))
    config = flight.config_of("stock")
    navigator, found = Navigator(config), list[Solution]()
    for record in World(spoofed).records(flight.sensors_of(config)):
        if record.t_ns > 112 * SECOND_NS:
            break
        found += [out for out in navigator.handle(record) if isinstance(out, Solution)]
        navigator.settle()
    assert found[-1].gnss_false is not None and found[-1].gnss_false > 0.999
    assert math.sqrt(max(found[-1].covariance[0], found[-1].covariance[3])) < 7.0


@pytest.mark.long
@pytest.mark.parametrize("scenario", ["one-beacon", "two-beacons", "mems"])
def test_ins_that_drifts_does_not_exclude_gnss_and_beacons_for_ever(scenario: str) -> None:
    """1 m/s for 4 min: GNSS looks drawn off until the beacons contradict (236 m and no end before)."""
    result = flown_within_its_level(scenario, "ins-drift")
    assert result.largest_m < 120.0
    assert result.last_m < 10.0  # by GNSS again


@functools.cache
def drawn_off_gently(scenario: str) -> FlightResult:
    """At 0.003 m/s^2; it ends at 87 m."""
    return fly_order(FlightOrder(scenario, "gnss-accelerate", 1))


@pytest.mark.long
@pytest.mark.parametrize("scenario", ["one-beacon", "two-beacons"])
def test_gnss_that_is_drawn_off_gently_is_found_beside_an_ins(scenario: str) -> None:
    """It was taken for a coarser INS, and excluded once it was honest again."""
    result = drawn_off_gently(scenario)
    assert result.raised is None
    assert result.excluded_s is not None
    assert (result.misleading_s, result.beyond_s) == (0.0, 0.0)
    assert result.last_m < 10.0


#: 57 m before the lasting velocity error of GNSS was a state, without which a healthy one is excluded.
NOT_REACHED = pytest.mark.xfail(strict=True, raises=AssertionError, reason="78 m: docs/limits.md")


@pytest.mark.long
@pytest.mark.parametrize("scenario", [pytest.param("one-beacon", marks=NOT_REACHED), "two-beacons"])
def test_gnss_that_is_drawn_off_gently_is_found_within_60_m(scenario: str) -> None:
    assert drawn_off_gently(scenario).largest_m < 60.0


@pytest.mark.long
@pytest.mark.parametrize("scenario", ["tactical", "mems"])
def test_gnss_that_drew_an_ins_off_unnoticed_is_believed_once_it_is_true_again(scenario: str) -> None:
    """It was excluded as it returned by 87 m, then the beacon too: 232 m off beyond a level of 63 m."""
    result = flown_within_its_level(scenario, "gnss-accelerate")
    assert result.largest_m < 100.0
    assert result.last_m < 10.0


@pytest.mark.long
def test_onsets_of_a_slow_lie_are_kept() -> None:
    """A GNSS that is drawn off at 0.5 m/s without an INS: it looks like a change of wind for three minutes.

    About half of such flights show it within four minutes, by the noise; the others stay within the level.
    """
    result = flown_within_its_level("stock", "gnss-spoof-0.5")
    assert result.detected_s is not None
    assert result.normal_m < 130.0
