"""Air-data dead reckoning: a channel that knows nothing of the autopilot's position, on recorded losses."""

from __future__ import annotations

import copy
import math
from collections.abc import Iterable, Iterator
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple

import msgspec
import numpy as np
import pytest

from companion.analysis.error_statistics import position_from_beacon
from companion.analysis.error_statistics import root_mean_square as rms
from companion.config import Config, load, to_toml
from companion.importers import sources
from companion.nav.geometry import Geodetic, displace, from_enu, separation, slant_range_azimuth
from companion.navigator import Navigator, air_data_channel
from companion.records import (
    INPUTS,
    AirData,
    Attitude,
    Event,
    GlobalPosition,
    Gnss,
    LocalOrigin,
    LocalPosition,
    RsbnFix,
    Solution,
    Source,
    Truth,
    Tuning,
    Wind,
)
from companion.units import Floats
from tests.recordings import recording

NS = 1_000_000_000
pytestmark = pytest.mark.flight

DATA = Path(__file__).parents[1] / "data"
SHARED = Path(__file__).parents[2].parent / "shared" / "data" / "autopilot_sitl"
SIGMA_AZIMUTH, SIGMA_RANGE = math.radians(0.125), 100.0  # one sigma
AIR = load(flags={"inertial.source": "air_data", "output.profile": "ardupilot"}, environment={})


class Recorded(NamedTuple):
    """Records of a flight, when GNSS was lost, and the truth as a function of time."""

    records: tuple[Any, ...]
    loss_ns: int
    t: Floats
    place: Floats

    def truth(self, t_ns: int) -> Geodetic:
        s = (t_ns - self.loss_ns) * 1e-9
        return Geodetic(*(float(np.interp(s, self.t, column)) for column in self.place.T))

    def since(self, record: Any) -> float:
        return float((record.t_ns - self.loss_ns) * 1e-9)


def sensed(record: Any) -> Any:
    """These aircraft have an airspeed sensor; the cut recordings do not say so."""
    return msgspec.structs.replace(record, sensed=True) if isinstance(record, AirData) else record


def recorded(records: Iterable[Any]) -> Recorded:
    kept = tuple(sensed(r) for r in records if isinstance(r, (*INPUTS, Truth)))
    loss = max(r.t_ns for r in kept if isinstance(r, Gnss) and r.has_3d_fix)
    truths = [r for r in kept if isinstance(r, Truth) and r.lat != 0.0]
    t = np.array([(r.t_ns - loss) * 1e-9 for r in truths])
    new = np.concatenate([[True], np.diff(t) > 0.0])
    return Recorded(kept, loss, t[new], np.array([(r.lat, r.lon, r.alt) for r in truths])[new])


@lru_cache(maxsize=4)
def flight(name: str) -> Recorded:
    """A recorded flight cut down to 5 Hz."""
    return recorded(recording(name))


def with_beacon(flown: Recorded, seed: int, bearing_deg: float, gap: tuple[float, float]) -> Iterator[Any]:
    """The flight with a beacon 60 km from where GNSS is lost, 1 Hz, silent within `gap` (s from the loss)."""
    rng, bearing = np.random.default_rng(seed), math.radians(bearing_deg)
    away = 60e3 * np.array([math.sin(bearing), math.cos(bearing), 0.0])
    beacon = from_enu(away, flown.truth(flown.loss_ns))._replace(alt=100.0)
    next_ns = 0
    for record in flown.records:
        yield record
        if isinstance(record, Truth) and record.t_ns >= next_ns:
            next_ns = record.t_ns + NS
            a, d = rng.standard_normal(2)
            sight = slant_range_azimuth(beacon, flown.truth(record.t_ns))
            if not gap[0] < flown.since(record) <= gap[1]:
                azimuth = (sight.azimuth + SIGMA_AZIMUTH * a) % math.tau
                distance = sight.slant_range + SIGMA_RANGE * d
                at = record.t_ns, record.rx_ns
                yield RsbnFix(*at, 7, *beacon, azimuth, distance, SIGMA_AZIMUTH, SIGMA_RANGE)


