"""A recorded flight made wrong: what is changed and what is not; GNSS alone is not doubted."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

from companion.command_line import cli
from companion.config import load
from companion.records import AirData, Attitude, Gnss, Imu, RsbnFix, Stamped
from companion.storage.reader import LogError
from companion.study.outages import Fixes
from companion.study.wrong_sensors import LATE_NS, WRONG, Row, fly, made_wrong, study
from tests.study.test_outages import AIRSPEED, circling

NS = 1_000_000_000
DATA = Path(__file__).parents[1] / "data"


def recorded() -> list[Stamped]:
    rng, found = np.random.default_rng(1), list[Stamped]()
    for k in range(40):
        t_ns = k * NS // 10
        f_b, w_b = ((*rng.standard_normal(3).tolist(),) for _ in range(2))
        found.append(Imu(t_ns, t_ns, 0, f_b, w_b))  # type: ignore[arg-type]
        found.append(Attitude(t_ns, t_ns, 0.01 * k, 0.02 * k, 3.0 + 1e-3 * k, (0.0, 0.0, 0.1)))
        found.append(AirData(t_ns, t_ns, 20.0 + k, True, sensed=True))
        found.append(Gnss(t_ns, t_ns, 0, k, 3, 0.8, 0.1, 300.0))
        found.append(RsbnFix(t_ns, t_ns, 7, 0.8, 0.2, 100.0, 6.25, 4e4, 2e-3, 100.0))
    return found


@pytest.mark.parametrize("wrong", WRONG)
def test_only_what_is_wrong_is_changed_and_only_from_then_on(wrong: str) -> None:
    (kind, change), records, from_ns = WRONG[wrong], recorded(), 2 * NS
    changed = list(made_wrong(records, kind, change, from_ns))
    for before, after in zip(records, changed, strict=True):
        if type(before) is kind and before.rx_ns >= from_ns:
            assert after != before
        else:
            assert after is before


def of(wrong: str) -> tuple[list[Stamped], list[Stamped]]:
    kind, change = WRONG[wrong]
    records = [r for r in recorded() if type(r) is kind]
    return records, list(made_wrong(records, kind, change, 2 * NS))


def test_a_turned_imu_feels_the_same_force_elsewhere_and_a_late_one_later() -> None:
    for before, after in zip(*of("IMU mounted with its x axis to the right"), strict=True):
        assert isinstance(before, Imu) and isinstance(after, Imu)
        assert math.hypot(*after.f_b) == pytest.approx(math.hypot(*before.f_b), rel=1e-12)
    records, late = of("IMU late by 0.3 s")
    assert {b.t_ns - a.t_ns for a, b in zip(records, late, strict=True)} == {0, LATE_NS}


def test_what_is_stuck_keeps_its_last_value() -> None:
    records, stuck = of("attitude stuck while the gyros go on")
    values = [(r.roll, r.pitch, r.heading) for r in stuck if isinstance(r, Attitude)]
    assert len(set(values)) == len([r for r in records if r.rx_ns < 2 * NS])
    assert stuck[-1].w_b == (0.0, 0.0, 0.1)  # type: ignore[attr-defined]


def test_of_a_beacon_either_azimuth_or_range_is_wrong() -> None:
    (*_, before), (*_, after) = of("azimuths of beacons off by 5 deg")
    assert isinstance(before, RsbnFix) and isinstance(after, RsbnFix)
    assert after.azimuth == pytest.approx(6.25 + math.radians(5.0) - math.tau)
    assert after.slant_range == before.slant_range
    (*_, after) = of("ranges of beacons off by 200 m")[1]
    assert isinstance(after, RsbnFix)
    assert (after.azimuth, after.slant_range) == (before.azimuth, 4e4 + 200.0)


def test_a_gap_of_the_fixes_is_not_compared() -> None:
    config, flight = load(flags={"inertial.source": "air_data"}, environment={}), circling(60.0, (30.0, 50.0))
    row = fly("nothing", flight, Fixes(flight), config)  # a straight line over 20 s is 50 m off a circle
    assert row.farthest_m < 5.0


@pytest.mark.flight
def test_without_a_beacon_gnss_is_never_suspect() -> None:
    config = load(flags={"inertial.source": "air_data"}, environment={})
    rows = {row.wrong: row for row in study(circling(60.0), config, 20.0)}
    assert set(rows) == {"nothing", *(w for w, (kind, _) in WRONG.items() if kind not in (Imu, RsbnFix))}
    assert rows["nothing"].farthest_m < 1.0
    assert all(row[2:] == (0.0, 0.0) for row in rows.values())
    second = 2.0 * AIRSPEED  # against the true velocity, until the next fix
    assert rows["nothing"].farthest_m < max(row.farthest_m for row in rows.values()) < second


def test_table_and_json() -> None:
    words = ["study", "wrong-sensors", str(DATA / "dronekit_copter_cut.tlog"), "--from", "5"]
    printed = CliRunner().invoke(cli, words, catch_exceptions=False).stdout
    rows = json.loads(CliRunner().invoke(cli, [*words, "--json"], catch_exceptions=False).stdout)
    assert "wrong from 5 s on" in printed
    assert [Row(**row).wrong in printed for row in rows] == [True] * len(rows)


def test_a_start_after_the_end_of_the_log_is_rejected() -> None:
    words = ["study", "wrong-sensors", str(DATA / "dronekit_copter_cut.tlog"), "--from", "3600"]
    done = CliRunner().invoke(cli, words)
    assert done.exit_code == 2
    assert "--from 3600 has no effect: the log ends at 27 s" in done.output


def test_a_list_of_beacons_that_is_not_there_is_missed_before_the_log_is_read(tmp_path: Path) -> None:
    words = ["study", "wrong-sensors", str(tmp_path / "flight.tlog"), "--rsbn", str(tmp_path / "beacons.csv")]
    with pytest.raises(LogError, match=r"beacons\.csv cannot be read: No such file"):
        CliRunner().invoke(cli, words, catch_exceptions=False)
