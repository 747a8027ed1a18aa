"""Recovery of a torn or damaged log. Which logs to recover, and when, is decided by the caller."""

from __future__ import annotations

import fcntl
import os
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple

from companion.storage import container
from companion.storage.container import Chunk, DamagedError
from companion.storage.mcap_file import DiskFile, McapFile, sync_folder
from companion.storage.reader import ACTIVE, ChannelTable, LogError, LogReader, open_log


class Recovered(NamedTuple):
    """Result of `recover`; `bytes_lost` counts the bytes of the torn log that were not saved."""

    messages: int
    chunks: int
    bytes_lost: int
    path: Path


def recover(
    path: str | os.PathLike[str],
    reserve: int = 0,
    relieve: Callable[[int], object] = lambda wanted: None,
) -> Recovered:
    """Recover a torn or damaged log: every complete chunk, and the complete messages of a truncated one.

    `x.mcap.active` becomes `x.mcap`: in place if only its end is missing, which needs space for the end only,
    and by a copy if it is damaged or a truncated chunk gives messages. A torn `x.mcap` is copied to
    `x.recovered.mcap`. The torn log is removed only after its copy is synced to the disk, and only if it is
    ".active". A closed log is left unchanged. A kill at any instant leaves a log that reads as before.

    Parameters
    ----------
    reserve : bytes of the disk to leave free.
    relieve : frees space for the end of a log, as for `DiskFile`; never called for a copy.

    Raises LogError if there is nothing to read or no space, if a process still writes the log, or if the
    target exists.
    """
    path = Path(path)
    with open_log(path) as locked:
        try:
            fcntl.flock(locked.file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            raise LogError(f"{path}: is still being written") from None
        target = _target_path(path)
        try:
            saved = _check_complete(path)
            if saved is not None and path.suffix != ACTIVE:
                return saved
            if target.exists():
                raise LogError(f"{target} already exists: move it away first")
            saved = saved or _complete_in_place(path, reserve, relieve)
            if saved is None:
                saved = _recover_by_copy(path, target, reserve)
            else:
                os.replace(path, target)
                sync_folder(target.parent)
        except LogError:
            raise
        except OSError as error:
            raise LogError(f"cannot write the recovered log {target}: {error.strerror or error}") from None
    return saved._replace(path=target)


def _check_complete(path: Path) -> Recovered | None:
    """Return the contents of the log at `path` if it is complete, after a sync; None if it is not."""
    with open_log(path) as source:
        try:
            count = sum(_count_messages(data) for data in source.message_blocks()) if source.closed else 0
        except DamagedError:
            return None
        if not source.closed or source.end < source.size:
            return None
        os.fsync(source.file.fileno())  # the writer may have been killed before its sync
        return Recovered(count, source.chunks, 0, path)


class CopyMismatch(Exception):
    """The log differs from what its copy would be."""


class InPlaceFile(DiskFile):
    """An existing file rewritten from its start. Equal bytes are not written again; the file is truncated at
    the first difference. A difference within the first `kept` bytes raises CopyMismatch.
    """

    def __init__(self, path: Path, kept: int, reserve: int, relieve: Callable[[int], object]) -> None:
        self._attach(os.open(path, os.O_RDWR), reserve, relieve)
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
                raise CopyMismatch
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
        """See `Disk`; never truncates below the kept bytes."""
        self._same = False
        super().truncate(max(size, self._kept))


def _complete_in_place(path: Path, reserve: int, relieve: Callable[[int], object]) -> Recovered | None:
    """Write the missing end of the log at `path`. If more than the end is missing, return None unchanged.

    The log is copied onto itself: its end becomes that of a copy, and everything before is compared.
    """
    if path.suffix != ACTIVE:
        return None
    with open_log(path) as source:
        kept, library = 0, ""
        for _, opcode, content in source.records():
            if opcode == container.DATA_END:
                break
            if opcode == container.HEADER:
                with suppress(DamagedError):
                    library = container.parse_library(content)
            if opcode not in (container.SCHEMA, container.CHANNEL, container.MESSAGE_INDEX):
                kept = source.end
        else:
            if any(container.iter_messages(container.salvage_torn_chunk(source.read_tail()))):
                return None  # a kill between truncate and write would lose them
    disk = InPlaceFile(path, kept, reserve, relieve)
    try:
        with open_log(path) as source:
            return _copy_records(source, McapFile(disk, library))
    except CopyMismatch:
        return None
    finally:
        disk.close()


def _recover_by_copy(path: Path, target: Path, reserve: int) -> Recovered:
    """Copy everything readable from `path` to `target`, and remove `path` if it is ".active"."""
    part = target.with_name(target.name + ".part")
    part.unlink(missing_ok=True)
    disk = DiskFile(part, reserve)
    try:
        with open_log(path) as source:
            saved = _copy_records(source, McapFile(disk, "companion recover"))
        os.replace(part, target)
    finally:
        disk.close()
        part.unlink(missing_ok=True)  # a partial copy would only take disk space
    sync_folder(target.parent)
    if path.suffix == ACTIVE:
        path.unlink(missing_ok=True)
    return saved


def _target_path(path: Path) -> Path:
    stem = path.with_suffix("") if path.suffix == ACTIVE else path
    if path.suffix == ACTIVE and not stem.exists():
        return stem
    return stem.with_name(f"{stem.stem}.recovered.mcap")


def _copy_records(source: LogReader, target: McapFile) -> Recovered:
    """Copy everything readable from `source` to `target`, chunk by chunk."""
    known = ChannelTable()
    messages = chunks = lost = 0
    between = Chunk()

    def keep(chunk: Chunk, compressed: bytes | None = None) -> None:
        nonlocal messages, chunks
        if chunk.index:
            target.chunk(chunk, known.schemas, known.channels, compressed)
            messages += chunk.messages
            chunks += 1

    for _, opcode, content in source.records():
        if opcode == container.DATA_END:
            break
        try:
            if opcode == container.METADATA:
                target.metadata(*container.parse_metadata(content))
            elif opcode == container.ATTACHMENT:
                target.attachment(content)
            elif opcode == container.CHUNK:
                data = container.decompress_chunk(content)
                keep(between)
                between = Chunk()
                chunk = _collect_messages(data, known, Chunk())
                keep(chunk, container.compressed_data(content) if chunk.data == data else None)
            elif opcode in (container.SCHEMA, container.CHANNEL, container.MESSAGE):
                _collect_messages(container.encode_record(opcode, content), known, between)
        except DamagedError:
            lost += 9 + len(content)
    else:
        if not source.closed:
            lost += source.size - source.end
            with suppress(DamagedError):  # torn and damaged: keep the messages before the damage
                _collect_messages(container.salvage_torn_chunk(source.read_tail()), known, between)
    keep(between)
    target.finish()
    target.sync()
    return Recovered(messages, chunks, lost, source.path)


def _collect_messages(data: bytes, known: ChannelTable, chunk: Chunk) -> Chunk:
    """Add the messages in `data` to `chunk`; messages of undefined channels are dropped."""
    for opcode, number, sequence, log_ns, publish_ns, content in container.iter_messages(data):
        if opcode != container.MESSAGE:
            known.define(opcode, content)
        elif number in known:
            chunk.add(number, sequence, log_ns, publish_ns, content)
    return chunk


def _count_messages(data: bytes) -> int:
    return sum(inner[0] == container.MESSAGE for inner in container.iter_messages(data))
