"""The folder logs live in: names by number and UTC time, room made by age, logs left torn made whole.

Age is the order in which logs were begun, whatever the clock said: each has the number after the greatest
that lies there. Names without a number, of earlier versions, are older than all others and go by their time.

It deletes nothing it did not name itself, never a log that is being written or mended, and nothing at all
where that would not make room enough.
"""

from __future__ import annotations

import fcntl
import os
import re
import shutil
from collections.abc import Mapping
from datetime import UTC, datetime
from functools import partial
from pathlib import Path

from companion.storage.flight_log import Writer
from companion.storage.mcap_file import DiskFile
from companion.storage.reader import ACTIVE, LogError
from companion.storage.recovery import Recovered, recover

_OURS = re.compile(r"(?:(\d{5,})-)?(\d{8}T\d{6}Z)(?:-(\d+))?(?:\.recovered)?\.mcap(?:\.active)?")


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
    """Begin a log in `folder`, named by its number and its start in UTC (00042-20260131T235959Z.mcap).

    At most `max_files` logs of ours are kept, this one included, and of the disk `min_free` bytes are left
    free: the oldest logs go first, now and for room also while this one is written. Raises LogError where the
    folder cannot be made or written to, and where without any log there would not be that room.
    """
    folder = Path(folder)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        roomy = make_room(folder, min_free, max_files - 1)
        path = _next_name(folder, start_unix_ns)
    except OSError as error:
        raise LogError(f"cannot keep logs in {folder}: {error.strerror or error}") from None
    if not roomy:
        raise LogError(
            f"cannot keep logs in {folder}: with all of them deleted there would still not be "
            f"{min_free >> 20} MiB free on the disk (log.minimum_free_mib), so none was"
        )
    return Writer(
        path,
        metadata=metadata,
        start_unix_ns=start_unix_ns,
        start_ns=start_ns,
        chunk_bytes=chunk_bytes,
        fsync_s=fsync_s,
        depth=depth,
        block=block,
        disk=partial(DiskFile, reserve=min_free, relieve=partial(make_room, folder)),
    )


def recover_left(folder: str | os.PathLike[str], min_free: int = 0) -> list[Recovered]:
    """Make whole every log in `folder` that was left ".active" and that no process is writing any more.

    One that holds nothing to read is left as it is, and so is one where `min_free` bytes of disk would not
    stay free. The newest comes first: where room must be made, it is the oldest that goes.
    """
    saved: list[Recovered] = []
    for path in sorted(Path(folder).glob(f"*.mcap{ACTIVE}"), key=_begun, reverse=True):
        try:
            saved.append(recover(path, min_free, partial(make_room, Path(folder))))
        except LogError:  # being written, or nothing in it, or no room: it waits for the next start
            continue
    return saved


def make_room(folder: Path, min_free: int, max_files: int | None = None) -> bool:
    """Delete the oldest logs of ours, closed or torn, until no more than `max_files` are left and `min_free`
    bytes of the disk are free; whether they are. Where they would not be, nothing is deleted.
    """
    logs = _logs(folder)
    spare = 0 if max_files is None else len(logs) - max_files
    missing = min_free - shutil.disk_usage(folder).free
    chosen: list[Path] = []
    for log in logs:
        if missing <= 0 and len(chosen) >= spare:
            break
        try:
            if _held(log):
                continue
            missing -= log.stat().st_blocks * 512
        except FileNotFoundError:  # another companion makes room, or gave it its name
            continue
        chosen.append(log)
    if missing > 0:
        return False
    for log in chosen:
        log.unlink(missing_ok=True)
    return True


def _held(log: Path) -> bool:
    """Whether a process, this one or another, writes or mends `log`."""
    if log.suffix != ACTIVE:
        return False
    with log.open("rb") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)
        except OSError:
            return True
    return False


def _logs(folder: Path) -> list[Path]:
    """The logs of ours, oldest first."""
    return sorted((log for log in folder.iterdir() if _OURS.fullmatch(log.name)), key=_begun)


def _begun(log: Path) -> tuple[int, str, int]:
    """What logs are ordered by; a file that is none of ours goes before them."""
    found = _OURS.fullmatch(log.name)
    return (int(found[1] or 0), found[2], int(found[3] or 1)) if found else (0, "", 0)


def _next_name(folder: Path, start_unix_ns: int) -> Path:
    number = max((_begun(log)[0] for log in folder.iterdir()), default=0) + 1
    start = datetime.fromtimestamp(start_unix_ns // 1_000_000_000, UTC)
    return folder / f"{number:05d}-{start:%Y%m%dT%H%M%SZ}.mcap"
