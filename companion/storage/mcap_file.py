"""MCAP file writer: chunk by chunk, readable if truncated after any write. No threads, no clock.

The records are those of the mcap package. Its Writer is not used: it keeps every chunk index as objects
(16 MB an hour at two chunks a second) and cannot repeat a chunk that the disk rejected. Schemas and channels
are written before the chunk that first uses them, not inside it: a lost chunk takes no definition with it.
"""

from __future__ import annotations

import errno
import fcntl
import os
import zlib
from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Protocol

import zstandard
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.records import (
    Attachment,
    AttachmentIndex,
    Channel,
    Chunk,
    ChunkIndex,
    DataEnd,
    Footer,
    Header,
    McapRecord,
    Message,
    MessageIndex,
    Metadata,
    MetadataIndex,
    Schema,
    Statistics,
    SummaryOffset,
)

MAGIC = b"\x89MCAP0\r\n"


class Disk(Protocol):
    """Storage of one file; every method may raise OSError."""

    def write(self, at: int, data: bytes) -> None:
        """Write all of `data` at offset `at`."""

    def sync(self) -> None:
        """Return once everything written survives a power loss."""

    def truncate(self, size: int) -> None:
        """Cut the file to `size` bytes."""

    def close(self) -> None:
        """Close the file."""


class DiskFile:
    """A file that leaves `reserve` bytes of the disk free; `new`, or an existing one.

    If the space is insufficient, `relieve` is called with the number of bytes that must be free, and may
    free some.
    """

    def __init__(
        self,
        path: str | os.PathLike[str],
        reserve: int = 0,
        relieve: Callable[[int], object] = lambda wanted: None,
        new: bool = True,
    ) -> None:
        self._fd = os.open(path, os.O_RDWR | (os.O_CREAT | os.O_EXCL if new else 0), 0o644)
        self._reserve, self._relieve = reserve, relieve
        if new:
            fcntl.flock(self._fd, fcntl.LOCK_EX)  # marks the log as being written
            sync_folder(Path(path).parent)

    def write(self, at: int, data: bytes) -> None:
        """See `Disk`; raises ENOSPC rather than use the reserve."""
        wanted = self._reserve + len(data)
        if self._free() < wanted:
            self._relieve(wanted)
            if self._reserve and self._free() < wanted:
                raise OSError(errno.ENOSPC, f"less than {self._reserve} bytes would remain free on the disk")
        view = memoryview(data)
        while view:
            written = os.pwrite(self._fd, view, at)
            at, view = at + written, view[written:]

    def _free(self) -> int:
        room = os.fstatvfs(self._fd)
        return room.f_bavail * room.f_frsize

    def sync(self) -> None:
        """See `Disk`."""
        os.fdatasync(self._fd)

    def truncate(self, size: int) -> None:
        """See `Disk`."""
        os.ftruncate(self._fd, size)

    def close(self) -> None:
        """See `Disk`."""
        os.close(self._fd)


def sync_folder(folder: Path) -> None:
    """Make a file name created or changed in `folder` survive a power loss."""
    fd = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        os.fsync(fd)
    finally:
        os.close(fd)


def encode_records(records: Iterable[McapRecord]) -> bytes:
    """Encode `records` one after another."""
    builder = RecordBuilder()
    for record in records:
        record.write(builder)
    encoded: bytes = builder.end()
    return encoded


def encode_chunk(messages: Sequence[Message]) -> tuple[Chunk, list[MessageIndex]]:
    """Return the compressed chunk of `messages` (one at least) and its indexes, one for each channel."""
    builder = RecordBuilder()
    entries: defaultdict[int, list[tuple[int, int]]] = defaultdict(list)
    for message in messages:
        entries[message.channel_id].append((message.log_time, builder.count))
        message.write(builder)
    data = builder.end()
    chunk = Chunk(
        compression="zstd",
        data=zstandard.ZstdCompressor(level=1).compress(data),
        message_start_time=min(message.log_time for message in messages),
        message_end_time=max(message.log_time for message in messages),
        uncompressed_crc=zlib.crc32(data),
        uncompressed_size=len(data),
    )
    return chunk, [MessageIndex(channel_id, records) for channel_id, records in entries.items()]


