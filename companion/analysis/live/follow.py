"""Sources of the live view: a log followed chunk by chunk while it is written, or a finished one played back.

Both give the messages that are new since the last call. The flight does not notice: the log is only read.
"""

from __future__ import annotations

import contextlib
import os
import time
from pathlib import Path
from typing import NamedTuple

from companion.importers.sources import LOG_SUFFIXES
from companion.records import Stamped
from companion.storage import flight_log
from companion.storage.reader import ACTIVE, DamagedError, LogError, LogReader, is_closed, open_log

BLOCK = 1 << 22  # bytes read at a time


class Channel(NamedTuple):
    """Topic, encoding and schema of a channel; `schema` and `data` are empty if it has none."""

    topic: str
    encoding: str
    schema: str
    data: bytes


class Message(NamedTuple):
    """One message: its channel, wall-clock time of arrival (ns), and content."""

    channel: Channel
    log_ns: int
    content: bytes


class FollowedLog:
    """A log that may still grow. Only complete chunks are read; `ended` when the log was closed, `is_behind`
    while more of it can be read.

    Raises LogError if the file cannot be read or is no MCAP log.
    """

    def __init__(self, path: Path) -> None:
        self.path, self.ended, self.is_behind = path, False, False
        with open_log(path):  # a sentence for the user if it is none
            self._file = path.open("rb", buffering=0)
        self._reader = LogReader(path, self._file, 0)
        self._channels: dict[int, Channel] = {}

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    def since_write_s(self) -> float:
        """Return the time since the log was written last; its messages keep the clock of the start."""
        return max(0.0, time.time() - os.fstat(self._file.fileno()).st_mtime)

    def poll(self) -> list[Message]:
        """Return the messages of at most some megabytes of new chunks; may block on the disk."""
        found: list[Message] = []
        reader, start = self._reader, self._reader.end
        self.is_behind = True
        reader.size = os.fstat(self._file.fileno()).st_size
        for raw in reader.records():
            try:
                messages = reader.unpack(raw.parse())
            except DamagedError:  # the rest may still be read
                continue
            for message in messages:
                channel = self._channels.get(message.channel_id) or self._channel(message.channel_id)
                found.append(Message(channel, message.log_time, message.data))
            if reader.end - start > BLOCK:
                return found
        self.is_behind = False
        if not found:
            self.ended = LogReader(self.path, self._file, reader.size).closed
        return found

    def _channel(self, number: int) -> Channel:
        if not self._reader.is_defined(number):
            return Channel("", "", "", b"")
        of = self._reader.channels[number]
        schema = self._reader.schemas.get(of.schema_id)
        name, data = ("", b"") if schema is None else (schema.name, schema.data)
        self._channels[number] = Channel(of.topic, of.message_encoding, name, data)
        return self._channels[number]


class PlayedLog:
    """A finished log, played back at `speed` times the pace of the flight."""

    def __init__(self, path: Path, speed: float) -> None:
        self.path, self.ended = path, False
        self._log, self._speed = FollowedLog(path), speed
        self._waiting: list[Message] = []
        self._started: float | None = None
        self._first_ns = 0

    def poll(self) -> list[Message]:
        """Return the messages that are due."""
        while not self._waiting and not self._log.ended:
            self._waiting = self._log.poll()
            if not self._waiting:
                break
        if not self._waiting:
            self.ended = True
            return []
        if self._started is None:
            self._started, self._first_ns = time.monotonic(), self._waiting[0].log_ns
        due_ns = self._first_ns + round((time.monotonic() - self._started) * self._speed * 1e9)
        count = next((k for k, m in enumerate(self._waiting) if m.log_ns > due_ns), len(self._waiting))
        due, self._waiting = self._waiting[:count], self._waiting[count:]
        return due

    def close(self) -> None:
        """Close the file."""
        self._log.close()


def reject_foreign(path: Path) -> None:
    """Raise LogError if the log at `path` is not one of ours; one that is still written may be empty."""
    if path.suffix.lower() in LOG_SUFFIXES:
        raise LogError(
            f"{path}: convert it first: companion log convert {path} -o {path.with_suffix('.mcap')}"
        )
    if is_closed(path) and not any(isinstance(entry.value, Stamped) for entry in flight_log.read(path)):
        raise LogError(f"{path} contains no records of the companion: nothing to show")


def find_log(path: Path) -> Path | None:
    """Return the log to show: `path` itself, or the newest log of a folder that is being written, else None.

    Raises LogError if there is nothing at `path`.
    """
    if path.is_dir():
        logs = list[tuple[int, Path]]()
        for log in path.glob(f"*.mcap{ACTIVE}"):
            with contextlib.suppress(FileNotFoundError):  # closed in between: it has another name
                logs.append((log.stat().st_mtime_ns, log))
        return max(logs)[1] if logs else None
    if not path.exists():
        active = path.with_name(path.name + ACTIVE)
        if active.exists():
            return active
        raise LogError(f"{path}: there is no such log or folder")
    return path
