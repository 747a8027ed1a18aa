"""Daemon thread: result and exception arrive; blocked work blocks neither the loop nor the exit."""

import asyncio
import subprocess
import sys
import threading

import pytest

from companion.transport.daemon_thread import run_in_daemon_thread


async def test_result_arrives_while_the_loop_runs() -> None:
    gate = threading.Event()
    doing = run_in_daemon_thread(lambda: "done" if gate.wait(30.0) else "late")
    gate.set()  # only possible if the loop is not blocked
    assert await doing == "done"


async def test_exception_is_raised_in_the_caller() -> None:
    with pytest.raises(ZeroDivisionError):
        await run_in_daemon_thread(lambda: 1 // 0)


def test_cancelled_work_still_completes() -> None:
    gate, ended = threading.Event(), threading.Event()

    def work() -> None:
        gate.wait(30.0)
        ended.set()

    async def give_up() -> None:
        with pytest.raises(TimeoutError):
            await asyncio.wait_for(run_in_daemon_thread(work), 0.01)

    asyncio.run(give_up())
    gate.set()
    assert ended.wait(30.0)


def test_endless_work_does_not_block_process_exit() -> None:
    code = """
import asyncio, contextlib, threading
from companion.transport.daemon_thread import run_in_daemon_thread
async def main():
    with contextlib.suppress(TimeoutError):
        await asyncio.wait_for(run_in_daemon_thread(threading.Event().wait), 0.01)
asyncio.run(main())
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=200)
    assert (done.returncode, done.stderr) == (0, "")
