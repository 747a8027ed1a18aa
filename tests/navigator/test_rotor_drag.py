"""A multirotor's drag as its airspeed: on a recorded copter, and linearised rightly."""

from __future__ import annotations

import heapq
import math
from collections.abc import Callable, Iterable
from typing import Any, NamedTuple

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from msgspec.structs import replace

from companion.analysis import simulated_rsbn
from companion.analysis.smoothing import smooth_flight
from companion.config import Config, load
from companion.nav.geometry import Geodetic, separation
from companion.navigator import Navigator
from companion.navigator.hypotheses import AIRSPEED, GNSS, VELOCITY
from companion.navigator.own_channel import AirspeedSums
from companion.navigator.own_error_model import (
    ACCELEROMETER,
    GUST,
    HEADING,
    SCALE,
    VERSINE,
    WIND,
    N,
    drag_rows,
)
from companion.navigator.own_error_model import (
    VELOCITY as SPEED,
)
from companion.records import (
    AirData,
    AirspeedSensor,
    Attitude,
    Gnss,
    Imu,
    Input,
    Pressure,
    Rejection,
    Solution,
    Vehicle,
)
from companion.records import Source as Basis
from tests.recordings import recording

NS = 1_000_000_000
LOSS_S = 105.0  # since boot; it flies at 2 to 14 m/s
DEFAULT = load(flags={"output.profile": "ardupilot"}, environment={})
WITHOUT = load(flags={"output.profile": "ardupilot", "air_data.rotor_drag_per_s": 0.0}, environment={})
Change = Callable[[Input], Input | None]


def recorded() -> tuple[Any, ...]:
    return recording("copter")


class Flown(NamedTuple):
    """Errors against GNSS by time (s), in m and in sigmas an axis; greatest probability that GNSS, airspeed
    and velocity of GNSS are false; rejections; the last solution.
    """

    errors: list[tuple[float, float, float]]
    false: tuple[float, float, float]
    rejections: list[Rejection]
    last: Solution | None

    def rms(self, start: float, end: float) -> float:
        found = [e for t, e, _ in self.errors if start <= t < end]
        return math.sqrt(sum(e * e for e in found) / len(found))


def fly(
    config: Config,
    change: Change = lambda record: record,
    dark: tuple[float, float] = (0, 0),
    added: Iterable[Input] = (),
) -> Flown:
    """Fly the recording, each record changed or left out, without GNSS for a time (s)."""
    fixes = [r for r in recorded() if isinstance(r, Gnss)]
    t = np.array([r.t_ns for r in fixes])
    lat, lon = np.array([(r.lat, r.lon) for r in fixes]).T
    navigator, rejections, last = Navigator(config), list[Rejection](), None
    errors: list[tuple[float, float, float]] = []
    false = np.zeros(3)
    for record in heapq.merge(recorded(), added, key=lambda record: record.t_ns):
        if isinstance(record, Gnss) and dark[0] * NS < record.t_ns < dark[1] * NS:
            continue
        changed = change(record)
        for out in () if changed is None else navigator.handle(changed):
            if isinstance(out, Rejection):
                rejections.append(out)
            elif isinstance(out, Solution):
                last = out
                place = Geodetic(np.interp(out.t_ns, t, lat), np.interp(out.t_ns, t, lon), 0.0)
                apart = separation(Geodetic(out.lat, out.lon, 0.0), place)[:2]
                sigmas = np.sqrt([out.covariance[0], out.covariance[3]])
                errors.append((out.t_ns / NS, float(np.hypot(*apart)), float(np.abs(apart / sigmas).max())))
        held = navigator._state.false
        if held:
            false = np.maximum(false, [held[GNSS], held[AIRSPEED], held[VELOCITY]])
    return Flown(errors, (float(false[0]), float(false[1]), float(false[2])), rejections, last)


@pytest.mark.flight
def test_a_real_copter_reckons_by_its_drag() -> None:
    """After a minute without GNSS it is less than half as far off as by its IMU alone, within its sigmas."""
    dark = LOSS_S, LOSS_S + 61.0
    with_drag, alone = fly(DEFAULT, dark=dark), fly(WITHOUT, dark=dark)
    end = LOSS_S + 55.0, LOSS_S + 60.0
    assert with_drag.rms(*end) < 0.5 * alone.rms(*end)
    assert max(sigmas for t, _, sigmas in with_drag.errors if LOSS_S < t < end[1]) < 3.0
    assert with_drag.last is not None and alone.last is not None
    assert with_drag.last.sources & Basis.AIR_DATA
    assert not alone.last.sources & Basis.AIR_DATA


