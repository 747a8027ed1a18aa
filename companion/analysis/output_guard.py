"""Protection of logs from being overwritten by the outputs of commands."""

from __future__ import annotations

import fcntl
import os
from collections.abc import Sequence
from pathlib import Path

from companion.analysis.replay_inputs import CONVERTED, DERIVED, is_own_log
from companion.importers import sources
from companion.storage import flight_log
from companion.storage.reader import ACTIVE, LogError


def reject_own_input(output: Path, *read: Path | None) -> None:
    """Raise LogError if `output`, or the name it has while written, is an input file, also through a link.

    Or if it can be no file: the work before it would be in vain. An empty name is that of the current folder.
    """
    if not output.name or output.is_dir():
        raise LogError(f"'{output}' as output is a folder: give the name of a file")
    if not output.parent.is_dir():
        raise LogError(f"{output} cannot be written: no folder {output.parent}")
    if not output.exists() and not os.access(output.parent, os.W_OK):
        raise LogError(f"{output} cannot be written: folder {output.parent.absolute()} is not writable")
    names = [name for name in (output, output.with_name(output.name + ACTIVE)) if name.exists()]
    for path in read:
        if path is not None and path.exists() and any(name.samefile(path) for name in names):
            named = "" if path == output else f" (as {path})"
            raise LogError(f"{output} is an input{named} and is not overwritten: give another name")


def reject_same_output(outputs: Sequence[Path]) -> None:
    """Raise LogError if two of the outputs are the same file."""
    named: dict[str, Path] = {}
    for output in outputs:
        if (first := named.setdefault(os.path.realpath(output), output)) is not output:
            raise LogError(f"{output} would be written twice (also as {first}): give another name")


def reject_other_flight(output: Path) -> None:
    """Raise LogError if `output`, which will be a log, exists and was not made by `replay` or `smooth`."""
    if output.exists() and not _has_metadata(output, DERIVED):
        raise LogError(
            f"{output} already exists and was not made by replay or smooth: give another name, or delete it"
        )


def remove_leftover(output: Path) -> None:
    """Remove what an interrupted run left of the log `output`, if it can be made again.

    Raises LogError if it is still being written, or may be the log of a flight.
    """
    active = output.with_name(output.name + ACTIVE)
    if not active.exists():
        return
    with active.open("rb") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            raise LogError(
                f"{active} is still being written: wait for its end, or give another name"
            ) from None
        if active.stat().st_size and not _has_metadata(active, DERIVED, CONVERTED):
            raise LogError(f"{active} already exists and may be of a flight: give another name, or delete it")
        active.unlink()


def _has_metadata(log: Path, *names: str) -> bool:
    try:
        return not flight_log.metadata(log).keys().isdisjoint(names)
    except OSError:
        return False  # not a log


def reject_any_log(output: Path) -> None:
    """Raise LogError if `output`, which will not be a log, is the name of an existing log."""
    target = Path(os.path.realpath(output))
    if target.exists() and (is_own_log(target) or target.suffix.lower() in sources.LOG_SUFFIXES):
        raise LogError(f"{output} is a log and is not overwritten: give another name")
