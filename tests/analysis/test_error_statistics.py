"""Error statistics against a known truth."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from companion.analysis import error_statistics
from companion.nav.geometry import Geodetic, displace, separation, slant_range_azimuth
from companion.records import Gnss, RsbnFix, Solution
from tests.solutions import solution_at

PLACE = Geodetic(math.radians(60.0), math.radians(30.0), 800.0)
SECOND = 1_000_000_000


def truth(t_ns: int) -> Geodetic | None:
    return PLACE if t_ns < 100 * SECOND else None


def solution(t: float, north: float, east: float, error_n=(30.0, -40.0), bound_n=None) -> Solution:
    lat, lon, alt = displace(*PLACE, north, east, 0.0)
    covariance = (1.0, 0.0, 0.0, 1.0, 0.0, 1.0)
    return solution_at(
        round(t * SECOND),
        lat=lat,
        lon=lon,
        alt_msl=alt,
        covariance=covariance,
        error_n=error_n,
        bound_n=bound_n,
    )


def gnss(t: float, north: float, fix: int = 3) -> Gnss:
    lat, lon, alt = displace(*PLACE, north, 0.0, 0.0)
    t_ns = round(t * SECOND)
    return Gnss(t_ns, t_ns, 0, t_ns // 1000, fix, lat, lon, alt)


def rsbn(beacon: Geodetic, place: Geodetic, **changes) -> RsbnFix:
    sight = slant_range_azimuth(beacon, place)
    values = {"azimuth": sight.azimuth, "slant_range": sight.slant_range} | changes
    return RsbnFix(0, 0, 1, *beacon, **values, sigma_azimuth=1e-3, sigma_range=1.0)


def test_errors_equal_the_displacements() -> None:
    found = error_statistics.horizontal_errors([solution(1.0, 3.0, 4.0), gnss(2.0, 7.0)], truth)
    assert found[error_statistics.CORRECTED].error == pytest.approx([5.0], rel=1e-6)
    assert found[error_statistics.INS].error == pytest.approx([math.hypot(33.0, -36.0)], rel=1e-4)
    assert found[error_statistics.GNSS].error == pytest.approx([7.0], rel=1e-6)
    assert np.isnan(found[error_statistics.CORRECTED].bound).all()


def test_records_without_truth_or_fix_and_repeats_are_not_counted() -> None:
    records = [
        gnss(1.0, 7.0),
        gnss(1.0, 7.0),
        gnss(3.0, 7.0, fix=1),
        gnss(101.0, 7.0),
        solution(101.0, 1.0, 1.0),
    ]
    found = error_statistics.horizontal_errors(records, truth)
    assert list(found) == [error_statistics.GNSS]
    assert found[error_statistics.GNSS].t_ns.tolist() == [SECOND]


def test_phase_uses_its_own_instants() -> None:
    records = [solution(t, 0.0, float(t), bound_n=(0.0, 10.5)) for t in range(20)]
    phases = [
        error_statistics.FlightPhase("first", 0, 10 * SECOND),
        error_statistics.FlightPhase("last", 10 * SECOND, 20 * SECOND),
    ]
    first, last = error_statistics.summarize_phases(
        error_statistics.horizontal_errors(records, truth), phases
    )
    assert first.rms[error_statistics.CORRECTED] == pytest.approx(
        math.sqrt(sum(t * t for t in range(10)) / 10), rel=1e-5
    )
    assert first.p95[error_statistics.CORRECTED] == pytest.approx(np.percentile(range(10), 95.0), rel=1e-5)
    assert (first.held, first.inside, first.inside_twice, first.bound) == (True, 1.0, 1.0, 10.5)
    assert first.share == pytest.approx(first.rms[error_statistics.CORRECTED] / 10.5)
    assert last.held is False and last.inside == pytest.approx(0.1) and last.inside_twice == 1.0
    assert last.seconds == 10.0


def test_phase_without_records_has_no_numbers() -> None:
    (row,) = error_statistics.summarize_phases(
        error_statistics.horizontal_errors([solution(1.0, 1.0, 0.0)], truth),
        [error_statistics.FlightPhase("late", 50, 60)],
    )
    assert (
        row.rms == {} and row.bound is None and row.share is None and row.held is None and row.inside is None
    )


@settings(max_examples=50)
@given(st.floats(-math.pi, math.pi), st.floats(2e3, 250e3), st.floats(100.0, 9000.0))
def test_exact_beacon_measurement_gives_the_true_position(
    azimuth: float, distance: float, alt: float
) -> None:
    beacon = Geodetic(math.radians(60.05), math.radians(31.07), 80.0)
    away = displace(*beacon, distance * math.cos(azimuth), distance * math.sin(azimuth), 0.0)
    place = away._replace(alt=alt)
    found = error_statistics.position_from_beacon(rsbn(beacon, place), alt)
    assert found is not None
    north, east, _ = separation(found, place)
    assert math.hypot(north, east) < 2.0  # two iterations of the height above the tangent plane


def test_incomplete_beacon_measurement_gives_no_position() -> None:
    beacon = Geodetic(math.radians(60.05), math.radians(31.07), 80.0)
    assert error_statistics.position_from_beacon(rsbn(beacon, PLACE, azimuth=None), 800.0) is None
    assert error_statistics.position_from_beacon(rsbn(beacon, PLACE, slant_range=None), 800.0) is None


def test_fix_that_starts_a_phase_is_not_counted_in_the_previous_one():
    second = 1_000_000_000
    t = np.arange(0, 20 * second, second // 2)
    t = t[t > 9 * second]  # the first is valid half a second before the phase that it starts
    fixes = error_statistics.ErrorSeries(t, np.ones(len(t)), *np.full((3, len(t)), np.nan))
    phases = [
        error_statistics.FlightPhase("neither", 0, 10 * second),
        error_statistics.FlightPhase("GNSS only", 10 * second, 20 * second),
    ]
    before, after = error_statistics.summarize_phases({error_statistics.GNSS: fixes}, phases)
    assert error_statistics.GNSS not in before.rms and after.rms[error_statistics.GNSS] == 1.0


def test_bound_far_above_the_claim_or_the_limit_is_of_no_use() -> None:
    """The claim is 1.4 m on both axes together: ten times that, or 5 km, and nothing is held."""
    phase = [error_statistics.FlightPhase("all", 0, 20 * SECOND)]
    for bound, useful in ((14.0, True), (14.3, False), (6000.0, False)):
        records = [solution(t, 0.0, 1.0, bound_n=(0.0, bound)) for t in range(20)]
        (row,) = error_statistics.summarize_phases(error_statistics.horizontal_errors(records, truth), phase)
        assert row.useful is useful and row.held is (True if useful else None)
        assert row.bound == pytest.approx(bound) and row.expected == pytest.approx(math.sqrt(2.0))
