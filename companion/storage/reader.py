"""An MCAP file opened for reading, whole or torn, ours or foreign.

It gives the stretches of bytes that hold messages, up to where the file ends or is damaged, and says whether
the file was closed. It does not know what the messages are.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO

from companion.storage import container
from companion.storage.container import Damaged

ACTIVE = ".active"
"""Stands after the name of a log that is not closed."""


class LogError(OSError):
    """A log that cannot be written or read; its text is one sentence for a person."""


class Opened:
    """A log open for reading. `closed` tells a whole file from a torn one; the rest grows as it is read:
    `end` is where the last whole record ends, `metadata` is by name.
    """

    def __init__(self, path: Path, file: BinaryIO, size: int) -> None:
        self.path, self.file, self.size = path, file, size
        self.closed = container.is_closed(file, size)
        self.end = len(container.MAGIC)
        self.chunks = 0
        self.metadata: dict[str, dict[str, str]] = {}

    def records(self) -> Iterator[container.Whole]:
        """Every whole record up to the footer, or up to where the file is torn."""
        for whole in container.scan(self.file, self.size):
            self.end = whole.offset + 9 + len(whole.content)
            yield whole
            if whole.opcode == container.FOOTER and self.closed:
                self.end = self.size

    def stretches(self) -> Iterator[bytes]:
        """Runs of schema, channel and message records: each chunk opened, and what stands between chunks.

        A chunk torn off gives the messages that can still be had. Raises Damaged at a chunk that is whole in
        length and wrong inside.
        """
        data_ended = False
        for _, opcode, content in self.records():
            if opcode == container.CHUNK:
                data = container.unpack(content)
                self.chunks += 1
                yield data
            elif opcode == container.METADATA:
                name, values = container.metadata(content)
                self.metadata[name] = values
            elif opcode == container.DATA_END:
                data_ended = True
            elif opcode in (container.SCHEMA, container.CHANNEL, container.MESSAGE) and not data_ended:
                yield container.record(opcode, content)
        if not self.closed and not data_ended:
            yield container.unpack_torn(self.tail())

    def tail(self) -> bytes:
        """What stands after the last whole record."""
        self.file.seek(self.end)
        return self.file.read(min(self.size - self.end, container.MOST_UNCOMPRESSED))

    def damaged(self, error: Exception) -> LogError:
        """`error`, met in a stretch, as a sentence."""
        if isinstance(error, KeyError):
            error = Damaged(f"a message is on channel {error}, which is not defined")
        return LogError(
            f"{self.path}: damaged near byte {self.end}: {error}; `companion log recover` saves the rest"
        )


@contextmanager
def opened(path: str | os.PathLike[str]) -> Iterator[Opened]:
    """Open the log at `path`; LogError where it is missing, empty, foreign, or cut before its header."""
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
        source = Opened(path, file, size)
        first = next(container.scan(file, size), None)
        if first is None:
            raise LogError(f"{path}: was cut off before its header ended; there is nothing in it to read")
        if first.opcode != container.HEADER:
            raise LogError(f"{path}: is not an MCAP log (its first record is not a header)")
        file.seek(len(container.MAGIC))
        yield source


def is_closed(path: str | os.PathLike[str]) -> bool:
    """Whether the log at `path` is whole. Raises LogError as `opened` does."""
    with opened(path) as source:
        return source.closed


class Channels:
    """The schemas and channels a file has defined so far: contents of their records, by id."""

    def __init__(self) -> None:
        self.schemas: dict[int, bytes] = {}
        self.channels: dict[int, bytes] = {}

    def define(self, opcode: int, content: bytes) -> int | None:
        """Take in one record; the id if it was a channel. Raises Damaged where it cannot be parsed."""
        if opcode == container.SCHEMA:
            self.schemas[container.schema(content)[0]] = content
        elif opcode == container.CHANNEL:
            number = container.channel(content)[0]
            self.channels[number] = content
            return number
        return None

    def __contains__(self, number: int) -> bool:
        """Whether channel `number` and its schema are defined."""
        of_schema = container.channel(self.channels[number])[1] if number in self.channels else -1
        return of_schema == 0 or of_schema in self.schemas

    def __getitem__(self, number: int) -> container.Channel:
        """The channel `number`; raises KeyError where it or its schema is not defined."""
        _, of_schema, topic, encoding = container.channel(self.channels[number])
        name = container.schema(self.schemas[of_schema])[1] if of_schema else ""
        return container.Channel(topic, encoding, name)
