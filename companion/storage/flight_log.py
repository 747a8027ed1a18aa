"""A flight's log: every record and every raw frame in one MCAP file, written and read as mirror images.

`Writer` takes records from the service and puts them on a disk from a thread of its own, so that no disk,
full, slow or gone, ever holds navigation up. What is at risk is the last second: the open chunk is closed and
synced that often. `read` gives the same records back in the order they were written, from a log closed or
torn.

It knows what a record is and where a position stands in it; it does not know what any of them mean. Times in
the container are wall-clock (`log_time` of arrival, `publish_time` of validity), for other tools; the exact
monotonic ones are inside the records.
"""

from __future__ import annotations

import os
import struct
import threading
import time
from collections import Counter, deque
from collections.abc import Callable, Iterator, Mapping
from functools import partial
from pathlib import Path
from types import TracebackType
from typing import Any, NamedTuple

import msgspec

from companion import __version__
from companion.records import BY_NAME, INPUTS, LinkState, Stamped, Truth, encode
from companion.storage import container, location_fix
from companion.storage.container import Chunk, Damaged
from companion.storage.mcap_file import Disk, DiskFile, Store, sync_folder
from companion.storage.reader import ACTIVE, Channels, LogError, opened
from companion.storage.recovery import Recovered, recover

__all__ = [
    "Entry",
    "Info",
    "LogError",
    "Recovered",
    "Writer",
    "info",
    "metadata",
    "read",
    "recover",
    "topic_of",
]

MAP_PERIOD_NS = 500_000_000
"""Positions go to the map's topics no more often than this."""

_MOST = 2**64 - 1


class Entry(NamedTuple):
    """One message: its topic, its wall-clock time of arrival (ns) and its record, or bytes if it is none."""

    topic: str
    log_time: int
    value: Any


class Info(NamedTuple):
    """What a log holds. Times are wall-clock ns (0 where it holds no message); `counts` is by topic."""

    path: Path
    closed: bool
    start_ns: int
    end_ns: int
    messages: int
    chunks: int
    counts: dict[str, int]
    metadata: dict[str, dict[str, str]]
    bytes: int
    bytes_lost: int

    @property
    def duration_s(self) -> float:
        """From the first message to the last."""
        return (self.end_ns - self.start_ns) * 1e-9


