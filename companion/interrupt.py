"""Ctrl-C at any time ends in one line and exit code 130.

While modules are imported the signal handler ends the process: a KeyboardInterrupt there can turn into
another error (of `__set_name__`, RuntimeError until Python 3.12) or get lost in a callback of the import
system. A command receives KeyboardInterrupt, so that it can clean up. Standard library only: the entry point
imports it before all else.
"""

import os
import signal
from types import FrameType
from typing import NoReturn

EX_INTERRUPTED = 130  # as a shell reports SIGINT


def end(number: int | None = None, frame: FrameType | None = None) -> NoReturn:
    """Print one line and end the process, without clean-up."""
    try:
        os.write(2, b"companion: interrupted\n")
    finally:  # also without a stderr
        os._exit(EX_INTERRUPTED)


def end_at_interrupt() -> None:
    """End the process at SIGINT, unless it is ignored (a background process)."""
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, end)


def raise_at_interrupt() -> None:
    """Raise KeyboardInterrupt at SIGINT again. No effect without `end_at_interrupt`."""
    if signal.getsignal(signal.SIGINT) is end:
        signal.signal(signal.SIGINT, signal.default_int_handler)
