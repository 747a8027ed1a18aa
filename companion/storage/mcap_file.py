"""Lays an MCAP file down on a disk, chunk by chunk, so that it can be cut off after any of its writes.

It knows where the bytes go and what the summary at the end must say; it starts no thread and asks no clock.
Schemas and channels stand before the chunk that first uses them, not inside it: a chunk lost to a full disk
then takes no definition with it.
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
    pack,
    record,
    text,
    texts,
)


class Disk(Protocol):
    """Where a file's bytes go; every method may raise OSError."""

    def write(self, data: bytes) -> None:
        """Append all of `data`."""

    def read(self, at: int, size: int) -> bytes:
        """Return `size` bytes of what was written, from `at` on."""

    def sync(self) -> None:
        """Return once what was written survives a loss of power."""

    def rewind(self, size: int) -> None:
        """Let the next write go to after `size` bytes; asks nothing of the disk."""

    def truncate(self, size: int) -> None:
        """Cut off what stands after `size` bytes."""

    def close(self) -> None:
        """Let go."""


class DiskFile:
    """A file that is written once from front to back; `reserve` bytes of its disk are left to others.

    `relieve` is called where the room is gone, with the bytes that must be free, and may make some.
    """

    def __init__(
        self,
        path: str | os.PathLike[str],
        reserve: int = 0,
        relieve: Callable[[int], object] = lambda wanted: None,
    ) -> None:
        self._take(os.open(path, os.O_RDWR | os.O_CREAT | os.O_EXCL, 0o644), reserve, relieve)
        fcntl.flock(self._fd, fcntl.LOCK_EX)  # tells a log being written from one left behind
        sync_folder(Path(path).parent)

    def _take(self, fd: int, reserve: int, relieve: Callable[[int], object]) -> None:
        self._fd, self._reserve, self._relieve = fd, reserve, relieve
        self._at = 0

    def write(self, data: bytes) -> None:
        """See `Disk`; refuses where it would eat into the reserve."""
        wanted = self._reserve + len(data)
        if self._free() < wanted:
            self._relieve(wanted)
            if self._reserve and self._free() < wanted:
                raise OSError(errno.ENOSPC, f"less than {self._reserve} bytes would be left on the disk")
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
            raise OSError(errno.EIO, "what was written cannot be read")
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
    """Put a name just made or changed in `folder` where a loss of power does not reach it."""
    fd = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        os.fsync(fd)
    finally:
        os.close(fd)


class Store:
    """Lays an MCAP file down on `disk`. After every method that returned, the file is readable so far.

    A method that raises OSError has been undone and may be called again; where the disk will not cut off what
    it took, the next goes over it. Of a chunk it remembers in 24 bytes where it is: what the summary says of
    it (half a kilobyte; 40 MB after a day) is read from the disk again.
    """

    def __init__(self, disk: Disk, library: str) -> None:
        self._disk = disk
        self._end = 0
        self._uncut = False  # a part of what was refused stands after the end
        self._compress = zstandard.ZstdCompressor(level=1).compress
        self._schemas: dict[int, bytes] = {}
        self._channels: dict[int, bytes] = {}
        self._counts: defaultdict[int, int] = defaultdict(int)
        self._chunks = array("Q")  # of each: where it begins, where its message indexes do, and their end
        self._metadata_indexes: list[bytes] = []
        self._attachments = 0
        self._first: int | None = None
        self._last = 0
        self._append(MAGIC + record(HEADER, text(""), text(library)))

    def metadata(self, name: str, values: Mapping[str, str]) -> None:
        """Add one metadata record."""
        body = record(METADATA, text(name), texts(values))
        self._append(body)
        place = struct.pack("<QQ", self._end - len(body), len(body))
        self._metadata_indexes.append(record(METADATA_INDEX, place, text(name)))

    def attachment(self, content: bytes) -> None:
        """Add one attachment record as it stood in another file."""
        self._append(record(ATTACHMENT, content))
        self._attachments += 1

    def chunk(
        self,
        chunk: Chunk,
        schemas: Mapping[int, bytes],
        channels: Mapping[int, bytes],
        squeezed: bytes | None = None,
    ) -> None:
        """Add `chunk`; `schemas` and `channels` are the contents of the records it may refer to, by id.

        `squeezed` is its data compressed by zstd, where that is known.
        """
        new = [name for name in chunk.index if name not in self._channels]
        needed = {name: int.from_bytes(channels[name][2:4], "little") for name in new}
        new_schemas = {i: schemas[i] for i in needed.values() if i in schemas and i not in self._schemas}
        definitions = b"".join(record(SCHEMA, content) for content in new_schemas.values())
        definitions += b"".join(record(CHANNEL, channels[name]) for name in new)
        body, indexes, first, last = pack(chunk, squeezed or self._compress(bytes(chunk.data)))
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
            (SCHEMA, [record(SCHEMA, content) for content in self._schemas.values()]),
            (CHANNEL, [record(CHANNEL, content) for content in self._channels.values()]),
            (STATISTICS, [record(STATISTICS, statistics, counts)]),
            (CHUNK_INDEX, map(self._chunk_index, *(self._chunks[i::3] for i in range(3)))),
            (METADATA_INDEX, self._metadata_indexes),
        )
        data_end = record(DATA_END, struct.pack("<I", 0))
        start = self._end + len(data_end)
        summary, offsets = b"", b""
        for opcode, members in groups:
            group = b"".join(members)
            if group:
                place = struct.pack("<BQQ", opcode, start + len(summary), len(group))
                offsets += record(SUMMARY_OFFSET, place)
                summary += group
        tail = summary + offsets + struct.pack("<BQQQ", FOOTER, 20, start, start + len(summary))
        self._cut()
        self._append(data_end + tail + struct.pack("<I", zlib.crc32(tail)) + MAGIC)

    def _chunk_index(self, start: int, at: int, end: int) -> bytes:
        """The summary's record of the chunk at `start`, whose message indexes lie from `at` to `end`."""
        first, last, size, squeezed = container.chunk_head(self._disk.read(start, container.CHUNK_HEAD_SIZE))
        places = b"".join(
            struct.pack("<HQ", of, at + offset)
            for offset, of in container.indexed_channels(self._disk.read(at, end - at))
        )
        return record(
            CHUNK_INDEX,
            struct.pack("<QQQQ", first, last, start, at - start),
            struct.pack("<I", len(places)) + places,
            struct.pack("<Q", end - at) + text("zstd"),
            struct.pack("<QQ", squeezed, size),
        )

    def sync(self) -> None:
        """Put what was written where a loss of power does not reach it."""
        self._disk.sync()

    def close(self) -> None:
        """Let the disk go; without `finish` before it the file stays open-ended."""
        self._disk.close()

    def _append(self, data: bytes) -> None:
        self._try_to_cut()
        try:
            self._disk.write(data)
        except OSError:
            self._disk.rewind(self._end)
            self._uncut = True
            self._try_to_cut()
            raise
        self._end += len(data)

    def _try_to_cut(self) -> None:
        with suppress(OSError):
            self._cut()

    def _cut(self) -> None:
        if self._uncut:
            self._disk.truncate(self._end)
            self._uncut = False
