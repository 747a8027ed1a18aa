"""A serial line: opened raw, and for nobody else."""

from __future__ import annotations

import contextlib
import errno
import fcntl
import os
import termios
import tty

from companion.transport.address import BAUD_RATES, Address
from companion.transport.connection import AT_ONCE, Stream

TAKEN = "another program has this line open: end it"


def open_serial(address: Address) -> Stream:
    """Open the device raw, without flow control, at its rate. OSError, in words where it is somebody else's.

    Two readers would share its bytes out among them. TIOCEXCL keeps all but root from opening it while we
    have it; the lock keeps out who asks for it, root too: a companion, and what is made with pySerial.
    """
    try:
        fd = os.open(address.place, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
    except OSError as error:
        if error.errno == errno.EBUSY:
            raise OSError(TAKEN) from None
        raise
    try:
        _claim(fd)
        tty.setraw(fd)
        mode = termios.tcgetattr(fd)
        mode[2] = mode[2] & ~(termios.CRTSCTS | termios.CSTOPB) | termios.CLOCAL | termios.CREAD
        mode[4] = mode[5] = BAUD_RATES[address.number]
        termios.tcsetattr(fd, termios.TCSANOW, mode)
        termios.tcflush(fd, termios.TCIOFLUSH)
    except BaseException as error:
        os.close(fd)
        if isinstance(error, BlockingIOError):
            raise OSError(TAKEN) from None
        if isinstance(error, termios.error):
            raise OSError(f"not a serial line: {error.args[1]}") from None
        raise

    def release() -> None:
        with contextlib.suppress(OSError):  # a device that was pulled out
            fcntl.ioctl(fd, termios.TIOCNXCL)  # would outlive us where somebody had it open before
        os.close(fd)

    return Stream(str(address), fd, lambda: os.read(fd, AT_ONCE), lambda frame: os.write(fd, frame), release)


def _claim(fd: int) -> None:
    """Raises BlockingIOError where somebody holds the lock; a driver that knows neither way is used as is."""
    try:
        fcntl.flock(fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        raise
    except OSError:
        pass
    with contextlib.suppress(OSError):
        fcntl.ioctl(fd, termios.TIOCEXCL)
