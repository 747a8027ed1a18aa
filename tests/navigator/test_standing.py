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


REST = (0.0, 0.0, -9.80665)


def stood(*samples: tuple[float, bool, float, float, Gnss | None]) -> Standing:
    """The standing after these samples: time (s), landed, acceleration ahead, height, the last fix."""
    now = Standing()
    for t_s, landed, ahead, height, last in samples:
        now = follow(now, imu(t_s), landed, (ahead, 0.0, 0.0), (ahead, 0.0, REST[2]), height, last)
    return now


def test_it_stands_once_a_fix_has_shown_no_speed_since_it_is_still() -> None:
    still = (10.0, True, 0.0, 0.0, fix(9.0, 0.0))
    assert not stood(still).is_due(10 * NS)  # the fix is older
    shown = stood(still, (11.0, True, 0.0, 0.0, fix(10.5, 0.2)))
    assert shown.is_due(11 * NS)
    assert not shown._replace(measured_ns=11 * NS).is_due(11 * NS + EVERY_NS - 1)
    assert follow(shown, imu(60.0), True, LEVEL, REST, 0.0, fix(10.5, 0.2)) == shown  # GNSS is lost


@pytest.mark.parametrize("landed, w, ahead", [(False, 0.0, 0.0), (True, 0.1, 0.0), (True, 0.0, 1.0)])
def test_what_may_fly_or_is_moved_does_not_stand(landed: bool, w: float, ahead: float) -> None:
    still = Standing(0, REST, is_shown=True)
    moved = follow(still, imu(1.0, w), landed, (ahead, 0.0, 0.0), (ahead, 0.0, REST[2]), 0.0, None)
    assert not moved.is_due(100 * NS)


def test_an_attitude_that_runs_off_moves_nothing() -> None:
    """Landed in ArduPlane's SITL on source set 2 the attitude runs off by five degrees."""
    still = Standing(0, REST, is_shown=True)
    assert follow(still, imu(1.0), True, (0.85, 0.0, 0.0), REST, 0.0, None) == still


def test_on_a_ship_that_sails_it_does_not_stand() -> None:
    assert not stood((1.0, True, 0.0, 0.0, None), (1.1, True, 0.0, 0.0, fix(1.0, 8.0))).is_due(100 * NS)


PARKED = (1.0, True, 0.0, 0.0, fix(0.0, 0.0)), (2.0, True, 0.0, 0.0, fix(1.5, 0.0))
FLIES = (30.0, False, 3.0, 50.0, fix(30.0, 20.0))
LANDED = tuple((60.0 + k, True, 0.0, -5.0, fix(40.0, 20.0)) for k in range(11))


def test_landed_without_gnss_it_stands_as_where_it_took_off() -> None:
    landed = stood(*PARKED, FLIES, *LANDED)
    assert landed.is_due(70 * NS)
    assert not landed.is_due(70 * NS - 1)  # not for ten seconds yet
    carried = (71.0, True, 1.0, -5.0, None)
    assert not stood(*PARKED, FLIES, *LANDED, carried, (72.0, True, 0.0, -5.0, None)).is_due(99 * NS)


def test_off_a_ship_that_sails_it_may_land_on_one() -> None:
    sails = (2.0, True, 0.0, 0.0, fix(1.5, 8.0))
    assert not stood(PARKED[0], sails, FLIES, *LANDED).is_due(99 * NS)


def test_towed_while_gnss_is_lost_it_does_not_stand() -> None:
    towed = [(10.0, True, 1.0, 0.0, fix(1.5, 0.0)), *((20.0 + k, True, 0.0, 0.0, None) for k in range(20))]
    assert not stood(*PARKED, *towed).is_due(99 * NS)


def test_what_glides_down_does_not_stand() -> None:
    """An autopilot without GNSS and airspeed may take a glide for a landing."""
    glide = [(60.0 + k, True, 0.0, 100.0 - k, fix(40.0, 20.0)) for k in range(60)]
    assert not any(stood(*PARKED, FLIES, *glide[:k]).is_due((60 + k) * NS) for k in range(1, 60))


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
