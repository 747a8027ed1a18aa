"""MCAP container codec: records <-> bytes, messages <-> chunk (https://mcap.dev/spec, version 0).

Pure: no disks, no clocks, no meaning of messages. The parser trusts no length field: inconsistent data raises
DamagedError, a truncated end stops the iteration.

The mcap package is used in the tests only: its Writer (1.6) can neither close a chunk every second nor undo
a chunk that the disk rejected, and its readers stop at a torn end, where the last chunks of a flight are. By
`companion bench log` it is also 3 times slower to write and 5 times slower to read.
"""

from __future__ import annotations

import struct
import zlib
from collections import defaultdict
from collections.abc import Iterator, Mapping
from typing import BinaryIO, NamedTuple

import zstandard

try:
    import lz4.frame as lz4  # type: ignore[import-untyped]
except ImportError:  # needed only for logs of other recorders; ours are zstd
    lz4 = None

MAGIC = b"\x89MCAP0\r\n"
HEADER, FOOTER, SCHEMA, CHANNEL, MESSAGE, CHUNK, MESSAGE_INDEX, CHUNK_INDEX = range(1, 9)
ATTACHMENT, ATTACHMENT_INDEX, STATISTICS, METADATA, METADATA_INDEX, SUMMARY_OFFSET, DATA_END = range(9, 16)

MAX_UNCOMPRESSED = 1 << 28
"""Larger chunks are rejected, so that a forged size field cannot exhaust the memory."""

_HEAD = struct.Struct("<BQ")
_MESSAGE = struct.Struct("<BQHIQQ")  # opcode, length, channel, sequence, log time, publish time
_CHUNK = struct.Struct("<QQQI")  # first, last log time, uncompressed size, crc
_INDEX = struct.Struct("<BQH")  # opcode, length, channel
CHUNK_HEAD_SIZE = _HEAD.size + _CHUNK.size + 4 + len("zstd") + 8


class DamagedError(ValueError):
    """Inconsistent bytes, such as a wrong checksum or a length beyond the end of its record."""


class Channel(NamedTuple):
    """Topic, encoding and schema name of a channel; `schema` is empty if the channel has none."""

    topic: str
    encoding: str
    schema: str


class RawRecord(NamedTuple):
    """A complete record of a file: its offset, opcode and content."""

    offset: int
    opcode: int
    content: bytes


# ---------------------------------------------------------------------------------------------------------
# Records <-> bytes
# ---------------------------------------------------------------------------------------------------------


def encode_record(opcode: int, *parts: bytes) -> bytes:
    """Encode one record: opcode, length, content."""
    content = b"".join(parts)
    return _HEAD.pack(opcode, len(content)) + content


def scan_records(file: BinaryIO, size: int) -> Iterator[RawRecord]:
    """Yield every complete record up to the footer.

    `file` is positioned after its magic, `size` is in bytes.
    """
    offset = len(MAGIC)
    while offset + _HEAD.size <= size:
        opcode, length = _HEAD.unpack(file.read(_HEAD.size))
        if opcode == 0 or offset + _HEAD.size + length > size:
            return
        yield RawRecord(offset, opcode, file.read(length))
        offset += _HEAD.size + length
        if opcode == FOOTER:
            return


def is_closed(file: BinaryIO, size: int) -> bool:
    """Return whether the file ends with a footer and the magic, as a closed log does."""
    if size < len(MAGIC) + 29 + len(MAGIC):
        return False
    file.seek(size - 37)
    tail = file.read(37)
    file.seek(len(MAGIC))
    return tail[:9] == _HEAD.pack(FOOTER, 20) and tail[-8:] == MAGIC


def encode_string(value: str) -> bytes:
    """Encode a string with a length prefix."""
    data = value.encode()
    return struct.pack("<I", len(data)) + data


def encode_string_map(values: Mapping[str, str]) -> bytes:
    """Encode a map of strings with its length in bytes as a prefix."""
    data = b"".join(encode_string(key) + encode_string(value) for key, value in values.items())
    return struct.pack("<I", len(data)) + data


