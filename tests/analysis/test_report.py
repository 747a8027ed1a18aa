"""A report says what is in its log: errors put in come out, refusals in a row are one event, a broken bound
is told, the page stands alone and draws itself in a real browser (skipped where there is no chromium).
"""

import html
import json
import math
import re
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner
from hypothesis import given, settings
from hypothesis import strategies as st

from companion.analysis import assessment as assessing
from companion.analysis import error_statistics
from companion.analysis.assessment import assess
from companion.analysis.convert import convert
from companion.analysis.figures import figures
from companion.analysis.flight_arrays import gather
from companion.analysis.flight_events import refusal
from companion.analysis.flights import open_flights
from companion.analysis.plot_data import thinned
from companion.analysis.replay import command as replay_command
from companion.analysis.replay import metadata
from companion.analysis.report import command
from companion.analysis.summary import clock, comparison, lasting, verdict
from companion.config import Config
from companion.nav.geometry import displace
from companion.records import (
    Event,
    Fix,
    Gnss,
    LinkState,
    LocalPosition,
    Mode,
    Prediction,
    Reboot,
    Rejection,
    Reset,
    RsbnFix,
    Solution,
    Truth,
)
from companion.storage import flight_log
from companion.storage.reader import LogError

S = 1_000_000_000
START = 5_000 * S
LAT, LON = 0.97, 0.65
LOST, FOUND, END = 120, 240, 300  # s
CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser")
DATA = Path(__file__).parents[2].parent / "shared" / "data"
needs_chromium = pytest.mark.skipif(CHROMIUM is None, reason="no chromium to open the page in")


def flight_records(error=(3.0, 4.0), bound=(30.0, 40.0), ins=(60.0, 80.0), truth=True):
    """Five minutes eastwards at 20 m/s; GNSS lost from LOST to FOUND, refused for 2 s at 60 s."""
    rows = []
    for k in range(END * 5):
        t = START + k * S // 5
        second = k / 5
        lat, lon, _ = displace(LAT, LON, 0.0, 0.0, 20.0 * second, 0.0)
        lost = LOST <= second < FOUND
        if truth:
            rows.append(Truth(t, t, lat, lon, 100.0, (0.0, 20.0, 0.0)))
        glitch = 60.0 <= second < 62.0
        if not lost:
            off = 500.0 if glitch else 0.0
            place = displace(lat, lon, 0.0, off, 0.0, 0.0)
            rows.append(Gnss(t, t + 50_000_000, 0, k, 3, place.lat, place.lon, 100.0, 2.0))
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
                covariance=(25.0, 0.0, 0.0, 25.0, 0.0, 25.0),
                error_n=(ins[0] - error[0], ins[1] - error[1]),
                velocity_error_n=(0.0, 0.0),
                sources=1 if lost else 3,
                horizon_s=0.0,
                bound_n=bound,
                ahead=(Prediction(60.0, (10.0, 10.0), (5.0, 5.0), (8.0, 8.0)),),
            )
        )
        if k % 5 == 0 and not lost and not glitch:
            rows.append(Fix(t, t, lat, lon, 100.0, (59.0, 79.0), (4.0, 0.0, 4.0), 2, 0.0, 0, 1, 0.5))
        if k % 25 == 0:
            rows.append(LinkState(t, t, "serial", True, 10 * k, 1, 0, 0, 17 * S + k * 1000, 9_000_000))
            rows.append(RsbnFix(t, t + 1, 7, LAT, LON, 0.0, 1.0, 20.0 * second, 0.002, 100.0))
    rows.append(Event(START + LOST * S, START + LOST * S, 5, "navigation predicting: <b>no</b> fixes"))
    rows.append(Reset(START + 10 * S, START + 10 * S, "inertial channel", "it jumped by 12.0 m"))
    return rows


def flight(**kind):
    (found,) = gather(((flight_log.topic_of(type(r)), r) for r in flight_records(**kind)), "made.mcap")
    return found


@pytest.fixture(scope="module")
def assessed():
    return assess(flight())


