"""The simulated autopilot takes our positions: no harm with a healthy GNSS, a wind step held without it."""

import dataclasses

import pytest

from companion.config import Config, OutputConfig
from companion.records import Event
from sitl import loopback
from sitl.beacon import Beacon
from sitl.faults import Fault
from sitl.flight import FlightPlan, Leg, WindChange
from sitl.scenarios import Scenario

FEEDS = Config(output=OutputConfig(profile="ardupilot"))
FREE_M = 2.0
LEGS = (Leg(10, 40, 0, 0), Leg(50, 40, 38, 0), Leg(60, 40, 38, 60), Leg(60, 110, 38, 60))
HEALTHY = Scenario(
    "healthy",
    FlightPlan(LEGS, winds=(WindChange(0, 4, 5),)),
    beacons=(Beacon(1, 60.05, 31.07),),
    own_estimate=True,
)


def fly(scenario: Scenario) -> loopback.LoopbackFlight:
    return loopback.fly_scenario(scenario, FEEDS)


def selected_sets(flown: loopback.LoopbackFlight) -> list[str]:
    return [
        r.text[:16] for r in flown.records if isinstance(r, Event) and r.text.startswith("EKF source set")
    ]


@pytest.mark.flight
@pytest.mark.parametrize(
    "fault",
    [
        pytest.param(None, id="nothing"),
        pytest.param(Fault("pitot-stuck", 90.0, size=8.0), id="pitot-stuck 8"),
        pytest.param(Fault("pitot-stuck", 90.0, size=0.0), id="pitot-stuck 0", marks=pytest.mark.long),
        pytest.param(Fault("beacon-bias", 90.0, size=200.0), id="beacon-bias 200"),
    ],
)
def test_no_harm_while_gnss_is_healthy(fault) -> None:
    flown = fly(dataclasses.replace(HEALTHY, faults=() if fault is None else (fault,)))
    assert selected_sets(flown) == ["EKF source set 1"]
    for row in loopback.own_table(flown.autopilot):
        assert row.most <= row.most_alone + FREE_M


@pytest.mark.flight
def test_wind_step_without_gnss_is_held() -> None:
    """The wind turns by 9 m/s as GNSS is lost; the beacon is 60 km away."""
    legs = (*LEGS[:3], Leg(60, 110, 38, 60), Leg(100, 110, 38, 60), Leg(30, 110, 38, 60))
    flown = fly(
        dataclasses.replace(
            HEALTHY,
            plan=FlightPlan(legs, winds=(WindChange(0, -5, 0), WindChange(160, -7, -9, 4.0))),
            gnss_outages=((160.0, 280.0),),
        )
    )
    assert selected_sets(flown) == ["EKF source set 1", "EKF source set 2", "EKF source set 1"]
    lost, back = loopback.own_table(flown.autopilot)[1:]
    assert lost.most_alone > 800.0
    assert lost.rms < 0.15 * lost.rms_alone
    assert flown.autopilot.estimate is not None
    end = flown.autopilot.scenario.duration_s
    assert flown.autopilot.estimate.errors.between(end - 10.0, end)[1] < 5.0
    assert back.phase == "GNSS+RSBN"


def test_table_is_printed_where_an_ardupilot_is_fed() -> None:
    assert loopback.simulated_for(HEALTHY, FEEDS).own_estimate
    plain = dataclasses.replace(HEALTHY, own_estimate=False)
    assert loopback.simulated_for(plain, FEEDS).own_estimate
    assert not loopback.simulated_for(plain, Config()).own_estimate
