import math

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from companion.nav.geometry import Geodetic, displace
from sitl.comparison import Comparison, nearest, table

SECOND = 1_000_000_000
HOME = Geodetic(0.9, 0.6, 100.0)


def flying(seconds: float) -> Geodetic:
    return displace(*HOME, 20.0 * seconds, 5.0 * seconds, 0.0)


def off(seconds: float, north: float, east: float = 0.0) -> Geodetic:
    return displace(*flying(seconds), north, east, 0.0)


@settings(deadline=None, max_examples=30)
@given(
    st.lists(st.floats(0.0, 9.0), min_size=1, max_size=20),
    st.floats(-500.0, 500.0),
    st.floats(-500.0, 500.0),
)
def test_the_error_is_what_was_added_whenever_the_truth_comes(times, north, east) -> None:
    """Ten samples a second of a straight flight; estimates before, between and after them."""
    comparison = Comparison()
    for k, t in enumerate(times):
        comparison.estimate(round(t * SECOND), "it", off(t, north, east))
        if k == len(times) // 2:
            for i in range(95):
                comparison.truth(i * SECOND // 10, flying(0.1 * i))
    assert len(comparison.scored) == len(times)
    for scored in comparison.scored:
        assert scored.north == pytest.approx(north, abs=0.05)
        assert scored.east == pytest.approx(east, abs=0.2)


def test_truth_is_not_drawn_across_a_hole_nor_waited_for_for_ever() -> None:
    comparison = Comparison()
    for t in (0, 1, 4, 5):
        comparison.truth(t * SECOND, flying(t))
    for t in (0.5, 2.5, 4.5, 30.0):
        comparison.estimate(round(t * SECOND), "it", off(t, 1.0))
    comparison.truth(31 * SECOND, flying(31))
    assert [s.t_ns / SECOND for s in comparison.scored] == [0.5, 4.5]


def test_truth_across_the_antimeridian() -> None:
    comparison = Comparison()
    east = Geodetic(0.0, math.pi - 1e-7, 0.0)
    west = Geodetic(0.0, -math.pi + 1e-7, 0.0)
    comparison.truth(0, east)
    comparison.truth(SECOND, west)
    comparison.estimate(SECOND // 2, "it", Geodetic(0.0, math.pi, 0.0))
    assert comparison.scored[0].error < 0.01


def test_the_table_counts_from_the_loss() -> None:
    comparison = Comparison()
    for i in range(1000):
        comparison.truth(i * SECOND // 5, flying(0.2 * i))
        t = 0.2 * i
        drift = max(0.0, t - 50.0) * 2.0
        comparison.estimate(
            i * SECOND // 5, "it", off(t, drift), sigma=drift / 4.0 + 1.0 if t > 100 else None
        )
    (row,) = table(comparison.scored, 50 * SECOND, 150 * SECOND)
    assert row.at == {
        30: pytest.approx(60.0, abs=0.1),
        60: pytest.approx(120.0, abs=0.1),
        120: None,
        180: None,
    }
    assert row.largest == pytest.approx(199.6, abs=0.2)
    assert row.rms == pytest.approx(200.0 / math.sqrt(3.0), rel=0.01)
    assert row.within == 0.0  # drift is four sigmas, less a metre
    assert table(comparison.scored, 500 * SECOND, 600 * SECOND) == []
    assert nearest(comparison.scored, "other", 60 * SECOND) is None
