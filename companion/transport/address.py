"""Connection strings: parsing and validation."""

from __future__ import annotations

import ipaddress
import re
import socket
import termios
from typing import NamedTuple

FORMS = "serial:DEVICE:BAUD, udpin:HOST:PORT, udpout:HOST:PORT, tcp:HOST:PORT or tcpin:HOST:PORT"
#: Baud rates of this system: termios constant by number. B0 is none: it hangs up.
BAUD_RATES = {
    int(name[1:]): value
    for name, value in vars(termios).items()
    if name[0] == "B" and name[1:].isdigit() and name != "B0"
}
LOOPBACK = "127.0.0.1"
NOT_IN_NAMES = re.compile(rb"[^A-Za-z0-9._-]")  # of hosts
LISTENING = ("udpin", "tcpin")
KINDS = ("serial", "udpout", "tcp", *LISTENING)


class Address(NamedTuple):
    """Address of a link: `kind` serial, udpin, udpout, tcp or tcpin; `number` a port or a baud rate."""

    kind: str
    place: str
    number: int

    @classmethod
    def parse(cls, text: str) -> Address:
        """Parse a connection string; ValueError if it is invalid. The default host of a listening link is the
        loopback address.
        """
        kind, _, rest = text.partition(":")
        place, colon, digits = rest.rpartition(":")
        listens = kind in LISTENING
        if not colon and listens:
            place = ""
        if kind == "serial" and place and not digits.isdecimal():
            raise ValueError(f"{text!r}: {digits!r} is not a baud rate: give one like 57600 or 921600")
        if kind not in KINDS or not digits.isdecimal():
            raise ValueError(f"{text!r} is not a connection string: give {FORMS}")
        number = int(digits)
        if kind == "serial":
            if number not in BAUD_RATES:
                raise ValueError(
                    f"{text!r}: {number} is not a baud rate of this system: give one like 57600 or 921600"
                )
        elif not (0 if listens else 1) <= number <= 65535:
            raise ValueError(f"{text!r}: {number} is not a port: give 1 to 65535")
        if not place and not listens:
            raise ValueError(
                f"{text!r} is not a connection string, the host or device is missing: give {FORMS}"
            )
        place = place.strip("[]") or LOOPBACK
        if kind == "serial" and not _is_device(place):
            raise ValueError(f"{text!r}: {place!r} is not a device name")
        if kind != "serial" and not _is_host(place):
            raise ValueError(f"{text!r}: {place!r} is neither an address nor a host name")
        return cls(kind, place, number)

    @property
    def listens(self) -> bool:
        """Whether peers connect to this address."""
        return self.kind in LISTENING

    def __str__(self) -> str:
        place = f"[{self.place}]" if ":" in self.place else self.place
        return f"{self.kind}:{place}:{self.number}"


def _is_device(place: str) -> bool:
    try:
        return b"\0" not in place.encode()
    except UnicodeError:
        return False


def _is_host(place: str) -> bool:
    """Return whether `place` is a possible host; digits and dots alone are an address, not a name."""
    try:
        if ":" in place:
            ipaddress.IPv6Address(place)
        elif place.replace(".", "").isdecimal():
            socket.inet_aton(place)
        else:
            return NOT_IN_NAMES.search(place.encode("idna")) is None
    except (OSError, ValueError):  # UnicodeError is a ValueError
        return False
    return True
