"""Flight log: records round trip despite failing disks, truncation and kills."""

import dataclasses
import errno
import io
import itertools
import json
import math
import os
import resource
import signal
import struct
import subprocess
import sys
import tarfile
import threading
import time
import tracemalloc
from contextlib import suppress
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import lz4.frame
import msgspec
import pytest
import zstandard
from click.testing import CliRunner
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.opcode import Opcode
from mcap.reader import NonSeekingReader, make_reader
from mcap.records import Channel, Chunk, DataEnd, Footer, Header, Message, Schema
from mcap.stream_reader import StreamReader

from companion import records as r
from companion.analysis.log_command import group
from companion.storage import flight_log, location_fix, retention
from companion.storage.flight_log import Writer, info, metadata, read
from companion.storage.mcap_file import MAGIC, DiskFile, encode_records
from companion.storage.reader import LogError, open_log
from companion.storage.recovery import recover

SUITE = Path(__file__).parents[1] / "data" / "mcap_conformance.tar.xz"
START = {"start_unix_ns": 1_700_000_000_000_000_000, "start_ns": 12_345_678_901}
T = START["start_ns"]

EVERY_KIND = [
    r.Imu(T, T + 1, 0, (0.1, -0.2, -9.806649999999999), (1e-300, -0.0, 5e-324)),
    r.Attitude(T + 2, T + 3, 0.1, -0.2, 3.141592653589793, (1.0, 2.0, 3.0)),
    r.Gnss(T + 4, T + 5, 1, 123456, 3, 0.9, -2.1, 312.5, 1.5, 3.0, (1.0, 2.0, -3.0), 0.1, 12, 0.9, 330.1),
    r.LocalPosition(T + 6, T + 7, (1.0, 2.0, 3.0), (4.0, 5.0, 6.0)),
    r.LocalOrigin(T + 8, T + 9, 0.9, -2.1, 10.0),
    r.HomePosition(T + 10, T + 11, 0.9, -2.1, 10.0),
    r.GlobalPosition(T + 12, T + 13, 0.9, -2.1, 10.0, (1.0, 2.0, 3.0), 5.0),
    r.AirData(T + 14, T + 15, 31.4),
    r.Wind(T + 16, T + 17, (3.0, -4.0, 0.1)),
    r.Pressure(T + 18, T + 19, 101325.0, None, 288.15),
    r.FilterStatus(T + 20, T + 21, 831, False, 0.05),
    r.AirspeedSensor(T + 20, T + 21, True, True),
    r.Vehicle(T + 20, T + 21, multirotor=True, flying=False),
    r.GnssIntegrity(T + 20, T + 21, 0, 1, 2),
    r.SystemTime(T + 22, T + 23, 10**9),
    r.RsbnFix(T + 24, T + 25, 7, 0.91, -2.0, 120.0, None, 81234.5, 0.0044, 200.0),
    r.Fix(T + 26, T + 26, 0.9, -2.1, 3.0, (1.0, 2.0), (4.0, 0.5, 9.0), 6, 1.2, 2, 4),
    r.Rejection(T + 27, T + 27, "gnss", "too far", 12.5, 9.21),
    r.Reset(T + 28, T + 28, "filter", "the covariance lost its sign"),
    r.Event(T + 29, T + 29, 4, "RSBN beacon 7 lost ✈"),
    r.Solution(
        T + 30, T + 30, r.Mode.PREDICTING, "minimax", 0.9, -2.1, 300.0, (30.0, 0.1, -1.0),
        (16.0, 1.0, 2.0, 25.0, 3.0, 36.0), (637.0, -400.0), (0.5, -0.25), 5, 120.5, (700.0, 800.0),
        ahead=(r.Prediction(60.0, (1.0, 2.0), (0.5, 0.6), (1.5, 2.5)),),
    ),
    r.LinkState(T + 31, T + 31, "udp", True, 1000, 3, 1, 0, -5, 900_000),
    r.RangeDifference(T + 31, T + 31, 7, 0.9, -2.1, 100.0, 0.91, -2.2, 50.0, 1234.5, 30.0),
    r.StarFix(T + 31, T + 31, 3, 0.2, 1.1, 0.7, None, 1e-4, 2e-4),
    r.SecondIns(T + 31, T + 31, 2, 0.9, -2.1),
    r.Smoothed(T + 31, T + 31, 0.9, -2.1, 333.0, (1.0, 0.1, 2.0), (3.0, -4.0)),
    r.Reboot(T + 31, T + 31, 1),
    r.TimeStep(T + 31, T + 31, 1, 0.625),
    r.Tuning(T + 32, T + 32, '[gnss]\nsigma_m = 3.0\n'),
    r.Resumed(T + 33, T + 33, '[gnss]\nsigma_m = 3.0\n', bytes(range(256))),
    r.Truth(T + 32, T + 32, 0.9, -2.1, 333.0, (1.0, 2.0, 3.0), (0.1, 0.2, 0.3)),
]  # fmt: skip


