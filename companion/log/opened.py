"""An MCAP file opened for reading, whole or torn, ours or foreign; and a torn one made whole again.

It gives the stretches of bytes that hold messages, up to where the file ends or is damaged, and says whether
the file was closed. It does not know what the messages are.
"""

from __future__ import annotations

import fcntl
import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import BinaryIO, NamedTuple

from . import container
from .container import Chunk, Damaged
from .store import DiskFile, Store, sync_folder

ACTIVE = ".active"
"""Stands after the name of a log that is not closed."""


class LogError(OSError):
    """A log that cannot be written or read; its text is one sentence for a person."""


class Recovered(NamedTuple):
    """What `recover` saved, and where it put it; `bytes_lost` are those of the torn log not carried over."""

    messages: int
    chunks: int
    bytes_lost: int
    path: Path


class Opened:
    """A log open for reading. `closed` tells a whole file from a torn one; the rest grows as it is read:
    `end` is where the last whole record ends, `metadata` is by name.
    """

    def __init__(self, path: Path, file: BinaryIO, size: int) -> None:
        self.path, self.file, self.size = path, file, size
        self.closed = container.is_closed(file, size)
        self.end = len(container.MAGIC)
        self.chunks = 0
        self.library = ""
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


def recover(path: str | os.PathLike[str], reserve: int = 0) -> Recovered:
    """Make a torn or damaged log whole: every whole chunk, and the whole messages of one torn off.

    `x.mcap.active` becomes `x.mcap`; of a torn `x.mcap` a copy `x.recovered.mcap` is made. The torn log
    itself goes only after its copy is safely on the disk, and only if it is ".active". A whole log is left
    as it is. Raises LogError where there is nothing to read, where a process still writes it, or where there
    is no room for the copy beside `reserve` bytes to be left free.
    """
    with opened(path) as source:
        try:
            fcntl.flock(source.file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            raise LogError(f"{path}: is still being written") from None
        if source.closed:
            try:
                count = sum(_messages(data) for data in source.stretches())
                return Recovered(count, source.chunks, 0, source.path)
            except Damaged:
                source.file.seek(len(container.MAGIC))
                source.chunks = 0
        target = _target(source.path)
        part = target.with_name(target.name + ".part")
        try:
            part.unlink(missing_ok=True)
            disk = DiskFile(part, reserve)
            try:
                saved = _copy(source, Store(disk, "companion recover"))
                os.replace(part, target)
            finally:
                disk.close()
                part.unlink(missing_ok=True)  # half a copy only takes the room that a flight needs
            sync_folder(target.parent)
            if source.path.suffix == ACTIVE:
                source.path.unlink()
        except OSError as error:
            raise LogError(f"cannot write the recovered log {target}: {error.strerror or error}") from None
    return saved._replace(path=target)


def _target(path: Path) -> Path:
    stem = path.with_suffix("") if path.suffix == ACTIVE else path
    if path.suffix == ACTIVE and not stem.exists():
        return stem
    return stem.with_name(f"{stem.stem}.recovered.mcap")


def _copy(source: Opened, target: Store) -> Recovered:
    """Everything that can be read of `source` into `target`, chunk by chunk."""
    known = Channels()
    messages = chunks = lost = 0
    loose = Chunk()

    def keep(chunk: Chunk) -> None:
        nonlocal messages, chunks
        if chunk.index:
            target.chunk(chunk, known.schemas, known.channels)
            messages += chunk.messages
            chunks += 1

    for _, opcode, content in source.records():
        if opcode == container.DATA_END:
            break
        try:
            if opcode == container.METADATA:
                target.metadata(*container.metadata(content))
            elif opcode == container.ATTACHMENT:
                target.attachment(content)
            elif opcode == container.CHUNK:
                data = container.unpack(content)
                keep(loose)
                loose = Chunk()
                keep(_rebuild(data, known, Chunk()))
            elif opcode in (container.SCHEMA, container.CHANNEL, container.MESSAGE):
                _rebuild(container.record(opcode, content), known, loose)
        except Damaged:
            lost += 9 + len(content)
    else:
        if not source.closed:
            lost += source.size - source.end
            with suppress(Damaged):  # torn and damaged: what stood before the damage is kept
                _rebuild(container.unpack_torn(source.tail()), known, loose)
    keep(loose)
    target.finish()
    target.sync()
    return Recovered(messages, chunks, lost, source.path)


def _rebuild(data: bytes, known: Channels, chunk: Chunk) -> Chunk:
    """Add the messages among `data` to `chunk`; those of channels never defined cannot be kept."""
    for opcode, number, sequence, log_ns, publish_ns, content in container.messages(data):
        if opcode != container.MESSAGE:
            known.define(opcode, content)
        elif number in known:
            chunk.add(number, sequence, log_ns, publish_ns, content)
    return chunk


def _messages(data: bytes) -> int:
    return sum(inner[0] == container.MESSAGE for inner in container.messages(data))
