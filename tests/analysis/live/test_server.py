"""The live view in a real browser, killed and started again; other sites cannot read it."""

import contextlib
import itertools
import json
import math
import re
import signal
import subprocess
import sys
import threading
import urllib.error
import urllib.request
from pathlib import Path

import pytest
from click.testing import CliRunner

from companion.analysis.live import server
from companion.analysis.live.follow import Channel, Message, find_log
from companion.analysis.live.server import LiveView, command
from companion.records import Event, Gnss, Mode, Solution, Trust
from companion.storage import flight_log
from companion.storage.reader import LogError
from tests.network import free_port
from tests.solutions import solution_at

pytest.importorskip("websockets")
S = 1_000_000_000
NASTY = "<!--<script>alert(1)</script><img src=x onerror=alert(2)>"
ROOT = Path(__file__).parents[3]


class Live:
    """A running `companion live`."""

    def __init__(self, path, port=0):
        self.process = subprocess.Popen(
            [sys.executable, "-m", "companion", "live", str(path), "--listen", f"127.0.0.1:{port}"],
            stderr=subprocess.PIPE,
            text=True,
            cwd=ROOT,
        )
        line = self.process.stderr.readline()
        self.port = int(re.search(r"http://127\.0\.0\.1:(\d+) shows", line)[1])
        self.url = f"http://127.0.0.1:{self.port}/"

    def __enter__(self):
        return self

    def __exit__(self, *error):
        self.process.kill()
        self.process.wait()
        self.process.stderr.close()


def get(url, **headers):
    try:
        with urllib.request.urlopen(urllib.request.Request(url, headers=headers), timeout=60) as answer:
            return answer.status, answer.read().decode()
    except urllib.error.HTTPError as error:
        with error:
            return error.code, error.read().decode()


def fly(log, first, count):
    for k in range(first, first + count):
        t = k * S // 5
        log.record(Gnss(t, t, 0, k + 1, 3, 0.97, 0.65 + 1e-6 * k, 100.0, 2.0))
        log.record(
            solution_at(
                t,
                lat=0.97,
                lon=0.65 + 1e-6 * k,
                alt_msl=100.0,
                v_n=(0.0, 20.0, 0.0),
                covariance=(25.0, 0.0, 0.0, 25.0, 0.0, 25.0),
                error_n=(3.0, 4.0),
                protection=80.0,
                trust=Trust.NORMAL,
                false_sources=(("gnss", 0.01),),
            )
        )


@contextlib.contextmanager
def flying(log):
    """A flight with one event that goes on, ten times as fast as real time, to the end of the block."""
    landed = threading.Event()

    def go_on():
        log.record(Event(0, 0, 4, NASTY))
        for k in itertools.count():
            if landed.wait(0.02):
                return
            fly(log, k, 1)

    flight = threading.Thread(target=go_on)
    flight.start()
    try:
        yield
    finally:
        landed.set()
        flight.join()


def test_page_follows_a_flight_and_survives_a_kill(tmp_path, browser):
    text, word = (
        "document.getElementById('events')?.textContent",
        "document.getElementById('trust').textContent",
    )
    time, dimmed = "Number(document.documentElement.dataset.t)", "document.body.classList.contains('gone')"
    # the clock was years off at the start and is right now: a computer without a battery clock
    with flight_log.Writer(
        tmp_path / "00001-x.mcap", metadata={}, start_unix_ns=0, start_ns=0, fsync_s=0.2
    ) as log:
        with flying(log), Live(tmp_path, free_port()) as live:
            browser.open(live.url)
            assert browser.wait_for(text).endswith(NASTY)
            browser.wait_for(f"{word}.includes('Trusted') && !{dimmed}")
            assert browser.evaluate("document.getElementById('sources').textContent").startswith(
                "GNSSused1.0"
            )
            assert browser.evaluate("document.querySelectorAll('img, #events script').length") == 0
            browser.wait_for(f"{time} > {browser.evaluate(time) + 20.0}")
            assert browser.console == []
            live.process.send_signal(signal.SIGKILL)
            browser.wait_for(f"{word}.includes('Not connected') && {dimmed}")
            with Live(tmp_path, live.port):
                browser.wait_for(f"{word}.includes('Trusted') && !{dimmed}")
                browser.wait_for(f"{time} > {browser.evaluate(time) + 20.0}")
        with Live(tmp_path, live.port):
            browser.wait_for(f"{word}.includes('No data') && {dimmed}")  # the log is still open
        assert log.trouble is None and log.dropped == 0
    assert {url.split("/")[2] for url in browser.requests if url.startswith("http")} == {
        f"127.0.0.1:{live.port}"
    }


