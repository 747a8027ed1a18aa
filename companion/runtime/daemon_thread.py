"""Work that may hang, done in a thread that nobody has to wait for.

    trouble = await aside(write)

`asyncio.to_thread` does it in a pool whose threads are waited for at the end of the process: with a disk that
never answers there would be none.
"""

from __future__ import annotations

import asyncio
import threading
from collections.abc import Callable
from concurrent.futures import Future
from typing import TypeVar

T = TypeVar("T")


def aside(work: Callable[[], T]) -> asyncio.Future[T]:
    """Begin `work` in a thread of its own; what it returns or raises. Cancelled, it goes on unheard."""
    done: Future[T] = Future()
    done.set_running_or_notify_cancel()

    def do() -> None:
        try:
            done.set_result(work())
        except BaseException as error:
            done.set_exception(error)

    threading.Thread(target=do, name="aside", daemon=True).start()
    return asyncio.wrap_future(done)
