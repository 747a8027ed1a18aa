"""Reports: simulated errors, grouped rejections and violated bounds are stated; the page is self-contained.

The page is opened in a real browser (skipped without chromium).
"""

import dataclasses
import errno
import html
import json
import math
import os
import re
import shutil
from pathlib import Path

import msgspec
import numpy as np
import pytest
from click.testing import CliRunner
from hypothesis import given, settings
from hypothesis import strategies as st

from companion import optional_dependencies
from companion.analysis import assessment as assessing
from companion.analysis import error_statistics
from companion.analysis.assessment import assess_flight
from companion.analysis.convert import convert_log
from companion.analysis.drawing import to_page, write_figures
from companion.analysis.figures import build_figures
from companion.analysis.flight_arrays import collect_flights
from companion.analysis.flight_events import describe_rejections, event_title, phase_title, topic_name
from companion.analysis.flights import describe_channel, open_flights
from companion.analysis.html import ReportBlock, comparison_table, render_report
from companion.analysis.log_command import group as log_group
from companion.analysis.plot_data import Figure, Line, thin_line
from companion.analysis.replay import command as replay_command
from companion.analysis.report import blocks_of_log, command, comparison_block
from companion.analysis.summary import (
    describe_gnss,
    describe_outage,
    format_duration,
    format_length,
    format_time,
    rms_after_start,
    rms_by_source,
    summarize_flight,
    worst_of,
)
from companion.analysis.verdict import judge_flight
from companion.config import Config, load, to_toml
from companion.nav.earth import radii
from companion.nav.geometry import displace
from companion.records import (
    INPUTS,
    OUTPUTS,
    AirData,
    Attitude,
    Event,
    Fix,
    Gnss,
    Imu,
    LinkState,
    LocalPosition,
    Mode,
    Prediction,
    Reboot,
    Rejection,
    Reset,
    RsbnFix,
    Solution,
    Source,
    Truth,
    Tuning,
)
from companion.storage import flight_log
from companion.storage.reader import LogError
from companion.storage.run_metadata import run_metadata
from companion.write_errors import write_whole

S = 1_000_000_000
START = 5_000 * S
LAT, LON = 0.97, 0.65
LOST, FOUND, END = 120, 240, 300  # s
DATA = Path(__file__).parents[2].parent / "shared" / "data"
NASTY = "<!--<script>alert(1)</script>"


def sentences(a):
    return " ".join(summarize_flight(a))


def flight_records(
    error=(3.0, 4.0), bound=(30.0, 40.0), ins=(60.0, 80.0), truth=True, receiver=0, sigma=5.0, **more
):
    """Five minutes eastwards at 20 m/s; GNSS lost from LOST to FOUND, rejected for 2 s at 60 s.

    With receiver 1 no fix is used. `unused`: GNSS is not lost, but not used either.
    """
    one = load(flags={"gnss.second_receiver": False}, environment={})
    rows = [Tuning(START, START, to_toml(one))] if receiver else []
    for k in range(END * 5):
        t = START + k * S // 5
        second = k / 5
        lat, lon, _ = displace(LAT, LON, 0.0, 0.0, 20.0 * second, 0.0)
        lost = LOST <= second < FOUND
        if truth:
            rows.append(Truth(t, t, lat, lon, 100.0, (0.0, 20.0, 0.0)))
        glitch = 60.0 <= second < 62.0
        if not lost or more.get("unused"):
            off = 500.0 if glitch else 0.0
            place = displace(lat, lon, 0.0, off, 0.0, 0.0)
            rows.append(Gnss(t, t + 50_000_000, receiver, k, 3, place.lat, place.lon, 100.0, 2.0))
            if glitch:
                rows.append(
                    Rejection(t, t, "gnss 0", "innovation beyond its gate (chi-square)", 99.0 + k, 27.6)
                )
        estimate = displace(lat, lon, 0.0, *error, 0.0)
        mode = Mode.PREDICTING if lost else Mode.FIXED
        rows.append(LocalPosition(t, t + 8_000_000, (0.0, 20.0 * second, 0.0), (0.0, 20.0, 0.0)))
        rows.append(
            Solution(
                *(t, t, mode, "minimax" if lost else "kalman", estimate.lat, estimate.lon, 100.0),
                v_n=(0.0, 20.0, 0.0),
                covariance=(sigma**2, 0.0, 0.0, sigma**2, 0.0, 25.0),
                error_n=(ins[0] - error[0], ins[1] - error[1]),
                velocity_error_n=(0.0, 0.0),
                sources=more.get("alone", 1) if lost else 3,
                horizon_s=0.0,
                bound_n=bound,
                ahead=(Prediction(60.0, (10.0, 10.0), (5.0, 5.0), (8.0, 8.0)),),
                protection=more.get("protection"),
            )
        )
        if k % 5 == 0 and not lost and not glitch:
            rows.append(Fix(t, t, lat, lon, 100.0, (59.0, 79.0), (4.0, 0.0, 4.0), 2, 0.0, 0, 1))
        if k % 25 == 0:
            rows.append(LinkState(t, t, "serial", True, 10 * k, 1, 0, 0, 17 * S + k * 1000, 9_000_000))
            if receiver == 0:
                rows.append(RsbnFix(t, t + 1, 7, LAT, LON, 0.0, 1.0, 20.0 * second, 0.002, 100.0))
    rows.append(Event(START + LOST * S, START + LOST * S, 5, f"navigation predicting: {NASTY} fixes"))
    if more.get("reset"):
        rows.append(Reset(START + 10 * S, START + 10 * S, "inertial channel", "it jumped by 12.0 m"))
    return rows


def flight(**kind):
    (found,) = collect_flights(
        ((flight_log.topic_of(type(r)), r) for r in flight_records(**kind)), "made.mcap"
    )
    return found


@pytest.fixture(scope="module")
def assessed():
    return assess_flight(flight())


@pytest.fixture(scope="module")
def log(tmp_path_factory):
    """A log whose name contains a script element."""
    path = tmp_path_factory.mktemp("logs") / "a <script> & b.mcap"
    with flight_log.Writer(
        path, metadata=run_metadata(Config()), start_unix_ns=1_700_000_000 * S, start_ns=START, block=True
    ) as out:
        for record in flight_records():
            out.record(record)
    return path


@pytest.fixture(scope="module")
def page(log, tmp_path_factory):
    pytest.importorskip("jinja2")
    path = tmp_path_factory.mktemp("page") / "report.html"
    found = CliRunner().invoke(command, [str(log), "-o", str(path)], catch_exceptions=False)
    assert found.exit_code == 0
    assert "GNSS was lost once" in found.output
    return path


# -- numbers ---------------------------------------------------------------------------------------------


def test_simulated_errors_are_reported(assessed):
    assert assessed.reference.what == assessing.TRUTH
    assert np.allclose(assessed.errors[error_statistics.CORRECTED].error, 5.0, atol=1e-3)
    assert np.allclose(assessed.errors[error_statistics.INS].error, 100.0, atol=1e-2)
    glitch = assessed.errors[error_statistics.GNSS].error
    assert np.isclose(glitch.max(), 500.0, atol=1e-2)
    assert np.median(glitch) < 1e-3
    for row in assessed.rows:
        assert row.rms[error_statistics.CORRECTED] == pytest.approx(5.0, abs=1e-3)


def test_beacon_errors_equal_those_of_the_loopback(assessed):
    """GNSS is available except for two minutes; every beacon measurement is counted."""

    def truth(t_ns):
        return displace(LAT, LON, 100.0, 0.0, 20.0 * (t_ns - START) / S, 0.0)

    expected = error_statistics.horizontal_errors(
        [r for r in flight_records() if isinstance(r, RsbnFix)], truth
    )[error_statistics.RSBN]
    found = assessed.errors[error_statistics.RSBN]
    assert len(found.t_ns) == len(expected.t_ns) == END // 5
    assert np.allclose(found.error, expected.error, rtol=1e-3, atol=0.1)
    assert all(error_statistics.RSBN in row.rms for row in assessed.rows)


def rebooted(at_s=200.0):
    """The same five minutes, with a reboot of the autopilot."""
    at = START + round(at_s * S)
    rows = flight_records()
    k = next(k for k, r in enumerate(rows) if r.rx_ns >= at)
    return [*rows[:k], Reboot(at, at, 1), *rows[k:]]