class FieldReader:
    """Sequential reader of the fields of a record; raises DamagedError beyond the end of the content."""

    def __init__(self, content: bytes) -> None:
        self._content = content
        self.at = 0

    def read_bytes(self, size: int) -> bytes:
        """Read the next `size` bytes."""
        data = self._content[self.at : self.at + size]
        if len(data) != size:
            raise DamagedError("a field extends beyond its record")
        self.at += size
        return data

    def read_uint(self, size: int) -> int:
        """Read an unsigned integer of `size` bytes."""
        return int.from_bytes(self.read_bytes(size), "little")

    def read_string(self) -> str:
        """Read a string; inverse of `encode_string`."""
        try:
            return self.read_bytes(self.read_uint(4)).decode()
        except UnicodeDecodeError:
            raise DamagedError("a string is not UTF-8") from None

    def read_string_map(self) -> dict[str, str]:
        """Read a map of strings; inverse of `encode_string_map`."""
        end = self.read_uint(4) + self.at
        values = {}
        while self.at < end:
            key = self.read_string()
            values[key] = self.read_string()
        return values


def parse_library(content: bytes) -> str:
    """Return the library field of a header record."""
    fields = FieldReader(content)
    fields.read_string()
    return fields.read_string()


def parse_metadata(content: bytes) -> tuple[str, dict[str, str]]:
    """Return the name and the map of a metadata record."""
    fields = FieldReader(content)
    return fields.read_string(), fields.read_string_map()


def parse_schema(content: bytes) -> tuple[int, str]:
    """Return the id and the name of a schema record."""
    fields = FieldReader(content)
    return fields.read_uint(2), fields.read_string()


def parse_channel(content: bytes) -> tuple[int, int, str, str]:
    """Return id, schema id (0 for none), topic and encoding of a channel record."""
    fields = FieldReader(content)
    return fields.read_uint(2), fields.read_uint(2), fields.read_string(), fields.read_string()


# ---------------------------------------------------------------------------------------------------------
# Messages <-> chunk
# ---------------------------------------------------------------------------------------------------------


class Chunk:
    """Messages in order of arrival, and an index by channel: [log time, offset, ...]."""

    __slots__ = ("data", "index")

    def __init__(self) -> None:
        self.data = bytearray()
        self.index: defaultdict[int, list[int]] = defaultdict(list)

    def add(self, channel: int, sequence: int, log_ns: int, publish_ns: int, data: bytes) -> None:
        """Append one message (hot path: runs once per message)."""
        self.index[channel] += (log_ns, len(self.data))
        self.data += _MESSAGE.pack(MESSAGE, 22 + len(data), channel, sequence, log_ns, publish_ns) + data

    @property
    def messages(self) -> int:
        """Number of messages in the chunk."""
        return sum(map(len, self.index.values())) // 2


def encode_chunk(chunk: Chunk, compressed: bytes) -> tuple[bytes, bytes, int, int]:
    """Encode a chunk whose data is `compressed`: chunk record, message indexes, first and last log time."""
    first = min(min(entries[::2]) for entries in chunk.index.values())
    last = max(max(entries[::2]) for entries in chunk.index.values())
    body = encode_record(
        CHUNK,
        _CHUNK.pack(first, last, len(chunk.data), zlib.crc32(chunk.data)),
        encode_string("zstd"),
        struct.pack("<Q", len(compressed)),
        compressed,
    )
    indexes = b"".join(
        encode_record(MESSAGE_INDEX, struct.pack(f"<HI{len(entries)}Q", of, 8 * len(entries), *entries))
        for of, entries in chunk.index.items()
    )
    return body, indexes, first, last


def parse_chunk_head(head: bytes) -> tuple[int, int, int, int]:
    """Return first and last log time, size and compressed size from the first CHUNK_HEAD_SIZE bytes."""
    first, last, size, _ = _CHUNK.unpack_from(head, _HEAD.size)
    return first, last, size, int.from_bytes(head[-8:], "little")


def iter_message_indexes(indexes: bytes) -> Iterator[tuple[int, int]]:
    """Yield (offset, channel) of each message index in `indexes`."""
    at = 0
    while at < len(indexes):
        _, length, of = _INDEX.unpack_from(indexes, at)
        yield at, of
        at += _HEAD.size + length


