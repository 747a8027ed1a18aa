"""What is never written over: the log that is read, through whatever link, and by a report any log at all."""

from __future__ import annotations

from pathlib import Path

from companion.analysis.replay_inputs import is_own
from companion.importers import sources
from companion.storage.reader import LogError


def refuse_own_input(output: Path, *read: Path | None) -> None:
    """LogError, one sentence, where `output` is one of the files that are `read`."""
    for path in read:
        if path is not None and path.exists() and output.exists() and output.samefile(path):
            raise LogError(f"{output} is read (as {path}) and not written over: give another name")


def refuse_any_log(output: Path) -> None:
    """LogError, one sentence, where `output`, to hold no log, is the name of one that is there."""
    target = output.resolve()
    if target.exists() and (is_own(target) or target.suffix.lower() in sources.KINDS):
        raise LogError(f"{output} is a log: a report is not written over it, give another name")
