"""The asyncio shell: links, timers, signals and the log round an `Onboard`. `companion run`.

Everything that decides is below; here bytes are carried, the clock is read and the deadline slept for. A link
that breaks is opened again for ever, a disk that refuses is reported, and neither stops navigation: whatever
waits for a disk, or for who reads what is told, does so in a thread of its own.

systemd is told "ready" when the log is begun and a link is open, and "alive" each time that bytes or a
deadline went through the navigator to the end and nothing is overdue, nowhere else: a navigator that hangs
hangs the loop, the watchdog is not fed, and systemd starts us anew.
"""

from __future__ import annotations

import asyncio
import contextlib
import os
import random
import signal
import sys
import threading
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path

import click

from companion import __version__
from companion.analysis.replay import metadata
from companion.config import Config, ConfigError, LogConfig, load
from companion.records import Event
from companion.runtime.core import Link, Onboard
from companion.runtime.daemon_thread import aside
from companion.runtime.signing_key import Keys
from companion.runtime.state_file import Kept
from companion.runtime.stderr_writer import Telling
from companion.runtime.systemd import Manager
from companion.storage.deferred_log import Deferred
from companion.storage.flight_log import Writer
from companion.storage.reader import LogError
from companion.storage.retention import open_log, recover_left
from companion.transport.drop_monitor import Shortfall
from companion.transport.links import Address, CannotListen, Stream, connections

EX_UNAVAILABLE, EX_CANTCREAT = 69, 73  # sysexits.h
LOG_CHECK_S = 1.0
KEEP_EVERY_S = 1.0
STOP_S = 5.0  # a disk is waited for at the end
OVERDUE_NS = 2_000_000_000


class Service:
    """One run of the companion. `tell` is handed every change of state, `now` reads the one clock, `base` is
    the operator's configuration without what ground stations set in it.
    """

    def __init__(
        self,
        config: Config,
        log: Writer,
        tell: Callable[[Event], None],
        now: Callable[[], int] = time.monotonic_ns,
        manager: Manager | None = None,
        base: Config | None = None,
    ) -> None:
        self._manager = manager or Manager({})
        self._addresses = {text: Address.parse(text) for text in config.link.connect}
        self._keys = Keys.of(config)
        signing = self._keys.signing if self._keys else None
        self._kept = Kept(Path(name) if (name := config.link.parameters_file) else None)
        self._keeping = threading.Lock()
        self._deferred = Deferred(log)
        self.onboard = Onboard(config, self._deferred, self._addresses, signing, self._kept.put, base)
        self._log, self._tell, self._now = log, tell, now
        self._streams: dict[str, Stream] = {}
        self._dropped_before: dict[str, int] = {}  # by earlier streams of the link
        self._shortfalls = {name: Shortfall(address) for name, address in self._addresses.items()}
        self._stopped = asyncio.Event()
        self._trouble: str | None = None

    def stop(self) -> None:
        """End `serve` soon."""
        self._stopped.set()

    async def serve(self) -> None:
        """Carry bytes until `stop`. Raises CannotListen where at the start an address is taken or forbidden;
        one that is not there yet, or is taken later, is tried again for ever.
        """
        try:
            async with asyncio.TaskGroup() as tasks:
                carrying = [tasks.create_task(self._carry(name)) for name in self._addresses]
                carrying += [tasks.create_task(self._keep_time()), tasks.create_task(self._keep())]
                await self._stopped.wait()
                self._manager.stopping()
                for task in carrying:
                    task.cancel()
        except* CannotListen as group:
            raise group.exceptions[0] from None
        finally:
            self._deferred.settle()

    async def _carry(self, name: str) -> None:
        """One link, opened again for ever."""
        async for stream in connections(self._addresses[name], random.random, self.say):
            link = self.onboard.links[name]
            self._streams[name], self._dropped_before[name] = stream, link.dropped
            self._manager.ready()
            try:
                await stream.hand_to(partial(self._receive, link))
            except ConnectionError as error:
                self.say(f"{name}: {error}; opening it again")
            self._count_dropped()
            del self._streams[name]

    def _receive(self, link: Link, data: bytes) -> None:
        self.onboard.receive(link.name, data, self._now())
        self._flush()

    async def _keep_time(self) -> None:
        """What is due, and whether the disk and the lines are well."""
        while True:
            now = self._now()
            self.onboard.poll(now)
            if self._log.trouble != self._trouble:
                self._trouble = self._log.trouble
                text = f"log: {self._trouble}; navigation goes on" if self._trouble else "log: writing again"
                text += f"; {self._log.dropped} messages lost so far" if self._log.dropped else ""
                self.onboard.note(4 if self._trouble else 6, text, now)
            self._look_at_lines(now)
            self._flush()
            await asyncio.sleep(max(0.0, min(1e-9 * (self.onboard.deadline() - self._now()), LOG_CHECK_S)))

    async def _keep(self) -> None:
        """What must outlive a restart. Only this waits for its disk."""
        told: str | None = None
        while True:
            await asyncio.sleep(KEEP_EVERY_S)
            if self._keys is not None:
                self._keys.follow()
            trouble = await aside(self.keep)
            if trouble is not None and trouble != told:
                self.onboard.note(4, f"parameters: {trouble}; none can be set until it is", self._now())
            told = trouble

    def _count_dropped(self) -> None:
        for name, stream in self._streams.items():
            self.onboard.links[name].dropped = self._dropped_before[name] + stream.dropped

    def _look_at_lines(self, now: int) -> None:
        self._count_dropped()
        for name in self._streams:
            shortfall = self._shortfalls[name]
            text = shortfall.look(self.onboard.links[name].dropped, 1e-9 * now)
            if text is not None:
                self.onboard.note(4 if shortfall.lasts else 6, text, now)

    def _flush(self) -> None:
        now = self._now()
        for name in self._addresses:
            frames = self.onboard.to_send(name, now)
            stream = self._streams.get(name)
            if stream is not None:
                for data in frames:
                    stream.write(data)
        for event in self.onboard.take_events():
            self._tell(event)
            self._manager.status(event.text)
        if now - self.onboard.deadline() < OVERDUE_NS:
            self._manager.alive(now)
        self.onboard.settle()
        self._deferred.settle()

    def keep(self) -> str | None:
        """Put on disk what must outlive a restart; waits for the disk, and for what is being put there. What
        the disk said of the parameters.
        """
        with self._keeping:
            if self._keys is not None:
                self._keys.store()
            return self._kept.write()

    def say(self, text: str) -> None:
        """Log and tell what happened to links and files."""
        self.onboard.note(5, text, self._now())
        self._deferred.settle()


