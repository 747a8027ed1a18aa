"""What stands: stated, still, and shown by a fix; a navigator that lost its bank goes on."""

from __future__ import annotations

import pytest
from msgspec import structs

from companion.config import load
from companion.navigator import Navigator
from companion.navigator.standing import EVERY_NS, Standing, follow
from companion.navigator.state import hypotheses
from companion.records import Attitude, Gnss, Imu, Vehicle

NS = 1_000_000_000
LEVEL = (0.0, 0.0, 0.0)


def imu(t_s: float, w: float = 0.0) -> Imu:
    t_ns = round(t_s * NS)
    return Imu(t_ns, t_ns, 0, (0.0, 0.0, -9.80665), (w, 0.0, 0.0))


def fix(t_s: float, speed: float) -> Gnss:
    t_ns = round(t_s * NS)
    return Gnss(t_ns, t_ns, 0, t_ns // 1000, 3, 0.8, 0.1, 300.0, v_n=(speed, 0.0, 0.0))


def test_it_stands_once_a_fix_has_shown_no_speed_since_it_is_still() -> None:
    still = follow(None, imu(10.0), True, LEVEL, fix(9.0, 0.0))
    assert still == Standing(10 * NS)  # the fix is older
    shown = follow(still, imu(11.0), True, LEVEL, fix(10.5, 0.2))
    assert shown is not None
    assert shown.is_due(11 * NS)
    assert not shown._replace(measured_ns=11 * NS).is_due(11 * NS + EVERY_NS - 1)
    assert follow(shown, imu(60.0), True, LEVEL, fix(10.5, 0.2)) == shown  # GNSS is lost


@pytest.mark.parametrize("landed, w, ahead", [(False, 0.0, 0.0), (True, 0.1, 0.0), (True, 0.0, 1.0)])
def test_what_may_fly_or_is_moved_does_not_stand(landed: bool, w: float, ahead: float) -> None:
    assert follow(Standing(0, True), imu(1.0, w), landed, (ahead, 0.0, 0.0), None) is None


def test_on_a_ship_that_sails_it_does_not_stand() -> None:
    assert follow(Standing(0), imu(1.1), True, LEVEL, fix(1.0, 8.0)) == Standing(round(1.1 * NS))


@pytest.mark.parametrize("lost", [{"bank": None, "nominal": None}, {"gnss_taken": None}])
def test_a_parked_navigator_that_lost_its_bank_goes_on(lost: dict[str, None]) -> None:
    navigator = Navigator(load(flags={"output.profile": "ardupilot"}, environment={}))
    navigator.handle(Vehicle(1, 1, flying=False))

    def still(begin: float, end: float, with_gnss: bool) -> None:
        for k in range(round(begin * 20), round(end * 20)):
            t_ns = k * NS // 20
            navigator.handle(Attitude(t_ns, t_ns, 1e-4 * (k % 7), 0.0, 1.0))  # the same numbers are stale
            navigator.handle(imu(k / 20, 1e-4 * (k % 5)))
            if with_gnss and k % 10 == 0:
                navigator.handle(fix(k / 20, 0.01 * (k % 3)))

    still(1.0, 20.0, True)
    still(20.0, 30.0, False)
    standing = navigator._state.sensors.standing
    assert standing is not None
    assert standing.is_shown
    assert standing.measured_ns > 28 * NS
    navigator._state = structs.replace(navigator._state, **lost)
    still(30.0, 40.0, False)


@pytest.mark.parametrize("landed", [True, False])
def test_minutes_on_the_ground_take_no_rows_for_steps_of_the_wind(landed: bool) -> None:
    """Nothing shows it there: they held half of the rows, and the step of the wind in flight none."""
    navigator = Navigator(load(flags={"output.profile": "ardupilot"}, environment={}))
    navigator.handle(Vehicle(1, 1, flying=not landed))
    for k in range(20, 20 * 60):
        t_ns = k * NS // 20
        navigator.handle(Attitude(t_ns, t_ns, 1e-4 * (k % 7), 0.0, 1.0))
        navigator.handle(imu(k / 20, 1e-4 * (k % 5)))
        if k % 10 == 0:
            navigator.handle(fix(k / 20, 0.01 * (k % 3)))
    bank = navigator.state.bank
    assert bank is not None
    layout = hypotheses(navigator.state, navigator.settings).layout
    (wind,) = (j for j, jump in enumerate(layout.jumps) if jump.name == "wind")
    rows = int((bank.event == layout.jump_event(wind)).sum())
    assert (rows == 0) is landed
    assert landed or rows > 20
