"""Fuzz targets on mutated valid inputs; `make fuzz` runs them longer, guided by coverage."""

import contextlib
import math
import struct
import tracemalloc

import pytest
import zstandard
from click.testing import CliRunner
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.opcode import Opcode
from mcap.records import Chunk, Header, McapRecord

from companion.config import ConfigError, parse
from companion.link import dialect, frame
from companion.navigator.air_data_channel import true_airspeed
from companion.records import AirData
from companion.storage import flight_log
from companion.storage.mcap_file import MAGIC, encode_records
from companion.storage.reader import LogError
from companion.storage.recovery import recover
from sitl.endurance import fuzz, fuzz_targets
from sitl.endurance.fuzz_targets import TARGETS

MIB = 1 << 20


def test_fuzzer_lists_every_target() -> None:
    assert tuple(TARGETS) == fuzz.TARGET_NAMES


@pytest.mark.parametrize("options", [[], ["--target", "log"]])
def test_replay_gives_the_input_to_its_target(options: list[str], monkeypatch, tmp_path) -> None:
    """Regression: without --target to none, and exit code 0."""
    replayed: list[bytes] = []
    monkeypatch.setitem(TARGETS, "log", fuzz_targets.Target(replayed.append, list))
    path = tmp_path / "crash"
    path.write_bytes(b"")
    done = CliRunner().invoke(fuzz.main, [*options, "--replay", str(path)])
    assert (done.exit_code, replayed) == (0, [b""])


@pytest.mark.parametrize("name", TARGETS)
def test_valid_inputs_pass(name: str) -> None:
    for seed in TARGETS[name].seeds():
        TARGETS[name].check(seed)


@pytest.mark.parametrize("chunked", [False, True])
def test_small_log_is_readable(tmp_path, chunked: bool) -> None:
    path = tmp_path / "x.mcap"
    path.write_bytes(fuzz_targets.small_log(chunked=chunked))
    assert [entry.value.text for entry in flight_log.read(path)] == ["text"]


def test_seed_scripts_reach_the_solution() -> None:
    """Otherwise the fuzzer would not reach the navigator."""
    kinds = set()

    class CollectingLog(fuzz_targets.ValidatingLog):
        def record(self, record: object, channel: str | None = None) -> None:
            super().record(record, channel)  # type: ignore[arg-type]
            kinds.add(type(record).__name__)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(fuzz_targets, "ValidatingLog", CollectingLog)
        for seed in TARGETS["onboard"].seeds():
            TARGETS["onboard"].check(seed)
    assert {"Solution", "Fix", "RsbnFix", "Tuning", "AirData", "Pressure"} <= kinds


@pytest.mark.parametrize(
    ("name", "fields", "wrong"),
    [
        ("ODOMETRY", {"vx": math.nan, "pose_covariance": [0.0] * 15 + [math.nan] * 6}, []),
        ("ODOMETRY", {"vx": math.inf, "z": math.nan}, ["z[0]", "vx[0]"]),
        ("ODOMETRY", {"pose_covariance": [math.nan] + [0.0] * 20}, ["pose_covariance[0]"]),
        ("GPS_INPUT", {"vn": math.nan, "horiz_accuracy": math.inf}, ["vn[0]", "horiz_accuracy[0]"]),
    ],
)
def test_a_number_that_means_nothing_is_not_sent(name: str, fields: dict, wrong: list[str]) -> None:
    """Regression: of a sent message only x, y, lat and lon were looked at."""
    message = dialect.new(name, **fields)
    assert fuzz_targets.wrong_numbers(message) == wrong
    log, data = fuzz_targets.ValidatingLog(), frame.encode(message, 0, 1, 191)
    with pytest.raises(AssertionError) if wrong else contextlib.nullcontext():
        log.frame("link", True, data, 0)


EDITS = st.lists(st.tuples(st.integers(0, 1 << 16), st.integers(0, 255), st.integers(0, 3)), max_size=12)


def edited(seed: bytes, edits: list[tuple[int, int, int]]) -> bytes:
    """A valid input with bytes changed, inserted, removed, or repeated."""
    data = bytearray(seed)
    for where, value, how in edits:
        at = where % (len(data) + 1)
        if how == 0:
            data[at : at + 1] = bytes((value,))
        elif how == 1:
            data[at:at] = bytes((value,)) * (1 + value % 9)
        elif how == 2:
            del data[at : at + 1 + value % 9]
        else:
            data += data[at : at + 4 * value]
    return bytes(data)


@pytest.mark.parametrize("name", TARGETS)
def test_any_bytes_pass(name: str) -> None:
    target = TARGETS[name]
    good = st.builds(edited, st.sampled_from(list(target.seeds())), EDITS)

    @settings(max_examples=60 if name == "onboard" else 250)
    @given(st.one_of(st.binary(max_size=600), good, good))
    def check(data: bytes) -> None:
        target.check(data)

    check()