@pytest.fixture(scope="module")
def log(tmp_path_factory):
    """A log in the file system whose name tries to end the page's script."""
    path = tmp_path_factory.mktemp("logs") / "a <script> & b.mcap"
    with flight_log.Writer(
        path, metadata=metadata(Config()), start_unix_ns=1_700_000_000 * S, start_ns=START, block=True
    ) as out:
        for record in flight_records():
            out.record(record)
    return path


@pytest.fixture(scope="module")
def page(log, tmp_path_factory):
    pytest.importorskip("plotly")
    path = tmp_path_factory.mktemp("page") / "report.html"
    found = CliRunner().invoke(command, [str(log), "-o", str(path)], catch_exceptions=False)
    assert found.exit_code == 0
    assert "GNSS was lost once" in found.output
    return path


# -- numbers ---------------------------------------------------------------------------------------------


def test_the_errors_put_in_come_out(assessed):
    assert assessed.reference.what == assessing.TRUTH
    assert np.allclose(assessed.errors[error_statistics.CORRECTED].error, 5.0, atol=1e-3)
    assert np.allclose(assessed.errors[error_statistics.INS].error, 100.0, atol=1e-2)
    glitch = assessed.errors[error_statistics.GNSS].error
    assert np.isclose(glitch.max(), 500.0, atol=1e-2)
    assert np.median(glitch) < 1e-3
    for row in assessed.rows:
        assert row.rms[error_statistics.CORRECTED] == pytest.approx(5.0, abs=1e-3)


def test_answers_of_beacons_are_scored_whatever_else_is_heard_as_the_loopback_scores_them(assessed):
    """The flight has GNSS but for two minutes; every answer of its beacon counts."""

    def truth(t_ns):
        return displace(LAT, LON, 100.0, 0.0, 20.0 * (t_ns - START) / S, 0.0)

    there = error_statistics.errors([r for r in flight_records() if isinstance(r, RsbnFix)], truth)[
        error_statistics.RSBN
    ]
    found = assessed.errors[error_statistics.RSBN]
    assert len(found.t_ns) == len(there.t_ns) == END // 5
    assert np.allclose(found.error, there.error, rtol=1e-3, atol=0.1)
    assert all(error_statistics.RSBN in row.rms for row in assessed.rows)


def rebooted(at_s=200.0):
    """The same five minutes, in which the autopilot began anew."""
    at = START + round(at_s * S)
    rows = flight_records()
    k = next(k for k, r in enumerate(rows) if r.rx_ns >= at)
    return [*rows[:k], Reboot(at, at, 1), *rows[k:]]


def test_a_reboot_parts_a_log_into_flights():
    records = [(flight_log.topic_of(type(r)), r) for r in rebooted()]
    first, second = gather(records, "made.mcap", unix_ns=10**18)
    assert (first.part, second.part) == ((1, 2), (2, 2))
    assert (second.unix_ns - first.unix_ns, second.zero_ns - first.zero_ns) == (200 * S, 200 * S)
    assert sum(len(s.t) for f in (first, second) for s in f.streams.values()) == len(records)
    assert "/in/Reboot" in second.streams and "/in/Reboot" not in first.streams
    said = verdict(assess(second))
    assert "Flight 2 of 2 lasts 1 min 40 s." in said
    assert "GNSS was lost once" not in said  # it was lost in the first: here it comes at 0:40


def test_every_flight_of_a_log_has_its_chapters(tmp_path):
    pytest.importorskip("plotly")
    log, out = tmp_path / "two.mcap", tmp_path / "r.html"
    with flight_log.Writer(
        log, metadata=metadata(Config()), start_unix_ns=1_700_000_000 * S, start_ns=START, block=True
    ) as writer:
        for record in rebooted():
            writer.record(record)
    found = CliRunner().invoke(
        command, [str(log), "-o", str(out), "--png", str(tmp_path)], catch_exceptions=False
    )
    assert "Flight 1 of 2" in found.output and "Flight 2 of 2" in found.output
    text = out.read_text("utf-8")
    ids = re.findall(r"id='plot-(\w+)'", text)
    assert {"flight1_track", "flight2_track"} <= set(ids) and len(set(ids)) == len(ids)
    assert set(json.loads(re.search(r"id='figures'>(.*?)</script>", text, re.S)[1])) == set(ids)
    assert (tmp_path / "flight2_track.png").exists()
    replayed = CliRunner().invoke(replay_command, [str(log), "-o", str(tmp_path / "x.mcap")])
    assert "2 flights, the autopilot having begun anew" in replayed.output


