"""A campaign: what was flown is kept, what is kept is not flown again, and the table says what happened."""

from __future__ import annotations

import dataclasses
import json
import os
import signal
from pathlib import Path

import pytest
from click.testing import CliRunner

from companion.config import Config
from companion.records import Event, Solution
from sitl import loopback
from sitl.campaign import command, flight
from sitl.campaign.command import Limits
from sitl.campaign.flight import KINDS, SCENARIOS, Order, Result, attempt
from sitl.faults import NAMES, Fault
from sitl.scenarios import Rates, named


def result(fault: str, seed: int, **changes: object) -> Result:
    order = Order("one-beacon", fault, seed)
    return Result(order.key, *order, 720.0, 2.0)._replace(**{"solutions": 3600, "quiet_s": 240.0, **changes})


@pytest.fixture(scope="module")
def flown(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, list[Result]]:
    """Six flights, in this process."""
    folder = tmp_path_factory.mktemp("campaign")
    faults = ("none", "gnss-jump", "gnss-spoof-5", "gnss-jam", "beacon-bias", "ins-reset")
    wanted = command.orders(("one-beacon",), faults, 1)
    return folder, command.campaign(wanted, folder, quiet=True)


def test_a_flight_without_faults_is_quiet_and_near(flown: tuple[Path, list[Result]]) -> None:
    quiet = flown[1][0]
    assert quiet.raised is None
    assert quiet.largest_m < 15.0
    assert (quiet.detected_s, quiet.excluded_s, quiet.alarms, quiet.misleading_s) == (None, None, 0, 0.0)


def test_gross_faults_are_seen_at_once_and_do_no_harm(flown: tuple[Path, list[Result]]) -> None:
    for r in flown[1][1:]:
        assert r.raised is None
        assert r.detected_s is not None, r.key
        assert r.detected_s < 10.0, r.key
        assert r.before_m < 100.0, r.key


def test_the_same_order_gives_the_same_numbers(flown: tuple[Path, list[Result]]) -> None:
    again = attempt(Order("one-beacon", "gnss-jump", 1))
    assert again._replace(took_s=0.0) == flown[1][1]._replace(took_s=0.0)


def test_what_is_stored_is_not_flown_again(
    flown: tuple[Path, list[Result]], monkeypatch: pytest.MonkeyPatch
) -> None:
    """A campaign cut short, its last line torn: only that flight and the missing ones are flown."""
    folder, results = flown
    path = folder / "flights.jsonl"
    lines = path.read_bytes().splitlines(keepends=True)
    assert len(lines) == len(results) == 6
    path.write_bytes(b"".join(lines[:4]) + lines[4][:25])
    asked: list[Order] = []

    def remembered(order: Order) -> Result:
        asked.append(order)
        return next(r for r in results if r.key == order.key)

    monkeypatch.setattr(command, "attempt", remembered)
    wanted = [Order(r.scenario, r.fault, r.seed) for r in results]
    assert command.campaign(wanted, folder, quiet=True) == results
    assert asked == wanted[4:]
    assert [json.loads(line)["key"] for line in path.read_bytes().splitlines()] == [r.key for r in results]


def test_a_flight_that_raises_is_a_result() -> None:
    lost = attempt(Order("nowhere", "none", 1))
    assert lost.raised is not None
    assert "scenarios are one-beacon" in lost.raised
    assert not command.table([lost], Limits())[0].passed


def test_the_table_counts_by_the_stated_limits() -> None:
    results = [
        result("gnss-jump", 1, detected_s=1.0, excluded_s=3.0, before_m=20.0, largest_m=50.0),
        result("gnss-jump", 2, detected_s=5.0, excluded_s=6.0, before_m=40.0, largest_m=400.0),
        result("beacon-bias", 1, largest_m=301.0, misleading_s=30.0, alarms=1),
        result("gnss-jam", 1, detected_s=3.0, rms_error=30.0, rms_bound=40.0),
        result("gnss-jam", 2, detected_s=3.0, rms_error=60.0, rms_bound=40.0),
    ]
    jump, bias, jam = command.table(results, Limits())
    assert (jump.flights, jump.detected, jump.median_s, jump.slowest_s) == (2, 2, 3.0, 5.0)
    assert (jump.before_m, jump.largest_m, jump.harmful, jump.passed) == (40.0, 400.0, 0, True)
    assert (bias.detected, bias.harmful, bias.misleading, bias.alarms_per_hour) == (0, 1, 1, 15.0)
    assert not bias.passed
    assert jam.bound_held is False


def test_a_slow_consumer_does_not_move_the_clock() -> None:
    """An autopilot that reads every ten seconds once moved it by half a second, and GNSS was blamed."""
    flown = attempt(Order("one-beacon", "slow-consumer", 1))
    assert flown.raised is None
    assert (flown.excluded_s, flown.wrong, flown.alarms) == (None, 0, 0)
    assert flown.largest_m < 15.0


