"""A log is followed while it grows, message by message as it was written."""

import time

import mcap.writer
import pytest

from companion.analysis.live.follow import FollowedLog, PlayedLog, find_log, reject_foreign
from companion.records import Attitude, Event
from companion.storage import flight_log
from companion.storage.reader import LogError

S = 1_000_000_000


def writer(path, **more):
    return flight_log.Writer(
        path, metadata={}, start_unix_ns=1_700_000_000 * S, start_ns=0, block=True, **more
    )


def write(log, first, count):
    for k in range(first, first + count):
        log.record(Attitude(k * S // 10, k * S // 10, 0.001 * k, 0.0, 0.0))
        if k % 50 == 0:
            log.record(Event(k * S // 10, k * S // 10, 6, f"event {k}"))
            log.frame("udp", False, bytes([k % 256]) * 20, k * S // 10)


def expected(path):
    return [(e.topic, e.log_time, e.value) for e in flight_log.read(path, raw=True)]


def seen(messages):
    return [(m.channel.topic, m.log_ns, m.content) for m in messages]


def test_a_growing_log_is_followed_to_its_end(tmp_path):
    path, found = tmp_path / "f.mcap", []
    with writer(path, fsync_s=0.1) as log:
        write(log, 0, 100)
        active = find_log(tmp_path)
        assert active is not None and active.name == "f.mcap.active"
        while not active.stat().st_size:
            time.sleep(0.01)
        source = FollowedLog(active)
        end = time.monotonic() + 60.0
        while len(found) < 106 and time.monotonic() < end:
            found += source.poll()
            time.sleep(0.02)
        assert len(found) == 106 and not source.ended  # nothing has to be closed first
        write(log, 100, 300)
    while not source.ended:
        found += source.poll()
    assert seen(found) == expected(path)
    assert {m.channel.schema for m in found} == {"Attitude", "Event", "foxglove.Log", "mavlink"}
    source.close()


def test_a_chunk_that_is_half_written_is_waited_for(tmp_path):
    whole, part, found = tmp_path / "f.mcap", tmp_path / "part.mcap.active", []
    with writer(whole, chunk_bytes=2000) as log:
        write(log, 0, 400)
    data = whole.read_bytes()
    part.write_bytes(data[:200])
    source = FollowedLog(part)
    for size in range(200, len(data) + 97, 97):
        part.write_bytes(data[:size])
        found += source.poll()
    while not source.ended:
        found += source.poll()
    assert seen(found) == expected(whole)
    source.close()


def test_a_damaged_chunk_is_left_out(tmp_path):
    path = tmp_path / "f.mcap"
    with writer(path, chunk_bytes=2000) as log:
        write(log, 0, 400)
    every = expected(path)
    data = bytearray(path.read_bytes())
    data[data.index(b"zstd", len(data) // 2) + 60] ^= 0xFF  # within a chunk
    path.write_bytes(data)
    source, found = FollowedLog(path), []
    while not source.ended:
        found += source.poll()
    rest = seen(found)
    assert len(every) - 60 < len(rest) < len(every)
    assert set(rest) <= set(every)
    source.close()


def test_a_finished_log_plays_at_its_pace(tmp_path, monkeypatch):
    path, now = tmp_path / "f.mcap", [100.0]
    with writer(path) as log:
        write(log, 0, 100)  # 10 s
    monkeypatch.setattr(time, "monotonic", lambda: now[0])
    source = PlayedLog(path, speed=2.0)
    counts = []
    for _ in range(12):
        counts.append(sum(m.channel.schema == "Attitude" for m in source.poll()))
        now[0] += 0.5
    assert counts[:3] == [1, 10, 10] and sum(counts) == 100
    assert source.ended
    source.close()


def test_a_log_is_as_old_as_its_last_write(tmp_path, monkeypatch):
    """Its messages have the clock of its start, which may have been years off: no battery keeps it."""
    path = tmp_path / "f.mcap"
    with writer(path) as log:
        write(log, 0, 10)
    source = FollowedLog(path)
    monkeypatch.setattr(time, "time", lambda: path.stat().st_mtime + 7.0)
    assert source.since_write_s() == 7.0
    source.close()


def test_a_long_log_is_behind_until_all_of_it_is_read(tmp_path, monkeypatch):
    path, states = tmp_path / "f.mcap", []
    monkeypatch.setattr("companion.analysis.live.follow.BLOCK", 2000)
    with writer(path, chunk_bytes=1000) as log:
        write(log, 0, 400)
    source = FollowedLog(path)
    while not source.ended:
        source.poll()
        states.append(source.is_behind)
    assert states[0] and states == sorted(states, reverse=True) and not states[-1]
    source.close()


def test_what_is_to_be_shown_is_found(tmp_path):
    assert find_log(tmp_path) is None
    (tmp_path / "00001-x.mcap").write_bytes(b"x")
    assert find_log(tmp_path) is None
    assert find_log(tmp_path / "00001-x.mcap") == tmp_path / "00001-x.mcap"
    (tmp_path / "00002-x.mcap.active").write_bytes(b"x")
    assert find_log(tmp_path) == find_log(tmp_path / "00002-x.mcap") == tmp_path / "00002-x.mcap.active"
    with pytest.raises(LogError, match="there is no such log or folder"):
        find_log(tmp_path / "none")
    with pytest.raises(LogError, match="is not an MCAP log"):
        FollowedLog(tmp_path / "00001-x.mcap")


def test_a_log_of_another_program_is_not_shown(tmp_path):
    ours, other, telemetry = tmp_path / "ours.mcap", tmp_path / "other.mcap", tmp_path / "f.tlog"
    with writer(ours) as log:
        write(log, 0, 10)
    reject_foreign(ours)
    with other.open("wb") as file:
        foreign = mcap.writer.Writer(file)
        foreign.start()
        channel = foreign.register_channel("/pose", "json", 0)
        foreign.add_message(channel, log_time=1, publish_time=1, data=b"{}")
        foreign.finish()
    telemetry.write_text("what is this")
    for path, sentence in ((other, "no records of the companion"), (telemetry, "companion log convert")):
        with pytest.raises(LogError, match=sentence):
            reject_foreign(path)
