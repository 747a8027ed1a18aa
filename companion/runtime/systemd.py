"""systemd notification: ready, watchdog, status and stopping; does nothing without a service manager.

The protocol of sd_notify(3) is a datagram of NAME=VALUE lines to the socket in NOTIFY_SOCKET; a name that
starts with @ is in the abstract namespace. The watchdog timeout is WATCHDOG_USEC. The existing packages are
bindings to libsystemd (which need a compiler and headers on the board) or unmaintained.

There is no thread and no timer: `alive` is called by the work that it confirms.
"""

from __future__ import annotations

import contextlib
import os
import socket
from collections.abc import Mapping

#: Watchdog notifications per timeout.
FEEDS_PER_TIMEOUT = 4


class SystemdNotifier:
    """Connection to the service manager that the process `environment` names."""

    def __init__(self, environment: Mapping[str, str]) -> None:
        name = environment.get("NOTIFY_SOCKET", "")
        self._address = "\0" + name[1:] if name.startswith("@") else name
        applies = environment.get("WATCHDOG_PID", "") in ("", str(os.getpid()))
        timeout_us = environment.get("WATCHDOG_USEC", "")
        self._interval_ns = (
            1000 * int(timeout_us) // FEEDS_PER_TIMEOUT if applies and timeout_us.isdecimal() else 0
        )
        self._fed_ns: int | None = None
        self._is_ready = False

    def ready(self) -> None:
        """Notify that the service is ready; sent once."""
        if not self._is_ready:
            self._is_ready = True
            self._notify("READY=1")

    def is_watchdog_due(self, now_ns: int) -> bool:
        """Whether the watchdog is enabled and must be fed."""
        fed_ns = self._fed_ns
        return bool(self._interval_ns) and (fed_ns is None or now_ns - fed_ns >= self._interval_ns)

    def alive(self, now_ns: int) -> None:
        """Feed the watchdog, if enabled and due, for work completed at `now_ns`."""
        if self.is_watchdog_due(now_ns):
            self._fed_ns = now_ns
            self._notify("WATCHDOG=1")

    def status(self, text: str) -> None:
        """Set the line shown by `systemctl status`."""
        self._notify("STATUS=" + text.replace("\n", " "))

    def stopping(self) -> None:
        """Notify that the service is stopping."""
        self._notify("STOPPING=1")

    def _notify(self, line: str) -> None:
        if self._address[:1] in ("/", "\0"):
            # keep navigating without a listening manager
            with contextlib.suppress(OSError), socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as sock:
                sock.sendto(line.encode(), socket.MSG_DONTWAIT, self._address)