def test_reboot_splits_a_log_into_flights():
    records = [(flight_log.topic_of(type(r)), r) for r in rebooted()]
    first, second = collect_flights(records, "made.mcap", unix_ns=10**18)
    assert (first.part, second.part) == ((1, 2), (2, 2))
    assert (second.unix_ns - first.unix_ns, second.zero_ns - first.zero_ns) == (200 * S, 200 * S)
    assert sum(len(s.t) for f in (first, second) for s in f.streams.values()) == len(records)
    assert "/in/Reboot" in second.streams and "/in/Reboot" not in first.streams
    text_of_summary = sentences(assess_flight(second))
    assert "Flight 2 of 2 lasts 1 min 40 s." in text_of_summary
    assert (
        "GNSS was lost once" not in text_of_summary
    )  # the outage is in the first flight: here GNSS starts at 0:40


def test_the_reset_of_a_reboot_is_no_reset_of_either_flight():
    """The importer reports it before the reboot, the navigator after it: both flights were cautioned."""
    rows = rebooted()
    k, at = next((k, r.rx_ns) for k, r in enumerate(rows) if isinstance(r, Reboot))
    why = "autopilot 1 rebooted"
    rows[k : k + 1] = [Reset(at, at, "flight", why), rows[k], Reset(at, at, "sensors", why)]

    def flights_in(rows):
        return map(assess_flight, collect_flights(((flight_log.topic_of(type(r)), r) for r in rows), "made"))

    for a, what in zip(flights_in(rows), ("flight", "sensors"), strict=True):
        (line,) = (line for line in a.timeline if "reset" in line.text)
        assert (line.kind, line.text) == ("reboot", f"{what} reset: {why}")
        assert judge_flight(a).level == "good" and "reset" not in sentences(a)
    later = at + 10 * S
    _, second = flights_in([*rows, Reset(later, later, "bank", "covariance not positive definite")])
    assert judge_flight(second).reason == (
        "The estimate was reset, first at 0:10: bank reset: covariance not positive definite."
    )


def silent_flight(start_s, end_s, **kind):
    """The same five minutes; nothing arrives from the autopilot for a part of them."""
    a, b = START + start_s * S, START + end_s * S
    rows = [r for r in flight_records(**kind) if not a <= r.rx_ns < b or isinstance(r, LinkState)]
    (found,) = collect_flights(((flight_log.topic_of(type(r)), r) for r in rows), "made.mcap")
    return assess_flight(found)


def test_a_silent_autopilot_is_no_loss_of_gnss_and_leaves_no_estimate():
    a = silent_flight(250, 280)
    assert [(round(h.start), round(h.end)) for h in a.outages] == [(LOST, FOUND)]
    (silence,) = a.silences
    assert (round(silence.start), round(silence.end)) == (250, 280)
    (row,) = (row for row in a.rows if row.phase == "no estimate")
    assert row.seconds == pytest.approx(30.0, abs=0.5)
    assert row.held is None
    assert "Nothing was received from the autopilot once, for 30 s (from 4:10 to 4:40)." in sentences(a)
    verdict = judge_flight(a)
    assert (verdict.level, verdict.number) == ("caution", "30 s")
    assert verdict.reason == "There was no estimate for a part of the flight, from 4:10 on."


def test_an_autopilot_that_is_switched_off_at_the_end_is_no_reason_for_caution():
    a = silent_flight(260, END)
    assert [(round(h.start), round(h.end)) for h in a.outages] == [(LOST, FOUND)]
    assert "(from 4:20 to the end)" in sentences(a)
    assert describe_gnss(a) == "GNSS was lost for up to 2 min"
    assert describe_gnss(silent_flight(260, END, unused=True)) == (
        "GNSS had a fix throughout, while the autopilot sent"
    )
    assert a.rows[-1].phase == "no estimate"
    assert judge_flight(a).level == "good"


@pytest.mark.parametrize(("after_s", "level"), [(0.1, "good"), (8.0, "caution")])
def test_a_silence_before_a_reboot_is_none_of_a_flight(after_s, level):
    """A restarted autopilot sends a few messages before its reboot is recognised; 19 s were cautioned."""
    a, b = START + 260 * S, START + 279 * S
    rows = [r for r in flight_records() if r.rx_ns < a]
    late = (b + round(t * S) for t in np.linspace(0.0, after_s, 5))
    rows += [LocalPosition(t, t, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)) for t in late]
    (found,) = collect_flights(((flight_log.topic_of(type(r)), r) for r in rows), "made.mcap")
    assert judge_flight(assess_flight(found)).level == level


def test_every_flight_has_its_own_chapters(tmp_path, monkeypatch):
    """Files of figures are named only: that they are drawn is another test."""
    pytest.importorskip("jinja2")
    sheet = pytest.importorskip("matplotlib.figure").Figure
    monkeypatch.setattr(sheet, "savefig", lambda self, file, format: None)
    log, out = tmp_path / "two.mcap", tmp_path / "r.html"
    with flight_log.Writer(
        log, metadata=run_metadata(Config()), start_unix_ns=1_700_000_000 * S, start_ns=START, block=True
    ) as writer:
        for record in rebooted(20.0):
            if record.rx_ns < START + 40 * S:
                writer.record(record)
    found = CliRunner().invoke(
        command, [str(log), "-o", str(out), "--png", str(tmp_path)], catch_exceptions=False
    )
    assert "Flight 1 of 2" in found.output and "Flight 2 of 2" in found.output
    text = out.read_text("utf-8")
    ids = re.findall(r'id="plot-(\w+)"', text)
    assert {"flight1_map", "flight2_map"} <= set(ids) and len(set(ids)) == len(ids)
    assert set(json.loads(re.search(r'id="figures">(.*?)</script>', text, re.S)[1])) == set(ids)
    assert (tmp_path / "flight2_map.png").exists()
    replayed = CliRunner().invoke(replay_command, [str(log), "-o", str(tmp_path / "x.mcap")])
    assert "2 flights, separated by reboots of the autopilot" in replayed.output


def test_phases_follow_the_sources_of_the_position(assessed):
    assert [phase.name for phase in assessed.phases] == ["GNSS", "prediction", "GNSS"]
    assert [round(phase.start_ns / S) for phase in assessed.phases] == [0, LOST, FOUND]
    assert [(round(h.start), round(h.end)) for h in assessed.outages] == [(LOST, FOUND)]


def test_consecutive_rejections_are_grouped(assessed):
    (group,) = assessed.groups
    assert (group.source, group.number) == ("gnss 0", 10)
    assert (group.start, group.end) == pytest.approx((60.0, 61.8))
    assert group.metres == pytest.approx(500.0, abs=5.0)
    assert group.value == 99.0 + 309
    assert "10 in a row" in describe_rejections(group)
    assert [line.text for line in assessed.timeline if line.kind == "rejected"] == [
        describe_rejections(group)
    ]


def test_distance_of_rejected_fixes_is_that_of_their_receiver():
    """The second receiver agrees with the estimate while the first is rejected, and far off at the end."""
    rows = flight_records()
    for second in (60.5, 61.0, 61.5, 280.0, 281.0):
        t = START + round(second * S)
        lat, lon, _ = displace(LAT, LON, 0.0, 0.0, 20.0 * second, 0.0)
        north = 900.0 if second > 61.0 else 0.0
        place = displace(lat, lon, 0.0, north, 0.0, 0.0)
        rows.append(Gnss(t, t, 1, round(10 * second), 3, place.lat, place.lon, 100.0, 2.0))
        if second <= 61.0 or second >= 280.0:
            rows.append(Rejection(t, t, "gnss 1", "outlier: normalised squared innovation", 99.0, 27.6))
    rows.sort(key=lambda r: r.rx_ns)
    (found,) = collect_flights(((flight_log.topic_of(type(r)), r) for r in rows), "made.mcap")
    apart = {k: [g.metres for g in assess_flight(found).groups if g.source == f"gnss {k}"] for k in (0, 1)}
    assert apart[0] == pytest.approx([497.0], abs=0.1)  # the estimate is 3 m north, 4 m east
    assert apart[1] == pytest.approx([5.0, 897.0], abs=0.1)


