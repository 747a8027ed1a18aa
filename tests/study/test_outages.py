"""Outages of a recorded flight: the rules are right where they must be, and the companion is no worse."""

from __future__ import annotations

import json
import lzma
import math
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner
from msgspec.structs import replace

from companion.command_line import cli
from companion.config import load
from companion.importers.sources import open_source
from companion.nav.geometry import Geodetic, displace, separation
from companion.records import AirData, AirspeedSensor, Attitude, Gnss, Stamped, Vehicle
from companion.storage.flight_log import Writer
from companion.storage.reader import LogError
from companion.study import outages

NS = 1_000_000_000
DATA = Path(__file__).parents[1] / "data"
SHARED = Path(__file__).parents[3] / "shared" / "data"
AIRSPEED, WIND, TURN_S = 25.0, (6.0, -4.0), 200.0


def circling(seconds: float, lost: tuple[float, float] = (0.0, 0.0)) -> list[Stamped]:
    """An aircraft that turns in a wind that stays; GNSS without noise, not there during `lost`."""
    place, records = Geodetic(0.8, 0.1, 500.0), list[Stamped]()
    v_n = (0.0, 0.0)
    for k in range(round(10 * seconds)):
        t_ns = k * NS // 10
        heading = math.tau * k / 10 / TURN_S
        v_n = (AIRSPEED * math.cos(heading) + WIND[0], AIRSPEED * math.sin(heading) + WIND[1])
        bank = math.atan(AIRSPEED * math.tau / TURN_S / 9.81)
        records.append(Attitude(t_ns, t_ns, bank, 0.0, math.remainder(heading, math.tau), (0.0, 0.0, 0.0)))
        live = 0.1 * math.sin(k)  # the same number for seconds is a frozen sensor
        records.append(AirData(t_ns, t_ns, AIRSPEED + live, True, sensed=True))
        if k % 2 == 0 and not lost[0] <= k / 10 < lost[1]:
            stated = {"sigma_horizontal": 2.0, "sigma_velocity": 0.3}
            records.append(Gnss(t_ns, t_ns, 0, t_ns // 1000, 3, *place, v_n=(*v_n, 0.0), **stated))
        place = displace(*place, 0.1 * v_n[0], 0.1 * v_n[1], 0.0)
    return records


@pytest.mark.flight
def test_rules_and_companion_on_a_flight_that_is_known() -> None:
    config = load(flags={"inertial.source": "air_data"}, environment={})
    rows = outages.study("", circling(330.0), config, 60.0, (10.0, 60.0))
    assert [row.outages for row in rows] == [3, 3]
    for row in rows:
        assert row.by_wind_m is not None and row.by_wind_m < 3.0
        arc = AIRSPEED * TURN_S / math.tau * math.tau / TURN_S * row.lasting_s
        angle = math.tau * row.lasting_s / TURN_S
        true = AIRSPEED * TURN_S / math.tau * np.array([math.sin(angle), 1.0 - math.cos(angle)])
        assert row.straight_on_m == pytest.approx(math.hypot(true[0] - arc, true[1]), rel=0.02)
        assert row.rms_m is not None and row.rms_m < 10.0
        assert row.within is not None and row.within > 0.9


def test_positions_between_fixes_cross_the_antimeridian() -> None:
    first, second = (record for record in circling(0.3) if isinstance(record, Gnss))
    lon = math.pi - 1e-7
    fixes = outages.Fixes([replace(first, lon=lon), replace(second, lon=-lon)])
    between = fixes.at((first.t_ns + second.t_ns) / 2)
    assert separation(between, Geodetic(between.lat, math.pi, 0.0))[1] == pytest.approx(0.0, abs=0.01)


def test_no_outage_where_the_recorded_gnss_was_lost() -> None:
    fixes = outages.Fixes(circling(400.0, lost=(150.0, 160.0)))
    starts = [t / NS for t in fixes.starts(30.0, 20.0)]
    assert starts and not [t for t in starts if 130.0 < t < 210.0]
    assert all(b - a >= 30.0 for a, b in pairwise(starts))
    longer = outages.Fixes(circling(500.0, lost=(150.0, 300.0)))
    assert not [t for t in longer.starts(10.0, 20.0) if 130.0 * NS < t < 360.0 * NS]


def test_a_slow_flight_is_one_where_the_log_states_it() -> None:
    """A copter: outages begin and end in the air."""
    slow = [replace(r, v_n=(1.0, 0.0, 0.0)) if isinstance(r, Gnss) else r for r in circling(400.0)]
    assert not outages.Fixes(slow).starts(10.0, 20.0)
    spans = {10: True, 150: False, 200: True, 390: False}
    stated = [Vehicle(t * NS, t * NS, True, flying) for t, flying in spans.items()]
    starts = [t / NS for t in outages.Fixes([*slow, *stated]).starts(10.0, 20.0)]
    assert starts and starts[0] >= 100.0
    assert all(t < 130.0 or 200.0 <= t < 370.0 for t in starts)
    assert [t for t in starts if t < 130.0] and [t for t in starts if t > 340.0]


def test_of_an_aeroplane_the_speed_counts_whatever_its_log_states() -> None:
    fast = circling(330.0)
    landed = [Vehicle(t * NS, t * NS, False, t > 200) for t in range(0, 330, 10)]
    assert outages.Fixes([*fast, *landed]).starts(10.0, 20.0) == outages.Fixes(fast).starts(10.0, 20.0)


def test_a_flight_too_short_is_one_sentence() -> None:
    log = DATA / "dronekit_copter_cut.tlog"
    with pytest.raises(
        LogError,
        match=r"no 100 s of flight with GNSS \(stated by the log, or faster than 8 m/s\): choose a longer",
    ):
        CliRunner().invoke(cli, ["study", "outages", str(log)], catch_exceptions=False)


@pytest.mark.flight
def test_of_several_logs_each_has_its_rows_and_its_reason(tmp_path: Path) -> None:
    """A name is printed as it is; a log that is refused costs the others nothing."""
    log, short = tmp_path / "[b]circle.mcap", DATA / "dronekit_copter_cut.tlog"
    with Writer(log, metadata={}, start_unix_ns=NS, start_ns=0) as writer:
        for record in circling(130.0):
            writer.record(record)
    words = ["study", "outages", str(log), str(short), "--lasting", "10"]
    done = CliRunner().invoke(cli, [*words, "--json"], catch_exceptions=False)
    assert [(row["log"], row["lasting_s"], row["outages"]) for row in json.loads(done.stdout)] == [
        (log.name, 10.0, 1)
    ]
    assert done.exit_code == 1
    assert done.stderr.startswith(f"companion: {short}: no 100 s of flight with GNSS")
    shown = CliRunner().invoke(cli, [*words, "--lasting", "60"]).stdout
    assert log.name in shown
    assert f"{log.name} is too short for 60 s" in " ".join(shown.split())  # the shorter ones are flown


@pytest.mark.parametrize("name", ["no_airspeed_sensor", "pitot_stuck"])
def test_the_rule_uses_an_airspeed_that_the_navigator_takes_as_measured(name: str, tmp_path: Path) -> None:
    """ArduPlane without a sensor sends its own estimate as VFR_HUD.airspeed."""
    log = tmp_path / f"{name}.tlog"
    log.write_bytes(lzma.decompress((DATA / f"{name}_cut.tlog.xz").read_bytes()))
    records = sorted(open_source(log), key=lambda record: record.rx_ns)
    assert sum(isinstance(record, AirData) for record in records) > 100
    air, last_ns = outages.Air(records), max(r.t_ns for r in records if isinstance(r, AirData))
    assert air.is_sensed(last_ns) == (name != "no_airspeed_sensor")


def test_an_airspeed_counts_while_its_sensor_is_healthy() -> None:
    unstated = [replace(r, sensed=None) if isinstance(r, AirData) else r for r in circling(100.0)]
    assert not outages.Air(unstated).is_sensed(20 * NS)
    states = [AirspeedSensor(t * NS, t * NS, t < 50) for t in range(100)]
    air = outages.Air(sorted([*states, *unstated], key=lambda record: record.rx_ns))
    assert air.is_sensed(50 * NS) and not air.is_sensed(61 * NS)


@pytest.mark.shared
@pytest.mark.flight
@pytest.mark.long
def test_recorded_outages_are_bridged_as_well_as_by_the_best_rule() -> None:
    log = SHARED / "umn_fixed_wing"
    if not log.exists():
        pytest.skip("recordings are not there")
    done = CliRunner().invoke(cli, ["study", "outages", str(log), "--json"], catch_exceptions=False)
    rows = [outages.Row(**row) for row in json.loads(done.stdout)]
    ours, rule = zip(*((row.rms_m or math.inf, row.by_wind_m or math.inf) for row in rows))
    assert all(a < 1.05 * b for a, b in zip(ours, rule)) and sum(ours) < sum(rule)