@pytest.mark.parametrize("width", [360, 1180, 1420])
def test_the_longest_coordinates_fit_their_tiles(tmp_path, browser, width):
    path = tmp_path / "south.mcap"
    place = {"lat": math.radians(-77.70486), "lon": math.radians(-179.08532), "alt_msl": 100.0}
    with flight_log.Writer(path, metadata={}, start_unix_ns=0, start_ns=0) as log:
        log.record(solution_at(S, **place))
    with Live(path, free_port()) as live:
        browser.open(live.url, width)
        browser.wait_for("document.getElementById('numbers')?.textContent.includes('-179.08532°')")
        tiles = "[...document.querySelectorAll('.tiles dd, .tiles dt')]"
        assert browser.evaluate(f"{tiles}.filter((e) => e.scrollWidth > e.clientWidth).length") == 0
        root = "document.documentElement"
        assert browser.evaluate(f"{root}.scrollWidth <= {root}.clientWidth")


def wait_for_position(live, t, behind=math.inf):
    """Return the first frame with a position that is at least `t` (s) after the start of the log, and at most
    `behind` (s) old."""
    from websockets.sync.client import connect

    with connect(f"ws://127.0.0.1:{live.port}/socket", max_size=None) as client:
        while True:
            frame = json.loads(client.recv(timeout=60))
            if frame.get("numbers") and frame["t"] >= t and frame["behind"] <= behind:
                return frame


@contextlib.contextmanager
def until_interrupted(*arguments):
    """A `companion` that is stopped at the end."""
    process = subprocess.Popen(
        [sys.executable, "-m", "companion", *arguments], stderr=subprocess.DEVNULL, cwd=ROOT
    )
    try:
        yield
        process.send_signal(signal.SIGINT)
        assert process.wait(60) == 0
    finally:
        process.kill()
        process.wait()


def test_a_flight_does_not_notice_that_the_live_view_is_killed(tmp_path):
    port = free_port()
    settings = ("--preset", "navigation-ins", "--set", "output.profile=ardupilot")
    with (
        until_interrupted("run", "--connect", f"udpin:127.0.0.1:{port}", "--logs", str(tmp_path), *settings),
        until_interrupted("sitl", "--scenario", "short", "--connect", f"udpout:127.0.0.1:{port}"),
    ):
        with Live(tmp_path) as live:
            first = wait_for_position(live, 0.0)
            live.process.send_signal(signal.SIGKILL)
            assert live.process.wait(60) == -signal.SIGKILL
        with Live(tmp_path) as live:
            second = wait_for_position(live, first["t"] + 4.0, behind=3.0)
            live.process.send_signal(signal.SIGKILL)
            assert live.process.wait(60) == -signal.SIGKILL
        with Live(tmp_path) as live:
            wait_for_position(live, second["t"] + 2.0)
    assert second["log"] == first["log"]
    (log,) = tmp_path.glob("*.mcap")
    values = [e.value for e in flight_log.read(log)]
    texts = [value.text for value in values if isinstance(value, Event)]
    assert not [text for text in texts if text.startswith("log: ") or "lost" in text], texts
    assert sum(isinstance(value, Solution) and value.mode is Mode.FIXED for value in values) > 10