def imu(i: int) -> r.Imu:
    return r.Imu(T + i * 10**7, T + i * 10**7 + 11, 0, (0.1 * i, 0.2, -9.81), (1e-3 / (i + 1), 2e-3, 0.0))


def wait_until(condition) -> None:
    end = time.monotonic() + 60.0
    while not condition():
        assert time.monotonic() < end, "condition not met in time"
        time.sleep(0.01)


# -- round trip ----------------------------------------------------------------------------------------------


def test_records_and_frames_round_trip_bit_for_bit(tmp_path):
    assert {type(one) for one in EVERY_KIND} == set(r.BY_NAME.values())
    path = tmp_path / "x.mcap"
    with Writer(path, metadata={"configuration": {"toml": "a = 1\n"}}, **START) as log:
        for one in EVERY_KIND:
            log.record(one)
        log.record(EVERY_KIND[0], "/replay/Imu")
        log.frame("udp", False, b"\xfd\x00\xff", T + 40)
        log.frame("udp", True, b"", T + 41)
        assert log.path == path and not path.exists()
    assert (log.dropped, log.trouble) == (0, None)
    entries = list(read(path))
    ours = [e for e in entries if not e.topic.startswith(("/map/", "/log"))]
    assert [e.value for e in ours] == [*EVERY_KIND, EVERY_KIND[0], b"\xfd\x00\xff", b""]
    assert [r.encode(e.value) for e in ours[: len(EVERY_KIND)]] == [r.encode(one) for one in EVERY_KIND]
    shift = START["start_unix_ns"] - START["start_ns"]
    assert [e.log_time - shift for e in ours[: len(EVERY_KIND)]] == [one.rx_ns for one in EVERY_KIND]
    topics = [e.topic for e in ours]
    assert {"/in/Gnss", "/out/Solution", "/truth/Truth", "/link/LinkState"} <= set(topics)
    assert topics[-3:] == ["/replay/Imu", "/mavlink/udp/rx", "/mavlink/udp/tx"]
    assert metadata(path) == info(path).metadata
    assert metadata(path)["configuration"] == {"toml": "a = 1\n"}
    assert metadata(path)["log"]["start_ns"] == str(START["start_ns"])


def test_mcap_package_reads_the_same_messages(tmp_path):
    path = tmp_path / "x.mcap"
    with Writer(path, metadata={"a": {"b": "c"}}, chunk_bytes=2000, **START) as log:
        for one in itertools.islice(itertools.cycle(EVERY_KIND), 500):
            log.record(one)
    ours = [(e.topic, e.log_time, e.value) for e in read(path, raw=True)]
    with path.open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True)
        # its order is by time; that of the file is the order of writing
        theirs = [(c.topic, m.log_time, m.data) for _, c, m in reader.iter_messages()]
        assert sorted(theirs) == sorted(ours)
        assert {m.name: m.metadata for m in reader.iter_metadata()} == metadata(path)
        summary = reader.get_summary()
    found = info(path)
    assert summary.statistics.message_count == found.messages == len(ours)
    assert summary.statistics.chunk_count == found.chunks == len(summary.chunk_indexes) > 10
    assert summary.statistics.message_start_time == found.start_ns
    assert summary.statistics.message_end_time == found.end_ns
    with path.open("rb") as stream:
        stream_records = list(StreamReader(stream, validate_crcs=True).records)
    assert [x.data for x in stream_records if type(x).__name__ == "Message"] == [x[2] for x in ours]


def test_map_positions_are_limited_to_two_per_second(tmp_path):
    path = tmp_path / "x.mcap"
    solution = next(one for one in EVERY_KIND if isinstance(one, r.Solution))

    with Writer(path, metadata={}, **START) as log:
        for i in range(101):
            t_ns = T + i * 10**8
            log.record(msgspec.structs.replace(solution, t_ns=t_ns, rx_ns=t_ns))
    points = {"/map/solution": [], "/map/inertial": []}
    for entry in read(path):
        if entry.topic in points:
            points[entry.topic].append(json.loads(entry.value))
    assert [len(v) for v in points.values()] == [21, 21]
    corrected, inertial = points["/map/solution"][0], points["/map/inertial"][0]
    # 637 m north and 400 m west of it, by the radii of the ellipsoid at 51.6 degrees
    assert (inertial["latitude"] - corrected["latitude"]) * 111_258 == pytest.approx(637.0, rel=1e-3)
    assert (inertial["longitude"] - corrected["longitude"]) * 69_340 == pytest.approx(-400.0, rel=2e-3)
    nn, ne, nd, ee, ed, dd = solution.covariance
    assert corrected["position_covariance"] == [ee, ne, -ed, ne, nn, -nd, -ed, -nd, dd]
    assert corrected["position_covariance_type"] == location_fix.KNOWN
    assert set(corrected) == set(location_fix.SCHEMA["properties"])
    start_s, _ = divmod(START["start_unix_ns"] + 30, 10**9)
    assert corrected["timestamp"]["sec"] == start_s


