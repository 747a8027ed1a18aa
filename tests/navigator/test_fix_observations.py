"""Accuracy of a fix's velocity: as stated, but never finer than configured; wide while a receiver settles."""

import pytest

from companion.config import GnssConfig
from companion.navigator.fix_observations import SETTLING_M_S, SETTLING_S, velocity_sigma
from companion.records import Gnss
from companion.units import SECOND_NS

FIRST_NS = 7 * SECOND_NS


@pytest.mark.parametrize(
    ("age_s", "stated", "expected"),
    [
        (0.0, None, SETTLING_M_S),
        (SETTLING_S - 0.1, None, SETTLING_M_S),
        (SETTLING_S, None, 0.1),
        (0.0, 0.4, 0.4),
        (0.0, 0.05, 0.1),
        (60.0, 0.4, 0.4),
    ],
)
def test_only_a_receiver_that_states_nothing_is_given_time_to_settle(
    age_s: float, stated: float | None, expected: float
) -> None:
    t_ns = FIRST_NS + round(age_s * SECOND_NS)
    fix = Gnss(t_ns, t_ns, 0, 0, 3, 0.6, 0.5, 100.0, v_n=(2.0, 1.0, 0.0), sigma_velocity=stated)
    assert velocity_sigma(fix, FIRST_NS, GnssConfig(sigma_velocity_m_s=0.1)) == expected
