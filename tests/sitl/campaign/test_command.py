"""Campaign: results are stored, stored flights are not repeated, and the table summarises them."""

from __future__ import annotations

import dataclasses
import json
import math
import os
import signal
from pathlib import Path

import pytest
from click.testing import CliRunner

from companion.analysis.jobs import Journal
from companion.config import Config
from companion.records import Event, Solution, Trust
from companion.units import SECOND_NS
from sitl import loopback
from sitl.campaign import command, flight
from sitl.campaign.command import CampaignLimits
from sitl.campaign.flight import (
    FAULT_CASES,
    SCENARIOS,
    FlightOrder,
    FlightResult,
    fly_order,
    scenario_of,
    score_flight,
)
from sitl.faults import NAMES, Fault
from sitl.scenarios import SensorRates, get_scenario
from sitl.world import World
from tests.solutions import solution_at


def result(fault: str, seed: int, **changes: object) -> FlightResult:
    order = FlightOrder("one-beacon", fault, seed)
    return FlightResult(order.key, *order, 720.0)._replace(**{"solutions": 3600, "quiet_s": 240.0, **changes})


def flown(fault: str, scenario: str = "one-beacon") -> FlightResult:
    found = fly_order(FlightOrder(scenario, fault, 1))
    assert found.raised is None
    return found


JUMP = FlightOrder("one-beacon", "gnss-jump", 1)
#: Results as of flights, where only their storage and their table matter.
RESULTS = [
    result("none", 1),
    result("gnss-jump", 1, detected_s=1.0, excluded_s=3.0, before_m=20.0, largest_m=50.0, normal_m=9.0),
]
ORDERS = [FlightOrder(r.scenario, r.fault, r.seed) for r in RESULTS]


@pytest.fixture
def requested(monkeypatch: pytest.MonkeyPatch) -> list[FlightOrder]:
    """Orders that were flown; each gives its result of `RESULTS`."""
    orders: list[FlightOrder] = []

    def remembered(order: FlightOrder) -> FlightResult:
        orders.append(order)
        return next(r for r in RESULTS if r.key == order.key)

    monkeypatch.setattr(command, "fly_order", remembered)
    return orders


@pytest.mark.flight
@pytest.mark.long
def test_flight_without_faults_has_no_alarms_and_small_errors() -> None:
    quiet = flown("none")
    assert quiet.largest_m < 15.0
    assert (quiet.detected_s, quiet.excluded_s, quiet.alarms, quiet.misleading_s) == (None, None, 0, 0.0)


@pytest.mark.flight
@pytest.mark.long
@pytest.mark.parametrize("fault", ["gnss-jump", "ins-reset", "beacon-bias"])
def test_gross_faults_are_detected_at_once(fault: str) -> None:
    found = flown(fault)
    assert found.detected_s is not None and found.detected_s < 10.0
    assert found.before_m < 100.0


@pytest.mark.flight
@pytest.mark.long
def test_same_order_gives_the_same_result() -> None:
    assert fly_order(JUMP) == fly_order(JUMP)


def test_stored_flights_are_not_repeated(requested: list[FlightOrder], tmp_path: Path) -> None:
    """After an interruption with an incomplete last line, that flight and the missing ones are flown."""
    assert command.run_campaign(ORDERS, tmp_path) == RESULTS
    path = tmp_path / "flights.jsonl"
    lines = path.read_bytes().splitlines(keepends=True)
    assert len(lines) == 2
    path.write_bytes(lines[0] + lines[1][:25])
    assert command.run_campaign(ORDERS, tmp_path) == RESULTS
    assert requested == [*ORDERS, ORDERS[1]]
    assert [json.loads(line)["key"] for line in path.read_bytes().splitlines()] == [r.key for r in RESULTS]


def test_exception_in_a_flight_is_a_result() -> None:
    lost = fly_order(FlightOrder("nowhere", "none", 1))
    assert lost.raised is not None
    assert "scenarios are one-beacon" in lost.raised
    assert not command.summarise([lost], CampaignLimits())[0].passed


def test_table_applies_the_limits() -> None:
    results = [
        result("gnss-jump", 1, detected_s=1.0, excluded_s=3.0, before_m=20.0, largest_m=50.0),
        result("gnss-jump", 2, detected_s=5.0, excluded_s=6.0, before_m=40.0, largest_m=400.0),
        result("beacon-bias", 1, largest_m=301.0, misleading_s=30.0, alarms=1),
        result("gnss-jam", 1, detected_s=3.0, rms_error=30.0, rms_bound=40.0),
        result("gnss-jam", 2, detected_s=3.0, rms_error=60.0, rms_bound=40.0),
    ]
    jump, bias, jam = command.summarise(results, CampaignLimits())
    assert (jump.flights, jump.detected, jump.median_s, jump.slowest_s) == (2, 2, 3.0, 5.0)
    assert (jump.before_m, jump.largest_m, jump.harmful, jump.passed) == (40.0, 400.0, 0, True)
    assert (bias.detected, bias.harmful, bias.misleading, bias.alarms_per_hour) == (0, 1, 1, 15.0)
    assert not bias.passed
    assert jam.bound_held is False