def test_receiver_without_a_fix_is_not_on_the_map(tmp_path):
    """It states latitude and longitude 0, and must not take the place of one that has a fix."""
    path = tmp_path / "x.mcap"
    fix = next(one for one in EVERY_KIND if isinstance(one, r.Gnss))

    with Writer(path, metadata={}, **START) as log:
        for t_ns in range(T, T + 10**9, 10**8):
            log.record(
                msgspec.structs.replace(fix, t_ns=t_ns, rx_ns=t_ns, receiver=1, fix=1, lat=0.0, lon=0.0)
            )
            log.record(msgspec.structs.replace(fix, t_ns=t_ns, rx_ns=t_ns, receiver=0))
    found = [json.loads(entry.value) for entry in read(path) if entry.topic == "/map/gnss"]
    assert [one["latitude"] for one in found] == [pytest.approx(math.degrees(fix.lat))] * 2
    assert info(path).counts["/in/Gnss"] == 20


def test_implausible_times_round_trip(tmp_path):
    mad = [r.Reset(-(2**62), 2**63 - 1, "x", "a"), r.Reset(2**63 - 1, -(2**62), "x", "b")]
    with Writer(tmp_path / "x.mcap", metadata={}, start_unix_ns=0, start_ns=2**60) as log:
        for one in mad:
            log.record(one)
    assert [e.value for e in read(tmp_path / "x.mcap")] == mad


# -- torn logs -----------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def small(tmp_path_factory) -> bytes:
    path = tmp_path_factory.mktemp("small") / "x.mcap"
    with Writer(path, metadata={"c": {"k": "v"}}, chunk_bytes=150, **START) as log:
        for i in range(6):
            log.record(r.Reset(T + i, T + i, "x", f"event {i}"))
            log.frame("udp", i % 2 == 0, bytes(range(i)), T + i)
    return path.read_bytes()


def test_log_truncated_at_any_byte_is_readable_and_recoverable(tmp_path, small):
    whole, cut = tmp_path / "whole.mcap", tmp_path / "x.mcap.active"
    whole.write_bytes(small)
    entries = list(read(whole))
    ends, have = [], 0  # (where a chunk ends, messages up to there)

    with open_log(whole) as source:
        for record in source.records():
            if record.opcode == Opcode.CHUNK:
                have += len(source.unpack(record.parse()))
                ends.append((record.end, have))
    assert have == len(entries) == 12 and len(ends) >= 4
    header_end = 8 + 9 + int.from_bytes(small[9:17], "little")
    for size in range(len(small)):
        cut.write_bytes(small[:size])
        if size < header_end:
            with pytest.raises(LogError):
                list(read(cut))
            with pytest.raises(LogError):
                recover(cut)
            continue
        least = max((n for end, n in ends if end <= size), default=0)
        got = list(read(cut))
        assert got == entries[: len(got)] and len(got) >= least, size
        found = info(cut)
        assert not found.closed and found.messages == len(got)
        if size % 9 and size not in {e for end, _ in ends for e in (end - 1, end, end + 1)}:
            continue  # sample the sizes: a recovery syncs the disk several times
        saved = recover(cut)
        assert saved.path == tmp_path / "x.mcap" and not cut.exists()
        assert saved.messages == len(got)
        assert list(read(saved.path)) == got and info(saved.path).closed
        with saved.path.open("rb") as stream:
            assert sum(1 for _ in NonSeekingReader(stream, validate_crcs=True).iter_messages()) == len(got)
        saved.path.unlink()


class KilledError(BaseException):
    """Simulated end of the process."""


