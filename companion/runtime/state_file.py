"""State file: a small text that outlives a restart, written atomically to a disk that may be slow or full.

    file = StateFile(path)
    file.put(text)              # returns at once; OSError while the disk fails
    trouble = file.write()      # in a thread: writes the last text, returns the error of the disk

It does not interpret the text, starts no thread and reads no clock.
"""

from __future__ import annotations

import errno
import os
import threading
from pathlib import Path

BOOT_ID = Path("/proc/sys/kernel/random/boot_id")


def boot_id(path: Path) -> str:
    """Return the id of this boot of the computer; "unknown" where the system does not state it."""
    try:
        return path.read_text("ascii").strip()
    except (OSError, ValueError):
        return "unknown"


class StateFile:
    """Text of one file; with `path` None nothing is stored."""

    def __init__(self, path: Path | None) -> None:
        self._path = path
        self._lock = threading.Lock()
        self._pending: str | None = None
        self.trouble: str | None = None

    def put(self, text: str) -> None:
        """Set the text for the next `write`. Raises OSError while the previous text cannot be stored."""
        with self._lock:
            if self.trouble is not None:
                raise OSError(errno.EIO, self.trouble)
            self._pending = text

    def write(self) -> str | None:
        """Store the pending text; return the error if the disk failed (the next call retries), else None."""
        with self._lock:
            text, self._pending = self._pending, None
        if text is None or self._path is None:
            return self.trouble
        try:
            replace_text(self._path, text)
        except OSError as error:
            with self._lock:
                self._pending = text if self._pending is None else self._pending
                self.trouble = f"cannot write {self._path}: {error.strerror or error}"
        else:
            self.trouble = None
        return self.trouble


def replace_text(path: Path, text: str) -> None:
    """Replace a file atomically: a power loss leaves the old text or the new one. Raises OSError.

    A folder or a device, such as /dev/null, is not replaced.
    """
    if path.exists() and not path.is_file():
        raise OSError(errno.EINVAL, "not a regular file", str(path))
    temporary = path.with_name(path.name + ".new")
    with temporary.open("w", encoding="utf-8") as file:
        file.write(text)
        file.flush()
        os.fsync(file.fileno())
    os.replace(temporary, path)
