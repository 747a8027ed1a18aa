"""Kill test: a killed service loses at most a second of its log, and the next start recovers it."""

from pathlib import Path

import pytest

from sitl.endurance.kill_test import AT_RISK_S, KilledRun, _compare_with_log, run_kills


@pytest.mark.flight
def test_kills_of_the_service_lose_only_the_end(tmp_path: Path) -> None:
    """A second of it at most where the machine is not late, as in one flight at least; the interval on which
    that rests is tested with the log, on a clock of its own."""
    runs = run_kills(4, 3, tmp_path)
    flown = [run for run in runs if run.connected_s is not None]
    assert len(flown) == 4 and any(run.logged for run in flown)
    assert all(run.holes == 0 for run in flown), runs
    assert any(run.lost_s <= AT_RISK_S < run.connected_s for run in flown), runs
    assert not list(tmp_path.glob("*/*.active"))


def test_comparison_finds_missing_frames() -> None:
    """Missing frames inside the log and at its end count; frames sent before the service listened do not."""
    sent = [(5.0 - 0.5 * i, bytes([i])) for i in range(10)]
    datas = [data for _, data in sent]
    assert _compare_with_log(5.0, sent, datas) == KilledRun(5.0, 10, 10, 0.0, 0)
    assert _compare_with_log(5.0, sent, datas[2:8]) == KilledRun(5.0, 8, 6, 1.0, 0)
    assert _compare_with_log(5.0, sent, datas[:3] + datas[5:]).holes == 2
    assert _compare_with_log(4.5, sent, []).lost_s == 4.5
    assert _compare_with_log(None, sent, []) == KilledRun(
        None, 10, 0, 0.0, 0
    )  # never connected: nothing to lose