def test_a_report_is_the_same_across_the_antimeridian(monkeypatch, assessed):
    """The aircraft crosses it at 61 s, while GNSS is rejected."""
    at_61_s = displace(LAT, LON, 0.0, 0.0, 20.0 * 61.0, 0.0).lon - LON
    monkeypatch.setitem(globals(), "LON", math.pi - at_61_s)
    assert sentences(assess_flight(flight())) == sentences(assessed)


def test_the_last_moment_belongs_to_the_last_phase():
    """The log ends with an estimate without fixes, 500 m off: of the flight with fixes it is none."""
    last = max(r.t_ns for r in flight_records() if isinstance(r, Solution) and r.t_ns < START + 150 * S)
    rows = [r for r in flight_records() if r.rx_ns <= last and not isinstance(r, Event)]
    far = displace(LAT, LON, 0.0, 500.0, 20.0 * (last - START) / S, 0.0)
    rows[-1] = msgspec.structs.replace(rows[-1], lat=far.lat, lon=far.lon)
    a = collected(rows)
    assert [phase.name for phase in a.phases] == ["GNSS", "prediction"]
    rms = rms_by_source(a)
    assert rms["with GNSS"] == pytest.approx(5.0, abs=0.1)
    assert (without := rms["without fixes"]) == a.rows[-1].rms[error_statistics.CORRECTED]
    assert without == pytest.approx(math.sqrt((149 * 5.0**2 + 500.0**2) / 150), rel=1e-3)


def test_a_figure_names_only_what_it_draws(assessed):
    """A flight without a bound had one in its legend; flights that are compared have no shaded times."""
    bare = collected(
        msgspec.structs.replace(r, bound_n=None) if isinstance(r, Solution) else r for r in flight_records()
    )
    for flights, bounds in (([assessed], 1), ([bare], 0), ([assessed, bare], 1)):
        (figure,) = (figure for figure in build_figures(flights) if figure.key == "error")
        assert sum(line.name.endswith("guaranteed bound") for line in figure.lines) == bounds
        assert ("Shaded" in figure.note) == bool(figure.spans)


def test_nothing_is_drawn_where_nothing_came():
    """The autopilot is silent for a minute: a line across it would be an estimate that there was not."""
    a = collected([r for r in flight_records() if not 30.0 < (r.rx_ns - START) / S < 90.0])
    assert [phase.name for phase in a.phases][:3] == ["GNSS", "no estimate", "GNSS"]
    found = {figure.key: figure for figure in build_figures([a])}
    for key in ("map", "error", "bound", "consistency", "inertial_north", "inertial_east", "sources"):
        for line in found[key].lines:
            t, y = line.t if key == "map" else line.x, line.y
            if line.style == "dots" or t is None:
                continue
            drawn = np.isfinite(y[:-1] + y[1:])
            assert drawn.any() and not drawn[(t[:-1] < 60.0) & (t[1:] > 60.0)].any(), (key, line.name)


@pytest.mark.parametrize("seconds", [3, 12, 121])
def test_a_steady_message_has_one_rate_to_the_end_of_the_chart(seconds):
    """Five estimates a second."""
    a = collected([r for r in flight_records() if r.rx_ns < START + seconds * S])
    (figure,) = (figure for figure in build_figures([a]) if figure.key == "rates")
    (line,) = (line for line in figure.lines if line.name == "estimate")
    width = a.flight.seconds / len(line.y)
    assert np.allclose(line.y, 5.0, atol=1.0 / width + 1e-9)  # one message more or less
    assert np.sum(line.y) * width == pytest.approx(5 * seconds)


def test_nees_is_the_normalized_squared_error(assessed):
    (nees,) = (series for series in assessed.normalized_errors if series.what == "NEES")
    assert np.allclose(nees.value, 1.0, atol=1e-3)
    assert nees.inside == 1.0


def test_chi_square_quantiles_match_tables():
    found = assessing.chi2_95(np.array([1.0, 2.0, 3.0]))
    assert np.allclose(found, [3.841, 5.991, 7.815], atol=1e-3)


@pytest.mark.parametrize("alone", [Source.INERTIAL, Source.INERTIAL | Source.AIR_DATA])
def test_the_bound_is_drawn_where_there_are_no_fixes(alone):
    found = {figure.key: figure for figure in build_figures([assess_flight(flight(alone=int(alone)))])}
    (ellipses,) = (line for line in found["map"].lines if line.name == "guaranteed bound")
    assert np.isnan(ellipses.x).sum() == 9
    for axis in ("north", "east"):
        edges = [line for line in found[f"inertial_{axis}"].lines if line.dash]
        assert [np.isfinite(edge.y).any() for edge in edges] == [True, True]


@pytest.mark.parametrize(("size", "held"), [(4.9, False), (5.1, True)])
def test_violated_bound_is_reported(size, held):
    side = size / math.sqrt(2.0)
    a = assess_flight(flight(bound=(side, side)))
    assert all(row.held is held for row in a.rows)
    assert ("was exceeded in 3 of 3 phases" in sentences(a)) is not held
    assert ("held at every instant that had one" in sentences(a)) is held


def test_summary_describes_the_flight(assessed):
    text_of_summary = sentences(assessed)
    for words in (
        "The log covers 5 min.",
        "GNSS was lost once, for 2 min (from 2:00 to 4:00).",
        "error of the estimate was 5.0 m with GNSS, 5.0 m without fixes (r.m.s.), 5.0 m at most (",
        "); the inertial channel alone 100 m",
        "10 fixes were rejected, from 1:00 to 1:02",
    ):
        assert words in text_of_summary


def collected(records):
    (found,) = collect_flights(((flight_log.topic_of(type(r)), r) for r in records), "made.mcap")
    return assess_flight(found)


@pytest.mark.parametrize(
    ("fix", "state"), [(None, "never received"), (1, "received without a fix")], ids=["no message", "no fix"]
)
def test_gnss_that_never_had_a_fix_was_not_kept(fix, state):
    records = (r for r in flight_records() if fix or not isinstance(r, Gnss))
    a = collected(msgspec.structs.replace(r, fix=fix) if isinstance(r, Gnss) else r for r in records)
    assert f"GNSS was {state}. The position was predicted without any fix for 2 min." in sentences(a)
    assert describe_outage(a) == state
    assert judge_flight(a).reason.startswith(f"GNSS was {state}, and the guaranteed bound held")


def test_gnss_that_is_there_but_not_used_is_reported_so():
    text = sentences(assess_flight(flight(unused=True)))
    assert "GNSS had a fix throughout, but was not used for 2 min." in text
    assert "predicted without any fix" not in text


def test_gnss_that_comes_late_was_not_there_throughout():
    late = START + 60 * S
    a = collected(r for r in flight_records(unused=True) if not isinstance(r, Gnss) or r.t_ns >= late)
    assert "GNSS had a fix from 1:00 on" in sentences(a)


