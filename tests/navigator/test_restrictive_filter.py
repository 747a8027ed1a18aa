import numpy as np

from companion.config import Config
from companion.navigator import restrictive_filter

AIR = Config().air_data
BEGUN = restrictive_filter.Restrictive(
    5_000_000_000, np.array([10.0, -20.0, 3.0, 1.0]), np.diag([400.0, 400.0, 4.0, 4.0])
)


def test_a_moment_before_its_first_fix_it_is_what_it_was_then() -> None:
    """A solution is of the channel's newest point, and a fix may be newer than that."""
    for earlier_ns in (0, 113_955, 150_000_000):
        x, P = restrictive_filter.at(BEGUN, BEGUN.t_ns - earlier_ns, AIR)
        assert np.array_equal(x, BEGUN.x)
        assert np.allclose(P, BEGUN.P, rtol=1e-9)


def test_afterwards_the_wind_carries_it_off_and_it_grows() -> None:
    x, P = restrictive_filter.at(BEGUN, BEGUN.t_ns + 10_000_000_000, AIR)
    assert np.allclose(x, [10.0 + 30.0, -20.0 + 10.0, 3.0, 1.0])
    assert np.all(np.diag(P) > np.diag(BEGUN.P))
