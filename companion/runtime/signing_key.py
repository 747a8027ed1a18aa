"""The key of signed links through the life of a process: read once, its time followed, its stamp kept.

    keys = Keys.of(config)      # None: nothing is signed
    keys.follow()               # every second
    keys.store()                # in a thread: waits for a disk

By a clock that is behind, every frame of an autopilot on GPS time would be of the future, and ours of the
past there. That a system clock shows a time of these years says nothing: a board without a battery begins
where it was last shut down (fake-hwclock) or when its systemd was built. So on Linux the system's time is
taken only while there is a file that systemd-timesyncd makes once a server has told it the time, and that the
next boot begins without. Till then time is what genuine frames say; a time once taken runs on by itself.

With chrony or ntpd nobody makes that file, and genuine frames tell the time always: signed links live, and
miss only the refusal of what is stamped ahead. The kernel knows of all three (adjtimex), but units that
protect the clock, ours too, end a process that asks it.
"""

from __future__ import annotations

import contextlib
import os
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Self

from companion.config import Config, ConfigError
from companion.link.signing import Signing, read_key, store, stored

#: Made by systemd-timesyncd (239 and later) when the clock has been set after a server's.
SYNCHRONIZED = "/run/systemd/timesync/synchronized"
#: Elsewhere than on Linux, a system clock before 2024 was never set.
SET_AFTER_NS = 1_704_067_200_000_000_000


def synchronized_time(platform: str = sys.platform, synchronized: str = SYNCHRONIZED) -> int | None:
    """The system's time, UNIX nanoseconds; None where nobody vouches for it."""
    unix_ns = time.time_ns()
    vouched = os.path.exists(synchronized) if platform == "linux" else unix_ns >= SET_AFTER_NS
    return unix_ns if vouched else None


class Keys:
    """MAVLink 2 signing with its key and the timestamp that must outlive a restart."""

    def __init__(
        self, signing: Signing, stamp: Path, system_time: Callable[[], int | None] = synchronized_time
    ) -> None:
        """`system_time`: UNIX nanoseconds, None while nobody vouches for them."""
        self.signing, self._stamp, self._system_time = signing, stamp, system_time
        self.follow()

    @classmethod
    def of(cls, config: Config) -> Self | None:
        """As the configuration says, None without a key. Raises ConfigError for an unusable key."""
        settings = config.signing
        if not settings.key_file:
            return None
        stamp = Path(settings.stamp_file)
        try:
            signing = Signing(
                read_key(Path(settings.key_file)),
                timestamp=stored(stamp),
                refuse_unsigned=settings.refuse_unsigned,
                always_accepted=settings.always_accepted,
            )
        except (OSError, ValueError) as error:
            raise ConfigError(f"signing.key_file: {error}") from None
        return cls(signing, stamp)

    def follow(self) -> None:
        """Take the system's time, which may be set at any moment, if there is one."""
        if (unix_ns := self._system_time()) is not None:
            self.signing.follow(unix_ns, time.monotonic_ns())

    def store(self) -> None:
        """Keep the timestamp; a disk that refuses costs signed links a minute after the next start."""
        if self.signing.wants_storing:
            with contextlib.suppress(OSError):
                store(self._stamp, self.signing.to_store())
