"""The scene shows what the records state, and its size does not grow with the flight."""

import math

import msgspec
import pytest

from companion.analysis.live.follow import Channel, Message
from companion.analysis.live.scene import Scene
from companion.nav.geometry import displace
from companion.records import Event, Gnss, Mode, RsbnFix, Trust, encode
from companion.storage.flight_log import topic_of
from tests.solutions import solution_at

S = 1_000_000_000
LAT, LON = 0.97, 0.65


def message(record):
    kind = type(record)
    return Message(Channel(topic_of(kind), "json", kind.__name__, b"{}"), record.rx_ns, encode(record))


def solution(t, east=0.0, north=0.0, **more):
    place = displace(LAT, LON, 0.0, north, east, 0.0)
    fields = {
        "alt_msl": 300.0,
        "v_n": (0.0, 20.0, 0.0),
        "covariance": (4.0, 0.0, 0.0, 9.0, 0.0, 25.0),
        "error_n": (30.0, 40.0),
        "bound_n": (30.0, 40.0),
        "protection": 80.0,
        "trust": Trust.NORMAL,
    }
    return solution_at(round(t * S), lat=place.lat, lon=place.lon, **(fields | more))


def test_an_hour_is_no_bigger_than_a_few_minutes():
    scene, sizes = Scene("x"), {}
    for k in range(3600 * 5):
        t = 0.2 * k
        scene.add(message(solution(t, east=20.0 * t, false_sources=(("gnss", 0.01),) if k % 5 == 0 else ())))
        if k % 10 == 0:
            scene.add(message(Gnss(round(t * S), round(t * S), 0, k + 1, 3, LAT, LON, 300.0)))
        if k % 50 == 0:
            scene.add(message(Event(round(t * S), round(t * S), 6, f"event {k}")))
        if t in (1200.0, 3595.0):
            sizes[t] = len(msgspec.json.encode(scene.frame(0.1, False)))
    assert sizes[3595.0] < 1.3 * sizes[1200.0]
    assert sizes[3595.0] < 500_000
    (line,) = (line for line in scene.frame(0.1, False)["map"]["lines"] if line["name"] == "estimate")
    assert line["x"][0] == 0.0 and line["x"][-1] == pytest.approx(72_000.0, abs=200.0)  # the whole flight


def test_numbers_and_circles_are_those_of_the_solution():
    scene = Scene("x")
    scene.add(message(solution(1.0)))
    frame = scene.frame(0.3, False)
    numbers = dict(frame["numbers"])
    assert (numbers["protection level"], numbers["guaranteed bound"]) == ("80 m", "50 m")
    assert numbers["95 % radius"] == "7.3 m"  # sqrt(5.991) sigma of the worse axis, 3 m
    lines = {line["name"]: line for line in frame["map"]["lines"]}
    for name, radius in (("guaranteed circle", 50.0), ("protection level", 80.0)):
        assert all(
            math.hypot(x, y) == pytest.approx(radius, abs=0.02)
            for x, y in zip(lines[name]["x"], lines[name]["y"])
        )
    ellipse = lines["95 % ellipse"]
    assert (max(ellipse["x"]), max(ellipse["y"])) == pytest.approx((7.34, 4.9), abs=0.03)
    assert (lines["inertial channel alone"]["x"], lines["inertial channel alone"]["y"]) == ([40], [30])


@pytest.mark.parametrize(
    ("more", "behind", "level", "word"),
    [
        ({}, 0.2, "good", "Trusted"),
        ({"trust": Trust.DEGRADED}, 0.2, "caution", "Degraded"),
        ({"trust": Trust.PREDICTING, "mode": Mode.PREDICTING, "sources": 1}, 0.2, "caution", "Predicting"),
        ({"trust": Trust.PREDICTING}, 0.2, "caution", "Recovering"),  # fixes are back, the trust settles
        ({"trust": Trust.UNTRUSTED, "mode": Mode.UNTRUSTED, "sources": 1}, 0.2, "fault", "Do not trust"),
        ({}, 4.0, "fault", "No data"),
    ],
)
def test_trust_is_a_word(more, behind, level, word):
    scene = Scene("x")
    scene.add(message(solution(1.0, **more)))
    found = scene.frame(behind, False)["trust"]
    assert (found["level"], found["word"]) == (level, word)