def test_phases_are_what_the_position_rests_on(assessed):
    assert [phase.name for phase in assessed.phases] == ["GNSS", "prediction", "GNSS"]
    assert [round(phase.start_ns / S) for phase in assessed.phases] == [0, LOST, FOUND]
    assert [(round(h.start), round(h.end)) for h in assessed.outages] == [(LOST, FOUND)]


def test_refusals_in_a_row_are_one_event(assessed):
    (group,) = assessed.groups
    assert (group.source, group.number) == ("gnss 0", 10)
    assert (group.start, group.end) == pytest.approx((60.0, 61.8))
    assert group.metres == pytest.approx(500.0, abs=5.0)
    assert group.value == 99.0 + 309
    assert "10 in a row" in refusal(group)
    assert [line.text for line in assessed.timeline if line.kind == "refused"] == [refusal(group)]


def test_nees_is_the_squared_error_by_its_covariance(assessed):
    (nees,) = (misfit for misfit in assessed.misfits if misfit.what == "NEES")
    assert np.allclose(nees.value, 1.0, atol=1e-3)
    assert nees.inside == 1.0
    (nis,) = (misfit for misfit in assessed.misfits if misfit.what == "NIS")
    assert np.allclose(nis.value, 0.5)


def test_chi_square_limits_are_those_of_the_tables():
    found = assessing.chi2_95(np.array([1.0, 2.0, 3.0]))
    assert np.allclose(found, [3.841, 5.991, 7.815], atol=1e-3)


@pytest.mark.parametrize(("size", "held"), [(4.9, False), (5.1, True)])
def test_a_bound_that_does_not_hold_is_told(size, held):
    side = size / math.sqrt(2.0)
    a = assess(flight(bound=(side, side)))
    assert all(row.held is held for row in a.rows)
    assert ("DID NOT HOLD in 3 of 3 phases" in verdict(a)) is not held
    assert ("held in every phase" in verdict(a)) is held


def test_the_verdict_tells_what_happened(assessed):
    said = verdict(assessed)
    for words in (
        "The log holds 5 min.",
        "GNSS was lost once, for 2 min (from 2:00 to 4:00).",
        "off by 5.0 m with fixes and 5.0 m without (r.m.s.), 5.0 m at most; the inertial channel alone 100 m",
        "10 fixes were refused, from 1:00 to 1:02",
        "1 reset, the first at 0:10",
    ):
        assert words in said


def test_an_estimate_worse_than_the_inertial_channel_is_odd():
    assert "worse than the inertial channel alone" in verdict(
        assess(flight(error=(30.0, 40.0), ins=(3.0, 4.0)))
    )


def test_without_truth_the_reference_is_said_so():
    a = assess(flight(truth=False))  # no origin: nothing to smooth
    assert a.reference.what == assessing.GNSS
    assert "GNSS is no truth" in verdict(a)
    assert error_statistics.GNSS not in a.errors  # it would be compared with itself


def test_two_flights_are_compared_phase_by_phase(assessed):
    worse = assess(flight(error=(6.0, 8.0)))
    said = comparison(assessed, worse)
    assert "Without fixes A was nearer: 5.0 m r.m.s. against 10.0 m of B." in said
    for figure in figures([assessed, worse]):
        assert all(line.name[:2] in ("A ", "B ", "") for line in figure.lines)


def test_durations_read_as_people_say_them():
    assert [lasting(s) for s in (3.24, 42.0, 60.0, 187.0, 3600.0, 3725.0)] == [
        *("3.2 s", "42 s", "1 min", "3 min 7 s", "1 h", "1 h 2 min 5 s"),
    ]
    assert [clock(s) for s in (0.0, 187.4, -26.0, 7200.0)] == ["0:00", "3:07", "-0:26", "120:00"]


