"""Flight log: every record and every raw frame in one MCAP file; writer and reader.

`Writer` accepts records without blocking and writes them in a thread of its own, so that a full, slow or
failing disk never delays navigation. The open chunk is closed and synced once a second: at most the last
second is lost. `read` returns the same records in the order written, from closed and torn logs.

Times in the container are wall-clock for other tools: `log_time` of arrival, `publish_time` of validity. The
exact monotonic times are inside the records.
"""

from __future__ import annotations

import os
import threading
import time
from collections import Counter, deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from types import TracebackType
from typing import Any, NamedTuple

import msgspec
from mcap.opcode import Opcode
from mcap.records import Attachment, Channel, Message, Schema

from companion import __version__
from companion.records import BY_NAME, DECODERS, INPUTS, OUTPUTS, Event, LinkState, Stamped, Truth, encode
from companion.storage import location_fix, schemas
from companion.storage.mcap_file import Disk, DiskFile, McapFile, sync_folder
from companion.storage.reader import ACTIVE, DamagedError, LogError, LogReader, open_log
from companion.write_errors import describe_write_error

MAP_PERIOD_NS = 500_000_000
"""Minimum interval of positions on the /map topics."""

_MAX_UINT64 = 2**64 - 1
_MESSAGE_HEAD = 31  # bytes of a message record before its data


class Entry(NamedTuple):
    """One message: topic, wall-clock time of arrival (ns), and the record, or bytes if it is not a record."""

    topic: str
    log_time: int
    value: Any


class Info(NamedTuple):
    """Summary of a log. Times are wall-clock ns (0 if it has no messages); `counts` is by topic."""

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
        """Time from the first message to the last, s."""
        return (self.end_ns - self.start_ns) * 1e-9