class LimitedCalls:
    """Allows a number of system calls that change a log and a part of the next write, then raises."""

    def __init__(self, patch: pytest.MonkeyPatch, steps: int, part: float) -> None:
        self.steps, self.part, self.written = steps, part, 0
        for name in ("ftruncate", "pwrite", "fsync", "fdatasync", "replace"):
            patch.setattr(os, name, partial(self.call, name, getattr(os, name)))

    def call(self, name, real, *arguments):
        self.steps -= 1
        if self.steps < 0:
            if name == "pwrite":
                fd, data, at = arguments
                real(fd, data[: int(len(data) * self.part)], at)
            raise KilledError
        result = real(*arguments)
        self.written += result if name == "pwrite" else 0
        return result


@settings(max_examples=300)
@given(cut=st.integers(0, 900), steps=st.integers(0, 8), part=st.floats(0, 1))
def test_kill_during_recovery_leaves_a_log_that_reads_as_before(tmp_path_factory, small, cut, steps, part):
    path = tmp_path_factory.mktemp("killed") / "x.mcap.active"
    path.write_bytes(small[: len(small) - cut])
    entries = list(read(path))
    with pytest.MonkeyPatch.context() as patch:
        LimitedCalls(patch, steps, part)
        with suppress(KilledError):
            recover(path)
    left = path if path.exists() else path.with_suffix("")
    assert list(read(left)) == entries
    if left == path:
        assert recover(path).messages == len(entries)
    assert [one.name for one in path.parent.iterdir()] == ["x.mcap"]
    assert list(read(path.with_suffix(""))) == entries and info(path.with_suffix("")).closed


def test_recovery_writes_only_after_the_last_chunk(tmp_path, small):
    """The recovered log is the same file and has the same bytes; a complete log is only renamed."""
    path = tmp_path / "x.mcap.active"
    with io.BytesIO(small) as stream:
        summary = make_reader(stream).get_summary()
    last = max(index.chunk_start_offset + index.chunk_length for index in summary.chunk_indexes)
    for cut in (0, 30, len(small) - small.rindex(encode_records([DataEnd(0)])), len(small) - last):
        path.write_bytes(small[: len(small) - cut])
        node = path.stat().st_ino
        with pytest.MonkeyPatch.context() as patch:
            power = LimitedCalls(patch, 100, 0.0)
            assert recover(path).messages == 12
        assert power.written <= (len(small) - last if cut else 0)
        assert (tmp_path / "x.mcap").read_bytes() == small and (tmp_path / "x.mcap").stat().st_ino == node
        (tmp_path / "x.mcap").unlink()


def test_damaged_log_is_unchanged_until_its_copy_is_complete(tmp_path, small):
    path = tmp_path / "x.mcap.active"
    for at in range(8, small.rindex(encode_records([DataEnd(0)])), 7):
        damaged = bytearray(small[:-20])
        damaged[at] ^= 0xFF
        path.write_bytes(damaged)
        kept = None
        with suppress(LogError):
            kept = list(read(path))
        with pytest.MonkeyPatch.context() as patch, suppress(LogError, KilledError):
            LimitedCalls(patch, 2, 0.5)
            recover(path)
        if kept is not None and path.exists():
            assert list(read(path))[: len(kept)] == kept, at
        with suppress(LogError):
            recover(path)
            assert info(tmp_path / "x.mcap").closed
            assert info(tmp_path / "x.mcap").messages >= len(kept or ()), at
        for one in tmp_path.iterdir():
            one.unlink()


def test_messages_outside_chunks_are_recovered_into_one(tmp_path):
    channel = Channel(id=1, topic="t", message_encoding="t", metadata={}, schema_id=0)
    loose = [Message(1, i, b"%d" % i, i, i) for i in range(10)]
    for name in ("x.mcap", "y.mcap.active"):
        path = tmp_path / name
        path.write_bytes(MAGIC + encode_records([Header("", ""), channel, *loose])[:-10])
        assert [e.value for e in read(path)] == [b"%d" % i for i in range(9)]
        saved = recover(path)
        assert saved.messages == 9 and path.exists() == (name == "x.mcap")
        with saved.path.open("rb") as stream:
            assert len(list(make_reader(stream).iter_messages())) == 9
    assert {one.name for one in tmp_path.iterdir()} == {"x.mcap", "x.recovered.mcap", "y.mcap"}


def test_damaged_byte_is_reported_and_the_rest_is_recovered(tmp_path, small):
    path = tmp_path / "x.mcap"
    at = small.index(b"\x28\xb5\x2f\xfd") + 30  # inside the first compressed chunk
    path.write_bytes(small[:at] + bytes([small[at] ^ 0xFF]) + small[at + 1 :])
    with pytest.raises(LogError, match="damaged near byte"):
        list(read(path))
    with pytest.raises(LogError, match="damaged near byte"):
        info(path)
    saved = recover(path)
    assert 0 < saved.messages < 12 and saved.bytes_lost > 0
    assert info(saved.path).messages == saved.messages


