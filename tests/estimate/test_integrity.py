"""Solution separation: covariance, identification of the faulty source, protection level."""

from __future__ import annotations

import math
from functools import lru_cache
from typing import NamedTuple

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from companion.estimate import filterbank, integrity, monitor, trust
from companion.estimate.filterbank import Bank, Measurement
from companion.estimate.fusion import Azimuth, Position, Range, maximum_likelihood
from companion.estimate.trust import Evidence, Held, Limits, Trust

NS = 1_000_000_000
FREE = 1e9  # a limit that refuses nothing

# North and east position and velocity errors of an inertial channel, pushed by white acceleration.
DT = 1.0
PHI = np.eye(4) + DT * np.eye(4, 4, 2)
Q = 1e-4 * np.diag([DT**3 / 3, DT**3 / 3, DT, DT]) + 1e-4 * DT**2 / 2 * (np.eye(4, 4, 2) + np.eye(4, 4, -2))
P0 = np.diag([20.0**2, 20.0**2, 0.5**2, 0.5**2])
LOOSE = np.array([0.0, 0.0, 1e-3, 1e-3])
SIGMA = {"gnss": 3.0, "north": 30.0, "east": 60.0}
ROWS = {"gnss": np.eye(2, 4), "north": np.eye(1, 4), "east": np.eye(1, 4, 1)}


def begun(forks: int = 0) -> Bank:
    bank = filterbank.begin(0, np.zeros(4), P0)
    for source in SIGMA:
        bank = filterbank.join(bank, source, forks=forks if source == "gnss" else 0)
    return bank


def carried(bank: Bank) -> Bank:
    return filterbank.carry(bank, bank.t_ns + NS, PHI, Q, LOOSE, np.zeros(0))


def measured(source: str, x: np.ndarray, rng: np.random.Generator, fault: float = 0.0) -> Measurement:
    H, sigma = ROWS[source], SIGMA[source]
    z = H @ x + sigma * rng.standard_normal(len(H)) + fault
    return Measurement(source, z, H, sigma**2 * np.eye(len(H)))


class Flight(NamedTuple):
    bank: Bank
    x: np.ndarray


def fly(seed: int, seconds: int, faulty: str = "", slope: float = 0.0, start: int = 0) -> Flight:
    """A flight by the filters' own model; from `start` on, `faulty` drifts at `slope` m/s."""
    rng, bank = np.random.default_rng(seed), begun()
    x = np.sqrt(np.diag(P0)) * rng.standard_normal(4)
    noise = np.linalg.cholesky(Q)
    for t in range(seconds):
        x = PHI @ x + noise @ rng.standard_normal(4)
        bank = carried(bank)
        for source in SIGMA:
            fault = slope * max(t - start, 0) if source == faulty else 0.0
            bank = filterbank.take(bank, measured(source, x, rng, fault), FREE).bank
    return Flight(bank, x)


@lru_cache(maxsize=1)
def honest() -> list[Flight]:
    return [fly(seed, 25) for seed in range(400)]


def test_the_separation_has_the_covariance_of_the_difference() -> None:
    """Brown and McBurney's law, on 400 flights: the normalised square has the mean of its chi-square."""
    found = [integrity.separations(f.bank) for f in honest()]
    # in position a row without a scalar source differs along one direction, GNSS's row along two
    for column, freedom in zip(
        np.array([[s.position for s in f] for f in found]).T, (2.0, 1.0, 1.0), strict=True
    ):
        assert abs(column.mean() - freedom) < 4.0 * math.sqrt(2.0 * freedom / len(column))
    for column, freedom in zip(
        np.array([[s.statistic for s in f] for f in found]).T, (4.0, 2.0, 2.0), strict=True
    ):
        assert abs(column.mean() - freedom) < 4.0 * math.sqrt(2.0 * freedom / len(column))
    assert {tuple(s.freedom for s in f) for f in found} == {(4, 2, 2)}


