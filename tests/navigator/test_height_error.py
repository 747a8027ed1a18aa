"""The height error against GNSS on days that are not standard, and heights that are false."""

from __future__ import annotations

import math

import numpy as np
import pytest

from companion.config import load
from companion.nav.geometry import Geodetic, displace, slant_range_azimuth
from companion.navigator import Navigator, air_data_channel, height_error
from companion.navigator.air_data_channel import HEIGHT_EXPONENT, LAPSE, P0, T0, Reckoner, pressure_altitude
from companion.navigator.height_error import Level
from companion.navigator.inertial_track import Point
from companion.records import (
    AirData,
    Attitude,
    Gnss,
    Imu,
    LocalOrigin,
    LocalPosition,
    Pressure,
    Rejection,
    RsbnFix,
    Solution,
)
from companion.units import G0

NS = 1_000_000_000
GATE = 24.0
CORRELATION_S = 60.0


def fix(t: float, alt: float) -> Gnss:
    return Gnss(round(t * NS), round(t * NS), 0, 0, 3, 1.0, 0.5, alt)


def point(t: float, alt: float) -> Point:
    return Point(round(t * NS), Geodetic(1.0, 0.5, alt), (0.0, 0.0, 0.0))


def climbed(
    share: float, hz: float, until: float = math.inf, wrong: dict[int, float] | None = None
) -> list[tuple[float, float]]:
    """Errors of the corrected height and their sigmas, second by second: 300 s level, 2900 m up in 1500 s,
    300 s level. The channel is 20 m too high and `share` of the climb. GNSS errs by a drift of 2 m until it
    ceases at `until`; `wrong` is what it adds at some fixes.
    """
    rng = np.random.default_rng(1)
    level, drift, last, found = Level(), 0.0, -math.inf, []
    for k in range(round(2100 * hz)):
        t = k / hz
        true = 100.0 + 2900.0 * min(max(t - 300.0, 0.0), 1500.0) / 1500.0
        ins = point(t, true + 20.0 + share * (true - 100.0))
        keep = math.exp(-1.0 / hz / CORRELATION_S)
        drift = keep * drift + 2.0 * math.sqrt(1.0 - keep**2) * rng.standard_normal()
        if t < until:
            part = min(t - last, CORRELATION_S) / CORRELATION_S
            reported = true + drift + (wrong or {}).get(k, 0.0)
            level, last = height_error.update(level, fix(t, reported), ins, part, GATE), t
        now = height_error.at(level, ins)
        if k % round(hz) == 0:
            found.append((ins.position.alt - now.error - true, math.sqrt(now.covariance[0])))
    return found


@pytest.mark.parametrize("hz", [1.0, 5.0])
@pytest.mark.parametrize("share", [0.0, 0.08, -0.1])
def test_a_climb_on_a_day_that_is_not_standard(share: float, hz: float) -> None:
    error, sigma = np.array(climbed(share, hz)).T
    assert np.all(np.abs(error[60:]) < 3.0 * sigma[60:])
    assert np.abs(error[60:]).max() < 20.0
    assert np.abs(error[-200:]).max() < 6.0


def test_without_gnss_the_sigma_of_a_level_height_grows_as_that_of_recorded_flights() -> None:
    """In three minutes by 2.7 m: 96 % of 18 recorded flights' heights of GNSS are within two sigma by it."""
    _, sigma = np.array(climbed(0.0, 1.0, until=100.0)).T
    assert math.sqrt(sigma[280] ** 2 - sigma[100] ** 2) == pytest.approx(2.7, abs=0.2)


def test_a_climb_without_gnss_costs_what_is_not_known_of_the_day() -> None:
    """Lost at once it costs 8 % of the climb, one sigma, and says so; lost halfway up, little."""
    error, sigma = np.array(climbed(0.08, 1.0, until=300.0)).T
    assert 100.0 < abs(error[-1]) < 2.0 * sigma[-1]
    error, sigma = np.array(climbed(0.08, 1.0, until=1000.0)).T
    assert abs(error[-1]) < min(3.0 * sigma[-1], 40.0)


def test_one_false_height_is_refused_and_one_that_stays_believed() -> None:
    once = np.array(climbed(0.0, 1.0, wrong={200: 1000.0}))
    none = np.array(climbed(0.0, 1.0))
    assert np.abs(once - none)[:, 0].max() < 0.2
    stays = np.array(climbed(0.0, 1.0, wrong={k: 300.0 for k in range(200, 2100)}))
    assert abs(stays[205, 0]) < 10.0
    assert stays[-1, 0] == pytest.approx(300.0, abs=20.0)


