import dataclasses
import math

import numpy as np
import pytest

from companion.nav.geometry import Geodetic, radio_horizon, slant_range_azimuth
from sitl.beacon import Beacon, azimuth_range_elevation, in_reach, simulate_answers
from sitl.flight import fly_plan
from sitl.scenarios import get_scenario

BEACON = Beacon(1, 60.05, 31.07, azimuth_step_deg=0.0, range_step=0.0, drop_out=0.0)


@pytest.fixture(scope="module")
def flight():
    return fly_plan(get_scenario("default").plan).at(np.arange(0.0, 2520.0, 1.0))


def at_distance(flight, beacon, lon_deg, alt):
    """First rows of the flight, moved to other longitudes at the beacon's latitude."""
    n = len(lon_deg)
    values = {name: getattr(flight, name)[:n] for name in flight._fields}
    values |= {"lat": np.full(n, math.radians(beacon.lat_deg)), "lon": np.radians(lon_deg)}
    return type(flight)(**(values | {"alt": np.full(n, alt)}))


def test_azimuth_range_elevation_agree_with_nav_geometry(flight):
    ground = Geodetic(math.radians(BEACON.lat_deg), math.radians(BEACON.lon_deg), BEACON.alt)
    azimuth, slant, elevation = azimuth_range_elevation(BEACON, flight)
    for k in range(0, len(flight.t), 250):
        expected = slant_range_azimuth(ground, Geodetic(flight.lat[k], flight.lon[k], flight.alt[k]))
        assert (azimuth[k], slant[k], elevation[k]) == pytest.approx(expected, rel=1e-9)


def test_errors_have_the_stated_sigmas(flight):
    azimuth, slant, _ = azimuth_range_elevation(BEACON, flight)
    a, d, s = [], [], []
    for seed in range(10):
        for fix in simulate_answers(BEACON, flight, np.random.default_rng(seed)):
            k = round(fix.t_ns * 1e-9)
            a.append(math.remainder(fix.azimuth - azimuth[k], math.tau))
            d.append((fix.slant_range - slant[k]) / fix.sigma_range)
            s.append(fix.sigma_range - (100.0 + 1.5e-4 * slant[k]))
            assert fix.rx_ns - fix.t_ns == 150_000_000
    assert np.std(a) == pytest.approx(math.radians(0.125), rel=0.03)
    assert np.std(d) == pytest.approx(1.0, rel=0.03)
    assert abs(np.mean(d)) < 0.03
    assert np.abs(s).max() < 1e-9


def test_quantisation(flight):
    coarse = dataclasses.replace(BEACON, azimuth_step_deg=0.1, range_step=50.0)
    for fix in simulate_answers(coarse, flight, np.random.default_rng(1)):
        assert fix.slant_range % 50.0 == 0.0
        assert abs(math.remainder(math.degrees(fix.azimuth), 0.1)) < 1e-9


def test_no_answer_beyond_horizon_or_limit(flight):
    lons = BEACON.lon_deg + np.linspace(0.1, 8.0, 80)
    there = at_distance(flight, BEACON, lons, 1000.0)
    mast = Geodetic(math.radians(BEACON.lat_deg), math.radians(BEACON.lon_deg), BEACON.alt)
    horizon = radio_horizon(BEACON.alt - BEACON.ground_alt, 1000.0 - BEACON.ground_alt)
    expected = [
        slant_range_azimuth(mast, Geodetic(lat, lon, 1000.0)).slant_range <= horizon
        for lat, lon in zip(there.lat, there.lon)
    ]
    assert in_reach(BEACON, there).tolist() == expected
    assert 0 < sum(expected) < len(expected)
    near = dataclasses.replace(BEACON, range_limit=50e3)
    reached = in_reach(near, there)
    assert (
        azimuth_range_elevation(near, there)[1][reached].max()
        <= 50e3
        < azimuth_range_elevation(near, there)[1][~reached].min()
    )


def test_cone_of_silence_has_range_but_no_azimuth(flight):
    overhead = at_distance(flight, BEACON, BEACON.lon_deg + np.array([0.001, 0.005, 0.05]), 1000.0)
    fixes = simulate_answers(BEACON, overhead, np.random.default_rng(1))
    assert [fix.azimuth is None for fix in fixes] == [True, True, False]
    assert all(fix.slant_range is not None for fix in fixes)


def test_drop_out_and_outages_do_not_change_other_answers(flight):
    whole = {fix.t_ns: fix for fix in simulate_answers(BEACON, flight, np.random.default_rng(1))}
    fewer = simulate_answers(
        dataclasses.replace(BEACON, drop_out=0.2), flight, np.random.default_rng(1), ((1000.0, 1100.0),)
    )
    assert all(whole[fix.t_ns] == fix for fix in fewer)
    assert not any(1000.0 <= fix.t_ns * 1e-9 < 1100.0 for fix in fewer)
    assert len(fewer) / (len(whole) - 100) == pytest.approx(0.8, abs=0.03)