def test_short_flight_is_named_by_what_lasted_longest():
    """A second of prediction before four of GNSS: both are too short for a phase of their own."""
    cut = START + LOST * S
    solutions = [r for r in flight_records() if isinstance(r, Solution)]
    lost = [r for r in solutions if r.t_ns >= cut][:5]
    rest = [r for r in solutions if r.t_ns < cut][:20]
    moved = [msgspec.structs.replace(r, t_ns=START + k * S // 5) for k, r in enumerate([*lost, *rest])]
    a = collected(msgspec.structs.replace(r, rx_ns=r.t_ns) for r in moved)
    assert [phase.name for phase in a.phases] == ["GNSS"]


def test_estimate_worse_than_the_inertial_channel_is_an_anomaly():
    assert "worse than the inertial channel alone" in sentences(
        assess_flight(flight(error=(30.0, 40.0), ins=(3.0, 4.0)))
    )


def test_the_first_minutes_are_not_compared_with_an_ins_that_starts_without_error():
    rows = list(flight_records(error=(3.0, 4.0), ins=(0.0, 0.0)))
    short = collected(r for r in rows if r.rx_ns < START + 60 * S)
    assert judge_flight(short).level == "good"
    assert "worse than the inertial channel" not in sentences(short)
    assert "worse than the inertial channel" in judge_flight(collected(rows)).reason


def test_a_phase_without_an_estimate_is_not_compared_with_the_inertial_channel():
    """The autopilot is silent for a minute; the first estimate after it, 400 m off, belongs to that phase."""
    start, end = START + 60 * S, START + 110 * S
    rows = [r for r in flight_records() if not start <= r.rx_ns < end or isinstance(r, Truth)]
    first = next(k for k, r in enumerate(rows) if isinstance(r, Solution) and r.t_ns >= end)
    far = displace(rows[first].lat, rows[first].lon, 0.0, 400.0, 0.0, 0.0)
    ins = (-400.0 + 3.0, 4.0)
    rows[first] = msgspec.structs.replace(
        rows[first], mode=Mode.UNTRUSTED, lat=far.lat, lon=far.lon, error_n=ins, bound_n=None
    )
    a = collected(rows)
    (row,) = (row for row in a.rows if row.phase == "no estimate")
    assert row.rms["corrected"] > 1.2 * row.rms["INS alone"] + 1.0
    assert "worse than the inertial channel" not in sentences(a)
    assert judge_flight(a).reason == "There was no estimate for a part of the flight, from 1:00 on."


def test_reference_without_truth_is_named():
    a = assess_flight(flight(truth=False, receiver=1))  # no fix of the receiver in use: nothing to smooth
    assert a.reference.what == assessing.GNSS
    assert "GNSS may itself be off" in sentences(a)
    assert error_statistics.GNSS not in a.errors  # GNSS is the reference itself


def test_flights_are_compared_in_one_table_and_in_the_same_axes(assessed):
    worse = assess_flight(flight(error=(6.0, 8.0)))
    logs = [[assessed.flight], [worse.flight], [assessed.flight]]
    (block,) = comparison_block(logs, ["one", "two", "three"])
    table = comparison_table(block)
    assert [row[0] for row in table.rows] == ["A: one", "B: two", "C: three"]
    off = [(m, "–", m, m) for m in ("5.0 m", "10.0 m", "5.0 m")]
    assert [row[4:8] for row in table.rows] == off
    for figure in block.figures:
        assert {line.name[:2] for line in figure.lines} == {"A ", "B ", "C "}


# -- verdict ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("kind", "level", "number", "reason"),
    [
        ({}, "good", "5.0 m", "GNSS was lost for up to 2 min, and the guaranteed bound held in every phase"),
        ({"bound": (3.0, 3.0)}, "fault", "1.18 ×", "The guaranteed bound did not hold"),
        ({"protection": 4.0}, "fault", "1.25 ×", "exceeded the protection level"),
        ({"protection": 4.99}, "fault", "1.00200 ×", "exceeded the protection level"),
        ({"protection": 5.1}, "good", "5.0 m", "held in every phase"),
        (
            {"error": (30.0, 40.0), "ins": (3.0, 4.0), "bound": None},
            "fault",
            "50.0 m",
            "worse than the inertial",
        ),
        ({"bound": (3.0, 3.0), "truth": False, "receiver": 1}, "caution", "15.17 ×", "did not hold"),
        ({"bound": None}, "caution", "2 min", "no useful guaranteed bound and no protection level"),
        ({"bound": (6e3, 6e3)}, "caution", "2 min", "Without fixes nothing limited"),
        ({"bound": (6e3, 6e3), "protection": 9.0}, "good", "5.0 m", "no phase has a useful guaranteed bound"),
        ({"bound": None, "protection": 9.0}, "good", "5.0 m", "no phase has a useful guaranteed bound"),
        ({"sigma": 1.0}, "caution", "0 %", "sigmas are too small"),
    ],
)
def test_verdict_names_the_number_that_decides(kind, level, number, reason):
    verdict = judge_flight(assess_flight(flight(**kind)))
    assert (verdict.level, verdict.number) == (level, number)
    assert reason in verdict.reason


def test_an_estimate_of_seconds_is_not_judged():
    verdict = judge_flight(collected([r for r in flight_records() if r.t_ns < START + 5 * S]))
    assert (verdict.level, verdict.what) == ("caution", "with an estimate")
    assert "less than 10 s show nothing" in verdict.reason
    longer = judge_flight(collected([r for r in flight_records() if r.t_ns < START + 15 * S]))
    assert longer.level == "good"


def test_phases_without_a_useful_bound_are_counted():
    a = assess_flight(flight(protection=9.0))
    rows = [a.rows[0], a.rows[1]._replace(held=None, share=None, inside=None), a.rows[2]]
    verdict = judge_flight(dataclasses.replace(a, rows=rows))
    assert verdict.level == "good"
    assert "held in 2 of 3 phases; it was of no use in the others" in verdict.reason
    text = sentences(dataclasses.replace(a, rows=rows))
    assert f"No useful guaranteed bound in 1 phase “{phase_title(rows[1].phase)}”." in text
    text = sentences(dataclasses.replace(a, rows=[rows[1]] * 2, phases=[a.phases[1]] * 2))
    assert f"No useful guaranteed bound in 2 phases, the first “{phase_title(rows[1].phase)}”." in text


def test_moments_above_the_bound_are_no_fault():
    a = assess_flight(flight())
    rows = [row._replace(held=False, share=0.45, inside=0.912) for row in a.rows]
    verdict = judge_flight(dataclasses.replace(a, rows=rows))
    assert (verdict.level, verdict.number) == ("caution", "91.2 %")
    assert "At moments the error was above the guaranteed bound" in verdict.reason


@pytest.mark.parametrize(
    ("logged", "shown"),
    [
        (
            "navigation fixed: gnss and azimuth and range fixes",
            "position from GNSS and beacon azimuth and range",
        ),
        ("navigation fixed: azimuth and range fixes", "position from beacon azimuth and range"),
        ("navigation predicting: no fixes", "position predicted: no fixes"),
        ("rsbn 7 range is used again", "beacon 7 range is used again"),
        ("udpin:0.0.0.0:14550: autopilot 1 rebooted", "autopilot 1 rebooted"),
        ("EKF3 IMU0 is using GPS", "EKF3 IMU0 is using GPS"),
    ],
)
def test_events_are_in_words_for_users(logged, shown):
    assert event_title(logged) == shown


def test_rejections_have_units_and_a_single_one_is_not_in_the_lead():
    records = [*flight_records(), Rejection(START, START, "gnss 0", "late: not used", 260.6, 6.0)]
    records = [r for r in records if not isinstance(r, Rejection) or r.limit == 6.0]
    a = collected(records)
    assert describe_rejections(a.groups[0]).startswith(
        "GNSS 0 rejected once: too late, 260.6 s old (limit 6 s)"
    )
    assert "rejected" not in sentences(a)


@pytest.mark.parametrize(
    ("source", "reason", "numbers", "shown"),
    [
        (
            "height of gnss 0",
            "outlier: innovation, m",
            (31.24,),
            "height of GNSS 0 rejected once: outlier, 31.2 m off",
        ),
        (
            "airspeed",
            "it steps: not used",
            (20.0, 10.5),
            "airspeed rejected once: it steps, by 20.0 m/s (limit 10.5 m/s)",
        ),
        (
            "pressure",
            "its altitude steps: not used",
            (900.0, 200.0),
            "pressure rejected once: its altitude steps, by 900.0 m (limit 200.0 m)",
        ),
    ],
)
def test_what_is_rejected_is_in_words_with_its_unit(source, reason, numbers, shown):
    rejected = Rejection(START, START, source, reason, *numbers)
    kept = [r for r in flight_records() if not isinstance(r, Rejection)]
    (group,) = collected([*kept, rejected]).groups
    assert describe_rejections(group) == shown


def with_velocity_rejected(number, every_s=0.5, **kind):
    """The five minutes without a rejected fix; from 1:00 on velocities of GNSS are, and other messages."""
    rows = [r for r in flight_records(**kind) if not isinstance(r, Rejection)]
    for k in range(number):
        t = START + 60 * S + round(k * every_s * S)
        rows.append(Rejection(t, t, "velocity of gnss 0", "excluded: false with probability", 0.9999, 0.999))
    rows += [Rejection(START + 90 * S, START + 90 * S, "GLOBAL_POSITION_INT", "no position yet")] * 3
    return rows


def test_rejected_velocities_are_not_rejected_fixes():
    text = sentences(collected(with_velocity_rejected(73)))
    assert (
        "No position fix was rejected. The velocity of GNSS 0 was rejected 73 times, from 1:00 to 1:36. "
        "Of other measurements, GLOBAL_POSITION_INT was rejected most, 3 times: no position yet." in text
    )
    assert "No position fix was rejected. Of other" in sentences(collected(with_velocity_rejected(1)))
    assert "No fix was rejected. Of other" in sentences(collected(with_velocity_rejected(0)))
    fixes = [r for r in flight_records() if isinstance(r, Rejection)]
    both = sentences(collected([*with_velocity_rejected(73), *fixes]))
    assert "10 fixes were rejected, from 1:00 to 1:02" in both and "GNSS 0 was rejected 73 times" in both


def against(reference, a):
    """The same flight, as if its reference were another one."""
    return dataclasses.replace(a, reference=a.reference._replace(what=reference))


def test_velocities_rejected_for_long_are_no_good_flight_without_a_truth():
    a = collected(with_velocity_rejected(73))
    verdict = judge_flight(against(assessing.SMOOTHED, a))
    assert (verdict.level, verdict.number, verdict.what) == ("caution", "36 s", "of velocities rejected")
    assert verdict.reason.startswith("The velocity of GNSS 0 was rejected from 1:00;")
    known = judge_flight(a)
    assert known.level == "good" and "the velocity of GNSS 0 was rejected for 36 s" in known.reason
    assert judge_flight(against(assessing.SMOOTHED, collected(with_velocity_rejected(9)))).level == "good"


def test_each_estimate_is_judged_by_its_own_protection_level():
    """At the time of a fix there are two: predicted up to the fix, and with it."""
    rows = []
    for row in flight_records(protection=4.0):
        if isinstance(row, Solution):
            rows.append(msgspec.structs.replace(row, protection=400.0))
        rows.append(row)
    verdict = judge_flight(collected(rows))
    assert (verdict.level, verdict.number) == ("fault", "1.25 ×")
    assert verdict.reason.endswith(": 5.0 m against 4.0 m.")


def test_a_distance_beyond_the_protection_level_is_a_caution():
    """Of the smoothed track, unless GNSS contradicts that; GNSS itself may have been rejected rightly."""
    a = assess_flight(flight(protection=4.0))
    verdict = judge_flight(against(assessing.SMOOTHED, a))
    assert (verdict.level, verdict.number) == ("caution", "1.25 ×")
    assert verdict.reason.startswith("The distance from the smoothed track exceeded the protection level at ")
    assert verdict.reason.endswith(": 5.0 m against 4.0 m.")
    assert judge_flight(against(assessing.GNSS, a)).level == "good"
    far = a.errors["GNSS fix"]._replace(error=a.errors["GNSS fix"].error + 50.0)
    torn = dataclasses.replace(against(assessing.SMOOTHED, a), errors={**a.errors, "GNSS fix": far})
    assert "contradict each other" in judge_flight(torn).reason


def with_gnss_off(a, seconds, off=360.0, claimed=math.nan):
    """The same flight against the smoothed track; for some seconds from the start GNSS is far off it."""
    gnss = a.errors["GNSS fix"]
    far = np.where(gnss.t_ns < seconds * S, off, 1.0)
    gnss = gnss._replace(error=far, claimed=np.full(len(far), claimed))
    return dataclasses.replace(against(assessing.SMOOTHED, a), errors={**a.errors, "GNSS fix": gnss})


def test_a_smoothed_track_far_off_its_fixes_for_seconds_is_no_good_flight(assessed):
    """The median over the flight had no sight of the first 18 s, and the verdict was good."""
    torn = with_gnss_off(assessed, 18.0)
    verdict = judge_flight(torn)
    assert (verdict.level, verdict.number) == ("caution", "360 m")
    assert verdict.reason == (
        "From 0:00 to 0:18 GNSS and the smoothed track contradict each other: one of them is wrong."
    )
    assert "From 0:00 to 0:18 GNSS and the smoothed track differ by 360 m (median)" in sentences(torn)
    for near in (
        with_gnss_off(assessed, 9.0),  # not for long
        with_gnss_off(assessed, 18.0, off=29.0),
        with_gnss_off(assessed, 18.0, claimed=130.0),  # the receiver itself states that much
    ):
        assert judge_flight(near).level == "good"
        assert "differ by" not in sentences(near)


def test_the_stated_accuracy_of_fixes_is_that_of_their_errors(assessed):
    assert assessed.errors["GNSS fix"].claimed == pytest.approx(2.0 * math.sqrt(2.0))
    assert np.isnan(assessed.errors["GNSS fix"].bound).all()


def test_warnings_of_the_events_table_have_their_severity_and_colour():
    pytest.importorskip("jinja2")
    warning = Event(START + S, START + S, 4, "low battery")
    (found,) = collect_flights(
        ((flight_log.topic_of(type(r)), r) for r in [*flight_records(), warning]), "made.mcap"
    )
    page = render_report("r", blocks_of_log([found]))
    assert re.search(r'class="caution">warning</td><td data-label="text">low battery', page)


def test_a_share_below_100_percent_is_not_written_as_100_percent(assessed):
    value = np.where(np.arange(4000) == 7, 99.0, 1.0)
    nees = assessing.NormalizedErrors("NEES", np.arange(4000.0), value, np.full(4000, 2.0))
    shown = dataclasses.replace(assessed, normalized_errors=[nees])
    page = render_report("r", [ReportBlock(["a"], [shown], [])])
    assert "99.9 %" in page and "100.0 %" not in page


def test_every_kind_of_record_has_a_name_for_users():
    for kind in (*INPUTS, *OUTPUTS, Truth):
        assert topic_name(flight_log.topic_of(kind)) != kind.__name__, kind
    for kind in (Event, Rejection):
        assert topic_name(f"/link/{kind.__name__}") != topic_name(flight_log.topic_of(kind))


def test_a_flight_of_no_consequence_is_judged_by_its_reset():
    verdict = judge_flight(assess_flight(flight(reset=True)))
    assert (verdict.level, verdict.number) == ("caution", "1") and "first at 0:10" in verdict.reason


@pytest.mark.parametrize(
    ("kinds", "wanted"),
    [
        ((), "No input was logged. A fix is missing"),
        ((Gnss,), "needs ATTITUDE with airspeed"),
        ((Gnss, Imu), "its own, LOCAL_POSITION_NED with GPS_GLOBAL_ORIGIN"),
        ((Gnss, Attitude), "needs airspeed (VFR_HUD) or an IMU (RAW_IMU, HIGHRES_IMU)"),
        ((Gnss, LocalPosition), "with an INS of its own, the message GPS_GLOBAL_ORIGIN"),
        ((Attitude, AirData), "A fix is missing, for no position was received"),
        ((Gnss, Attitude, AirData), "A channel is there, but no fix was accepted"),
    ],
)
def test_a_flight_without_an_estimate_names_what_is_missing(kinds, wanted):
    made = {
        Gnss: Gnss(START, START, 0, 1, 3, LAT, LON, 100.0),
        Attitude: Attitude(START, START, 0.0, 0.0, 0.0),
        LocalPosition: LocalPosition(START, START, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)),
        Imu: Imu(START, START, 0, (0.0, 0.0, -9.8), (0.0, 0.0, 0.0)),
        AirData: AirData(START, START, 20.0),
    }
    records = [Event(START, START, 6, "x"), *(made[kind] for kind in kinds)]
    (empty,) = collect_flights(((flight_log.topic_of(type(r)), r) for r in records), "made.mcap")
    verdict = judge_flight(assess_flight(empty))
    assert (verdict.level, verdict.number) == ("fault", "0")
    assert wanted in verdict.reason
    assert not re.search("compare|bound|error", sentences(assess_flight(empty)))