def test_of_two_runs_of_heights_of_gnss_the_longer_one_is_believed() -> None:
    none = np.array(climbed(0.0, 1.0))
    minute = np.array(climbed(0.0, 1.0, wrong={k: 3000.0 for k in range(200, 260)}))
    assert np.abs(minute - none)[:, 0].max() < 2.0  # one sigma of its drift: a minute is missing
    first = np.array(climbed(0.0, 1.0, wrong={k: 3000.0 for k in range(60)}))
    assert abs(first[59, 0]) > 2900.0
    assert np.abs(first[125:300, 0]).max() < 20.0


@pytest.mark.parametrize(("wrong_m", "takes_s"), [(500.0, 10.0), (-800.0, 10.0), (-260.0, 90.0)])
def test_of_two_runs_the_one_near_the_standard_atmosphere_is_believed_sooner(
    wrong_m: float, takes_s: float
) -> None:
    """The first 90 s are wrong. No weather makes 500 m of a pressure altitude; 260 m it may."""
    off = np.array(climbed(0.0, 1.0, wrong={k: wrong_m for k in range(90)}))[:, 0]
    assert abs(off[89] - wrong_m) < 20.0
    assert np.abs(off[90 + round(takes_s) + 5 : 300]).max() < 20.0
    assert abs(off[90 + round(takes_s) - 5]) > 0.8 * abs(wrong_m)


@pytest.mark.parametrize("truth_m", [250.0, -300.0])
def test_a_height_of_gnss_that_steps_to_the_standard_atmosphere_within_its_errors_is_not_believed(
    truth_m: float,
) -> None:
    """The channel is off by `truth_m`, as high or low pressure makes it; for a minute GNSS denies that."""
    level = Level()
    for t in range(260):
        alt = 1000.0 - (0.0 if 200 <= t < 260 else truth_m)
        level = height_error.update(level, fix(float(t), alt), point(float(t), 1000.0), 1.0 / 60.0, GATE)
    assert level.error == pytest.approx(truth_m, abs=1.0)


START = Geodetic(1.0, 0.5, 1000.0)
BEACON = displace(*START, 0.0, 10_000.0, 1000.0)
AIR = load(flags={"output.profile": "ardupilot"}, environment={})
INS = load(flags={"inertial.independent": True}, environment={})


