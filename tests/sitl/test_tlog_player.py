import lzma
from pathlib import Path

import pytest
from click.testing import CliRunner

from companion.importers import tlog
from companion.link import dialect, frame
from sitl.tlog_player import NEVER, TlogPlayer, command

SECOND = 1_000_000_000
DATA = Path(__file__).parents[1] / "data"
ENTRIES = list(tlog.Tlog(lzma.decompress((DATA / "plane_wind_change_cut.tlog.xz").read_bytes())))
DRONEKIT = list(tlog.Tlog((DATA / "dronekit_copter_cut.tlog").read_bytes()))


def play_all(player: TlogPlayer) -> list[tuple[int, frame.Frame]]:
    played, reader = [], frame.Reader()
    while (due := player.deadline()) < NEVER:
        for data in player.poll(due):
            played += [(due, found) for found in reader.receive(data)]
    return played


def request(player: TlogPlayer, command: int, name: str, target: int = 1) -> list:
    message = dialect.new(
        "COMMAND_LONG", target_system=target, command=command, param1=dialect.type_named(name).msgid
    )
    player.receive(frame.encode(message, 0, 1, 191))
    reader = frame.Reader()
    return [dialect.decode(found) for data in player.poll(0) for found in reader.receive(data)]


def test_frames_are_played_unchanged_at_recorded_times() -> None:
    played = play_all(TlogPlayer(ENTRIES, 5 * SECOND))
    assert [found.raw for _, found in played] == [entry.frame.raw for entry in ENTRIES]
    first = ENTRIES[0].rx_ns
    assert all(
        due - 5 * SECOND == entry.rx_ns - first for (due, _), entry in zip(played, ENTRIES, strict=True)
    )


def test_double_speed_halves_the_duration() -> None:
    slow, fast = play_all(TlogPlayer(ENTRIES)), play_all(TlogPlayer(ENTRIES, speed=2.0))
    assert fast[-1][0] == pytest.approx(slow[-1][0] / 2, abs=2)
    assert len(fast) == len(slow)


def test_part_of_the_log_is_played() -> None:
    played = play_all(TlogPlayer(ENTRIES, 0, 10.0, 20.0))
    assert 0 <= played[0][0] < SECOND and 9 * SECOND < played[-1][0] < 10 * SECOND


def test_a_part_beyond_the_log_is_rejected_with_its_length() -> None:
    lasts_s = (ENTRIES[-1].rx_ns - ENTRIES[0].rx_ns) / SECOND
    with pytest.raises(ValueError, match=f"this part of the log, which lasts {lasts_s:.0f} s: choose"):
        TlogPlayer(ENTRIES, from_s=5000.0)


def test_only_autopilot_frames_without_old_answers_are_played() -> None:
    """The log also holds frames of a ground station and answers to it."""
    played = [found for _, found in play_all(TlogPlayer(DRONEKIT))]
    assert {(found.system, found.component) for found in played} == {(1, 1)}
    assert {(e.frame.system, e.frame.component) for e in DRONEKIT} > {(1, 1)}
    assert not {found.msgid for found in played} & {77, 111}


def test_last_message_is_sent_on_request() -> None:
    player = TlogPlayer(ENTRIES, SECOND, from_s=10.0)
    origin, acknowledged = request(player, 512, "GPS_GLOBAL_ORIGIN")  # sent before the part that is played
    assert origin.latitude == 557500000 and acknowledged.result == 0
    assert [m.result for m in request(player, 511, "SIM_STATE")] == [0]
    assert [m.result for m in request(player, 511, "HIL_STATE_QUATERNION")] == [3]
    assert [m.result for m in request(player, 43003, "SIM_STATE")] == [3]
    assert request(player, 511, "SIM_STATE", target=7) == []


def test_answers_do_not_advance_the_sequence() -> None:
    player, reader = TlogPlayer(ENTRIES), frame.Reader()
    lost = []
    while (due := player.deadline()) < NEVER:
        request_frame = frame.encode(dialect.new("COMMAND_LONG", command=511, param1=30), 0, 1, 191)
        player.receive(request_frame)
        for data in player.poll(due):
            reader.receive(data)
        lost.append(reader.counts[1, 1].lost)
    plain = frame.Reader()
    for entry in ENTRIES:
        plain.receive(entry.frame.raw)
    assert lost[-1] == plain.counts[1, 1].lost  # gaps of the thinned log only; answers add none


@pytest.mark.parametrize(
    ("data", "words"),
    [
        (b"", "is empty"),
        (b"x" * 100, "is not a tlog"),
        (
            b"".join((e.rx_ns // 1000).to_bytes(8, "big") + e.frame.raw for e in ENTRIES[:1]),
            "no HEARTBEAT of an autopilot",
        ),
    ],
)
def test_invalid_log_is_reported_in_one_line(tmp_path: Path, data: bytes, words: str) -> None:
    path = tmp_path / "bad.tlog"
    path.write_bytes(data)
    done = CliRunner().invoke(command, [str(path)])
    assert done.exit_code == 1 and words in done.output and len(done.output.splitlines()) == 1


def test_missing_log_is_reported() -> None:
    done = CliRunner().invoke(command, ["nothing.tlog"])
    assert done.exit_code == 1 and done.output == "companion: nothing.tlog: no such log\n"


def test_a_start_after_every_log_is_rejected(tmp_path: Path) -> None:
    log = tmp_path / "x.tlog"
    log.write_bytes(b"")
    done = CliRunner().invoke(command, [str(log), "--from", "1e300"])
    assert done.exit_code == 2 and "1e+300 is not in the range" in done.stderr
