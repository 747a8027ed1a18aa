"""The MCAP container, byte for byte: records <-> bytes, messages <-> chunk.

It knows the layout (https://mcap.dev/spec, version 0) and nothing of disks, clocks or what a message means.
Parsing trusts no length it is given: what contradicts itself raises Damaged, what is torn off ends the walk.

Why not the mcap package, which the tests read every log with: its Writer (1.6) offers no way to close a chunk
each second nor to take back one that the disk refused, and its readers stop at a torn end, where a flight's
last chunks are. By `companion bench log` it also costs 3 times as much to write and 5 times as much to read.
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
except ImportError:  # our own logs are zstd; foreign ones may need it
    lz4 = None

MAGIC = b"\x89MCAP0\r\n"
HEADER, FOOTER, SCHEMA, CHANNEL, MESSAGE, CHUNK, MESSAGE_INDEX, CHUNK_INDEX = range(1, 9)
ATTACHMENT, ATTACHMENT_INDEX, STATISTICS, METADATA, METADATA_INDEX, SUMMARY_OFFSET, DATA_END = range(9, 16)

MOST_UNCOMPRESSED = 1 << 28
"""A chunk that claims more bytes than this is not opened: a few hostile bytes must not take the memory."""

_HEAD = struct.Struct("<BQ")
_MESSAGE = struct.Struct("<BQHIQQ")  # opcode, length, channel, sequence, log time, publish time
_CHUNK = struct.Struct("<QQQI")  # first, last log time, uncompressed size, crc
_INDEX = struct.Struct("<BQH")  # opcode, length, channel
CHUNK_HEAD_SIZE = _HEAD.size + _CHUNK.size + 4 + len("zstd") + 8


class Damaged(ValueError):
    """Bytes that contradict themselves: a bad checksum, a length that runs out of its record."""


class Channel(NamedTuple):
    """What a channel's messages are: `schema` is the schema's name, empty where there is none."""

    topic: str
    encoding: str
    schema: str


class Whole(NamedTuple):
    """One whole record as it stands in a file: where it begins, its opcode and its content."""

    offset: int
    opcode: int
    content: bytes


# ---------------------------------------------------------------------------------------------------------
# Records <-> bytes
# ---------------------------------------------------------------------------------------------------------


def record(opcode: int, *parts: bytes) -> bytes:
    """One record: opcode, length, content."""
    content = b"".join(parts)
    return _HEAD.pack(opcode, len(content)) + content


def scan(file: BinaryIO, size: int) -> Iterator[Whole]:
    """Every whole record of `file` (positioned after its magic, `size` bytes in all) up to its footer."""
    offset = len(MAGIC)
    while offset + _HEAD.size <= size:
        opcode, length = _HEAD.unpack(file.read(_HEAD.size))
        if opcode == 0 or offset + _HEAD.size + length > size:
            return
        yield Whole(offset, opcode, file.read(length))
        offset += _HEAD.size + length
        if opcode == FOOTER:
            return


def is_closed(file: BinaryIO, size: int) -> bool:
    """Whether a file ends the way a closed one does: a footer and the magic."""
    if size < len(MAGIC) + 29 + len(MAGIC):
        return False
    file.seek(size - 37)
    tail = file.read(37)
    file.seek(len(MAGIC))
    return tail[:9] == _HEAD.pack(FOOTER, 20) and tail[-8:] == MAGIC


def text(value: str) -> bytes:
    """A string behind its length."""
    data = value.encode()
    return struct.pack("<I", len(data)) + data


def texts(values: Mapping[str, str]) -> bytes:
    """A map of strings behind its length in bytes."""
    data = b"".join(text(key) + text(value) for key, value in values.items())
    return struct.pack("<I", len(data)) + data


class Fields:
    """Reads the fields of one record's content in order; raises Damaged where they run out of it."""

    def __init__(self, content: bytes) -> None:
        self._content = content
        self.at = 0

    def take(self, size: int) -> bytes:
        """The next `size` bytes."""
        data = self._content[self.at : self.at + size]
        if len(data) != size:
            raise Damaged("a field runs out of its record")
        self.at += size
        return data

    def number(self, size: int) -> int:
        """The next unsigned integer of `size` bytes."""
        return int.from_bytes(self.take(size), "little")

    def text(self) -> str:
        """Mirror of `text`."""
        try:
            return self.take(self.number(4)).decode()
        except UnicodeDecodeError:
            raise Damaged("a string is not UTF-8") from None

    def texts(self) -> dict[str, str]:
        """Mirror of `texts`."""
        end = self.number(4) + self.at
        values = {}
        while self.at < end:
            key = self.text()
            values[key] = self.text()
        return values


def library(content: bytes) -> str:
    """What a header says it was written by."""
    fields = Fields(content)
    fields.text()
    return fields.text()


def metadata(content: bytes) -> tuple[str, dict[str, str]]:
    """Name and map of a metadata record."""
    fields = Fields(content)
    return fields.text(), fields.texts()


def schema(content: bytes) -> tuple[int, str]:
    """Id and name of a schema record."""
    fields = Fields(content)
    return fields.number(2), fields.text()


def channel(content: bytes) -> tuple[int, int, str, str]:
    """Id, id of its schema (0 for none), topic and encoding of a channel record."""
    fields = Fields(content)
    return fields.number(2), fields.number(2), fields.text(), fields.text()


# ---------------------------------------------------------------------------------------------------------
# Messages <-> chunk
# ---------------------------------------------------------------------------------------------------------


