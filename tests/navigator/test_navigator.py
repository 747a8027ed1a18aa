"""The navigator as a fold: what it promises, and what late, wild and repeated records may not do to it."""

from __future__ import annotations

import copy
import math
import re
from collections.abc import Iterator
from functools import lru_cache
from itertools import pairwise
from typing import Any

import msgspec
import numpy as np
import pytest
from msgspec import structs

import companion.navigator as navigator_module
from companion.analysis.error_statistics import root_mean_square as rms
from companion.config import Config, InertialConfig, load, to_toml
from companion.estimate.fusion import Azimuth
from companion.link.parameter_server import PARAMETERS
from companion.nav.geometry import (
    Geodetic,
    displace,
    from_enu,
    geodetic_to_local,
    separation,
    slant_range_azimuth,
)
from companion.navigator import Navigator, measurements, past_states
from companion.navigator.channel import Nominal
from companion.navigator.hypotheses import GNSS
from companion.navigator.inertial_track import Point
from companion.navigator.ins_channel import ins_channel
from companion.navigator.state import EXCLUDED, SUSPECT, source_name
from companion.records import (
    Attitude,
    Event,
    Fix,
    Gnss,
    LocalOrigin,
    LocalPosition,
    Mode,
    Reboot,
    Rejection,
    Reset,
    RsbnFix,
    Solution,
    Source,
    Truth,
    Tuning,
)

ORIGIN = Geodetic(math.radians(60.0), math.radians(30.0), 0.0)
BEACON = Geodetic(math.radians(60.4), math.radians(30.3), 100.0)
CONFIG = Config(inertial=InertialConfig(independent=True))  # the channel that flies here is one
NS = 1_000_000_000


class Moment:
    """All that is said in one tenth of a second, and the truth of it."""

    def __init__(self, truth: Geodetic, records: list[Any], ins_error: tuple[float, float]) -> None:
        self.truth, self.records, self.ins_error = truth, records, ins_error


