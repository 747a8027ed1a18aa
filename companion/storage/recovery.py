"""A torn or damaged log made whole again.

It knows how a log is laid down and read; which logs are left torn, and when to mend them, is not its concern.
"""

from __future__ import annotations

import fcntl
import os
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple

from companion.storage import container
from companion.storage.container import Chunk, Damaged
from companion.storage.mcap_file import DiskFile, Store, sync_folder
from companion.storage.reader import ACTIVE, Channels, LogError, Opened, opened


class Recovered(NamedTuple):
    """What `recover` saved, and where it put it; `bytes_lost` are those of the torn log not carried over."""

    messages: int
    chunks: int
    bytes_lost: int
    path: Path


def recover(
    path: str | os.PathLike[str],
    reserve: int = 0,
    relieve: Callable[[int], object] = lambda wanted: None,
) -> Recovered:
    """Make a torn or damaged log whole: every whole chunk, and the whole messages of one torn off.

    `x.mcap.active` becomes `x.mcap`: where it stands if only its end is missing, which takes the room of that
    end, and by a copy if it is damaged or a torn chunk gives messages. Of a torn `x.mcap` a copy
    `x.recovered.mcap` is made. A torn log goes only after its copy is safely on the disk, and only if it is
    ".active". A whole log is left as it is. Killed at any instant it leaves a log that reads as before.

    `reserve` bytes of the disk are left free; `relieve` may make room for an end, as for a `DiskFile`, never
    for a copy. Raises LogError where there is nothing to read or no room, where a process still writes, and
    where what it would become is there already.
    """
    path = Path(path)
    with opened(path) as locked:
        try:
            fcntl.flock(locked.file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            raise LogError(f"{path}: is still being written") from None
        target = _target(path)
        try:
            saved = _whole(path)
            if saved is not None and path.suffix != ACTIVE:
                return saved
            if target.exists():
                raise LogError(f"{target} is there already: move it away first")
            saved = saved or _ended(path, reserve, relieve)
            if saved is None:
                saved = _copied(path, target, reserve)
            else:
                os.replace(path, target)
                sync_folder(target.parent)
        except LogError:
            raise
        except OSError as error:
            raise LogError(f"cannot write the recovered log {target}: {error.strerror or error}") from None
    return saved._replace(path=target)


def _whole(path: Path) -> Recovered | None:
    """What the log at `path` holds if it is whole, and then safely on the disk; None if it is not."""
    with opened(path) as source:
        try:
            count = sum(_messages(data) for data in source.stretches()) if source.closed else 0
        except Damaged:
            return None
        if not source.closed or source.end < source.size:
            return None
        os.fsync(source.file.fileno())  # killed after its last write it may not have been
        return Recovered(count, source.chunks, 0, path)


class Differs(Exception):
    """A log is not what its copy would be."""


class Standing(DiskFile):
    """A file that stands already, to be written again from its front. What is the same is left alone, at the
    first difference the file is cut off, and never before `kept` bytes: a difference there raises Differs.
    """

    def __init__(self, path: Path, kept: int, reserve: int, relieve: Callable[[int], object]) -> None:
        self._take(os.open(path, os.O_RDWR), reserve, relieve)
        self._kept, self._same = kept, True

    def write(self, data: bytes) -> None:
        """See `Disk`."""
        if self._same:
            there = os.pread(self._fd, len(data), self._at)
            if there == data:
                self._at += len(data)
                return
            same = next((i for i, (a, b) in enumerate(zip(there, data)) if a != b), len(there))
            if self._at + same < self._kept:
                raise Differs
            self._at += same
            self.truncate(self._at)
            data = data[same:]
        super().write(data)

    def sync(self) -> None:
        """See `Disk`."""
        if self._same:
            self.truncate(self._at)
        super().sync()

    def truncate(self, size: int) -> None:
        """See `Disk`; what is kept stays even where a write is taken back."""
        self._same = False
        super().truncate(max(size, self._kept))


def _ended(path: Path, reserve: int, relieve: Callable[[int], object]) -> Recovered | None:
    """Put its end to the log at `path`; None where that is not all it lacks, and then it is as it was.

    It is copied onto itself: so the end is what the copy's would be, and all before it was compared.
    """
    if path.suffix != ACTIVE:
        return None
    with opened(path) as source:
        kept, library = 0, ""
        for _, opcode, content in source.records():
            if opcode == container.DATA_END:
                break
            if opcode == container.HEADER:
                with suppress(Damaged):
                    library = container.library(content)
            if opcode not in (container.SCHEMA, container.CHANNEL, container.MESSAGE_INDEX):
                kept = source.end
        else:
            if any(container.messages(container.unpack_torn(source.tail()))):
                return None  # killed between the cut and the write they would be lost
    disk = Standing(path, kept, reserve, relieve)
    try:
        with opened(path) as source:
            return _copy(source, Store(disk, library))
    except Differs:
        return None
    finally:
        disk.close()


def _copied(path: Path, target: Path, reserve: int) -> Recovered:
    """Save what can be read of the log at `path` to `target`, and remove it if it is ".active"."""
    part = target.with_name(target.name + ".part")
    part.unlink(missing_ok=True)
    disk = DiskFile(part, reserve)
    try:
        with opened(path) as source:
            saved = _copy(source, Store(disk, "companion recover"))
        os.replace(part, target)
    finally:
        disk.close()
        part.unlink(missing_ok=True)  # half a copy only takes the room that a flight needs
    sync_folder(target.parent)
    if path.suffix == ACTIVE:
        path.unlink(missing_ok=True)
    return saved


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

    def keep(chunk: Chunk, squeezed: bytes | None = None) -> None:
        nonlocal messages, chunks
        if chunk.index:
            target.chunk(chunk, known.schemas, known.channels, squeezed)
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
                chunk = _rebuild(data, known, Chunk())
                keep(chunk, container.squeezed(content) if chunk.data == data else None)
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
