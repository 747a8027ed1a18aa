"""Non-blocking stderr writer: a daemon thread writes, so a stalled reader cannot block the event loop.

    writer = StderrWriter()
    writer.write_line("main: autopilot 1 connected")    # returns at once
    writer.close()                                      # waits until all is written, at most a second

A write to a stopped terminal, a full pipe or a stalled journal blocks until it is read. The thread writes to
the file descriptor and not to `sys.stderr`: a blocked write would hold its lock, and the interpreter aborts
if it cannot take that lock at exit.
"""

from __future__ import annotations

import contextlib
import os
import sys
import threading
from collections import deque
from collections.abc import Callable

#: Queue length; when it is full the oldest line is dropped.
MAX_LINES = 1000
CLOSE_S = 1.0


def write_to_stderr(line: str) -> None:
    """Write one line; blocks until it is read. Raises OSError if the reader is gone."""
    if sys.__stderr__ is None:  # closed before the start: the descriptor may belong to another file
        return
    data = f"{line}\n".encode()
    while data:
        data = data[os.write(sys.__stderr__.fileno(), data) :]


class StderrWriter:
    """Queue of at most `max_lines` lines, written in order by a daemon thread through `write`."""

    def __init__(self, write: Callable[[str], None] = write_to_stderr, max_lines: int = MAX_LINES) -> None:
        self._write, self._max_lines = write, max_lines
        self._condition = threading.Condition()
        self._queue: deque[str] = deque()
        self._dropped = 0
        self._closed = False
        self._thread = threading.Thread(target=self._run, name="stderr-writer", daemon=True)
        self._thread.start()

    def write_line(self, line: str) -> None:
        """Queue `line`. Never blocks: a full queue drops its oldest line."""
        with self._condition:
            if len(self._queue) >= self._max_lines:
                self._queue.popleft()
                self._dropped += 1
            self._queue.append(line)
            self._condition.notify()

    def close(self, timeout_s: float = CLOSE_S) -> None:
        """Write what is queued; wait at most `timeout_s`."""
        with self._condition:
            self._closed = True
            self._condition.notify()
        self._thread.join(timeout_s)

    def _run(self) -> None:
        while (line := self._next()) is not None:
            with contextlib.suppress(OSError):  # the reader is gone: keep navigating
                self._write(line)

    def _next(self) -> str | None:
        with self._condition:
            self._condition.wait_for(lambda: self._queue or self._closed)
            if self._dropped:
                dropped, self._dropped = self._dropped, 0
                return f"... {dropped} lines dropped: stderr was not read in time"
            return self._queue.popleft() if self._queue else None
