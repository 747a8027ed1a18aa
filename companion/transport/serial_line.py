"""Serial lines, opened in raw mode for exclusive use."""

from __future__ import annotations

import contextlib
import errno
import fcntl
import os
import termios
import tty

from companion.transport.address import BAUD_RATES, Address
from companion.transport.connection import READ_SIZE, Connection

IN_USE = "another program has this line open: end it"
NOT_SERIAL = "not a serial line; see `ls /dev/serial/by-id`"
NO_DEVICE = "no such device; see `ls /dev/serial/by-id`"


def open_serial(address: Address) -> Connection:
    """Open the device in raw mode, without flow control, at its baud rate. OSError if it fails or is in use.

    Two readers would each get a part of the bytes. TIOCEXCL keeps all users but root from opening the device
    while it is open here; the lock keeps out every program that requests it, run by root too: another
    companion, and programs that use pySerial.
    """
    try:
        fd = os.open(address.place, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
    except FileNotFoundError:
        raise OSError(NO_DEVICE) from None
    except IsADirectoryError:
        raise OSError(NOT_SERIAL) from None
    except OSError as error:
        if error.errno == errno.EBUSY:
            raise OSError(IN_USE) from None
        raise
    try:
        _lock(fd)
        tty.setraw(fd)
        mode = termios.tcgetattr(fd)
        mode[2] = mode[2] & ~(termios.CRTSCTS | termios.CSTOPB) | termios.CLOCAL | termios.CREAD
        mode[4] = mode[5] = BAUD_RATES[address.number]
        termios.tcsetattr(fd, termios.TCSANOW, mode)
        termios.tcflush(fd, termios.TCIOFLUSH)
    except BaseException as error:
        os.close(fd)
        if isinstance(error, BlockingIOError):
            raise OSError(IN_USE) from None
        if isinstance(error, termios.error):
            not_serial = error.args[0] == errno.ENOTTY
            raise OSError(NOT_SERIAL if not_serial else f"cannot be set up: {error.args[1]}") from None
        raise

    def release() -> None:
        with contextlib.suppress(OSError):  # a device that was unplugged
            fcntl.ioctl(fd, termios.TIOCNXCL)  # it would persist if another process keeps the device open
        os.close(fd)

    return Connection(
        str(address), fd, lambda: os.read(fd, READ_SIZE), lambda frame: os.write(fd, frame), release
    )


def _lock(fd: int) -> None:
    """Lock the device, if its driver supports locks; BlockingIOError if another process holds the lock."""
    try:
        fcntl.flock(fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        raise
    except OSError:
        pass
    with contextlib.suppress(OSError):
        fcntl.ioctl(fd, termios.TIOCEXCL)
