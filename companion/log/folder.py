"""The folder logs live in: names by UTC time, room made by age, logs left torn made whole.

It deletes nothing it did not name itself, and never a log that is not closed.
"""

from __future__ import annotations

import os
import re
import shutil
from collections.abc import Mapping
from datetime import UTC, datetime
from functools import partial
from pathlib import Path

from .file import Writer
from .opened import ACTIVE, LogError
from .recovery import Recovered, recover
from .store import DiskFile

_OURS = re.compile(r"\d{8}T\d{6}Z(-\d+)?(\.recovered)?\.mcap")


def open_log(
    folder: str | os.PathLike[str],
    *,
    metadata: Mapping[str, Mapping[str, str]],
    start_unix_ns: int,
    start_ns: int,
    max_files: int = 100,
    min_free: int = 1 << 28,
    chunk_bytes: int = 131072,
    fsync_s: float = 1.0,
    depth: int = 1 << 25,
    block: bool = False,
) -> Writer:
    """Begin a log in `folder`, named by its start in UTC (20260131T235959Z.mcap).

    At most `max_files` logs of ours are kept, this one included, and of the disk `min_free` bytes are left
    free: the oldest logs go first, now and while this one is written. Raises LogError where the folder cannot
    be made or written to.
    """
    folder = Path(folder)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        make_room(folder, max_files - 1, min_free)
    except OSError as error:
        raise LogError(f"cannot keep logs in {folder}: {error.strerror or error}") from None
    return Writer(
        _free_name(folder, start_unix_ns),
        metadata=metadata,
        start_unix_ns=start_unix_ns,
        start_ns=start_ns,
        chunk_bytes=chunk_bytes,
        fsync_s=fsync_s,
        depth=depth,
        block=block,
        disk=partial(DiskFile, reserve=min_free, relieve=partial(make_room, folder, max_files - 1)),
    )


def recover_left(folder: str | os.PathLike[str], min_free: int = 0) -> list[Recovered]:
    """Make whole every log in `folder` that was left ".active" and that no process is writing any more.

    One that holds nothing to read is left as it is, and so is one whose copy would not leave `min_free` bytes
    of the disk.
    """
    saved: list[Recovered] = []
    for path in sorted(Path(folder).glob(f"*.mcap{ACTIVE}")):
        try:
            saved.append(recover(path, min_free))
        except LogError:  # being written, or nothing in it, or no room: it waits for the next start
            continue
    return saved


def make_room(folder: Path, max_files: int, min_free: int) -> list[Path]:
    """Delete the oldest closed logs of ours until both limits hold or none is left; what was deleted."""
    logs = sorted(path for path in folder.iterdir() if _OURS.fullmatch(path.name))
    deleted = []
    while logs and (len(logs) > max(max_files, 0) or shutil.disk_usage(folder).free < min_free):
        logs[0].unlink()
        deleted.append(logs.pop(0))
    return deleted


def _free_name(folder: Path, start_unix_ns: int) -> Path:
    stem = datetime.fromtimestamp(start_unix_ns // 1_000_000_000, UTC).strftime("%Y%m%dT%H%M%SZ")
    path, number = folder / f"{stem}.mcap", 1
    while path.exists() or path.with_name(path.name + ACTIVE).exists():
        number += 1
        path = folder / f"{stem}-{number}.mcap"
    return path
