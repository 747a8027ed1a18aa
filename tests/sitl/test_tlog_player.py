import lzma
from pathlib import Path

import pytest
from click.testing import CliRunner

from companion.importers import tlog
from companion.link import dialect, frame
from sitl.tlog_player import NEVER, Player, command

SECOND = 1_000_000_000
DATA = Path(__file__).parents[1] / "data"
ENTRIES = list(tlog.Tlog(lzma.decompress((DATA / "plane_wind_change_cut.tlog.xz").read_bytes())))
DRONEKIT = list(tlog.Tlog((DATA / "dronekit_copter_cut.tlog").read_bytes()))


def all_of(player: Player) -> list[tuple[int, frame.Frame]]:
    heard, reader = [], frame.Reader()
    while (due := player.deadline()) < NEVER:
        for data in player.poll(due):
            heard += [(due, found) for found in reader.receive(data)]
    return heard


def ask(player: Player, command: int, name: str, target: int = 1) -> list:
    message = dialect.new(
        "COMMAND_LONG", target_system=target, command=command, param1=dialect.type_named(name).msgid
    )
    player.receive(frame.encode(message, 0, 1, 191))
    reader = frame.Reader()
    return [dialect.decode(found) for data in player.poll(0) for found in reader.receive(data)]


def test_every_frame_goes_out_as_it_was_and_when_it_was() -> None:
    heard = all_of(Player(ENTRIES, 5 * SECOND))
    assert [found.raw for _, found in heard] == [entry.frame.raw for entry in ENTRIES]
    first = ENTRIES[0].rx_ns
    assert all(
        due - 5 * SECOND == entry.rx_ns - first for (due, _), entry in zip(heard, ENTRIES, strict=True)
    )


def test_twice_as_fast_takes_half_as_long() -> None:
    slow, fast = Player(ENTRIES), Player(ENTRIES, speed=2.0)
    assert fast.end_ns == pytest.approx(slow.end_ns / 2, abs=2)
    assert len(all_of(fast)) == len(all_of(slow))


def test_a_part_of_the_log_is_played() -> None:
    heard = all_of(Player(ENTRIES, 0, 10.0, 20.0))
    assert 0 <= heard[0][0] < SECOND and 9 * SECOND < heard[-1][0] < 10 * SECOND


def test_nobody_else_speaks_and_no_answers_to_others() -> None:
    """A ground station and its dialogue are in the log too."""
    heard = [found for _, found in all_of(Player(DRONEKIT))]
    assert {(found.system, found.component) for found in heard} == {(1, 1)}
    assert {(e.frame.system, e.frame.component) for e in DRONEKIT} > {(1, 1)}
    assert not {found.msgid for found in heard} & {77, 111}


def test_the_last_of_a_message_is_given_for_the_asking() -> None:
    player = Player(ENTRIES, SECOND, from_s=10.0)
    origin, acknowledged = ask(player, 512, "GPS_GLOBAL_ORIGIN")  # it was said before the part that is played
    assert origin.latitude == 557500000 and acknowledged.result == 0
    assert [m.result for m in ask(player, 511, "SIM_STATE")] == [0]
    assert [m.result for m in ask(player, 511, "HIL_STATE_QUATERNION")] == [3]
    assert [m.result for m in ask(player, 43003, "SIM_STATE")] == [3]
    assert ask(player, 511, "SIM_STATE", target=7) == []


def test_answers_take_no_number_of_the_sequence() -> None:
    player, reader = Player(ENTRIES), frame.Reader()
    lost = []
    while (due := player.deadline()) < NEVER:
        ask_every = frame.encode(dialect.new("COMMAND_LONG", command=511, param1=30), 0, 1, 191)
        player.receive(ask_every)
        for data in player.poll(due):
            reader.receive(data)
        lost.append(reader.counts[1, 1].lost)
    plain = frame.Reader()
    for entry in ENTRIES:
        plain.receive(entry.frame.raw)
    assert lost[-1] == plain.counts[1, 1].lost  # the cut left frames out; the answers lost none


@pytest.mark.parametrize(
    ("data", "words"),
    [
        (b"", "is empty"),
        (b"x" * 100, "is no tlog"),
        (b"".join((e.rx_ns // 1000).to_bytes(8, "big") + e.frame.raw for e in ENTRIES[:1]), "no autopilot"),
    ],
)
def test_what_cannot_be_played_is_refused_in_a_sentence(tmp_path: Path, data: bytes, words: str) -> None:
    path = tmp_path / "bad.tlog"
    path.write_bytes(data)
    done = CliRunner().invoke(command, [str(path)])
    assert done.exit_code == 1 and words in done.output and len(done.output.splitlines()) == 1


def test_a_log_that_is_not_there_is_told() -> None:
    done = CliRunner().invoke(command, ["nothing.tlog"])
    assert done.exit_code == 1 and "nothing.tlog" in done.output and "No such file" in done.output
