"""`companion live [LOG or folder]`: one page on the loopback address that shows a flight while it happens.

A process of its own: it reads the log that `companion run` writes and sends nothing to the flight. Files and
the socket of the page come from one port; a page of another site cannot read it (checked by Host and Origin).
"""

from __future__ import annotations

import asyncio
import contextlib
import signal
import time
from collections.abc import Callable
from importlib.resources import files
from pathlib import Path
from typing import TYPE_CHECKING

import click
import msgspec

from companion.analysis.live.follow import FollowedLog, PlayedLog, find_log, reject_foreign
from companion.analysis.live.scene import Scene
from companion.option_types import INPUT_PATH, FloatRange
from companion.optional_dependencies import missing_package
from companion.storage.reader import ACTIVE, LogError
from companion.transport.connection import reason

if TYPE_CHECKING:
    from websockets.asyncio.server import ServerConnection
    from websockets.http11 import Request, Response

    from companion.analysis.live.foxglove_server import FoxgloveServer

POLL_S = 0.1
HEARTBEAT_S = 1.0  # a frame at least so often, also without messages
FIRST_CHUNK = 256  # bytes: a shorter log is just being created and has no message yet
PORT = 8300
_PAGES = {
    "/": ("live.html", "text/html; charset=utf-8"),
    "/live.js": ("live.js", "text/javascript"),
    "/view.js": ("view.js", "text/javascript"),
    "/uplot.min.js": ("uplot.min.js", "text/javascript"),
    "/style.css": ("style.css", "text/css"),
    "/live.css": ("live.css", "text/css"),
    "/uplot.min.css": ("uplot.min.css", "text/css"),
}
_HEADERS = {
    "Content-Security-Policy": "default-src 'self'; style-src 'self' 'unsafe-inline'; img-src data:",
    "X-Content-Type-Options": "nosniff",
    "Cache-Control": "no-store",
}


class LiveView:
    """Follows the log and keeps the newest frame; a client that is slow skips frames.

    Parameters
    ----------
    path : log or folder.
    speed : pace of a finished log, in times of the flight.
    foxglove : gets every message too.
    """

    def __init__(self, path: Path, speed: float = 1.0, foxglove: FoxgloveServer | None = None) -> None:
        self._path, self._speed, self._foxglove = path, speed, foxglove
        self._source: FollowedLog | PlayedLog | None = None
        self._scene: Scene | None = None
        self._clients = 0
        self._newer = asyncio.Condition()
        self._number = 0
        self._frame = b""
        self._stopped = False
        self._due = 0.0  # when the next frame goes out at the latest

    async def follow(self) -> None:
        """Follow the log until cancelled. Reading and encoding are done in a thread."""
        while True:
            frame = await asyncio.to_thread(self._step)
            if frame:
                async with self._newer:
                    self._frame, self._number = frame, self._number + 1
                    self._newer.notify_all()
            await asyncio.sleep(POLL_S)

    async def stop(self) -> None:
        """Let go of all clients."""
        async with self._newer:
            self._stopped = True
            self._newer.notify_all()

    def _step(self) -> bytes:
        """Read what is new. Return the page if it changed or is due, and someone looks at it."""
        self._choose()
        messages = [] if self._source is None else self._source.poll()
        if self._scene is not None:
            for message in messages:
                self._scene.add(message)
        if self._foxglove is not None:
            self._foxglove.forward(messages)
        if messages and isinstance(self._source, FollowedLog) and self._source.is_behind:
            return b""  # what was written since has not been read yet
        now = time.monotonic()
        if not self._clients or not (messages or now >= self._due):
            return b""
        self._due = now + HEARTBEAT_S
        return self._encode()

    def _choose(self) -> None:
        """Open the log to show: at first, and in a folder whenever a newer one is being written."""
        if self._source is not None and not self._path.is_dir():
            return
        found = find_log(self._path)
        if found is None or (self._source is not None and self._source.path == found):
            return
        if self._path.is_dir() and not _has_header(found):
            return
        live = found.name.endswith(ACTIVE)
        try:
            source = FollowedLog(found) if live else PlayedLog(found, self._speed)
        except (FileNotFoundError, LogError):
            if found.exists():
                raise
            return  # closed in between: it has another name
        if self._source is not None:
            self._source.close()
        self._source = source
        self._scene = Scene(found.name.removesuffix(ACTIVE))

    def _encode(self) -> bytes:
        if self._scene is None or self._source is None:
            waiting = {
                "level": "caution",
                "word": "Waiting for a flight",
                "why": f"No log is being written in {self._path}.",
            }
            return msgspec.json.encode({"old": True, "trust": waiting})
        behind = None if isinstance(self._source, PlayedLog) else self._source.since_write_s()
        return msgspec.json.encode(self._scene.frame(behind, self._source.ended))

    async def serve(self, client: ServerConnection) -> None:
        """Send frames to one client until it leaves."""
        from websockets.exceptions import ConnectionClosed

        self._clients += 1
        self._due = 0.0
        seen = self._number

        def is_newer() -> bool:
            return self._stopped or self._number != seen

        try:
            with contextlib.suppress(ConnectionClosed):
                while not self._stopped:
                    async with self._newer:
                        await self._newer.wait_for(is_newer)
                        seen, frame = self._number, self._frame
                    await client.send(frame.decode())
        finally:
            self._clients -= 1


