"""Protection of logs from being overwritten by the outputs of commands."""

from __future__ import annotations

from pathlib import Path

from companion.analysis.replay_inputs import is_own_log
from companion.importers import sources
from companion.storage.reader import LogError


def reject_own_input(output: Path, *read: Path | None) -> None:
    """Raise LogError if `output` is one of the input files, directly or through a link."""
    for path in read:
        if path is not None and path.exists() and output.exists() and output.samefile(path):
            raise LogError(f"{output} is an input (as {path}) and is not overwritten: give another name")


def reject_any_log(output: Path) -> None:
    """Raise LogError if `output`, which will not be a log, is the name of an existing log."""
    target = output.resolve()
    if target.exists() and (is_own_log(target) or target.suffix.lower() in sources.LOG_SUFFIXES):
        raise LogError(f"{output} is a log and is not overwritten by a report: give another name")