def decompress_chunk(content: bytes) -> bytes:
    """Return the uncompressed records of a chunk. Raises DamagedError if size or checksum do not match."""
    fields = FieldReader(content)
    _, _, size, crc = _CHUNK.unpack(fields.read_bytes(_CHUNK.size))
    compression = fields.read_string()
    data = fields.read_bytes(fields.read_uint(8))
    if size > MAX_UNCOMPRESSED:
        raise DamagedError(f"a chunk states {size} bytes (limit {MAX_UNCOMPRESSED})")
    try:
        if compression == "zstd":
            if size and zstandard.get_frame_parameters(data).content_size not in (size, -1, 2**64 - 1):
                raise DamagedError("a chunk's size differs from the stated one")
            data = zstandard.ZstdDecompressor().decompress(data, max_output_size=size) if size else b""
        elif compression == "lz4":
            if lz4 is None:
                raise DamagedError("a chunk is compressed with lz4, which is not installed (pip install lz4)")
            data = lz4.LZ4FrameDecompressor().decompress(data, max_length=size)
        elif compression:
            raise DamagedError(f"a chunk has the unsupported compression {compression[:20]!r}")
    except (zstandard.ZstdError, RuntimeError, EOFError) as error:
        raise DamagedError(f"a chunk cannot be decompressed ({error})") from None
    if len(data) != size or (crc and zlib.crc32(data) != crc):
        raise DamagedError("a chunk's checksum is wrong")
    return bytes(data)


def compressed_data(content: bytes) -> bytes | None:
    """Return the zstd-compressed records of a chunk; None if another compression is used."""
    fields = FieldReader(content)
    fields.read_bytes(_CHUNK.size)
    return fields.read_bytes(fields.read_uint(8)) if fields.read_string() == "zstd" else None


def salvage_torn_chunk(torn: bytes) -> bytes:
    """Return the readable part of a truncated chunk record (opcode and length first). Never raises.

    Compression blocks decompress completely or not at all, so a short chunk gives nothing.
    """
    if torn[:1] != bytes([CHUNK]):
        return b""
    try:
        fields = FieldReader(torn[_HEAD.size :])
        size = _CHUNK.unpack(fields.read_bytes(_CHUNK.size))[2]
        compression = fields.read_string()
        fields.read_uint(8)
        rest = torn[_HEAD.size + fields.at :]
        if compression == "zstd" and 0 < size <= MAX_UNCOMPRESSED:
            return _decompress_whole_blocks(rest, size)
        return rest if compression == "" else b""
    except (DamagedError, zstandard.ZstdError):
        return b""


def _decompress_whole_blocks(torn: bytes, size: int) -> bytes:
    """Decompress the complete blocks of a zstd frame, up to `size` bytes: it may expand to gigabytes."""
    blocks = []
    with zstandard.ZstdDecompressor(max_window_size=MAX_UNCOMPRESSED).stream_reader(torn) as reader:
        while size > 0 and (block := reader.read(min(size, 1 << 17))):
            blocks.append(block)
            size -= len(block)
    return b"".join(blocks)


def iter_messages(data: bytes) -> Iterator[tuple[int, int, int, int, int, bytes]]:
    """Yield (opcode, channel, sequence, log time, publish time, data) of every complete record of a chunk.

    For records other than messages the four numbers are 0 and `data` is the content of the record.
    """
    at, end = 0, len(data)
    parse, size = _MESSAGE.unpack_from, _MESSAGE.size
    while at + size <= end:
        opcode, length, of, sequence, log_ns, publish_ns = parse(data, at)
        stop = at + 9 + length
        if stop > end:
            return
        if opcode == MESSAGE:
            yield opcode, of, sequence, log_ns, publish_ns, data[at + size : stop]
        else:
            yield opcode, 0, 0, 0, 0, data[at + 9 : stop]
        at = stop
    while at + 9 <= end:  # a schema or channel record shorter than a message header
        opcode, length = _HEAD.unpack_from(data, at)
        if at + 9 + length > end:
            return
        yield opcode, 0, 0, 0, 0, data[at + 9 : at + 9 + length]
        at += 9 + length