@pytest.mark.parametrize(
    ("first", "seconds", "greatest", "before"),
    [
        (0, 10, "5.0 m", ", 299 m before GNSS)"),
        (40, 50, "5.0 m", ", 299 m before GNSS)"),
        (0, 60, "299 m", ")"),
    ],
)
def test_the_greatest_error_is_not_that_of_a_single_beacon_before_gnss(first, seconds, greatest, before):
    """A beacon alone for seconds before GNSS is a start; for a minute it is a part of the flight."""
    rows = [r for r in flight_records() if not isinstance(r, Solution) or r.t_ns >= START + first * S]
    for k, row in enumerate(rows):
        if isinstance(row, Solution) and row.t_ns < START + seconds * S:
            far = displace(row.lat, row.lon, 0.0, 0.0, 295.0, 0.0)
            beacons = Source.AZIMUTH | Source.RANGE
            rows[k] = msgspec.structs.replace(row, lat=far.lat, lon=far.lon, sources=beacons)
    a = collected(rows)
    assert [phase.name for phase in a.phases] == ["RSBN", "GNSS", "prediction", "GNSS"]
    assert format_length(worst_of(a).estimate) == greatest
    (found,) = [text for text in summarize_flight(a) if "(r.m.s.)" in text]
    assert ("by beacons alone" in found) == (before == ")")
    assert re.search(rf"{greatest} at most \(\d+:\d\d{re.escape(before)}", found)
    assert max(rms_by_source(a).values()) <= worst_of(a).estimate
    assert rms_after_start(a, error_statistics.CORRECTED) <= worst_of(a).estimate