@pytest.mark.parametrize(("fault", "harmful"), [("beacon-bias", 1), ("gnss-jump", 0)])
def test_beside_a_healthy_gnss_a_fault_that_is_detected_excuses_no_error(fault: str, harmful: int) -> None:
    found = [result(fault, 1, detected_s=1.0, largest_m=301.0, normal_m=20.0)]
    assert command.summarise(found, CampaignLimits())[0].harmful == harmful


def test_a_case_flies_all_of_its_faults() -> None:
    faults = flight.scenario_of(FlightOrder("one-beacon", "beacon-anywhere-first", 1)).faults
    assert [(fault.name, fault.end_s) for fault in faults] == [
        ("beacon-anywhere", math.inf),
        ("gnss-jam", 30.0),
    ]


def test_an_error_above_the_protection_level_is_misleading_or_flagged() -> None:
    """Regression: one under an untrusted position was neither."""
    order = FlightOrder("one-beacon", "none", 1)
    trusts = [Trust.UNTRUSTED] * 5 + [Trust.DEGRADED] * 3 + [Trust.PREDICTING] * 2
    far = [solution_at(t * SECOND_NS, protection=5001.0, trust=trust) for t, trust in enumerate(trusts, 100)]
    scored = score_flight(order, World(scenario_of(order)), far)
    assert (scored.beyond_s, scored.misleading_s) == (8.0, 1.0)  # the last one ends the flight


@pytest.mark.flight
@pytest.mark.long
def test_slow_consumer_does_not_shift_the_clock() -> None:
    """Regression: reading every ten seconds shifted the clock by half a second, and GNSS was excluded."""
    found = flown("slow-consumer")
    assert (found.excluded_s, found.wrong, found.alarms) == (None, 0, 0)
    assert found.largest_m < 15.0


@pytest.mark.flight
@pytest.mark.long
@pytest.mark.parametrize(
    ("scenario", "name"),
    [("one-beacon", "clock-jump"), ("air-data", "link-late"), ("one-beacon", "reboot-turning")],
)
def test_late_link_and_clock_jump_are_reported_without_position_error(scenario: str, name: str) -> None:
    """Regression: a late link shifted the clock, and a clock set back counted as a reboot: 220 m of error,
    GNSS excluded. The same happened where the error of the restarted channel was five times its sigma.
    """
    found = flown(name, scenario)
    assert (found.excluded_s, found.wrong, found.alarms, found.misleading_s) == (None, 0, 0, 0.0)
    assert found.detected_s is not None and found.detected_s < 10.0
    assert found.largest_m < 15.0


@pytest.mark.flight
@pytest.mark.long
def test_an_ins_that_drifts_and_stops_is_not_trusted_beyond_its_level() -> None:
    """Regression: that its velocity steps twice was as good as excluded: level 31 m, error 243 m."""
    found = flown("ins-drift", "no-beacon")
    assert found.largest_m > 200.0
    assert (found.misleading_s, found.beyond_s) == (0.0, 0.0)


@pytest.mark.flight
@pytest.mark.long
@pytest.mark.parametrize("name", ["gnss-stale", "beacon-frozen", "ins-frozen"])
def test_stale_data_with_new_stamps_is_detected_at_once(name: str) -> None:
    found = flown(name)
    assert found.detected_s is not None and found.detected_s < 3.0
    assert found.largest_m < 100.0


@pytest.mark.flight
def test_stop_and_resumption_of_solutions_are_reported() -> None:
    """The position freezes while the attitude continues; events as sent over the link."""
    fault = Fault("ins-frozen", 60.0, 75.0)
    scenario = dataclasses.replace(
        get_scenario("short"), faults=(fault,), rates=SensorRates(imu=1.0, truth=1.0)
    )
    records = loopback.fly_scenario(scenario, loopback.simulator_config(Config())).records
    events = [(r.rx_ns * 1e-9 - 1000.0, r.text) for r in records if isinstance(r, Event)]
    (stopped,) = [t for t, text in events if "no data from the inertial channel" in text]
    (resumed,) = [t for t, text in events if text == "solutions resumed"]
    assert 60.0 < stopped < 65.0 and 75.0 < resumed < 78.0
    assert not [r for r in records if isinstance(r, Solution) and 62.0 < r.rx_ns * 1e-9 - 1000.0 < 75.0]


def test_campaign_covers_every_simulator_fault() -> None:
    covered = {kind.fault.name for kind in FAULT_CASES.values() if kind.fault}
    # a byte fault, covered by the tests of the frame reader, and one that the harm study flies
    assert set(NAMES) - covered <= {"cut", "gnss-velocity"}
    for name in SCENARIOS:
        for fault in FAULT_CASES:
            assert flight.scenario_of(FlightOrder(name, fault, 1)).duration_s >= 600.0


