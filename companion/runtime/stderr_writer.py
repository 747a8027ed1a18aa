"""Lines for a reader who may be slow, or never read: told in order by a thread of its own.

    telling = Telling()
    telling.tell("main: autopilot 1 heard")     # at once, whoever reads
    telling.close()                             # what was told is out, or a second has passed

A terminal that was stopped, a pipe that nobody empties, a journal that hangs: a write to any of them lasts
until it is read. It goes past `sys.stderr`, whose lock a write that hangs would hold to the end: the
interpreter aborts where it cannot have it.
"""

from __future__ import annotations

import contextlib
import os
import sys
import threading
from collections import deque
from collections.abc import Callable

#: Lines that wait to be read; of more the oldest are dropped.
MOST = 1000
CLOSE_S = 1.0


def to_stderr(line: str) -> None:
    """Write one line; waits for the reader. OSError where there is none any more."""
    if sys.__stderr__ is None:  # closed before we were begun: the number may be another file's
        return
    data = f"{line}\n".encode()
    while data:
        data = data[os.write(sys.__stderr__.fileno(), data) :]


class Telling:
    """Hands lines to `write` in a thread, which may wait as long as it likes; at most `most` wait for it."""

    def __init__(self, write: Callable[[str], None] = to_stderr, most: int = MOST) -> None:
        self._write, self._most = write, most
        self._change = threading.Condition()
        self._waiting: deque[str] = deque()
        self._dropped = 0
        self._closed = False
        self._thread = threading.Thread(target=self._run, name="telling", daemon=True)
        self._thread.start()

    def tell(self, line: str) -> None:
        """Have `line` written soon. Never waits: the oldest line is dropped where there are too many."""
        with self._change:
            if len(self._waiting) >= self._most:
                self._waiting.popleft()
                self._dropped += 1
            self._waiting.append(line)
            self._change.notify()

    def close(self, timeout_s: float = CLOSE_S) -> None:
        """Have all that waits written; a reader who does not read is waited for no longer than that."""
        with self._change:
            self._closed = True
            self._change.notify()
        self._thread.join(timeout_s)

    def _run(self) -> None:
        while (line := self._next()) is not None:
            with contextlib.suppress(OSError):  # nobody reads it any more: no reason not to navigate
                self._write(line)

    def _next(self) -> str | None:
        with self._change:
            self._change.wait_for(lambda: self._waiting or self._closed)
            if self._dropped:
                dropped, self._dropped = self._dropped, 0
                return f"... {dropped} lines that nobody read in time"
            return self._waiting.popleft() if self._waiting else None