class McapFile:
    """Writer of an MCAP file. The file is readable up to the last method that returned.

    A method that raises OSError has changed nothing and may be called again; if the disk cannot cut a partial
    write off, the next write tries again and covers it. The summary is kept compressed: 10 MB after a day.
    """

    def __init__(self, disk: Disk) -> None:
        self._disk = disk
        self.end = 0
        self._has_partial_write = False  # bytes after the end
        self._schemas: dict[int, Schema] = {}
        self._channels: dict[int, Channel] = {}
        self._indexes: list[AttachmentIndex | MetadataIndex] = []
        self._chunk_index: ChunkIndex | None = None  # of the last chunk
        self._chunk_indexes, self._compressor = bytearray(), zlib.compressobj()  # of all before it
        self._counts: Counter[int] = Counter()
        self.chunks = 0
        self._first, self._last = 2**64 - 1, 0

    @property
    def messages(self) -> int:
        """Number of messages in the chunks."""
        return self._counts.total()

    def begin(self, library: str) -> None:
        """Write the magic and the header."""
        head = MAGIC + encode_records([Header(profile="", library=library)])
        self._append(head)
        self.end = len(head)

    def metadata(self, name: str, values: Mapping[str, str]) -> None:
        """Add one metadata record."""
        self.write([Metadata(name=name, metadata=dict(values))])

    def chunk(
        self, messages: Sequence[Message], schemas: Mapping[int, Schema], channels: Mapping[int, Channel]
    ) -> None:
        """Add a chunk of `messages` and the definitions that it is the first to need."""
        new = [channels[number] for number in dict.fromkeys(message.channel_id for message in messages)]
        new = [channel for channel in new if channel.id not in self._channels]
        needed = dict.fromkeys(channel.schema_id for channel in new if channel.schema_id)
        chunk, indexes = encode_chunk(messages)
        self.write([*(schemas[i] for i in needed if i not in self._schemas), *new, chunk, *indexes])

    def write(self, records: Sequence[McapRecord]) -> None:
        """Append `records`, all or none of them. The indexes of a chunk follow it."""
        parts = [encode_records([record]) for record in records]
        self._append(b"".join(parts))
        for record, part in zip(records, parts, strict=True):
            self.enter(record, self.end, self.end + len(part))

    def enter(self, record: McapRecord, start: int, end: int) -> None:
        """Enter into the summary a record that is in the file from `start` to `end`."""
        self.end = end
        match record:
            case Schema():
                self._schemas[record.id] = record
            case Channel():
                self._channels[record.id] = record
            case Metadata():
                self._indexes.append(MetadataIndex(start, end - start, record.name))
            case Attachment(create_time=created, log_time=logged, name=name, media_type=media):
                size = len(record.data)
                self._indexes.append(AttachmentIndex(start, end - start, logged, created, size, name, media))
            case Chunk():
                self._pack_chunk_index()
                self.chunks += 1
                self._first = min(self._first, record.message_start_time)
                self._last = max(self._last, record.message_end_time)
                self._chunk_index = ChunkIndex(
                    chunk_start_offset=start,
                    chunk_length=end - start,
                    compression=record.compression,
                    compressed_size=len(record.data),
                    uncompressed_size=record.uncompressed_size,
                    message_start_time=record.message_start_time,
                    message_end_time=record.message_end_time,
                    message_index_length=0,
                    message_index_offsets={},
                )
            case MessageIndex() if self._chunk_index is not None:
                self._chunk_index.message_index_offsets[record.channel_id] = start
                self._chunk_index.message_index_length += end - start
                self._counts[record.channel_id] += len(record.records)

    def finish(self) -> None:
        """Write the summary, the footer and the closing magic."""
        self._pack_chunk_index()
        packed = bytes(self._chunk_indexes) + self._compressor.copy().flush()
        statistics = Statistics(
            message_count=self.messages,
            schema_count=len(self._schemas),
            channel_count=len(self._channels),
            attachment_count=sum(isinstance(one, AttachmentIndex) for one in self._indexes),
            metadata_count=sum(isinstance(one, MetadataIndex) for one in self._indexes),
            chunk_count=self.chunks,
            message_start_time=self._first if self.messages else 0,
            message_end_time=self._last,
            channel_message_counts=dict(self._counts),
        )
        data_end = encode_records([DataEnd(data_section_crc=0)])
        start = at = self.end + len(data_end)
        summary, offsets = b"", []
        for opcode, group in (
            (Opcode.SCHEMA, encode_records(self._schemas.values())),
            (Opcode.CHANNEL, encode_records(self._channels.values())),
            (Opcode.STATISTICS, encode_records([statistics])),
            (Opcode.CHUNK_INDEX, zlib.decompress(packed)),
            (
                Opcode.ATTACHMENT_INDEX,
                encode_records(i for i in self._indexes if isinstance(i, AttachmentIndex)),
            ),
            (Opcode.METADATA_INDEX, encode_records(i for i in self._indexes if isinstance(i, MetadataIndex))),
        ):
            if group:
                offsets.append(SummaryOffset(group_opcode=opcode, group_start=at, group_length=len(group)))
                summary, at = summary + group, at + len(group)
        summary += encode_records(offsets)
        crc = zlib.crc32(summary + encode_records([Footer(start, at, 0)])[:-4])
        self._disk.truncate(self.end)
        self._append(data_end + summary + encode_records([Footer(start, at, crc)]) + MAGIC)

    def _pack_chunk_index(self) -> None:
        if self._chunk_index is not None:
            self._chunk_indexes += self._compressor.compress(encode_records([self._chunk_index]))
            self._chunk_index = None

    def sync(self) -> None:
        """Make everything written survive a power loss."""
        self._disk.sync()

    def close(self) -> None:
        """Close the disk; without `finish` the log stays unclosed."""
        self._disk.close()

    def _append(self, data: bytes) -> None:
        self._cut_partial_write()
        try:
            self._disk.write(self.end, data)
        except OSError:
            self._has_partial_write = True
            self._cut_partial_write()
            raise

    def _cut_partial_write(self) -> None:
        if self._has_partial_write:
            with suppress(OSError):
                self._disk.truncate(self.end)
                self._has_partial_write = False