class Errors(NamedTuple):
    """Of the solutions: time from the loss (s), horizontal error and its claimed sigma (m)."""

    t: Floats
    error: Floats
    sigma: Floats


def flown_by(flown: Recorded, records: Iterable[Any], config: Config = AIR) -> Errors:
    return flown_on(flown, Navigator(config), records)


def flown_on(flown: Recorded, navigator: Navigator, records: Iterable[Any]) -> Errors:
    rows = []
    for record in records:
        if isinstance(record, Truth):
            continue
        for out in navigator.handle(record):
            if isinstance(out, Solution):
                north, east, _ = separation(Geodetic(out.lat, out.lon, 0.0), flown.truth(out.t_ns))
                sigma = math.sqrt(out.covariance[0] + out.covariance[3])
                rows.append((flown.since(out), math.hypot(north, east), sigma))
    return Errors(*np.array(rows).T)


def raw_rms(flown: Recorded, records: Iterable[Any], start: float, end: float) -> float:
    """Of the beacon's fixes alone, m."""
    errors = []
    for r in records:
        if isinstance(r, RsbnFix) and start <= flown.since(r) < end:
            true = flown.truth(r.t_ns)
            fix = position_from_beacon(r, true.alt)
            assert fix is not None
            errors.append(math.hypot(*separation(fix, true)[:2]))
    return rms(errors)


NEVER = (0.0, 0.0)
SEEDS = [0, *(pytest.param(seed, marks=pytest.mark.long) for seed in (1, 2))]


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize(
    "name", [pytest.param("plane_gps_loss", marks=pytest.mark.long), "plane_wind_change"]
)
def test_with_a_beacon_the_error_is_at_most_half_the_fixes(name: str, seed: int) -> None:
    flown = flight(name)
    records = list(with_beacon(flown, seed, 120.0 * seed, NEVER))
    found = flown_by(flown, records)
    late = found.t >= 60.0
    raw = raw_rms(flown, records, 60.0, 1e9)
    assert rms(found.error[late]) <= 0.5 * raw
    assert np.all(found.error[late] <= 3.0 * found.sigma[late])
    if name == "plane_gps_loss":
        two_sigma = 2.0 * math.hypot(60e3 * SIGMA_AZIMUTH, SIGMA_RANGE)
        assert found.error[found.t >= 0.0].max() <= two_sigma


@pytest.mark.long
@pytest.mark.parametrize(
    ("flags", "first_m", "third_m"),
    [({}, 70.0, 34.0), ({"rsbn.bias_azimuth_deg": 0.001, "rsbn.bias_range_m": 0.1}, 70.0, 30.0)],
    ids=["by default", "a beacon stated to have no bias"],
)
def test_a_step_of_the_wind_is_found_by_fixes_alone(
    flags: dict[str, float], first_m: float, third_m: float
) -> None:
    """Error in the first minute and from the third on, six noises; 80 m with a step an hour.

    What is left from the third minute on is the beacon's bias, as far as two minutes of GNSS have shown it.
    """
    air = {"inertial.source": "air_data", "output.profile": "ardupilot"}
    config, flown = load(flags=air | flags, environment={}), flight("plane_wind_change")
    found = [flown_by(flown, with_beacon(flown, seed, 120.0 * seed, NEVER), config) for seed in range(6)]

    def between(start: float, end: float) -> float:
        return rms(np.concatenate([f.error[(f.t >= start) & (f.t < end)] for f in found]))

    assert between(0.0, 60.0) < first_m
    assert between(120.0, math.inf) < third_m