@lru_cache(maxsize=4)
def flight(duration_s: int, gnss_until: float, rsbn_until: float, seed: int = 1) -> tuple[Moment, ...]:
    """A circling aircraft whose inertial channel errs as its equations say; GNSS 5 Hz, a beacon 1 Hz."""
    rng = np.random.default_rng(seed)
    dt, channel = 0.1, ins_channel(CONFIG)
    v_n = (30.0, 0.0, 0.0)
    begin, end = Point(0, ORIGIN, v_n), Point(round(dt * NS), ORIGIN, v_n)
    step = channel.transition(Nominal(end, (0.0, 0.0), begin))
    noise = np.linalg.cholesky(step.Q[0] + 1e-30 * np.eye(channel.n))
    x = np.sqrt(channel.prior()[0].diagonal()) * rng.standard_normal(channel.n)
    moments = []
    for k in range(1, round(duration_s / dt)):
        t = k * dt
        t_ns = round(t * NS)
        x = step.Phi @ x + noise @ rng.standard_normal(channel.n)
        truth = from_enu(
            np.array([9000.0 * (1.0 - math.cos(t / 300.0)), 9000.0 * math.sin(t / 300.0), 1000.0]), ORIGIN
        )
        v_n = (30.0 * math.cos(t / 300.0), 30.0 * math.sin(t / 300.0), 0.0)
        ins = displace(*truth, x[0], x[1], 0.0)
        x_n = tuple(float(c) for c in geodetic_to_local("tangent", ORIGIN, ins))
        records: list[Any] = [
            LocalPosition(t_ns, t_ns, x_n, (v_n[0] + float(x[2]), v_n[1] + float(x[3]), 0.0))
        ]
        if k % 2 == 0 and t < gnss_until:
            e, w = 1.5 * rng.standard_normal(2), 0.1 * rng.standard_normal(2)
            fix = displace(*truth, e[0], e[1], 0.0)
            v = (v_n[0] + float(w[0]), v_n[1] + float(w[1]), 0.0)
            records.append(Gnss(t_ns, t_ns, 0, t_ns // 1000, 3, *fix, 1.5, 3.0, v_n=v))
        if k % 10 == 0 and t < rsbn_until:
            sight, (a, d) = slant_range_azimuth(BEACON, truth), rng.standard_normal(2)
            azimuth, distance = sight.azimuth + math.radians(0.125) * a, sight.slant_range + 100.0 * d
            records.append(RsbnFix(t_ns, t_ns, 7, *BEACON, azimuth, distance, math.radians(0.125), 100.0))
        moments.append(Moment(truth, records, (float(x[0]), float(x[1]))))
    return tuple(moments)


def origin() -> LocalOrigin:
    return LocalOrigin(0, 0, *ORIGIN, "tangent")


def flown(moments: tuple[Moment, ...], config: Config = CONFIG) -> Iterator[tuple[Moment, list[Any]]]:
    navigator = Navigator(config)
    navigator.handle(origin())
    for moment in moments:
        yield moment, [out for record in moment.records for out in navigator.handle(record)]


@lru_cache(maxsize=2)
def flown_in_order(gnss_until: float) -> tuple[Navigator, list[list[Any]]]:
    """A navigator after half a minute of records in order, and its outputs by them; not to be changed."""
    navigator = Navigator(CONFIG)
    navigator.handle(origin())
    moments = flight(60, gnss_until, 60.0)[:300]
    return navigator, [navigator.handle(record) for moment in moments for record in moment.records]


def distance(solution: Solution, truth: Geodetic) -> float:
    north, east, _ = separation(Geodetic(solution.lat, solution.lon, solution.alt_msl), truth)
    return math.hypot(north, east)


@pytest.fixture(scope="module")
def outage() -> list[tuple[Moment, Solution]]:
    """Eight minutes with everything, three with the beacon alone, three with nothing."""
    found = flown(flight(840, 480.0, 660.0))
    return [(moment, out) for moment, outs in found for out in outs if isinstance(out, Solution)]


def of(outage: list[tuple[Moment, Solution]], start: float, end: float) -> list[tuple[Moment, Solution]]:
    return [(m, s) for m, s in outage if start * NS < s.t_ns <= end * NS]


@pytest.mark.flight
def test_with_fixes_the_estimate_beats_the_best_fix(outage: list[tuple[Moment, Solution]]) -> None:
    gnss = 1.5 * math.sqrt(2.0)
    assert rms([distance(s, m.truth) for m, s in of(outage, 120, 480)]) < gnss
    beacon = [slant_range_azimuth(BEACON, m.truth).slant_range for m, _ in of(outage, 480, 660)]
    fix = rms([math.hypot(100.0, math.radians(0.125) * d) for d in beacon])
    assert rms([distance(s, m.truth) for m, s in of(outage, 480, 660)]) < 0.25 * fix


@pytest.mark.flight
def test_without_fixes_the_error_stays_inside_the_guaranteed_bound(
    outage: list[tuple[Moment, Solution]],
) -> None:
    alone = of(outage, 671, 840)
    assert {s.mode for _, s in alone} == {Mode.PREDICTING}
    assert {s.estimator for _, s in alone} == {"kalman"}
    bounds = [s.bound_n for _, s in alone]
    assert all(b is not None for b in bounds)
    assert rms([distance(s, m.truth) for m, s in alone]) < rms([math.hypot(*b) for b in bounds if b])


@pytest.mark.flight
def test_the_claimed_sigma_is_honest(outage: list[tuple[Moment, Solution]]) -> None:
    for start, end in ((60, 480), (480, 660)):
        errors = [distance(s, m.truth) for m, s in of(outage, start, end)]
        claimed = [math.sqrt(s.covariance[0] + s.covariance[3]) for _, s in of(outage, start, end)]
        assert rms(errors) < 2.0 * rms(claimed)


def test_the_same_records_give_the_same_outputs() -> None:
    first = [out for outs in flown_in_order(60.0)[1] for out in outs]
    assert first == [out for _, outs in flown(flight(60, 60.0, 60.0)[:300]) for out in outs]


def test_a_late_answer_is_folded_in_at_its_own_time() -> None:
    moments = flight(60, 8.0, 60.0)[:300]
    in_time, late = copy.deepcopy(flown_in_order(8.0)[0]), Navigator(CONFIG)
    waiting: list[RsbnFix] = []
    late.handle(origin())
    for k, moment in enumerate(moments):
        for record in moment.records:
            if isinstance(record, RsbnFix):
                waiting.append(record)
            else:
                late.handle(record)
        if k % 30 == 29 or k == len(moments) - 1:  # answers come up to three seconds late, newest first
            while waiting:
                late.handle(waiting.pop())
    last = moments[-1].records[0]
    end = last.t_ns + 6 * NS // 10
    x_n = tuple(x + v * (end - last.t_ns) / NS for x, v in zip(last.x_n, last.v_n))
    tail = LocalPosition(end, end, x_n, last.v_n)
    a = [out for out in in_time.handle(tail) if isinstance(out, Solution)]
    b = [out for out in late.handle(tail) if isinstance(out, Solution)]
    assert a
    assert b
    one_millimetre = 1e-3  # solutions fall at other instants, and with them the steps of the error equations
    assert math.dist(a[0].error_n, b[0].error_n) < one_millimetre
    per_mille = 1e-3 * a[0].covariance[0]  # the covariance north-east is nearly nothing
    np.testing.assert_allclose(a[0].covariance, b[0].covariance, rtol=1e-3, atol=per_mille)


def with_late_answer(late_s: float) -> tuple[list[Any], RsbnFix, int]:
    """A flight without GNSS from 8 s on, an answer of its beacon at 14 s, and the answer's place among the
    other records if it arrives `late_s` later.
    """
    records = [origin(), *(record for moment in flight(60, 8.0, 60.0)[:260] for record in moment.records)]
    answer = next(r for r in records if isinstance(r, RsbnFix) and r.t_ns == 14 * NS)
    arrival = answer.t_ns + round(late_s * NS)
    records.remove(answer)
    place = next(k for k, record in enumerate(records) if record.t_ns > arrival)
    return records, msgspec.structs.replace(answer, rx_ns=arrival), place


@lru_cache(maxsize=1)
def before_late_answer() -> tuple[Navigator, list[Solution]]:
    """A navigator at 19 s, where the answer of 14 s arrives, and its solutions up to then."""
    navigator, (records, _, place) = Navigator(CONFIG), with_late_answer(5.0)
    return navigator, solutions(navigator, records[:place])


def solutions(navigator: Navigator, records: list[Any]) -> list[Solution]:
    return [out for record in records for out in navigator.handle(record) if isinstance(out, Solution)]


def assert_same(ours: list[Solution], in_order: list[Solution]) -> None:
    """The same but for the instants of the solutions, and with them the steps of the error equations."""
    by_time = {solution.t_ns: solution for solution in in_order}
    pairs = [(solution, by_time[solution.t_ns]) for solution in ours if solution.t_ns in by_time]
    assert len(pairs) > 0.5 * len(in_order)
    one_millimetre = 1e-3
    for a, b in pairs:
        assert math.dist(a.error_n, b.error_n) < one_millimetre
        per_mille = 1e-3 * b.covariance[0]
        np.testing.assert_allclose(a.covariance, b.covariance, rtol=1e-3, atol=per_mille)


def test_solutions_go_on_while_a_late_answer_is_folded_in() -> None:
    """Five seconds late: until all is folded again, the solutions are those without the answer; after half a
    second, those of the records in order.
    """
    records, answer, place = with_late_answer(5.0)
    wanted = solutions(Navigator(CONFIG), sorted([*records, answer], key=lambda record: record.t_ns))
    without, before = before_late_answer()
    reported = before + solutions(copy.deepcopy(without), records[place:])
    found = before + solutions(copy.deepcopy(without), [answer, *records[place:]])
    first = next(k for k, (a, b) in enumerate(zip(found, reported)) if a != b)
    assert 0.0 < found[first].t_ns / NS - 19.0 < 0.5
    assert {solution.t_ns for solution in found} >= {solution.t_ns for solution in reported}
    assert_same(found[first:], [solution for solution in wanted if solution.t_ns >= found[first].t_ns])


@pytest.mark.parametrize("late_s", [0.4, 5.9])
def test_states_that_are_not_kept_change_no_solution(late_s: float, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of the seconds before the last, one state each is kept; a late answer is folded in as if all were."""
    records, answer, place = with_late_answer(late_s)
    records.insert(place, answer)
    navigator, kept = Navigator(CONFIG), list[int]()
    ours = list[Solution]()
    for record in records:
        in_order = navigator._roll_back is None
        ours += solutions(navigator, [record])
        if in_order and navigator._roll_back is None:
            kept.append(sum(t_ns < record.t_ns - 1.2 * NS for t_ns in navigator._past.states_ns))
    assert 5 <= max(kept) <= 8
    monkeypatch.setattr(past_states, "DENSE_NS", 60 * NS)
    wanted = {each.t_ns: each for each in solutions(Navigator(CONFIG), records)}
    later = [each for each in ours if each.t_ns > answer.rx_ns + NS]
    assert len(later) > 10
    assert all(each == wanted[each.t_ns] for each in later)


def test_with_no_record_more_than_a_few_are_folded_again(monkeypatch: pytest.MonkeyPatch) -> None:
    """A hundred answers and more within a second, five seconds late, among the other records."""
    navigator, folded = Navigator(CONFIG), list[Any]()
    fold = Navigator._fold
    monkeypatch.setattr(Navigator, "_fold", lambda self, record: folded.append(record) or fold(self, record))
    records = [origin(), *(record for moment in flight(60, 60.0, 60.0)[:300] for record in moment.records)]
    answer = next(r for r in records if isinstance(r, RsbnFix) and r.t_ns == 15 * NS)
    outputs, kept, most, most_fixes, tried = [], 0, 0, 0, 0
    for record in records:
        arriving = [record]
        if 20 * NS <= record.rx_ns < 21 * NS:
            for k in range(tried, tried + 10):
                t_ns, distance = answer.t_ns + k * 1000, answer.slant_range + k
                arriving.append(
                    msgspec.structs.replace(answer, t_ns=t_ns, rx_ns=record.rx_ns, slant_range=distance)
                )
            tried += 10
        for each in arriving:
            folded.clear()
            outputs += navigator.handle(each)
            kept = max(kept, len(navigator._past))
            most = max(most, len(folded))
            most_fixes = max(most_fixes, sum(isinstance(one, Gnss | RsbnFix) for one in folded))
    assert tried > 100
    assert most <= navigator_module.MOST_AGAIN + 1  # the record itself
    assert most_fixes <= navigator_module.MOST_FIXES + 1
    assert kept <= past_states.MOST_KEPT
    times = [out.t_ns for out in outputs if isinstance(out, Solution)]
    assert max(b - a for a, b in pairwise(times)) <= NS // 5


@pytest.mark.parametrize(
    ("late_s", "burst"), [(5.0, True), (5.0, False), (1.0, False)], ids=["burst", "5 s", "1 s"]
)
def test_samples_behind_answers_in_time_share_roll_backs(
    monkeypatch: pytest.MonkeyPatch, late_s: float, burst: bool
) -> None:
    """The autopilot's link is late, a beacon's is not: each sample alone would fold all answers since again,
    and a computer that has been late once would never catch up.
    """
    folded, ours = [0], Navigator(CONFIG)
    records = [record for moment in flight(60, 8.0, 60.0)[:300] for record in moment.records]
    late_ns, end_ns = round(late_s * NS), 20 * NS

    def arrival(record: Any) -> int:
        if isinstance(record, RsbnFix) or not 10 * NS <= record.t_ns < end_ns:
            return int(record.t_ns)
        return 15 * NS if burst and record.t_ns < 15 * NS else int(record.t_ns) + (0 if burst else late_ns)

    arriving = [msgspec.structs.replace(record, rx_ns=arrival(record)) for record in records]
    ours.handle(origin())
    wanted = [out for outs in flown_in_order(8.0)[1] for out in outs if isinstance(out, Solution)]
    fold, outputs = Navigator._fold, list[Any]()

    def counted(self: Navigator, record: Any) -> Any:
        folded[0] += 1
        return fold(self, record)

    monkeypatch.setattr(Navigator, "_fold", counted)
    for record in sorted(arriving, key=lambda record: record.rx_ns):
        outputs += ours.handle(record)
    found = [out for out in outputs if isinstance(out, Solution)]
    assert not any("computed" in out.reason for out in outputs if isinstance(out, Rejection))
    assert folded[0] < 1.5 * len(records)
    ends = [[each for each in run if each.t_ns > 27 * NS] for run in (found, wanted)]
    assert_same(*ends)


def test_more_late_answers_than_can_wait_are_rejected_aloud(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(navigator_module, "MOST_WAITING", 2)
    navigator, outputs = copy.deepcopy(before_late_answer()[0]), []
    _, answer, _ = with_late_answer(5.0)
    for k in range(4):  # each is older than where the roll-back is
        older = msgspec.structs.replace(answer, t_ns=answer.t_ns - k * 1000, slant_range=5e4 + k)
        outputs += navigator.handle(older)
    (out,) = (out for out in outputs if isinstance(out, Rejection) and "wait" in out.reason)
    assert out.reason == "more than 2 late records wait: not used"


@pytest.mark.parametrize(
    "between",
    [Tuning(19 * NS, 19 * NS, "[estimator]\nlate_s = 7.0\n"), Reboot(19 * NS, 19 * NS, 1)],
    ids=lambda record: type(record).__name__,
)
def test_what_comes_while_a_late_answer_is_folded_in_finds_it_used(between: Any) -> None:
    """Parameters are set, or the autopilot reboots: afterwards all is as if the answer had come in time."""
    records, answer, place = with_late_answer(5.0)
    ours, in_order = copy.deepcopy(before_late_answer()[0]), Navigator(CONFIG)
    solutions(ours, [answer])
    assert ours._roll_back is not None
    solutions(in_order, sorted([*records[:place], answer], key=lambda each: each.t_ns))
    rest = [between, msgspec.structs.replace(origin(), t_ns=19 * NS, rx_ns=19 * NS), *records[place:]]
    found, wanted = solutions(ours, rest), solutions(in_order, rest)
    assert ours._roll_back is None
    assert_same(
        [each for each in found if each.t_ns > 21 * NS], [each for each in wanted if each.t_ns > 21 * NS]
    )


@pytest.mark.parametrize(("off_m", "count", "least", "most"), [(5e4, 30, 3, 5), (0.0, 10, 10, 10)])
def test_false_late_answers_share_few_roll_backs(
    monkeypatch: pytest.MonkeyPatch, off_m: float, count: int, least: int, most: int
) -> None:
    """One answer a second, five seconds late: true ones are all used, false ones are tried once in ten
    seconds.
    """
    navigator, roll_backs = Navigator(CONFIG), []
    rewound = Navigator._rewound
    monkeypatch.setattr(
        Navigator, "_rewound", lambda self, state: roll_backs.append(1) or rewound(self, state)
    )
    navigator.handle(origin())
    late: list[RsbnFix] = []
    rejected: list[Any] = []
    for moment in flight(60, 60.0, 60.0)[: 10 * (16 + count)]:
        now = moment.records[0].t_ns
        for record in moment.records:
            if isinstance(record, RsbnFix) and 10 * NS <= now < (10 + count) * NS:
                late.append(
                    msgspec.structs.replace(
                        record, rx_ns=now + 5 * NS, azimuth=None, slant_range=record.slant_range + off_m
                    )
                )
            else:
                navigator.handle(record)
        while late and late[0].rx_ns <= now:
            rejected += [out for out in navigator.handle(late.pop(0)) if isinstance(out, Rejection)]
    assert least <= len(roll_backs) <= most
    assert bool(rejected) == (off_m > 0.0)


def test_answers_in_time_do_not_excuse_false_late_ones() -> None:
    """True answers 0.2 s late, false ones five seconds: these are tried twice in ten seconds."""
    navigator = Navigator(CONFIG)
    records = [record for moment in flight(60, 60.0, 60.0)[:400] for record in moment.records]
    answers = [record for record in records if isinstance(record, RsbnFix)]
    arriving = [record for record in records if not isinstance(record, RsbnFix)]
    for answer in answers:
        arriving.append(msgspec.structs.replace(answer, rx_ns=answer.t_ns + NS // 5))
        if answer.t_ns > 10 * NS:
            t_ns, far = answer.t_ns + NS // 2, answer.slant_range + 5e4
            arriving.append(
                msgspec.structs.replace(answer, t_ns=t_ns, rx_ns=t_ns + 5 * NS, azimuth=None, slant_range=far)
            )
    outputs = list[Any](navigator.handle(origin()))
    for record in sorted(arriving, key=lambda each: each.rx_ns):
        outputs += navigator.handle(record)
    rejected = [out.reason for out in outputs if isinstance(out, Rejection)]
    assert len(rejected) > 20
    assert sum("outlier" in reason for reason in rejected) <= 8


def test_a_stamp_cut_to_milliseconds_is_not_late(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of one instant: a fix stamped in us before a local position stamped in ms."""
    navigator, roll_backs = Navigator(CONFIG), []
    rewound = Navigator._rewound
    monkeypatch.setattr(
        Navigator, "_rewound", lambda self, state: roll_backs.append(1) or rewound(self, state)
    )
    navigator.handle(origin())
    outs = []
    for moment in flight(30, 30.0, 0.0):
        local, *fixes = moment.records
        for fix in fixes:
            outs += navigator.handle(msgspec.structs.replace(fix, t_ns=fix.t_ns + 700_000))
        outs += navigator.handle(local)
    assert not roll_backs
    assert max(out.t_ns for out in outs if isinstance(out, Solution)) > 29 * NS


@pytest.mark.parametrize("late_ns", [7 * NS // 10, 5 * NS])
def test_what_is_settled_in_between_changes_nothing(late_ns: int) -> None:
    """The service learns while it waits, a replay when the next record is there: answers come late, one GNSS
    fix is wild, and parameters are set in flight."""
    records = [record for moment in flight(60, 60.0, 60.0)[:360] for record in moment.records]
    answers = [record for record in records if isinstance(record, RsbnFix)]
    wild = next(k for k, record in enumerate(records) if k > 400 and isinstance(record, Gnss))
    for k, record in enumerate(records[wild : wild + 40], wild):  # not every fix is used
        if isinstance(record, Gnss) and record.t_ns < records[wild].t_ns + 6 * NS // 10:
            records[k] = msgspec.structs.replace(record, lat=record.lat + 1e-3)
    for answer in answers[9:30:3]:
        records.remove(answer)
        later = next(k for k, r in enumerate(records) if r.t_ns > answer.t_ns + late_ns)
        records.insert(later, answer)
    last = answers[15]  # right after it, its lesson not yet learnt perhaps
    tuning = Tuning(last.t_ns, last.rx_ns, "[rsbn]\nbias_range_m = 1.0\nbias_azimuth_deg = 0.001\n")
    records.insert(records.index(last) + 1, tuning)
    settling, waiting = Navigator(CONFIG), Navigator(CONFIG)
    settled, left = [], []
    for k, record in enumerate((origin(), *records)):
        settled += settling.handle(record)
        settling.settle()
        for _ in range(k % 3):  # births come in two halves
            settling.bear()
        left += waiting.handle(record)
    assert settled == left
    assert any(isinstance(out, Rejection) for out in left)
    assert any(isinstance(out, Fix) for out in left)


def test_a_fix_is_taken_to_be_as_old_as_the_receiver_is_slow() -> None:
    slow = Navigator(load(flags={"gnss.latency_s": 0.2, "inertial.independent": True}, environment={}))
    slow.handle(origin())
    reported, wanted = [], []
    for moment in flight(40, 40.0, 0.0):
        for record in moment.records:
            if isinstance(record, Gnss):
                wanted.append(record.t_ns)
                record = msgspec.structs.replace(record, t_ns=record.t_ns + NS // 5)
            reported += [out.t_ns for out in slow.handle(record) if isinstance(out, Fix)]
    assert len(reported) > 50
    assert set(reported) <= set(wanted)


def test_what_is_later_than_the_limit_is_rejected_aloud() -> None:
    navigator = Navigator(load(flags={"estimator.late_s": 2.0, "inertial.independent": True}, environment={}))
    navigator.handle(origin())
    records = [r for m in flight(60, 8.0, 60.0)[:199] for r in m.records]
    answer = next(r for r in records if isinstance(r, RsbnFix))
    for record in records:
        navigator.handle(record)
    (out,) = navigator.handle(answer)
    assert isinstance(out, Rejection)
    assert out.value is not None
    assert out.limit == 2.0
    assert out.value > 18.0


def test_what_is_older_than_the_first_record_is_not_called_late_and_no_fix_is_no_refusal() -> None:
    navigator = Navigator(CONFIG)
    records = [r for m in flight(10, 10.0, 10.0) for r in m.records if r.t_ns > 5 * NS]
    for record in (origin(), *records):
        navigator.handle(msgspec.structs.replace(record, t_ns=max(record.t_ns, 5 * NS)))
    answer = next(r for r in records if isinstance(r, RsbnFix))
    old = msgspec.structs.replace(answer, t_ns=4 * NS, rx_ns=10 * NS)
    (out,) = navigator.handle(old)
    assert isinstance(out, Rejection) and "older than the oldest kept state" in out.reason
    fix = next(r for r in records if isinstance(r, Gnss))
    assert navigator.handle(msgspec.structs.replace(fix, t_ns=NS, rx_ns=10 * NS, stamp_us=1, fix=1)) == []


def test_what_is_too_late_is_so_after_parameters_were_set_too() -> None:
    navigator = Navigator(CONFIG)
    navigator.handle(origin())
    records = [r for m in flight(40, 0.0, 40.0) for r in m.records]
    answer = next(r for r in records if isinstance(r, RsbnFix) and r.t_ns == 12 * NS)
    records.remove(answer)
    for record in records:
        navigator.handle(record)
        if record.t_ns == 20 * NS and isinstance(record, RsbnFix):
            navigator.handle(Tuning(20 * NS, 20 * NS, "[rsbn]\nbias_range_m = 60.0\n"))
            outputs = navigator.handle(msgspec.structs.replace(answer, rx_ns=20 * NS))
            assert isinstance(outputs[-1], Rejection)
            assert "not used" in outputs[-1].reason
            assert not any(isinstance(out, Solution) for out in outputs)


@lru_cache(maxsize=1)
def lost_for_ten_seconds() -> tuple[Navigator, list[Any], list[Solution]]:
    """A navigator without fixes since 30 s at 40 s, the records from then on, and its solutions by them."""
    records = [origin(), *(record for moment in flight(60, 30.0, 30.0) for record in moment.records)]
    at = next(k for k, record in enumerate(records) if record.t_ns > 40 * NS)
    navigator = Navigator(CONFIG)
    solutions(navigator, records[:at])
    return navigator, records[at:], solutions(copy.deepcopy(navigator), records[at:])


@pytest.mark.parametrize("name", [name for name, key in PARAMETERS.items() if key[0] != "output"])
def test_what_a_station_sets_without_fixes_keeps_the_position(name: str) -> None:
    """There is no other: only another inertial channel begins again."""
    section, key = PARAMETERS[name]
    old = getattr(getattr(CONFIG, section), key)
    new = (not old) if isinstance(old, bool) else 1.1 * max(old, 0.0) + 0.01
    changed = structs.replace(CONFIG, **{section: structs.replace(getattr(CONFIG, section), **{key: new})})
    navigator, records, wanted = lost_for_ten_seconds()
    tuning = Tuning(40 * NS, 40 * NS, to_toml(changed))
    found = solutions(copy.deepcopy(navigator), [tuning, *records])
    assert [each.t_ns for each in found] == [each.t_ns for each in wanted]
    for ours, its in zip(found, wanted, strict=True):
        assert math.dist(ours.error_n[:2], its.error_n[:2]) < 0.1 * math.sqrt(its.covariance[0])


def test_a_jump_of_the_inertial_channel_is_no_jump_of_the_estimate() -> None:
    navigator, seen, errors, resets = Navigator(CONFIG), False, [], []
    navigator.handle(origin())
    for moment in flight(60, 60.0, 60.0)[:400]:
        for record in moment.records:
            if isinstance(record, LocalPosition) and record.t_ns > 30 * NS:
                x, y, z = record.x_n
                record = msgspec.structs.replace(record, x_n=(x + 97.0, y - 40.0, z))
                seen = True
            for out in navigator.handle(record):
                if isinstance(out, Solution) and out.t_ns > 20 * NS:
                    errors.append(distance(out, moment.truth))
                if isinstance(out, Reset):
                    resets.append(out)
    assert seen
    assert len(resets) == 1
    assert "104.9 m" in resets[0].reason
    assert max(errors) < 15.0


def silent(gnss_until: float, step_m: float) -> tuple[list[tuple[Moment, Solution]], list[Any]]:
    """The solutions of a flight whose local position is silent from 25 s to 30 s and comes back `step_m`
    further north, each with its moment, and what is begun anew or excluded from then on.
    """
    navigator, solutions, reported = Navigator(CONFIG), [], []
    navigator.handle(origin())
    for moment in flight(60, gnss_until, 60.0)[:450]:
        for record in moment.records:
            if isinstance(record, LocalPosition) and record.t_ns > 25 * NS:
                if record.t_ns <= 30 * NS:
                    continue
                x, y, z = record.x_n
                record = msgspec.structs.replace(record, x_n=(x + step_m, y, z))
            for out in navigator.handle(record):
                solutions += [(moment, out)] if isinstance(out, Solution) else []
                excluded = isinstance(out, Rejection) and "excluded" in out.reason
                reported += [out] if isinstance(out, Reset) or excluded else []
    return solutions, reported


@pytest.mark.parametrize("gnss_until", [60.0, 15.0], ids=["gnss", "a beacon"])
def test_a_step_in_a_silence_is_undone_by_the_next_fix(gnss_until: float) -> None:
    """A turn would explain 200 m in 5 s, so it is no jump; but neither is it held against who contradicts."""
    solutions, reported = silent(gnss_until, 200.0)
    assert [(type(out), out.reason) for out in reported] == [(Reset, "no local position for 5.1 s")]
    after = [(m, s) for m, s in solutions if s.t_ns > 32 * NS]
    first = next(s for _, s in solutions if s.t_ns > 30 * NS)
    assert first.bound_n is None  # what was promised rests on what is no more
    worst_m = 10.0 if gnss_until > 30.0 else 300.0  # what one answer of a beacon is good for
    assert max(distance(s, m.truth) for m, s in after) < worst_m
    assert all(distance(s, m.truth) < 4.0 * math.sqrt(s.covariance[0] + s.covariance[3]) for m, s in after)
    if gnss_until > 30.0:
        assert solutions[-1][1].bound_n is not None  # and something is promised again


def test_a_silence_without_a_step_changes_nothing_that_was_known() -> None:
    solutions, reported = silent(60.0, 0.0)
    assert reported == []
    after = [(m, s) for m, s in solutions if s.t_ns > 30 * NS]
    assert max(distance(s, m.truth) for m, s in after) < 10.0
    assert all(s.bound_n is not None for _, s in after)


def test_a_gnss_jump_is_refused_and_counted() -> None:
    navigator, rejections, errors = Navigator(CONFIG), 0, []
    navigator.handle(origin())
    for moment in flight(70, 70.0, 70.0)[:620]:
        for record in moment.records:
            if isinstance(record, Gnss) and 50 * NS < record.t_ns < 60 * NS:
                record = msgspec.structs.replace(record, lat=record.lat + 500.0 / 6.4e6)
            for out in navigator.handle(record):
                rejections += isinstance(out, Rejection) and out.source == "gnss 0"
                if isinstance(out, Solution) and out.t_ns > 20 * NS:
                    errors.append(distance(out, moment.truth))
    assert rejections >= 9
    assert max(errors) < 15.0


def parked(stated: Iterator[tuple[float, float]], config: Config) -> Iterator[tuple[float, float, list[Any]]]:
    """Time of each fix of an aircraft at rest, how far north it is (m), and what the navigator returns."""
    navigator = Navigator(config)
    for k, (t, north) in enumerate(stated):
        t_ns, place = round(t * NS), displace(*ORIGIN, north, 0.0, 0.0)
        found = navigator.handle(Gnss(t_ns, t_ns, 0, t_ns // 1000, 3, *place, 1.5, 3.0, v_n=(0.0, 0.1, 0.0)))
        found += navigator.handle(Attitude(t_ns + NS // 10, t_ns + NS // 10, 1e-4 * k, 0.0, 0.0))
        yield t, north, found


def solved_off(found: list[Any], north: float) -> list[float]:
    """Distances of the solutions from a place `north` of the origin, m."""
    place = displace(*ORIGIN, north, 0.0, 0.0)
    return [distance(out, place) for out in found if isinstance(out, Solution)]


OWN_CHANNEL = load(flags={"output.profile": "ardupilot"}, environment={})


@pytest.mark.parametrize("hours", [0.5, 2.0, 10.0, 72.0])
@pytest.mark.parametrize("moved_m", [0.0, 3e3])
def test_a_fix_is_used_after_a_silence_of_any_length(hours: float, moved_m: float) -> None:
    """Parked, moved, and switched on again: from 20 minutes on every fix was an outlier, until a restart."""
    before, after = 0.5 * np.arange(1, 60), 3600.0 * hours + 0.5 * np.arange(60, 120)
    fixes = [*((t, 0.0) for t in before), *((t, moved_m) for t in after)]
    errors = [
        error
        for t, north, found in parked(iter(fixes), OWN_CHANNEL)
        for error in solved_off(found, north)
        if t > after[10]
    ]
    assert len(errors) > 40
    assert max(errors) < 5.0


@pytest.mark.parametrize("wrong_m", [1e3, 5e3, 1e5])
@pytest.mark.parametrize("wrong_s", [0.5, 1.0, 20.0])
def test_of_two_runs_of_fixes_that_contradict_each_other_the_longer_one_is_believed(
    wrong_m: float, wrong_s: float
) -> None:
    """First fixes may be far off: one, and GNSS was rejected for a minute by 1 km, for good by 5 km."""
    limit = wrong_s + max(10.0, wrong_s) + 2.0
    fixes = [(t, wrong_m if t <= wrong_s else 0.0) for t in 0.5 * np.arange(1, 2 * limit + 20)]
    last, resets = 0.0, list[Reset]()
    for t, _, found in parked(iter(fixes), OWN_CHANNEL):
        last = t if max(solved_off(found, 0.0), default=0.0) > 10.0 else last
        resets += [out for out in found if isinstance(out, Reset)]
    assert last <= limit
    assert [reset.what for reset in resets] == ["position"]


def test_a_gnss_that_jumps_far_is_not_followed_before_it_outlasts_the_flight_before() -> None:
    """A spoofer's: 5 km off for 50 s after a minute, and true again."""
    fixes = [(t, 5e3 if 60.0 < t <= 110.0 else 0.0) for t in 0.5 * np.arange(1, 240)]
    for t, _, found in parked(iter(fixes), OWN_CHANNEL):
        assert not [out for out in found if isinstance(out, Reset)]
        assert max(solved_off(found, 0.0), default=0.0) < (200.0 if 60.0 < t <= 112.0 else 5.0)


@pytest.mark.parametrize("late_s", [0.3, 0.9])
def test_each_change_of_belief_is_reported_once_beside_late_answers(late_s: float) -> None:
    """Each answer of the beacon folds what came since again, and may decide other than before."""
    navigator, reported, waiting = Navigator(CONFIG), list[tuple[str, str]](), list[RsbnFix]()
    navigator.handle(origin())
    for record in (record for moment in flight(60, 60.0, 60.0)[:290] for record in moment.records):
        if isinstance(record, RsbnFix):
            waiting.append(structs.replace(record, rx_ns=record.t_ns + round(late_s * NS)))
            continue
        if isinstance(record, Gnss) and 17.5 * NS < record.t_ns < 24.5 * NS:
            off = 25.0 * (record.t_ns / NS - 16.5)
            record = structs.replace(record, lat=record.lat + off / 6.4e6)
        due = [waiting.pop(0)] if waiting and waiting[0].rx_ns <= record.rx_ns else []
        for out in (out for each in (*due, record) for out in navigator.handle(each)):
            if isinstance(out, Event) and (
                found := re.match("(.*) is (excluded|suspect|used again|no longer suspect)", out.text)
            ):
                reported.append((found[1], found[2]))
    names = [source_name(i, navigator.state) for i in range(len(navigator.state.reported))]
    assert ("gnss", "excluded") in reported
    for source in {source for source, _ in reported}:
        words = [word for of, word in reported if of == source]
        assert all(a != b for a, b in pairwise(words)), (source, words)
        number = navigator.state.reported[names.index(source)]
        states = {"used again": 0, "no longer suspect": 0, "suspect": SUSPECT, "excluded": EXCLUDED}
        assert states[words[-1]] == number


def test_an_answer_that_fits_nothing_displaces_no_beacon() -> None:
    """Eight are followed; the ninth is stated 900 km off."""
    navigator, answers = Navigator(CONFIG), 0
    navigator.handle(origin())
    for record in (record for moment in flight(24, 24.0, 24.0) for record in moment.records):
        if isinstance(record, RsbnFix):
            number, answers = min(answers, 8), answers + 1
            lat = record.lat + (0.15 if number == 8 else 0.0)
            record = structs.replace(record, beacon=10 + number, lat=lat)
        navigator.handle(record)
    assert answers > 9
    assert {beacon.identity for beacon in navigator.state.beacons} == set(range(10, 18))


def test_a_repeated_fix_teaches_once() -> None:
    moments = flight(30, 30.0, 0.0)
    once = [o for _, outs in flown(moments) for o in outs]
    navigator = Navigator(CONFIG)
    navigator.handle(origin())
    twice = []
    for moment in moments:
        for record in moment.records:
            twice += navigator.handle(record)
            if isinstance(record, Gnss):
                assert navigator.handle(record) == []
    assert once == twice


def test_truth_reaches_nothing() -> None:
    navigator = Navigator(CONFIG)
    navigator.handle(origin())
    truth = Truth(NS, NS, *ORIGIN, (0.0, 0.0, 0.0))
    before = navigator.state
    assert navigator.handle(truth) == []
    assert navigator.state is before


def test_an_azimuth_alone_corrects_across_and_is_no_fix() -> None:
    navigator = Navigator(CONFIG)
    navigator.handle(origin())
    fixes, last = [], None
    for moment in flight(60, 1.0, 60.0)[:300]:
        for record in moment.records:
            if isinstance(record, RsbnFix):
                record = msgspec.structs.replace(record, slant_range=None)
            for out in navigator.handle(record):
                if isinstance(out, Fix) and out.t_ns > 3 * NS:
                    fixes.append(out)
                if isinstance(out, Solution):
                    last = out
    assert fixes == []
    assert last is not None
    assert last.mode is Mode.FIXED


def test_azimuth_and_range_in_messages_of_their_own_are_as_one_answer() -> None:
    """As of a VOR and a DME receiver: two events a second named one part, then the other."""

    def fly(is_apart: bool) -> tuple[list[Solution], list[str]]:
        navigator, out = Navigator(CONFIG), list[Any]()
        navigator.handle(origin())
        for record in (record for moment in flight(42, 20.0, 30.0) for record in moment.records):
            if is_apart and isinstance(record, RsbnFix):
                out += navigator.handle(structs.replace(record, slant_range=None))
                record = structs.replace(record, azimuth=None)
            out += navigator.handle(record)
        last = {each.t_ns: each for each in out if isinstance(each, Solution)}
        events = [each.text for each in out if isinstance(each, Event) and each.text.startswith("navigation")]
        return list(last.values()), events

    (whole, expected), (apart, events) = fly(False), fly(True)
    assert [text for text in events if text not in expected] == ["navigation fixed: gnss and azimuth fixes"]
    assert [text for text in events if text in expected] == expected
    for a, b in zip(whole, apart, strict=True):
        assert distance(a, Geodetic(b.lat, b.lon, b.alt_msl)) < 0.5
        assert a.sources == b.sources


@lru_cache(maxsize=1)
def fixes_of_whole_answers() -> list[Fix]:
    return fixes_by_a_beacon(None)


def fixes_by_a_beacon(apart_s: float | None) -> list[Fix]:
    """With a beacon alone since 20 s, whose range comes in a message of its own, `apart_s` later."""
    navigator, records, out = Navigator(CONFIG), list[Any](), list[Any]()
    for record in (record for moment in flight(42, 20.0, 40.0) for record in moment.records):
        if apart_s is not None and isinstance(record, RsbnFix):
            records.append(structs.replace(record, slant_range=None))
            t_ns = record.t_ns + round(apart_s * NS)
            record = structs.replace(record, azimuth=None, t_ns=t_ns, rx_ns=t_ns)
        records.append(record)
    for record in (origin(), *sorted(records, key=lambda record: record.rx_ns)):
        out += navigator.handle(record)
    return [each for each in out if isinstance(each, Fix) and each.t_ns > 22.5 * NS]


@pytest.mark.parametrize("apart_s", [0.0, 0.4])
def test_azimuth_and_range_in_messages_of_their_own_are_one_fix(apart_s: float) -> None:
    """The range is stamped later here than it was measured: by as much the fix may be off."""
    whole, apart = fixes_of_whole_answers(), fixes_by_a_beacon(apart_s)
    assert len(whole) == len(apart) == 17
    for a, b in zip(whole, apart, strict=True):
        assert math.dist(a.correction_n, b.correction_n) < 0.1 + 30.0 * apart_s
        assert b.covariance == pytest.approx(a.covariance, rel=0.02, abs=100.0)
        assert a.sources == b.sources


def test_a_gnss_that_is_suspect_joins_no_fix_of_a_beacon() -> None:
    """With the answer it was one, 35 m off with a sigma of 2 m, and in the window of the guaranteed bound."""
    navigator, joined = Navigator(CONFIG), dict[bool, int]()
    navigator.handle(origin())
    for record in (record for moment in flight(60, 60.0, 60.0)[:300] for record in moment.records):
        if isinstance(record, Gnss) and record.t_ns > 20 * NS:
            off = 15.0 * (record.t_ns / NS - 20.0)
            record = structs.replace(record, lat=record.lat + off / 6.4e6)
        navigator.handle(record)
        before = navigator.state
        navigator.settle()
        if isinstance(record, RsbnFix):
            is_suspect = before.false[GNSS] > 0.5
            for fix in navigator._deferred:
                assert not (is_suspect and isinstance(fix, Fix) and fix.sources & Source.GNSS)
                joined[is_suspect] = joined.get(is_suspect, 0) + isinstance(fix, Fix)
    assert joined == {False: 21, True: 9}


@pytest.mark.parametrize("ranged", [True, False], ids=["with a range", "an azimuth alone"])
def test_in_the_cone_of_silence_an_azimuth_is_no_fix(ranged: bool) -> None:
    """The beacon stands where the aircraft is after 40 s, 1 km up: it crosses the cone in 38 s."""
    moments, navigator, used = flight(60, 15.0, 60.0)[:406], Navigator(CONFIG), {}
    beacon = moments[400].truth._replace(alt=0.0)
    navigator.handle(origin())
    for moment in moments:
        for record in moment.records:
            if isinstance(record, RsbnFix):
                seen = slant_range_azimuth(beacon, moment.truth)
                record = RsbnFix(
                    *(record.t_ns, record.rx_ns, 1, *beacon),
                    seen.azimuth,
                    seen.slant_range if ranged else None,
                    record.sigma_azimuth,
                    record.sigma_range,
                )
            for out in navigator.handle(record):
                if isinstance(out, Solution):
                    used[round(out.t_ns / NS)] = Source(out.sources) & (Source.AZIMUTH | Source.RANGE)
    assert Source.AZIMUTH in used[15]
    assert used[40] == (Source.RANGE if ranged else Source(0))


def test_what_cannot_be_computed_is_refused_and_the_flight_goes_on(monkeypatch: pytest.MonkeyPatch) -> None:
    def singular(*_: Any) -> None:
        raise np.linalg.LinAlgError("Singular matrix")

    moments = flight(30, 30.0, 30.0)
    navigator, outs = Navigator(CONFIG), []
    navigator.handle(origin())
    for k, moment in enumerate(moments):
        with monkeypatch.context() as patch:
            if 100 <= k < 120:
                patch.setattr(measurements, "gnss_position", singular)
            outs += [out for record in moment.records for out in navigator.handle(record)]
    refused = [out for out in outs if isinstance(out, Rejection)]
    assert refused
    assert "cannot be computed with: Singular matrix" in {out.reason for out in refused}
    assert isinstance(outs[-1], Solution | Fix)
    assert max(out.t_ns for out in outs if isinstance(out, Solution)) > 29 * NS


def spoilt(record: Any, value: float) -> Iterator[Any]:
    """The record with `value` in one number after the other."""
    for field in record.__struct_fields__:
        said = getattr(record, field)
        if isinstance(said, float):
            yield msgspec.structs.replace(record, **{field: value})
        elif isinstance(said, tuple):
            for k in range(len(said)):
                yield msgspec.structs.replace(record, **{field: (*said[:k], value, *said[k + 1 :])})


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf, 1e300])
def test_what_is_no_number_is_refused_and_changes_nothing(value: float) -> None:
    clean, spoiled, refused, reported = iter(flown_in_order(60.0)[1]), Navigator(CONFIG), 0, 0
    spoiled.handle(origin())
    for k, moment in enumerate(flight(60, 60.0, 60.0)[:300]):
        for record in moment.records:
            if k >= 90 and k % 10 == 9:
                for wrong in spoilt(record, value):
                    outs = spoiled.handle(wrong)
                    assert {type(out) for out in outs} <= {Rejection}
                    refused, reported = refused + 1, reported + len(outs)
            assert spoiled.handle(record) == next(clean)
    assert refused > 200
    assert reported == 3 * 21  # once a second of each kind


def test_no_solution_lies_beyond_a_pole() -> None:
    """A flat earth goes on north of the pole, the earth does not."""
    navigator, outs = Navigator(CONFIG), []
    lat = math.radians(89.99)
    navigator.handle(LocalOrigin(0, 0, lat, 0.0, 0.0, "ardupilot"))
    for k in range(1, 600):  # the pole is 1.1 km ahead
        t_ns, north, v_n = k * NS // 10, 30.0 * k / 10, (30.0, 0.0, 0.0)
        outs += navigator.handle(LocalPosition(t_ns, t_ns, (north, 0.0, 0.0), v_n))
        if k < 20:
            outs += navigator.handle(Gnss(t_ns, t_ns, 0, t_ns // 1000, 3, lat + north / 6.4e6, 0.0, 0.0))
    solutions = [out for out in outs if isinstance(out, Solution)]
    refused = [out for out in outs if isinstance(out, Rejection) and out.source == "solution"]
    assert max(out.t_ns for out in solutions) < 40 * NS < max(out.t_ns for out in refused)
    assert all(abs(out.lat) <= math.pi / 2.0 for out in solutions)
    assert all(out.value > out.limit == math.pi / 2.0 for out in refused)


def test_a_state_gone_wrong_is_begun_anew_and_said(monkeypatch: pytest.MonkeyPatch) -> None:
    sight = measurements.sight

    def broken(*given: Any) -> measurements.Taken:
        taken = sight(*given)
        if isinstance(given[2], Azimuth):  # or the range finds it out, and only the answer is rejected
            return taken
        return taken._replace(bank=taken.bank._replace(P=np.full_like(taken.bank.P, np.nan)))

    navigator, outs = Navigator(CONFIG), []
    navigator.handle(origin())
    for k, moment in enumerate(flight(60, 60.0, 60.0)[:300]):
        with monkeypatch.context() as patch:
            if 100 <= k < 112:
                patch.setattr(measurements, "sight", broken)
            outs += [(moment, out) for record in moment.records for out in navigator.handle(record)]
    resets = [out for _, out in outs if isinstance(out, Reset)]
    assert {out.what for out in resets} == {"bank"}
    last_moment, last = [(m, out) for m, out in outs if isinstance(out, Solution)][-1]
    assert distance(last, last_moment.truth) < 10.0
    solutions = [out for _, out in outs if isinstance(out, Solution)]
    again = next(out for out in solutions if out.t_ns > resets[-1].t_ns)
    assert again.t_ns - resets[-1].t_ns < 0.4 * NS  # by the next fix, however soon after the last
    assert again.protection == pytest.approx(solutions[0].protection, rel=0.2)  # nothing before it counts