class Writer:
    """A log being written to `path` + ".active"; `close` gives it its name.

    `start_unix_ns` is the wall-clock time at `start_ns` of the companion's clock. `metadata` is kept as
    given, beside a record "log" of version and start times. A chunk holds `chunk_bytes` or what came in
    `fsync_s` seconds of real time. At most `depth` bytes wait for the disk: beyond, the oldest are dropped
    and counted, or with `block` (a simulation that runs faster than any disk) the caller waits for a disk
    that is slow, never for one that refuses. `disk` opens the file.

    Raises LogError where the file cannot be begun, and never afterwards: `trouble` says what the disk said
    last, None while all is well, and what waits is tried again for as long as there is room.
    """

    def __init__(
        self,
        path: str | os.PathLike[str],
        *,
        metadata: Mapping[str, Mapping[str, str]],
        start_unix_ns: int,
        start_ns: int,
        chunk_bytes: int = 131072,
        fsync_s: float = 1.0,
        depth: int = 1 << 25,
        block: bool = False,
        disk: Callable[[Path], Disk] = DiskFile,
    ) -> None:
        self.path = Path(path)
        self.dropped = 0
        self.trouble: str | None = None
        self._shift = start_unix_ns - start_ns
        self._chunk_bytes, self._depth, self._block = chunk_bytes, depth, block
        # The disk takes its own time to sync, a busy machine to let us: half of the second is left to them.
        self._period_s = 0.5 * fsync_s

        self._lock = threading.Lock()
        self._room = threading.Condition(self._lock)
        self._open = Chunk()
        self._waiting: deque[Chunk] = deque()
        self._waiting_bytes = 0
        self._wake = threading.Event()
        self._closing = False

        self._ids: dict[Any, int] = {}
        self._sequences: list[int] = [0]
        self._schemas: dict[int, bytes] = {}
        self._channels: dict[int, bytes] = {}
        self._map_due = {kind: -_MOST for kind in BY_NAME.values() if kind.__name__ in _MAPPED}

        self._file = self._begin(disk, metadata, start_unix_ns, start_ns)
        self._thread = threading.Thread(target=self._run, name="log", daemon=True)
        self._thread.start()

    def record(self, record: Stamped, channel: str | None = None) -> None:
        """Write one record, to the topic of its kind or to `channel`. Never waits for the disk."""
        kind = type(record)
        key = kind if channel is None else (channel, kind)
        number = self._ids.get(key) or self._channel_of_record(key, kind, channel)
        self._put(number, record.rx_ns, record.t_ns, encode(record))
        due = self._map_due.get(kind)
        if due is not None and not due - MAP_PERIOD_NS <= record.t_ns < due:
            self._map_due[kind] = record.t_ns + MAP_PERIOD_NS
            for topic, fix in location_fix.fixes(record, record.t_ns + self._shift):
                number = self._ids.get(topic) or self._channel_of_map(topic)
                self._put(number, record.rx_ns, record.t_ns, msgspec.json.encode(fix))

    def frame(self, link: str, outgoing: bool, data: bytes, t_ns: int) -> None:
        """Write one frame as it was on the wire of `link`. Never waits for the disk."""
        key = (link, outgoing)
        number = self._ids.get(key)
        if number is None:
            topic = f"/mavlink/{link.strip('/')}/{'tx' if outgoing else 'rx'}"
            number = self._define(key, topic, "mavlink", "", None)
        self._put(number, t_ns, t_ns, data)

    @property
    def waiting(self) -> int:
        """Bytes that wait for the disk."""
        return self._waiting_bytes

    def close(self, timeout_s: float = 30.0) -> bool:
        """Write all that waits, close the file and give it its name; whether that was done.

        Where the disk refuses or takes longer than `timeout_s` the log stays ".active", to be recovered.
        """
        with self._lock:
            self._closing = True
        self._wake.set()
        self._thread.join(timeout_s)
        if self._thread.is_alive():
            self.trouble = f"cannot close the log {self.path}: no answer from the disk in {timeout_s:g} s"
        return self.trouble is None

    def __enter__(self) -> Writer:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    # -- in the caller's thread ------------------------------------------------------------------------

    def _put(self, number: int, rx_ns: int, t_ns: int, data: bytes) -> None:
        log_ns, publish_ns = rx_ns + self._shift, t_ns + self._shift
        if not (
            0 <= log_ns <= _MOST and 0 <= publish_ns <= _MOST
        ):  # a clock gone mad; the record has it exact
            log_ns, publish_ns = min(max(log_ns, 0), _MOST), min(max(publish_ns, 0), _MOST)
        with self._lock:
            if self._closing:
                self.dropped += 1
                return
            sequence = self._sequences[number]
            self._sequences[number] = (sequence + 1) & 0xFFFFFFFF
            chunk = self._open
            chunk.add(number, sequence, log_ns, publish_ns, data)
            if len(chunk.data) >= self._chunk_bytes:
                self._turn()
                self._wake.set()
                while self._block and self._waiting_bytes > self._depth and self.trouble is None:
                    self._room.wait(1.0)

    def _turn(self) -> None:
        """Close the open chunk and let it wait for the disk (under the lock)."""
        if not self._open.data:
            return
        self._waiting.append(self._open)
        self._waiting_bytes += len(self._open.data)
        self._open = Chunk()
        if not self._block or self.trouble is not None:
            while self._waiting_bytes > self._depth and self._waiting:
                oldest = self._waiting.popleft()
                self._waiting_bytes -= len(oldest.data)
                self.dropped += oldest.messages

    def _channel_of_record(self, key: Any, kind: type[Stamped], channel: str | None) -> int:
        schema = msgspec.json.encode(msgspec.json.schema(kind))
        return self._define(key, channel or topic_of(kind), "json", kind.__name__, schema)

    def _channel_of_map(self, topic: str) -> int:
        return self._define(
            topic, topic, "json", location_fix.SCHEMA_NAME, msgspec.json.encode(location_fix.SCHEMA)
        )

    def _define(self, key: Any, topic: str, encoding: str, name: str, schema: bytes | None) -> int:
        with self._lock:
            number = len(self._channels) + 1
            of_schema = 0
            if schema is not None:
                of_schema = number
                self._schemas[of_schema] = (
                    struct.pack("<H", of_schema)
                    + container.text(name)
                    + container.text("jsonschema")
                    + struct.pack("<I", len(schema))
                    + schema
                )
            head = struct.pack("<HH", number, of_schema)
            self._channels[number] = (
                head + container.text(topic) + container.text(encoding) + container.texts({})
            )
            self._sequences.append(0)
            self._ids[key] = number
            return number

    # -- in the writer's thread ------------------------------------------------------------------------

    def _begin(
        self,
        disk: Callable[[Path], Disk],
        metadata: Mapping[str, Mapping[str, str]],
        start_unix_ns: int,
        start_ns: int,
    ) -> Store:
        active = self.path.with_name(self.path.name + ACTIVE)
        log = {"version": __version__, "start_unix_ns": str(start_unix_ns), "start_ns": str(start_ns)}
        try:
            file = Store(disk(active), f"companion {__version__}")
            for name, values in {"log": log, **metadata}.items():
                file.metadata(name, values)
            file.sync()
        except OSError as error:
            raise LogError(f"cannot write a log to {active}: {error.strerror or error}") from None
        return file

    def _run(self) -> None:
        due = time.monotonic() + self._period_s
        while not self._closing:
            self._wake.wait(max(0.0, due - time.monotonic()))
            self._wake.clear()
            tick = time.monotonic() >= due
            if tick:
                with self._lock:
                    self._turn()
                due = time.monotonic() + self._period_s
            if self._drain() and tick:
                self._try(self._file.sync)
        with self._lock:
            self._turn()
        written = self._drain()
        finished = written and self._try(self._file.finish) and self._try(self._file.sync)
        if finished:
            self._try(self._name)
        self._file.close()  # and with it the lock: no other start is to mend what only lacks its name
        with self._lock:
            self.dropped += sum(chunk.messages for chunk in self._waiting)

    def _name(self) -> None:
        os.replace(self.path.with_name(self.path.name + ACTIVE), self.path)
        sync_folder(self.path.parent)

    def _drain(self) -> bool:
        """Write every chunk that waits; False at the first the disk refuses, which then waits on."""
        while True:
            with self._lock:
                if not self._waiting:
                    return True
                chunk = self._waiting.popleft()
                self._waiting_bytes -= len(chunk.data)
                self._room.notify_all()
            if not self._try(partial(self._file.chunk, chunk, self._schemas, self._channels)):
                with self._lock:
                    self._waiting.appendleft(chunk)
                    self._waiting_bytes += len(chunk.data)
                return False

    def _try(self, act: Callable[[], None]) -> bool:
        try:
            act()
        except OSError as error:
            self.trouble = f"cannot write the log {self.path}: {error.strerror or error}"
            return False
        self.trouble = None
        return True