@pytest.mark.long
@pytest.mark.parametrize("seed", range(3))
def test_a_minute_without_the_beacon_in_a_changed_wind_wherever_it_begins(seed: int) -> None:
    """From one minute after GNSS is lost on."""
    flown = flight("plane_wind_change")
    heard = [r for r in with_beacon(flown, seed, 120.0 * seed, NEVER) if not isinstance(r, Truth)]
    navigator, done = Navigator(AIR), 0
    for start in range(60, 181, 10):
        upto = next(k for k, r in enumerate(heard) if flown.since(r) > start)
        flown_on(flown, navigator, heard[done:upto])
        done = upto
        gap = [r for r in heard[upto:] if flown.since(r) <= start + 60.0 and not isinstance(r, RsbnFix)]
        found = flown_on(flown, copy.deepcopy(navigator), gap)
        assert found.t[-1] > start + 59.0
        assert found.error[-1] <= 200.0
        assert np.all(found.error <= 3.0 * found.sigma)


@pytest.mark.parametrize("seed", SEEDS)
def test_a_minute_without_the_beacon_by_the_restrictive_estimator(seed: int) -> None:
    flown = flight("plane_wind_change")
    records = [r for r in with_beacon(flown, seed, 120.0 * seed, (120.0, 180.0)) if flown.since(r) <= 180.0]
    """Its bound of the wind's change is for the operator to state: a wind that steps, here."""
    air = {"inertial.source": "air_data", "estimator.output": "restrictive", "output.profile": "ardupilot"}
    air |= {"air_data.wind_change_m_s_sqrt_s": 0.2}  # type: ignore[dict-item]
    found = flown_by(flown, records, load(flags=air, environment={}))
    assert found.t[-1] > 179.0
    assert found.error[-1] <= 200.0
    inside = found.t >= 120.0
    assert np.all(found.error[inside] <= 3.0 * found.sigma[inside])


@pytest.mark.long
@pytest.mark.parametrize(("seed", "before"), [(2, 60.0), (0, 110.0), (1, 110.0)])
def test_a_step_of_the_wind_is_not_taken_for_the_fault_of_a_beacon(seed: int, before: float) -> None:
    """By the only beacon left, however short GNSS was heard with it before."""
    flown = flight("plane_wind_change")
    records = [r for r in with_beacon(flown, seed, 120.0 * seed, NEVER) if flown.since(r) > -before]
    found = flown_by(flown, records)
    late = found.t >= 60.0
    assert rms(found.error[late]) <= 0.5 * raw_rms(flown, records, 60.0, 1e9)
    assert np.all(found.error[late] <= 3.0 * found.sigma[late])


def test_air_data_alone_drifts_no_more_than_the_autopilot_and_says_so() -> None:
    flown = flight("plane_gps_loss")
    found = flown_by(flown, flown.records)
    after = found.t >= 0.0
    at_end = (found.t > 235.0) & (found.t < 241.0)
    autopilot = 59.0  # m at 240 s, its own dead reckoning in this log
    assert found.error[at_end].max() <= 1.5 * autopilot
    assert np.all(found.error[after] <= 3.0 * found.sigma[after])


@pytest.mark.long
@pytest.mark.parametrize("name", ["plane_gps_loss", "plane_wind_change"])
def test_the_whole_logs_say_the_same_as_the_cut_ones(name: str) -> None:
    path = SHARED / f"{name}.tlog"
    if not path.exists():
        pytest.skip("the recordings are not here")
    flown = recorded(sources.open_source(path))
    records = list(with_beacon(flown, 1, 120.0, (120.0, 180.0)))
    found = flown_by(flown, records)
    late = (found.t >= 60.0) & ((found.t < 120.0) | (found.t > 200.0))
    assert rms(found.error[late]) <= 0.5 * raw_rms(flown, records, 60.0, 1e9)
    at_end = found.error[(found.t > 179.0) & (found.t <= 180.0)]
    assert at_end.max() <= 200.0


