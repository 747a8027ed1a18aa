"""Service: the asyncio shell around `CompanionCore`, and the command `companion run`.

It transfers bytes, reads the clock, waits for deadlines and handles signals; it decides nothing. A broken
link is reopened until stopped and a failing disk is reported; neither stops navigation, because everything
that waits for a disk or for the reader of stderr runs in a thread of its own.

systemd is notified "ready" when the log and a link are open. The watchdog is fed only after bytes or a
deadline have been processed completely and nothing is overdue. So if the navigator hangs, the event loop
hangs, the watchdog expires and systemd restarts the service.
"""

from __future__ import annotations

import asyncio
import contextlib
import gc
import os
import random
import signal
import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Hashable, Iterable
from functools import partial
from pathlib import Path

import click

from companion import __version__
from companion.config import Config, ConfigError, LogConfig, load
from companion.config.options import configuration_options
from companion.printable import printable
from companion.records import Event, Severity
from companion.runtime.console import Console, terminal_columns
from companion.runtime.core import CompanionCore
from companion.runtime.exposure import exposure
from companion.runtime.kept_parameters import KeptParameters
from companion.runtime.kept_run import KEEP_AFTER_S, KEEP_S, Flown, KeptRun
from companion.runtime.link_addresses import check_links
from companion.runtime.links import Link
from companion.runtime.signing_key import SigningKey
from companion.runtime.state_file import StateFile
from companion.runtime.status import Status
from companion.runtime.stderr_writer import StderrWriter
from companion.runtime.systemd import SystemdNotifier
from companion.storage.deferred_log import DeferredLog
from companion.storage.flight_log import Writer
from companion.storage.reader import LogError
from companion.storage.retention import create_log, recover_unclosed
from companion.storage.run_metadata import run_metadata
from companion.transport.daemon_thread import run_in_daemon_thread
from companion.transport.drop_monitor import DropMonitor
from companion.transport.reconnect import Address, CannotListen, Connection, cannot_listen, connections

LOG_CHECK_S = 1.0
SAVE_INTERVAL_S = 1.0
STOP_TIMEOUT_S = 5.0  # limit on waiting for a disk at the end
STATUS_INTERVAL_NS = 1_000_000_000
OVERDUE_NS = 2_000_000_000
CONFIRM_AFTER_S = 60.0  # of solutions with parameters set by ground stations


def ignore_status(status: Status, now_ns: int) -> None:
    """Show no status."""


