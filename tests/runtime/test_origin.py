"""Local origin: a forged GPS_GLOBAL_ORIGIN never leads, a true change is followed and counted as a reset."""

import math
from typing import Any

import pytest

from companion.nav.geometry import Geodetic, displace, geodetic_to_local
from companion.records import FilterStatus, GlobalPosition, LocalOrigin, LocalPosition
from companion.runtime.origin import TOLERANCE_M, OriginCheck
from companion.units import SECOND_NS

TRUE = Geodetic(math.radians(55.7), math.radians(37.7), 150.0)
SPEED = (20.0, -15.0, 0.0)


def moved(north_m: float, east_m: float = 0.0) -> Geodetic:
    return displace(*TRUE, north_m, east_m, 0.0)


class Autopilot:
    """One estimator: its local and global positions refer to `origin`."""

    def __init__(self, check: OriginCheck) -> None:
        self.check, self.now, self.origin = check, 10**12, TRUE
        self.place = moved(3000.0, -8000.0)
        self.texts: list[str] = []

    def state(self, place: Geodetic) -> None:
        """Send GPS_GLOBAL_ORIGIN, or somebody does in its name."""
        self.take(LocalOrigin(self.now, self.now, *place, "ardupilot"))

    def take(self, record: Any) -> None:
        self.texts += [event.text for event in self.check.receive(record)]

    def fly(self, seconds: float) -> None:
        """Send local positions at 10 Hz and global ones at 2 Hz, 20 ms later."""
        for k in range(round(10 * seconds)):
            self.now += SECOND_NS // 10
            self.place = displace(*self.place, *(0.1 * v for v in SPEED))
            x_n = geodetic_to_local("ardupilot", self.origin, self.place)
            self.take(LocalPosition(self.now, self.now, x_n, SPEED))
            if k % 5 == 0:
                later = self.now + SECOND_NS // 50
                place = displace(*self.place, *(0.02 * v for v in SPEED))
                self.take(GlobalPosition(later, later, *place, SPEED, 100.0))

    def off(self) -> float:
        """Return the distance of the origin in use from the true one, m."""
        assert self.check.origin is not None
        used = self.check.origin
        north, east, _ = geodetic_to_local("tangent", self.origin, Geodetic(used.lat, used.lon, used.alt_msl))
        return math.hypot(north, east)


@pytest.fixture
def autopilot() -> Autopilot:
    return Autopilot(OriginCheck(has_pairs=True))


def test_stated_origin_is_used_once_pairs_agree(autopilot: Autopilot) -> None:
    autopilot.state(TRUE)
    assert autopilot.check.origin is None
    autopilot.fly(3.0)
    assert autopilot.off() == 0.0
    assert (autopilot.check.resets, autopilot.texts) == (0, [])


@pytest.mark.parametrize("off", [6.0, 50.0, 10_000.0, 2e6])
def test_forged_origin_moves_nothing(autopilot: Autopilot, off: float) -> None:
    autopilot.state(TRUE)
    autopilot.fly(3.0)
    for _ in range(5):
        autopilot.state(moved(off))
        autopilot.fly(20.0)
        assert autopilot.off() == 0.0
    assert autopilot.check.resets == 0
    (text,) = autopilot.texts
    assert "off the autopilot's positions: not used" in text


def test_forged_origin_before_the_true_one(autopilot: Autopilot) -> None:
    autopilot.state(moved(5000.0))
    autopilot.fly(10.0)
    assert autopilot.off() < 0.5  # the origin of the pairs
    autopilot.state(TRUE)
    autopilot.fly(10.0)
    assert autopilot.off() < 0.5
    assert autopilot.check.resets == 0


@pytest.mark.parametrize("is_stated", [True, False])
def test_true_change_is_followed_and_counted(autopilot: Autopilot, is_stated: bool) -> None:
    autopilot.state(TRUE)
    autopilot.fly(10.0)
    autopilot.origin = moved(800.0, 600.0)
    if is_stated:
        autopilot.state(autopilot.origin)
    autopilot.fly(3.0)
    assert autopilot.off() < 0.5
    assert autopilot.check.resets == 1
    assert autopilot.texts[-1] == "local origin moved by 1000 m: position reset"
    assert len(autopilot.texts) == (1 if is_stated else 2)  # the origin that was stated last is true, or not


def test_an_origin_that_the_last_pair_contradicts_is_not_used(autopilot: Autopilot) -> None:
    """For 1.5 s our positions went out 1 km off."""
    autopilot.state(TRUE)
    autopilot.fly(10.0)
    autopilot.origin = moved(800.0, 600.0)
    for k in range(20):
        autopilot.fly(0.1)
        used = autopilot.check.undoubted
        assert used is None or (k >= 2 and autopilot.off() < 0.5)
    assert autopilot.check.undoubted is not None


def jump_between_positions(autopilot: Autopilot) -> None:
    """After 10 s the estimator is reset by 300 m between the local and the global position."""
    autopilot.state(TRUE)
    autopilot.fly(10.1)
    autopilot.place = displace(*autopilot.place, 300.0, 0.0, 0.0)
    autopilot.take(GlobalPosition(autopilot.now, autopilot.now, *autopilot.place, SPEED, 100.0))


