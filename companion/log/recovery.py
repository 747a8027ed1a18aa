"""A torn or damaged log made whole again.

It knows how a log is laid down and read; which logs are left torn, and when to mend them, is not its concern.
"""

from __future__ import annotations

import fcntl
import os
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple

from . import container
from .container import Chunk, Damaged
from .opened import ACTIVE, Channels, LogError, Opened, opened
from .store import DiskFile, Store, sync_folder


class Recovered(NamedTuple):
    """What `recover` saved, and where it put it; `bytes_lost` are those of the torn log not carried over."""

    messages: int
    chunks: int
    bytes_lost: int
    path: Path


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