def test_no_number_of_the_text_is_greater_than_the_cards(assessed):
    """A rejected fix is 500 m off: the card of the farthest GNSS fix has it."""
    lengths = [
        float(value) * (1000.0 if unit == "km" else 1.0)
        for value, unit in re.findall(r"(\d+(?:\.\d+)?) (m|km)\b", sentences(assessed).replace("min", ""))
    ]
    worst = worst_of(assessed)
    assert max(lengths) == pytest.approx(500.0, abs=5.0)
    assert max(lengths) <= max(worst) + 0.5
    assert format_length(worst.estimate) == "5.0 m"


def test_there_is_no_error_without_a_truth():
    a = assess_flight(flight(truth=False, receiver=1))
    figure = {figure.key: figure for figure in build_figures([a])}["error"]
    assert figure.title == "Distance from GNSS itself"
    assert "The error of the estimate" not in sentences(a)
    assert "The distance of the estimate from GNSS itself was" in sentences(a)


def visible_text(page):
    """What a reader sees: no script, style or configuration; of the figures the names of their lines."""
    (data,) = re.findall(r'id="figures">(.*?)</script>', page, re.DOTALL)
    names = [line["name"] for figure in json.loads(data).values() for line in figure["lines"]]
    page = re.sub(r"<(script|style|pre)\b.*?</\1>", "", page, flags=re.DOTALL)
    return html.unescape(re.sub(r"<[^>]+>", " ", page)) + " ".join(names)


@pytest.mark.parametrize(
    "kind", [{}, {"bound": (3.0, 3.0)}, {"sigma": 1.0}, {"bound": None, "protection": 4.0}], ids=str
)
def test_the_whole_page_has_no_error_without_a_truth(kind):
    pytest.importorskip("jinja2")
    words = re.compile(r"(?i)[^.]*\b(?:errors?|tru\w+|actual\w*|NEES)\b[^.]*")
    shown = visible_text(render_report("r", blocks_of_log([flight(truth=False, receiver=1, **kind)])))
    assert "Distances" in shown and "Distance from GNSS itself" in shown
    assert words.findall(shown) == []
    against_truth = visible_text(render_report("r", blocks_of_log([flight(**kind)])))
    assert "Error of the position" in against_truth and "NEES: error of the estimate" in against_truth


def test_durations_and_times_are_formatted():
    assert [format_duration(s) for s in (3.24, 42.0, 60.0, 187.0, 3600.0, 3725.0)] == [
        *("3.2 s", "42 s", "1 min", "3 min 7 s", "1 h", "1 h 2 min 5 s"),
    ]
    assert [format_time(s) for s in (0.0, 187.4, -26.0, 7200.0)] == ["0:00", "3:07", "-0:26", "120:00"]


@settings(max_examples=60)
@given(st.integers(1, 5000), st.integers(20, 400), st.integers(0, 2**32 - 1))
def test_thinning_keeps_extremes_and_ends(n, most, seed):
    rng = np.random.default_rng(seed)
    x, y = np.arange(float(n)), rng.normal(size=n)
    y[rng.random(n) < 0.1] = np.nan
    kept_x, kept_y = thin_line(x, y, most)
    assert len(kept_x) <= max(n if n <= most else 0, 1.5 * most + 4)
    assert (np.diff(kept_x) > 0.0).all()
    assert (kept_x[0], kept_x[-1]) == (x[0], x[-1])
    if np.isfinite(y[: n - n % max(1, math.ceil(2 * n / most))]).any() and n > most:
        whole = y[: n // math.ceil(2 * n / most) * math.ceil(2 * n / most)]
        assert np.nanmax(kept_y) >= np.nanmax(whole)
        assert np.nanmin(kept_y) <= np.nanmin(whole)


# -- page ------------------------------------------------------------------------------------------------


def test_page_is_self_contained(page):
    text = page.read_text("utf-8")
    own = text[: text.index("<script>")] + text[text.index('<script type="application/json"') :]
    assert not re.findall(r"(?:src|href)\s*=\s*['\"]?\s*(?:https?:)?//", own)
    assert "@import" not in own
    data = json.loads(re.search(r'id="figures">(.*?)</script>', own, re.S)[1])
    assert set(data) == set(re.findall(r'id="plot-(\w+)"', own))
    assert {"map", "error", "bound", "consistency", "inertial_north", "ahead", "sources", "rates"} <= set(
        data
    )
    assert {"latency", "timesync"} <= set(data)
    assert page.stat().st_size < 0.8e6  # an hour is at most 1.5e6: `companion study after-flight`


def test_text_of_a_log_is_escaped(page):
    text = page.read_text("utf-8")
    assert "a <script> & b" not in text and html.escape("a <script> & b.mcap") in text
    assert "<!--" not in text and NASTY not in text
    assert html.escape(NASTY) in text  # the table of events
    (data,) = re.findall(r'<script type="application/json" id="figures">(.*?)</script>', text, re.S)
    assert not set("<>&") & set(data)
    assert any(NASTY in mark[1] for mark in json.loads(data)["error"]["marks"])


@pytest.mark.parametrize(("width", "dark"), [(1280, False), (390, True)])
def test_browser_draws_every_plot_without_console_output(page, width, dark, browser):
    plots = len(re.findall(r'id="plot-\w+"', page.read_text("utf-8")))
    browser.open(page.as_uri(), width, dark)
    browser.wait_for("document.documentElement?.dataset.drawn")
    status = browser.evaluate("Object.assign({}, document.documentElement.dataset)")
    assert status == {"drawn": str(plots), "failed": "0", "overflow": "0"}
    paper = browser.evaluate("getComputedStyle(document.body).backgroundColor")
    assert (sum(map(int, re.findall(r"\d+", paper))) < 200) is dark
    # one time axis: what is shown in one plot is shown in all
    browser.evaluate("Group.last.zoom([60, 90]), 1")
    seconds = "Group.last.charts.map(({plot: {scales: {x}}}) => Math.round(x.max - x.min))"
    browser.wait_for(f"{seconds}.every((s) => s === 30)")
    assert len(browser.evaluate(seconds)) == plots - 1
    assert browser.console == []
    assert [url for url in browser.requests if not url.startswith(("file:", "data:"))] == []


@pytest.mark.parametrize(
    ("x", "y"),
    [
        ([1.0, 11.4201, 11.4203, 90.0], [math.nan, math.nan, 2.0, 2.0]),
        ([1.0, 11.4201, 11.4203, 90.0], [2.0, 2.0, math.nan, math.nan]),
        ([11.4148, 11.4151, 11.4152, 11.4153], [1.0, math.nan, 1.0, 1.0]),
    ],
)
def test_a_bar_begins_and_ends_beside_a_gap_that_is_a_moment_away(x, y):
    """The times of the page are rounded. A gap at the time of a point hid the line up to the next one."""
    line = Line("beacons", np.array(x), np.array(y), ("#000000", "#ffffff"))
    (drawn,) = to_page(Figure("sources", "Sources", "", [line]))["lines"]
    assert drawn["y"] == [None if math.isnan(v) else v for v in y]
    filled = {t for t, v in zip(drawn["x"], drawn["y"], strict=True) if v is not None}
    assert not filled & {t for t, v in zip(drawn["x"], drawn["y"], strict=True) if v is None}
    assert drawn["x"] == sorted(drawn["x"]) and drawn["x"] == pytest.approx(x, abs=0.01)


@pytest.mark.parametrize("width", [1280, 390])
def test_names_of_rows_are_not_cut(page, width, browser):
    browser.open(page.as_uri(), width)
    browser.wait_for("document.documentElement?.dataset.drawn")
    room, wanted = browser.evaluate("""(() => {
        const chart = Group.last.charts.find((c) => c.figure.rows.length);
        chart.figure.rows[0] = "rejected: GLOBAL_POSITION_INT";
        chart.plot.destroy();
        chart.build();
        const axis = chart.plot.axes[1], ctx = document.createElement("canvas").getContext("2d");
        ctx.font = axis.font[0];
        return [axis._size * devicePixelRatio, ctx.measureText(chart.figure.rows[0]).width];
    })()""")
    assert wanted > 100.0
    assert room >= wanted


@pytest.mark.parametrize("lat_deg", [0.0, -35.0, 60.0])
def test_the_map_reads_the_coordinates_of_its_points(page, lat_deg, browser):
    """With 111320 m in every degree a point 50 km off was read up to 340 m off."""
    R_N, R_E = radii(math.radians(lat_deg))
    lat = lat_deg + math.degrees(50_000.0 / R_N)
    lon = 149.0 + math.degrees(30_000.0 / (R_E * math.cos(math.radians(lat_deg))))
    browser.open(page.as_uri())
    browser.wait_for("document.documentElement?.dataset.drawn")
    text = browser.evaluate(f"""(() => {{
        const map = Group.last.maps[0];
        map.figure.origin = [{lat_deg}, 149.0];
        map.figure.lines = [{{ name: "point", x: [30000], y: [50000], t: [0], colour: ["#000", "#fff"] }}];
        map.read(...map.pixel(30000, 50000));
        return map.hover.querySelector("i").textContent;
    }})()""")
    assert [float(part) for part in text.replace("°", "").split(",")] == pytest.approx([lat, lon], abs=2e-5)


@pytest.mark.parametrize("width", [1280, 390])
def test_a_beacon_beyond_the_map_is_clear_of_the_buttons(page, width, browser):
    """Its arrow and its name were behind them."""
    browser.open(page.as_uri(), width)
    browser.wait_for("document.documentElement?.dataset.drawn")
    reached, buttons = browser.evaluate("""(() => {
        const map = Group.last.maps[0], reached = [], buttons = map.box.querySelector(".buttons").offsetLeft;
        const real = map.canvas.getContext("2d"), note = (x) => reached.push(x);
        const ctx = { beginPath() {}, fill() {}, moveTo: note, lineTo: note };
        ctx.measureText = (text) => real.measureText(text);
        map.text = (c, text, x) => note(x + real.measureText(text).width);
        for (const py of [-500, 0, 150, 250, 400, 5000]) map.place(ctx, "beacon 12", ...map.world(9000, py));
        return [Math.max(...reached), buttons];
    })()""")
    assert 250.0 < reached <= buttons


def test_print_has_every_row_of_long_tables(page, browser):
    browser.open(page.as_uri())
    browser.wait_for("document.documentElement?.dataset.drawn")
    browser.call("Emulation.setEmulatedMedia", media="print")
    hidden = "[...document.querySelectorAll('.long')].map(e => e.scrollHeight - e.clientHeight)"
    assert browser.evaluate(hidden) == [0]


def test_figures_are_written_to_pdf_and_png(log, tmp_path):
    pytest.importorskip("matplotlib")
    pytest.importorskip("jinja2")
    out, pdf, png = tmp_path / "r.html", tmp_path / "r.pdf", tmp_path / "png"
    arguments = [str(log), str(log), "-o", str(out), "--pdf", str(pdf), "--png", str(png)]
    found = CliRunner().invoke(command, arguments, catch_exceptions=False)
    assert found.exit_code == 0
    assert pdf.read_bytes().startswith(b"%PDF")
    assert {path.stem for path in png.iterdir()} >= {"map", "error", "bound"}
    assert all(path.read_bytes().startswith(b"\x89PNG") for path in png.iterdir())


# -- bad input -------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("none.mcap", None),
        ("empty.mcap", b""),
        ("foreign.mcap", b"what is this" * 20),
        ("none.tlog", None),
        ("empty.tlog", b""),
        ("picture.png", b"\x89PNG"),
    ],
)
def test_invalid_input_is_reported_in_one_sentence(name, content, tmp_path):
    path = tmp_path / name
    if content is not None:
        path.write_bytes(content)
    found = CliRunner().invoke(command, [str(path), "-o", str(tmp_path / "r.html")])
    assert isinstance(found.exception, LogError)
    assert str(path) in str(found.exception) or name in str(found.exception)
    assert "\n" not in str(found.exception)
    assert not (tmp_path / "r.html").exists()


