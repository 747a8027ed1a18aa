"""Daemon thread for blocking work whose completion the process does not wait for.

    trouble = await run_in_daemon_thread(write)

`asyncio.to_thread` uses a pool that is joined when the process exits; with a disk or a name server that never
responds the process would not exit.
"""

from __future__ import annotations

import asyncio
import threading
from collections.abc import Callable
from concurrent.futures import Future
from typing import TypeVar

T = TypeVar("T")


def run_in_daemon_thread(work: Callable[[], T]) -> asyncio.Future[T]:
    """Run `work` in a daemon thread; return a future of its result. Cancelling does not stop the thread."""
    done: Future[T] = Future()
    done.set_running_or_notify_cancel()

    def do() -> None:
        try:
            done.set_result(work())
        except BaseException as error:
            done.set_exception(error)

    threading.Thread(target=do, name="daemon-work", daemon=True).start()
    return asyncio.wrap_future(done)