class Chunk:
    """Messages in the order they came, and per channel where each stands: [log time, offset, ...]."""

    __slots__ = ("data", "index")

    def __init__(self) -> None:
        self.data = bytearray()
        self.index: defaultdict[int, list[int]] = defaultdict(list)

    def add(self, channel: int, sequence: int, log_ns: int, publish_ns: int, data: bytes) -> None:
        """Append one message. This is the only code that runs once per message."""
        self.index[channel] += (log_ns, len(self.data))
        self.data += _MESSAGE.pack(MESSAGE, 22 + len(data), channel, sequence, log_ns, publish_ns) + data

    @property
    def messages(self) -> int:
        """How many messages it holds."""
        return sum(map(len, self.index.values())) // 2


def pack(chunk: Chunk, squeezed: bytes) -> tuple[bytes, bytes, int, int]:
    """The chunk record, its data compressed to `squeezed`, and its message indexes; first, last log time."""
    first = min(min(entries[::2]) for entries in chunk.index.values())
    last = max(max(entries[::2]) for entries in chunk.index.values())
    body = record(
        CHUNK,
        _CHUNK.pack(first, last, len(chunk.data), zlib.crc32(chunk.data)),
        text("zstd"),
        struct.pack("<Q", len(squeezed)),
        squeezed,
    )
    indexes = b"".join(
        record(MESSAGE_INDEX, struct.pack(f"<HI{len(entries)}Q", of, 8 * len(entries), *entries))
        for of, entries in chunk.index.items()
    )
    return body, indexes, first, last


def chunk_head(head: bytes) -> tuple[int, int, int, int]:
    """Of the CHUNK_HEAD_SIZE first bytes that `pack` made: first and last log time, size, size squeezed."""
    first, last, size, _ = _CHUNK.unpack_from(head, _HEAD.size)
    return first, last, size, int.from_bytes(head[-8:], "little")


def indexed_channels(indexes: bytes) -> Iterator[tuple[int, int]]:
    """Of message indexes in a row: where each begins, and its channel."""
    at = 0
    while at < len(indexes):
        _, length, of = _INDEX.unpack_from(indexes, at)
        yield at, of
        at += _HEAD.size + length


def unpack(content: bytes) -> bytes:
    """The uncompressed records of a chunk; raises Damaged where they are not what was written."""
    fields = Fields(content)
    _, _, size, crc = _CHUNK.unpack(fields.take(_CHUNK.size))
    compression = fields.text()
    data = fields.take(fields.number(8))
    if size > MOST_UNCOMPRESSED:
        raise Damaged(f"a chunk claims {size} bytes")
    try:
        if compression == "zstd":
            if size and zstandard.get_frame_parameters(data).content_size not in (size, -1, 2**64 - 1):
                raise Damaged("a chunk's size is not the stated one")
            data = zstandard.ZstdDecompressor().decompress(data, max_output_size=size) if size else b""
        elif compression == "lz4":
            if lz4 is None:
                raise Damaged("a chunk is compressed by lz4, which is not installed")
            data = lz4.LZ4FrameDecompressor().decompress(data, max_length=size)
        elif compression:
            raise Damaged(f"a chunk is compressed by {compression[:20]!r}, which is not known")
    except (zstandard.ZstdError, RuntimeError, EOFError) as error:
        raise Damaged(f"a chunk does not decompress ({error})") from None
    if len(data) != size or (crc and zlib.crc32(data) != crc):
        raise Damaged("a chunk's checksum is wrong")
    return bytes(data)


def squeezed(content: bytes) -> bytes | None:
    """A chunk's records as they stand in it, compressed by zstd; None where by something else."""
    fields = Fields(content)
    fields.take(_CHUNK.size)
    return fields.take(fields.number(8)) if fields.text() == "zstd" else None


def unpack_torn(torn: bytes) -> bytes:
    """What can still be had of a chunk record (opcode and length first) whose end is missing.

    A compressor's block is whole or nothing, so short chunks give nothing; never raises.
    """
    if torn[:1] != bytes([CHUNK]):
        return b""
    try:
        fields = Fields(torn[_HEAD.size :])
        size = _CHUNK.unpack(fields.take(_CHUNK.size))[2]
        compression = fields.text()
        fields.number(8)
        rest = torn[_HEAD.size + fields.at :]
        if compression == "zstd" and 0 < size <= MOST_UNCOMPRESSED:
            return _as_far_as_it_goes(rest, size)
        return rest if compression == "" else b""
    except (Damaged, zstandard.ZstdError):
        return b""


def _as_far_as_it_goes(torn: bytes, size: int) -> bytes:
    """The whole blocks of a zstd frame, `size` bytes at most: a few bytes of one may stand for gigabytes."""
    blocks = []
    with zstandard.ZstdDecompressor(max_window_size=MOST_UNCOMPRESSED).stream_reader(torn) as reader:
        while size > 0 and (block := reader.read(min(size, 1 << 17))):
            blocks.append(block)
            size -= len(block)
    return b"".join(blocks)


def messages(data: bytes) -> Iterator[tuple[int, int, int, int, int, bytes]]:
    """Every whole record among a chunk's: (opcode, channel, sequence, log time, publish time, data).

    For what is not a message the four numbers are 0 and `data` is the record's content.
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
    while at + 9 <= end:  # a short record at the end: a schema or a channel
        opcode, length = _HEAD.unpack_from(data, at)
        if at + 9 + length > end:
            return
        yield opcode, 0, 0, 0, 0, data[at + 9 : at + 9 + length]
        at += 9 + length