@pytest.mark.parametrize("option", ["-o", "--pdf"])
def test_logs_are_not_overwritten(option, log, tmp_path):
    other, link, before = tmp_path / "other.tlog", tmp_path / "page.html", log.read_bytes()
    other.write_bytes(b"another flight")
    link.symlink_to(log)
    for output in (log, link, other):
        found = CliRunner().invoke(command, [str(log), option, str(output)])
        assert isinstance(found.exception, LogError) and "give another name" in str(found.exception)
    assert log.read_bytes() == before and other.read_bytes() == b"another flight"


def test_older_page_is_overwritten(log, tmp_path):
    pytest.importorskip("jinja2")
    page = tmp_path / "r.html"
    page.write_text("an older one")
    CliRunner().invoke(command, [str(log), "-o", str(page)], catch_exceptions=False)
    assert "an older one" not in page.read_text("utf-8")


def test_configuration_options_are_rejected_for_flown_logs(log, tmp_path):
    mine = tmp_path / "mine.toml"
    mine.write_text("[gnss]\nsigma_m = 7.5\n")
    for option in (["--with", "gnss.sigma_m=50"], ["--config", str(mine)]):
        found = CliRunner().invoke(command, [str(log), "-o", str(tmp_path / "r.html"), *option])
        assert isinstance(found.exception, LogError)
        assert f"replay it first: companion replay {log} --with" in str(found.exception)
        assert not (tmp_path / "r.html").exists()


def test_each_verdict_in_the_terminal_names_its_flight(log, tmp_path):
    pytest.importorskip("jinja2")
    other = tmp_path / "other.mcap"
    shutil.copy(log, other)
    found = CliRunner().invoke(command, [str(log), str(other), "-o", str(tmp_path / "r.html")])
    verdicts = [line for line in found.output.splitlines() if "Good: " in line]
    assert [line.partition(": Good: ")[0] for line in verdicts] == [f"A: {log.name}", "B: other.mcap"]


def test_report_accepts_as_many_logs_as_there_are_letters(log):
    assert CliRunner().invoke(command, [str(log)] * 27).exit_code == 2


@pytest.mark.parametrize(("options", "package"), [((), "jinja2"), (("--pdf", "x.pdf"), "matplotlib")])
def test_missing_package_is_reported_before_the_work(options, package, log, tmp_path, monkeypatch):
    monkeypatch.setattr("companion.analysis.report.open_flights", lambda *_: pytest.fail("work was done"))
    monkeypatch.setattr(optional_dependencies, "find_spec", lambda name: None if name == package else True)
    with pytest.raises(LogError, match=f"a report needs {package}: run `pip install"):
        CliRunner().invoke(
            command, [str(log), "-o", str(tmp_path / "r.html"), *options], catch_exceptions=False
        )


@pytest.mark.parametrize(
    ("option", "name", "words"),
    [
        ("-o", "no/r.html", "cannot be written: no folder"),
        ("-o", "", "is a folder: give the name of a file"),
        ("-o", "closed/r.html", "closed is not writable"),
        ("-o", "r.pdf", "r.pdf: a report is written as .html: give a name that ends with it"),
        ("--pdf", "no/r.pdf", "cannot be written: no folder"),
        ("--pdf", "f.html", "f.html: the PDF of the figures is written as .pdf: give a name"),
        ("--png", "file", "it is a file; give a folder"),
    ],
)
def test_unwritable_output_is_reported_before_the_work(option, name, words, log, tmp_path, monkeypatch):
    monkeypatch.setattr("companion.analysis.report.open_flights", lambda *_: pytest.fail("work was done"))
    (tmp_path / "file").write_text("")
    closed = tmp_path / "closed"
    closed.mkdir()
    monkeypatch.setattr(os, "access", lambda path, mode: Path(path) != closed)
    arguments = [str(log), "-o", str(tmp_path / "r.html"), option, str(tmp_path / name)]
    with pytest.raises(LogError, match=re.escape(words)) as found:
        CliRunner().invoke(command, arguments, catch_exceptions=False)
    assert str(tmp_path / name) in str(found.value)


