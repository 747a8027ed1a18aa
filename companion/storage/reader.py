"""MCAP log reader: records, messages and definitions of a closed or torn file, ours or another recorder's.

The mcap package parses the records and the chunks. Its readers stop at a torn end and trust every length, so
the records are found here: one of incomplete length ends a log, one of wrong content raises DamagedError.
It does not decode messages.
"""

from __future__ import annotations

import errno
import os
import stat
import struct
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from io import BytesIO
from pathlib import Path
from typing import BinaryIO, NamedTuple

import lz4.frame
import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Channel, Chunk, McapRecord, Message, Metadata, Schema
from mcap.stream_reader import StreamReader

from companion.storage.mcap_file import MAGIC

ACTIVE = ".active"
"""Suffix of a log that is not closed."""

MAX_RECORD = 1 << 25
"""Bytes of a record, and of a decompressed chunk; those of our chunks are 128 KiB. Larger ones are damage."""
MAX_EXPANSION = 100
"""Ratio of a log's decompressed and compressed size, beyond the first `MAX_RECORD` bytes; ours reach 10."""

_HEAD = struct.Struct("<BQ")  # opcode, length
_MESSAGE = struct.Struct("<HIQQ")  # channel, sequence, log time, publish time; the data follows


class LogError(OSError):
    """A log that cannot be written or read; the text is one sentence for the user."""


class DamagedError(ValueError):
    """Inconsistent bytes, such as a wrong checksum or a length beyond the end of its record."""


def open_regular(path: Path) -> BinaryIO:
    """Open a file for reading. Raises OSError for a pipe or a device too, which could be read without end."""
    if not stat.S_ISREG(path.stat().st_mode):
        raise OSError(errno.EINVAL, "not a regular file", str(path))
    return path.open("rb")


class RawRecord(NamedTuple):
    """A complete record of a file: its offset, and its bytes with opcode and length.

    Only these two of a record larger than `MAX_RECORD`.
    """

    start: int
    data: bytes

    @property
    def opcode(self) -> int:
        """Opcode of the record."""
        return self.data[0]

    @property
    def end(self) -> int:
        """Offset of the next record."""
        return self.start + _HEAD.size + int(_HEAD.unpack_from(self.data)[1])

    def parse(self) -> McapRecord:
        """Parse the record, of a known opcode. Raises DamagedError if it is inconsistent or too large."""
        if (size := self.end - self.start) != len(self.data):
            raise DamagedError(f"a record has {size} bytes (limit {MAX_RECORD})")
        try:
            stream = StreamReader(BytesIO(self.data), skip_magic=True, emit_chunks=True)
            return next(stream.records)
        except (McapError, struct.error, UnicodeDecodeError, OverflowError) as error:
            raise DamagedError(f"a record cannot be parsed ({error or type(error).__name__})") from None


class LogReader:
    """A log opened for reading; `closed` is False for a torn one.

    Updated while reading: `end`, where the last complete record ends; `chunks`; `metadata` by name; `schemas`
    and `channels` by id.
    """

    def __init__(self, path: Path, file: BinaryIO, size: int) -> None:
        self.path, self.file, self.size = path, file, size
        file.seek(max(0, size - 37))
        tail = file.read(37)
        self.closed = tail[:9] == _HEAD.pack(Opcode.FOOTER, 20) and tail[29:] == MAGIC
        self.end = len(MAGIC)
        self.chunks = 0
        self._expanded = 0  # bytes of all chunks decompressed
        self.metadata: dict[str, dict[str, str]] = {}
        self.schemas: dict[int, Schema] = {}
        self.channels: dict[int, Channel] = {}

    def records(self) -> Iterator[RawRecord]:
        """Yield every complete record of the data, up to where its end is stated or the file is torn."""
        self.file.seek(self.end)
        has_data = True
        while len(head := self.file.read(_HEAD.size)) == _HEAD.size:
            opcode, length = _HEAD.unpack(head)
            if opcode == 0 or self.end + len(head) + length > self.size:
                return
            small = length <= MAX_RECORD
            raw = RawRecord(self.end, head + self.file.read(length) if small else head)
            self.end = raw.end
            if not small:
                self.file.seek(self.end)
            has_data = has_data and opcode not in (Opcode.DATA_END, Opcode.FOOTER)
            if has_data and opcode < Opcode.DATA_END:  # others are private or of a later format
                yield raw
            elif opcode == Opcode.FOOTER:
                self.end = self.size if self.closed else self.end
                return

    def messages(self) -> Iterator[Message]:
        """Yield the messages in the order written. Raises DamagedError at a record of wrong content."""
        for raw in self.records():
            if raw.opcode in (Opcode.CHUNK, Opcode.MESSAGE, Opcode.SCHEMA, Opcode.CHANNEL):
                yield from self._unpacked(raw.parse())
            elif raw.opcode == Opcode.METADATA:
                self.keep_metadata(raw)

    def unpack(self, record: McapRecord) -> list[Message]:
        """Return the messages of a chunk or message record; keep the definitions."""
        return list(self._unpacked(record))

    def _unpacked(self, record: McapRecord) -> Iterator[Message]:
        """Yield what `unpack` returns: small messages take several times the memory of their chunk."""
        for one in self._chunk_records(record) if isinstance(record, Chunk) else (record,):
            if isinstance(one, Message):
                yield one
            elif isinstance(one, Schema):
                self.schemas[one.id] = one
            elif isinstance(one, Channel):
                self.channels[one.id] = one
        self.chunks += isinstance(record, Chunk)

    def _chunk_records(self, chunk: Chunk) -> Iterator[McapRecord]:
        """Yield the records of a chunk. Raises DamagedError if size, checksum or content are wrong."""
        size = chunk.uncompressed_size
        self._expanded += size
        if size > MAX_RECORD:
            raise DamagedError(f"a chunk states {size} bytes (limit {MAX_RECORD})")
        if self._expanded > MAX_RECORD + MAX_EXPANSION * self.size:
            raise DamagedError(f"its chunks expand to more than {MAX_EXPANSION} times its size")
        try:
            yield from _break_up(_decompress(chunk))
        except (
            McapError,
            zstandard.ZstdError,
            struct.error,
            ValueError,
            OverflowError,
            RuntimeError,
        ) as error:
            raise DamagedError(f"a chunk cannot be read ({error or type(error).__name__})") from None

    def keep_metadata(self, raw: RawRecord) -> None:
        """Parse a metadata record and keep it in `metadata`."""
        record = raw.parse()
        assert isinstance(record, Metadata)
        self.metadata[record.name] = record.metadata

    def is_defined(self, channel_id: int) -> bool:
        """Return whether a channel and its schema are defined."""
        channel = self.channels.get(channel_id)
        return channel is not None and (channel.schema_id == 0 or channel.schema_id in self.schemas)

    def damage_error(self, error: Exception) -> LogError:
        """Convert an error found while reading into a LogError for the user."""
        return LogError(
            f"{self.path}: damaged near byte {self.end}: {' '.join(str(error).split())[:200]};"
            " `companion log recover` saves the rest"
        )