def test_false_alarm_rate_matches_its_allocation() -> None:
    limit, found = integrity.threshold(0.1), [integrity.separations(f.bank) for f in honest()]
    gnss = [s[0].position > limit for s in found]
    assert abs(np.mean(gnss) - 0.1) < 4.0 * math.sqrt(0.1 * 0.9 / len(gnss))
    for i in (1, 2):  # of one direction instead of two: fewer
        assert np.mean([s[i].position > limit for s in found]) < 0.1
    for i in (0, 1, 2):
        share = np.mean([s[i].statistic > s[i].limit(0.1) for s in found])
        assert abs(share - 0.1) < 4.0 * math.sqrt(0.1 * 0.9 / len(found))
        assert np.mean([s[i].beyond(0.1) for s in found]) < 0.1 + 4.0 * math.sqrt(0.1 * 0.9 / len(found))


@pytest.mark.parametrize("slope", [0.0, 0.5, 2.0, 10.0])
def test_protection_level_is_exceeded_undetected_within_its_risk(slope: float) -> None:
    """Whatever the drift: misleading is an error beyond the level and no separation beyond its limit."""
    false_alarm, risk = 0.01, 0.05
    flights = honest() if slope == 0.0 else [fly(s, 25, "gnss", slope, 10) for s in range(150)]
    misleading = 0
    for bank, x in flights:
        level = integrity.protection(bank, false_alarm, risk).level
        seen = integrity.blame(integrity.separations(bank), false_alarm) is not None
        misleading += math.hypot(*(bank.x[0, :2] - x[:2])) > level and not seen
    assert misleading / len(flights) <= risk


@settings(deadline=None, max_examples=20)
@given(st.sampled_from(sorted(SIGMA)), st.integers(0, 10_000))
def test_source_that_jumps_is_blamed(faulty: str, seed: int) -> None:
    bank = fly(seed, 40, faulty, 40.0 * SIGMA[faulty] / 25.0, 15).bank
    found = integrity.blame(integrity.separations(bank), 1e-6)
    assert found is not None
    assert found.source == faulty


def test_exclusion_removes_all_effects_of_the_source() -> None:
    """After an exclusion the full solution equals that of a filter which never used the faulty source."""
    rng, bank, alone = np.random.default_rng(3), begun(), begun()
    for t in range(60):
        bank, alone = carried(bank), carried(alone)
        for source in SIGMA:
            z = measured(source, np.zeros(4), rng, 5.0 * t if source == "gnss" else 0.0)
            bank = filterbank.take(bank, z, FREE).bank
            if source != "gnss":
                alone = filterbank.take(alone, z, FREE).bank
    assert np.linalg.norm(bank.x[0, :2]) > 100.0
    bank = integrity.exclude(bank, "gnss", 1e-6)
    np.testing.assert_allclose(bank.x[0], alone.x[0], atol=1e-9)
    np.testing.assert_allclose(bank.P[0], alone.P[0], rtol=1e-9, atol=1e-12)
    again = filterbank.take(bank, measured("gnss", np.zeros(4), rng), FREE)
    assert not again.accepted
    bank = filterbank.readmit(bank, "gnss")
    assert filterbank.take(bank, measured("gnss", np.zeros(4), rng), FREE).accepted


def test_forked_row_detects_a_later_drift_sooner() -> None:
    bank, rng = begun(forks=1), np.random.default_rng(4)
    fork = next(i for i, row in enumerate(bank.rows) if not row.never)
    for t in range(120):
        if t == 60:
            bank = filterbank.fork(bank, fork)
        bank = carried(bank)
        for source in SIGMA:
            fault = 1.0 * max(t - 60, 0) if source == "gnss" else 0.0
            bank = filterbank.take(bank, measured(source, np.zeros(4), rng, fault), FREE).bank
    statistic = {s.row.never: s.statistic for s in integrity.separations(bank) if s.row.without == "gnss"}
    assert statistic[False] > 2.0 * statistic[True] > 0.0


def test_beacon_bias_is_estimated_with_the_others_and_used_without_them() -> None:
    rng, bias = np.random.default_rng(5), 80.0
    bank = filterbank.join(begun(), "beacon", 100.0)
    without_state = begun()
    x, noise = np.zeros(4), np.linalg.cholesky(Q)
    worst, naive = 0.0, 0.0
    for t in range(400):
        x = PHI @ x + noise @ rng.standard_normal(4)
        bank = filterbank.carry(bank, bank.t_ns + NS, PHI, Q, LOOSE, np.zeros(1))
        without_state = carried(without_state)
        if t < 200:
            fix = measured("gnss", x, rng)
            bank, without_state = (filterbank.take(b, fix, FREE).bank for b in (bank, without_state))
        z = Measurement(
            "beacon", x[:1] + bias + 20.0 * rng.standard_normal(1), np.eye(1, 4), 400.0 * np.eye(1)
        )
        bank = filterbank.take(bank, z._replace(unit=np.ones(1)), FREE).bank
        without_state = filterbank.take(without_state, z._replace(source="other"), FREE).bank
        if t == 199:
            assert abs(bank.x[0, 4] - bias) < 3.0 * math.sqrt(bank.P[0, 4, 4]) < 10.0
        worst, naive = max(worst, abs(bank.x[0, 0] - x[0])), max(naive, abs(without_state.x[0, 0] - x[0]))
    assert worst < 20.0 < 60.0 < naive