async def run(config: Config, tell: Callable[[Event], None], base: Config | None = None) -> None:
    """Open the log, serve until SIGINT or SIGTERM, close the log. `base`: see `Service`."""
    start_ns, start_unix_ns = time.monotonic_ns(), time.time_ns()
    settings = config.log
    log = open_log(
        settings.folder,
        metadata=metadata(config),
        start_unix_ns=start_unix_ns,
        start_ns=start_ns,
        max_files=settings.maximum_files,
        min_free=settings.minimum_free_mib << 20,
        chunk_bytes=settings.chunk_kib << 10,
    )
    service, flew = None, True
    try:
        service = Service(config, log, tell, manager=Manager(os.environ), base=base)
        loop = asyncio.get_running_loop()
        for number in (signal.SIGINT, signal.SIGTERM):
            loop.add_signal_handler(number, service.stop)
        service.onboard.note(6, f"companion {__version__}: log {log.path}", time.monotonic_ns())
        recovering = partial(_recover, settings, service, asyncio.get_running_loop())
        threading.Thread(target=recovering, name="recover", daemon=True).start()
        await service.serve()
        with contextlib.suppress(TimeoutError):
            await asyncio.wait_for(aside(service.keep), STOP_S)
    except (CannotListen, ConfigError):  # a log of nothing takes no flight's place
        flew = service is not None and any(link.received for link in service.onboard.links.values())
        raise
    finally:
        await aside(log.close)
        if flew:
            text = f"log: closed as {log.path}" if log.trouble is None else f"log: left torn, {log.trouble}"
            text += f"; {log.dropped} messages were lost" if log.dropped else ""
            tell(Event(time.monotonic_ns(), time.monotonic_ns(), 6, text))
        else:
            log.path.unlink(missing_ok=True)


def _recover(settings: LogConfig, service: Service, loop: asyncio.AbstractEventLoop) -> None:
    """Make whole what earlier runs left torn, which takes seconds for each hour of them: navigation is not to
    wait for it, nor the end of the service (what is begun twice is begun anew)."""
    for found in recover_left(settings.folder, settings.minimum_free_mib << 20):
        text = f"log: {found.path} recovered, {found.messages} messages"
        with contextlib.suppress(RuntimeError):  # the loop has ended
            loop.call_soon_threadsafe(service.say, text)


@click.command("run")
@click.option("--config", "file", type=click.Path(path_type=Path), help="TOML file; see check-config.")
@click.option("--connect", multiple=True, help="Link (may be repeated): udpin:HOST:PORT, tcp:HOST:PORT, ...")
@click.option("--logs", help="Folder for the flight's log.")
@click.option("--set", "pairs", multiple=True, metavar="SECTION.KEY=VALUE", help="Any other key of the file.")
def command(file: Path | None, connect: tuple[str, ...], logs: str | None, pairs: tuple[str, ...]) -> None:
    """Navigate: listen to the autopilot, send it corrected estimates, log everything, until SIGINT or
    SIGTERM.

    Links are serial:DEVICE:BAUD, udpin:HOST:PORT, udpout:HOST:PORT, tcp:HOST:PORT and tcpin:HOST:PORT. Exit
    codes: 0 stopped, 69 an address to listen on is taken or forbidden at the start, 73 no log can be begun
    (folder or room), 78 bad configuration.
    """
    flags = {"link.connect": connect or None, "log.folder": logs}
    base = config = load(file, flags, pairs=pairs)
    if config.link.parameters_file and Path(config.link.parameters_file).exists():
        config = load(file, flags, pairs=pairs, tuned=Path(config.link.parameters_file))
    try:
        for text in config.link.connect:
            Address.parse(text)
    except ValueError as error:
        raise ConfigError(f"link.connect: {error}") from None
    begun, telling = time.monotonic_ns(), Telling()

    def tell(event: Event) -> None:
        telling.tell(f"{(event.rx_ns - begun) * 1e-9:9.3f} {event.text}")

    try:
        asyncio.run(run(config, tell, base))
    except CannotListen as error:
        telling.tell(f"companion: {error.strerror}")
        sys.exit(EX_UNAVAILABLE)
    except LogError as error:
        telling.tell(f"companion: {error}")
        sys.exit(EX_CANTCREAT)
    finally:
        telling.close()