def _decompress(chunk: Chunk) -> bytes:
    """Return the content of a chunk; no more than its stated size is decompressed.

    Raises DamagedError if size or checksum are wrong, or the exceptions of the decompressor.
    """
    data: bytes = chunk.data
    size = chunk.uncompressed_size
    if not size:
        return b""
    if chunk.compression == "zstd":
        # a frame's own size would override the limit; -1: not stated
        if zstandard.frame_content_size(data) not in (-1, size):
            raise DamagedError("its size differs from the stated one")
        data = zstandard.decompress(data, size)
    elif chunk.compression == "lz4":
        data = lz4.frame.LZ4FrameDecompressor().decompress(data, max_length=size + 1)
    elif chunk.compression:
        raise DamagedError(f"unknown compression {chunk.compression[:20]!r}")
    if len(data) != size:
        raise DamagedError("its size differs from the stated one")
    if chunk.uncompressed_crc not in (0, zlib.crc32(data)):
        raise DamagedError("wrong checksum")
    return data


def _break_up(data: bytes) -> Iterator[McapRecord]:
    """Yield the messages and definitions in a chunk's content. Raises ValueError, struct.error, McapError."""
    at = 0
    while at < len(data):
        opcode, length = _HEAD.unpack_from(data, at)
        start, at = at + _HEAD.size, at + _HEAD.size + length
        if at > len(data):
            raise DamagedError("one of its records is incomplete")
        if opcode == Opcode.MESSAGE:
            if length < _MESSAGE.size:
                raise DamagedError("one of its messages is too short")
            channel, sequence, log_time, publish_time = _MESSAGE.unpack_from(data, start)
            content = data[start + _MESSAGE.size : at]
            yield Message(channel, log_time, content, publish_time, sequence)
        elif opcode == Opcode.CHANNEL:
            yield Channel.read(ReadDataStream(BytesIO(data[start:at])))
        elif opcode == Opcode.SCHEMA:
            yield Schema.read(ReadDataStream(BytesIO(data[start:at])))


@contextmanager
def open_log(path: str | os.PathLike[str]) -> Iterator[LogReader]:
    """Open the log at `path`. Raises LogError if it is missing, empty, not MCAP, or cut before its header.

    An exception while the log is read becomes a LogError too.
    """
    path = Path(path)
    try:
        file = open_regular(path)
    except OSError as error:
        raise LogError(f"{path}: cannot be read: {error.strerror or error}") from None
    with file:
        size = os.fstat(file.fileno()).st_size
        magic = file.read(len(MAGIC))
        if not magic:
            raise LogError(f"{path} is empty: nothing was recorded")
        if not MAGIC.startswith(magic):
            is_named_so = path.suffix.lower() in (".mcap", ACTIVE)
            advice = "" if is_named_so else "; convert it first with `companion log convert`"
            raise LogError(f"{path} is not an MCAP log (it does not begin with MCAP's magic){advice}")
        first = next(LogReader(path, file, size).records(), None)
        if first is None:
            raise LogError(f"{path} is truncated within its header and contains no messages")
        if first.opcode != Opcode.HEADER:
            raise LogError(f"{path} is not an MCAP log (its first record is not a header)")
        source = LogReader(path, file, size)
        try:
            yield source
        except (OSError, DamagedError):
            raise
        except Exception as error:  # the last guard: no content of a file ends the program
            raise source.damage_error(error) from error


def is_closed(path: str | os.PathLike[str]) -> bool:
    """Return whether the log at `path` was closed. Raises LogError as `open_log` does."""
    with open_log(path) as source:
        return source.closed
