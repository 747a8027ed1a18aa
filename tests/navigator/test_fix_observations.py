"""Accuracy of a fix's velocity: as stated, but never finer than configured; wide while a receiver settles."""

import math

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


@pytest.mark.parametrize(
    ("speed", "turned_deg", "receiver", "expected"),
    [
        (0.3, 0.0, 0, 1.2),  # the course is held: any direction
        (1.3, 0.0, 0, 5.2),
        (1.3, 0.02, 0, 0.1),  # two steps of the message
        (1.3, 180.0, 0, 0.1),
        (1.3, 0.0, 1, 0.1),  # another receiver's course proves nothing
        (0.0, 0.0, 0, 0.1),  # at rest a simulated receiver states exactly that
        (3.5, 0.0, 0, 0.1),  # straight flight
    ],
)
def test_slow_velocity_along_a_held_course_may_have_any_direction(
    speed: float, turned_deg: float, receiver: int, expected: float
) -> None:
    def fix(t_ns: int, receiver: int, speed: float, course_deg: float) -> Gnss:
        north, east = (speed * part(math.radians(course_deg)) for part in (math.cos, math.sin))
        return Gnss(t_ns, t_ns, receiver, 0, 3, 0.6, 0.5, 100.0, v_n=(north, east, 0.0), sigma_velocity=0.05)

    before = fix(FIRST_NS, receiver, 0.7, 105.38)
    record = fix(FIRST_NS + SECOND_NS, 0, speed, 105.38 + turned_deg)
    sigma = velocity_sigma(record, FIRST_NS, GnssConfig(sigma_velocity_m_s=0.1), before)
    assert sigma == pytest.approx(expected)


def test_velocity_is_as_accurate_as_stated_without_a_fix_before_or_its_velocity() -> None:
    record = Gnss(FIRST_NS, FIRST_NS, 0, 0, 3, 0.6, 0.5, 100.0, v_n=(1.0, 0.0, 0.0), sigma_velocity=0.05)
    before = Gnss(FIRST_NS, FIRST_NS, 0, 0, 3, 0.6, 0.5, 100.0)
    assert velocity_sigma(record, FIRST_NS, GnssConfig(sigma_velocity_m_s=0.1), before) == 0.1
    assert velocity_sigma(record, FIRST_NS, GnssConfig(sigma_velocity_m_s=0.1)) == 0.1