@settings(max_examples=1500)
@given(data=st.data())
def test_arbitrary_bytes_raise_only_log_error(tmp_path_factory, small, data):
    kind = data.draw(st.integers(0, 2))
    if kind == 0:
        junk = data.draw(st.binary(max_size=200))
    elif kind == 1:
        junk = MAGIC + data.draw(st.binary(max_size=200))
    else:
        edits = data.draw(
            st.lists(st.tuples(st.integers(8, len(small) - 1), st.integers(0, 255)), max_size=8)
        )
        changed = bytearray(small)
        for at, value in edits:
            changed[at] = value
        junk = bytes(changed)
    path = tmp_path_factory.getbasetemp() / "junk.mcap"
    path.write_bytes(junk)
    for look in (lambda: list(read(path)), lambda: info(path), lambda: metadata(path), lambda: recover(path)):
        try:
            look()
        except LogError as error:
            assert "\n" not in str(error) and str(path.parent) in str(error)


def test_invalid_log_is_reported_in_one_sentence(tmp_path):
    for name, content, words in (
        ("empty", b"", "is empty"),
        ("foreign.mcap", b"\x7fELF" * 20, r"is not an MCAP log \(.*magic\)$"),
        ("foreign.tlog", b"\x7fELF" * 20, "is not an MCAP log .* convert it first"),
        ("short", MAGIC[:5], "is truncated within its header"),
        ("zeros", MAGIC + bytes(100), "is truncated within its header"),
    ):
        (tmp_path / name).write_bytes(content)
        with pytest.raises(LogError, match=words):
            list(read(tmp_path / name))
    with pytest.raises(LogError, match="cannot be read: No such file"):
        info(tmp_path / "missing")
    bomb = Chunk("zstd", b"", 0, 0, uncompressed_crc=0, uncompressed_size=2**62)
    log = MAGIC + encode_records([Header("", ""), bomb, Footer(0, 0, 0)]) + MAGIC
    (tmp_path / "bomb").write_bytes(log)
    with pytest.raises(LogError, match="states"):
        list(read(tmp_path / "bomb"))


def chunk_log(compression: str, data: bytes, stated: int, repeats: int = 1) -> bytes:
    definitions = [
        *(Header("", ""), Schema(id=1, data=b"{}", encoding="jsonschema", name="Event")),
        Channel(id=1, topic="/out/Event", message_encoding="json", metadata={}, schema_id=1),
    ]
    bomb = Chunk(compression, data, 0, 0, uncompressed_crc=0, uncompressed_size=stated)
    return MAGIC + encode_records([*definitions, *[bomb] * repeats, Footer(0, 0, 0)]) + MAGIC


EMPTY, LONG = (
    encode_records([Message(channel_id=1, log_time=5, data=bytes(size), publish_time=5, sequence=0)])
    for size in (0, 10_000)
)


@pytest.mark.parametrize(
    ("log", "words"),
    [
        (chunk_log("lz4", lz4.frame.compress(bytes(10**8)), 100), "size differs"),
        (chunk_log("zstd", zstandard.compress(bytes(10**8)), 100), "size differs"),
        (chunk_log("", bytes(200), 100), "size differs"),
        (chunk_log("zstd", zstandard.compress(EMPTY * 2**21), 2**21 * len(EMPTY)), "states 65011712 bytes"),
        (chunk_log("zstd", zstandard.compress(LONG * 100), 100 * len(LONG), 200), "more than 100 times"),
        (chunk_log("", EMPTY[:-1], len(EMPTY) - 1), "incomplete"),
    ],
)
def test_chunk_that_expands_beyond_its_size_or_the_limit_is_damage(tmp_path, log, words):
    (tmp_path / "x.mcap").write_bytes(log)
    assert len(log) < 500_000
    tracemalloc.start()
    try:
        with pytest.raises(LogError, match=words):
            info(tmp_path / "x.mcap")
        assert tracemalloc.get_traced_memory()[1] < 5e7
    finally:
        tracemalloc.stop()


def test_record_beyond_the_limit_is_not_read_and_the_rest_is(tmp_path, small):
    """An attachment of another recorder is no damage, a chunk is."""
    (tmp_path / "small.mcap").write_bytes(small)
    with open_log(tmp_path / "small.mcap") as source:
        first = next(source.records()).end
    for opcode, words in ((Opcode.ATTACHMENT, None), (Opcode.CHUNK, "a record has")):
        path = tmp_path / f"{opcode}.mcap"
        with path.open("wb") as file:
            file.write(small[:first] + struct.pack("<BQ", opcode, 1 << 32))
            file.seek(1 << 32, os.SEEK_CUR)
            file.write(small[first:])
        if words is None:
            assert info(path).counts == info(tmp_path / "small.mcap").counts
        else:
            with pytest.raises(LogError, match=words):
                info(path)