class Service:
    """One run of the companion.

    `on_event` is called for every event, `base` is the operator's configuration without the values that
    ground stations set, `kept` the file of those, `deleted` the logs that were deleted and are still to be
    reported. `on_status` is called once a second. `kept_run` is the file of what the next run needs of the
    flight, `flown` what the run before left there.
    """

    def __init__(
        self,
        config: Config,
        log: Writer,
        on_event: Callable[[Event], None],
        notifier: SystemdNotifier | None = None,
        base: Config | None = None,
        kept: KeptParameters | None = None,
        deleted: deque[Path] | None = None,
        on_status: Callable[[Status, int], None] = ignore_status,
        kept_run: KeptRun | None = None,
        flown: Flown | None = None,
    ) -> None:
        self._kept, self._kept_run = kept, kept_run
        self._deleted = deque[Path]() if deleted is None else deleted
        self._on_status, self._next_status_ns = on_status, 0
        self._notifier = notifier or SystemdNotifier({})
        self._addresses = {str(address): address for address in map(Address.parse, config.link.connect)}
        self._signing_key = SigningKey.from_config(config)
        signing = self._signing_key.signing if self._signing_key else None
        self._parameters_file = StateFile(Path(name) if (name := config.link.parameters_file) else None)
        self._save_lock = threading.Lock()
        self._deferred = DeferredLog(log)
        self.core = CompanionCore(
            config, self._deferred, self._addresses, signing, self._parameters_file.put, base, flown
        )
        self._log, self._on_event = log, on_event
        self._connections: dict[str, Connection] = {}
        self._dropped_before: dict[str, int] = {}  # by earlier connections of the link
        self._drop_monitors = {name: DropMonitor(address) for name, address in self._addresses.items()}
        self._trouble: str | None = None

    async def serve(self, stopped: asyncio.Event) -> None:
        """Run links and timers until `stopped`.

        Raises CannotListen if at the start an address is in use or forbidden. An address that does not exist
        yet, or is in use later, is retried until stopped.
        """
        try:
            async with asyncio.TaskGroup() as tasks:
                running = [tasks.create_task(self._run_link(name)) for name in self._addresses]
                running += [
                    tasks.create_task(self._run_timers()),
                    tasks.create_task(self._save_state_periodically()),
                    tasks.create_task(self._keep_flight_periodically()),
                ]
                await stopped.wait()
                self._notifier.stopping()
                for task in running:
                    task.cancel()
        except ExceptionGroup as group:
            raise cannot_listen(group) from None
        finally:
            self._deferred.flush()

    async def _run_link(self, name: str) -> None:
        """Serve one link; reopen it whenever it fails."""
        link = self.core.links[name]
        judge = partial(self._judge, link)
        link.is_open = False
        async for stream in connections(self._addresses[name], random.random, self.report, judge):
            link.is_open = True
            link.session.reader.close()  # what is left of a frame of the connection before
            self._connections[name], self._dropped_before[name] = stream, link.dropped
            self._notifier.ready()
            if self._addresses[name].listens:
                address = self._addresses[name]._replace(number=stream.port)  # 0 asks for any free one
                self.core.report(Severity.INFO, f"listening: {address}", time.monotonic_ns())
                self._flush()
            try:
                await stream.deliver_to(partial(self._receive, link, stream))
            except ConnectionError as error:
                self.report(f"{error}; reopening")
            self._count_dropped()
            del self._connections[name]
            link.is_open = False

    def _judge(self, link: Link) -> Callable[[bytes], bool]:
        is_proven = link.session.judge()
        return lambda data: is_proven(data, time.monotonic_ns())

    def _receive(self, link: Link, stream: Connection, data: bytes, peer: Hashable) -> None:
        stream.note(peer, self.core.receive(link.name, data, time.monotonic_ns(), peer))
        self._flush()

    async def _run_timers(self) -> None:
        """Run periodic work; report changes of the state of the disk and the lines."""
        while True:
            now = time.monotonic_ns()
            self.core.poll(now)
            if self._log.trouble != self._trouble:
                self._trouble = self._log.trouble
                text = (
                    f"log: {self._trouble}; navigation continues" if self._trouble else "log: writing resumed"
                )
                text += f"; {self._log.dropped} messages lost so far" if self._log.dropped else ""
                self.core.report(Severity.WARNING if self._trouble else Severity.INFO, text, now)
            self._report_drops(now)
            while self._deleted:
                text = f"log: {self._deleted.popleft().name} deleted to keep the limits of [log]"
                self.core.report(Severity.NOTICE, text, now)
            self._flush()
            if now >= self._next_status_ns:
                self._next_status_ns = now + STATUS_INTERVAL_NS
                self._on_status(self.core.status(), now)
            await asyncio.sleep(
                max(0.0, min(1e-9 * (self.core.deadline() - time.monotonic_ns()), LOG_CHECK_S))
            )

    async def _save_state_periodically(self) -> None:
        """Save the state that outlives a restart; only this task waits for its disk."""
        reported: list[str] = []
        solved_s = 0.0
        while True:
            await asyncio.sleep(SAVE_INTERVAL_S)
            if self.core.has_solution and solved_s < CONFIRM_AFTER_S:
                solved_s += SAVE_INTERVAL_S
                if solved_s >= CONFIRM_AFTER_S:
                    await run_in_daemon_thread(self.confirm_parameters)
            if self._signing_key is not None:
                self._signing_key.follow_system_time()
            before, reported = reported, await run_in_daemon_thread(self.save_state)
            for text in reported:
                if text not in before:
                    self.core.report(Severity.WARNING, text, time.monotonic_ns())

    async def _keep_flight_periodically(self) -> None:
        """Keep what the next run needs of the flight; only this task waits for its disk."""
        if self._kept_run is None:
            return
        solved_s, trouble = 0.0, ""
        while True:
            await asyncio.sleep(KEEP_S)
            flown = self.core.flown(time.monotonic_ns())
            solved_s += KEEP_S if flown else 0.0
            if flown is None or solved_s < KEEP_AFTER_S:
                continue
            before, trouble = trouble, await run_in_daemon_thread(partial(self._kept_run.keep, flown))
            if trouble and trouble != before:
                text = f"{trouble}; after a restart in flight navigation would begin again"
                self.core.report(Severity.WARNING, text, time.monotonic_ns())

    def _count_dropped(self) -> None:
        for name, stream in self._connections.items():
            self.core.links[name].dropped = self._dropped_before[name] + stream.dropped

    def _report_drops(self, now: int) -> None:
        self._count_dropped()
        for name in self._connections:
            monitor = self._drop_monitors[name]
            text = monitor.update(self.core.links[name].dropped, 1e-9 * now)
            if text is not None:
                self.core.report(Severity.WARNING if monitor.is_dropping else Severity.INFO, text, now)

    def _flush(self) -> None:
        now = time.monotonic_ns()
        for name in self._addresses:
            frames = self.core.to_send(name, now)
            stream = self._connections.get(name)
            if stream is not None:
                for data in frames:
                    stream.write(data)
        for event in self.core.take_events():
            self._on_event(event)
            self._notifier.status(event.text)
        if self._notifier.is_watchdog_due(now) and now - self.core.deadline() < OVERDUE_NS:
            self._notifier.alive(now)
        self.core.settle()
        self._deferred.flush()
        if self.core.births_due:  # two turns of their own: each half takes as long as an answer
            asyncio.get_running_loop().call_soon(self._bear)

    def _bear(self) -> None:
        """Do one half and let the other follow, no more: births that fail stay due."""
        self.core.bear()
        if self.core.births_due:
            asyncio.get_running_loop().call_soon(self.core.bear)

    def save_state(self) -> list[str]:
        """Save the timestamp and the parameters; return a sentence for each that the disk did not take.

        Blocks on the disk and on another call in progress.
        """
        with self._save_lock:
            troubles = list[str]()
            if self._signing_key is not None and (trouble := self._signing_key.save_timestamp()):
                troubles.append(
                    f"signing: {trouble}; after a restart frames of this run may be accepted again"
                )
            if trouble := self._parameters_file.write():
                troubles.append(f"parameters: {trouble}; parameters cannot be set until this is resolved")
            return troubles

    def confirm_parameters(self) -> None:
        """Accept the parameters set by ground stations: the service works with them. Blocks on the disk."""
        if self._kept is not None:
            self._kept.confirm()

    def report(self, text: str) -> None:
        """Log and report a change of links and files."""
        self.core.report(Severity.NOTICE, text, time.monotonic_ns())
        self._deferred.flush()


