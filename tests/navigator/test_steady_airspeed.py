"""A fixed wing without an airspeed sensor: its airspeed is taken for steady, on a recorded flight."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from msgspec.structs import replace

from companion.analysis.smoothing import smooth_flight
from companion.config import load
from companion.nav.geometry import Geodetic, displace, separation
from companion.navigator import Navigator, own_channel
from companion.navigator.hypotheses import AIRSPEED
from companion.navigator.own_error_model import (
    CRAB,
    HEADING,
    SCALE,
    STEADY_M_S,
    STEADY_S,
    WIND,
    Amplitudes,
    N,
    Propagator,
    add_velocity,
    begin,
)
from companion.records import (
    AirData,
    AirspeedSensor,
    Attitude,
    Event,
    Gnss,
    Input,
    Reboot,
    Solution,
    Source,
    Vehicle,
)
from companion.study import outages
from sitl.campaign.flight import SCENARIOS, config_of, sensors_of
from sitl.flight import FlightPlan, Leg, WindChange
from sitl.world import World
from tests.recordings import recording

NS = 1_000_000_000
CONFIG = load(flags={"output.profile": "ardupilot"}, environment={})


def recorded() -> tuple[Any, ...]:
    """A real fixed wing by attitude, GNSS and airspeed, without an IMU."""
    return recording("umn_flight")


def without_airspeed() -> list[Input]:
    return [r for r in recorded() if not isinstance(r, AirData)]


@pytest.mark.flight
def test_a_real_fixed_wing_reckons_without_an_airspeed_sensor() -> None:
    """It is no worse than the rule that fits airspeed and wind to the last two minutes, within its sigmas."""
    rows = outages.study("", without_airspeed(), CONFIG, 60.0, (10.0, 30.0, 60.0, 120.0))
    for row in rows:
        assert row.rms_m is not None and row.by_wind_m is not None and row.within is not None
        assert row.rms_m < row.by_wind_m < 0.3 * row.straight_on_m
        assert row.within >= 0.9


@pytest.mark.flight
def test_the_airspeed_that_is_found_is_the_measured_one() -> None:
    """To 10 %, three minutes after take-off; the sensor's own readings are the judge."""
    navigator = Navigator(CONFIG)
    for record in without_airspeed():
        navigator.handle(record)
        if record.rx_ns > 240 * NS:
            break
    state = navigator._state
    assert state.bank is not None and state.sensors.steady_m_s is not None
    scale = float(state.bank.x[int(state.bank.L.argmax()), SCALE])
    measured = [r.airspeed for r in recorded() if isinstance(r, AirData) and 60 < r.t_ns / NS < 240]
    mean = sum(measured) / len(measured)
    assert state.sensors.steady_m_s * (1.0 - scale) == pytest.approx(mean, rel=0.1)


def uses_air(records: list[Input], until_s: float) -> float:
    """When a solution is first by the airspeed; inf if none is before `until_s`."""
    navigator = Navigator(CONFIG)
    for record in sorted(records, key=lambda record: record.rx_ns):
        if record.rx_ns > until_s * NS:
            break
        for out in navigator.handle(record):
            if isinstance(out, Solution) and out.sources & Source.AIR_DATA:
                return out.t_ns / NS
    return math.inf


def stated(**fields: bool) -> list[Input]:
    """The flight whose vehicle is as stated, every second."""
    vehicles = [Vehicle(t * NS, t * NS, **fields) for t in range(1, 40)]
    return [*(r for r in without_airspeed() if not isinstance(r, Vehicle)), *vehicles]


def test_it_is_used_of_a_fixed_wing_that_flies_only() -> None:
    flying = stated(fixed_wing=True, flying=True)
    assert 20.0 < uses_air(flying, 25.0) < 25.0
    assert uses_air(stated(fixed_wing=True, flying=False), 40.0) == math.inf
    assert uses_air(stated(fixed_wing=True, flying=True, hovering=True), 40.0) == math.inf
    assert uses_air(stated(fixed_wing=False, flying=True), 40.0) == math.inf


def test_a_quadplane_that_leaves_a_mode_of_its_rotors_has_no_steady_airspeed_for_twenty_seconds() -> None:
    """By its HEARTBEAT alone: it gathers speed first."""
    others = [r for r in without_airspeed() if not isinstance(r, Vehicle)]
    vehicles = [
        Vehicle(t * NS, t * NS, multirotor=False, flying=True, fixed_wing=t >= 30) for t in range(1, 60)
    ]
    assert 50.0 <= uses_air([*others, *vehicles], 55.0) < 55.0