@pytest.mark.parametrize("option", ["-o", "--pdf"])
def test_failed_report_keeps_the_older_one(option, log, tmp_path, monkeypatch):
    pytest.importorskip("jinja2")
    pytest.importorskip("matplotlib")
    older = tmp_path / "older"
    older.write_text("an older one")
    replace = os.replace

    def full(source, target):
        if Path(target) == older:
            raise OSError(errno.ENOSPC, "No space left on device")
        replace(source, target)

    monkeypatch.setattr("companion.write_errors.os.replace", full)
    monkeypatch.setattr("companion.analysis.report._all_figures", lambda blocks: blocks[0].figures[:1])
    found = CliRunner().invoke(command, [str(log), "-o", str(tmp_path / "r.html"), option, str(older)])
    assert isinstance(found.exception, LogError)
    assert str(found.exception) == f"cannot write the report to {older}: No space left on device"
    assert older.read_text() == "an older one"
    assert not list(tmp_path.glob("*.part"))


def test_same_output_twice_is_rejected(log, tmp_path):
    found = CliRunner().invoke(command, [str(log), "-o", str(tmp_path / "x"), "--pdf", str(tmp_path / "x")])
    assert isinstance(found.exception, LogError) and "would be written twice" in str(found.exception)


def test_report_is_written_to_a_device(log):
    pytest.importorskip("jinja2")
    assert CliRunner().invoke(command, [str(log), "-o", os.devnull]).exit_code == 0
    assert not Path(os.devnull).is_file()


def test_report_is_written_to_a_pipe():
    """`-o /dev/stdout | gzip`: the link of a pipe resolves to a name that no file has."""
    reader, writer = os.pipe()
    with os.fdopen(reader, "rb") as pipe:
        write_whole(Path(f"/dev/fd/{writer}"), b"page")
        os.close(writer)
        assert pipe.read() == b"page"


def test_log_that_is_not_closed_has_no_unreadable_bytes(log, tmp_path):
    assert "not closed" not in " ".join(open_flights(log, Config())[0].remarks)
    active = tmp_path / "x.mcap.active"
    with flight_log.Writer(tmp_path / "x.mcap", metadata={}, start_unix_ns=0, start_ns=0, block=True) as sink:
        for entry in flight_log.read(log):
            if isinstance(entry.value, (*INPUTS, *OUTPUTS)):
                sink.record(entry.value)
        sink.close(finish=False)
    assert open_flights(active, Config())[0].remarks[0] == "The log was not closed."
    shown = CliRunner().invoke(log_group, ["info", str(active)]).output
    assert "torn, or still written (run companion log recover)" in shown


def test_closed_log_is_not_searched_for_bytes_lost(log, monkeypatch):
    """It has none, and the search reads all of it."""
    monkeypatch.setattr(flight_log, "info", lambda path: pytest.fail("searched"))
    assert "configuration" in open_flights(log, Config())[0].metadata


def test_long_names_of_lines_leave_room_for_the_plot(tmp_path):
    """Two logs, each link by its address: matplotlib warned, and the legend was wider than the picture."""
    pytest.importorskip("matplotlib")
    t = np.arange(5.0)
    names = [f"{log} udpin:127.0.0.1:14550: clock difference since the start" for log in "ABCD"]
    lines = [Line(name, t, t, ("#000000", "#ffffff")) for name in names]
    (path,) = write_figures([Figure("timesync", "Clock", "ms", lines)], None, tmp_path)
    assert path.stat().st_size


def test_bars_of_a_picture_end_at_their_last_points(tmp_path):
    """The usual cap added 5 s to each end of a bar in a picture of six minutes."""
    image = pytest.importorskip("matplotlib.image")
    bar = Line("", np.array([10.0, 40.0]), np.array([2.0, 2.0]), ("#ff0000", "#ff0000"), width=40.0)
    thin = Line("", np.array([0.0, 50.0]), np.array([1.0, 1.0]), ("#0000ff", "#0000ff"))
    (path,) = write_figures([Figure("bars", "Bars", "", [bar, thin])], None, tmp_path)
    red, _, blue = np.moveaxis(image.imread(path)[:, :, :3], -1, 0)
    wide, long = (np.ptp(np.flatnonzero(k.any(axis=0))) for k in (red - blue > 0.5, blue - red > 0.5))
    assert wide / long == pytest.approx(30.0 / 50.0, abs=0.01)


def test_file_in_place_of_the_folder_of_figures_is_reported(log, tmp_path):
    pytest.importorskip("jinja2")
    pytest.importorskip("matplotlib")
    (tmp_path / "file").touch()
    found = CliRunner().invoke(
        command, [str(log), "-o", str(tmp_path / "r.html"), "--png", str(tmp_path / "file")]
    )
    assert isinstance(found.exception, LogError)
    assert str(found.exception).endswith("file: it is a file; give a folder")


def test_converted_log_is_reported_as_the_original(tmp_path):
    folder, log = Path(__file__).parents[1] / "data" / "umn_fixed_wing_cut", tmp_path / "umn.mcap"
    config = load(flags={"inertial.source": "local_position"}, environment={})
    convert_log(folder, log, config)
    (direct,), (converted,) = open_flights(folder, config), open_flights(log, config)
    for name, table in direct.tables.items():
        for column in table:
            np.testing.assert_array_equal(converted.tables[name][column], table[column])
    assert len(converted.tables["Solution"]["t"]) > 10
    (delay,) = converted.latencies
    assert delay.seconds == pytest.approx(0.2, abs=0.05)
    assert "behind the local position" in sentences(assess_flight(converted))


@pytest.mark.parametrize(
    ("sensors", "keys", "words"),
    [
        ("attitude imu", {}, "is the companion's own, by the autopilot's attitude and IMU."),
        (
            "attitude imu air_data local_position",
            {},
            "by the autopilot's attitude, IMU and airspeed.",
        ),
        ("attitude imu air_data", {"inertial.source": "imu"}, "by the autopilot's attitude and IMU."),
        (
            "local_position",
            {},
            "Give --with inertial.source=local_position to go by the autopilot's velocity.",
        ),
        (
            "attitude imu local_position",
            {"inertial.source": "local_position"},
            "is the velocity of the autopilot's local position, which may depend on that GNSS.",
        ),
        ("imu air_data", {}, "has nothing for an inertial channel."),
        ("attitude", {}, "no sensor of airspeed: a fixed wing is taken to keep its airspeed, anything else"),
        ("attitude", {"inertial.source": "imu"}, "has nothing for an inertial channel."),
        ("attitude imu", {"inertial.independent": True}, "has nothing for an inertial channel."),
        ("local_position", {"inertial.independent": True}, "is the local position of an INS of its own."),
    ],
)
def test_channel_is_described_by_what_the_log_has(sensors, keys, words):
    assert words in describe_channel(load(flags=keys, environment={}), set(sensors.split()))


def test_report_of_a_foreign_log_names_the_sensors_in_it(tmp_path):
    """Airspeed without a sensor is the autopilot's own number: it is not used, and not named."""
    records = [
        record
        for k in range(200)
        for record in (
            Attitude(START + k * S // 50, START + k * S // 50, 0.0, 0.0, 0.0),
            Imu(START + k * S // 50, START + k * S // 50, 0, (0.0, 0.0, -9.8), (0.0, 0.0, 0.0)),
            AirData(START + k * S // 50, START + k * S // 50, 15.0),
        )
    ]
    path, about = tmp_path / "converted.mcap", {"converted": {"from": "flight.bin"}}
    with flight_log.Writer(path, metadata=about, start_unix_ns=10**18, start_ns=START, block=True) as out:
        for record in records:
            out.record(record)
    (found,) = open_flights(path, Config())
    assert found.remarks[-1].endswith(
        "The inertial channel is the companion's own, by the autopilot's attitude and IMU."
    )


@pytest.mark.flight
@pytest.mark.shared
@pytest.mark.skipif(not DATA.exists(), reason="the recordings are not available")
def test_f450_glitch_is_an_event():
    (flight,) = open_flights(DATA / "inertialnav" / "f450_glitch_log.zip", Config())
    a = assess_flight(flight)
    (line,) = (line for line in a.timeline if line.kind == "glitch")
    assert 126.2 < line.t < 127.7
    assert line.text in sentences(a)