def test_nothing_of_the_autopilots_own_position_comes_back_to_it() -> None:
    """Whatever it says of where it is, how fast and in what wind, the outputs are the same bit for bit."""
    flown = flight("plane_gps_loss")
    records = [r for r in with_beacon(flown, 0, 120.0, NEVER) if -60.0 < flown.since(r) < 60.0]

    def mirrored(record: Any) -> Any:
        match record:
            case LocalPosition():
                moved = (1e4 - record.x_n[0], -1e4, 5.0)
                return msgspec.structs.replace(record, x_n=moved, v_n=(-30.0, 7.0, 1.0))
            case GlobalPosition():
                return msgspec.structs.replace(record, lat=0.1, lon=0.2, v_n=(-30.0, 7.0, 1.0))
            case AirData():
                changed = {"groundspeed": 99.0, "climb": 9.0, "heading": 1.0, "alt_msl": 9000.0}
                return msgspec.structs.replace(record, **changed)
        return record

    def outputs(records: Iterable[Any]) -> list[Any]:
        navigator = Navigator(AIR)
        found = [out for r in records if not isinstance(r, Truth) for out in navigator.handle(r)]
        return [out for out in found if not (isinstance(out, Event) and "local origin" in out.text)]

    lies: list[Any] = []
    for record in records:
        lies.append(mirrored(record))
        at = record.t_ns, record.rx_ns
        lies += [LocalOrigin(*at, 0.5, 0.5, 0.0), Wind(*at, (30.0, -30.0, 0.0))]
    plain = outputs(records)
    assert any(isinstance(out, Solution) for out in plain)
    assert outputs(lies) == plain


FED = load(flags={"output.profile": "ardupilot"}, environment={})
UNFED = load(flags={"inertial.independent": True}, environment={})


def test_another_channel_in_flight_begins_anew() -> None:
    flown = flight("plane_gps_loss")
    navigator, reported, solutions = Navigator(FED), [], 0
    for record in flown.records:
        if isinstance(record, Truth) or not -60.0 < flown.since(record) < 10.0:
            continue
        if not reported or (len(reported) == 1 and flown.since(record) > -10.0):
            config = UNFED if reported else FED
            navigator.handle(Tuning(record.t_ns, record.rx_ns, to_toml(config)))
        outs = navigator.handle(record)
        reported += [out.text for out in outs if isinstance(out, Event) and "inertial channel" in out.text]
        solutions += sum(isinstance(out, Solution) for out in outs)
    assert reported == [
        "inertial channel: own, by what arrives of imu, air data; guaranteed bound by airspeed",
        "inertial channel: local position of an INS of its own",
    ]
    assert solutions > 100


def test_all_estimators_run_on_one_stream() -> None:
    flown = flight("plane_wind_change")
    for leading in ("kalman", "minimax", "restrictive"):
        air = {"inertial.source": "air_data", "estimator.output": leading, "output.profile": "ardupilot"}
        navigator, last = Navigator(load(flags=air, environment={})), None
        for record in flown.records:
            if flown.since(record) < 20.0 and not isinstance(record, Truth):
                for out in navigator.handle(record):
                    last = out if isinstance(out, Solution) else last
        assert last is not None
        assert last.estimator == leading
        assert last.sources == Source.INERTIAL | Source.AIR_DATA
        assert last.disagreement is not None
        assert last.disagreement < 7.0 * 20.0  # what the step of the wind makes in this time