def flown_level(
    step_m: float,
    until: float,
    by_ins: bool,
    climb: float = 0.0,
    seconds: int = 40,
    gnss_step_m: float = 0.0,
    pressure_hz: int = 10,
) -> tuple[list[float], list[Rejection]]:
    """Fly north at 30 m/s, by airspeed or by an INS whose height is `step_m` off from 20 s on `until`.

    GNSS states a height that is `gnss_step_m` off for the same time. A beacon is 10 km east of the start. The
    static pressure comes `pressure_hz` times a second, a divisor of 10.

    Return how far each altitude sent is off, and the rejections.
    """
    navigator, off, rejections = Navigator(INS if by_ins else AIR), list[float](), list[Rejection]()
    navigator.handle(LocalOrigin(0, 0, *START, "tangent"))
    for k in range(10 * seconds):
        t, t_ns = 0.1 * k, k * NS // 10
        true = START.alt + climb * t
        is_false = 20.0 <= t < until
        read = true + is_false * step_m
        at = displace(*START, 30.0 * t, 0.0, 0.0)._replace(alt=true)
        records: list[object] = [
            Attitude(t_ns, t_ns, 1e-6 * k, 0.0, 0.0),
            AirData(t_ns, t_ns, 30.0 + 1e-6 * k, true=True, sensed=True),
            Pressure(t_ns, t_ns, P0 * (1.0 - read * LAPSE / T0) ** (1.0 / HEIGHT_EXPONENT)),
        ]
        if k % (10 // pressure_hz):
            del records[2]
        if by_ins:
            records = [LocalPosition(t_ns, t_ns, (30.0 * t, 0.0, START.alt - read), (30.0, 0.0, -climb))]
        if k % 5 == 0:
            v_n = (30.0, 0.0, -climb)
            alt = true + is_false * gnss_step_m
            records.append(Gnss(t_ns, t_ns, 0, t_ns // 1000, 3, at.lat, at.lon, alt, 1.5, 3.0, v_n=v_n))
        if k % 10 == 0:
            sight = slant_range_azimuth(BEACON, at)
            sigmas = math.radians(0.125), 100.0
            records.append(RsbnFix(t_ns, t_ns, 7, *BEACON, sight.azimuth, sight.slant_range, *sigmas))
        for out in (out for record in records for out in navigator.handle(record)):
            if isinstance(out, Solution):
                off.append(out.alt_msl - true)
            elif isinstance(out, Rejection):
                rejections.append(out)
    return off, rejections


def test_the_first_pressure_after_the_first_fix_moves_no_altitude_that_is_sent() -> None:
    """A telemetry log began with a fix; the pressure, of a height 130 m lower, came 0.15 s later."""
    navigator, alts, rejections = Navigator(load(environment={})), list[float](), list[Rejection]()
    for k in range(20 * 20):
        t_ns = k * NS // 20
        records: list[object] = [
            Attitude(t_ns, t_ns, 1e-6 * k, 0.0, 0.0),
            Imu(t_ns, t_ns, 0, (1e-6 * k, 0.0, -G0), (1e-6 * k, 0.0, 0.0)),
        ]
        if k % 4 == 0:
            place = displace(*START, 0.75 * k, 0.0, 0.0)._replace(alt=START.alt + 130.0)
            records.append(Gnss(t_ns, t_ns, 0, t_ns // 1000, 3, *place, 1.5, 3.0, v_n=(15.0, 0.0, 0.0)))
        if k >= 3:
            static = P0 * (1.0 - (START.alt + 1e-3 * (k % 7)) * LAPSE / T0) ** (1.0 / HEIGHT_EXPONENT)
            records.append(Pressure(t_ns, t_ns, static))
        for out in (out for record in records for out in navigator.handle(record)):
            if isinstance(out, Solution):
                alts.append(out.alt_msl)
            elif isinstance(out, Rejection):
                rejections.append(out)
    assert rejections == []
    assert alts == pytest.approx([START.alt + 130.0] * len(alts), abs=1.0)


def climbing(
    climb: float,
    pressure_every: int,
    seconds: int = 32,
    silent: range = range(0),
    no_fix: range = range(0),
) -> list[Solution]:
    """Climb north at 15 m/s by an IMU at 20 Hz, a pressure every so many samples, and GNSS between them.

    In the seconds of `silent` no pressure comes, in those of `no_fix` no fix.
    """
    navigator, records = Navigator(load(environment={})), list[object]()
    for k in range(20 * seconds):
        t, t_ns = k / 20, k * NS // 20
        alt = START.alt + climb * t
        records += [
            Attitude(t_ns, t_ns, 1e-6 * k, 0.0, 0.0),
            Imu(t_ns, t_ns, 0, (1e-6 * k, 0.0, -G0), (1e-6 * k, 0.0, 0.0)),
        ]
        if k % pressure_every == 0 and k // 20 not in silent:
            records.append(Pressure(t_ns, t_ns, P0 * (1.0 - alt * LAPSE / T0) ** (1.0 / HEIGHT_EXPONENT)))
        if k % 4 == 0 and k // 20 not in no_fix:
            t_ns += NS // 40
            place = displace(*START, 15.0 * (t + 0.025), 0.0, 0.0)._replace(alt=alt + 0.025 * climb)
            v_n = (15.0, 0.0, -climb)
            records.append(Gnss(t_ns, t_ns, 0, t_ns // 1000, 3, *place, 1.5, 3.0, v_n=v_n))
    outputs = [out for record in records for out in navigator.handle(record)]
    return [out for out in outputs if isinstance(out, Solution)]


@pytest.mark.parametrize("pressure_every", [1, 4])
@pytest.mark.parametrize("climb", [5.0, -20.0])
def test_the_vertical_velocity_of_a_steady_climb_is_that_of_the_pressure(
    climb: float, pressure_every: int
) -> None:
    """It was the rate since the last fix, of a height older than that: a fifth too fast."""
    late = [out for out in climbing(climb, pressure_every) if out.t_ns > 20 * NS]
    assert len(late) > 50
    assert [out.v_n[2] for out in late] == pytest.approx([-climb] * len(late), rel=0.01)


def test_without_a_pressure_no_climb_is_known() -> None:
    """A sensor that is silent leaves the last height, and no vertical velocity."""
    last, silent_ns = air_data_channel.sense(Reckoner(), Pressure(NS, NS, 99e3)), 3 * NS
    rising = air_data_channel.sense(last, Pressure(NS + NS // 5, NS + NS // 5, 98.9e3))
    assert rising.climb > 1.0 and rising.climb_at(rising.static_ns) == rising.climb
    assert rising.climb_at(rising.static_ns + silent_ns) == 0.0


@pytest.mark.parametrize("silent", [range(10, 40), range(60)])
def test_without_a_pressure_the_altitude_is_that_of_the_fixes(silent: range) -> None:
    """A recorded fixed wing without one was sent 65 m off a healthy GNSS, with a sigma of 2.4 m."""
    for out in climbing(5.0, 4, 60, silent):
        assert abs(out.alt_msl - START.alt - 5.0 * out.t_ns / NS) < 12.0
        assert 5.0 * out.covariance[5] ** 0.5 > 12.0


@pytest.mark.parametrize("back_s", [30, 60])
def test_with_neither_pressure_nor_fix_the_sigma_of_the_altitude_grows(back_s: int) -> None:
    """To 300 m, no more: a position is sent without a height too. The pressure is right again at once."""
    for out in climbing(-5.0, 4, 70, range(10, back_s), range(10, 70)):
        off, t = abs(out.alt_msl - START.alt + 5.0 * out.t_ns / NS), out.t_ns / NS
        sigma = out.covariance[5] ** 0.5
        assert off < 3.0 * sigma < 1000.0
        assert t < back_s + 0.3 or off < 5.0
    assert t > 69.0


def test_the_pressure_of_a_height_gives_that_height() -> None:
    assert pressure_altitude(P0 * (1.0 - 5000.0 * LAPSE / T0) ** (1.0 / HEIGHT_EXPONENT)) == pytest.approx(
        5e3
    )


@pytest.mark.parametrize("by_ins", [False, True], ids=["pressure", "ins"])
@pytest.mark.parametrize("step_m", [4900.0, -300.0])
def test_a_height_that_steps_for_a_second_moves_no_altitude_that_is_sent(step_m: float, by_ins: bool) -> None:
    off, rejections = flown_level(step_m, 21.0, by_ins, seconds=25)
    assert len(off) > 100
    assert max(map(abs, off)) < 5.0
    if not by_ins:
        assert {each.source for each in rejections} == {"pressure"}
        assert [each.value for each in rejections] == pytest.approx([abs(step_m)] * 10, rel=1e-6)


@pytest.mark.parametrize("by_ins", [False, True], ids=["pressure", "ins"])
@pytest.mark.parametrize("climb", [100.0, -25.0])
def test_a_steep_climb_is_no_step(climb: float, by_ins: bool) -> None:
    """What is left is a delay of some samples."""
    off, rejections = flown_level(0.0, 0.0, by_ins, climb, seconds=24)
    assert rejections == []
    assert max(map(abs, off)) < 0.5 * abs(climb)


@pytest.mark.parametrize(("climb", "pressure_hz"), [(300.0, 2), (300.0, 1), (600.0, 10), (-250.0, 2)])
def test_a_climb_that_pressure_and_gnss_show_alike_is_no_step(climb: float, pressure_hz: int) -> None:
    """Both were rejected, and the altitude was kilometres off after ten seconds. A sample's delay is left."""
    off, rejections = flown_level(0.0, 0.0, False, climb, seconds=24, pressure_hz=pressure_hz)
    assert max(map(abs, off)) < 1.4 * abs(climb)
    assert all(
        each.t_ns <= NS for each in rejections if each.source != "height of gnss 0"
    )  # GNSS shows its climb by two fixes


def test_a_pressure_that_stepped_and_stays_is_used_again() -> None:
    """After ten seconds; GNSS shows its error after ten more."""
    off, rejections = flown_level(4900.0, 50.0, by_ins=False, seconds=50)
    assert [each.source for each in rejections].count("pressure") == 100
    assert abs(off[-1]) < 20.0


@pytest.mark.parametrize("by_ins", [False, True], ids=["pressure", "ins"])
def test_a_height_of_gnss_that_is_false_for_seconds_moves_no_altitude_and_no_range(by_ins: bool) -> None:
    """Its horizontal position is right; 3 km of height are 720 m of the beacon's slant range."""
    off, rejections = flown_level(0.0, 35.0, by_ins, seconds=40, gnss_step_m=3000.0)
    assert max(map(abs, off)) < 5.0
    assert {each.source for each in rejections} == {"height of gnss 0"}
    assert [each.value for each in rejections] == pytest.approx([3000.0] * 30, rel=1e-3)
