"""Ctrl-C at any time ends in one line and exit code 130.

While modules are imported the signal handler ends the process: a KeyboardInterrupt there can turn into
another error (of `__set_name__`, RuntimeError until Python 3.12) or get lost in a callback of the import
system. A command receives KeyboardInterrupt, so that it can clean up. Standard library only: the entry point
imports it before all else.
"""

import os
import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
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


@contextmanager
def passed_to(report: Callable[[], object]) -> Iterator[None]:
    """Call `report` at SIGINT in place of KeyboardInterrupt, which is lost in a callback of the collector.

    A second SIGINT ends the process. No effect where SIGINT is ignored or handled otherwise, nor in another
    thread than the main one.
    """
    former = signal.getsignal(signal.SIGINT)
    is_ours = former in (signal.default_int_handler, end)
    if not is_ours or threading.current_thread() is not threading.main_thread():
        yield
        return

    def receive(number: int, frame: FrameType | None) -> None:
        signal.signal(signal.SIGINT, end)
        report()

    signal.signal(signal.SIGINT, receive)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, former)


@contextmanager
def held() -> Iterator[None]:
    """Hold SIGINT back until the end of the block; threads and processes started in it never receive it."""
    from multiprocessing import resource_tracker

    resource_tracker.ensure_running()  # its own start would let the signal through again
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    # a thread of before, as those of linear algebra, can receive it still, and Python then handles it here
    received: list[int] = []
    former = signal.getsignal(signal.SIGINT)
    is_handled = callable(former) and threading.current_thread() is threading.main_thread()
    if is_handled:
        signal.signal(signal.SIGINT, lambda number, frame: received.append(number))
    try:
        yield
    finally:
        if is_handled:
            signal.signal(signal.SIGINT, former)
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
        for number in received[:1]:
            signal.raise_signal(number)