@pytest.mark.flight
def test_a_copter_that_states_that_it_hovers_reckons_by_its_drag() -> None:
    """ArduCopter's EXTENDED_SYS_STATE has the VTOL state of a multicopter: its drag was not used at all."""

    def hovering(record: Input) -> Input:
        return replace(record, hovering=True) if isinstance(record, Vehicle) else record

    dark = LOSS_S, LOSS_S + 30.0
    assert fly(DEFAULT, hovering, dark).errors == fly(DEFAULT, dark=dark).errors


@pytest.mark.flight
def test_with_gnss_nothing_is_false_and_nothing_rejected() -> None:
    flown = fly(DEFAULT)
    assert max(flown.false) < 0.5
    assert flown.rms(30.0, 215.0) < 2.0
    assert not [r for r in flown.rejections if r.source == "gnss"]


def at_a_hertz() -> Change:
    """An IMU of 1 Hz and attitudes of 2 Hz, as a ground station requests them."""
    last: dict[type[Input], int] = {}

    def thinned(record: Input) -> Input | None:
        if isinstance(record, Imu | Attitude):
            apart = NS if isinstance(record, Imu) else NS // 2
            if record.t_ns - last.get(type(record), 0) < apart:
                return None
            last[type(record)] = record.t_ns
        return record

    return thinned


@pytest.mark.flight
@pytest.mark.parametrize("begin_s", [60.0, 105.0, 140.0])
def test_with_an_imu_of_one_hertz_it_reckons_by_single_samples_of_its_drag(begin_s: float) -> None:
    """Held straight on it was 389, 216 and 346 m off in the last ten seconds of the minute without GNSS."""
    dark = (begin_s, begin_s + 60.0)
    by_drag, held = (fly(config, at_a_hertz(), dark) for config in (DEFAULT, WITHOUT))
    assert by_drag.rms(dark[1] - 10.0, dark[1]) < 60.0
    assert held.rms(dark[1] - 10.0, dark[1]) < 130.0
    within = [sigmas < 2.0 for t, _, sigmas in by_drag.errors if dark[0] < t < dark[1]]
    assert np.mean(within) > 0.95


def crooked(record: Input) -> Input:
    """An autopilot that is mounted with a roll of 10 deg against the plane of the rotors."""
    angle = math.radians(10.0)
    if isinstance(record, Imu):
        x, y, z = record.f_b
        c, s = math.cos(angle), math.sin(angle)
        return replace(record, f_b=(x, c * y + s * z, c * z - s * y))
    return replace(record, roll=record.roll + angle) if isinstance(record, Attitude) else record


def half(record: Input) -> Input:
    """A drag of which but half is measured, from a time on."""
    if not isinstance(record, Imu) or record.t_ns < 80 * NS:
        return record
    return replace(record, f_b=(0.5 * record.f_b[0], 0.5 * record.f_b[1], record.f_b[2]))


def stuck(record: Input) -> Input:
    """An accelerometer that measures no drag at all, as that of a simulator without one."""
    return replace(record, f_b=(0.0, 0.0, record.f_b[2])) if isinstance(record, Imu) else record


@pytest.mark.flight
@pytest.mark.parametrize("change", [crooked, half, stuck])
def test_beside_a_healthy_gnss_a_wrong_drag_does_no_harm(change: Change) -> None:
    flown = fly(DEFAULT, change)
    assert flown.false[0] < 0.5  # GNSS
    assert not [r for r in flown.rejections if r.source == "gnss"]
    assert max(flown.rms(t, t + 10.0) for t in range(30, 200, 10)) < 5.0


def noisy(record: Input) -> Input:
    """Accelerometers with white noise of 3 m/s^2."""
    if not isinstance(record, Imu):
        return record
    noise = 3.0 * np.random.default_rng(record.t_ns).standard_normal(3)
    return replace(record, f_b=tuple((record.f_b + noise).tolist()))


