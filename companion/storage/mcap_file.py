"""MCAP file writer: chunk by chunk, readable if truncated after any write. No threads, no clock.

Schemas and channels are written before the chunk that first uses them, not inside it, so that a chunk lost to
a full disk takes no definition with it.
"""

from __future__ import annotations

import errno
import fcntl
import os
import struct
import zlib
from array import array
from collections import defaultdict
from collections.abc import Callable, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Protocol

import zstandard

from companion.storage import container
from companion.storage.container import (
    ATTACHMENT,
    CHANNEL,
    CHUNK_INDEX,
    DATA_END,
    FOOTER,
    HEADER,
    MAGIC,
    METADATA,
    METADATA_INDEX,
    SCHEMA,
    STATISTICS,
    SUMMARY_OFFSET,
    Chunk,
    encode_chunk,
    encode_record,
    encode_string,
    encode_string_map,
)


class Disk(Protocol):
    """Storage of one file; every method may raise OSError."""

    def write(self, data: bytes) -> None:
        """Append all of `data`."""

    def read(self, at: int, size: int) -> bytes:
        """Return `size` written bytes from offset `at`."""

    def sync(self) -> None:
        """Return once everything written survives a power loss."""

    def rewind(self, size: int) -> None:
        """Set the position of the next write to `size`, without disk access."""

    def truncate(self, size: int) -> None:
        """Cut the file to `size` bytes."""

    def close(self) -> None:
        """Close the file."""


class DiskFile:
    """A file written sequentially, which leaves `reserve` bytes of the disk free.

    If the space is insufficient, `relieve` is called with the number of bytes that must be free, and may
    free some.
    """

    def __init__(
        self,
        path: str | os.PathLike[str],
        reserve: int = 0,
        relieve: Callable[[int], object] = lambda wanted: None,
    ) -> None:
        self._attach(os.open(path, os.O_RDWR | os.O_CREAT | os.O_EXCL, 0o644), reserve, relieve)
        fcntl.flock(self._fd, fcntl.LOCK_EX)  # marks the log as being written
        sync_folder(Path(path).parent)

    def _attach(self, fd: int, reserve: int, relieve: Callable[[int], object]) -> None:
        self._fd, self._reserve, self._relieve = fd, reserve, relieve
        self._at = 0

    def write(self, data: bytes) -> None:
        """See `Disk`; raises ENOSPC rather than use the reserve."""
        wanted = self._reserve + len(data)
        if self._free() < wanted:
            self._relieve(wanted)
            if self._reserve and self._free() < wanted:
                raise OSError(errno.ENOSPC, f"less than {self._reserve} bytes would remain free on the disk")
        view = memoryview(data)
        while view:
            written = os.pwrite(self._fd, view, self._at)
            self._at += written
            view = view[written:]

    def _free(self) -> int:
        room = os.fstatvfs(self._fd)
        return room.f_bavail * room.f_frsize

    def read(self, at: int, size: int) -> bytes:
        """See `Disk`."""
        data = os.pread(self._fd, size, at)
        if len(data) != size:
            raise OSError(errno.EIO, "written data cannot be read back")
        return data

    def sync(self) -> None:
        """See `Disk`."""
        os.fdatasync(self._fd)

    def rewind(self, size: int) -> None:
        """See `Disk`."""
        self._at = size

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


