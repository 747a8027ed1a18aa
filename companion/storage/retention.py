"""Log folder: file names, deletion of the oldest logs, recovery of logs left unclosed.

Logs are ordered by the number in their name, not by the clock: a new log gets the greatest number plus one.
Names without a number (earlier versions) count as older and are ordered by their time.

Only files with names of this format are deleted, never a log that is being written or recovered, and none
at all if deleting them could not free enough space.
"""

from __future__ import annotations

import fcntl
import os
import re
import shutil
from collections.abc import Callable, Mapping
from datetime import UTC, datetime
from functools import partial
from pathlib import Path

from companion.storage import schemas
from companion.storage.flight_log import Writer
from companion.storage.mcap_file import DiskFile
from companion.storage.reader import ACTIVE, LogError
from companion.storage.recovery import Recovered, recover
from companion.write_errors import describe_write_error, make_folder

_LOG_NAME = re.compile(r"(?:(\d{5,})-)?(\d{8}T\d{6}Z)(?:-(\d+))?(?:\.recovered)?\.mcap(?:\.active)?")


def create_log(
    folder: str | os.PathLike[str],
    *,
    metadata: Mapping[str, Mapping[str, str]],
    start_unix_ns: int,
    start_ns: int,
    max_files: int = 100,
    min_free: int = 1 << 28,
    chunk_bytes: int = 131072,
    fsync_s: float = 1.0,
    block: bool = False,
    on_delete: Callable[[Path], None] = lambda log: None,
) -> Writer:
    """Create a log in `folder`, named by number and start time in UTC (00042-20260131T235959Z.mcap).

    At most `max_files` logs are kept, this one included, and `min_free` bytes of the disk are left free: the
    oldest logs are deleted first, at the start and, for space, while this log is written. Raises LogError if
    the folder cannot be created or written, or if deleting all logs would not free enough space. `on_delete`
    is called with each deleted log, in any thread.
    """
    folder = Path(folder)
    try:
        make_folder(folder)
        has_space = make_room(folder, min_free, max_files - 1, on_delete)
        path = _next_path(folder, start_unix_ns)
    except OSError as error:
        raise LogError(f"cannot keep logs in {folder.absolute()}: {describe_write_error(error)}") from None
    if not has_space:
        raise LogError(
            f"cannot keep logs in {folder}: deleting all of them would not leave {min_free >> 20} MiB free; "
            "none was deleted. Free space on the disk, or lower log.minimum_free_mib"
        )
    disk = partial(DiskFile, reserve=min_free, relieve=partial(make_room, folder, on_delete=on_delete))
    while True:
        try:
            return Writer(
                path,
                metadata=metadata,
                start_unix_ns=start_unix_ns,
                start_ns=start_ns,
                chunk_bytes=chunk_bytes,
                fsync_s=fsync_s,
                block=block,
                disk=disk,
                attachments=[schemas.dialect_attachment(start_unix_ns)],
            )
        except LogError as error:
            if not isinstance(error.__cause__, FileExistsError):
                raise
        path = _next_path(folder, start_unix_ns)  # a process that started in the same second has taken it


def recover_unclosed(
    folder: str | os.PathLike[str], min_free: int = 0, on_delete: Callable[[Path], None] = lambda log: None
) -> list[Recovered]:
    """Recover every ".active" log in `folder` that no process is writing.

    A log with nothing to read is left unchanged, and so is one that would leave less than `min_free` bytes
    of the disk free. The newest is recovered first: if space must be freed, the oldest is deleted.
    """
    saved: list[Recovered] = []
    for path in sorted(Path(folder).glob(f"*.mcap{ACTIVE}"), key=_age_key, reverse=True):
        try:
            saved.append(recover(path, min_free, partial(make_room, Path(folder), on_delete=on_delete)))
        except LogError:  # being written, empty, or no space: retried at the next start
            continue
    return saved


def make_room(
    folder: Path,
    min_free: int,
    max_files: int | None = None,
    on_delete: Callable[[Path], None] = lambda log: None,
) -> bool:
    """Delete the oldest logs, closed or torn, until at most `max_files` remain and `min_free` bytes are free.

    Return whether the space is free. If it cannot be reached, nothing is deleted.
    """
    logs = _find_logs(folder)
    spare = 0 if max_files is None else len(logs) - max_files
    missing = min_free - shutil.disk_usage(folder).free
    chosen: list[Path] = []
    for log in logs:
        if missing <= 0 and len(chosen) >= spare:
            break
        try:
            if _is_locked(log):
                continue
            missing -= log.stat().st_blocks * 512
        except FileNotFoundError:  # deleted or renamed by another process
            continue
        chosen.append(log)
    if missing > 0:
        return False
    for log in chosen:
        log.unlink(missing_ok=True)
        on_delete(log)
    return True


def _is_locked(log: Path) -> bool:
    """Return whether a process is writing or recovering `log`."""
    if log.suffix != ACTIVE:
        return False
    with log.open("rb") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)
        except OSError:
            return True
    return False


def _find_logs(folder: Path) -> list[Path]:
    """Return the logs with names of this format, oldest first."""
    return sorted((log for log in folder.iterdir() if _LOG_NAME.fullmatch(log.name)), key=_age_key)


def _age_key(log: Path) -> tuple[int, str, int]:
    """Return the sort key of a log: number, start time, suffix. Other files sort first."""
    found = _LOG_NAME.fullmatch(log.name)
    return (int(found[1] or 0), found[2], int(found[3] or 1)) if found else (0, "", 0)


def _next_path(folder: Path, start_unix_ns: int) -> Path:
    number = max((_age_key(log)[0] for log in folder.iterdir()), default=0) + 1
    start = datetime.fromtimestamp(start_unix_ns // 1_000_000_000, UTC)
    return folder / f"{number:05d}-{start:%Y%m%dT%H%M%SZ}.mcap"