def test_a_case_given_twice_is_flown_once() -> None:
    """The table counted each of its flights twice."""
    assert command.list_orders(["one-beacon"] * 2, ["none"] * 2, 1) == [FlightOrder("one-beacon", "none", 1)]


@pytest.mark.parametrize(
    ("scenarios", "fault"),
    [(["no-beacon", "one-beacon", "mems"], "beacon-late"), (["air-data", "one-beacon"], "ins-nan")],
)
def test_a_fault_is_flown_once_in_the_first_scenario_that_it_concerns(
    scenarios: list[str], fault: str
) -> None:
    """Regression: in none, where it does not concern the first scenario, and the campaign passed."""
    assert command.list_orders(scenarios, [fault], 1) == [FlightOrder("one-beacon", fault, 1)]


def test_a_campaign_without_a_flight_is_rejected(tmp_path: Path) -> None:
    options = ["--scenario", "no-beacon", "--fault", "beacon-bias", "--results", str(tmp_path)]
    done = CliRunner().invoke(command.command, options)
    assert done.exit_code == 2 and "no flight" in done.output


@pytest.mark.parametrize("name", ["x.txt", "flight.mcap", "folder.md", ""])
def test_a_report_that_is_no_markdown_is_rejected_before_the_flights(
    name: str, tmp_path: Path, requested: list[FlightOrder]
) -> None:
    (tmp_path / "folder.md").mkdir()
    page = str(tmp_path / name) if name else ""
    done = CliRunner().invoke(
        command.command, ["--report", page, "--results", str(tmp_path), "--workers", "0"]
    )
    assert done.exit_code == 2 and not requested
    assert "ends with .md" in done.output.replace("\n", " ")


@pytest.mark.usefixtures("requested")
def test_exit_code_follows_the_limits(tmp_path: Path) -> None:
    options = ["--scenario", "one-beacon", "--fault", "none", "--fault", "gnss-jump", "--seeds", "1"]
    options += ["--workers", "0", "--results", str(tmp_path), "--json"]
    events = CliRunner().invoke(command.command, options)
    assert events.exit_code == 0, events.output
    assert [line["fault"] for line in json.loads(events.stdout)] == ["none", "gnss-jump"]
    page = tmp_path / "campaign.md"
    limits = ["--harmless-m", "0.001"]
    strict = CliRunner().invoke(command.command, [*options[:-1], *limits, "--report", str(page)])
    assert strict.exit_code == 1
    assert "gnss-jump" in strict.output
    made_by = "--scenario one-beacon --fault none --fault gnss-jump --harmless-m 0.001 --seeds 1"
    assert f"    companion campaign {made_by} --report {page}\n" in page.read_text()


@pytest.mark.usefixtures("requested")
def test_heads_of_the_table_are_not_cut(tmp_path: Path) -> None:
    options = ["--scenario", "one-beacon", "--fault", "none", "--workers", "0", "--results", str(tmp_path)]
    shown = CliRunner().invoke(command.command, options).output
    assert [head for head in command.HEADS if head not in shown] == []


def test_dask_returns_every_flight_and_that_of_a_killed_worker_too(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """SIGKILL during the third of six flights; the nanny starts another worker, which repeats it. The flights
    end at once because their scenario is unknown.
    """
    pytest.importorskip("distributed", reason="the extra `campaign` is not installed")
    killed = tmp_path / "killed"

    def fly(order: FlightOrder) -> FlightResult:
        if order.seed == 3 and not killed.exists():
            killed.touch()
            os.kill(os.getpid(), signal.SIGKILL)
        return fly_order(order)

    monkeypatch.setattr(command, "fly_order", fly)
    wanted = [FlightOrder("nowhere", "none", seed) for seed in range(1, 7)]
    results = command.run_campaign(wanted, tmp_path, workers=1)
    assert killed.exists()
    assert [r.key for r in results] == [order.key for order in wanted]
    assert all(r.raised and "scenarios are" in r.raised for r in results)
    assert sorted(command.results_in(Journal(tmp_path / "flights.jsonl"))) == sorted(results)
    lines = (tmp_path / "flights.jsonl").read_bytes().splitlines()
    assert sorted(json.loads(line)["seed"] for line in lines) == [1, 2, 3, 4, 5, 6]


def test_lost_flight_is_repeated_by_the_next_campaign(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (order,) = wanted = [FlightOrder("one-beacon", "none", 1)]
    lost = FlightResult(order.key, *order, 0.0, raised=f"{command.WORKER_LOST}: it died")
    whole = result("none", 1)
    for returned in (lost, whole):
        monkeypatch.setattr(command, "fly_orders", lambda *_, returned=returned: iter([returned]))
        assert command.run_campaign(wanted, tmp_path) == [returned]
    assert command.results_in(Journal(tmp_path / "flights.jsonl")) == [whole]