async def run(
    config: Config,
    on_event: Callable[[Event], None],
    base: Config | None = None,
    kept: KeptParameters | None = None,
    notes: Iterable[str] = (),
    on_status: Callable[[Status, int], None] = ignore_status,
) -> None:
    """Open the log, report `notes`, serve until SIGINT, SIGTERM or SIGHUP, close the log.

    The other parameters are those of `Service`.
    """
    start_ns, start_unix_ns = time.monotonic_ns(), time.time_ns()
    loop, stopped = asyncio.get_running_loop(), asyncio.Event()
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        if number != signal.SIGHUP or signal.getsignal(number) != signal.SIG_IGN:  # nohup ignores it
            loop.add_signal_handler(number, stopped.set)
    settings, deleted = config.log, deque[Path]()
    log = create_log(
        settings.folder,
        metadata=run_metadata(config),
        start_unix_ns=start_unix_ns,
        start_ns=start_ns,
        max_files=settings.maximum_files,
        min_free=settings.minimum_free_mib << 20,
        chunk_bytes=settings.chunk_kib << 10,
        on_delete=deleted.append,
    )
    service, has_data = None, True
    kept_run = KeptRun(Path(settings.folder))
    flown = kept_run.take(config)
    try:
        if kept is not None:
            kept.count_start()
        service = Service(
            config,
            log,
            on_event,
            notifier=SystemdNotifier(os.environ),
            base=base,
            kept=kept,
            deleted=deleted,
            on_status=on_status,
            kept_run=kept_run,
            flown=flown,
        )
        service.core.report(Severity.INFO, f"companion {__version__}: log {log.path}", time.monotonic_ns())
        for address in map(Address.parse, config.link.connect):
            if not address.listens:  # those that listen are reported once they do
                service.core.report(Severity.INFO, f"connecting: {address}", time.monotonic_ns())
            is_open, sentence = exposure(address, config)
            severity = Severity.WARNING if is_open else Severity.INFO
            service.core.report(severity, sentence, time.monotonic_ns())
        for note in notes:
            service.core.report(Severity.WARNING, note, time.monotonic_ns())
        recover = partial(_recover_logs, settings, service, loop, deleted)
        threading.Thread(target=recover, name="recover", daemon=True).start()
        gc.freeze()  # what was imported stays: looking through all of it for cycles takes 25 ms
        await service.serve(stopped)
        kept_run.end()
        with contextlib.suppress(TimeoutError):
            await asyncio.wait_for(run_in_daemon_thread(service.save_state), STOP_TIMEOUT_S)
            await asyncio.wait_for(run_in_daemon_thread(service.confirm_parameters), STOP_TIMEOUT_S)
    except (CannotListen, ConfigError, SystemExit) as error:
        if flown is not None and isinstance(error, CannotListen):  # it was not used
            kept_run.keep(flown)
        if kept is not None:  # neither the values' fault (`load` has checked them) nor a stop is one
            kept.withdraw_start()
        # an empty log would count in log.maximum_files
        has_data = service is not None and any(link.received for link in service.core.links.values())
        raise
    finally:
        await run_in_daemon_thread(log.close)
        if has_data:
            text = f"log: closed as {log.path}" if log.trouble is None else f"log: not closed, {log.trouble}"
            text += f"; {log.dropped} messages were lost" if log.dropped else ""
            on_event(Event(time.monotonic_ns(), time.monotonic_ns(), Severity.INFO, text))
        else:
            log.path.unlink(missing_ok=True)


