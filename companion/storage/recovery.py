"""Recovery of a torn or damaged log. Which logs to recover, and when, is decided by the caller."""

from __future__ import annotations

import fcntl
import os
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

from mcap.opcode import Opcode
from mcap.records import Chunk, Message, MessageIndex

from companion.storage.mcap_file import DiskFile, McapFile, encode_chunk, sync_folder
from companion.storage.reader import ACTIVE, DamagedError, LogError, LogReader, open_log


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
    reject_empty: bool = False,
) -> Recovered:
    """Recover every complete chunk of a torn or damaged log.

    `x.mcap.active` becomes `x.mcap`: in place if only its end is missing, which needs space for the end only,
    and by a copy if it is damaged. A torn or damaged `x.mcap` is copied to `x.recovered.mcap`. The torn log
    is removed only after its copy is synced to the disk, and only if it is ".active". A closed log is left
    unchanged. A kill at any instant leaves a log that reads as before.

    Parameters
    ----------
    reserve : bytes of the disk to leave free.
    relieve : frees space for the end of a log, as for `DiskFile`; never called for a copy.
    reject_empty : raise LogError, and write nothing, if no message of a torn or damaged log can be read. At
        its start the service closes such a log like any other.

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
            if locked.closed and path.suffix != ACTIVE:
                saved = _finish_in_place(path, reserve, relieve, reject_empty)
                if saved is not None:
                    return saved
            if target.exists():
                raise LogError(f"{target} already exists: move it away first")
            saved = None
            if path.suffix == ACTIVE:
                saved = _finish_in_place(path, reserve, relieve, reject_empty)
            if saved is None:
                saved = _recover_by_copy(path, target, reserve, reject_empty)
            else:
                os.replace(path, target)
                sync_folder(target.parent)
        except LogError:
            raise
        except OSError as error:
            raise LogError(f"cannot write the recovered log {target}: {error.strerror or error}") from None
    return saved._replace(path=target)


def _target_path(path: Path) -> Path:
    stem = path.with_suffix("") if path.suffix == ACTIVE else path
    if path.suffix == ACTIVE and not stem.exists():
        return stem
    return stem.with_name(f"{stem.stem}.recovered.mcap")


def _empty(path: Path) -> LogError:
    return LogError(f"{path} contains no message that can be read: nothing to recover")


def _finish_in_place(
    path: Path, reserve: int, relieve: Callable[[int], object], reject_empty: bool
) -> Recovered | None:
    """Write what is missing after the last complete chunk at `path`; None, unchanged, if it is damaged."""
    file = McapFile(DiskFile(path, reserve, relieve, new=False))
    try:
        with open_log(path) as source:
            try:
                messages, last = _enter_all(source, file)
            except DamagedError:
                return None
            if not source.closed:
                if reject_empty and not messages:
                    raise _empty(path)
                if messages != file.messages + len(last):
                    return None  # some are outside chunks
                if last:
                    file.write(encode_chunk(last)[1])
                file.finish()
            file.sync()  # of a closed log too: its writer may have been killed before
            return Recovered(messages, source.chunks, source.size - source.end, path)
    finally:
        file.close()


def _enter_all(source: LogReader, file: McapFile) -> tuple[int, list[Message]]:
    """Enter the records of `source` into `file`, without the indexes of a chunk at a torn end.

    Returns the number of messages, and the messages of that chunk: its indexes may be incomplete.
    """
    count = 0
    last: list[Message] = []
    indexes: list[tuple[MessageIndex, int, int]] = []  # of the last chunk
    for raw in source.records():
        record = raw.parse()
        if isinstance(record, MessageIndex):
            indexes.append((record, raw.start, raw.end))
            continue
        for index in indexes:
            file.enter(*index)
        messages = source.unpack(record)
        if not all(source.is_defined(message.channel_id) for message in messages):
            raise DamagedError("a message is on a channel that is not defined")
        count, indexes = count + len(messages), []
        last = messages if isinstance(record, Chunk) else []
        file.enter(record, raw.start, raw.end)
    for definition in (*source.schemas.values(), *source.channels.values()):
        file.enter(definition, file.end, file.end)  # of another recorder: inside a chunk
    return count, last


def _recover_by_copy(path: Path, target: Path, reserve: int, reject_empty: bool) -> Recovered:
    """Copy everything readable from `path` to `target`, and remove `path` if it is ".active"."""
    part = target.with_name(target.name + ".part")
    part.unlink(missing_ok=True)
    file = McapFile(DiskFile(part, reserve))
    try:
        file.begin("companion recover")
        with open_log(path) as source:
            lost = _copy_records(source, file)
        if reject_empty and not file.messages:
            raise _empty(path)
        file.finish()
        file.sync()
        os.replace(part, target)
    finally:
        file.close()
        part.unlink(missing_ok=True)  # a partial copy would only take disk space
    sync_folder(target.parent)
    if path.suffix == ACTIVE:
        path.unlink(missing_ok=True)
    return Recovered(file.messages, file.chunks, lost, target)


def _copy_records(source: LogReader, file: McapFile) -> int:
    """Copy everything readable; return the number of bytes lost. Messages of undefined channels are lost."""
    lost = 0
    between: list[Message] = []  # messages outside chunks
    for raw in source.records():
        try:
            if raw.opcode in (Opcode.METADATA, Opcode.ATTACHMENT):
                file.write([raw.parse()])
            elif raw.opcode in (Opcode.SCHEMA, Opcode.CHANNEL, Opcode.MESSAGE, Opcode.CHUNK):
                messages = [m for m in source.unpack(raw.parse()) if source.is_defined(m.channel_id)]
                between += messages
                if raw.opcode == Opcode.CHUNK and between:
                    file.chunk(between, source.schemas, source.channels)
                    between = []
        except DamagedError:
            lost += raw.end - raw.start
    if between:
        file.chunk(between, source.schemas, source.channels)
    return lost + (0 if source.closed else source.size - source.end)