@pytest.mark.flight
def test_beside_a_noisy_imu_and_a_beacon_a_healthy_gnss_is_beyond_doubt() -> None:
    """As airspeed of 1 m/s, noise of 3 m/s^2 held a copter's GNSS false: 131 m off."""
    fix = next(r for r in recorded() if isinstance(r, Gnss))
    beacon = simulated_rsbn.ListedBeacon(1, fix.lat + math.radians(0.54), fix.lon, 3000.0)
    track = simulated_rsbn.extract_track(recorded(), DEFAULT)
    flown = fly(DEFAULT, noisy, added=simulated_rsbn.simulate_measurements([beacon], track, 0))
    assert flown.false[0] < 0.05
    assert not [r for r in flown.rejections if r.source == "gnss"]
    assert flown.rms(30.0, 215.0) < 2.0


@given(noise=st.floats(0.1, 10.0), speed=st.floats(0.0, 20.0), seed=st.integers(0, 1000))
def test_the_scatter_of_a_mean_is_that_of_its_samples(noise: float, speed: float, seed: int) -> None:
    samples = 400
    rng = np.random.default_rng(seed)
    sums = AirspeedSums(0, (speed, 0.0))
    for n, e in noise * rng.standard_normal((samples, 2)):
        sums = sums.with_one((0.0, 0.0), (speed + n, e))
    assert sums.scatter == pytest.approx(noise**2 / samples, rel=0.35)


@pytest.mark.parametrize(
    "added",
    [
        (Vehicle(15 * NS, 15 * NS, multirotor=False),),
        (Vehicle(15 * NS, 15 * NS, flying=False),),
        tuple(AirspeedSensor(t * NS, t * NS, True) for t in range(15, 215, 5)),
        tuple(AirData(t * NS, t * NS, 3.0 + 0.1 * (t % 7), sensed=True) for t in range(15, 215, 5)),
    ],
)
def test_it_is_used_of_flying_multirotors_without_an_airspeed_sensor_only(added: tuple[Input, ...]) -> None:
    navigator, last = Navigator(DEFAULT), None
    for record in sorted((*recorded()[:1500], *added), key=lambda record: record.t_ns):
        last = next((o for o in navigator.handle(record) if isinstance(o, Solution)), last)
    assert last is not None and not last.sources & Basis.AIR_DATA


