"""What a run of the service keeps of the flight: if it is killed or crashes, the next one goes on with it.

    kept = KeptRun(folder)
    last = kept.take(config)     # at the start, once: what crashed a run must not crash the next one
    kept.keep(flown)             # every KEEP_S, in a thread; returns the error of the disk
    kept.end()                   # ended as requested: the next run begins a flight of its own

The file is of use to this boot of the computer only, as its times are of the monotonic clock: systemd's
RUNTIME_DIRECTORY, else the log folder, is its place, and nothing waits until a disk has it.
"""

from __future__ import annotations

import contextlib
import os
from pathlib import Path

import msgspec

from companion import __version__
from companion.config import Config, ConfigError, parse
from companion.runtime.state_file import BOOT_ID, boot_id
from companion.storage.reader import open_regular

NAME = "companion.flight"
KEEP_S = 2.0
KEEP_AFTER_S = 30.0  # of solutions: what is wrong with a state that was gone on with shows before


class Flown(msgspec.Struct, frozen=True):
    """The autopilot's system id and boot on our clock (ns), our configuration as TOML, and the state."""

    system: int
    booted_ns: int
    toml: str
    state: bytes


class _File(msgspec.Struct, frozen=True):
    boot: str
    version: str
    flown: Flown


class KeptRun:
    """The file of one log folder."""

    def __init__(self, folder: Path, boot: Path = BOOT_ID) -> None:
        self.path = Path(os.environ.get("RUNTIME_DIRECTORY") or folder) / NAME
        self._boot, self._ended = boot, False

    def take(self, config: Config) -> Flown | None:
        """Return what the run before left, if it was of this boot, this version and the same links."""
        try:
            with open_regular(self.path) as file:
                found = msgspec.msgpack.decode(file.read(), type=_File)
            links = parse(found.flown.toml, str(self.path)).link.connect
        except (OSError, msgspec.MsgspecError, UnicodeError, RecursionError, ConfigError):
            return None
        finally:
            self._remove()
        is_ours = (found.boot, found.version) == (boot_id(self._boot), __version__)
        return found.flown if is_ours and links == config.link.connect else None

    def keep(self, flown: Flown) -> str:
        """Replace the file; return the error of the disk in a sentence, empty if there is none."""
        new = self.path.with_name(NAME + ".new")
        try:
            new.write_bytes(msgspec.msgpack.encode(_File(boot_id(self._boot), __version__, flown)))
            os.replace(new, self.path)
            if self._ended:  # meanwhile
                self._remove()
        except OSError as error:
            return f"cannot write {self.path}: {error.strerror or error}"
        return ""

    def end(self) -> None:
        """Leave nothing to the next run."""
        self._ended = True
        self._remove()

    def _remove(self) -> None:
        with contextlib.suppress(OSError):
            self.path.unlink(missing_ok=True)
