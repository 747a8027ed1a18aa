"""What `companion run` prints: events as they come, and one status line.

On a terminal the status is the last line and changes every second; elsewhere (a journal, a file) it is
printed once a minute. With `as_json` every line is a JSON object, for programs.
"""

from __future__ import annotations

import json
import os
import shutil
import sys
from collections.abc import Callable

from companion.printable import printable
from companion.records import Event, Severity
from companion.runtime.status import Status
from companion.units import SECOND_NS

STATUS_INTERVAL = 60 * SECOND_NS
#: Move to the status line that was printed last, and clear it and what is below, such as ^C.
_REPLACE = "\x1b[1A\r\x1b[J"


class Console:
    """Lines for `write_line`, with times since `start_ns`."""

    def __init__(
        self,
        write_line: Callable[[str], None],
        start_ns: int,
        *,
        as_json: bool = False,
        columns: int | None = None,
    ) -> None:
        """`columns`: width of the terminal; None if the output is no terminal."""
        self._write_line, self._start_ns = write_line, start_ns
        self._as_json, self._columns = as_json, None if as_json else columns
        self._shown: str | None = None  # the status line below which nothing is printed
        self._next_status_ns = start_ns + STATUS_INTERVAL

    def event(self, event: Event) -> None:
        """Print an event."""
        seconds = self._seconds(event.rx_ns)
        if self._as_json:
            severity = Severity(event.severity).name.lower()
            self._write_line(json.dumps({"t_s": seconds, "severity": severity, "text": event.text}))
        else:
            self._print(f"{seconds:9.3f} {printable(event.text)}")

    def status(self, status: Status, now_ns: int) -> None:
        """Show the status; call it once a second."""
        line = f"{self._seconds(now_ns):5.0f} {status.text()}"
        if self._columns is not None:
            self._shown, before = line[: self._columns - 1], self._shown
            if self._shown != before:
                self._write_line(f"{_REPLACE if before is not None else ''}{self._shown}")
        elif now_ns >= self._next_status_ns:
            self._next_status_ns = now_ns + STATUS_INTERVAL
            values = {"t_s": self._seconds(now_ns), **status._asdict()}
            self._write_line(json.dumps(values) if self._as_json else line)

    def close(self) -> None:
        """Clear the status line: what is printed next takes its place."""
        if self._shown is not None:
            self._shown = None
            self._write_line(f"{_REPLACE}\x1b[1A")  # one line up, because writing a line goes one down

    def _print(self, line: str) -> None:
        if self._shown is None:
            self._write_line(line)
        else:
            self._write_line(f"{_REPLACE}{line}\n{self._shown}")

    def _seconds(self, now_ns: int) -> float:
        return round((now_ns - self._start_ns) / SECOND_NS, 3)


def terminal_columns() -> int | None:
    """Return the width of the terminal that stderr is, None if it is none."""
    stderr = sys.__stderr__
    if stderr is None or not stderr.isatty() or os.environ.get("TERM") == "dumb":
        return None
    return shutil.get_terminal_size().columns
