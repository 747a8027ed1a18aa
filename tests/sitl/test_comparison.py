import math

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from companion.nav.geometry import Geodetic, displace
from sitl.comparison import Comparison, nearest_error, outage_table

SECOND = 1_000_000_000
HOME = Geodetic(0.9, 0.6, 100.0)


def flying(seconds: float) -> Geodetic:
    return displace(*HOME, 20.0 * seconds, 5.0 * seconds, 0.0)


def off(seconds: float, north: float, east: float = 0.0) -> Geodetic:
    return displace(*flying(seconds), north, east, 0.0)


@settings(max_examples=30)
@given(
    st.lists(st.floats(0.0, 9.0), min_size=1, max_size=20),
    st.floats(-500.0, 500.0),
    st.floats(-500.0, 500.0),
)
def test_error_does_not_depend_on_arrival_order_of_truth(times, north, east) -> None:
    """Straight flight with truth at 10 Hz; estimates arrive before and after it."""
    comparison = Comparison()
    for k, t in enumerate(times):
        comparison.add_estimate(round(t * SECOND), "it", off(t, north, east))
        if k == len(times) // 2:
            for i in range(95):
                comparison.add_truth(i * SECOND // 10, flying(0.1 * i))
    assert len(comparison.errors) == len(times)
    for scored in comparison.errors:
        assert scored.north == pytest.approx(north, abs=0.05)
        assert scored.east == pytest.approx(east, abs=0.2)


def test_truth_gap_is_not_interpolated() -> None:
    comparison = Comparison()
    for t in (0, 1, 4, 5):
        comparison.add_truth(t * SECOND, flying(t))
    for t in (0.5, 2.5, 4.5, 30.0):
        comparison.add_estimate(round(t * SECOND), "it", off(t, 1.0))
    comparison.add_truth(31 * SECOND, flying(31))
    assert [s.t_ns / SECOND for s in comparison.errors] == [0.5, 4.5]


def test_truth_across_the_antimeridian() -> None:
    comparison = Comparison()
    east = Geodetic(0.0, math.pi - 1e-7, 0.0)
    west = Geodetic(0.0, -math.pi + 1e-7, 0.0)
    comparison.add_truth(0, east)
    comparison.add_truth(SECOND, west)
    comparison.add_estimate(SECOND // 2, "it", Geodetic(0.0, math.pi, 0.0))
    assert comparison.errors[0].error < 0.01


def test_table_counts_from_the_loss() -> None:
    comparison = Comparison()
    for i in range(1000):
        comparison.add_truth(i * SECOND // 5, flying(0.2 * i))
        t = 0.2 * i
        drift = max(0.0, t - 50.0) * 2.0
        comparison.add_estimate(
            i * SECOND // 5, "it", off(t, drift), sigma=drift / 4.0 + 1.0 if t > 100 else None
        )
    (row,) = outage_table(comparison.errors, 50 * SECOND, 150 * SECOND)
    assert row.at == {
        30: pytest.approx(60.0, abs=0.1),
        60: pytest.approx(120.0, abs=0.1),
        120: None,
        180: None,
    }
    assert row.largest == pytest.approx(199.6, abs=0.2)
    assert row.rms == pytest.approx(200.0 / math.sqrt(3.0), rel=0.01)
    assert row.within == 0.0  # drift is about four sigmas
    assert outage_table(comparison.errors, 500 * SECOND, 600 * SECOND) == []
    assert nearest_error(comparison.errors, "other", 60 * SECOND) is None