def test_a_log_that_was_closed_trusts_nothing():
    """The companion was stopped in flight: the page went on with "Trusted"."""
    scene = Scene("x")
    scene.add(message(solution(1.0)))
    frame = scene.frame(20.0, True)
    assert frame["old"] and frame["trust"] == {
        "level": "caution",
        "word": "Stopped",
        "why": "The companion closed this log 20 s ago.",
    }
    played = scene.frame(None, True)
    assert (played["old"], played["trust"]["word"]) == (False, "Trusted")


def test_sources_grow_old_with_a_log_that_is_not_written():
    """The companion is killed, which no record states."""
    scene = Scene("x")
    scene.add(message(Gnss(S, S, 0, 1, 3, LAT, LON, 300.0)))
    scene.add(message(RsbnFix(S, S, 7, LAT, LON, 0.0, math.pi / 2, 5000.0, 0.002, 100.0)))
    scene.add(message(solution(1.0, sources=1 | 2 | 4 | 8)))
    for behind, state, ends in ((0.5, "used", 29), (30.0, "silent", 0)):
        frame = scene.frame(behind, False)
        assert {(row["state"], row["age"]) for row in frame["sources"]} == {(state, behind)}
        (line,) = (line for line in frame["map"]["lines"] if line["name"] == "lines of position")
        assert (frame["old"], len(line["x"])) == (not ends, ends)


def test_charts_are_of_the_last_ten_minutes():
    """What is seldom, or is received no more, does not stretch them."""
    scene = Scene("x")
    for k in range(1500):
        false = (("gnss", 0.01),) if k % 2 else ()
        scene.add(message(solution(k, false_sources=false)))
        if k < 60:
            scene.add(message(Gnss(k * S, k * S, 0, k + 1, 3, LAT, LON, 300.0)))
    charts = {chart["key"]: chart["lines"] for chart in scene.frame(0.1, False)["charts"]}
    assert charts["gnss"][0]["x"] == []
    starts = [line["x"][0] for key in ("size", "false", "inertial") for line in charts[key]]
    assert starts == pytest.approx([1499.0 - 600.0] * len(starts), abs=1.0)


def test_nothing_is_trusted_before_a_position():
    trust = Scene("x").frame(0.1, False)["trust"]
    assert (trust["level"], trust["word"], trust["why"]) == (
        "caution",
        "No position yet",
        "No fix was received yet.",
    )


def test_sources_have_the_probability_that_each_is_false():
    scene = Scene("x")
    false = (("gnss", 0.9999), ("airspeed", 0.02), ("rsbn 7 azimuth", 0.6), ("rsbn 7 range", 0.001))
    false = (*false, ("velocity of gnss", 0.03))
    scene.add(message(Gnss(S, S, 0, 1, 3, LAT, LON, 300.0, v_n=(30.0, 0.0, 0.0))))
    scene.add(message(RsbnFix(S, S, 7, LAT, LON, 0.0, math.pi / 2, 5000.0, 0.002, 100.0)))
    scene.add(message(solution(1.5, sources=1 | 4 | 8 | 16, false_sources=false)))
    rows = {row["name"]: (row["state"], row["false"]) for row in scene.frame(0.1, False)["sources"]}
    assert rows == {
        "GNSS": ("excluded", 100.0),
        "velocity of GNSS": ("not used", 3.0),
        "beacon 7 azimuth": ("suspect", 60.0),
        "beacon 7 range": ("used", 0.1),
        "airspeed": ("used", 2.0),
    }
    scene.add(message(solution(1.6, sources=1 | 4, false_sources=(("gnss", 0.9),))))
    assert scene.frame(0.1, False)["sources"][0]["state"] == "excluded"  # until it is believed
    scene.add(message(solution(1.7, sources=1 | 4 | 8 | 16, false_sources=false)))
    assert "Probably false: GNSS, beacon 7 azimuth." in scene.frame(0.1, False)["trust"]["why"]
    scene.add(message(solution(10.0)))
    assert {row["state"] for row in scene.frame(0.1, False)["sources"]} >= {"silent"}