def test_a_row_agrees_with_the_maximum_likelihood_fix() -> None:
    """One azimuth and one range with the prior: the bank's update is the fusion's, both linear so far off."""
    beacon = np.array([52_000.0, -30_000.0, 0.0])
    place = np.array([12.0, -7.0, 0.0])  # x east, y north: the INS stands 7 m north and 12 m west of it
    away = place - beacon
    azimuth = Azimuth(beacon, math.atan2(away[0], away[1]) + 1e-4, math.radians(0.125))
    slant = Range(beacon, float(np.linalg.norm(away)) + 15.0, 100.0)
    bank = begun()
    for name, z in (("azimuth", azimuth), ("range", slant)):
        sight = filterbank.sighted(name, z, bank.x[0], 4)
        assert sight is not None
        bank = filterbank.take(bank, sight, FREE).bank
    prior = Position(np.zeros(3), np.diag([20.0**2, 20.0**2, 1e-4]))
    fix = maximum_likelihood((prior, azimuth, slant))
    np.testing.assert_allclose(-bank.x[0, [1, 0]], fix.position[:2], atol=1e-3)
    np.testing.assert_allclose(bank.P[0, :2, :2], fix.covariance[1::-1, 1::-1], rtol=1e-3)


def test_azimuth_above_the_beacon_is_not_used() -> None:
    overhead = Azimuth(np.array([0.0, 10.0, -3000.0]), 1.0, 0.002)
    assert filterbank.sighted("azimuth", overhead, np.zeros(4), 4) is None


def test_monitor_excludes_a_slow_drift_and_reports_numbers() -> None:
    allotment = monitor.Allotment()
    watch = monitor.Monitor(begun(forks=2))
    rng, excluded = np.random.default_rng(6), []
    for t in range(400):
        watch = watch._replace(bank=carried(watch.bank))
        for source in SIGMA:
            fault = 2.0 * max(t - 250, 0) if source == "gnss" else 0.0
            watch, _ = monitor.hear(watch, measured(source, np.zeros(4), rng, fault), allotment)
        watch, exclusions = monitor.watch(watch, allotment)
        excluded += [(t, e) for e in exclusions]
    assert [e.source for _, e in excluded] == ["gnss"]
    t, exclusion = excluded[0]
    assert 250 < t < 300
    assert exclusion.value > exclusion.limit or exclusion.reason == monitor.REFUSED
    assert exclusion.since_ns < 250 * NS
    assert not monitor.trusted(watch, "gnss")
    assert monitor.trusted(watch, "north")
    assert np.linalg.norm(watch.bank.x[0, :2]) < 40.0


def test_a_run_of_wild_measurements_excludes_and_single_ones_do_not() -> None:
    allotment, rng = monitor.Allotment(run=5), np.random.default_rng(7)
    watch, refused, excluded = monitor.Monitor(begun(forks=2)), 0, []
    for t in range(80):
        watch = watch._replace(bank=carried(watch.bank))
        for source in SIGMA:
            wild = source == "north" and (t in (20, 25, 30) or t >= 60)
            z = measured(source, np.zeros(4), rng, 5000.0 if wild else 0.0)
            watch, refusal = monitor.hear(watch, z, allotment)
            refused += refusal is not None
        watch, exclusions = monitor.watch(watch, allotment)
        excluded += [(t, e.source, e.reason) for e in exclusions]
    assert excluded == [(64, "north", monitor.REFUSED)]
    assert refused == 3 + 20


