"""What is done aside gives its result or its error, holds nothing else up, and may never end."""

import asyncio
import subprocess
import sys
import threading

import pytest

from companion.runtime.daemon_thread import aside


def test_its_result_comes_while_the_loop_goes_on() -> None:
    gate = threading.Event()

    async def both() -> str:
        doing = aside(lambda: "done" if gate.wait(30.0) else "late")
        gate.set()  # the loop is free to
        return await doing

    assert asyncio.run(both()) == "done"


def test_its_error_is_the_caller_s() -> None:
    async def fail() -> None:
        await aside(lambda: 1 // 0)

    with pytest.raises(ZeroDivisionError):
        asyncio.run(fail())


def test_what_is_given_up_ends_unheard() -> None:
    gate, ended = threading.Event(), threading.Event()

    def work() -> None:
        gate.wait(30.0)
        ended.set()

    async def give_up() -> None:
        with pytest.raises(TimeoutError):
            await asyncio.wait_for(aside(work), 0.01)

    asyncio.run(give_up())
    gate.set()
    assert ended.wait(30.0)


def test_what_never_ends_does_not_keep_the_process() -> None:
    code = """
import asyncio, contextlib, threading
from companion.aside import aside
async def main():
    with contextlib.suppress(TimeoutError):
        await asyncio.wait_for(aside(threading.Event().wait), 0.01)
asyncio.run(main())
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=30)
    assert (done.returncode, done.stderr) == (0, "")
