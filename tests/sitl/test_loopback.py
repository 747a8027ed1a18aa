"""A whole flight in virtual time: the same every time, better than any source, within its promise."""

import hashlib
import json
import math
from pathlib import Path

import pytest
from click.testing import CliRunner

from companion.analysis import replay
from companion.analysis.error_statistics import CORRECTED, GNSS, RSBN
from companion.config import Config
from sitl.loopback import command, fly, scored, simulated
from sitl.scenarios import named

CONFIG = simulated(Config())


class Memory:
    """A log in memory: a digest of all that was sent and said."""

    def __init__(self) -> None:
        self.digest = hashlib.sha256()

    def record(self, record, channel=None) -> None:
        self.digest.update(repr(record).encode())

    def frame(self, link, outgoing, data, t_ns) -> None:
        if outgoing:
            self.digest.update(data)


SEEDS = (1, 2, 3, 4)


@pytest.fixture(scope="module")
def flights():
    """The table of each of four flights that differ in noise alone."""
    return [scored(fly(named("short", seed=seed), CONFIG)) for seed in SEEDS]


def flown_again(seed: int) -> str:
    log = Memory()
    fly(named("short", seed=seed), CONFIG, log)
    return log.digest.hexdigest()


def test_the_same_seed_gives_the_same_bytes_and_another_seed_others() -> None:
    first = flown_again(1)
    assert first == flown_again(1)
    assert first != flown_again(2)


def test_with_fixes_the_corrected_estimate_beats_the_best_of_them(flights) -> None:
    """Over the flights together: what GNSS drifts in one correlation time nobody can tell in one flight."""
    for rows in zip(*flights, strict=True):
        phase = rows[0].phase
        if phase == "neither":
            continue
        sources = [source for source, name in ((GNSS, "GNSS"), (RSBN, "RSBN")) if name in phase]

        def rms(source: str, rows=rows) -> float:
            return math.sqrt(sum(row.rms[source] ** 2 for row in rows) / len(rows))

        assert rms(CORRECTED) < min(map(rms, sources)), phase
    assert {row.phase for row in flights[0]} == {"GNSS+RSBN", "GNSS only", "RSBN only", "neither"}


def test_the_bound_holds_in_every_phase_and_without_fixes_at_every_instant(flights) -> None:
    for rows in flights:
        assert all(row.held for row in rows)
        assert [row.inside for row in rows if row.phase == "neither"] == [1.0]


def test_the_command_s_log_replays_bit_for_bit(tmp_path: Path) -> None:
    done = CliRunner().invoke(command, ["--scenario", "short", "--logs", str(tmp_path), "--json"])
    assert done.exit_code == 0, done.output
    summary = json.loads(done.stdout)
    assert {row["phase"] for row in summary["phases"]} >= {"GNSS+RSBN", "neither"}
    assert summary["times_real_time"] > 10.0  # 100 on a quiet machine; see the benchmark
    log = Path(summary["log"])
    again = CliRunner().invoke(replay.command, [str(log), "--json"])
    assert again.exit_code == 0, again.output
    found = json.loads(again.stdout)
    assert found["different"] == 0 and found["compared"] > 1000
    assert found["outputs"]["Solution"] > 1000


def test_a_log_replayed_with_another_configuration_is_different_and_says_where(tmp_path: Path) -> None:
    done = CliRunner().invoke(command, ["--scenario", "short", "--logs", str(tmp_path), "--json"])
    other = tmp_path / "other.toml"
    other.write_text("[gnss]\nsigma_m = 4.0\n")
    again = CliRunner().invoke(replay.command, [json.loads(done.stdout)["log"], "--config", str(other)])
    assert again.exit_code == 1
    assert "DIFFERENT" in again.stdout and "first difference" in again.stdout


def test_an_unknown_scenario_names_the_nearest(tmp_path: Path) -> None:
    done = CliRunner().invoke(command, ["--scenario", "shrt", "--logs", str(tmp_path)])
    assert done.exit_code == 2
    assert "did you mean short?" in done.output
