import itertools

import numpy as np
import pytest

from companion.nav.geometry import Geodetic, local_to_geodetic, separation
from companion.records import AirData, Attitude, Gnss, Imu, LocalPosition, RsbnFix, Truth
from sitl.faults import Fault
from sitl.scenarios import SCENARIOS, Scenario, SensorRates, get_scenario
from sitl.world import World


@pytest.fixture(scope="module")
def short():
    return World(get_scenario("short"))


@pytest.mark.parametrize("name", SCENARIOS)
def test_phases_cover_the_flight_without_gap(name):
    scenario = get_scenario(name)
    phases = scenario.phases()
    assert phases[0].start_s == 0.0 and phases[-1].end_s == scenario.duration_s
    assert all(a.end_s == b.start_s and a.name != b.name for a, b in itertools.pairwise(phases))


def test_the_default_scenario_has_all_four_phases():
    phases = {phase.name: phase for phase in get_scenario("default").phases()[:4]}
    assert set(phases) == {"GNSS+RSBN", "GNSS only", "RSBN only", "neither"}
    assert phases["neither"].end_s - phases["neither"].start_s == 300.0
    assert get_scenario("default").duration_s >= 2400.0
    assert len([p for p in get_scenario("ten-outages").phases() if p.name == "neither"]) == 10


def test_streams_have_their_rates_and_order(short):
    duration, rates = short.scenario.duration_s, SensorRates()
    for kind, rate in (
        (Imu, rates.imu),
        (LocalPosition, 10.0),
        (Gnss, 5.0),
        (AirData, 10.0),
        (Attitude, 10.0),
    ):
        stream = short.streams[kind]
        assert len(stream) == duration * rate + 1
        assert all(a.rx_ns <= b.rx_ns for a, b in itertools.pairwise(stream))


def test_outages_follow_the_schedule(short):
    for phase in short.scenario.phases():
        inside = [f for f in short.streams[Gnss] if phase.start_s <= f.t_ns * 1e-9 < phase.end_s]
        assert {f.fix for f in inside} == ({3} if "GNSS" in phase.name else {1})
        answers = [f for f in short.streams[RsbnFix] if phase.start_s <= f.t_ns * 1e-9 < phase.end_s]
        assert bool(answers) == ("RSBN" in phase.name)


def test_local_position_is_truth_plus_inertial_error(short):
    for local, true in list(zip(short.streams[LocalPosition], short.streams[Truth]))[::400]:
        place = local_to_geodetic("ardupilot", short.origin, np.array(local.x_n))
        error = separation(place, Geodetic(true.lat, true.lon, true.alt))
        t = true.t_ns * 1e-9
        expected = [np.interp(t, short.inertial_error.t, short.inertial_error.x_n[:, i]) for i in range(3)]
        assert error == pytest.approx(expected, abs=0.02)


def test_records_depend_on_the_seed(short):
    repeated = World(get_scenario("short"))
    assert repeated.streams == short.streams
    other = World(get_scenario("short", seed=2))
    assert other.streams[Gnss] != short.streams[Gnss]
    assert other.streams[Truth] == short.streams[Truth]


def test_record_fault_changes_only_its_stream(short):
    bad = World(get_scenario("short", faults=(Fault("gnss-jump", 60.0, 90.0),)))
    changed = [kind for kind in short.streams if bad.streams[kind] != short.streams[kind]]
    assert changed == [Gnss]


def test_invalid_scenarios_are_rejected():
    with pytest.raises(ValueError, match="did you mean default"):
        get_scenario("defualt")
    with pytest.raises(ValueError, match="grade"):
        get_scenario("default", grade="marine")
    with pytest.raises(ValueError, match="end after its start"):
        get_scenario("default", gnss_outages=((5.0, 1.0),))
    with pytest.raises(ValueError, match="rate"):
        Scenario("x", get_scenario("short").plan, rates=SensorRates(gnss=0.0))