_MAPPED = ("Gnss", "Solution", "Truth")


def topic_of(kind: type[Stamped]) -> str:
    """The topic of a kind of record."""
    if kind is Truth:
        return "/truth/Truth"
    if kind is LinkState:
        return "/link/LinkState"
    return f"/{'in' if kind in INPUTS else 'out'}/{kind.__name__}"


# ---------------------------------------------------------------------------------------------------------
# Reading
# ---------------------------------------------------------------------------------------------------------


def read(path: str | os.PathLike[str], *, raw: bool = False) -> Iterator[Entry]:
    """Every message of a log in the order written; with `raw`, records stay the bytes they are in the file.

    A torn log is read up to its first damage. Raises LogError where the file is no MCAP log, and where a
    closed one is damaged.
    """
    with opened(path) as source:
        channels = Channels()
        decoders: dict[int, tuple[str, Callable[[bytes], Any] | None]] = {}
        try:
            for data in source.stretches():
                for opcode, number, _, log_ns, _, content in container.messages(data):
                    if opcode == container.MESSAGE:
                        topic, decode = decoders[number]
                        yield Entry(topic, log_ns, content if decode is None else decode(content))
                    elif (defined := channels.define(opcode, content)) is not None:
                        decoders[defined] = _decoder(channels[defined], raw)
        except (Damaged, KeyError) as error:
            if source.closed:
                raise source.damaged(error) from None
        except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError) as error:
            raise LogError(f"{path}: a record is not of this version's kind ({error})") from None


def info(path: str | os.PathLike[str]) -> Info:
    """Counts, times and metadata of a log, closed or torn. Raises LogError as `read` does."""
    with opened(path) as source:
        counts: Counter[int] = Counter()
        by_topic: Counter[str] = Counter()
        channels = Channels()
        first, last = _MOST, 0
        try:
            for data in source.stretches():
                for opcode, number, _, log_ns, _, content in container.messages(data):
                    if opcode == container.MESSAGE:
                        counts[number] += 1
                        first = log_ns if log_ns < first else first
                        last = log_ns if log_ns > last else last
                    else:
                        channels.define(opcode, content)
            for number, count in counts.items():
                by_topic[channels[number].topic] += count
        except (Damaged, KeyError) as error:
            if source.closed:
                raise source.damaged(error) from None
        total = sum(by_topic.values())
        return Info(
            path=source.path,
            closed=source.closed,
            start_ns=first if total else 0,
            end_ns=last,
            messages=total,
            chunks=source.chunks,
            counts=dict(by_topic),
            metadata=source.metadata,
            bytes=source.size,
            bytes_lost=source.size - source.end,
        )


def metadata(path: str | os.PathLike[str]) -> dict[str, dict[str, str]]:
    """The metadata at the head of a log (before its first message), by name."""
    with opened(path) as source:
        found = {}
        for _, opcode, content in source.records():
            if opcode in (container.CHUNK, container.MESSAGE):
                break
            if opcode == container.METADATA:
                try:
                    name, values = container.metadata(content)
                except Damaged as error:
                    raise source.damaged(error) from None
                found[name] = values
        return found


def _decoder(channel: container.Channel, raw: bool) -> tuple[str, Callable[[bytes], Any] | None]:
    """Topic of a channel, and how its messages become records (None: they stay bytes)."""
    kind = BY_NAME.get(channel.schema)
    if raw or kind is None or channel.encoding != "json":
        return channel.topic, None
    return channel.topic, msgspec.json.Decoder(kind).decode
