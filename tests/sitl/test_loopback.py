"""Loopback flights in virtual time: reproducible, better than any source, within the guaranteed bound."""

import hashlib
import json
import math
from pathlib import Path

import pytest
from click.testing import CliRunner

from companion.analysis import replay
from companion.analysis.error_statistics import CORRECTED, GNSS, RSBN
from companion.config import Config
from sitl.loopback import command, error_table, fly_scenario, simulator_config
from sitl.scenarios import get_scenario

CONFIG = simulator_config(Config())


class DigestLog:
    """Log that computes a digest of all records and sent frames."""

    def __init__(self) -> None:
        self.digest = hashlib.sha256()

    def record(self, record, channel=None) -> None:
        self.digest.update(repr(record).encode())

    def frame(self, link, outgoing, data, t_ns) -> None:
        if outgoing:
            self.digest.update(data)


SEEDS = (1, 2)


def fly(seed: int) -> tuple[str, list]:
    """Digest of all that was recorded and sent, and error table."""
    log = DigestLog()
    flown = fly_scenario(get_scenario("short", seed=seed), CONFIG, log)
    return log.digest.hexdigest(), error_table(flown)


@pytest.fixture(scope="module")
def flights():
    """Two flights that differ in noise only."""
    return [fly(seed) for seed in SEEDS]


@pytest.fixture
def tables(flights):
    return [table for _, table in flights]


@pytest.mark.flight
def test_output_bytes_depend_on_the_seed_only(flights) -> None:
    digests = [digest for digest, _ in flights]
    assert fly(SEEDS[0])[0] == digests[0]
    assert len(set(digests)) == len(SEEDS)


@pytest.mark.flight
def test_corrected_estimate_is_better_than_the_best_fix_source(tables) -> None:
    """Pooled over flights: the GNSS drift within one correlation time is unobservable in one flight."""
    for rows in zip(*tables, strict=True):
        phase = rows[0].phase
        if phase == "neither":
            continue
        sources = [source for source, name in ((GNSS, "GNSS"), (RSBN, "RSBN")) if name in phase]

        def rms(source: str, rows=rows) -> float:
            return math.sqrt(sum(row.rms[source] ** 2 for row in rows) / len(rows))

        assert rms(CORRECTED) < min(map(rms, sources)), phase
    assert {row.phase for row in tables[0]} == {"GNSS+RSBN", "GNSS only", "RSBN only", "neither"}


@pytest.mark.flight
def test_bound_holds_in_every_phase_and_always_without_fixes(tables) -> None:
    for rows in tables:
        assert all(row.share < 1.0 and row.inside > 0.97 for row in rows)
        assert [row.inside for row in rows if row.phase == "neither"] == [1.0]


@pytest.mark.flight
@pytest.mark.long
def test_log_of_the_command_replays_bit_for_bit(tmp_path: Path) -> None:
    done = CliRunner().invoke(command, ["--scenario", "short", "--logs", str(tmp_path), "--json"])
    assert done.exit_code == 0, done.output
    summary = json.loads(done.stdout)
    assert {row["phase"] for row in summary["phases"]} >= {"GNSS+RSBN", "neither"}
    log = Path(summary["log"])
    replayed = CliRunner().invoke(replay.command, [str(log), "--json"])
    assert replayed.exit_code == 0, replayed.output
    found = json.loads(replayed.stdout)
    assert found["different"] == 0 and found["compared"] > 1000
    assert found["outputs"]["Solution"] > 1000


def test_unknown_scenario_suggests_the_nearest(tmp_path: Path) -> None:
    done = CliRunner().invoke(command, ["--scenario", "shrt", "--logs", str(tmp_path)])
    assert done.exit_code == 2
    assert "did you mean short?" in done.output


@pytest.mark.parametrize(("arguments", "correctors"), [([], ("stars",)), (["--preset", "px4"], ())])
def test_correctors_of_a_scenario_are_used_by_an_ins_of_its_own_only(
    monkeypatch, tmp_path: Path, arguments, correctors
) -> None:
    """A preset without one flies the scenario all the same."""

    class Flown(Exception):
        pass

    def fly(scenario, config, log, progress):
        raise Flown(config.inertial.correctors)

    monkeypatch.setattr("sitl.loopback.fly_scenario", fly)
    done = CliRunner().invoke(command, ["--scenario", "stars", "--logs", str(tmp_path), *arguments])
    assert isinstance(done.exception, Flown) and done.exception.args == (correctors,)