# -- regressions found by the fuzzer, and cases out of its reach --------------------------------------------


@pytest.mark.parametrize("field", ["x", "vy", "z"])
def test_number_beyond_its_limit_is_rejected(field: str) -> None:
    """Regression: a local position of 3e10 m gave a latitude of -3110 rad."""
    sane = {"time_boot_ms": 61_000, "x": 1.0, "vx": 1.0}
    message = dialect.new("LOCAL_POSITION_NED", **sane | {field: 3.1e10})
    (record,) = fuzz_targets.decode(
        message, fuzz_targets.START_NS, fuzz_targets.Sender(fuzz_targets.BootClock())
    )
    assert record.reason.startswith(f"{field} 3.1e+10 is beyond the limit ")


@pytest.mark.parametrize("text", ["gnss = " + "[" * 60_000, "[gnss]\nsigma_m = " + "1" * 5000])
def test_oversized_configuration_is_a_short_error(text: str) -> None:
    with pytest.raises(ConfigError, match="not valid TOML") as caught:
        parse(text, "here")
    assert len(str(caught.value)) < 300


def torn(*records: McapRecord) -> bytes:
    """A log that ends after `records`."""
    return MAGIC + encode_records([Header("", "x"), *records])


def test_torn_log_is_recovered_up_to_a_damaged_schema(tmp_path) -> None:
    bad = struct.pack("<BQHI", Opcode.SCHEMA, 6, 1, 1 << 30)
    path = tmp_path / "x.mcap.active"
    path.write_bytes(torn(Chunk("", bad, 0, 0, uncompressed_crc=0, uncompressed_size=len(bad))))
    assert recover(path).messages == 0
    assert flight_log.info(tmp_path / "x.mcap").closed


def test_compression_bomb_is_limited_to_its_stated_size(tmp_path) -> None:
    """Half a gigabyte of zeros in 50 KiB, with a stated size of 100 bytes."""
    bomb = zstandard.ZstdCompressor(level=1, write_content_size=False).compressobj()
    squeezed = b"".join(bomb.compress(bytes(16 * MIB)) for _ in range(32)) + bomb.flush()
    assert len(squeezed) < MIB
    path = tmp_path / "x.mcap"
    path.write_bytes(torn(Chunk("zstd", squeezed, 0, 0, uncompressed_crc=0, uncompressed_size=100)))
    tracemalloc.start()
    try:
        assert list(flight_log.read(path)) == []
        assert tracemalloc.get_traced_memory()[1] < 16 * MIB
    finally:
        tracemalloc.stop()


def test_deeply_nested_record_is_an_error(tmp_path) -> None:
    path = tmp_path / "x.mcap"
    path.write_bytes(fuzz_targets.small_log(b'{"a":' + b"[" * 100_000))
    with pytest.raises(LogError, match="does not match the format"):
        list(flight_log.read(path))


PATTERNS = {
    "zeros": bytes(4096),
    "false heads": b"\xfd" * 1024,
    "false old heads": b"\xfe" * 1024,
    "legal flags": b"\xfd\xff\x00" * 1400,
    "heads of unknown messages": (b"\xfd\xff\x00\x00\x00\x01\x01" + (190_000).to_bytes(3, "little")) * 400,
    "frames": b"".join(frame.encode(dialect.new("ATTITUDE", yaw=1.0), i & 0xFF, 1, 1) for i in range(100)),
}


@pytest.mark.parametrize("name", PATTERNS)
def test_reader_memory_is_bounded(name: str) -> None:
    reader = frame.Reader()
    reader.receive(PATTERNS[name])
    tracemalloc.start()
    try:
        before = tracemalloc.get_traced_memory()[0]
        for _ in range(20):
            reader.receive(PATTERNS[name])
            assert reader.waiting <= frame.MAX_WAITING
        held, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert held - before < 16 << 10 and peak - before < 2 * MIB


def test_record_with_invalid_utf8_is_an_error(tmp_path) -> None:
    path = tmp_path / "x.mcap"
    path.write_bytes(
        fuzz_targets.small_log(b'{"type":"E\x87ent","t_ns":5,"rx_ns":5,"severity":6,"text":"x"}')
    )
    with pytest.raises(LogError, match="does not match the format"):
        list(flight_log.read(path))


def test_true_airspeed_is_real_at_any_height() -> None:
    """The standard atmosphere ends at 44 km (0 K), but a message can state any height."""
    speeds = [true_airspeed(AirData(0, 0, 40.0), None, alt) for alt in (-1e3, 0.0, 11_000.0, 1e5, 2e6)]
    assert speeds == sorted(speeds) and speeds[-1] < 80.0