def circling(wind: tuple[float, float], scale: float, heading_error: float) -> Recorded:
    """Five minutes of circles at 25 m/s, GNSS for three of them, the air data wrong by scale and heading."""
    rng = np.random.default_rng(3)
    here = Geodetic(math.radians(60.0), math.radians(30.0), 500.0)
    records: list[Any] = []
    for k in range(1, 1500):
        t_ns, psi = k * NS // 5, k / 5 / 20.0
        v = 25.0 * math.cos(psi) + wind[0], 25.0 * math.sin(psi) + wind[1], 0.0
        here = displace(*here, 0.2 * v[0], 0.2 * v[1], 0.0)
        records.append(Attitude(t_ns, t_ns, 0.0, 0.0, (psi + heading_error) % math.tau))
        records.append(AirData(t_ns, t_ns, 25.0 * (1.0 + scale) + 1e-9 * (k % 2), true=True))
        records.append(Truth(t_ns, t_ns, *here, v))
        if k < 900:
            e = 0.7 * rng.standard_normal(2)
            fix = displace(*here, e[0], e[1], 0.0)
            records.append(Gnss(t_ns, t_ns, 0, t_ns // 1000, 3, *fix, 0.7, 1.0, v_n=v))
    return recorded(records)


def test_turns_teach_the_errors_of_airspeed_and_heading() -> None:
    flown = circling((6.0, -4.0), 0.03, math.radians(2.0))
    found = flown_by(flown, flown.records)
    assert (
        found.error[found.t > 100.0].max() < 40.0
    )  # left alone, 3 % and 2 deg walk 100 m off in each circle
    assert np.all(found.error[found.t > 0.0] <= 3.0 * found.sigma[found.t > 0.0])


def test_a_silence_of_the_air_data_widens_the_claim() -> None:
    flown = flight("plane_gps_loss")
    whole = [r for r in flown.records if flown.since(r) < 20.0]
    silent = [r for r in whole if not (isinstance(r, AirData) and 5.0 < flown.since(r) < 15.0)]
    plain, found = flown_by(flown, whole), flown_by(flown, silent)
    assert found.sigma[-1] > 2.0 * plain.sigma[-1]
    assert np.all(found.error[found.t > 0.0] <= 3.0 * found.sigma[found.t > 0.0])


@pytest.mark.parametrize("stuck_at", [6.0, 60.0])
def test_a_pitot_that_steps_does_not_move_the_position(stuck_at: float) -> None:
    """GNSS is healthy. The position was 26 m off before the next fix came, at a claimed sigma of 4 m."""
    flown, navigator = flight("plane_gps_loss"), Navigator(AIR)
    records, begin = [r for r in flown.records if flown.since(r) < 0.0], -20.0
    for k, r in enumerate(records):
        if isinstance(r, AirData) and flown.since(r) > begin:
            records[k] = msgspec.structs.replace(r, airspeed=stuck_at)
    found = flown_on(flown, navigator, records)
    after = found.t > begin
    assert after.sum() > 50 and found.error[after].max() < 8.0
    assert not navigator.state.reported[0]


@pytest.mark.parametrize(("height", "ratio"), [(0.0, 1.0), (1000.0, 0.9075), (5000.0, 0.6009)])
def test_true_airspeed_by_the_standard_atmosphere(height: float, ratio: float) -> None:
    """Densities of the standard atmosphere, ISO 2533, over that at sea level, by geopotential height."""
    four_digits = 1e-4
    record = AirData(0, 0, 20.0)
    by_height = air_data_channel.true_airspeed(record, None, height)
    assert by_height == pytest.approx(20.0 / math.sqrt(ratio), rel=four_digits)
    pressure = {0.0: 101325.0, 1000.0: 89874.6, 5000.0: 54019.9}[height]
    assert air_data_channel.true_airspeed(record, pressure, 0.0) == pytest.approx(by_height, rel=four_digits)
    assert air_data_channel.pressure_altitude(pressure) == pytest.approx(height, abs=0.5)


@pytest.mark.parametrize(
    ("height", "pressure", "ratio"), [(15e3, 12044.6, 0.15810), (20e3, 5474.88, 0.071865)]
)
def test_above_the_tropopause_the_temperature_stays(height: float, pressure: float, ratio: float) -> None:
    """ISO 2533 as above. By the lapse of the lower air airspeed was 6 and 13 % low, height 0.2 and 1.1 km."""
    found = air_data_channel.true_airspeed(AirData(0, 0, 20.0), pressure, 0.0)
    assert found == pytest.approx(20.0 / math.sqrt(ratio), rel=1e-4)
    assert air_data_channel.pressure_altitude(pressure) == pytest.approx(height, abs=0.5)


def test_it_begins_at_a_beacons_fix_where_there_is_no_gnss() -> None:
    flown = flight("plane_gps_loss")
    records = [r for r in with_beacon(flown, 0, 120.0, NEVER) if not isinstance(r, Gnss)]
    found = flown_by(flown, [r for r in records if -90.0 < flown.since(r) < 60.0])
    assert rms(found.error[found.t > 0.0]) <= 0.5 * raw_rms(flown, records, 0.0, 60.0)