@pytest.mark.parametrize(
    ("scenario", "name"),
    [
        ("one-beacon", "link-late"),
        ("air-data", "link-late"),
        ("one-beacon", "clock-jump"),
        ("one-beacon", "reboot-turning"),
    ],
)
def test_a_link_that_is_late_and_a_clock_that_leaps_are_told_and_move_nothing(
    scenario: str, name: str
) -> None:
    """Once a late link moved the clock, and a clock set back was a reboot: 220 m, and GNSS was blamed. So it
    was where the channel begun anew was a hundred metres off, five times what it claims.
    """
    flown = attempt(Order(scenario, name, 1))
    assert flown.raised is None
    assert (flown.excluded_s, flown.wrong, flown.alarms, flown.misleading_s) == (None, 0, 0, 0.0)
    assert flown.detected_s is not None and flown.detected_s < 10.0
    assert flown.largest_m < 15.0


@pytest.mark.parametrize("name", ["gnss-stale", "beacon-frozen", "ins-frozen"])
def test_old_numbers_under_new_times_are_told_at_once_and_do_no_harm(name: str) -> None:
    flown = attempt(Order("one-beacon", name, 1))
    assert flown.raised is None
    assert flown.detected_s is not None and flown.detected_s < 3.0
    assert flown.largest_m < 100.0


def test_when_solutions_cease_it_is_told_and_when_they_come_again() -> None:
    """The position freezes while the attitude goes on: over the link, as the pilot hears it."""
    fault = Fault("ins-frozen", 60.0, 75.0)
    scenario = dataclasses.replace(named("short"), faults=(fault,), rates=Rates(imu=1.0, truth=1.0))
    kept = loopback.fly(scenario, loopback.simulated(Config())).kept
    told = [(r.rx_ns * 1e-9 - 1000.0, r.text) for r in kept if isinstance(r, Event)]
    (ceased,) = [t for t, text in told if "the inertial channel gives nothing" in text]
    (again,) = [t for t, text in told if text == "solutions again"]
    assert 60.0 < ceased < 65.0 and 75.0 < again < 78.0
    assert not [r for r in kept if isinstance(r, Solution) and 61.0 < r.rx_ns * 1e-9 - 1000.0 < 75.0]


def test_every_fault_of_the_simulator_is_flown() -> None:
    flown = {kind.fault.name for kind in KINDS.values() if kind.fault}
    assert set(NAMES) - flown <= {"cut"}  # of the stream, tried elsewhere
    for name in SCENARIOS:
        for fault in KINDS:
            assert flight.ordered(Order(name, fault, 1)).duration_s >= 600.0


def test_the_command_prints_and_ends_by_the_limits(flown: tuple[Path, list[Result]]) -> None:
    folder = str(flown[0])
    options = ["--fault", "none", "--fault", "gnss-jump", "--workers", "0", "--results", folder, "--json"]
    told = CliRunner().invoke(command.command, options)
    assert told.exit_code == 0, told.output
    assert [line["fault"] for line in json.loads(told.stdout)] == ["none", "gnss-jump"]
    strict = CliRunner().invoke(command.command, [*options[:-1], "--harmless-m", "0.001"])
    assert strict.exit_code == 1
    assert "gnss-jump" in strict.output


def test_dask_brings_back_every_flight(tmp_path: Path) -> None:
    """One worker process; the flights end at once for want of their scenario, which is all that is asked."""
    pytest.importorskip("distributed", reason="the extra `campaign` is not installed")
    wanted = [Order("nowhere", "none", seed) for seed in range(8)]
    results = command.campaign(wanted, tmp_path, workers=1, quiet=True)
    assert [r.key for r in results] == [order.key for order in wanted]
    assert all(r.raised and "scenarios are" in r.raised for r in results)
    assert sorted(command.stored(tmp_path / "flights.jsonl")) == sorted(results)


def test_a_worker_killed_in_flight_loses_no_flight(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """SIGKILL under the third of six flights; the nanny starts another worker, and it is flown there."""
    pytest.importorskip("distributed", reason="the extra `campaign` is not installed")
    killed = tmp_path / "killed"

    def fly(order: Order) -> Result:
        if order.seed == 3 and not killed.exists():
            killed.touch()
            os.kill(os.getpid(), signal.SIGKILL)
        return Result(order.key, *order, 720.0, 2.0)

    monkeypatch.setattr(command, "attempt", fly)
    wanted = [Order("one-beacon", "none", seed) for seed in range(1, 7)]
    results = command.campaign(wanted, tmp_path, workers=1, quiet=True)
    assert killed.exists()
    assert results == [Result(order.key, *order, 720.0, 2.0) for order in wanted]
    lines = (tmp_path / "flights.jsonl").read_bytes().splitlines()
    assert sorted(json.loads(line)["seed"] for line in lines) == [1, 2, 3, 4, 5, 6]


def test_a_flight_that_no_worker_survived_is_flown_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (order,) = wanted = [Order("one-beacon", "none", 1)]
    lost, flown = Result(order.key, *order, 0.0, 0.0, raised=f"{command.LOST}: it died"), result("none", 1)
    for came in (lost, flown):
        monkeypatch.setattr(command, "run", lambda *_, came=came: iter([came]))
        assert command.campaign(wanted, tmp_path, quiet=True) == [came]
    assert command.stored(tmp_path / "flights.jsonl") == [flown]