def test_excluded_source_is_readmitted_after_settling_within_the_bound() -> None:
    allotment = monitor.Allotment(settle_s=10.0)
    watch = monitor.Monitor(integrity.exclude(fly(8, 30).bank, "gnss", 0.5))
    for t in range(100):
        inside = t >= 50 and t != 55  # the spoofer leaves at 50 and is back for a moment
        offset = (3.0, 4.0) if inside else (900.0, 0.0)
        value, limit = integrity.admits(offset, (30.0, 30.0), (2.0, 2.0), 0.01)
        admitted = value <= limit
        assert admitted == inside
        watch, back = monitor.offer(watch, t * NS, "gnss", admitted, allotment)
        if back:
            break
    assert t == 66
    assert monitor.trusted(watch, "gnss")


def test_smaller_covariance_gives_smaller_protection_level() -> None:
    bank = fly(9, 30).bank
    wide = filterbank.widen(bank, 4.0)
    assert integrity.protection(wide, 1e-6, 1e-5).level > 1.9 * integrity.protection(bank, 1e-6, 1e-5).level


@settings(deadline=None, max_examples=200)
@given(
    st.lists(st.tuples(st.floats(-1e3, 1e3), st.floats(-1e3, 1e3)), min_size=1, max_size=30),
    st.floats(0.001, 0.5),
)
def test_gate_of_the_bound_rejects_within_its_probability(
    offsets: list[tuple[float, float]], refusal: float
) -> None:
    """Of any errors whatever that obey their r.m.s. bounds."""
    north, east = (max(float(np.sqrt(np.mean(np.square(c)))), 1e-3) for c in zip(*offsets, strict=True))
    found = [integrity.admits(o, (north, east), (0.0, 0.0), refusal) for o in offsets]
    assert np.mean([value > limit for value, limit in found]) <= refusal + 1e-12


def test_bad_input_is_reported() -> None:
    bank = begun()
    with pytest.raises(ValueError, match=r"position first"):
        filterbank.begin(0, np.zeros(3), np.eye(2))
    with pytest.raises(ValueError, match=r"a unique name"):
        filterbank.join(bank, "gnss")
    with pytest.raises(ValueError, match=r"gnss: H has shape"):
        filterbank.take(bank, Measurement("gnss", np.zeros(2), np.eye(2), np.eye(2)), FREE)
    with pytest.raises(ValueError, match=r"there are gnss, north, east"):
        integrity.exclude(bank, "unknown", 0.5)
    with pytest.raises(ValueError, match=r"not excluded"):
        filterbank.readmit(bank, "gnss")
    with pytest.raises(ValueError, match=r"between 0 and 1"):
        integrity.threshold(0.0)
    with pytest.raises(ValueError, match=r"fork another"):
        filterbank.fork(bank, 1)


GOOD = Evidence(True, False, 10.0, 10.0)
evidence = st.builds(
    Evidence,
    st.booleans(),
    st.booleans(),
    st.none() | st.floats(0.0, 1000.0),
    st.none() | st.floats(0.0, 1e4),
)


@settings(deadline=None, max_examples=200)
@given(st.lists(evidence, min_size=1, max_size=60))
def test_trust_falls_at_once_and_rises_after_settling(course: list[Evidence]) -> None:
    limits = Limits(settle_s=5.0)
    held = Held(Trust.UNTRUSTED, 0)
    for t, now in enumerate(course, 1):
        before, held = held, trust.turn(held, t * NS, now, limits)
        assert held.trust >= trust.judge(now, limits)
        if held.trust < before.trust:
            better = course[t - 6 : t]
            assert len(better) == 6
            assert all(trust.judge(e, limits, limits.clear) < before.trust for e in better)


def test_trust_has_hysteresis_at_its_limit() -> None:
    limits, held = Limits(protection=100.0), Held(Trust.NORMAL, 0)
    changes = 0
    for t in range(1, 400):
        level = 100.0 + 5.0 * (-1) ** t
        before, held = held, trust.turn(held, t * NS, GOOD._replace(protection=level), limits)
        changes += held.trust is not before.trust
    assert changes == 1
    assert held.trust is Trust.DEGRADED
    for t in range(400, 420):
        held = trust.turn(held, t * NS, GOOD, limits)
    assert held.trust is Trust.NORMAL
    assert trust.turn(held, 421 * NS, Evidence(False, False, None, 6000.0), limits).trust is Trust.UNTRUSTED
    assert trust.turn(held, 421 * NS, Evidence(False, False, None, 60.0), limits).trust is Trust.PREDICTING