class McapFile:
    """Writer of an MCAP file. The file is readable up to the last method that returned.

    A method that raises OSError is undone and may be called again; if the disk cannot truncate the partial
    write, the next write overwrites it. Only 24 bytes per chunk are kept in memory; the summary of a chunk
    (half a kilobyte, 40 MB after a day) is read back from the disk by `finish`.
    """

    def __init__(self, disk: Disk, library: str) -> None:
        self._disk = disk
        self._end = 0
        self._partial_write = False  # a failed write left bytes after the end
        self._compress = zstandard.ZstdCompressor(level=1).compress
        self._schemas: dict[int, bytes] = {}
        self._channels: dict[int, bytes] = {}
        self._counts: defaultdict[int, int] = defaultdict(int)
        self._chunks = array("Q")  # per chunk: offset, offset of its message indexes, end
        self._metadata_indexes: list[bytes] = []
        self._attachments = 0
        self._first: int | None = None
        self._last = 0
        self._append(MAGIC + encode_record(HEADER, encode_string(""), encode_string(library)))

    def metadata(self, name: str, values: Mapping[str, str]) -> None:
        """Add one metadata record."""
        body = encode_record(METADATA, encode_string(name), encode_string_map(values))
        self._append(body)
        place = struct.pack("<QQ", self._end - len(body), len(body))
        self._metadata_indexes.append(encode_record(METADATA_INDEX, place, encode_string(name)))

    def attachment(self, content: bytes) -> None:
        """Add one attachment record, copied from another file."""
        self._append(encode_record(ATTACHMENT, content))
        self._attachments += 1

    def chunk(
        self,
        chunk: Chunk,
        schemas: Mapping[int, bytes],
        channels: Mapping[int, bytes],
        compressed: bytes | None = None,
    ) -> None:
        """Add `chunk`; `schemas` and `channels` are the record contents it may refer to, by id.

        `compressed` is its zstd-compressed data, if already known.
        """
        new = [name for name in chunk.index if name not in self._channels]
        needed = {name: int.from_bytes(channels[name][2:4], "little") for name in new}
        new_schemas = {i: schemas[i] for i in needed.values() if i in schemas and i not in self._schemas}
        definitions = b"".join(encode_record(SCHEMA, content) for content in new_schemas.values())
        definitions += b"".join(encode_record(CHANNEL, channels[name]) for name in new)
        body, indexes, first, last = encode_chunk(chunk, compressed or self._compress(bytes(chunk.data)))
        self._append(definitions + body + indexes)

        self._schemas |= new_schemas
        self._channels |= {name: channels[name] for name in new}
        for of, entries in chunk.index.items():
            self._counts[of] += len(entries) // 2
        at = self._end - len(indexes)
        self._chunks.extend((at - len(body), at, self._end))
        self._first = first if self._first is None else min(first, self._first)
        self._last = max(last, self._last)

    def finish(self) -> None:
        """Write the summary, the footer and the closing magic."""
        counts = b"".join(struct.pack("<HQ", of, count) for of, count in self._counts.items())
        statistics = struct.pack(
            "<QHIIIIQQI",
            sum(self._counts.values()),
            len(self._schemas),
            len(self._channels),
            self._attachments,
            len(self._metadata_indexes),
            len(self._chunks) // 3,
            self._first or 0,
            self._last,
            len(counts),
        )
        groups = (
            (SCHEMA, [encode_record(SCHEMA, content) for content in self._schemas.values()]),
            (CHANNEL, [encode_record(CHANNEL, content) for content in self._channels.values()]),
            (STATISTICS, [encode_record(STATISTICS, statistics, counts)]),
            (CHUNK_INDEX, map(self._chunk_index, *(self._chunks[i::3] for i in range(3)))),
            (METADATA_INDEX, self._metadata_indexes),
        )
        data_end = encode_record(DATA_END, struct.pack("<I", 0))
        start = self._end + len(data_end)
        summary, offsets = b"", b""
        for opcode, members in groups:
            group = b"".join(members)
            if group:
                place = struct.pack("<BQQ", opcode, start + len(summary), len(group))
                offsets += encode_record(SUMMARY_OFFSET, place)
                summary += group
        tail = summary + offsets + struct.pack("<BQQQ", FOOTER, 20, start, start + len(summary))
        self._truncate()
        self._append(data_end + tail + struct.pack("<I", zlib.crc32(tail)) + MAGIC)

    def _chunk_index(self, start: int, at: int, end: int) -> bytes:
        """Return the index record of the chunk at `start`, whose message indexes are from `at` to `end`."""
        first, last, size, compressed = container.parse_chunk_head(
            self._disk.read(start, container.CHUNK_HEAD_SIZE)
        )
        places = b"".join(
            struct.pack("<HQ", of, at + offset)
            for offset, of in container.iter_message_indexes(self._disk.read(at, end - at))
        )
        return encode_record(
            CHUNK_INDEX,
            struct.pack("<QQQQ", first, last, start, at - start),
            struct.pack("<I", len(places)) + places,
            struct.pack("<Q", end - at) + encode_string("zstd"),
            struct.pack("<QQ", compressed, size),
        )

    def sync(self) -> None:
        """Make everything written survive a power loss."""
        self._disk.sync()

    def close(self) -> None:
        """Close the disk; without `finish` the log stays unclosed."""
        self._disk.close()

    def _append(self, data: bytes) -> None:
        self._try_truncate()
        try:
            self._disk.write(data)
        except OSError:
            self._disk.rewind(self._end)
            self._partial_write = True
            self._try_truncate()
            raise
        self._end += len(data)

    def _try_truncate(self) -> None:
        with suppress(OSError):
            self._truncate()

    def _truncate(self) -> None:
        if self._partial_write:
            self._disk.truncate(self._end)
            self._partial_write = False