@settings(deadline=None, max_examples=60)
@given(st.integers(1, 5000), st.integers(20, 400), st.integers(0, 2**32 - 1))
def test_thinning_keeps_every_extreme_and_the_ends(n, most, seed):
    rng = np.random.default_rng(seed)
    x, y = np.arange(float(n)), rng.normal(size=n)
    y[rng.random(n) < 0.1] = np.nan
    kept_x, kept_y = thinned(x, y, most)
    assert len(kept_x) <= max(n if n <= most else 0, 1.5 * most + 4)
    assert (np.diff(kept_x) > 0.0).all()
    assert (kept_x[0], kept_x[-1]) == (x[0], x[-1])
    if np.isfinite(y[: n - n % max(1, math.ceil(2 * n / most))]).any() and n > most:
        whole = y[: n // math.ceil(2 * n / most) * math.ceil(2 * n / most)]
        assert np.nanmax(kept_y) >= np.nanmax(whole)
        assert np.nanmin(kept_y) <= np.nanmin(whole)


# -- the page --------------------------------------------------------------------------------------------


def test_the_page_stands_alone(page):
    text = page.read_text("utf-8")
    own = text[: text.index("<script>")] + text[text.index("<script type='application/json'") :]
    assert not re.findall(r"(?:src|href)\s*=\s*['\"]?\s*(?:https?:)?//", own)
    assert "@import" not in own
    assert "a <script> & b" not in own  # a log's name is words, not HTML
    assert html.escape("a <script> & b.mcap") in own
    assert "&lt;b&gt;no&lt;/b&gt; fixes" in own
    data = json.loads(re.search(r"id='figures'>(.*?)</script>", own, re.S)[1])
    assert set(data) == set(re.findall(r"id='plot-(\w+)'", own))
    assert {"track", "error", "bound", "consistency", "inertial_north", "ahead", "sources", "rates"} <= set(
        data
    )
    assert {"latency", "timesync"} <= set(data)
    assert page.stat().st_size < 12e6


def opened(page, width, folder):
    """What the page says of itself in a browser `width` wide, and what its console said."""
    # no window is narrower than 500: a frame is
    frame = folder / f"frame{width}.html"
    frame.write_text(
        f"<!doctype html><iframe src='{page.as_uri()}' style='border:0;width:{width}px;height:3000px'>"
        "</iframe>"
        "<script>setInterval(() => { const d = document.querySelector('iframe').contentDocument;"
        "if (d) document.documentElement.dataset.said = JSON.stringify(d.documentElement.dataset); }, 100)"
        "</script>"
    )
    found = subprocess.run(
        [
            *(CHROMIUM, "--headless", "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run"),
            *("--disable-background-networking", "--disable-component-update", "--disable-sync"),
            *("--allow-file-access-from-files", f"--user-data-dir={folder / str(width)}"),
            *(
                "--enable-logging=stderr",
                "--v=0",
                "--virtual-time-budget=20000",
                "--dump-dom",
                frame.as_uri(),
            ),
        ],
        capture_output=True,
        text=True,
        timeout=180,
    )
    said = re.search(r'data-said="([^"]*)"', found.stdout)
    assert said, found.stderr[-2000:]
    console = [line for line in found.stderr.splitlines() if "CONSOLE" in line]
    return json.loads(html.unescape(said[1])), console


@needs_chromium
@pytest.mark.parametrize("width", [1280, 390])
def test_a_browser_draws_every_plot_without_a_word(page, width, tmp_path):
    said, console = opened(page, width, tmp_path)
    plots = len(re.findall(r"id='plot-\w+'", page.read_text("utf-8")))
    assert said == {"drawn": str(plots), "failed": "0", "overflow": "0"}
    assert console == []


def test_figures_go_to_paper(log, tmp_path):
    pytest.importorskip("matplotlib")
    pytest.importorskip("plotly")
    out, pdf, png = tmp_path / "r.html", tmp_path / "r.pdf", tmp_path / "png"
    arguments = [str(log), str(log), "-o", str(out), "--pdf", str(pdf), "--png", str(png)]
    found = CliRunner().invoke(command, arguments, catch_exceptions=False)
    assert found.exit_code == 0
    assert pdf.read_bytes().startswith(b"%PDF")
    assert {path.stem for path in png.iterdir()} >= {"track", "error", "bound"}
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
def test_bad_input_is_one_sentence(name, content, tmp_path):
    path = tmp_path / name
    if content is not None:
        path.write_bytes(content)
    found = CliRunner().invoke(command, [str(path), "-o", str(tmp_path / "r.html")])
    assert isinstance(found.exception, LogError)
    assert str(path) in str(found.exception) or name in str(found.exception)
    assert "\n" not in str(found.exception)
    assert not (tmp_path / "r.html").exists()


@pytest.mark.parametrize("option", ["-o", "--pdf"])
def test_no_log_is_written_over(option, log, tmp_path):
    other, link, before = tmp_path / "other.tlog", tmp_path / "page.html", log.read_bytes()
    other.write_bytes(b"another flight")
    link.symlink_to(log)
    for output in (log, link, other):
        found = CliRunner().invoke(command, [str(log), option, str(output)])
        assert isinstance(found.exception, LogError) and "give another name" in str(found.exception)
    assert log.read_bytes() == before and other.read_bytes() == b"another flight"


def test_a_page_is_written_over_an_older_one(log, tmp_path):
    pytest.importorskip("plotly")
    page = tmp_path / "r.html"
    page.write_text("an older one")
    CliRunner().invoke(command, [str(log), "-o", str(page)], catch_exceptions=False)
    assert "an older one" not in page.read_text("utf-8")


def test_what_would_be_flown_with_is_refused_where_nothing_is_flown(log, tmp_path):
    mine = tmp_path / "mine.toml"
    mine.write_text("[gnss]\nsigma_m = 7.5\n")
    for option in (["--with", "gnss.sigma_m=50"], ["--config", str(mine)]):
        found = CliRunner().invoke(command, [str(log), "-o", str(tmp_path / "r.html"), *option])
        assert isinstance(found.exception, LogError)
        assert f"replay it first: companion replay {log} --with" in str(found.exception)
        assert not (tmp_path / "r.html").exists()


def test_a_report_is_of_one_log_or_two(log):
    assert CliRunner().invoke(command, [str(log)] * 3).exit_code == 2


def test_a_page_that_cannot_be_written_is_said(log, tmp_path):
    pytest.importorskip("plotly")
    found = CliRunner().invoke(command, [str(log), "-o", str(tmp_path / "no" / "r.html")])
    assert isinstance(found.exception, LogError)
    assert "cannot write the report" in str(found.exception)


def test_a_converted_log_is_flown_like_what_it_was_made_of(tmp_path):
    folder, log = Path(__file__).parents[1] / "data" / "umn_fixed_wing_cut", tmp_path / "umn.mcap"
    convert(folder, log)
    (direct,), (converted,) = open_flights(folder, Config()), open_flights(log, Config())
    for name, table in direct.tables.items():
        for column in table:
            np.testing.assert_array_equal(converted.tables[name][column], table[column])
    assert len(converted.tables["Solution"]["t"]) > 10
    (delay,) = converted.latencies
    assert delay.seconds == pytest.approx(0.2, abs=0.05)
    assert "behind the local position" in verdict(assess(converted))


@pytest.mark.shared
@pytest.mark.skipif(not DATA.exists(), reason="the recordings are not here")
def test_the_glitch_of_the_f450_is_an_event():
    (flight,) = open_flights(DATA / "inertialnav" / "f450_glitch_log.zip", Config())
    a = assess(flight)
    (group,) = (group for group in a.groups if group.source == "gnss 0")  # excluded, as it drifts off before
    assert 124.0 < group.start < 126.7
    assert group.end > 128.0
    assert 10.0 < group.metres < 20.0
    (line,) = (line for line in a.timeline if line.kind == "glitch")
    assert 126.2 < line.t < 127.7
    assert line.text in verdict(a)
