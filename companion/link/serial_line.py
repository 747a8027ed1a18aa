"""A serial line, or what stands for one."""

from __future__ import annotations

import os
import termios
import tty

from companion.link.address import BAUD_RATES, Address
from companion.link.stream import AT_ONCE, Stream


def open_serial(address: Address) -> Stream:
    """Open the device raw, without flow control, at its rate. OSError."""
    fd = os.open(address.place, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
    try:
        tty.setraw(fd)
        mode = termios.tcgetattr(fd)
        mode[2] = mode[2] & ~(termios.CRTSCTS | termios.CSTOPB) | termios.CLOCAL | termios.CREAD
        mode[4] = mode[5] = BAUD_RATES[address.number]
        termios.tcsetattr(fd, termios.TCSANOW, mode)
        termios.tcflush(fd, termios.TCIOFLUSH)
    except termios.error as error:
        os.close(fd)
        raise OSError(error.args[0], f"not a serial line: {error.args[1]}") from None
    return Stream(str(address), fd, lambda: os.read(fd, AT_ONCE), lambda frame: os.write(fd, frame))
