"""A small text that must outlive a restart: kept whole on a disk that may be slow, full or gone.

    kept = Kept(path)
    kept.put(text)              # at once; OSError while the disk refuses
    trouble = kept.write()      # in a thread: puts on disk what was put last, says what the disk said

It knows nothing of what the text says, starts no thread and asks no clock.
"""

from __future__ import annotations

import errno
import os
import threading
from pathlib import Path


class Kept:
    """The text of one file; `path` None: nothing is kept."""

    def __init__(self, path: Path | None) -> None:
        self._path = path
        self._lock = threading.Lock()
        self._waiting: str | None = None
        self.trouble: str | None = None

    def put(self, text: str) -> None:
        """Have `text` kept soon. OSError while what was put before it cannot be."""
        with self._lock:
            if self.trouble is not None:
                raise OSError(errno.EIO, self.trouble)
            self._waiting = text

    def write(self) -> str | None:
        """Put on disk what waits; what the disk said if it refused (then it is tried again), else None."""
        with self._lock:
            text, self._waiting = self._waiting, None
        if text is None or self._path is None:
            return self.trouble
        try:
            replace_text(self._path, text)
        except OSError as error:
            with self._lock:
                self._waiting = text if self._waiting is None else self._waiting
                self.trouble = f"cannot write {self._path}: {error.strerror or error}"
        else:
            self.trouble = None
        return self.trouble


def replace_text(path: Path, text: str) -> None:
    """Write a file so that a loss of power leaves the old one or the new one, never half. OSError if not."""
    beside = path.with_name(path.name + ".new")
    with beside.open("w", encoding="utf-8") as file:
        file.write(text)
        file.flush()
        os.fsync(file.fileno())
    os.replace(beside, path)
