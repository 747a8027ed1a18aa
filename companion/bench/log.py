"""Benchmark of the flight log: writing and reading, compared with the mcap package on the same data."""

import atexit
import shutil
import tempfile
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path

from mcap.reader import make_reader
from mcap.writer import CompressionType
from mcap.writer import Writer as PackageWriter

from companion.records import Imu, encode
from companion.storage.flight_log import Writer, read

MESSAGES = 20_000
READ = 1_000_000  # messages in the file that is read
ROUNDS = 3


def imu(i: int) -> Imu:
    """Return the i-th of a series of differing records."""
    t_ns = i * 20_000_000
    return Imu(t_ns, t_ns + 1_000_017, 0, (0.1 * i, 0.2, -9.81), (1e-3 / (i + 1), 2e-3, 0.0))


def write(path: Path, records: Iterable[Imu]) -> None:
    """Write a closed log of records."""
    with Writer(path, metadata={}, start_unix_ns=10**18, start_ns=0, block=True) as log:
        for one in records:
            log.record(one)


def cases() -> Iterator[tuple[str, Callable[[], object]]]:
    """Yield (name, callable): one call writes MESSAGES records, or one, or reads READ."""
    folder = Path(tempfile.mkdtemp())
    atexit.register(shutil.rmtree, folder, True)
    path = folder / "read.mcap"
    write(path, map(imu, range(READ)))
    written = folder / "written.mcap"
    endless = Writer(folder / "endless.mcap", metadata={}, start_unix_ns=10**18, start_ns=0)
    atexit.register(endless.close)
    record, records = imu(7), [imu(i) for i in range(MESSAGES)]

    def ours() -> None:
        write(written, records)
        written.unlink()

    def package() -> None:
        with (folder / "package.mcap").open("wb") as stream:
            log = PackageWriter(stream, chunk_size=131072, compression=CompressionType.ZSTD)
            log.start()
            channel = log.register_channel("/in/Imu", "json", log.register_schema("Imu", "jsonschema", b"{}"))
            for one in records:
                log.add_message(channel, one.rx_ns, encode(one), one.t_ns)
            log.finish()

    def package_read() -> None:
        with path.open("rb") as stream:
            deque(make_reader(stream).iter_messages(log_time_order=False), maxlen=0)

    yield "log: one record, in the caller's thread", lambda: endless.record(record)
    yield f"log: {MESSAGES} records written, synced and closed", ours
    yield f"mcap: {MESSAGES} records written, unsynced", package
    yield f"log: {READ} messages read into records", lambda: deque(read(path), maxlen=0)
    yield f"log: {READ} messages read as bytes", lambda: deque(read(path, raw=True), maxlen=0)
    yield f"mcap: {READ} messages read as bytes", package_read
