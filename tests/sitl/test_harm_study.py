"""Harm study: the measure of harm, the flights, and the judgement of recordings."""

import json
import math
from dataclasses import replace
from itertools import product

import numpy as np
import pytest
from click.testing import CliRunner

from companion.analysis.jobs import FinishedJob
from companion.config import Config
from companion.records import Event, GlobalPosition, Gnss, Rejection, Solution
from sitl import harm_study
from sitl.campaign.flight import sensors_of
from sitl.faults import Fault
from sitl.harm_recordings import (
    LOGS,
    RecordingLog,
    RecordingResult,
    Track,
    fly_log,
    judge_recording,
    longest_refusal,
)
from sitl.harm_study import (
    CHANNELS,
    WRONG,
    HarmOrder,
    HarmResult,
    beside_fixes,
    config_of,
    fly,
    scenario_of,
    worst_ratio,
)
from sitl.world import World
from tests.solutions import solution_at

S = 1_000_000_000


def fix(t_s: float, **changes) -> Gnss:
    t = round(t_s * S)
    return Gnss(t, t, 0, t // 1000, **{"fix": 3, "lat": 1.0, "lon": 0.5, "alt_msl": 0.0, **changes})


def solution(t_s: float, north: float = 0.0) -> Solution:
    return solution_at(round(t_s * S), lat=1.0 + north / 6.37e6, lon=0.5, alt_msl=0.0)


def test_ratio_is_that_of_the_worst_ten_seconds_less_three_metres():
    t = np.arange(0.0, 60.0, 0.2)
    gnss = np.full(len(t), 2.0)
    assert worst_ratio(t, np.full(len(t), 3.0), t, gnss) == pytest.approx(0.0)
    error = np.where((t >= 30.0) & (t < 40.0), 9.0, 1.0)
    assert worst_ratio(t, error, t, gnss) == pytest.approx(3.0)
    assert worst_ratio(t[:0], error[:0], t, gnss) is None


def test_nothing_is_compared_where_no_fix_is_there():
    """Until the first fix, and from three silent seconds on until the next."""
    t = np.arange(0.0, 20.0, 0.5)
    left, _ = beside_fixes(t, t, np.array([2.0, 3.0, 14.0, 15.0]))
    assert list(left) == [*np.arange(2.5, 6.5, 0.5), *np.arange(14.5, 18.5, 0.5)]
    assert [len(x) for x in beside_fixes(t, t, np.array([]))] == [0, 0]


def test_a_flight_passes_only_without_exclusion_set_2_or_exception():
    good = HarmResult("nothing", "stock", 1, False, False, 1.2)
    assert good.passed
    for changes in ({"excluded": True}, {"set_2": True}, {"ratio": 1.21}, {"ratio": None}, {"raised": "no"}):
        assert not good._replace(**changes).passed


@pytest.mark.parametrize(("name", "minutes"), list(product(WRONG, (5.0, 10.0))))
def test_every_case_has_a_scenario_and_a_configuration(name, minutes):
    for channel in WRONG[name].channels:
        order = HarmOrder(name, channel, 1, minutes)
        assert scenario_of(order).duration_s == pytest.approx(60.0 * minutes)
        assert config_of(order).has_own_ins == channel.startswith("INS")


@pytest.mark.flight
@pytest.mark.parametrize("channel", ["INS navigation", "air data"])
def test_flight_with_nothing_wrong_passes(channel):
    result = fly(HarmOrder("nothing", channel, 1, 4.0))
    assert result.passed, result


@pytest.mark.flight
@pytest.mark.parametrize(
    "wrong", [pytest.param("beacon 3x as noisy as stated", marks=pytest.mark.long), "beacon range +200 m"]
)
def test_a_mems_ins_stated_as_navigation_grade_does_not_exclude_gnss(wrong):
    """Its gyros are 100 times as coarse, its accelerometers 10; by one factor for both GNSS was excluded.

    So it was once the range was false, of which the bank kept one grade.
    """
    result = fly(HarmOrder(wrong, "INS MEMS", 3, 10.0))
    assert result.passed, result


@pytest.mark.flight
@pytest.mark.long
@pytest.mark.parametrize("channel", ["INS navigation", "stock"])
def test_a_velocity_of_gnss_that_lags_its_positions_does_not_exclude_it(channel):
    """As of ArduPilot's simulator: excluded before, 13 m (stock) and 130 m (INS) beside a right GNSS."""
    assert fly(HarmOrder("GNSS velocity 0.3 % too small", channel, 1, 10.0)).passed


@pytest.mark.flight
@pytest.mark.parametrize(
    "channel",
    ["stock", *(pytest.param(c, marks=pytest.mark.long) for c in harm_study.CHANNELS if c != "stock")],
)
def test_a_false_velocity_of_gnss_does_not_exclude_its_position(channel):
    """Before, GNSS was excluded for it (stock, from take-off on: 574 times its own error)."""
    found = fly(HarmOrder("GNSS velocity 5 % too small", channel, 1, 5.0))
    assert found.passed and "velocity of gnss" in found.suspected


@pytest.mark.flight
@pytest.mark.parametrize("feeds", [True, False])
def test_set_2_is_seen_where_it_is_due_whatever_the_flight_sends(feeds, monkeypatch):
    """GNSS drawn off by 2 m/s, or without a fix: a study that never sees set 2 shows nothing."""
    monkeypatch.setitem(WRONG, "a false GNSS", harm_study.Wrong(feeds=feeds))
    order = HarmOrder("a false GNSS", "INS navigation", 1, 4.0)
    for fault, earliest_s, latest_s in (
        (Fault("gnss-spoof", 120.0, math.inf, 2.0), 125.0, 200.0),
        (Fault("gnss-jam", 120.0), 121.0, 124.0),
    ):
        scenario, config = replace(scenario_of(order), faults=(fault,)), config_of(order)
        log = fly_log(World(scenario).records(sensors_of(config)), config)
        assert log.set_2_ns and earliest_s <= log.set_2_ns[0] / S <= latest_s


def test_exception_in_a_flight_is_a_result(monkeypatch):
    monkeypatch.setattr(harm_study, "scenario_of", lambda order: 1 / 0)
    result = fly(HarmOrder("nothing", "stock", 1, 5.0))
    assert "ZeroDivisionError" in str(result.raised) and not result.passed


def test_longest_refusal_lasts_until_a_fix_is_used():
    fixes = [(fix(k), k != 12) for k in range(20)]
    assert longest_refusal(fixes, set()) == 0.0
    assert longest_refusal(fixes, {3 * S, 4 * S}) == 2.0
    assert longest_refusal(fixes, {10 * S, 11 * S, 12 * S, 13 * S}) == 1.0  # the fix at 12 s is not healthy


def test_recording_is_judged_by_what_was_done_to_healthy_fixes():
    log = RecordingLog(Config())
    for k in range(60):
        log.record(solution(k, 2.0))
        log.record(fix(k))
        log.record(GlobalPosition(k * S, k * S, 1.0 + 0.5 / 6.37e6, 0.5, 0.0, (0.0, 0.0, 0.0), 0.0))
    found = judge_recording("a", log, ())
    assert found.corrected_m == pytest.approx(2.0) and found.autopilot_m == pytest.approx(0.5)
    assert not found.passed  # worse than the autopilot by more than a metre
    better = RecordingLog(Config())
    better.records = [r for r in log.records if not isinstance(r, GlobalPosition)]
    assert judge_recording("a", better, ()).passed
    better.set_2_ns = [30 * S]
    assert judge_recording("a", better, ()).harmful
    assert not judge_recording("a", better, ((25.0, math.inf),)).harmful
    better.set_2_ns = []
    for k in (30, 31, 32):
        better.record(Rejection(k * S, k * S, "gnss 0", "excluded: false with probability", 1.0))
    better.record(Event(30 * S, 30 * S, 4, "gnss is excluded: false with probability 1.0000"))
    found = judge_recording("a", better, ())
    assert found.refused_s == pytest.approx(3.0) and found.excluded and not found.passed


def test_distance_is_unknown_beside_a_gap():
    track = Track.of([(0.0, 1.0, 0.5), (1.0, 1.0, 0.5), (10.0, 1.0, 0.5)])
    apart = track.distance(Track.of([(0.5, 1.0 + 10.0 / 6.37e6, 0.5), (5.0, 1.0, 0.5), (11.0, 1.0, 0.5)]))
    assert apart[0] == pytest.approx(10.0) and np.isnan(apart[1:]).all()


def test_command_prints_json_and_its_exit_code_tells_harm(tmp_path, monkeypatch):
    options = ["--quick", "--case", "nothing", "--workers", "0", "--data", str(tmp_path), "--json"]
    for ratio, code in ((0.5, 0), (2.0, 1)):
        monkeypatch.setattr(harm_study, "fly", lambda o, r=ratio: HarmResult(*o[:3], False, False, r))
        done = CliRunner().invoke(harm_study.command, options)
        assert done.exit_code == code, done.output
        found = json.loads(done.stdout)
        assert [row["channel"] for row in found["flights"]] == list(CHANNELS)
        assert found["recordings"] == [] and LOGS
    done = CliRunner().invoke(harm_study.command, options[:-1])
    assert "one thing wrong" in done.output and "NO (0 of 1)" in done.output


@pytest.mark.parametrize(
    ("options", "seeds", "minutes"),
    [
        ([], 3, 10.0),
        (["--quick"], 1, 5.0),
        (["--quick", "--seeds", "2"], 2, 5.0),
        (["--quick", "--minutes", "7"], 1, 7.0),
    ],
)
def test_what_is_given_beside_quick_is_used(options, seeds, minutes, tmp_path, monkeypatch):
    flown = []
    monkeypatch.setattr(harm_study, "fly", lambda o: flown.append(o) or HarmResult(*o[:3], False, False, 0.5))
    options = [*options, "--case", "nothing"]  # a case given twice is flown once
    fixed = ["--case", "nothing", "--channel", "stock", "--workers", "0", "--data", str(tmp_path), "--json"]
    done = CliRunner().invoke(harm_study.command, [*options, *fixed])
    assert done.exit_code == 0, done.output
    assert flown == [HarmOrder("nothing", "stock", seed, minutes) for seed in range(1, seeds + 1)]


def test_what_is_kept_is_not_flown_again(tmp_path, monkeypatch):
    flown = []
    monkeypatch.setattr(harm_study, "fly", lambda o: flown.append(o) or HarmResult(*o[:3], False, False, 0.5))
    monkeypatch.setattr(harm_study, "list_recordings", lambda data: ["a"])
    seen = RecordingResult("a", 60.0, 60, 0.0, 0.5, None, None, False, None, False, True)
    monkeypatch.setattr(harm_study, "fly_one_recording", lambda data, name: flown.append(name) or seen)
    fixed = ["--case", "nothing", "--channel", "stock", "--workers", "0", "--data", str(tmp_path), "--json"]
    keep = [*fixed, "--results", str(tmp_path / "kept")]
    printed = [CliRunner().invoke(harm_study.command, [*keep, "--seeds", n]).stdout for n in "1122"]
    assert flown == [HarmOrder("nothing", "stock", 1, 10.0), "a", HarmOrder("nothing", "stock", 2, 10.0)]
    assert printed[0] == printed[1] and printed[2] == printed[3]
    CliRunner().invoke(harm_study.command, [*keep, "--minutes", "5", "--seeds", "1"])
    assert flown[3:] == [HarmOrder("nothing", "stock", 1, 5.0)]  # another flight


def test_results_of_another_study_are_rejected(tmp_path):
    (tmp_path / "harm.jsonl").write_text('{"key": "nothing/stock/1/5", "result": {"detected_s": 3.0}}\n')
    options = ["--quick", "--case", "nothing", "--channel", "stock", "--results", str(tmp_path)]
    done = CliRunner().invoke(harm_study.command, [*options, "--workers", "0", "--data", str(tmp_path)])
    assert done.exit_code == 1
    assert "harm.jsonl: invalid result" in done.output and "choose another --results folder" in done.output


def test_a_flight_that_is_lost_with_its_worker_leaves_the_others_kept(tmp_path, monkeypatch):
    def run(work, jobs, *_):
        first, *others = jobs
        return iter(
            [FinishedJob(first, None, "worker lost"), *(FinishedJob(k, work(jobs[k])) for k in others)]
        )

    monkeypatch.setattr(harm_study, "run_jobs", run)
    monkeypatch.setattr(harm_study, "fly", lambda o: HarmResult(*o[:3], False, False, 0.5))
    options = ["--case", "nothing", "--channel", "stock", "--data", str(tmp_path / "none")]
    done = CliRunner().invoke(harm_study.command, [*options, "--workers", "0", "--results", str(tmp_path)])
    assert done.exit_code == 1 and "nothing/stock/1/10: worker lost: start again" in done.output
    kept = [json.loads(line)["key"] for line in (tmp_path / "harm.jsonl").read_text().splitlines()]
    assert kept == ["nothing/stock/2/10", "nothing/stock/3/10"]
