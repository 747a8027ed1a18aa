"""What the service manager is told of us: ready, alive, stopping. Silent where there is none.

The protocol of sd_notify(3) is a datagram of NAME=VALUE lines to the socket that NOTIFY_SOCKET names; a name
that begins with @ is in the abstract namespace. The watchdog's term is WATCHDOG_USEC. The packages for it
are bindings to libsystemd (a compiler and headers on every board) or unmaintained, for less than is here.

It has no thread and no timer: `alive` is told by whom it is to vouch for.
"""

from __future__ import annotations

import contextlib
import os
import socket
from collections.abc import Mapping

#: How often within its term the watchdog is fed.
TIMES = 4


class Manager:
    """The service manager at the other end, as `environment` (of the process) names it."""

    def __init__(self, environment: Mapping[str, str]) -> None:
        name = environment.get("NOTIFY_SOCKET", "")
        self._place = "\0" + name[1:] if name.startswith("@") else name
        meant = environment.get("WATCHDOG_PID", "") in ("", str(os.getpid()))
        term_us = environment.get("WATCHDOG_USEC", "")
        self._every_ns = 1000 * int(term_us) // TIMES if meant and term_us.isdecimal() else 0
        self._fed_ns: int | None = None
        self._is_ready = False

    def ready(self) -> None:
        """It serves; told once."""
        if not self._is_ready:
            self._is_ready = True
            self._tell("READY=1")

    def alive(self, now_ns: int) -> None:
        """Work was done at `now_ns`: feed the watchdog, if there is one and it is time."""
        if self._every_ns and (self._fed_ns is None or now_ns - self._fed_ns >= self._every_ns):
            self._fed_ns = now_ns
            self._tell("WATCHDOG=1")

    def status(self, text: str) -> None:
        """One line for `systemctl status`."""
        self._tell("STATUS=" + text.replace("\n", " "))

    def stopping(self) -> None:
        """The end has begun."""
        self._tell("STOPPING=1")

    def _tell(self, line: str) -> None:
        if self._place[:1] in ("/", "\0"):
            # a manager that does not listen is no reason not to navigate
            with contextlib.suppress(OSError), socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as sock:
                sock.sendto(line.encode(), socket.MSG_DONTWAIT, self._place)