# -- conformance suite ---------------------------------------------------------------------------------------


def test_conformance_suite_is_read(tmp_path):
    with tarfile.open(SUITE) as archive:
        archive.extraction_filter = getattr(tarfile, "data_filter", None)  # not in Python 3.11.2
        archive.extractall(tmp_path)
    logs = sorted(tmp_path.glob("*/*.mcap"))
    assert len(logs) == 171
    for path in logs:
        stated = json.loads(path.with_suffix(".json").read_text())["records"]
        stated = [(one["type"], dict(one["fields"])) for one in stated]
        topics = {f["id"]: f["topic"] for kind, f in stated if kind == "Channel"}
        expected = [
            (topics[f["channel_id"]], int(f["log_time"]), bytes(map(int, f["data"])))
            for kind, f in stated
            if kind == "Message"
        ]
        assert list(read(path)) == expected, path.name
        assert info(path).closed and info(path).messages == len(expected)
        names = {f["name"]: f["metadata"] for kind, f in stated if kind == "Metadata"}
        assert metadata(path) == names


# -- disk faults and kills -----------------------------------------------------------------------------------


@dataclasses.dataclass
class FaultyDisk:
    """A disk that calls `fault` before every write, which may wait, or return an error to raise."""

    path: Path
    fault: object

    def __post_init__(self):
        self.disk = DiskFile(self.path)

    def write(self, at, data):
        error = self.fault()
        if error is not None:
            self.disk.write(at, data[: len(data) // 2])  # a full disk writes a part
            raise error
        self.disk.write(at, data)

    def __getattr__(self, name):
        return getattr(self.disk, name)


def log_with_fault(folder, fault, **options):
    disk = partial(FaultyDisk, fault=fault)
    return Writer(folder / "x.mcap", metadata={}, fsync_s=0.05, disk=disk, **START, **options)


class Blocked:
    """A fault: a write waits from `begin` to `end`; until `works` each one fails, if there is an `error`."""

    def __init__(self, error=None):
        self.error, self.released = error, []
        self.slow, self.holds, self.go = threading.Event(), threading.Event(), threading.Event()

    def __call__(self):
        if not self.slow.is_set():
            return None
        self.holds.set()
        self.released.append(self.go.wait(30.0))
        return self.error if self.slow.is_set() else None

    def begin(self, log):
        self.slow.set()
        log.record(imu(0))
        wait_until(self.holds.is_set)

    def end(self):
        self.go.set()

    def works(self):
        self.slow.clear()


def test_full_disk_is_reported_and_queued_records_are_not_lost(tmp_path):
    full = threading.Event()

    def fault():
        return OSError(errno.ENOSPC, os.strerror(errno.ENOSPC)) if full.is_set() else None

    log = log_with_fault(tmp_path, fault, chunk_bytes=500)
    written = []
    for phase in range(3):
        full.set() if phase == 1 else full.clear()
        for i in range(100):
            written.append(imu(100 * phase + i))
            log.record(written[-1])
        if phase == 1:
            wait_until(lambda: log.trouble is not None)
            assert "No space left on device" in log.trouble
    wait_until(lambda: log.trouble is None)
    assert log.close() and log.dropped == 0
    assert [e.value for e in read(tmp_path / "x.mcap")] == written


@pytest.mark.parametrize("failures", [1, 2, 5])
def test_partial_write_that_cannot_be_truncated_is_overwritten(tmp_path, failures):
    """The disk writes a part, fails to truncate it, then works again."""

    class Flaky(FaultyDisk):
        left = 0

        def truncate(self, size):
            if self.left > 0:
                self.left -= 1
                raise OSError(errno.EIO, "broken")
            self.disk.truncate(size)

    drops, disks = threading.Event(), []

    def fault():
        if drops.is_set():
            drops.clear()
            disks[0].left = failures
            return OSError(errno.EIO, "broken")
        return None

    path = tmp_path / "x.mcap"
    log = Writer(
        path,
        metadata={},
        chunk_bytes=500,
        fsync_s=0.05,
        disk=lambda p: disks.append(Flaky(p, fault)) or disks[0],
        **START,
    )
    for i in range(200):
        log.record(imu(i))
        if i % 50 == 20:
            drops.set()
            wait_until(lambda: not drops.is_set() and log.trouble is None)
    assert log.close() and log.dropped == 0
    assert [e.value for e in read(path)] == [imu(i) for i in range(200)]
    with path.open("rb") as stream:
        assert sum(1 for _ in make_reader(stream, validate_crcs=True).iter_messages()) == 200


def test_permanently_full_disk_drops_the_oldest_and_counts_them(tmp_path):
    full = threading.Event()

    def fault():
        return OSError(errno.EIO, "broken") if full.is_set() else None

    log = log_with_fault(tmp_path, fault, chunk_bytes=500, depth=2000)
    full.set()
    for i in range(500):
        log.record(imu(i))
    wait_until(lambda: log.trouble is not None and log.dropped > 400)
    full.clear()
    assert log.close()
    kept = [e.value for e in read(tmp_path / "x.mcap")]
    assert kept == [imu(i) for i in range(500 - len(kept), 500)]
    assert log.dropped + len(kept) == 500


@pytest.mark.parametrize("fails", [True, False])
def test_chunk_that_is_being_written_is_the_oldest_and_is_dropped_first(tmp_path, fails):
    """The disk is blocked while the queue overflows. If it then fails, what is kept is without a gap."""
    blocked = Blocked(OSError(errno.EIO, "broken") if fails else None)
    log = log_with_fault(tmp_path, blocked, chunk_bytes=500, depth=2000)
    blocked.begin(log)
    for i in range(1, 500):
        log.record(imu(i))
    assert log.waiting <= 2000
    blocked.end()
    wait_until(lambda: log.trouble is not None if fails else log.waiting == 0)
    blocked.works()
    assert log.close()
    kept = [e.value for e in read(tmp_path / "x.mcap")]
    first = [] if fails else [imu(0)]  # written after all, and not counted as dropped
    assert kept == [*first, *(imu(i) for i in range(500 - len(kept) + len(first), 500))]
    assert log.dropped + len(kept) == 500


def test_failed_disk_leaves_a_recoverable_log(tmp_path):
    full = threading.Event()
    log = log_with_fault(tmp_path, lambda: OSError(errno.ENOSPC, "full") if full.is_set() else None)
    log.record(imu(0))
    wait_until(lambda: info(tmp_path / "x.mcap.active").messages == 1)
    full.set()
    log.record(imu(1))
    assert not log.close() and "full" in log.trouble and log.dropped == 1
    log.record(imu(2))
    assert log.dropped == 2
    assert recover(tmp_path / "x.mcap.active").messages == 1


def test_slow_disk_does_not_block_the_caller(tmp_path):
    """The disk is blocked until after the last record; no call of the writer waits for it."""
    blocked = Blocked()
    log = log_with_fault(tmp_path, blocked, chunk_bytes=2000)
    blocked.begin(log)
    i = 1000
    for k in range(1, i):
        log.record(imu(k))
    blocked.works()
    blocked.end()
    assert log.close() and log.dropped == 0 and all(blocked.released)
    assert sum(1 for _ in read(tmp_path / "x.mcap")) == i


def test_blocking_writer_drops_nothing(tmp_path):
    log = Writer(
        tmp_path / "x.mcap", metadata={}, chunk_bytes=1000, depth=2000, block=True,
        disk=lambda p: FaultyDisk(p, lambda: time.sleep(0.005)), **START,
    )  # fmt: skip
    for i in range(1000):
        log.record(imu(i))
    assert log.close() and log.dropped == 0
    assert [e.value.t_ns for e in read(tmp_path / "x.mcap")] == [imu(i).t_ns for i in range(1000)]


def test_file_size_limit_of_the_kernel_is_survived(tmp_path):
    path = tmp_path / "x.mcap"
    log = Writer(path, metadata={}, chunk_bytes=4000, fsync_s=0.05, **START)
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, before[1]))
    try:
        i = 0
        while log.trouble is None:
            log.record(imu(i))
            i += 1
            if log.waiting > 100_000:  # a slow disk does not fill the queue
                wait_until(lambda: log.trouble is not None or log.waiting < 50_000)
        assert "File too large" in log.trouble
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert log.close() and log.dropped == 0
    assert [e.value for e in read(path)] == [imu(k) for k in range(i)]