def test_it_is_used_again_once_the_airspeed_sensor_is_silent() -> None:
    navigator, used_ns = Navigator(DEFAULT), list[int]()
    airspeed = [AirData(t * NS // 5, t * NS // 5, 3.0 + 0.1 * (t % 7), sensed=True) for t in range(75, 125)]
    for record in sorted((*recorded()[:2000], *airspeed), key=lambda record: record.t_ns):
        for out in navigator.handle(record):
            if isinstance(out, Solution) and out.sources & Basis.AIR_DATA:
                used_ns.append(out.t_ns)
    nominal = navigator._state.nominal
    assert nominal is not None and nominal.interval is not None and nominal.interval.airspeed == "drag"
    assert used_ns and min(used_ns) > airspeed[-1].t_ns + 10 * NS


def test_a_multirotor_with_an_airspeed_sensor_uses_that_though_nothing_states_that_it_flies() -> None:
    added: list[Input] = [Vehicle(15 * NS, 15 * NS, multirotor=True)]
    added += [AirspeedSensor(t * NS, t * NS, True) for t in range(15, 40, 5)]
    added += [AirData(t * NS // 5, t * NS // 5, 12.0 + 0.1 * (t % 7)) for t in range(100, 200)]
    copter = [r for r in recorded()[:600] if not isinstance(r, Vehicle)]
    navigator, used = Navigator(DEFAULT), False
    for record in sorted((*copter, *added), key=lambda record: record.t_ns):
        for out in navigator.handle(record):
            used |= isinstance(out, Solution) and bool(out.sources & Basis.AIR_DATA)
    assert used


def test_a_multirotor_whose_autopilot_does_not_use_its_airspeed_sensor_uses_its_drag() -> None:
    """Neither was used: the airspeed because of the autopilot, the drag because of the sensor."""
    added: list[Input] = []
    for t in range(80, 400):
        t_ns = t * NS // 5
        added += [AirspeedSensor(t_ns, t_ns, False, False), AirspeedSensor(t_ns, t_ns, True)]
        added.append(AirData(t_ns, t_ns, 12.0 + 0.1 * (t % 7), sensed=True))
    navigator, last = Navigator(DEFAULT), None
    for record in sorted((*recorded()[:1500], *added), key=lambda record: record.t_ns):
        last = next((o for o in navigator.handle(record) if isinstance(o, Solution)), last)
    assert last is not None and last.sources & Basis.AIR_DATA
    nominal = navigator._state.nominal
    assert nominal is not None and nominal.interval is not None and nominal.interval.airspeed == "drag"


@pytest.mark.parametrize(("height", "begins_s"), [(2.0, 30.0), (20.0, 20.0)])
def test_while_it_takes_off_it_is_not_used(height: float, begins_s: float) -> None:
    """The ground pushes too: up to 5 m above it, or for ten seconds."""
    navigator, first_s = Navigator(DEFAULT), math.inf
    landed, flying = Vehicle(15 * NS, 15 * NS, True, False), Vehicle(20 * NS, 20 * NS, True, True)
    copter = [r for r in recorded()[:1000] if not isinstance(r, Vehicle)]
    above = 12.0 * height  # Pa
    pressures = [
        Pressure(t * NS // 5, t * NS // 5, 101_325.0 - above * (t > 100) + 0.1 * (t % 7))
        for t in range(75, 300)
    ]
    for record in sorted((*copter, landed, flying, *pressures), key=lambda record: record.t_ns):
        for out in navigator.handle(record):
            if isinstance(out, Solution) and out.sources & Basis.AIR_DATA:
                first_s = min(first_s, out.t_ns / NS)
    assert begins_s < first_s < begins_s + 1.5


@pytest.mark.flight
def test_the_smoother_is_the_two_point_solution_with_drag_too() -> None:
    runs = smooth_flight(
        (r for r in recorded() if not isinstance(r, Gnss) or not 105 * NS < r.t_ns < 165 * NS),
        DEFAULT,
        check=True,
    )
    assert len(runs) == 1 and runs[0].apart_sigma < 1e-6


VECTOR = st.lists(st.floats(-10.0, 10.0), min_size=2, max_size=2).map(np.array)


ANGLE = st.floats(-math.pi, math.pi)


@given(VECTOR, VECTOR, VECTOR, VECTOR, st.floats(-0.5, 1.0), ANGLE, ANGLE)
def test_the_row_of_drag_is_its_derivative(
    over_ground: np.ndarray,
    error: np.ndarray,
    wind: np.ndarray,
    V: np.ndarray,
    scale: float,
    heading: float,
    off: float,
) -> None:
    """z - H x is the predicted drag less the measured one, and H is what it changes by, at that state."""
    x = np.zeros((1, N))
    x[0, SPEED], x[0, WIND], x[0, SCALE], x[0, GUST] = error, wind, scale, 0.3
    x[0, ACCELEROMETER] = 0.1, -0.05
    x[0, HEADING], x[0, VERSINE] = math.sin(off), 1.0 - math.cos(off)

    def innovation(x: np.ndarray) -> np.ndarray:
        z, H = drag_rows(x, tuple(over_ground), tuple(V), heading, 0.2)
        return (z - np.einsum("rij,rj->ri", H, x))[0]

    air, f = over_ground - error - wind - 0.3, np.array((0.1, -0.05))
    seen = (1.0 + scale) * turned(air, off) - turned(f, heading) / 0.2
    np.testing.assert_allclose(innovation(x), seen - V, atol=1e-12)
    _, H = drag_rows(x, tuple(over_ground), tuple(V), heading, 0.2)
    step = 1e-6
    for k in range(N):
        moved = x.copy()
        moved[0, k] += step
        slope = (innovation(x) - innovation(moved)) / step
        np.testing.assert_allclose(slope, H[0, :, k], atol=1e-4)


def turned(v: np.ndarray, angle: float) -> np.ndarray:
    """A vector turned to the right, by an angle (rad)."""
    c, s = math.cos(angle), math.sin(angle)
    return np.array(((c, -s), (s, c))) @ v