def _has_header(log: Path) -> bool:
    """Whether a log that is being written has its header: no when just created, or closed and renamed."""
    with contextlib.suppress(FileNotFoundError):
        return log.stat().st_size >= FIRST_CHUNK
    return False


def answer_pages(hosts: frozenset[str] | None) -> Callable[[ServerConnection, Request], Response | None]:
    """Return the handler of HTTP requests: files of the page; `hosts` are the names that it answers to."""
    from websockets.datastructures import Headers
    from websockets.http11 import Response

    def answer(status: int, reason: str, body: bytes, kind: str = "text/plain") -> Response:
        headers = Headers(
            {"Content-Type": kind, "Content-Length": str(len(body)), "Connection": "close", **_HEADERS}
        )
        return Response(status, reason, headers, body)

    def respond(connection: ServerConnection, request: Request) -> Response | None:
        host, origin = request.headers.get("Host", ""), request.headers.get("Origin")
        if hosts is not None and host not in hosts:
            return answer(403, "Forbidden", b"this page answers to its own address only\n")
        if request.path == "/socket":
            if origin is not None and origin != f"http://{host}":
                return answer(403, "Forbidden", b"another site may not read this page\n")
            return None
        if request.path not in _PAGES:
            return answer(404, "Not Found", b"there is no such page\n")
        name, kind = _PAGES[request.path]
        return answer(200, "OK", files("companion.analysis").joinpath("web", name).read_bytes(), kind)

    return respond


async def run(view: LiveView, host: str, port: int, on_ready: Callable[[int], None]) -> None:
    """Serve the page until SIGINT or SIGTERM. `on_ready` gets the port."""
    from websockets.asyncio.server import serve

    stopped = asyncio.Event()
    loop = asyncio.get_running_loop()
    for number in (signal.SIGINT, signal.SIGTERM):
        loop.add_signal_handler(number, stopped.set)
    names = frozenset[str]()

    def respond(connection: ServerConnection, request: Request) -> Response | None:
        local = host in ("127.0.0.1", "localhost", "::1")
        return answer_pages(names if local else None)(connection, request)

    async with serve(
        view.serve, host, port, process_request=respond, compression=None, max_size=1 << 12
    ) as server:
        port = next(iter(server.sockets)).getsockname()[1]
        names = frozenset(f"{name}:{port}" for name in ("127.0.0.1", "localhost", "[::1]"))
        on_ready(port)
        following = asyncio.create_task(view.follow())
        stopping = asyncio.create_task(stopped.wait())
        await asyncio.wait((following, stopping), return_when=asyncio.FIRST_COMPLETED)
        stopping.cancel()
        if following.done():
            following.result()
        following.cancel()
        with contextlib.suppress(asyncio.CancelledError):
            await following
        await view.stop()


@click.command("live")
@click.argument("path", type=INPUT_PATH, default=Path("logs"), metavar="[LOG or FOLDER]")
@click.option(
    "--listen",
    default=f"127.0.0.1:{PORT}",
    show_default=True,
    metavar="HOST:PORT",
    help="Address of the page.",
)
@click.option(
    "--speed",
    type=FloatRange(0.1, 1000.0),
    default=1.0,
    show_default=True,
    help="Pace of a finished log.",
)
@click.option(
    "--foxglove",
    type=click.IntRange(0, 65535),
    metavar="PORT",
    help="Serve Foxglove too, for example on 8765.",
)
def command(path: Path, listen: str, speed: float, foxglove: int | None) -> None:
    """Show a flight in a browser while it happens.

    The page has map, trust, sources, events and strip charts. A folder is followed: the newest log that is
    being written. A finished log is played back. Nothing is sent to the flight.
    """
    host, _, port = listen.rpartition(":")
    if not host or not port.isdecimal():
        raise click.BadParameter(
            f"{listen!r}: give HOST:PORT, for example 127.0.0.1:{PORT}", param_hint="--listen"
        )
    if int(port) > 65535:
        raise click.BadParameter(f"{listen!r}: {port} is not a port: give 1 to 65535", param_hint="--listen")
    found = find_log(path)
    if found is not None and path.is_dir() and not _has_header(found):
        found = None  # waited for
    if found is not None:
        reject_foreign(found)
    bridge: FoxgloveServer | None = None
    try:
        import websockets  # noqa: F401

        if foxglove is not None:
            from companion.analysis.live.foxglove_server import FoxgloveServer

            bridge = FoxgloveServer(host, foxglove)
    except ModuleNotFoundError as error:
        extra = "foxglove" if error.name == "foxglove" else "live"
        raise LogError(missing_package("the live view", error.name, extra)) from None

    def ready(number: int) -> None:
        shown = found or f"the next log in {path}"
        click.echo(
            f"companion live: http://{host.strip('[]')}:{number} shows {shown}; stop with Ctrl-C", err=True
        )
        if bridge is not None:
            click.echo(f"companion live: Foxglove on ws://{host}:{bridge.port}", err=True)

    try:
        asyncio.run(run(LiveView(path, speed, bridge), host.strip("[]"), int(port), ready))
    except LogError:
        raise
    except OSError as error:
        raise LogError(f"cannot listen on {listen}: {reason(error)}; give another --listen") from None
    finally:
        if bridge is not None:
            bridge.stop()
