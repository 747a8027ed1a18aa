"""What tests share: the command line, and a real browser, headless Chromium driven through its DevTools
protocol.
"""

from __future__ import annotations

import asyncio
import gc
import inspect
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import time
import urllib.request
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import hypothesis
import pytest

# as the command line does: with batches of 20 states, threads of BLAS only wait for each other
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

# a busy machine is no failure; pytest has its own limit
hypothesis.settings.register_profile("untimed", deadline=None)
hypothesis.settings.load_profile("untimed")


def pytest_configure(config: pytest.Config) -> None:
    """Let each worker collect from another file on: in a fresh clone they load what others have compiled."""
    worker, here = os.environ.get("PYTEST_XDIST_WORKER"), Path(__file__).parent
    if worker and [Path(argument).resolve() for argument in config.args] == [here]:
        files = sorted(str(path) for path in here.rglob("test_*.py"))
        first = len(files) * int(worker.removeprefix("gw")) // int(os.environ["PYTEST_XDIST_WORKER_COUNT"])
        config.args = files[first:] + files[:first]


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Give the tests the same order in every worker."""
    if "PYTEST_XDIST_WORKER" in os.environ:
        items.sort(key=lambda item: item.path)


def pytest_collection_finish() -> None:
    """Leave the collected tests, which live to the end, out of every later garbage collection."""
    gc.freeze()


def pytest_pyfunc_call(pyfuncitem: pytest.Function) -> None:
    """Run an async test in an event loop, for two minutes at most."""
    test = pyfuncitem.obj
    if inspect.iscoroutinefunction(test):
        pyfuncitem.obj = lambda **arguments: asyncio.run(asyncio.wait_for(test(**arguments), 120.0))


@pytest.fixture
def companion(
    capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> Callable[..., subprocess.CompletedProcess[str]]:
    """Call the entry point `companion` in this process: another one takes half a second to start."""
    from companion.__main__ import main

    def run(*arguments: str | Path) -> subprocess.CompletedProcess[str]:
        monkeypatch.setattr(sys, "argv", ["companion", *map(str, arguments)])
        handlers = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
        try:
            with pytest.raises(SystemExit) as ended:
                main()
        finally:
            for number, handler in handlers.items():
                signal.signal(number, handler)
        assert isinstance(ended.value.code, int)
        return subprocess.CompletedProcess(sys.argv, ended.value.code, *capfd.readouterr())

    return run


CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser")


class Browser:
    """One page; `console` holds its messages, warnings and exceptions, `requests` every URL that it loads."""

    def __init__(self, profile: Path) -> None:
        from websockets.sync.client import connect

        assert CHROMIUM is not None
        self._process = subprocess.Popen(
            [
                *(CHROMIUM, "--headless", "--no-sandbox", "--disable-gpu", "--no-first-run"),
                *("--disable-background-networking", "--disable-component-update", "--disable-sync"),
                *("--remote-debugging-port=0", f"--user-data-dir={profile}", "about:blank"),
            ],
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            text=True,
        )
        assert self._process.stderr is not None
        found = next(m for line in self._process.stderr if (m := re.search(r"ws://([^/]+)/", line)))
        with urllib.request.urlopen(f"http://{found[1]}/json") as answer:
            page = next(tab for tab in json.load(answer) if tab["type"] == "page")
        self._open = connect(page["webSocketDebuggerUrl"], max_size=None)
        self._socket = self._open.__enter__()
        self._count = 0
        self.console: list[str] = []
        self.requests: list[str] = []
        for domain in ("Page", "Runtime", "Log", "Network"):
            self.call(f"{domain}.enable")

    def __enter__(self) -> Browser:
        return self

    def __exit__(self, *error: object) -> None:
        self._open.__exit__(None, None, None)
        self._process.kill()
        self._process.wait()
        assert self._process.stderr is not None
        self._process.stderr.close()

    def call(self, method: str, **parameters: object) -> dict[str, Any]:
        """Call a method of the protocol; events that come meanwhile are collected."""
        self._count += 1
        self._socket.send(json.dumps({"id": self._count, "method": method, "params": parameters}))
        while True:
            answer = json.loads(self._socket.recv(timeout=60))
            if answer.get("id") == self._count:
                assert "error" not in answer, answer
                return answer["result"]  # type: ignore[no-any-return]
            if answer.get("method") in (
                "Runtime.exceptionThrown",
                "Log.entryAdded",
                "Runtime.consoleAPICalled",
            ):
                self.console.append(json.dumps(answer["params"]))
            elif answer.get("method") == "Network.requestWillBeSent":
                self.requests.append(answer["params"]["request"]["url"])

    def open(self, url: str, width: int = 1280, dark: bool = False) -> None:
        """Open a page in a window `width` wide."""
        mobile = width < 600
        self.call(
            "Emulation.setDeviceMetricsOverride", width=width, height=900, deviceScaleFactor=1, mobile=mobile
        )
        scheme = {"name": "prefers-color-scheme", "value": "dark" if dark else "light"}
        self.call("Emulation.setEmulatedMedia", features=[scheme])
        self.call("Page.navigate", url=url)

    def evaluate(self, script: str) -> Any:
        """Return the value of an expression in the page."""
        found = self.call("Runtime.evaluate", expression=script, returnByValue=True, awaitPromise=True)
        assert "exceptionDetails" not in found, found
        return found["result"].get("value")

    def wait_for(self, script: str, timeout_s: float = 60.0) -> Any:
        """Return the first true value of an expression."""
        end = time.monotonic() + timeout_s
        while not (value := self.evaluate(script)):
            assert time.monotonic() < end, f"{script} is still {value!r}; console: {self.console}"
            time.sleep(0.05)
        return value


@pytest.fixture
def browser(tmp_path: Path) -> Iterator[Browser]:
    """A browser; skipped where there is none."""
    pytest.importorskip("websockets")
    if CHROMIUM is None:
        pytest.skip("no chromium to open the page in")
    with Browser(tmp_path / "browser") as found:
        yield found