@pytest.mark.parametrize("sources", [1 | 2, 1 | 2 | 16])
def test_table_and_chart_have_the_same_sources(sources):
    """Airspeed is a source once it is used; a beacon's azimuth once it was measured."""
    scene = Scene("x")
    false = (
        ("gnss", 0.01),
        ("velocity of gnss", 0.02),
        ("airspeed", 0.0),
        ("rsbn 7 azimuth", 0.0),
        ("rsbn 7 range", 0.1),
    )
    scene.add(message(Gnss(S, S, 0, 1, 3, LAT, LON, 300.0, v_n=(30.0, 0.0, 0.0))))
    scene.add(message(RsbnFix(S, S, 7, LAT, LON, 0.0, None, 5000.0, 0.002, 100.0)))
    scene.add(message(solution(1.5, sources=sources, false_sources=false)))
    frame = scene.frame(0.1, False)
    (chart,) = (chart for chart in frame["charts"] if chart["key"] == "false")
    names = [row["name"] for row in frame["sources"]]
    assert names == [line["name"] for line in chart["lines"]]
    assert names == ["GNSS", "velocity of GNSS", "beacon 7 range", *(["airspeed"] if sources & 16 else [])]


def test_lines_of_position_end_where_the_beacon_measured():
    scene = Scene("x")
    scene.add(message(RsbnFix(S, S, 7, LAT, LON, 0.0, math.pi / 2, 5000.0, 0.002, 100.0)))
    frame = scene.frame(0.1, False)["map"]
    (line,) = (line for line in frame["lines"] if line["name"] == "lines of position")
    assert (line["x"][:2], line["y"][:2]) == (
        [0, pytest.approx(5000.0, abs=1.0)],
        [0, pytest.approx(0.0, abs=5.0)],
    )
    assert frame["places"] == [["beacon 7", 0.0, 0.0]]


@pytest.mark.parametrize(
    ("azimuth", "slant_range"), [(math.pi / 2 - 0.01, 20_000.0), (math.pi / 2 - 0.01, None), (None, 20_400.0)]
)
def test_ends_of_lines_of_position_are_in_view(azimuth, slant_range):
    scene = Scene("x")
    for k in range(100):
        scene.add(message(solution(k, east=20_000.0, north=20.0 * k - 1980.0)))
    scene.add(message(RsbnFix(100 * S, 100 * S, 7, LAT, LON, 0.0, azimuth, slant_range, 0.004, 100.0)))
    x0, x1, y0, y1 = (figure := scene.frame(0.1, False)["map"])["frame"]
    (line,) = (line for line in figure["lines"] if line["name"] == "lines of position")
    x, y = (line["x"][1], line["y"][1]) if azimuth else (line["x"][12], line["y"][12])
    aircraft = figure["aircraft"]
    assert math.dist((x, y), aircraft[:2]) == pytest.approx(200.0 if azimuth else 400.0, abs=40.0)
    assert x0 < x < x1 and y0 < y < y1


@pytest.mark.parametrize("seconds", [2, 200])
def test_a_beacon_far_off_does_not_make_the_map_small(seconds):
    scene = Scene("x")
    for k in range(seconds):
        scene.add(message(solution(k, east=20.0 * k)))
    scene.add(message(RsbnFix(S * seconds, S * seconds, 7, LAT, LON, 0.0, 0.0, 90_000.0, 0.004, 100.0)))
    x0, x1, y0, y1 = scene.frame(0.1, False)["map"]["frame"]
    assert max(x1 - x0, y1 - y0) < 1.15 * max(1000.0, 2.0 * 20.0 * seconds)


def test_a_record_of_another_version_is_left_out():
    scene = Scene("x")
    channel = Channel("/out/Solution", "json", "Solution", b"{}")
    scene.add(Message(channel, S, b'{"unknown": 1}'))
    assert scene.frame(0.1, False)["trust"]["word"] == "No position yet"
