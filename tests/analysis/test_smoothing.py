"""Smoothing: more accurate than the filter before later fixes, equal at the end, consistent."""

from __future__ import annotations

import math
from functools import lru_cache
from typing import Any, NamedTuple

import msgspec
import numpy as np
import pytest

from companion.analysis import smoothing
from companion.analysis.error_statistics import root_mean_square as rms
from companion.analysis.first_pass import FirstPass
from companion.analysis.smoothing import SmoothedRun, smooth_flight
from companion.config import Config, GnssConfig, InertialConfig, load
from companion.nav.geometry import (
    Geodetic,
    displace,
    from_enu,
    geodetic_to_local,
    separation,
    slant_range_azimuth,
)
from companion.navigator import Navigator
from companion.navigator.channel import Nominal
from companion.navigator.inertial_track import Point
from companion.navigator.ins_channel import N, ins_channel
from companion.records import (
    Attitude,
    Fix,
    Gnss,
    Imu,
    LocalOrigin,
    LocalPosition,
    Reboot,
    RsbnFix,
    Solution,
    TimeStep,
    Vehicle,
)
from tests.recordings import recording

ORIGIN = Geodetic(math.radians(60.0), math.radians(30.0), 0.0)
BEACON = Geodetic(math.radians(60.4), math.radians(30.3), 100.0)
CONFIG = Config(inertial=InertialConfig(independent=True))
NS = 1_000_000_000


class SimulatedFlight(NamedTuple):
    """Records of a simulated flight, with truth and INS error by time, ns."""

    records: tuple[Any, ...]
    truth: dict[int, Geodetic]
    error: dict[int, Any]


