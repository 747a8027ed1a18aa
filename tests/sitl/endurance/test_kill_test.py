"""A service killed in flight: nothing older than a second is lost, and the next start makes its log whole."""

from pathlib import Path

from sitl.endurance.kill_test import AT_RISK_S, Life, _compared, kills


def test_a_few_kills_of_the_flying_service(tmp_path: Path) -> None:
    lives = kills(4, 3, tmp_path)
    flown = [life for life in lives if life.heard_s is not None]
    assert len(flown) == 4 and any(life.kept for life in flown)
    assert all(life.holes == 0 and life.lost_s <= AT_RISK_S for life in flown), lives
    assert not list(tmp_path.glob("*/*.active"))


def test_what_is_missing_is_seen() -> None:
    """The judge itself: a hole in the middle, a tail too long, and nothing of what no one listened to."""
    sent = [(5.0 - 0.5 * i, bytes([i])) for i in range(10)]
    datas = [data for _, data in sent]
    assert _compared(5.0, sent, datas) == Life(5.0, 10, 10, 0.0, 0)
    assert _compared(5.0, sent, datas[2:8]) == Life(5.0, 8, 6, 1.0, 0)
    assert _compared(5.0, sent, datas[:3] + datas[5:]).holes == 2
    assert _compared(4.5, sent, []).lost_s == 4.5
    assert _compared(None, sent, []) == Life(None, 10, 0, 0.0, 0)  # it had heard nothing that it could lose