def test_a_sensor_that_fails_is_replaced_and_one_that_comes_back_is_used_again() -> None:
    """What is wrong with the scale starts again with each: 3 % of a pitot, 40 % of a steady airspeed."""
    navigator = Navigator(CONFIG)
    scales: dict[int, float] = {}
    for record in recorded():
        if isinstance(record, AirData):
            if 120 < record.t_ns / NS < 150:
                continue
            record = replace(record, airspeed=record.airspeed + 1e-3 * math.sin(record.t_ns))
        navigator.handle(record)
        bank = navigator._state.bank
        if bank is not None:
            scales[record.rx_ns // NS] = float(bank.P[int(bank.L.argmax()), SCALE, SCALE]) ** 0.5
        if record.rx_ns > 180 * NS:
            break
    assert scales[119] < 0.04 and scales[179] < 0.04
    assert max(scales[t] for t in range(125, 140)) > 0.1
    interval = navigator._state.nominal and navigator._state.nominal.interval
    assert interval is not None and interval.airspeed == "pitot"


def taken_from(changed: list[Input], until_s: float) -> tuple[dict[int, str], list[str]]:
    """What the airspeed is taken from, by the second, and what is reported of it."""
    navigator, found, texts = Navigator(CONFIG), dict[int, str](), list[str]()
    for record in changed:
        for out in navigator.handle(record):
            if isinstance(out, Event) and ("used" in out.text or "switch" in out.text):
                texts.append(out.text)
        nominal = navigator._state.nominal
        if nominal is not None and nominal.interval is not None:
            found[record.rx_ns // NS] = nominal.interval.airspeed
        if record.rx_ns > until_s * NS:
            break
    return found, texts


@pytest.mark.parametrize(("lost_s", "apart_s"), [(math.inf, 0.0), (150.0, 0.0), (150.0, 0.9)])
def test_a_pitot_that_sticks_is_replaced_though_the_autopilot_calls_it_healthy(
    lost_s: float, apart_s: float
) -> None:
    """Without GNSS it flies by it: the pilot must switch it off. A stream of 1 Hz shows it too."""
    changed, last_ns = list[Input](), 0
    for record in recorded():
        if isinstance(record, AirData):
            if record.t_ns - last_ns < apart_s * NS:
                continue
            last_ns = record.t_ns
            changed.append(AirspeedSensor(record.t_ns, record.rx_ns, True))
            if record.t_ns > 120 * NS:
                record = replace(record, airspeed=12.0, sensed=True)
        if not isinstance(record, Gnss) or record.t_ns < lost_s * NS:
            changed.append(record)
    found, texts = taken_from(changed, 160.0)
    assert found[119] == "pitot"
    assert found[145] == found[159] == "steady"
    advice = ["switch the airspeed sensor off: ARSPD_USE 0"] if lost_s < 160.0 else []
    assert texts == ["airspeed is not used: it stands still at 12 m/s", *advice]


def test_a_pitot_that_the_autopilot_takes_again_without_gnss_is_reported_again() -> None:
    """ArduPlane switches one off that sticks, and on again as GNSS is lost."""
    changed: list[Input] = []
    for record in recorded():
        t = record.t_ns / NS
        if isinstance(record, AirData):
            used = not 125.0 < t < 150.0
            changed.append(AirspeedSensor(record.t_ns, record.rx_ns, used, used))
            if t > 120.0:
                record = replace(record, airspeed=12.0, sensed=True)
        if not isinstance(record, Gnss) or t < 150.0:
            changed.append(record)
    assert taken_from(changed, 180.0)[1] == [
        "airspeed is not used: the autopilot does not use its sensor",
        "airspeed is not used: it stands still at 12 m/s",
        "switch the airspeed sensor off: ARSPD_USE 0",
    ]


@pytest.mark.flight
def test_an_autopilot_that_restarts_in_flight_leaves_the_steady_airspeed_as_it_was() -> None:
    """It was the speed over ground then, with the scale of the one before: a healthy GNSS was doubted."""
    records = [r for r in stated(fixed_wing=True, flying=True) if not 200 < r.t_ns / NS < 204]
    records += [Reboot(204 * NS, 204 * NS, 1), Vehicle(205 * NS, 205 * NS, fixed_wing=True, flying=True)]
    navigator, found, before = Navigator(CONFIG), list[float](), None
    for record in sorted(records, key=lambda record: record.rx_ns):
        if record.rx_ns > 260 * NS:
            break
        navigator.handle(record)
        if isinstance(record, Reboot):
            before = navigator.state.sensors.steady_m_s
        found.append(max(navigator.state.false, default=0.0))
    after = navigator.state.sensors
    assert own_channel.is_steady(after, record.t_ns)
    assert before is not None and after.steady_m_s == before
    assert max(found) < 0.5


def test_a_sensor_that_the_autopilot_does_not_use_is_replaced() -> None:
    """ArduPlane switches one off that fails (SYS_STATUS); its driver calls it healthy (AIRSPEED)."""
    changed: list[Input] = []
    for record in recorded():
        if isinstance(record, AirData):
            used = not 120 < record.t_ns / NS < 150
            changed.append(AirspeedSensor(record.t_ns, record.rx_ns, used, used))
            changed.append(AirspeedSensor(record.t_ns, record.rx_ns, True))
            record = replace(record, airspeed=record.airspeed + 1e-3 * math.sin(record.t_ns))
        changed.append(record)
    found, texts = taken_from(changed, 220.0)
    assert found[119] == found[179] == "pitot"
    assert found[135] == found[149] == "steady"
    assert texts == [
        "airspeed is not used: the autopilot does not use its sensor",
        "airspeed is used again",
    ]


@pytest.mark.parametrize(("name", "fault_s"), [("plane_straight", 290.0), ("plane_turbulence", 50.0)])
def test_the_wind_of_a_pitot_that_stuck_is_not_gone_on_with(name: str, fault_s: float) -> None:
    """ArduPlane's, stuck at 8 m/s, is used for 7 s: the wind was 14 m/s off after it, one sigma 0.9."""
    navigator, records = Navigator(CONFIG), recording(name)
    begin_ns, winds = records[0].t_ns, dict[int, Any]()
    navigator.handle(Vehicle(begin_ns, begin_ns, multirotor=False, fixed_wing=True, flying=True))
    for record in records:
        t = (record.t_ns - begin_ns) / NS - fault_s
        if isinstance(record, AirData):
            navigator.handle(AirspeedSensor(record.t_ns, record.rx_ns, t < 7.0, t < 7.0))
            airspeed = 8.0 + 1e-3 * math.sin(record.t_ns) if t > 0.0 else record.airspeed
            record = replace(record, airspeed=airspeed, sensed=True)
        navigator.handle(record)
        bank = navigator._state.bank
        if bank is not None:
            winds[round(t)] = bank.x[int(bank.L.argmax()), WIND]
        if t > 40.0:
            break
    steady = navigator._state.sensors.steady_m_s
    assert steady is not None and 18.0 < steady < 30.0
    assert math.dist(winds[6], winds[-1]) > 8.0
    assert max(math.dist(winds[t], winds[-1]) for t in range(20, 41)) < 4.0


def test_a_pitot_that_comes_back_in_a_strong_headwind_is_not_false() -> None:
    """ArduPlane does not use a healthy one against 17 m/s, 20 s after take-off, for 80 s.

    What was known of the wind half a minute before was nothing; the speed over ground was taken for that
    through the air, the wind for 1 +- 3 m/s, and the pitot was excluded when it came back.
    """
    plan = FlightPlan((Leg(150, 0, 24, 100),), winds=(WindChange(0, -17, 0),))
    scenario = dataclasses.replace(SCENARIOS["stock"], plan=plan)
    navigator, wind = Navigator(config_of("stock")), np.zeros(2)
    navigator.handle(Vehicle(0, 0, multirotor=False, fixed_wing=True, flying=True))
    for record in World(scenario).records(sensors_of(config_of("stock"))):
        if isinstance(record, AirData):
            is_used = not 35.0 < record.t_ns / NS < 115.0
            navigator.handle(AirspeedSensor(record.t_ns, record.rx_ns, is_used, is_used))
        navigator.handle(record)
        state = navigator.state
        if state.bank is not None:
            wind = state.bank.x[int(state.bank.L.argmax()), WIND]
            assert state.reported[AIRSPEED : AIRSPEED + 1] in ((), (0,))
    assert math.dist(wind, (-17.0, 0.0)) < 4.0


@pytest.mark.parametrize("sensed", [True, False])
def test_the_velocity_does_not_jump_where_the_airspeed_becomes_the_driver(sensed: bool) -> None:
    """It is that over ground still, and the nominal one is the one through the air (8 and 14 m/s apart)."""
    navigator, last = Navigator(CONFIG), None
    for record in recorded() if sensed else without_airspeed():
        for out in navigator.handle(record):
            if isinstance(out, Solution) and out.sources & Source.AIR_DATA:
                assert last is not None and math.dist(out.v_n[:2], last.v_n[:2]) < 1.0
                return
            last = out if isinstance(out, Solution) else last
    raise AssertionError("no solution by airspeed")


def test_an_airspeed_without_a_sensor_is_no_source_that_may_be_false() -> None:
    navigator = Navigator(CONFIG)
    for record in without_airspeed():
        navigator.handle(record)
        if navigator._state.bank is not None:
            assert navigator._state.false[AIRSPEED] == 0.0
        if record.rx_ns > 60 * NS:
            break
    assert navigator._state.nominal and navigator._state.nominal.interval
    assert navigator._state.nominal.interval.airspeed == "steady"


@pytest.mark.flight
def test_the_smoother_is_the_two_point_solution_with_a_steady_airspeed_too() -> None:
    records = [r for r in without_airspeed() if not isinstance(r, Gnss) or not 150 < r.t_ns / NS < 200]
    runs = smooth_flight((r for r in records if r.rx_ns < 260 * NS), CONFIG, check=True)
    assert len(runs) == 1 and runs[0].apart_sigma < 1e-6


def test_as_the_driver_it_is_off_by_what_it_wanders() -> None:
    """Along the nose: the integral of a Gauss-Markov velocity of STEADY_M_S and STEADY_S, known at first."""
    settings = Amplitudes(wind_change_m_s_sqrt_s=1e-4)
    V, T, step = (20.0, 0.0), 60.0, 1.0
    covariance = np.zeros((N, N))
    for _ in range(round(T / step)):
        interval = add_velocity(begin("air", V)._replace(airspeed="steady"), step, V)
        Phi, Q = Propagator(settings).transition(interval)
        Phi[:, [SCALE, HEADING, CRAB]] = 0.0
        covariance = Phi @ covariance @ Phi.T + Q[0]
    stays = math.exp(-T / STEADY_S)
    exact = (STEADY_M_S * STEADY_S) ** 2 * (2.0 * T / STEADY_S - 3.0 + 4.0 * stays - stays**2)
    assert math.sqrt(covariance[0, 0]) == pytest.approx(math.sqrt(exact), rel=1e-4)


START = Geodetic(0.9, 0.6, 500.0)


def speeding(seed: int) -> Iterator[tuple[Input, Geodetic]]:
    """Records of a fixed wing by attitude and GNSS at 1 Hz alone, and where it is: 12 to 26 m/s and back."""
    rng, north, east, heading = np.random.default_rng(seed), 0.0, 0.0, 0.3
    for k in range(1600):
        t, t_ns = 0.1 * k, k * NS // 10
        speed = 19.0 - 7.0 * math.cos(2.0 * math.pi * t / 30.0) if t > 40.0 else 12.0
        v_n = np.array((speed * math.cos(heading) + 4.0, speed * math.sin(heading) - 3.0))
        north, east = north + 0.1 * v_n[0], east + 0.1 * v_n[1]
        heading += 0.006 * math.sin(2.0 * math.pi * t / 70.0)
        place = displace(*START, north, east, 0.0)
        yield Attitude(t_ns, t_ns, 1e-6 * k, 0.02, heading), place
        if k % 10 == 0:
            yield Vehicle(t_ns, t_ns, multirotor=False, fixed_wing=True, flying=True), place
            lat, lon, alt = displace(*place, *(0.8 * rng.standard_normal(2)), 0.0)
            seen = v_n + 0.1 * rng.standard_normal(2)
            yield Gnss(t_ns, t_ns, 0, t_ns // 1000, 3, lat, lon, alt, 1.5, 3.0, v_n=(*seen, 0.0)), place


@pytest.mark.parametrize("seed", [1, 2])
def test_a_speed_that_changes_takes_nothing_off_a_healthy_gnss(seed: int) -> None:
    """It was 3.2 m off r.m.s. beside a GNSS of 1.2: no velocity was kept from one fix to the next."""
    navigator, own, gnss = Navigator(CONFIG), list[float](), list[float]()
    for record, place in speeding(seed):
        found = navigator.handle(record)
        if record.t_ns < 80 * NS:
            continue
        if isinstance(record, Gnss):
            gnss.append(math.hypot(*separation(Geodetic(record.lat, record.lon, 0.0), place)[:2]))
        for out in found:
            if isinstance(out, Solution) and out.t_ns == record.t_ns:
                own.append(math.hypot(*separation(Geodetic(out.lat, out.lon, 0.0), place)[:2]))
    assert len(own) > 600
    assert np.sqrt(np.mean(np.square(own))) < 1.2 * np.sqrt(np.mean(np.square(gnss)))
