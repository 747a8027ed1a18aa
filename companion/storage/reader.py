"""MCAP log reader: blocks of message records from a closed or torn file, ours or another recorder's.

It does not decode messages.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO

from companion.storage import container
from companion.storage.container import DamagedError

ACTIVE = ".active"
"""Suffix of a log that is not closed."""


class LogError(OSError):
    """A log that cannot be written or read; the text is one sentence for the user."""


class LogReader:
    """A log opened for reading; `closed` is False for a torn one.

    Updated while reading: `end`, where the last complete record ends; `chunks`; `metadata` by name.
    """

    def __init__(self, path: Path, file: BinaryIO, size: int) -> None:
        self.path, self.file, self.size = path, file, size
        self.closed = container.is_closed(file, size)
        self.end = len(container.MAGIC)
        self.chunks = 0
        self.metadata: dict[str, dict[str, str]] = {}

    def records(self) -> Iterator[container.RawRecord]:
        """Yield every complete record up to the footer, or up to where the file is torn."""
        for whole in container.scan_records(self.file, self.size):
            self.end = whole.offset + 9 + len(whole.content)
            yield whole
            if whole.opcode == container.FOOTER and self.closed:
                self.end = self.size

    def message_blocks(self) -> Iterator[bytes]:
        """Yield blocks of schema, channel and message records: uncompressed chunks, and records between them.

        A truncated chunk gives the messages that can still be read. Raises DamagedError at a chunk of
        complete length with wrong content.
        """
        data_ended = False
        for _, opcode, content in self.records():
            if opcode == container.CHUNK:
                data = container.decompress_chunk(content)
                self.chunks += 1
                yield data
            elif opcode == container.METADATA:
                name, values = container.parse_metadata(content)
                self.metadata[name] = values
            elif opcode == container.DATA_END:
                data_ended = True
            elif opcode in (container.SCHEMA, container.CHANNEL, container.MESSAGE) and not data_ended:
                yield container.encode_record(opcode, content)
        if not self.closed and not data_ended:
            yield container.salvage_torn_chunk(self.read_tail())

    def read_tail(self) -> bytes:
        """Return the bytes after the last complete record."""
        self.file.seek(self.end)
        return self.file.read(min(self.size - self.end, container.MAX_UNCOMPRESSED))

    def damage_error(self, error: Exception) -> LogError:
        """Convert an error found while reading into a LogError for the user."""
        if isinstance(error, KeyError):
            error = DamagedError(f"a message is on channel {error}, which is not defined")
        return LogError(
            f"{self.path}: damaged near byte {self.end}: {error}; `companion log recover` saves the rest"
        )


@contextmanager
def open_log(path: str | os.PathLike[str]) -> Iterator[LogReader]:
    """Open the log at `path`. Raises LogError if it is missing, empty, not MCAP, or cut before its header."""
    path = Path(path)
    try:
        file = path.open("rb")
    except OSError as error:
        raise LogError(f"{path}: cannot be read: {error.strerror or error}") from None
    with file:
        size = os.fstat(file.fileno()).st_size
        magic = file.read(len(container.MAGIC))
        if not magic:
            raise LogError(f"{path}: is empty")
        if not container.MAGIC.startswith(magic):
            raise LogError(f"{path}: is not an MCAP log (it does not begin with MCAP's magic)")
        source = LogReader(path, file, size)
        first = next(container.scan_records(file, size), None)
        if first is None:
            raise LogError(f"{path}: is truncated within its header and contains no messages")
        if first.opcode != container.HEADER:
            raise LogError(f"{path}: is not an MCAP log (its first record is not a header)")
        file.seek(len(container.MAGIC))
        yield source


def is_closed(path: str | os.PathLike[str]) -> bool:
    """Return whether the log at `path` was closed. Raises LogError as `open_log` does."""
    with open_log(path) as source:
        return source.closed


class ChannelTable:
    """Schemas and channels defined so far in a file: record contents by id."""

    def __init__(self) -> None:
        self.schemas: dict[int, bytes] = {}
        self.channels: dict[int, bytes] = {}

    def define(self, opcode: int, content: bytes) -> int | None:
        """Add one record and return its id if it is a channel. Raises DamagedError if it cannot be parsed."""
        if opcode == container.SCHEMA:
            self.schemas[container.parse_schema(content)[0]] = content
        elif opcode == container.CHANNEL:
            number = container.parse_channel(content)[0]
            self.channels[number] = content
            return number
        return None

    def __contains__(self, number: int) -> bool:
        """Return whether channel `number` and its schema are defined."""
        of_schema = container.parse_channel(self.channels[number])[1] if number in self.channels else -1
        return of_schema == 0 or of_schema in self.schemas

    def __getitem__(self, number: int) -> container.Channel:
        """Return channel `number`. Raises KeyError if it or its schema is not defined."""
        _, of_schema, topic, encoding = container.parse_channel(self.channels[number])
        name = container.parse_schema(self.schemas[of_schema])[1] if of_schema else ""
        return container.Channel(topic, encoding, name)