def test_an_origin_is_doubted_no_longer_than_pairs_are_recent(autopilot: Autopilot) -> None:
    jump_between_positions(autopilot)
    assert autopilot.check.undoubted is None
    for _ in range(101):
        autopilot.now += SECOND_NS // 10
        autopilot.take(LocalPosition(autopilot.now, autopilot.now, (0.0, 0.0, 0.0), SPEED))
    assert autopilot.check.undoubted is not None


def test_nor_where_the_autopilot_has_no_local_position_any_more(autopilot: Autopilot) -> None:
    """An EKF in constant position mode sends none and waits for our positions: it waited for ever."""
    constant_position = 167
    jump_between_positions(autopilot)
    assert autopilot.check.undoubted is None
    for _ in range(11):
        autopilot.now += SECOND_NS
        autopilot.take(FilterStatus(autopilot.now, autopilot.now, constant_position, False, 0.0))
    assert autopilot.check.undoubted is not None


def test_one_pair_across_a_jump_of_the_estimator_changes_nothing(autopilot: Autopilot) -> None:
    jump_between_positions(autopilot)
    autopilot.fly(10.0)
    assert (autopilot.off(), autopilot.check.resets, autopilot.texts) == (0.0, 0, [])


def test_small_difference_is_no_change(autopilot: Autopilot) -> None:
    autopilot.state(moved(0.8 * TOLERANCE_M))
    autopilot.fly(10.0)
    assert autopilot.off() == pytest.approx(0.8 * TOLERANCE_M, rel=0.01)
    assert autopilot.check.resets == 0


def test_reboot_forgets_the_origin_and_keeps_the_count(autopilot: Autopilot) -> None:
    test_true_change_is_followed_and_counted(autopilot, True)
    autopilot.check.forget()
    assert autopilot.check.origin is None
    assert autopilot.check.resets == 1


def test_an_autopilot_without_a_position_has_its_stated_origin_until_pairs_come(autopilot: Autopilot) -> None:
    """Flown on ArduPlane without GNSS from the start: it has no position before it is given one."""
    constant_position, absolute = 167, 831  # EKF_STATUS_REPORT.flags
    autopilot.take(FilterStatus(autopilot.now, autopilot.now, constant_position, False, 0.0))
    autopilot.state(TRUE)
    assert autopilot.off() == 0.0
    autopilot.state(moved(5000.0))  # not while another one is in use
    autopilot.state(TRUE)
    autopilot.origin = moved(5000.0)  # its positions are DCM's
    autopilot.fly(3.0)
    autopilot.origin = TRUE
    assert autopilot.off() == 0.0
    autopilot.take(FilterStatus(autopilot.now, autopilot.now, absolute, False, 0.0))
    autopilot.fly(3.0)
    assert autopilot.off() == 0.0 and autopilot.check.resets == 0
    autopilot.origin = moved(0.0, 500.0)
    autopilot.fly(3.0)
    assert autopilot.off() < TOLERANCE_M and autopilot.check.resets == 1


def test_after_a_reboot_nothing_states_that_there_is_no_position(autopilot: Autopilot) -> None:
    """EKF_STATUS_REPORT may not come again: a stated origin is checked as from the start."""
    constant_position = 167
    autopilot.take(FilterStatus(autopilot.now, autopilot.now, constant_position, False, 0.0))
    autopilot.check.forget()
    autopilot.state(moved(5000.0))
    assert autopilot.check.origin is None
    autopilot.fly(3.0)
    assert autopilot.off() < TOLERANCE_M


def test_the_statement_that_there_is_no_position_ages(autopilot: Autopilot) -> None:
    """EKF_STATUS_REPORT may stop: the origin was checked no more."""
    constant_position = 167
    autopilot.take(FilterStatus(autopilot.now, autopilot.now, constant_position, False, 0.0))
    autopilot.state(moved(5000.0))
    autopilot.fly(9.0)
    assert autopilot.off() == pytest.approx(5000.0, rel=1e-3)
    autopilot.fly(4.0)
    assert autopilot.off() < TOLERANCE_M and autopilot.check.resets == 1
    autopilot.check.forget()
    autopilot.take(FilterStatus(autopilot.now, autopilot.now, constant_position, False, 0.0))
    autopilot.now += 11 * SECOND_NS
    autopilot.state(moved(5000.0))
    assert autopilot.check.origin is None


def test_ins_of_its_own_uses_the_stated_origin(autopilot: Autopilot) -> None:
    """Its drifting local position and the autopilot's global one are no pair."""
    autopilot.check = OriginCheck(has_pairs=False)
    autopilot.state(TRUE)
    assert autopilot.off() == 0.0
    autopilot.origin = moved(0.0, 500.0)
    autopilot.fly(10.0)
    assert autopilot.check.resets == 0
    autopilot.state(autopilot.origin)
    assert (autopilot.off(), autopilot.check.resets) == (0.0, 1)