class Writer:
    """Non-blocking log writer. Writes to `path` + ".active"; `close` renames the file to `path`.

    Parameters
    ----------
    metadata : metadata records by name; a record "log" with version and start times is added.
    start_unix_ns, start_ns : wall-clock time and time of the companion's clock at the same instant.
    chunk_bytes, fsync_s : a chunk is closed at this size, or after this real time.
    depth : limit of bytes queued for the disk. Beyond it the oldest chunks are dropped and counted in
        `dropped`.
    block : wait for a slow disk instead of dropping (for simulations faster than any disk); a failing disk
        is never waited for.
    disk : opens the file.
    attachments : are written at the start.

    Raises LogError if the file cannot be created, and never afterwards: `trouble` is the last error of the
    disk, None while writing works. Queued chunks are retried.
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
        attachments: Sequence[Attachment] = (),
    ) -> None:
        self.path = Path(path)
        self._attachments = attachments
        self.dropped = 0
        self.trouble: str | None = None
        self._shift = start_unix_ns - start_ns
        self._chunk_bytes, self._depth, self._block = chunk_bytes, depth, block
        # half of `fsync_s` is left for the sync itself and for a busy machine
        self._period_s = 0.5 * fsync_s

        self._lock = threading.Lock()
        self._space_available = threading.Condition(self._lock)
        self._open = _Batch()
        self._queued: deque[_Batch] = deque()
        self._queued_bytes = 0
        self._wake = threading.Event()
        self._closing = False
        self._finishing = True

        self._ids: dict[Any, int] = {}
        self._sequences: list[int] = [0]
        self._schemas: dict[int, Schema] = {}
        self._channels: dict[int, Channel] = {}
        self._map_due = {kind: -_MAX_UINT64 for kind in BY_NAME.values() if kind.__name__ in _MAP_RECORDS}

        self._file = self._create_file(disk, metadata, start_unix_ns, start_ns)
        self._thread = threading.Thread(target=self._write_loop, name="log", daemon=True)
        self._thread.start()

    def record(self, record: Stamped, channel: str | None = None) -> None:
        """Write one record, to the topic of its type or to `channel`. Never waits for the disk."""
        kind = type(record)
        key = kind if channel is None else (channel, kind)
        number = self._ids.get(key) or self._channel_of_record(key, kind, channel)
        self._append(number, record.rx_ns, record.t_ns, encode(record))
        due = self._map_due.get(kind)
        if due is not None and not due - MAP_PERIOD_NS <= record.t_ns < due:
            for topic, fix in location_fix.to_location_fixes(record, record.t_ns + self._shift):
                self._map_due[kind] = record.t_ns + MAP_PERIOD_NS
                number = self._ids.get(topic) or self._channel_of_map(topic)
                self._append(number, record.rx_ns, record.t_ns, msgspec.json.encode(fix))
        elif kind is Event:
            number = self._ids.get(schemas.LOG_TOPIC) or self._channel_of_events()
            found = msgspec.json.encode(schemas.to_log(record, record.t_ns + self._shift))  # type: ignore[arg-type]
            self._append(number, record.rx_ns, record.t_ns, found)

    def frame(self, link: str, outgoing: bool, data: bytes, t_ns: int) -> None:
        """Write one frame as transmitted on `link`. Never waits for the disk."""
        key = (link, outgoing)
        number = self._ids.get(key)
        if number is None:
            topic = f"/mavlink/{link.strip('/')}/{'tx' if outgoing else 'rx'}"
            number = self._define_channel(key, topic, schemas.MAVLINK, schemas.MAVLINK, schemas.FRAMES)
        self._append(number, t_ns, t_ns, data)

    @property
    def waiting(self) -> int:
        """Bytes queued for the disk."""
        return self._queued_bytes

    def close(self, timeout_s: float = 30.0, *, finish: bool = True) -> bool:
        """Write everything queued, close the file and rename it. Return whether this succeeded.

        Without `finish` the log stays ".active", as of an interrupted run.
        If the disk fails or takes longer than `timeout_s`, the log stays ".active" and can be recovered.
        """
        with self._lock:
            self._closing, self._finishing = True, finish
        self._wake.set()
        self._thread.join(timeout_s)
        if self._thread.is_alive():
            self.trouble = f"cannot close the log {self.path}: no response from the disk in {timeout_s:g} s"
        return self.trouble is None

    def __enter__(self) -> Writer:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    # -- in the caller's thread ------------------------------------------------------------------------

    def _append(self, number: int, rx_ns: int, t_ns: int, data: bytes) -> None:
        log_ns, publish_ns = rx_ns + self._shift, t_ns + self._shift
        if not (
            0 <= log_ns <= _MAX_UINT64 and 0 <= publish_ns <= _MAX_UINT64
        ):  # implausible clock: clamp here, the record keeps the exact times
            log_ns, publish_ns = min(max(log_ns, 0), _MAX_UINT64), min(max(publish_ns, 0), _MAX_UINT64)
        with self._lock:
            if self._closing:
                self.dropped += 1
                return
            sequence = self._sequences[number]
            self._sequences[number] = (sequence + 1) & 0xFFFFFFFF
            batch = self._open
            batch.messages.append(Message(number, log_ns, data, publish_ns, sequence))
            batch.size += _MESSAGE_HEAD + len(data)
            if batch.size >= self._chunk_bytes:
                self._queue_open_chunk()
                self._wake.set()
                while self._block and self._queued_bytes > self._depth and self.trouble is None:
                    self._space_available.wait(1.0)

    def _queue_open_chunk(self) -> None:
        """Close the open chunk and queue it for the disk (lock held)."""
        if not self._open.messages:
            return
        self._queued.append(self._open)
        self._queued_bytes += self._open.size
        self._open = _Batch()
        if not self._block or self.trouble is not None:
            while self._queued_bytes > self._depth and self._queued:
                oldest = self._queued.popleft()
                self._queued_bytes -= oldest.size
                self.dropped += len(oldest.messages)

    def _channel_of_record(self, key: Any, kind: type[Stamped], channel: str | None) -> int:
        schema = schemas.record_schema(kind)
        return self._define_channel(key, channel or topic_of(kind), "json", kind.__name__, schema)

    def _channel_of_map(self, topic: str) -> int:
        schema = msgspec.json.encode(location_fix.SCHEMA)
        return self._define_channel(topic, topic, "json", location_fix.SCHEMA_NAME, schema)

    def _channel_of_events(self) -> int:
        topic, schema = schemas.LOG_TOPIC, msgspec.json.encode(schemas.LOG)
        return self._define_channel(topic, topic, "json", schemas.LOG_NAME, schema)

    def _define_channel(self, key: Any, topic: str, encoding: str, name: str, schema: bytes) -> int:
        with self._lock:
            number = len(self._channels) + 1
            of = next((known.id for known in self._schemas.values() if known.name == name), None)
            if of is None:
                of = len(self._schemas) + 1
                kind = "jsonschema" if encoding == "json" else encoding
                self._schemas[of] = Schema(id=of, data=schema, encoding=kind, name=name)
            self._channels[number] = Channel(
                id=number, topic=topic, message_encoding=encoding, metadata={}, schema_id=of
            )
            self._sequences.append(0)
            self._ids[key] = number
            return number

    # -- in the writer's thread ------------------------------------------------------------------------

    def _create_file(
        self,
        disk: Callable[[Path], Disk],
        metadata: Mapping[str, Mapping[str, str]],
        start_unix_ns: int,
        start_ns: int,
    ) -> McapFile:
        active = self.path.with_name(self.path.name + ACTIVE)
        log = {"version": __version__, "start_unix_ns": str(start_unix_ns), "start_ns": str(start_ns)}
        try:
            file = McapFile(disk(active))
            file.begin(f"companion {__version__}")
            for name, values in {"log": log, **metadata}.items():
                file.metadata(name, values)
            file.write(self._attachments)
            file.sync()
        except OSError as error:
            raise LogError(f"cannot write a log to {active}: {describe_write_error(error)}") from error
        return file

    def _write_loop(self) -> None:
        due = time.monotonic() + self._period_s
        while not self._closing:
            self._wake.wait(max(0.0, due - time.monotonic()))
            self._wake.clear()
            tick = time.monotonic() >= due
            if tick:
                with self._lock:
                    self._queue_open_chunk()
                due = time.monotonic() + self._period_s
            if self._write_queued() and tick:
                self._attempt(self._file.sync)
        with self._lock:
            self._queue_open_chunk()
        written = self._write_queued()
        finish = written and self._finishing
        finished = finish and self._attempt(self._file.finish) and self._attempt(self._file.sync)
        if finished:
            self._attempt(self._rename)
        self._file.close()  # last: releases the lock that keeps others from recovering the log
        with self._lock:
            self.dropped += sum(len(batch.messages) for batch in self._queued)

    def _rename(self) -> None:
        os.replace(self.path.with_name(self.path.name + ACTIVE), self.path)
        sync_folder(self.path.parent)

    def _write_queued(self) -> bool:
        """Write all queued chunks. Return False on the first failure; that chunk stays the oldest queued."""
        while True:
            with self._lock:
                if not self._queued:
                    return True
                batch = self._queued[0]
            if not self._attempt(partial(self._file.chunk, batch.messages, self._schemas, self._channels)):
                return False
            with self._lock:
                if self._queued and self._queued[0] is batch:
                    self._queued.popleft()
                    self._queued_bytes -= batch.size
                else:  # dropped by the caller while it was being written
                    self.dropped -= len(batch.messages)
                self._space_available.notify_all()

    def _attempt(self, act: Callable[[], None]) -> bool:
        try:
            act()
        except OSError as error:
            self.trouble = f"cannot write the log {self.path}: {error.strerror or error}"
            return False
        self.trouble = None
        return True


class _Batch:
    """Messages of a chunk that is not written yet, and its uncompressed size."""

    __slots__ = ("messages", "size")

    def __init__(self) -> None:
        self.messages: list[Message] = []
        self.size = 0


_MAP_RECORDS = ("Gnss", "Smoothed", "Solution", "Truth")


def topic_of(kind: type[Stamped]) -> str:
    """Return the topic of a record type."""
    if kind is Truth:
        return "/truth/Truth"
    if kind is LinkState:
        return "/link/LinkState"
    return f"/{'in' if kind in INPUTS else 'out'}/{kind.__name__}"


def topic_of_input(record: Stamped) -> str:
    """Return the topic of a record of an importer; its events and rejections are under /link."""
    kind = type(record)
    return f"/link/{kind.__name__}" if isinstance(record, OUTPUTS) else topic_of(kind)


# ---------------------------------------------------------------------------------------------------------
# Reading
# ---------------------------------------------------------------------------------------------------------


def read(path: str | os.PathLike[str], *, raw: bool = False) -> Iterator[Entry]:
    """Yield every message of a log in the order written; with `raw`, records are not decoded.

    A torn log is read up to the first damage. Raises LogError if the file is not an MCAP log, or is a closed
    log that is damaged.
    """
    with open_log(path) as source:
        decoders: dict[int, tuple[str, Callable[[bytes], Any] | None]] = {}
        try:
            for message in source.messages():
                decoder = decoders.get(message.channel_id)
                if decoder is None:
                    decoder = decoders[message.channel_id] = _decoder(source, message.channel_id, raw)
                topic, decode = decoder
                yield Entry(topic, message.log_time, message.data if decode is None else decode(message.data))
        except DamagedError as error:
            if source.closed:
                raise source.damage_error(error) from None
        except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError) as error:
            raise LogError(f"{path}: a record does not match the format of this version ({error})") from None


def info(path: str | os.PathLike[str]) -> Info:
    """Return counts, times and metadata of a log, closed or torn. Raises LogError as `read` does."""
    with open_log(path) as source:
        counts: Counter[str] = Counter()
        topics: dict[int, str] = {}
        first, last = _MAX_UINT64, 0
        try:
            for message in source.messages():
                topic = topics.get(message.channel_id)
                if topic is None:
                    topic, _ = _decoder(source, message.channel_id, raw=True)
                    topics[message.channel_id] = topic
                counts[topic] += 1
                first, last = min(first, message.log_time), max(last, message.log_time)
        except DamagedError as error:
            if source.closed:
                raise source.damage_error(error) from None
        return Info(
            path=source.path,
            closed=source.closed,
            start_ns=first if counts else 0,
            end_ns=last,
            messages=counts.total(),
            chunks=source.chunks,
            counts=dict(counts),
            metadata=source.metadata,
            bytes=source.size,
            bytes_lost=source.size - source.end,
        )


def metadata(path: str | os.PathLike[str]) -> dict[str, dict[str, str]]:
    """Return the metadata records before the first message of a log, by name."""
    with open_log(path) as source:
        for raw in source.records():
            if raw.opcode in (Opcode.CHUNK, Opcode.MESSAGE):
                break
            if raw.opcode == Opcode.METADATA:
                try:
                    source.keep_metadata(raw)
                except DamagedError as error:
                    raise source.damage_error(error) from None
        return source.metadata


def _decoder(source: LogReader, number: int, raw: bool) -> tuple[str, Callable[[bytes], Any] | None]:
    """Return the topic of a channel and the decoder of its messages (None: not decoded)."""
    if not source.is_defined(number):
        raise DamagedError(f"a message is on channel {number}, which is not defined")
    channel = source.channels[number]
    schema = source.schemas[channel.schema_id].name if channel.schema_id else ""
    decoder = DECODERS.get(schema)
    if raw or decoder is None or channel.message_encoding != "json":
        return channel.topic, None
    return channel.topic, decoder.decode