@pytest.mark.parametrize("code", [errno.EACCES, errno.EROFS])
def test_folder_without_the_right_to_write_is_reported_with_its_path_and_what_to_do(monkeypatch, code):
    def fail(folder):
        raise OSError(code, os.strerror(code), str(folder))

    monkeypatch.setattr(retention, "make_folder", fail)
    with pytest.raises(LogError, match=rf"cannot keep logs in {Path.cwd()}/logs: .*; give a folder that may"):
        retention.create_log("logs", metadata={}, **START)


def test_unwritable_folder_is_reported_in_one_sentence(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(LogError, match=r"cannot keep logs in .*: it is a file; give a folder"):
        retention.create_log(tmp_path / "file", metadata={}, **START)
    with pytest.raises(LogError, match=r"cannot write a log to .*: no folder .*missing"):
        Writer(tmp_path / "missing" / "x.mcap", metadata={}, **START)
    if os.geteuid() == 0:  # root can write everywhere except in kernel folders
        with pytest.raises(LogError, match="cannot write a log to"):
            Writer("/proc/x.mcap", metadata={}, **START)
        return
    locked = tmp_path / "locked"
    locked.mkdir(mode=0o555)
    with pytest.raises(LogError, match="Permission denied"):
        Writer(locked / "x.mcap", metadata={}, **START)


@pytest.mark.parametrize("fsync_s", [1.0, 2.0])
def test_open_chunk_is_closed_and_synced_after_half_of_the_interval(tmp_path, monkeypatch, fsync_s):
    now, synced = [100.0], threading.Event()
    monkeypatch.setattr(flight_log, "time", SimpleNamespace(monotonic=lambda: now[0]))

    class Disk(DiskFile):
        def sync(self):
            super().sync()
            synced.set()

    log = Writer(tmp_path / "x.mcap", metadata={}, fsync_s=fsync_s, disk=Disk, **START)
    for i in range(3):
        log.record(imu(i))
        synced.clear()
        now[0] += 0.5 * fsync_s
        assert synced.wait(60.0)
        assert info(tmp_path / "x.mcap.active").messages == i + 1
    assert log.close()


KILLED = """
import os, sys, time
from companion.storage.flight_log import Writer
from companion.storage.mcap_file import DiskFile
from companion.records import Reset
class Disk(DiskFile):
    def sync(self):
        super().sync()
        os.write(1, b"synced\\n")
log = Writer(sys.argv[1], metadata={}, start_unix_ns=10**18, start_ns=0, disk=Disk)
i = 0
while True:
    log.record(Reset(i, i, "x", "y"))
    os.write(1, b"%d\\n" % i)
    i += 1
    time.sleep(0.002)
"""


@pytest.mark.parametrize("syncs", [0, 1, 3])
def test_killed_writer_loses_at_most_two_intervals_of_its_syncs(tmp_path, syncs):
    """What was recorded before a sync is in the chunk that the next one follows: two take a second."""
    path = tmp_path / "x.mcap"
    with subprocess.Popen([sys.executable, "-c", KILLED, str(path)], stdout=subprocess.PIPE) as child:
        assert child.stdout is not None
        assert child.stdout.readline() == b"synced\n"  # the head of the file
        printed = list[bytes]()
        while printed.count(b"synced\n") < syncs or len(printed) < 100:
            printed.append(child.stdout.readline())
        with pytest.raises(LogError, match="still being written"):
            recover(f"{path}.active")
        child.send_signal(signal.SIGKILL)
        printed += child.stdout.readlines()
    (saved,) = retention.recover_unclosed(tmp_path)
    assert saved.path == path
    kept = [e.value.rx_ns for e in read(path)]
    assert kept == list(range(len(kept)))
    at = [k for k, line in enumerate(printed) if line == b"synced\n"]
    assert len(at) >= syncs
    assert len(kept) >= (at[-2] - len(at) + 2 if len(at) > 1 else 0)
    assert len(kept) <= len(printed) - len(at) + 1


# -- command --------------------------------------------------------------------------------------


def test_log_command_shows_recovers_and_reports_errors(tmp_path, small):
    run = CliRunner()
    (tmp_path / "x.mcap").write_bytes(small)
    (tmp_path / "y.mcap.active").write_bytes(small[:-60])
    shown = run.invoke(group, ["info", str(tmp_path / "x.mcap")])
    assert shown.exit_code == 0 and "/out/Reset" in shown.output and "closed" in shown.output
    shown = run.invoke(group, ["info", "--json", str(tmp_path / "x.mcap")])
    assert json.loads(shown.output)["counts"] == {
        "/out/Reset": 6, "/mavlink/udp/tx": 3, "/mavlink/udp/rx": 3
    }  # fmt: skip
    assert "torn" in run.invoke(group, ["info", str(tmp_path / "y.mcap.active")]).output
    assert "12 messages" in run.invoke(group, ["recover", str(tmp_path / "y.mcap.active")]).output
    assert "is complete" in run.invoke(group, ["recover", str(tmp_path / "y.mcap")]).output
    for command in ("info", "recover"):
        failed = run.invoke(group, [command, str(tmp_path / "none")])
        assert isinstance(failed.exception, LogError) and "\n" not in str(failed.exception)
