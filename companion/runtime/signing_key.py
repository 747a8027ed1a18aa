"""Signing key of the links: read at the start, its time kept synchronized, its last timestamp stored.

    key = SigningKey.from_config(config)    # None: no signing
    key.follow_system_time()                # every second
    trouble = key.save_timestamp()          # in a thread: blocks on the disk

With a system clock that is behind, every frame of an autopilot on GPS time would be from the future, and ours
from the past. A plausible date is no proof of a correct clock: a board without a battery starts with the time
of its last shutdown (fake-hwclock) or of the build of systemd. So on Linux the system time is used only while
the file exists that systemd-timesyncd creates after it has synchronized with a server, and that is absent
after a boot. Until then the time is taken from genuine frames; once set, it runs on the monotonic clock.

chrony and ntpd do not create that file, so the time always comes from genuine frames: signed links work, only
frames from the future are not rejected. The kernel knows the state of all three (adjtimex), but units that
protect the clock, like ours, kill a process that makes this call.
"""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Self

from companion.config import Config, ConfigError
from companion.link.signing import Signing, load_timestamp, read_key
from companion.runtime.state_file import replace_text

#: Created by systemd-timesyncd (239 and later) after the clock was synchronized with a server.
SYNCHRONIZED = "/run/systemd/timesync/synchronized"
#: On other systems than Linux, a system clock before 2024 was never set.
SET_AFTER_NS = 1_704_067_200_000_000_000


def synchronized_time(platform: str = sys.platform, synchronized: str = SYNCHRONIZED) -> int | None:
    """Return the system time, UNIX ns; None if it is not known to be synchronized."""
    unix_ns = time.time_ns()
    synchronized_now = os.path.exists(synchronized) if platform == "linux" else unix_ns >= SET_AFTER_NS
    return unix_ns if synchronized_now else None


def read_configured_key(config: Config) -> bytes | None:
    """Read the key of `signing.key_file`; None without one. Raises ConfigError for an unusable file."""
    if not config.signing.key_file:
        return None
    try:
        return read_key(Path(config.signing.key_file))
    except (OSError, ValueError) as error:
        raise ConfigError(f"signing.key_file: {error}") from None


class SigningKey:
    """MAVLink 2 signing with its key and the timestamp that outlives a restart."""

    def __init__(
        self, signing: Signing, stamp: Path, system_time: Callable[[], int | None] = synchronized_time
    ) -> None:
        """`stamp`: file of the timestamp; `system_time`: UNIX ns, None while not synchronized."""
        self.signing, self._stamp, self._system_time = signing, stamp, system_time
        self.follow_system_time()

    @classmethod
    def from_config(cls, config: Config) -> Self | None:
        """Create from the configuration; None without a key. Raises ConfigError for an unusable key."""
        settings = config.signing
        if (key := read_configured_key(config)) is None:
            return None
        stamp = Path(settings.stamp_file)
        try:
            signing = Signing(
                key,
                timestamp=load_timestamp(stamp),
                refuse_unsigned=settings.refuse_unsigned,
                always_accepted=settings.always_accepted,
            )
        except (OSError, ValueError) as error:
            raise ConfigError(f"signing.key_file: {error}") from None
        return cls(signing, stamp)

    def follow_system_time(self) -> None:
        """Use the system time, which may be set at any moment, if it is synchronized."""
        if (unix_ns := self._system_time()) is not None:
            self.signing.set_time(unix_ns, time.monotonic_ns())

    def save_timestamp(self) -> str | None:
        """Store the timestamp; return the error if the disk failed (the next call retries), else None."""
        if self.signing.needs_saving:
            timestamp = self.signing.timestamp_to_save()
            try:
                replace_text(self._stamp, f"{timestamp}\n")
            except OSError as error:
                return f"cannot write {self._stamp}: {error.strerror or error}"
            self.signing.note_saved(timestamp)
        return None