def _recover_logs(
    settings: LogConfig, service: Service, loop: asyncio.AbstractEventLoop, deleted: deque[Path]
) -> None:
    """Recover the unclosed logs of earlier runs.

    This takes seconds per hour of log, so neither navigation nor the end of the service waits for it; an
    interrupted recovery restarts at the next run.
    """
    for found in recover_unclosed(settings.folder, settings.minimum_free_mib << 20, deleted.append):
        text = f"log: {found.path} recovered, {found.messages} messages"
        with contextlib.suppress(RuntimeError):  # the loop has ended
            loop.call_soon_threadsafe(service.report, text)


@click.command("run")
@configuration_options
@click.option("--connect", multiple=True, help="Link (may be repeated): udpin:HOST:PORT, tcp:HOST:PORT, ...")
@click.option("--logs", help="Folder for the flight's log.")
@click.option(
    "--log-format",
    type=click.Choice(["text", "json"]),
    default="text",
    show_default=True,
    help="Lines on stderr: text, with a live status line on a terminal, or JSON objects.",
)
def command(
    file: Path | None,
    preset: str | None,
    pairs: tuple[str, ...],
    connect: tuple[str, ...],
    logs: str | None,
    log_format: str,
) -> None:
    """Navigate, send the autopilot corrected positions, and log.

    Runs until SIGINT (Ctrl-C), SIGTERM or SIGHUP. Prints what it waits for and which inputs are missing.

    Links are serial:DEVICE:BAUD, udpin:HOST:PORT, udpout:HOST:PORT, tcp:HOST:PORT and tcpin:HOST:PORT. Exit
    codes: 0 stopped, 69 an address to listen on is in use or forbidden at the start, 73 no log can be created
    (folder or free space), 78 invalid configuration.
    """
    flags = {"link.connect": connect or None, "log.folder": logs}

    def load_with(tuned: Path | None) -> Config:
        config = load(file, flags, pairs=pairs, tuned=tuned, preset=preset)
        check_links(config)
        return config

    base = config = load_with(None)
    kept, notes = None, list[str]()
    if base.link.parameters_file:
        kept = KeptParameters(Path(base.link.parameters_file))
        config, notes = kept.load(base, partial(load_with, kept.path), file)
    writer = StderrWriter()
    console = Console(
        writer.write_line,
        time.monotonic_ns(),
        as_json=log_format == "json",
        columns=terminal_columns(),
    )
    try:
        with contextlib.closing(console):
            asyncio.run(run(config, console.event, base, kept, notes, console.status))
    except CannotListen as error:
        writer.write_line(f"companion: {printable(str(error.strerror))}")
        sys.exit(os.EX_UNAVAILABLE)
    except LogError as error:
        writer.write_line(f"companion: {printable(str(error))}")
        sys.exit(os.EX_CANTCREAT)
    finally:
        writer.close()