def test_a_log_that_is_just_created_is_waited_for(tmp_path):
    """The service creates the file, then writes its header; in between the view ended, or did not start."""
    log = tmp_path / "00001.mcap.active"
    for content in (b"", b"\x89MCAP0"):
        log.write_bytes(content)
        with Live(tmp_path) as live:
            for later in (content, b"\x89MCAP0"):
                log.write_bytes(later)
                with pytest.raises(subprocess.TimeoutExpired):
                    live.process.wait(1.0)
                assert get(live.url)[0] == 200


def test_a_log_that_is_closed_while_it_is_looked_for_is_no_end(tmp_path, monkeypatch):
    """It is renamed at its end: what was listed is not there any more."""
    gone = tmp_path / "00001-x.mcap.active"
    with monkeypatch.context() as patch:
        patch.setattr(Path, "glob", lambda folder, pattern: iter([gone]))
        assert find_log(tmp_path) is None
    view = LiveView(tmp_path)
    monkeypatch.setattr(server, "find_log", lambda path: gone)
    for has_header in (False, True):  # renamed before its size is read, or after it
        monkeypatch.setattr(server, "_has_header", lambda log, there=has_header: there)
        assert view._step() == b""


def test_other_sites_and_paths_are_refused(tmp_path):
    with Live(tmp_path) as live:
        assert get(live.url)[0] == 200
        assert get(f"{live.url}view.js")[0] == 200
        assert get(f"{live.url}../../etc/passwd")[0] == 404
        assert get(live.url, Host="evil.example")[0] == 403
        from websockets.exceptions import InvalidStatus
        from websockets.sync.client import connect

        address = f"ws://127.0.0.1:{live.port}/socket"
        with connect(address, origin=f"http://127.0.0.1:{live.port}") as client:
            waiting = json.loads(client.recv(timeout=60))["trust"]
            assert waiting["word"] == "Waiting for a flight"
        with pytest.raises(InvalidStatus, match="403"), connect(address, origin="http://evil.example"):
            pass
        live.process.send_signal(signal.SIGINT)
        assert live.process.wait(60) == 0


@pytest.mark.parametrize(
    ("listen", "words"), [("8300", "give HOST:PORT"), ("a:99999", "99999 is not a port: give 1 to 65535")]
)
def test_address_is_checked(listen, words, tmp_path):
    assert words in CliRunner().invoke(command, [str(tmp_path), "--listen", listen]).output


def test_address_of_another_computer_is_reported_in_the_systems_words(tmp_path):
    done = CliRunner().invoke(command, [str(tmp_path), "--listen", "192.0.2.1:8300"])
    wanted = "cannot listen on 192.0.2.1:8300: Cannot assign requested address; give another --listen"
    assert str(done.exception) == wanted


def test_missing_log_is_reported(tmp_path):
    found = CliRunner().invoke(command, [str(tmp_path / "none.mcap")])
    assert isinstance(found.exception, LogError) and "there is no such log" in str(found.exception)


def test_foxglove_clients_get_every_channel_with_its_schema():
    pytest.importorskip("foxglove")
    from websockets.sync.client import connect

    from companion.analysis.live.foxglove_server import FoxgloveServer

    foxglove = FoxgloveServer("127.0.0.1", 0)
    try:
        channel = Channel("/out/Event", "json", "Event", b'{"type": "object"}')
        foxglove.forward([Message(channel, 5, b'{"text": "x"}')])
        with connect(f"ws://127.0.0.1:{foxglove.port}", subprotocols=["foxglove.sdk.v1"]) as client:
            for _ in range(5):
                message = json.loads(client.recv(timeout=60))
                if message["op"] == "advertise":
                    break
        (shown,) = message["channels"]
        assert (shown["topic"], shown["schemaName"], shown["schema"]) == (
            "/out/Event",
            "Event",
            '{"type": "object"}',
        )
    finally:
        foxglove.stop()