@lru_cache(maxsize=8)
def flight(duration_s: int, outage_s: tuple[int, int], seed: int = 1) -> SimulatedFlight:
    """Simulate a circling aircraft with INS errors of the model, GNSS at 1 Hz with drift, a beacon every 5 s.

    There are no fixes in the interval `outage_s`.
    """
    rng = np.random.default_rng(seed)
    dt, channel = 0.2, ins_channel(CONFIG)
    v_n = (30.0, 0.0, 0.0)
    nominal = Nominal(Point(round(dt * NS), ORIGIN, v_n), (0.0, 0.0), Point(0, ORIGIN, v_n))
    Phi, Q = channel.transition(nominal)
    root = np.linalg.cholesky(Q[0] + 1e-30 * np.eye(N))
    x = np.sqrt(np.diag(channel.prior()[0])) * rng.standard_normal(N)
    x[14] = 0.0  # these fixes are not late
    records: list[Any] = [LocalOrigin(0, 0, *ORIGIN, "tangent")]
    truth, error = {}, {}
    for k in range(1, round(duration_s / dt)):
        t, t_ns = k * dt, round(k * dt * NS)
        x = Phi @ x + root @ rng.standard_normal(N)
        arc = t / 300.0
        place = from_enu(np.array([9000.0 * (1.0 - math.cos(arc)), 9000.0 * math.sin(arc), 1000.0]), ORIGIN)
        v_n = (30.0 * math.cos(arc), 30.0 * math.sin(arc), 0.0)
        truth[t_ns], error[t_ns] = place, x.copy()
        ins = displace(*place, x[0], x[1], 0.0)
        x_n = tuple(float(c) for c in geodetic_to_local("tangent", ORIGIN, ins))
        records.append(LocalPosition(t_ns, t_ns, x_n, (v_n[0] + float(x[2]), v_n[1] + float(x[3]), 0.0)))
        if outage_s[0] < t < outage_s[1]:
            continue
        if k % 5 == 0:
            e = x[12:14] + CONFIG.gnss.sigma_m / 3.0 * rng.standard_normal(2)
            w = CONFIG.gnss.sigma_velocity_m_s * rng.standard_normal(2)
            v = (v_n[0] + float(w[0]), v_n[1] + float(w[1]), 0.0)
            fix = displace(*place, e[0], e[1], 0.0)
            records.append(Gnss(t_ns, t_ns, 0, t_ns // 1000, 3, *fix, 1.5, 3.0, v_n=v))
        if k % 25 == 7:
            sight, (a, d) = slant_range_azimuth(BEACON, place), rng.standard_normal(2)
            azimuth, distance = sight.azimuth + math.radians(0.125) * a, sight.slant_range + 100.0 * d
            records.append(RsbnFix(t_ns, t_ns, 7, *BEACON, azimuth, distance, math.radians(0.125), 100.0))
    return SimulatedFlight(tuple(records), truth, error)


@lru_cache(maxsize=8)
def smoothed(duration_s: int, outage_s: tuple[int, int], seed: int = 1) -> SmoothedRun:
    """Smooth that flight."""
    (found,) = smooth_flight(flight(duration_s, outage_s, seed).records, CONFIG)
    return found


def errors(found: SmoothedRun, flown: SimulatedFlight) -> tuple[Any, Any]:
    """Return the errors (N, n) of the smoothed and of the filtered states."""
    true = np.array([flown.error[int(t)] for t in found.t_ns])
    return found.x[:, :N] - true, found.x_filter[:, :N] - true


@pytest.mark.flight
@pytest.mark.long
def test_smoothed_errors_are_below_filtered_errors() -> None:
    everywhere, outage = [], []
    for seed in range(1, 5):
        found, flown = smoothed(600, (200, 400), seed), flight(600, (200, 400), seed)
        both = np.stack(errors(found, flown))
        everywhere.append(both)
        outage.append(both[:, (found.t_ns > 220 * NS) & (found.t_ns < 400 * NS)])
    # GNSS drift has only few independent values per flight: several flights are needed
    for state in (slice(0, 2), slice(2, 4), slice(4, 6), slice(12, 14)):
        after, before = np.concatenate(everywhere, axis=1)[:, :, state]
        assert rms(after) < rms(before)
    after, before = np.concatenate(outage, axis=1)[:, :, :2]
    assert rms(after) < 0.7 * rms(before)


@pytest.mark.flight
def test_last_epoch_equals_the_filter() -> None:
    found, flown = smoothed(600, (200, 400)), flight(600, (200, 400))
    np.testing.assert_array_equal(found.x[-1], found.x_filter[-1])
    np.testing.assert_array_equal(found.P[-1], found.P_filter[-1])
    navigator, last = Navigator(CONFIG), None
    for record in flown.records:
        for out in navigator.handle(record):
            if isinstance(out, Solution):
                last = out
    assert last is not None
    assert found.t_ns[-1] == last.t_ns
    # solutions and smoother epochs are at different instants, with different propagation steps
    one_centimetre = 1e-2
    assert math.dist(found.x[-1, :2], last.error_n) < one_centimetre
    assert math.dist(found.x[-1, 2:4], last.velocity_error_n) < 1e-3
    np.testing.assert_allclose(found.P[-1, 0, 0], last.covariance[0], rtol=1e-3)


@pytest.mark.flight
@pytest.mark.long
def test_smoothing_reduces_variances_and_is_consistent() -> None:
    nees = []
    for seed in range(1, 7):
        found, flown = smoothed(600, (200, 400), seed), flight(600, (200, 400), seed)
        smaller = np.einsum("ijj->ij", found.P) / np.einsum("ijj->ij", found.P_filter)
        assert smaller.max() < 1.0 + 1e-6
        for k in range(5, len(found.t_ns), 60):
            e = errors(found, flown)[0][k, :4]
            nees.append(e @ np.linalg.solve(found.P[k, :4, :4], e))
    assert 2.0 < np.mean(nees) < 7.0


@pytest.mark.flight
def test_smoothed_track_matches_the_truth() -> None:
    found, flown = smoothed(600, (200, 400)), flight(600, (200, 400))
    off = []
    for t_ns, *place in zip(found.t_ns.tolist(), found.lat, found.lon, found.alt_msl, strict=True):
        off.append(separation(Geodetic(*place), flown.truth[t_ns])[:2])
    assert np.diff(found.t_ns).max() <= NS
    assert rms(off) < 10.0
    sigma = np.sqrt(np.trace(found.P[:, :2, :2], axis1=1, axis2=2))
    assert rms(off) < 2.0 * rms(sigma)


@pytest.mark.flight
def test_channel_jump_does_not_affect_the_smoothed_track() -> None:
    flown = flight(300, (0, 0))
    records = []
    for record in flown.records:
        if isinstance(record, LocalPosition) and record.t_ns > 150 * NS:
            x, y, z = record.x_n
            record = msgspec.structs.replace(record, x_n=(x + 97.0, y - 40.0, z))
        records.append(record)
    (plain,), (jumped,) = smooth_flight(flown.records, CONFIG), smooth_flight(records, CONFIG)
    np.testing.assert_array_equal(plain.t_ns, jumped.t_ns)
    late = plain.t_ns > 150 * NS
    shift = jumped.x[:, :2] - plain.x[:, :2] - np.where(late[:, None], [97.0, -40.0], 0.0)
    assert abs(shift).max() < 1.0  # the jump is detected to about a decimetre


@pytest.mark.flight
@pytest.mark.parametrize(
    ("rate", "step"),
    [
        (20.0, 0.0),  # 3 km off in the end
        (1.5, 400.0),  # the lie changes: taken to begin there, GNSS drew the track off
    ],
)
def test_false_gnss_is_left_out_from_its_onset(rate: float, step: float) -> None:
    """GNSS runs away from the 150th second on, its velocity stays true, and steps in the 250th: it is left
    out from the onset on, not only from the moment at which the navigator noticed.
    """
    flown = flight(300, (0, 0))
    begins, steps, records = 150 * NS, 250 * NS, []
    for record in flown.records:
        if isinstance(record, Gnss) and record.t_ns > begins:
            away = rate * (record.t_ns - begins) / NS + step * (record.t_ns > steps)
            place = displace(record.lat, record.lon, record.alt_msl, away, 0.0, 0.0)
            record = msgspec.structs.replace(record, lat=place.lat, lon=place.lon)
        records.append(record)
    (found,) = smooth_flight(records, CONFIG)
    smoothed = errors(found, flown)[0]
    sigma = np.sqrt(np.einsum("nii->n", found.P[:, :2, :2]))
    assert rms(smoothed[:, :2]) < 2.0 * rms(sigma)
    assert np.linalg.norm(smoothed[:, :2], axis=1).max() < 60.0


@pytest.mark.flight
@pytest.mark.parametrize(("since_s", "until_s"), [(0, 18), (0, 60), (100, 130)])
def test_a_lie_that_is_known_by_its_end_is_left_out_from_its_onset(since_s: int, until_s: int) -> None:
    """GNSS is 360 m off for a while, which one beacon every 5 s does not show while it lasts."""
    flown = flight(300, (0, 0))
    records = []
    for record in flown.records:
        if isinstance(record, Gnss) and since_s * NS <= record.t_ns < until_s * NS:
            place = displace(record.lat, record.lon, record.alt_msl, 360.0, 0.0, 0.0)
            record = msgspec.structs.replace(record, lat=place.lat, lon=place.lon)
        records.append(record)
    (found,) = smooth_flight(records, CONFIG)
    away = np.linalg.norm(errors(found, flown)[0][:, :2], axis=1)
    sigma = np.sqrt(np.einsum("nii->n", found.P[:, :2, :2]))
    assert away.max() < 60.0
    assert (away < 4.0 * sigma).all()


@pytest.mark.flight
@pytest.mark.parametrize(
    ("name", "degrees", "without"),
    [
        ("plane_take_off", 180.0, ()),
        ("plane_turbulence", 90.0, ()),
        ("plane_take_off", 180.0, Imu),  # the track ended there
    ],
)
def test_a_heading_that_steps_does_not_affect_the_smoothed_track(
    name: str, degrees: float, without: Any
) -> None:
    """GNSS is healthy: 435 and 525 m off where the smoother did not let the heading step."""
    records = [r for r in recording(name) if not isinstance(r, without)]
    steps_ns = (records[0].rx_ns + records[-1].rx_ns) // 2
    turned = [
        msgspec.structs.replace(r, heading=r.heading + math.radians(degrees))
        if isinstance(r, Attitude) and r.rx_ns >= steps_ns
        else r
        for r in records
    ]
    (found,) = smooth_flight(turned, load(flags={"output.profile": "ardupilot"}, environment={}))
    fixes = np.array([(r.t_ns, r.lat, r.lon) for r in records if isinstance(r, Gnss) and r.has_3d_fix])
    assert found.t_ns[-1] > fixes[-1, 0] - NS
    late = found.t_ns > steps_ns
    t, lat = found.t_ns[late], found.lat[late]
    north = lat - np.interp(t, fixes[:, 0], fixes[:, 1])
    east = (found.lon[late] - np.interp(t, fixes[:, 0], fixes[:, 2])) * np.cos(lat)
    assert 6.371e6 * np.hypot(north, east).max() < 6.0


@pytest.mark.flight
def test_a_fix_that_the_bank_believed_is_used_beside_a_wrong_accelerometer() -> None:
    """3 m/s^2 off from two minutes on, in turns: the plain filter rejected all fixes then, 2.9 km off."""
    rng, place, course, truth = np.random.default_rng(1), np.zeros(2), 0.0, {}
    records: list[Any] = [Vehicle(0, 0, multirotor=True, flying=True)]
    for k in range(1, 20 * 180):
        t_ns = k * NS // 20
        if k > 20 * 60:
            course = 1.2 * (1.0 - math.cos(0.25 * (k / 20 - 60.0)))
        v = 8.0 * np.array((math.cos(course), math.sin(course)))
        place = place + v / 20
        a, ahead = 1e-3 * rng.standard_normal(6), 3.0 if k > 20 * 120 else 0.0
        records.append(Attitude(t_ns, t_ns, a[0], a[1], course + a[2]))
        records.append(Imu(t_ns, t_ns, 0, (ahead + a[3], a[4], a[5] - 9.80665), (0.0, 0.0, 0.0)))
        truth[t_ns] = displace(*ORIGIN, *place, 0.0)
        if k % 5 == 0:
            fix = displace(*ORIGIN, *(place + rng.standard_normal(2)), 0.0)
            records.append(Gnss(t_ns, t_ns, 0, t_ns // 1000, 3, *fix, 1.5, 3.0, v_n=(v[0], v[1], 0.0)))
    (found,) = smooth_flight(records, load(flags={"output.profile": "ardupilot"}, environment={}))
    for t_ns, lat, lon in zip(found.t_ns.tolist(), found.lat, found.lon, strict=True):
        if t_ns in truth:
            north, east, _ = separation(Geodetic(lat, lon, ORIGIN.alt), truth[t_ns])
            assert math.hypot(north, east) < 60.0


@pytest.mark.flight
def test_false_velocity_of_gnss_is_left_out_from_its_onset() -> None:
    """The path is that of a receiver that stops sending a velocity there; its positions are used."""
    flown = flight(300, (0, 0))
    onset_ns = 150 * NS

    def records(off_m_s: float | None) -> list[Any]:
        out = []
        for record in flown.records:
            if isinstance(record, Gnss) and record.v_n is not None and record.t_ns > onset_ns:
                north, east, down = record.v_n
                v_n = None if off_m_s is None else (north + off_m_s, east, down)
                record = msgspec.structs.replace(record, v_n=v_n)
            out.append(record)
        return out

    (wrong,), (silent,) = smooth_flight(records(3.0), CONFIG), smooth_flight(records(None), CONFIG)
    assert rms((wrong.x - silent.x)[:, :2]) < 0.1
    assert rms(errors(wrong, flown)[0][:, :2]) < 1.5


@pytest.mark.flight
def test_first_pass_decides_as_in_flight_and_makes_no_solutions() -> None:
    records = [  # every third answer of the beacon arrives late, behind what came meanwhile
        msgspec.structs.replace(r, rx_ns=r.rx_ns + NS) if isinstance(r, RsbnFix) and not k % 3 else r
        for k, r in enumerate(flight(120, (60, 90)).records)
    ]
    navigator, first = Navigator(CONFIG), FirstPass(CONFIG)
    flown, noted = [], []
    for record in sorted(records, key=lambda record: record.rx_ns):
        flown += navigator.handle(record)
        noted += first.handle(record)
    made = {type(record) for record in flown}
    assert {Fix, Solution} <= made and not {Fix, Solution} & {type(record) for record in noted}
    ours, its = navigator.state.bank, first.state.bank
    assert ours is not None and its is not None
    for name in ("L", "x", "P", "grade", "excluded"):
        assert np.array_equal(getattr(ours, name), getattr(its, name))


@pytest.mark.parametrize("latency_s", [0.3, 1.3])
def test_fixes_that_are_late_as_configured_give_the_same_track(latency_s: float) -> None:
    """7 m off where what is folded again was followed twice, and the fix too late."""
    config = msgspec.structs.replace(CONFIG, gnss=GnssConfig(latency_s=latency_s))
    flown, late_ns = flight(120, (60, 90)), round(latency_s * NS)
    records = [
        msgspec.structs.replace(r, t_ns=r.t_ns + late_ns) if isinstance(r, Gnss) else r for r in flown.records
    ]
    first = FirstPass(config)
    for record in sorted(records, key=lambda r: r.t_ns):
        first.handle(record)
    first.end()
    folded = [(f.record.t_ns, type(f.record)) for f in first.folded]
    assert len(folded) == len(set(folded))
    (found,), plain = smooth_flight(records, config), smoothed(120, (60, 90))
    np.testing.assert_array_equal(found.t_ns, plain.t_ns)
    np.testing.assert_array_equal(found.x, plain.x)


def test_reboot_starts_a_new_run() -> None:
    flown = flight(300, (0, 0))
    cut = 150 * NS + 1
    records = [*flown.records, Reboot(cut, cut, 1), msgspec.structs.replace(flown.records[0], t_ns=cut + 1)]
    found = smooth_flight(records, CONFIG)
    (first,) = smooth_flight([r for r in flown.records if r.t_ns < cut], CONFIG)
    np.testing.assert_array_equal(found[0].x, first.x)


def test_a_step_of_time_widens_the_position_in_both_directions() -> None:
    flown = flight(80, (20, 60))
    step = TimeStep(40 * NS, 40 * NS, 1, 1.0)
    (plain,) = smooth_flight(flown.records, CONFIG)
    (found,) = smooth_flight((*flown.records, step), CONFIG, check=True)
    assert found.apart_sigma < 1e-6
    wider = found.P[:, 0, 0] / np.interp(found.t_ns, plain.t_ns, plain.P[:, 0, 0])
    assert abs(found.t_ns[wider.argmax()] - step.t_ns) < 20 * NS
    assert wider.max() > 1.05 and wider.min() > 0.999


def fixed_wing(until_s: float) -> list[Any]:
    """A recorded fixed wing, whose first fix is at 9 s."""
    return [record for record in recording("umn_flight") if record.rx_ns < until_s * NS]


FIXED_WING = load(flags={"output.profile": "ardupilot"}, environment={})


@pytest.mark.flight
def test_another_receiver_is_the_two_point_solution_too() -> None:
    """What was estimated of the first one, its drift and its latency, does not hold for the second."""
    records = []
    for record in fixed_wing(150.0):
        if isinstance(record, Gnss) and record.t_ns > 100 * NS:
            records.append(msgspec.structs.replace(record, fix=1, v_n=None))
            record = msgspec.structs.replace(record, receiver=1)
        records.append(record)
    (found,) = smooth_flight(records, FIXED_WING, check=True)
    assert found.apart_sigma < 1e-6


@pytest.mark.flight
def test_a_position_that_is_restarted_leaves_the_track_before_it_alone() -> None:
    """The first fixes are 30 km off. It was drawn to where the others are, 25 km off with 5 m of sigma."""
    first_ns = min(r.t_ns for r in fixed_wing(60.0) if isinstance(r, Gnss) and r.has_3d_fix)
    records = []
    for record in fixed_wing(60.0):
        if isinstance(record, Gnss) and record.has_3d_fix and record.t_ns < first_ns + 15 * NS:
            place = displace(record.lat, record.lon, record.alt_msl, 30e3, 0.0, 0.0)
            record = msgspec.structs.replace(record, lat=place.lat)
        records.append(record)
    (found,) = smooth_flight(records, FIXED_WING, check=True)
    restarted = int(np.argmax(np.linalg.norm(found.x[:, :2], axis=1) > 10e3))
    moved = np.linalg.norm((found.x - found.x_filter)[:restarted, :2], axis=1)
    assert found.t_ns[restarted - 1] - first_ns > 29 * NS
    assert (moved < 3.0 * np.sqrt(found.P_filter[:restarted, 0, 0])).all()
    assert found.apart_sigma < 1e-2


@pytest.mark.parametrize("lon", [math.radians(149.0), math.pi - 1e-6])
def test_a_correction_of_the_channel_is_the_same_across_the_antimeridian(lon: float) -> None:
    """Without the wrap the smoothed track was 60 m off there, and not that of the two-point problem."""
    before = Geodetic(-0.6, lon, 500.0)
    after = displace(*before, -70.0, 30.0, 0.0)
    moved = smoothing._moved(Point(0, before, (20.0, 1.0, 0.0)), Point(0, after, (19.0, 3.0, 0.0)))
    assert moved.tolist() == pytest.approx([-70.0, 30.0, -1.0, 2.0], abs=1e-6)


def test_nothing_to_smooth_is_reported_in_one_sentence() -> None:
    with pytest.raises(ValueError, match="nothing to smooth: the records need"):
        smooth_flight([r for r in flight(20, (0, 20)).records], CONFIG)
